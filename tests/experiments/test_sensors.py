import shutil
from dataclasses import replace

import pytest
import torch
import yaml

from arraygeom.camera import Camera, intrinsics
from arraygeom.distortion import Distortion
from arraygeom.pose import Pose, rotation_from_vector
from arraygeom.rig import Rig
from arraygeom.sensor import Band, Curve, Sensor
from experiments.__main__ import Experiments
from experiments.sensors import (
    STEPS,
    DecodeSRGB,
    Mosaic,
    MotionBlur,
    Spectral,
    read_chain,
    read_chains,
    record_array,
)
from pat import fuse, load_weights
from pat.app.cli.main import main
from pat.lab.data.windows import read_view
from pat.lab.farm.backends import LayeredSettings
from pat.lab.synthesis.check import CheckLimits
from pat.lab.synthesis.rendered import Rendered, save_frame
from pat.media.colour import luminance, srgb_from_linear
from pat.media.images import read_image
from pat.sensors import BoxBlur, Clip, GaussianBlur, Noise, Quantise, Resample, record
from tests.arraygeom.rigs import parallel_rig


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.mark.parametrize("pattern", ["RGGB", "GRBG", "BGGR", "GBRG"])
def test_a_mosaic_keeps_the_colours_its_name_says(pattern):
    image = torch.rand(2, 3, 6, 8, generator=generator())
    raw = Mosaic(pattern).apply(image, generator())
    for i, letter in enumerate(pattern):
        y, x = divmod(i, 2)
        assert torch.equal(raw[:, 0, y::2, x::2], image[:, "RGB".index(letter), y::2, x::2])


CHAINS = {
    "half": [Resample(0.5)],
    "all": [
        *(GaussianBlur(1.0), MotionBlur(0.01, (100.0, 50.0)), Resample((52, 78), "bicubic"), BoxBlur(3)),
        *(Resample(0.5), Noise(1e9)),
    ],
    "none": [],
}


@pytest.mark.parametrize(
    "lens", [None, Distortion("brown-conrady", torch.tensor([-0.1, 0.02, 0.0, 0.0]).double())]
)
@pytest.mark.parametrize("chain", CHAINS)
def test_points_are_found_where_the_rig_of_the_recorded_images_projects_them(chain, lens):
    """Soft dots are drawn where 3-D points project in the ideal images of two cameras, then recorded."""
    turned = Pose(
        rotation_from_vector(torch.tensor([0.02, -0.05, 0.1]).double()), torch.tensor([0.1, 0.02, 0]).double()
    )
    cameras = {
        "left": Camera(
            K=intrinsics(90.0, (64, 96)), cam_from_world=Pose.identity(), hw=(64, 96), distortion=lens
        ),
        "right": Camera(K=intrinsics((85.0, 80.0), (70, 90)), cam_from_world=turned, hw=(70, 90)),
    }
    rig = Rig(cameras, depth=(1, 5))
    chains = {"left": CHAINS[chain], "right": CHAINS["half"]}
    for X in torch.tensor([[0.13, -0.07, 1.6], [-0.2, 0.1, 2.0]]).double():
        images = {n: _dot(c, X) for n, c in cameras.items()}
        recorded = record_array(images, rig, chains, seed=0)
        for name in cameras:
            wanted = recorded.rig[name].project(X).x
            assert recorded.rig[name].hw == tuple(recorded.images[name].shape[-2:])
            torch.testing.assert_close(_found(recorded.images[name]), wanted, atol=0.02, rtol=0)


def _dot(camera: Camera, X: torch.Tensor) -> torch.Tensor:
    x, y = camera.project(X).x
    rows, columns = torch.meshgrid(*(torch.arange(float(n)).double() for n in camera.hw), indexing="ij")
    return torch.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * 4**2))[None, None].expand(1, 3, -1, -1)


def _found(image: torch.Tensor) -> torch.Tensor:
    light = image.mean(1)[0] - image.mean(1)[0].median()
    light = torch.where(light > 0.02, light, 0.0)
    rows, columns = torch.meshgrid(*(torch.arange(float(n)).double() for n in light.shape), indexing="ij")
    return torch.stack([(light * c).sum() / light.sum() for c in (columns, rows)])


def test_each_camera_draws_for_itself():
    """A camera more, or another order, changes no other camera's noise."""
    rig = Rig(
        {n: Camera(K=intrinsics(90.0, (8, 8)), cam_from_world=Pose.identity(), hw=(8, 8)) for n in "abc"}
    )
    images = {n: torch.full((1, 1, 8, 8), 0.5) for n in "abc"}
    chains = {n: [Noise(100.0)] for n in "abc"}
    three = record_array(images, rig, chains, seed=1).images
    two = record_array({n: images[n] for n in "ca"}, rig, {n: chains[n] for n in "ca"}, seed=1).images
    assert torch.equal(three["a"], two["a"])
    assert torch.equal(three["c"], two["c"])
    assert not torch.equal(three["a"], three["b"])
    assert not torch.equal(three["a"], record_array(images, rig, chains, seed=2).images["a"])


def test_mistakes_are_named():
    with pytest.raises(ValueError, match="even"):
        Mosaic().apply(torch.rand(1, 3, 7, 8), generator())
    rig = Rig({"mono": Camera(K=intrinsics(9.0, (8, 8)), cam_from_world=Pose.identity(), hw=(8, 8))})
    with pytest.raises(ValueError, match="'mono'"):
        record_array({}, rig, {"mno": []}, seed=0)


TEXT = """
mono:
  - decode-srgb
  - spectral: luminance
  - motion-blur: {shutter: 0.01, velocity: [300, 0]}
  - resample: 0.5
  - noise: {full_well: 8e3, read: 3}
  - clip
  - quantise: 12
blue:
  - spectral: {centre: 450, width: 40}
  - resample: {to: [10, 12], method: bicubic}
  - mosaic: BGGR
  - spectral: {response: {wavelength: [400, 500], response: [1, 1]}}
"""


def test_a_file_says_what_each_camera_does():
    chains = read_chains(yaml.safe_load(TEXT))
    assert chains["mono"] == (
        *(DecodeSRGB(), Spectral("luminance"), MotionBlur(0.01, (300.0, 0.0)), Resample(0.5)),
        *(Noise(8000.0, 3.0), Clip(), Quantise(12)),
    )
    assert chains["blue"] == (
        *(Spectral(Band(450.0, 40.0)), Resample((10, 12), "bicubic")),
        *(Mosaic("BGGR"), Spectral(Curve((400.0, 500.0), (1.0, 1.0)))),
    )


def test_every_step_has_a_name():
    assert set(STEPS) >= {"box-blur", "motion-blur", "mosaic", "noise", "encode-srgb"}


def test_a_chain_from_a_file_runs():
    text = "[decode-srgb, {exposure: 0.5}, mosaic, encode-srgb, {quantise: 8}]"
    chain = read_chain(yaml.safe_load(text))
    assert record(torch.rand(1, 3, 8, 8), chain, torch.Generator()).shape == (1, 1, 8, 8)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[{nois: {full_well: 3}}]", r"chain\[0\].*'nois'"),
        (
            "[clip, {noise: {fullwell: 3}}]",
            r"chain\[1\].noise.fullwell.*'full_well'",
        ),
        ("[{noise: {read: 3}}]", r"full_well: missing"),
        ("[{noise: {full_well: many}}]", "noise.full_well.*'many'"),
        ("[{noise: {full_well: -3}}]", r"full_well"),
        ("[{resample: {to: 0.5, method: cubic}}]", "method.*'cubic'"),
        ("[{box-blur: 4}]", "box-blur"),
        ("[{box-blur: 2.5}]", "width: "),
        ("[{spectral: lumnance}]", "'luminance'"),
        ("[{spectral: {center: 450, width: 3}}]", "'centre'"),
        ("[{motion-blur: {shutter: 0, velocity: [3]}}]", "velocity: "),
        ("[{mosaic: RGBG}]", "pattern.*'RGBG'"),
        ("[{clip: 3}]", "clip: "),
        ("[[clip]]", "step"),
        ("{clip: 1}", "steps"),
    ],
)
def test_typos_are_named_with_their_entry(text, words):
    with pytest.raises(ValueError, match=words):
        read_chain(yaml.safe_load(text))


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    """Two layered scenes of two cameras."""
    root = tmp_path_factory.mktemp("rendered")
    rig = parallel_rig(70.0, (48, 64), {"mono": (), "colour": (0.1,)}, (2.0, 12.0))
    rig = rig.with_camera("mono", rig["mono"].replace(sensor=Sensor("mono")))
    renderer = LayeredSettings(layers=(4, 7), oversampling=1).renderer(rig, CheckLimits())
    for seed in range(2):
        renderer(seed, root / "scenes" / f"{seed:06d}")
    return root


def test_rendered_scenes_are_recorded_by_their_responses_for_fusion(rendered, tmp_path, capsys):
    main(["lab", "data", "info", str(rendered)])
    assert "2 scenes of mono 64x48, colour 64x48" in capsys.readouterr().out
    main(["record", str(rendered), "--out", str(tmp_path)], group=Experiments)
    assert {path.name for path in tmp_path.iterdir()} == {"000000", "000001"}
    out, view = tmp_path / "000001", read_view(rendered / "scenes" / "000001", "mono")
    mono, colour = (read_image(out / f"{name}.png") for name in ("mono", "colour"))
    assert (mono.shape, colour.shape) == ((1, 48, 64), (3, 48, 64))
    ideal = srgb_from_linear(luminance(view.rgb)).clamp(0, 1)
    assert 0 < (mono - ideal).square().mean().sqrt() < 0.02
    rig, images = Rig.load(out / "rig.yaml"), {"mono": mono, "colour": colour}
    frame = fuse(images, rig, alpha="mono", network=load_weights("mono-colour"))
    assert frame.image.shape == (3, 48, 64)


def test_near_infrared_is_recorded_where_it_was_rendered(rendered, tmp_path, refusal):
    """All cameras recorded colours, whatever their response."""
    shutil.copytree(rendered / "scenes" / "000000", tmp_path / "scene")
    source = Rendered(tmp_path / "scene")
    rig = source.rig.with_camera("mono", source.rig["mono"].replace(sensor=Sensor("nir")))
    rig.save(source.folder / "rig.yaml")
    arguments = ["record", str(source.folder), "--out", str(tmp_path / "out")]
    assert "render infrared too" in refusal(*arguments)
    frames = {name: source.frame(name) for name in rig.names}
    for name, frame in frames.items():
        nir = 1 - frame.rgb[:1].clamp(0, 1)
        save_frame(source.folder / source.about["frames"][name][0]["file"], replace(frame, nir=nir))
    main(arguments, group=Experiments)
    mono, colour = (read_image(tmp_path / "out" / "scene" / f"{name}.png") for name in rig.names)
    wanted = srgb_from_linear(1 - frames["mono"].rgb[:1].clamp(0, 1))
    assert (mono - wanted).square().mean().sqrt() < 0.02
    assert colour.shape == (3, 48, 64)


def test_rendered_scenes_are_recorded_by_a_file_of_steps(rendered, tmp_path, refusal):
    sensors = tmp_path / "sensors.yaml"
    arguments = ["record", str(rendered), "--sensors", str(sensors), "--out", str(tmp_path / "out")]
    sensors.write_text("colour: [{resample: 0.5}, {spectral: luminance}, clip, encode-srgb]\n")
    main(arguments, group=Experiments)
    rig = Rig.load(tmp_path / "out/000000/rig.yaml")
    assert rig["colour"].hw == (24, 32)
    assert float(rig["colour"].K[0, 0]) == 35
    assert read_image(tmp_path / "out/000000/colour.png").shape == (1, 24, 32)
    sensors.write_text("mono: [{spectrl: luminance}]\n")
    assert "no step is called 'spectrl'; did you mean 'spectral'" in refusal(*arguments)
    sensors.write_text("mno: [clip]\n")
    assert "no camera 'mno'; did you mean 'mono'" in refusal(*arguments)
