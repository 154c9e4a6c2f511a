"""Every kind of stress experiment by the name that a list gives it.

A list names a kind and its arguments; the module of the kind says what it does and which quantities it measures.
"""

from __future__ import annotations

from gran_bench.stress.beds import BEDS
from gran_bench.stress.experiment import Experiment
from gran_bench.stress.impacts import IMPACTS
from gran_bench.stress.rollouts import ROLLOUTS
from gran_bench.stress.steps import STEPS
from gran_bench.stress.symmetries import SYMMETRIES

EXPERIMENTS: dict[str, Experiment] = {
    **IMPACTS,
    **BEDS,
    **STEPS,
    **ROLLOUTS,
    **SYMMETRIES,
}
