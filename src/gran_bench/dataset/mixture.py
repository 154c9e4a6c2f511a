"""Which scene a training window is of: shares of the windows, a row for each stage of a training."""

from collections.abc import Sequence

import numpy as np

from gran_bench.dataset.case_file import Case
from gran_bench.dataset.case_spec import CaseSpec


class Mixture:
    """Draws a case: first its scene, by the shares of the stage, then one of the scene's cases, each as likely.

    Args:
        cases: made or to be made; those of a scene stand together, the run's own scene first.
        shares: ``(S, K)`` of windows, for each stage and scene; a row has any sum above 0. None: every scene alike.
        until: ``(S − 1,)`` share of the budget at which each stage but the last ends, increasing.
    """

    def __init__(
        self,
        cases: Sequence[Case | CaseSpec],
        shares: Sequence[Sequence[float]] | None = None,
        until: Sequence[float] = (),
    ) -> None:
        names = [case.scene.name for case in cases]
        self._cases = [[i for i, name in enumerate(names) if name == scene] for scene in dict.fromkeys(names)]
        rows = np.asarray(shares or [[1.0] * len(self._cases)], float)
        self._shares, self._until = rows / rows.sum(axis=1, keepdims=True), list(until)
        counts = np.array([cases[group[0]].scene.filling.count for group in self._cases], float)
        self._size = self._shares @ counts / counts[0]

    def _stage(self, progress: float) -> int:
        return int(np.searchsorted(self._until, progress, side="right"))

    def draw(self, rng: np.random.Generator, progress: float) -> int:
        """Number of a case, at a share of the budget, 0 … 1."""
        share = self._shares[self._stage(progress)]
        group = self._cases[int(rng.choice(len(share), p=share))]
        return group[int(rng.integers(len(group)))]

    def size(self, progress: float) -> float:
        """Mean number of spheres of a window over that of the run's own scene, at a share of the budget."""
        return float(self._size[self._stage(progress)])
