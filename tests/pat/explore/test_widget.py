"""The widget's messages without a browser, and its saved page in one."""

import shutil
import time

import pytest
import torch

from arraygeom import Camera, Epipolar, Pose, Rig
from pat.data.sample_array import load_sample

pytest.importorskip("anywidget", reason="the extra 'explore' is not installed")
from pat.explore import explore

CHROMIUM, DRIVER = shutil.which("chromium") or shutil.which("google-chrome"), shutil.which("chromedriver")


def small_rig(baseline=0.1, names=("a", "b")):
    K = torch.tensor([[90.0, 0, 59.5], [0, 90.0, 39.5], [0, 0, 1]], dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64)
    centres = [torch.tensor([i * baseline, 0, 0], dtype=torch.float64) for i in range(len(names))]
    cameras = {n: Camera(K=K, cam_from_world=Pose.from_centre(eye, c), hw=(80, 120)) for n, c in zip(names, centres)}
    return Rig(cameras, depth=(1.0, 8.0))


def change(widget, **controls):
    widget.controls = {**widget.controls, **controls}
    return widget.answer


def test_samples_are_those_of_the_field():
    rig = small_rig()
    view = explore(rig, x=(70, 30))
    found = Epipolar()(rig.pair("a", "b"), torch.tensor([[70.0, 30.0]], dtype=torch.float64))
    samples = torch.tensor(view.answer["betas"]["b"]["samples"]).double()
    torch.testing.assert_close(samples[[0, -1]], torch.cat([found.start, found.end]), atol=0.01, rtol=0)


def test_the_room_is_matched_at_its_depth():
    """Alpha's middle sees the back wall, which is 8 m away."""
    assert explore(small_rig(baseline=0.5)).answer["depth"] == pytest.approx(8.0, rel=0.1)


def test_controls_move_the_samples():
    view = explore(small_rig())
    first = view.answer["betas"]["b"]["samples"][0]
    wider = change(view, baseline=2.0)["betas"]["b"]["samples"][0]
    assert first[0] - wider[0] == pytest.approx(9.0, abs=0.02)  # f b / near = 90 * 0.1 / 1
    rotated = change(view, baseline=1.0, rotation=1.0)["betas"]["b"]["samples"][0]
    assert abs(rotated[0] - first[0]) > 1
    assert view.answer["code"] == "explore(rig, images, alpha='a', x=(60, 40), rotation=1)"


def test_what_is_wrong_is_said_in_the_picture():
    assert "one camera" in explore(small_rig(names=("a",))).answer["error"]
    other_size = {"a": torch.rand(1, 80, 120), "b": torch.rand(1, 40, 60)}
    assert "60x40" in explore(small_rig(), other_size).answer["error"]
    assert "problem" in explore(small_rig(baseline=50.0)).answer["betas"]["b"]
    assert "near" in change(explore(small_rig()), near=9.0)["error"]
    assert "nobody" in explore(small_rig(), alpha="nobody").answer["error"]


@pytest.mark.slow
def test_an_answer_takes_under_50_ms():
    sample = load_sample()
    view = explore(sample.rig, sample.images)
    times = []
    for x in range(100, 500, 40):
        start = time.perf_counter()
        change(view, x=[x, 200])
        times.append(time.perf_counter() - start)
    assert sorted(times)[len(times) // 2] < 0.05


@pytest.mark.slow
@pytest.mark.skipif(not (CHROMIUM and DRIVER), reason="no browser is installed: apt-get install chromium")
def test_the_saved_page_answers_in_a_browser(tmp_path):
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    explore(small_rig()).save(tmp_path / "view.html", columns=4)
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for flag in ("--headless=new", "--no-sandbox", "--window-size=1200,700", "--disable-dev-shm-usage"):
        options.add_argument(flag)
    driver = webdriver.Chrome(options, webdriver.ChromeService(DRIVER))
    try:
        driver.get((tmp_path / "view.html").as_uri())
        read = "return [...document.querySelectorAll('figcaption')].map(c => c.textContent)"
        before = driver.execute_script(read)
        canvas = driver.find_element("css selector", "canvas[data-camera=a]")
        webdriver.ActionChains(driver).move_to_element_with_offset(canvas, -100, -60).click().perform()
        end = time.monotonic() + 60
        while driver.execute_script(read) == before and time.monotonic() < end:
            time.sleep(0.1)
        after = driver.execute_script(read)
        driver.save_screenshot(str(tmp_path / "view.png"))
        assert after != before
        assert after[1].startswith("b: match (")
        assert driver.execute_script("return performance.getEntriesByType('resource').length") == 2  # the two images
    finally:
        driver.quit()
