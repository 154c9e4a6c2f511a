"""Make the cases of a dataset with the DEM: ``python -m gran_bench.generate scene=drum dataset=holdout30``."""

from __future__ import annotations

from gran_bench.config import GenerateConfig
from gran_bench.entry import run


def task(config: GenerateConfig) -> object:
    """Say what it takes, then make the cases that ``config`` describes and that are missing, and a figure of each."""
    # Imported here, so that --help and a refused config need not wait for Numba.
    from gran_bench.dataset import generate
    from gran_bench.plots.data_card import draw_missing_cards
    from gran_bench.run.cost import generate_cost

    if generate_cost(config).tell(config.dry_run):
        return []
    paths = generate(config)
    print(f"a figure of each case is in {draw_missing_cards(paths)[0].parent}")
    return paths


if __name__ == "__main__":
    run(task, "generate", GenerateConfig)
