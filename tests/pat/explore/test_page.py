"""The explorer in a real browser: clicks and sliders, what is drawn, and how long it takes."""

import json
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from arraygeom import Epipolar
from pat.data.sample_array import SAMPLE, load_sample

pytest.importorskip("panel", reason="the extra 'explore' is not installed")
webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
DRIVER = shutil.which("chromedriver")
pytestmark = pytest.mark.skipif(not (CHROMIUM and DRIVER), reason="no browser is installed: apt-get install chromium")

SCRIPT = """
const doc = Bokeh.documents[0];
const find = (name) => { for (const m of doc._all_models.values()) if (m.name === name) return m; };
const columns = (name) => Object.fromEntries(Object.entries(find(name).data).map(([k, v]) => [k, Array.from(v)]));
const titled = (title) => { for (const m of doc._all_models.values()) if (m.title === title) return m; };
"""


@pytest.fixture(scope="module")
def page():
    command = [sys.executable, "-c", "from pat.cli.main import main; main()", "explore", str(SAMPLE / "rig.yaml")]
    images = [a for n in ("mono", "colour") for a in ("--image", f"{n}={SAMPLE / n}.png")]
    server = subprocess.Popen(
        [*command, *images, "--no-browser"], cwd=Path(__file__).parents[3], stdout=subprocess.PIPE, text=True
    )
    try:
        address = re.search(r"http://\S+", server.stdout.readline())[0]
        yield from opened(address)
    finally:
        server.terminate()
        server.wait()


def opened(address):
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for flag in ("--headless=new", "--no-sandbox", "--window-size=1500,1400", "--disable-dev-shm-usage"):
        options.add_argument(flag)
    driver = webdriver.Chrome(options, webdriver.ChromeService(DRIVER))
    driver.set_script_timeout(PATIENCE)
    try:
        driver.before = slowed_by_others()
        driver.get(address)
        until(driver, "return !!window.Bokeh && Bokeh.documents.length > 0")
        until(driver, SCRIPT + "return !!find('segment:colour') && columns('segment:colour').x.length == 2")
        yield driver
    finally:
        driver.quit()


PATIENCE = 300
"""Seconds to wait for what is to come; how soon it comes is measured elsewhere."""
LOST = 20
"""Seconds after which a click is taken to be lost."""


def until(driver, script):
    assert holds_within(driver, script, PATIENCE), f"not so after {PATIENCE} s: {script[-200:]}"


def holds_within(driver, script, seconds):
    end = time.monotonic() + seconds
    while not driver.execute_script(script):
        if time.monotonic() > end:
            return False
        time.sleep(0.05)
    return True


def drawn(driver, name):
    return driver.execute_script(SCRIPT + f"return columns('{name}')")


def click(driver, x, y):
    """A click of the mouse on the middle of alpha's pixel (x, y)."""
    click_until(
        driver,
        "alpha",
        x,
        y,
        f"const d = columns('pixel'); return Math.abs(d.x[0] - {x}) < 2 && Math.abs(d.y[0] - {y}) < 2",
    )


def click_until(driver, name, x, y, there):
    """A click on a pixel of the named figure; again if it was lost, as one soon after another is that the browser takes
    for a double click."""
    for _ in range(PATIENCE // LOST):
        click_in(driver, name, x, y)
        if holds_within(driver, SCRIPT + there, LOST):
            return
    raise AssertionError(f"not so after {PATIENCE} s: {there}")


def click_in(driver, name, x, y):
    """A click of the mouse on the middle of a pixel of the named figure."""
    left, top = driver.execute_script(
        SCRIPT
        + """
        const [x, y, name] = arguments;
        const view = Bokeh.index.find_one(find(name));
        const box = view.canvas_view.el.getBoundingClientRect();
        return [box.left + view.frame.x_scale.compute(x), box.top + view.frame.y_scale.compute(y)];
        """,
        x,
        y,
        name,
    )
    actions = webdriver.ActionChains(driver)
    actions.w3c_actions.pointer_action.move_to_location(round(left), round(top))
    actions.w3c_actions.pointer_action.click()
    actions.perform()


def segment(pair, x, **bounds):
    found = Epipolar(**bounds)(pair, torch.tensor([x], dtype=torch.float64))
    return torch.cat([found.start, found.end])


def ends(driver):
    columns = drawn(driver, "segment:colour")
    return torch.tensor([columns["x"], columns["y"]], dtype=torch.float64).T


@pytest.mark.parametrize("x", [(100, 80), (320, 210), (560, 330)])
def test_a_click_draws_the_segment_of_that_pixel(page, x):
    click(page, *x)
    pixel = drawn(page, "pixel")
    pair = load_sample().rig.pair("mono", "colour")
    torch.testing.assert_close(ends(page), segment(pair, (pixel["x"][0], pixel["y"][0])))


def captions(driver):
    return driver.execute_script(
        SCRIPT + "return [...doc._all_models.values()].map(m => m.text || '').join(' ')"
    ).replace("&lt;", "<")


def off_line(driver):
    return float(re.search(r"([\d.]+) px off the line", captions(driver))[1])


def test_a_moved_rig_shows_how_far_the_match_is_off_the_line(page):
    click(page, 334, 133)
    until(page, SCRIPT + "return columns('found:colour').x.length == 1")
    assert off_line(page) < 0.5
    page.execute_script(SCRIPT + "titled('colour.rotation x (deg)').value = 0.3")
    end = time.monotonic() + PATIENCE
    while off_line(page) < 1:
        assert time.monotonic() < end, "the distance stays as it was"
        time.sleep(0.05)
    assert off_line(page) < 8
    page.execute_script(SCRIPT + "titled('colour.rotation x (deg)').value = 0.0")
    until(page, SCRIPT + "return columns('found:colour').x.length == 1")


def test_a_click_in_beta_goes_the_other_way(page):
    click(page, 334, 133)
    match = drawn(page, "match:colour")
    click(page, 100, 80)
    at = round(match["x"][0]), round(match["y"][0])
    click_until(page, "beta:colour", *at, "return columns('backwards').x.length == 2")
    pixel = drawn(page, "pixel")
    assert abs(pixel["x"][0] - 334) <= 3
    assert abs(pixel["y"][0] - 133) <= 3
    columns = drawn(page, "backwards")
    other = load_sample().rig.pair("colour", "mono")
    torch.testing.assert_close(
        torch.tensor([columns["x"], columns["y"]], dtype=torch.float64).T, segment(other, at), atol=3.0, rtol=0
    )


def test_near_is_typed_and_reset_brings_it_back(page):
    click(page, 320, 210)
    before = ends(page)
    page.execute_script(SCRIPT + "titled('type near').value = 3.0")
    until(page, SCRIPT + f"return Math.abs(columns('segment:colour').x[0] - {float(before[0, 0])}) > 1")
    assert abs(page.execute_script(SCRIPT + "return titled('near (m)').value") - 0.4771) < 0.01
    press(page, "reset")
    until(page, SCRIPT + "return Math.abs(titled('near (m)').value - Math.log10(1.4)) < 1e-6")


def press(driver, label):
    """A click of the mouse on a button."""
    button = """
        const seek = (root) => {
            for (const el of root.querySelectorAll('*')) {
                if (el.tagName == 'BUTTON' && el.innerText.trim() == arguments[0]) return el;
                const inner = el.shadowRoot && seek(el.shadowRoot);
                if (inner) return inner;
            }
        };
        return seek(document);
    """
    driver.execute_script(button, label).click()


def test_the_fused_image_is_a_layer(page):
    """In colour, and the camera's own image again afterwards."""
    channels = (
        SCRIPT
        + """
        const image = find('alpha image').data.image[0], pixels = new Uint32Array(image.buffer ? image.buffer : image);
        const coloured = pixels.filter((p) => Math.abs((p & 255) - ((p >> 16) & 255)) > 12);
        return coloured.length / pixels.length;
        """
    )
    assert page.execute_script(channels) == 0
    press(page, "fused")
    until(page, channels.replace("return coloured", "return 0.2 < coloured"))
    press(page, "camera")
    until(page, channels.replace("return coloured", "return 0 == coloured"))


def test_light_and_dark(page):
    colour = "return getComputedStyle(document.body).backgroundColor"
    before = page.execute_script(colour)
    press(page, "light / dark")
    until(page, f"{colour} != '{before}'")
    press(page, "light / dark")
    until(page, f"{colour} == '{before}'")


def test_a_slider_moves_the_segment(page):
    click(page, 320, 210)
    pixel = drawn(page, "pixel")
    before = ends(page)
    page.execute_script(SCRIPT + "titled('near (m)').value = Math.log10(4.0)")
    until(page, SCRIPT + f"return Math.abs(columns('segment:colour').x[0] - {float(before[0, 0])}) > 1")
    pair = load_sample().rig.pair("mono", "colour")
    torch.testing.assert_close(ends(page), segment(pair, (pixel["x"][0], pixel["y"][0]), near=4.0), atol=1e-6, rtol=0)


def test_a_slider_is_answered_at_once(page, record_property):
    """From a slider's move until the page is painted: the quickest of 15."""
    slower = slowed_by_others()
    times = page.execute_async_script(
        SCRIPT
        + """
        const done = arguments[arguments.length - 1], times = [], slider = titled('far (m)');
        const source = find('segment:colour');
        let start;
        const next = () => { start = performance.now(); slider.value = Math.log10(6 + times.length / 4); };
        const painted = () => {
            times.push(performance.now() - start);
            times.length < 15 ? setTimeout(next, 50) : done(times);
        };
        source.properties.data.change.connect(() => requestAnimationFrame(() => setTimeout(painted, 0)));
        next();
        """
    )
    slower = max(1.0, min(slower, slowed_by_others()))
    record_property("milliseconds", times)
    record_property("slower", slower)
    print(f"ms from slider to image: {sorted(round(t) for t in times)}, others slow the machine {slower:.1f} times")
    assert min(times) < bound(100, slower)


def slowed_by_others():
    """How many times longer work takes than it would alone: seconds gone by for each that a core worked."""
    start, end = time.perf_counter(), time.thread_time() + 0.15
    while time.thread_time() < end:
        pass
    return (time.perf_counter() - start) / 0.15


def bound(quiet: float, slower: float) -> float:
    """What may be taken in a suite, whose other tests share caches and memory too: four times what it may on a machine
    that does nothing else. What it is there, the tests print."""
    return 4 * quiet * slower


def test_the_first_paint_is_soon(page):
    """On a machine with nothing else to do; Chromium itself, which starts then, counts among the others."""
    slower = max(1.0, page.before, slowed_by_others())
    paint = page.execute_script("return performance.getEntriesByName('first-contentful-paint')[0].startTime") / 1000
    print(f"first paint after {paint:.1f} s, others slow the machine {slower:.1f} times")
    assert paint < bound(3, slower)


def test_a_click_is_answered_at_once(page):
    """From the mouse's button until the page is painted: the quickest of eight."""
    slower = slowed_by_others()
    page.execute_script(
        SCRIPT
        + """
        window.clicks = [];
        let begin;
        document.addEventListener('pointerdown', () => { begin = performance.now(); }, true);
        find('segment:colour').properties.data.change.connect(() => requestAnimationFrame(() => setTimeout(() => {
            if (begin) window.clicks.push(performance.now() - begin);
            begin = undefined;
        }, 0)));
        """
    )
    for i in range(8):
        click(page, 150 + 40 * i, 120 + 20 * i)
    until(page, "return window.clicks.length >= 6")
    times = page.execute_script("return window.clicks")
    slower = max(1.0, min(slower, slowed_by_others()))
    print(f"ms from click to image: {sorted(round(t) for t in times)}, others slow the machine {slower:.1f} times")
    assert min(times) < bound(100, slower)


def test_the_rig_is_drawn_in_space_and_what_was_chosen_is_shown(page, tmp_path):
    click(page, 320, 210)
    facts = page.execute_script(SCRIPT + "return [...doc._all_models.values()].map(m => m.text || '').join(' ')")
    assert "pixel (320, 2" in facts.replace("&lt;", "<")
    traces = page.execute_script(
        SCRIPT
        + "return [...doc._all_models.values()].filter(m => m.type.endsWith('PlotlyPlot'))[0].data.map(t => t.name)"
    )
    assert {"mono", "colour", "the pixel"} <= set(traces)
    page.save_screenshot(str(tmp_path / "explorer.png"))
    assert [entry for entry in page.get_log("browser") if entry["level"] == "SEVERE"] == []


def test_the_rig_in_space_follows_once_the_controls_rest(page):
    camera = (
        SCRIPT
        + """
        const plot = [...doc._all_models.values()].filter(m => m.type.endsWith('PlotlyPlot'))[0];
        const entries = (data) => data instanceof Map ? [...data] : Object.entries(data);
        const plain = (v) => v && typeof v == 'object' && v[Symbol.iterator] ? Array.from(v, plain) : v;
        return JSON.stringify(plot.data.map(t => entries(t).map(([k, v]) => [k, plain(v)])));
        """
    )
    before = page.execute_script(camera)
    assert before.count(".") > 20
    page.execute_script(SCRIPT + "titled('colour.rotation y (deg)').value = 2.0")
    until(page, camera.replace("return JSON", f"return {json.dumps(before)} != JSON"))
