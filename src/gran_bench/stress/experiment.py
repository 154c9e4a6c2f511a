"""What a stress experiment is: a function with named parameters, the quantities that it measures, and their units."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from gran_bench.stress.expectation import Observation
from gran_bench.surrogate.step import Surrogate


@dataclass(frozen=True)
class Bench:
    """What an experiment may use beside its parameters."""

    shared: Path  # folder of settled beds that the cases of a run share
    model: Surrogate | None = None  # under stress, in evaluation mode; None for the DEM


@dataclass(frozen=True)
class Experiment:
    """A kind of stress case."""

    run: Callable[..., Observation]  # called with a bench and the parameters of the case by name
    measures: Mapping[str, str]  # unit of each quantity by its name
    of_model: bool = False  # whether it is done with a model
    alone: bool = False  # whether nothing else may run beside it, because it takes times

    @property
    def parameters(self) -> dict[str, inspect.Parameter]:
        """The parameters that a case may set, by name, with evaluated annotations."""
        return dict(list(inspect.signature(self.run, eval_str=True).parameters.items())[1:])
