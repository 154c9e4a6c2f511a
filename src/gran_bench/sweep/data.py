"""The data of all jobs of a sweep, made once before any of them starts, so that no two jobs wait for each other."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable

from gran_bench.config import TrainConfig
from gran_bench.dataset import CaseSpec, DatasetError, ensure_cases
from gran_bench.run.identity import all_cases
from gran_bench.run.record import tell


def make_data(configs: Iterable[TrainConfig]) -> None:
    """Make every run of the DEM that the jobs need and that is not there.

    What cannot be made is told and left to the jobs that need it: they fail, the others go on.

    Args:
        configs: of the jobs, checked.
    """
    wanted: dict[tuple[str, int], list[CaseSpec]] = defaultdict(list)
    for config in configs:
        wanted[config.dataset.root, config.dataset.workers] += all_cases(config)
    for (root, workers), specs in wanted.items():
        by_path = {spec.path(root): spec for spec in specs}
        tell(f"data of all jobs: {len(by_path)} cases in {root}")
        try:
            ensure_cases(by_path.values(), root, workers)
        except DatasetError as error:
            tell(f"the jobs that need it will fail: {error}")
