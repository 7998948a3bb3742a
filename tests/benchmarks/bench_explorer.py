"""Time of the explorer in a browser from a moved pointer to the drawn result.

    python -m tests.benchmarks.bench_explorer [--points 40] [--out tests/benchmarks/RESULTS_explorer.md]

The sample array in headless Chromium: as a saved page, as `pat explore` serves it, and in JupyterLab where
that is installed; with attention by windows and by a network's own features. Median and 90th percentile,
milliseconds.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from statistics import median, quantiles
from typing import Any

from selenium import webdriver
from selenium.common.exceptions import WebDriverException

from pat.app.cli.parser import script
from pat.app.sample_array import load_sample
from pat.lab.evaluation.tables import markdown_header, markdown_row
from tests.benchmarks.bench_job import PAT, ROOT
from tests.benchmarks.printed import print_tables
from tests.browser import browser

SAMPLE = ROOT / "pat" / "app" / "sample"
NETWORKS = "windows", "pat-supervised"
MOVED = """
const [points, done] = arguments, canvas = document.querySelector('canvas[data-camera=mono]');
const caption = canvas.parentElement.querySelector('figcaption'), times = [];
const frame = () => new Promise(requestAnimationFrame);
(async () => {
  for (let i = 0; i <= points; i++) {
    const box = canvas.getBoundingClientRect(), before = caption.textContent, start = performance.now();
    canvas.dispatchEvent(new PointerEvent('pointermove', { bubbles: true,
      clientX: box.left + box.width * (0.2 + 0.6 * i / points),
      clientY: box.top + box.height * (0.3 + 0.01 * (i % 40)) }));
    while (caption.textContent === before && performance.now() - start < 5000) await frame();
    if (i) times.push(performance.now() - start);
  }
  done(times);
})()"""
"""Moves over alpha and waits until its caption has changed; the first is not counted."""
NOTEBOOK = """from pat.app.sample_array import load_sample
from pat.app.explore import explore
sample = load_sample()
explore(sample.rig, sample.images, network=None if "{0}" == "windows" else "{0}")"""

KERNEL = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}


@contextmanager
def server(command: list[str], folder: Path) -> Iterator[str]:
    """The address that a server prints once it answers."""
    process = subprocess.Popen(
        command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    assert process.stdout is not None
    try:
        yield next(
            found[0] for line in process.stdout if (found := re.search(r"http://(localhost|127)\S+", line))
        )
    finally:
        process.kill()
        process.communicate()


def times(driver: Any, points: int) -> list[float]:
    """Milliseconds of each point, once the explorer is drawn."""
    drawn = (
        "const c = document.querySelector('canvas[data-camera=mono]'); return c && c.parentElement.innerText"
    )
    end = time.monotonic() + 180
    while "depth" not in (driver.execute_script(drawn) or ""):
        if time.monotonic() > end:
            raise RuntimeError(f"no explorer within 180 s in {driver.current_url}: {driver.title}")
        time.sleep(0.2)
    return list(driver.execute_async_script(MOVED, points))


def measured(driver: Any, points: int) -> Iterator[tuple[str, str, list[float]]]:
    """Where it runs, by what it weighs, and the times."""
    with tempfile.TemporaryDirectory() as name:
        folder, sample = Path(name), load_sample()
        from pat.app.explore import explore

        explore(sample.rig, sample.images).save(folder / "saved.html")
        driver.get((folder / "saved.html").as_uri())
        yield "a saved page", "windows", times(driver, points)
        images = [
            word for camera in ("mono", "colour") for word in ("--image", f"{camera}={SAMPLE / camera}.png")
        ]
        for network in NETWORKS:
            chosen = [] if network == "windows" else ["--network", network]
            rig = str(SAMPLE / "rig.yaml")
            command = [*PAT, "explore", rig, *images, *chosen, "--no-browser"]
            with server(command, ROOT) as address:
                driver.get(address)
                yield "`pat explore`", network, times(driver, points)
        if shutil.which("jupyter-lab", path=Path(sys.executable).parent):
            for network in NETWORKS:
                yield "JupyterLab", network, in_jupyter(driver, folder, network, points)


def in_jupyter(driver: Any, folder: Path, network: str, points: int) -> list[float]:
    """The same in a notebook of one cell, with its kernel."""
    cell = {"cell_type": "code", "metadata": {}, "execution_count": None, "outputs": [], "id": "explorer"}
    cells = [{**cell, "source": NOTEBOOK.format(network)}]
    notebook = {"cells": cells, "metadata": KERNEL, "nbformat": 4, "nbformat_minor": 5}
    (folder / "explorer.ipynb").write_text(json.dumps(notebook))
    quiet = ["--no-browser", "--allow-root", "--ServerApp.token=", "--port=8899"]
    command = [sys.executable, "-m", "jupyterlab", *quiet]
    with server(command, folder) as address:
        base = address.split("/lab")[0].split("/tree")[0].rstrip("/")
        driver.get(f"{base}/lab/tree/explorer.ipynb")
        begun = """const prompt = document.querySelector('.jp-CodeCell .jp-InputPrompt');
            return prompt && prompt.textContent !== '[ ]:'"""
        end = time.monotonic() + 120
        while not driver.execute_script(begun):
            if time.monotonic() > end:
                raise RuntimeError("JupyterLab runs no cell within 120 s")
            time.sleep(1)
            with suppress(WebDriverException):  # while its splash screen is in front
                editor = driver.find_element("css selector", ".jp-CodeCell .cm-content")
                editor.click()
                editor.send_keys(webdriver.Keys.SHIFT, webdriver.Keys.ENTER)
        return times(driver, points)


def rows(points: int) -> Iterator[str]:
    yield from markdown_header(["in", "attention by", "points", "median, ms", "90 %, ms"]).splitlines()
    with browser() as driver:
        driver.set_script_timeout(300)
        for where, network, found in measured(driver, points):
            figures = f"{median(found):.0f}", f"{quantiles(found, n=10)[-1]:.0f}"
            yield markdown_row([where, network, len(found), *figures])


def main(points: int = 40, out: Path | None = None) -> None:
    """Print the table."""
    print_tables("The explorer in a browser", [rows(points)], out)


if __name__ == "__main__":
    script(main)
