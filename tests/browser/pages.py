"""The UI in a headless Chromium: how to start both, and the four pages of a comparison. Waits, never sleeps."""

from __future__ import annotations

import shutil
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from selenium import webdriver
from selenium.common.exceptions import (
    ElementClickInterceptedException,
    NoSuchElementException,
    StaleElementReferenceException,
)
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.by import By
from selenium.webdriver.remote.webelement import WebElement
from selenium.webdriver.support.ui import WebDriverWait

from gran_bench.tracking.views import view_path

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
PATIENCE = 120.0  # s, for a page on a busy machine
WINDOW = (1600, 900)  # pixels
WIDE = (4000, 900)  # of a window that has all columns of the table in sight; those out of it do not exist in the page
# In JavaScript, because one call cannot be overtaken by the page's redrawing.
_CELLS = """
const rows = new Map();  // a row is in pieces: what is pinned and what scrolls
for (const row of [...document.querySelectorAll('.ag-row[row-id]')].sort((a, b) => a.ariaRowIndex - b.ariaRowIndex))
  for (const cell of row.querySelectorAll('[col-id]')) {
    const id = row.getAttribute('row-id');
    if (!rows.has(id)) rows.set(id, {});
    rows.get(id)[cell.getAttribute('col-id')] = cell.innerText.trim();
  }
return [...rows];  // pairs, because the driver sorts the keys of an object
"""
_AXES = "return [...document.querySelectorAll('.parcoords svg .dimension .label')].map(label => label.textContent)"


@contextmanager
def user_interface(root: Path) -> Iterator[tuple[str, float]]:
    """The UI as ``make ui`` starts it, on the store under ``root``; yields its address and the seconds it took."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    began, address = time.monotonic(), f"http://127.0.0.1:{port}"
    command = [sys.executable, "-m", "gran_bench.ui", f"port={port}", f"tracking.root={root}", "shipped=false"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    try:
        while not _answers(f"{address}/health"):
            assert process.poll() is None, "the UI ended before it answered"
            assert time.monotonic() - began < 2 * PATIENCE, "the UI never answered"
            time.sleep(0.1)  # between two questions; nothing is assumed about how long it takes
        yield address, time.monotonic() - began
    finally:
        process.terminate()
        process.wait(timeout=PATIENCE)


def _answers(url: str) -> bool:
    try:
        with urllib.request.urlopen(url, timeout=5.0):
            return True
    except (urllib.error.URLError, OSError):
        return False


def _clicked(element: WebElement) -> bool:
    element.click()
    return True


class Browser:
    """A headless Chromium on one UI.

    Args:
        address: of the UI, without a path.
        window: width and height in pixels.
    """

    def __init__(self, address: str, window: tuple[int, int] = WINDOW) -> None:
        options = webdriver.ChromeOptions()
        options.binary_location = CHROMIUM
        width, height = window
        # Containers run as root and have a small /dev/shm.
        for flag in ("headless=new", "no-sandbox", "disable-dev-shm-usage", "disable-gpu", "hide-scrollbars"):
            options.add_argument(f"--{flag}")
        options.add_argument(f"--window-size={width},{height}")
        self.driver, self.address = webdriver.Chrome(options=options, service=Service(DRIVER)), address
        # A panel that opens by itself on a first visit would cover what is tested.
        self.driver.get(f"{address}/health")
        for key, value in (("fab.autoOpenedOnFirstLoad_v1", "true"), ("panelOpen_v1", "false")):
            self.driver.execute_script(f"localStorage.setItem('mlflow.assistant.{key}', '{value}')")

    def open(self, path: str) -> None:
        """Load a page anew, also where only the part after # differs."""
        self.driver.get("about:blank")
        self.driver.get(self.address + path)

    def wait(self, selector: str, count: int = 1) -> list[WebElement]:
        """At least ``count`` elements of a CSS selector, in sight."""

        def found(driver: webdriver.Chrome) -> list[WebElement] | bool:
            shown = [e for e in driver.find_elements(By.CSS_SELECTOR, selector) if e.is_displayed()]
            return shown if len(shown) >= count else False

        return self._until(found, f"{count} of {selector}")

    def wait_for_text(self, *texts: str) -> None:
        """Wait until the page says all of this."""

        self._until(lambda _: all(text in self.text() for text in texts), repr(texts))

    def text(self) -> str:
        """What the page says."""
        return self.driver.find_element(By.TAG_NAME, "body").text

    def wait_for_pictures(self, selector: str, count: int = 1) -> None:
        """Wait until pictures of a CSS selector have arrived and been decoded."""
        script = "return [...document.querySelectorAll(arguments[0])].filter(i => i.naturalWidth > 100).length"
        self._until(lambda driver: driver.execute_script(script, selector) >= count, f"pictures {selector}")

    def button(self, text: str) -> WebElement:
        """The button of a text, once it can be pressed."""
        path = f"//button[normalize-space()='{text}']"
        return self._until(
            lambda driver: next((b for b in driver.find_elements(By.XPATH, path) if b.is_enabled()), False), text
        )

    def _until(self, condition, what: str):
        # The page redraws itself at any time: what has just gone, or lies under something, is looked up again.
        again = (NoSuchElementException, StaleElementReferenceException, ElementClickInterceptedException)
        return WebDriverWait(self.driver, PATIENCE, 0.1, again).until(condition, f"{what} never came")

    # ---- the pages of a comparison ---------------------------------------------------------------------------

    def run_table(self, experiment: str, runs: Iterable[str]) -> dict[str, dict[str, str]]:
        """Open the saved view's table and wait for rows.

        Args:
            experiment: its id.
            runs: ids of runs that must be among the rows, with a figure.

        Returns:
            For each run by its id, from top to bottom: what each cell says, by the name of its column.
        """
        self.open(view_path(experiment))
        self.wait("[data-testid='sort-header-headline/angle error floors']")
        wanted = set(runs)

        def filled(driver: webdriver.Chrome) -> dict[str, dict[str, str]] | bool:
            rows = dict(driver.execute_script(_CELLS))
            figures = {
                run_id: any(column.startswith("metrics.") for column in rows.get(run_id, ())) for run_id in wanted
            }
            return rows if all(figures.values()) else False

        return self._until(filled, f"rows of {wanted}")

    def charts(self, experiment: str, axes: Iterable[str] = ()) -> None:
        """Open the saved view's charts, and wait for the parallel coordinates to be drawn, with the axes named."""
        self.open(view_path(experiment, charts=True))
        self.wait_for_text("choices against")
        self.wait(".parcoords canvas.foreground")
        wanted = set(axes)

        def named(driver: webdriver.Chrome) -> bool:
            return wanted <= set(driver.execute_script(_AXES))

        self._until(named, f"axes {wanted}")

    def compare(self, runs: Sequence[str]) -> None:
        """Tick runs of the open table and press Compare."""
        for run_id in runs:
            box = f".ag-row[row-id='{run_id}'] .ag-selection-checkbox"
            self._until(lambda driver, box=box: _clicked(driver.find_element(By.CSS_SELECTOR, box)), box)
        self._until(lambda _: _clicked(self.button("Compare")), "Compare")
        self.wait_for_text(f"Comparing {len(runs)} Runs")

    def only_differences(self) -> None:
        """On the open comparison: fold what comes before the parameters, and show those alone that differ."""
        for name in ("Visualizations", "Run details"):
            header = f"//*[@role='button'][normalize-space()='{name}']"

            def folded(driver: webdriver.Chrome, header: str = header) -> bool:
                found = driver.find_element(By.XPATH, header)
                return found.get_attribute("aria-expanded") == "false" or not _clicked(found)

            self._until(folded, f"folded {name}")
        switch = "[role='switch'][aria-label*='Parameters']"
        self._until(lambda driver: _clicked(driver.find_element(By.CSS_SELECTOR, switch)), switch)
        self.wait(f"{switch}[aria-checked='true']")

    def run_page(self, experiment: str, run_id: str) -> None:
        """Open a run's page, with the whole of its description, and wait for the figures in it."""
        self.open(f"/#/experiments/{experiment}/runs/{run_id}")
        self.button("Show more").click()
        self.wait_for_pictures("img[src*='get-artifact']", 3)
