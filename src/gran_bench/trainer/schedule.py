"""What changes while a training goes on: its learning rate, and how many frames it looks ahead."""

from __future__ import annotations

import math

from gran_bench.config import OptimConfig, RolloutConfig


def learning_rate(config: OptimConfig, step: int, steps: int) -> float:
    """Learning rate of update ``step`` (0 … steps − 1).

    ``steps`` falls geometrically in ``decay_steps`` equal drops from the first to the final rate, ``cosine``
    follows half a cosine between them, ``constant`` stays. A linear warm-up multiplies the first updates.
    """
    first, final = config.learning_rate, config.final_learning_rate
    progress = step / max(steps, 1)
    if config.schedule == "steps":
        drops = min(int(progress * (config.decay_steps + 1)), config.decay_steps)
        rate = first * (final / first) ** (drops / max(config.decay_steps, 1))
    elif config.schedule == "cosine":
        rate = final + 0.5 * (first - final) * (1.0 + math.cos(math.pi * progress))
    else:
        rate = first
    return rate * min(1.0, (step + 1) / config.warmup_steps) if config.warmup_steps else rate


def frames_ahead(config: RolloutConfig, step: int, steps: int) -> int:
    """F at update ``step``: ``frames``, growing to ``final_frames`` where that is set.

    ``growth = jump`` goes there at once at ``final_from`` of the budget; ``linear`` takes every number on the way, each
    for as many updates, and is there at the same moment.
    """
    first, last, until = config.frames, config.final_frames, config.final_from * steps
    if last is None:
        return first
    if step >= until:
        return last
    return first + int((last - first) * step / until) if config.growth == "linear" else first
