"""Every kind of stress experiment by the name that a list gives it."""

from __future__ import annotations

from gran_bench.stability.beds import BEDS
from gran_bench.stability.damage import DAMAGE
from gran_bench.stability.experiment import Experiment
from gran_bench.stability.full_disk import FULL_DISK
from gran_bench.stability.impacts import IMPACTS
from gran_bench.stability.kills import KILLS
from gran_bench.stability.rollouts import ROLLOUTS
from gran_bench.stability.sharing import SHARING
from gran_bench.stability.steps import STEPS
from gran_bench.stability.symmetries import SYMMETRIES

EXPERIMENTS: dict[str, Experiment] = {
    **IMPACTS,
    **BEDS,
    **STEPS,
    **ROLLOUTS,
    **SYMMETRIES,
    **DAMAGE,
    **FULL_DISK,
    **KILLS,
    **SHARING,
}
