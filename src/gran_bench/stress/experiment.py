"""What a stress experiment is: a function with named parameters, the quantities that it measures, and their units."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from gran_bench.stress.expectation import Observation
from gran_bench.surrogate.step import Surrogate


@dataclass(frozen=True)
class Subject:
    """A model under stress.

    Attributes:
        label: for tables and figures.
        name: ``contact``, ``radial`` or ``ccnn``.
        model: in evaluation mode.
        diameter: of the spheres that it was made for, m.
    """

    label: str
    name: str
    model: Surrogate
    diameter: float


@dataclass(frozen=True)
class Bench:
    """What an experiment may use beside its parameters.

    Attributes:
        shared: folder of settled beds that the cases of a run share.
        subject: the model under stress; None for the DEM.
    """

    shared: Path
    subject: Subject | None = None

    @property
    def model(self) -> Subject:
        """The model under stress.

        Raises:
            RuntimeError: an experiment without a model asks for one.
        """
        if self.subject is None:
            raise RuntimeError("this experiment has no model")
        return self.subject


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
        """The parameters that a case may set, by name."""
        return dict(list(inspect.signature(self.run).parameters.items())[1:])
