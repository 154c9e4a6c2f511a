"""The recipe of the README in a browser: open the experiment, see what matters, compare two runs, see the figures."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("selenium", reason="no selenium: pip install 'gran-bench[browser]', or make browser-test")

from mlflow import MlflowClient
from mlflow.entities import Run
from pages import CHROMIUM, DRIVER, WIDE, Browser, user_interface

from gran_bench.tracking import HEADLINE, SWEEP_TAG
from gran_bench.tracking.store import DATABASE
from gran_bench.tracking.views import FIRST_TAGS

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(not (CHROMIUM and DRIVER), reason="no chromium and chromedriver on the PATH"),
    pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy"),  # SQLAlchemy's word to MLflow
]
# Two runs as short as they can be and still have every headline figure.
SHORT = ["scene.filling.count=120", "scene.container.length=0.25", "scene.end_time=2.2", "judge.speeds_rpm=[40]"]
COMMAND = ["-m", "gran_bench.train", "-m", "+experiment=smoke", *SHORT, "model.iterations=2", "trainer.steps=3"]
AXES = ["rollout.final_frames=3,5", "threads=1", "hydra/launcher=local"]


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The root of a store with two short runs that were really made."""
    folder = tmp_path_factory.mktemp("comparison")
    done = subprocess.run([sys.executable, *COMMAND, *AXES], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder / "results"


@pytest.fixture(scope="module")
def browser(results: Path) -> Iterator[Browser]:
    with user_interface(results) as (address, _):
        browser = Browser(address, WIDE)
        yield browser
        browser.driver.quit()


@pytest.fixture(scope="module")
def runs(results: Path) -> dict[str, Run]:
    """The two runs by their id; their parent is not among them."""
    store = MlflowClient(f"sqlite:///{results / DATABASE}")
    experiment = store.get_experiment_by_name("gran-bench")
    found = store.search_runs([experiment.experiment_id])
    return {run.info.run_id: run for run in found if "mlflow.parentRunId" in run.data.tags}


@pytest.fixture
def experiment(runs: dict[str, Run]) -> str:
    assert len(runs) == 2
    return next(iter(runs.values())).info.experiment_id


def test_the_table_shows_choices_and_headline_figures_best_first(
    browser: Browser, runs: dict[str, Run], experiment: str
):
    rows = browser.run_table(experiment, set(runs))
    best = min(runs.values(), key=lambda run: run.data.metrics[f"{HEADLINE}angle error floors"])
    assert next(iter(rows)) == best.info.run_id
    for run_id, run in runs.items():
        row = rows[run_id]
        assert run.info.run_name in row["attributes.`Run Name`"]
        for name in ("angle error floors", "speed W1 floors", "rollout ms per frame", "requirements failed"):
            shown = float(row[f"metrics.`{HEADLINE}{name}`"])
            assert shown == run.data.metrics[HEADLINE + name]
        for name in ("loss terms", "frames ahead"):
            assert row[f"params.`{name}`"] == run.data.params[name]
        for name in FIRST_TAGS:
            assert row[f"tags.`{name}`"] == run.data.tags[name]
        assert row[f"tags.`{SWEEP_TAG}`"] == run.data.tags[SWEEP_TAG] != ""
    assert {row["params.`frames ahead`"] for run_id, row in rows.items() if run_id in runs} == {"3", "3 to 5"}


def test_the_address_alone_opens_the_saved_view(browser: Browser, runs: dict[str, Run]):
    browser.open("")
    browser.wait("[data-testid='sort-header-headline/angle error floors']")
    browser.wait_for_text(*(run.info.run_name for run in runs.values()))


def test_two_runs_compare_in_what_they_differ(browser: Browser, runs: dict[str, Run], experiment: str):
    browser.run_table(experiment, set(runs))
    browser.compare(sorted(runs))
    browser.wait_for_text("boundary.kind", "frames ahead", "3 to 5", f"{HEADLINE}angle error floors")
    browser.only_differences()
    browser.wait_for_text("frames ahead", "3 to 5", "rollout.final_frames", f"{HEADLINE}angle error floors")
    assert "boundary.kind" not in browser.text()


def test_the_charts_begin_with_choices_against_error(browser: Browser, experiment: str):
    browser.charts(experiment, ["model.name", "loss terms", "frames ahead", f"{HEADLINE}angle error floors"])


def test_a_runs_page_shows_its_figures_and_their_file_names_it(browser: Browser, runs: dict[str, Run], experiment: str):
    run_id, run = next(iter(runs.items()))
    browser.run_page(experiment, run_id)
    browser.wait_for_text(Path(run.data.tags["folder"]).name)
    browser.open(f"/#/experiments/{experiment}/runs/{run_id}/artifacts/figures/flow_pattern.png")
    browser.wait_for_pictures("img")
