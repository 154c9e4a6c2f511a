"""The UI in a headless Chromium: how to start both, and the four pages of a comparison. Waits, never sleeps."""

from __future__ import annotations

import shutil
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from selenium import webdriver
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.by import By
from selenium.webdriver.remote.webelement import WebElement
from selenium.webdriver.support.ui import WebDriverWait

from gran_bench.tracking.views import view_path

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
PATIENCE = 60.0  # s, for a page on a busy machine
WINDOW = (1600, 900)  # pixels


@contextmanager
def user_interface(root: Path) -> Iterator[tuple[str, float]]:
    """The UI as ``make ui`` starts it, on the store under ``root``; yields its address and the seconds it took."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    began, address = time.monotonic(), f"http://127.0.0.1:{port}"
    command = [sys.executable, "-m", "gran_bench.ui", f"port={port}", f"tracking.root={root}"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
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


class Browser:
    """A headless Chromium on one UI.

    Args:
        address: of the UI, without a path.
    """

    def __init__(self, address: str) -> None:
        options = webdriver.ChromeOptions()
        options.binary_location = CHROMIUM
        width, height = WINDOW
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

    def wait_for_text(self, text: str) -> None:
        """Wait until the page says something."""
        self._until(lambda driver: text in driver.find_element(By.TAG_NAME, "body").text, repr(text))

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
        # The page redraws itself at any time; an element that has just gone is looked up again.
        from selenium.common.exceptions import StaleElementReferenceException as Gone

        return WebDriverWait(self.driver, PATIENCE, 0.1, (Gone,)).until(condition, f"{what} never came")

    # ---- the pages of a comparison ---------------------------------------------------------------------------

    def run_table(self, experiment: str, runs: int) -> dict[str, str]:
        """Open the saved view's table; the column's name of each cell of its first row, and what it says."""
        self.open(view_path(experiment))
        self.wait("[data-testid='sort-header-headline/angle error floors']")
        self.wait(".ag-pinned-left-cols-container .ag-row, .ag-center-cols-container .ag-row", runs)
        cells = self.driver.find_elements(By.CSS_SELECTOR, ".ag-row[row-index='0'] [col-id]")
        return {cell.get_attribute("col-id"): cell.text for cell in cells}

    def charts(self, experiment: str) -> None:
        """Open the saved view's charts, and wait for the parallel coordinates to be drawn."""
        self.open(view_path(experiment, charts=True))
        self.wait_for_text("choices against error")
        self.wait(".parcoords svg .dimension", 4)
        self.wait(".parcoords canvas.foreground")

    def compare_first_two(self) -> None:
        """Tick the first two runs of the open table and press Compare."""
        boxes = self.wait(".ag-row .ag-selection-checkbox", 2)
        for box in boxes[:2]:
            box.click()
        self.button("Compare").click()
        self.wait_for_text("Comparing 2 Runs")

    def run_page(self, experiment: str, run_id: str) -> None:
        """Open a run's page, with the whole of its description, and wait for the figures in it."""
        self.open(f"/#/experiments/{experiment}/runs/{run_id}")
        self.button("Show more").click()
        self.wait_for_pictures("img[src*='get-artifact']", 3)
