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
    """What an experiment may use beside its parameters.

    Attributes:
        shared: folder of settled beds that the cases of a run share.
        model: under stress, in evaluation mode; None for the DEM.
    """

    shared: Path
    model: Surrogate | None = None


@dataclass(frozen=True)
class Experiment:
    """A kind of stress case.

    Attributes:
        run: called with a bench and the parameters of the case by name.
        measures: unit of each quantity by its name.
        of_model: whether it is done with a model.
        alone: whether nothing else may run beside it, because it takes times.
    """

    run: Callable[..., Observation]
    measures: Mapping[str, str]
    of_model: bool = False
    alone: bool = False

    @property
    def parameters(self) -> dict[str, inspect.Parameter]:
        """The parameters that a case may set, by name, with evaluated annotations."""
        return dict(list(inspect.signature(self.run, eval_str=True).parameters.items())[1:])
