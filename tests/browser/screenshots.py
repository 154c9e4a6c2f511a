"""The README's pictures of the UI: ``python tests/browser/screenshots.py [RESULTS]``, after ``make browser-test``.

RESULTS is the root of a store with two runs or more (``results``). Pictures go to ``docs/screenshots``.
"""

from __future__ import annotations

import io
import sys
from pathlib import Path

from mlflow import MlflowClient
from pages import Browser, user_interface
from PIL import Image

from gran_bench.files import whole_file
from gran_bench.tracking.store import DATABASE

FOLDER = Path(__file__).parents[2] / "docs" / "screenshots"
WINDOW = (1600, 1150)
LEFT = 200  # pixels of the UI's own menu, which is cut off


def shoot(browser: Browser, name: str, height: int) -> None:
    """Write what is in sight as a paletted PNG of ``height`` rows."""
    picture = Image.open(io.BytesIO(browser.driver.get_screenshot_as_png())).convert("RGB")
    picture = picture.crop((LEFT, 0, picture.width, min(height, picture.height)))
    with whole_file(FOLDER / f"{name}.png") as temporary:
        picture.quantize(128).save(temporary, format="PNG", optimize=True)


def main(root: Path) -> None:
    """Take all four."""
    store = MlflowClient(f"sqlite:///{root / DATABASE}")
    experiment = store.get_experiment_by_name("gran-bench").experiment_id
    runs = store.search_runs([experiment], order_by=["metrics.`headline/angle error floors` ASC"])
    with user_interface(root) as (address, seconds):
        print(f"the UI answered after {seconds:.1f} s")
        browser = Browser(address, WINDOW)
        try:
            ids = [run.info.run_id for run in runs if run.data.metrics]
            browser.run_table(experiment, ids[:2])
            shoot(browser, "runs", 690)
            browser.compare(ids[:3])
            browser.only_differences()
            shoot(browser, "comparison", 1000)
            browser.charts(experiment)
            shoot(browser, "charts", 860)
            browser.run_page(experiment, ids[0])
            shoot(browser, "run", 960)
        finally:
            browser.driver.quit()


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "results").resolve())
