"""The page of a fused frame: complete in itself, and in a real browser."""

import re
from itertools import combinations

import pytest
import torch

from arraygeom import Distortion, Pose, Rig, View
from pat.app.report import Facts, report_page, rig_drawing
from pat.app.sample_array import SAMPLE, load_sample
from pat.fusion.classical import classical_view
from pat.fusion.frame import Frame
from pat.media.figures import reduced
from pat.support.metrics import score
from tests.browser import CHROMIUM, DRIVER, browser


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    sample = load_sample()
    h, w = sample.rig["mono"].hw
    depth = torch.linspace(2, 9, w).expand(h, w).clone()
    depth[:, :40] = torch.nan
    frame = Frame(sample.ground_truth, depth, torch.linspace(0, 1, h)[:, None].expand(h, w), 0.1 / depth)
    baseline = classical_view(sample.rig, sample.images, "mono", longest=h)
    said = ["weights: <mono> & more"], ["the rig may be wrong: check it"]
    facts = Facts(*said, 12.0, 2.0**30, classical=baseline)
    path = tmp_path_factory.mktemp("report") / "index.html"
    path.write_text(report_page(frame, sample.images, sample.rig, "mono", facts), encoding="utf-8")
    return path


def test_the_page_needs_no_other_file(page):
    text = page.read_text()
    assert not re.findall(r"\{\{\w+\}\}", text)
    sources = re.findall(r'(?:src|href)="([^"]{0,30})', text)
    assert len(sources) == 7
    assert all(source.startswith("data:") for source in sources)
    assert not re.findall(r"https?://|@import|url\(", text)
    assert "weights: &lt;mono&gt; &amp; more" in text
    assert "2.5 to 8.93 m, for 98% of the pixels" in text
    assert "12 s" in text
    assert "prefers-color-scheme: dark" in text
    assert text.index("<h2>Warnings") < text.index('<div class="stage"')
    assert text.index("<summary>") < text.index("weights: &lt;mono")
    assert text.count("<polyline") == 10


def test_without_depth_poses_and_warnings_there_is_nothing_of_them(page):
    frame = Frame(torch.rand(3, 20, 30), torch.full((20, 30), torch.nan), *torch.rand(2, 20, 30))
    sample = load_sample()
    views = {name: sample.rig[name].resize((20, 30)) for name in sample.rig.names}
    text = report_page(frame, dict.fromkeys(views, torch.rand(1, 20, 30)), Rig(views), "mono", Facts())
    assert 'data-overlay="depth"' not in text
    assert "<h2>Warnings" not in text
    assert "<polyline" not in text
    assert rig_drawing(Rig.load(SAMPLE / "rig.yaml"), "mono").count("(alpha)") == 1


def test_labels_of_cameras_above_one_another_are_apart():
    """Cameras of one column of three rows are at one point seen from above."""
    camera = load_sample().rig["mono"]
    places = [torch.tensor([0.04 * (i % 3), 0.04 * (i // 3), 0]).double() for i in range(9)]
    poses = {f"Cam-{i}": Pose(torch.eye(3).double(), t) for i, t in enumerate(places)}
    rig = Rig({name: camera.replace(cam_from_world=pose) for name, pose in poses.items()})
    drawing = rig_drawing(rig, "Cam-4")
    labels = [(float(x), float(y)) for x, y in re.findall(r'<text x="([\d.]+)" y="([\d.]+)"', drawing)]
    assert len(labels) == 9
    assert all(abs(x - u) > 60 or abs(y - v) > 15 for (x, y), (u, v) in combinations(labels, 2))
    assert max(y for _, y in labels) < float(re.search(r'viewBox="0 0 \d+ (\d+)', drawing)[1])


@pytest.mark.skipif(not (CHROMIUM and DRIVER), reason="no browser is installed: apt-get install chromium")
def test_a_long_path_does_not_widen_the_page(page, tmp_path):
    pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    path = tmp_path / "long.html"
    path.write_text(page.read_text().replace("the rig may be wrong", "/folder" * 20), encoding="utf-8")
    for width in (1200, 500):
        with browser(f"{width},900") as driver:
            driver.get(path.as_uri())
            items = "[...document.querySelectorAll('li')].map(x => x.scrollWidth - x.clientWidth)"
            page_width = "document.documentElement.scrollWidth - innerWidth"
            beyond = driver.execute_script(f"return [{page_width}, ...{items}]")
            assert max(beyond) <= 0


@pytest.mark.skipif(not (CHROMIUM and DRIVER), reason="no browser is installed: apt-get install chromium")
def test_slider_and_overlays_work_in_a_browser(page):
    pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    with browser("1280,1200") as driver:
        run = driver.execute_script
        driver.get(page.as_uri())
        assert run("return [...document.images].every(i => i.complete && i.naturalWidth > 0)")
        shown = "return [...document.querySelectorAll('.layer.SIDE')].map(i => i.dataset.name)"
        assert run(shown.replace("SIDE", "left")) == ["alpha: mono"]
        assert run(shown.replace("SIDE", "right")) == ["fused"]
        drag(driver, 0.25)
        boundary = run("return document.querySelector('.stage').style.getPropertyValue('--at')")
        assert float(boundary[:-1]) == pytest.approx(25, abs=1.5)
        for name in ("depth", "confidence"):
            visible = f"return getComputedStyle(document.getElementById('{name}')).visibility"
            assert run(f"return document.getElementById('{name}').hidden") is True
            driver.find_element("css selector", f"[data-overlay={name}]").click()
            assert run(visible) == "visible"
            assert run(f"return document.getElementById('{name}').hidden") is False
        assert run("return document.querySelector('.legend').hidden") is False
        driver.find_element("css selector", "#left option:nth-child(2)").click()
        assert run(shown.replace("SIDE", "left")) == ["beta: colour"]
        driver.find_element("css selector", "#left option:nth-child(3)").click()
        assert run(shown.replace("SIDE", "left")) == ["classical"]
        clipped = run("return getComputedStyle(document.querySelector('.layer.left')).clipPath")
        left = 100 - float(boundary[:-1])
        assert float(re.findall(r"[\d.]+(?=%)", clipped)[0]) == pytest.approx(left, abs=0.01)
        assert len(driver.get_screenshot_as_png()) > 20_000
        assert driver.get_log("browser") == []


@pytest.mark.skipif(not (CHROMIUM and DRIVER), reason="no browser is installed: apt-get install chromium")
def test_the_picture_zooms_to_its_pixels_and_a_tall_one_fits_the_window(page, tmp_path):
    pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    tall = tmp_path / "tall.html"
    tall.write_text(page.read_text().replace("640 / 400", "400 / 640"), encoding="utf-8")
    with browser("1280,900") as driver:
        run = driver.execute_script
        driver.get(tall.as_uri())
        wide, high, window = run("return [stage.clientWidth, stage.clientHeight, innerHeight]")
        assert high <= 0.79 * window
        assert wide / high == pytest.approx(400 / 640, rel=0.01)
        driver.get(page.as_uri())
        driver.find_element("css selector", "#pixel").click()
        for _ in range(9):
            driver.find_element("css selector", "#in").click()
        assert run("return zoom * pixelSize()") == pytest.approx(32)
        assert run("return getComputedStyle(document.querySelector('.layer')).imageRendering") == "pixelated"
        box, cut = run(
            "const b = canvas.getBoundingClientRect(), s = stage.getBoundingClientRect();"
            "return [[s.left + s.width / 2 - b.left, b.width], stage.style.getPropertyValue('--cut')]"
        )
        assert float(cut[:-1]) == pytest.approx(100 * box[0] / box[1], abs=0.05)
        driver.find_element("css selector", "#fit").click()
        assert run("return [zoom, x, y]") == [1, 0, 0]


@pytest.mark.parametrize("lens", [None, [-0.12, 0.03, 0.0, 0.0]])
def test_the_classical_layer_is_at_alphas_own_pixels(lens):
    sample = load_sample()
    lens = lens and Distortion("brown-conrady", torch.tensor(lens, dtype=torch.float64))
    rig = sample.rig.with_camera("mono", sample.rig["mono"].replace(distortion=lens))
    found = classical_view(rig, sample.images, "mono", longest=320)
    small, grey = (reduced(image, 320) for image in (sample.ground_truth, sample.images["mono"]))
    assert found.shape == small.shape
    if lens is None:
        assert score(found, small).psnr > score(grey.expand(3, -1, -1), small).psnr + 8
    else:
        assert float((found.mean(0) - grey[0]).abs().median()) < 0.05


def test_there_is_no_classical_layer_of_cameras_known_by_lines_alone():
    sample = load_sample()
    views = {name: View(hw=sample.rig[name].hw) for name in sample.rig.names}
    with pytest.raises(ValueError, match="mono, colour"):
        classical_view(Rig(views), sample.images, "mono", longest=320)


def drag(driver, share):
    """Drag the slider from the middle to a share of its width, with the mouse."""
    from selenium.webdriver import ActionChains

    slider = driver.find_element("id", "slider")
    step = (share - 0.5) * slider.size["width"]
    ActionChains(driver).click_and_hold(slider).move_by_offset(round(step), 0).release().perform()
