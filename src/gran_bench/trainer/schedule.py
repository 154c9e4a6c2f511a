"""What changes in the course of a training: the learning rate, the frames ahead, and what an update takes."""

import math

from gran_bench.config import OptimConfig, RolloutConfig
from gran_bench.dataset.mixture import Mixture


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


def work_of_updates(config: RolloutConfig, steps: int, mixture: Mixture | None, done: int = 0) -> list[float]:
    """What updates ``done`` … ``steps`` − 1 take, in frames of a window of the run's own scene."""
    sizes = (1.0 if mixture is None else mixture.size(step / steps) for step in range(done, steps))
    return [size * frames_ahead(config, step, steps) for step, size in enumerate(sizes, done)]
