"""The four arrays: the paper's rigs, recordings as cameras write files, fusion better than alpha."""

import math

import pytest
import torch

import experiments.stage
from arraygeom import Rig
from experiments import NAMES, load_system, run_system
from experiments.__main__ import Experiments
from experiments.hdr import merged, usable_range
from experiments.sensors import Mosaic
from experiments.stage import SystemScene
from pat.app.cli.main import main
from pat.fusion.frame import Frame
from pat.fusion.steps import resolution_ratio
from pat.fusion.views import ViewFiles
from pat.media.colour import linear_from_srgb, srgb_from_linear
from pat.media.images import read_image
from pat.media.raw import demosaiced


def angle(focal: float, pixels: int) -> float:
    return math.degrees(2 * math.atan(pixels / 2 / focal))


def test_the_arrays_are_the_papers():
    wide, nir, exposures, fast = (load_system(name).rig for name in NAMES)
    assert [c.hw for c in wide.cameras.values()] == [(3036, 4024), (3684, 4912)]
    assert 9 < 1 / resolution_ratio(wide.pair("narrow", "wide")) ** 2 < 13
    assert angle(float(wide["wide"].K[0, 0]), 4912) > 3 * angle(float(wide["narrow"].K[0, 0]), 4024)
    assert {c.hw for c in nir.cameras.values()} == {(2048, 2048)}
    assert [round(c.sensor.exposure / 12e-6) for c in exposures.cameras.values()] == [150, 500, 300, 800]
    assert [exposures[n].sensor.response.centre for n in exposures.betas("alpha")] == [600, 550, 450]
    assert fast["fast"].sensor.frame_rate == 227
    assert len({fast[n].sensor.time_offset for n in fast.names}) == 4
    assert all(rig.betas(rig.names[0]) for rig in (wide, nir, exposures, fast))


def test_an_unknown_system_is_named(capsys, refusal):
    said = refusal("systems", "run", "wide-narow")
    assert "'wide-narow'" in said
    main(["systems", "list"], group=Experiments)
    shown = capsys.readouterr().out
    assert all(name in shown for name in NAMES)


def test_a_scale_makes_the_reduced_size_smaller_and_leaves_the_full_one():
    system = load_system("exposures")
    sizes = [
        system.sized(full, scale=scale)["alpha"].hw for full, scale in ((False, 1), (False, 0.5), (True, 0.5))
    ]
    assert sizes == [(320, 512), (160, 256), (800, 1280)]


@pytest.fixture
def tiny(monkeypatch):
    """Every system at a few thousand pixels."""
    for name in NAMES:
        system = load_system(name)
        monkeypatch.setattr(system.module, "REDUCED", 100 / system.rig[system.alpha].hw[1])
    monkeypatch.setattr(load_system("fast-slow").module, "FRAMES", 4)


def stage(name: str, **changes) -> SystemScene:
    system = load_system(name)
    m = system.module
    options = {"depths": m.DEPTHS, "layers": m.LAYERS, "seed": m.SEED, **changes}
    return SystemScene(system.sized(False), system.alpha, **options)


def test_a_scene_is_the_same_each_time_and_moves(tiny):
    a, b = stage("fast-slow"), stage("fast-slow")
    assert torch.equal(a.seen("red")[0], b.seen("red")[0])
    layer = int(a.shares().argmax())
    still, moved = a.seen("fast")[0], a.seen("fast", a.moved(layer, torch.tensor([0.3, 0.0, 0.0])))[0]
    assert (still - moved).abs().mean() > 0.003
    assert a.shares().sum() == pytest.approx(1)


def test_a_layer_moved_sideways_is_displaced_by_focal_over_depth(tiny):
    s = stage("fast-slow", layers=1)
    step = torch.tensor([0.2, 0.0, 0.0])
    depth, focal = s.seen("fast")[1], float(s.camera("fast").K[0, 0, 0])
    before, after = s.seen("fast")[0], s.seen("fast", s.moved(0, step))[0]
    shift = focal * 0.2 / float(depth.median())
    whole = round(shift)
    off = [(after[..., k:] - before[..., : before.shape[-1] - k]).abs().mean() for k in (0, whole, 2 * whole)]
    assert off[1] < min(off[0], off[2])


def test_large_images_are_rendered_in_bands(tiny, monkeypatch):
    s = stage("wide-narrow")
    image, depth = s.seen("wide")
    h, w = depth.shape
    monkeypatch.setattr(experiments.stage, "BAND", 9 * w * (h // 3))
    banded, banded_depth = s.seen("wide")
    assert (banded - image).abs().max() < 1e-3
    torch.testing.assert_close(banded_depth, depth, rtol=1e-5, atol=0)


def test_a_mosaic_is_undone_by_its_pattern():
    rgb = torch.rand(3, 1, 1).expand(3, 12, 14)
    for pattern in ("RGGB", "GBRG"):
        torch.testing.assert_close(
            demosaiced(Mosaic(pattern).apply(rgb[None], torch.Generator())[0], pattern),
            rgb,
            atol=1e-4,
            rtol=0,
        )


def psnr(result) -> dict[str, float]:
    """dB by method, of a result's first table."""
    rows = (line.split("|") for line in result.table.split("\n\n")[0].splitlines())
    return {cells[1].strip(): float(cells[2]) for cells in rows if cells[2].strip()[0].isdigit()}


def test_recordings_are_files_as_cameras_write_them(tiny, tmp_path):
    result = run_system("visible-nir", tmp_path)
    rig = Rig.load(tmp_path / "inputs" / "rig.yaml")
    files = {name: tmp_path / "inputs" / f"{name}_000.png" for name in rig.names}
    assert read_image(files["nir"]).max() <= 1023 / 65535
    assert ViewFiles(rig, files, alpha="nir")["nir"].max() > 0.3
    assert {p.name for p in result.written} >= {"figure.png", "scores.md", "fused.png", "view.yaml"}
    assert psnr(result)["fusion"] > psnr(result)["alpha alone"] + 2


def test_near_infrared_is_not_taken_for_a_response(tmp_path):
    """A response that explains 0.6 of it would make the image 10 dB worse. Too small an image hides it."""
    found = psnr(run_system("visible-nir", tmp_path))
    assert found["fusion"] > found["classical"] + 3


@pytest.mark.slow
@pytest.mark.parametrize("name", ["wide-narrow", "exposures", "fast-slow"])
def test_every_system_runs(tiny, tmp_path, name):
    assert "| fusion |" in run_system(name, tmp_path, max_memory="2GiB").table


def test_the_usable_range_ends_at_white_and_in_the_noise():
    light = torch.logspace(-4, 1, 40_000)
    g = torch.Generator().manual_seed(0)
    measured = (light + 0.002 * torch.randn(light.shape, generator=g)).clamp(0, 2)
    found = usable_range(measured, light)
    assert found.high == pytest.approx(2 * math.sqrt(2), rel=0.5)
    assert found.low == pytest.approx(0.002 * 0.67 / 0.25, rel=0.5)
    assert found.stops == pytest.approx(math.log2(found.high / found.low))
    with pytest.raises(ValueError, match="light"):
        usable_range(light * 3, light)


def test_merged_exposures_have_more_range_than_alpha(tiny):
    """Exact depth and confidence, a scene twice as bright as alpha's white on the right."""
    rig = load_system("exposures").sized(False)
    h, w = rig["alpha"].hw
    light = torch.linspace(0.02, 2.0, w).expand(1, h, w)
    one_place = rig["alpha"].cam_from_world
    for name in rig.betas("alpha"):
        rig = rig.with_camera(name, rig["alpha"].replace(cam_from_world=one_place, sensor=rig[name].sensor))
    limit = {"alpha": 1.0, "red": 1 / 0.9, "green": 1 / 0.54, "blue": 1 / 1.44}
    images = {name: srgb_from_linear(light.clamp(max=limit[name])) for name in rig.names}
    frame = Frame(images["alpha"].expand(3, -1, -1), torch.full((h, w), 5.0), *torch.ones(2, h, w))
    measured = linear_from_srgb(merged(frame, rig, images, "alpha").image)[1]
    off = ((measured - light[0]) / light[0]).abs()
    assert off[:, light[0, 0] < 1.7].max() < 0.02
    assert measured.max() > 1.7
