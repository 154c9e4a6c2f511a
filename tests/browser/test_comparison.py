"""The recipe of the README in a browser: open the experiment, see what matters, compare two runs, see the figures."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("selenium", reason="no selenium: pip install 'gran-bench[browser]', or make browser-test")

from mlflow import MlflowClient
from pages import CHROMIUM, DRIVER, Browser, user_interface

from gran_bench.tracking.store import DATABASE

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(not (CHROMIUM and DRIVER), reason="no chromium and chromedriver on the PATH"),
]
COMMAND = ["-m", "gran_bench.train", "-m", "+experiment=smoke", "scene.end_time=2.2", "trainer.steps=8", "seed=0,1"]


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The root of a store with two short runs that were really made."""
    folder = tmp_path_factory.mktemp("comparison")
    done = subprocess.run([sys.executable, *COMMAND], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder / "results"


@pytest.fixture(scope="module")
def address(results: Path) -> Iterator[str]:
    with user_interface(results) as (address, _):
        yield address


@pytest.fixture
def browser(address: str) -> Iterator[Browser]:
    browser = Browser(address)
    yield browser
    browser.driver.quit()


@pytest.fixture(scope="module")
def runs(results: Path) -> list:
    store = MlflowClient(f"sqlite:///{results / DATABASE}")
    experiment = store.get_experiment_by_name("gran-bench")
    return [run for run in store.search_runs([experiment.experiment_id]) if run.data.metrics]


def test_the_table_shows_headline_figures_and_two_runs_compare(browser: Browser, runs: list):
    experiment = runs[0].info.experiment_id
    row = browser.run_table(experiment, len(runs))
    first = next(run for run in runs if run.info.run_name in row.values())
    shown = float(row["metrics.`headline/requirements failed`"])
    assert shown == first.data.metrics["headline/requirements failed"]
    browser.compare_first_two()


def test_the_charts_begin_with_choices_against_error(browser: Browser, runs: list):
    browser.charts(runs[0].info.experiment_id)


def test_a_runs_page_shows_its_figures_and_their_file_names_it(browser: Browser, runs: list):
    run = runs[0]
    browser.run_page(run.info.experiment_id, run.info.run_id)
    browser.wait_for_text(Path(run.data.tags["folder"]).name)
    browser.open(f"/#/experiments/{run.info.experiment_id}/runs/{run.info.run_id}/artifacts/figures/flow_pattern.png")
    browser.wait_for_pictures("img")
