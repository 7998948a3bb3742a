"""fuse: tiles equal the whole, sizes and pitches are followed, mistakes are named."""

import math
import subprocess
import sys
import weakref

import pytest
import torch

import pat.fusion.steps
import pat.fusion.tiles
import pat.matching.inputs
from arraygeom import (
    Camera,
    Distortion,
    Epipolar,
    LensView,
    Link,
    Local,
    Pose,
    Rectified,
    Rig,
    Segments,
    Sensor,
    View,
    intrinsics,
    resampled,
    rotation_from_vector,
)
from arraygeom.fields import AroundDepth
from arraygeom.runtime.chunks import Tile, tiles_of
from arraygeom.runtime.threads import limited_to
from calib.images.matches import match_points, seen_depths
from pat import FuseSettings, fuse
from pat.fusion.frame import Frame
from pat.fusion.inputs import FrameInputs, prepared
from pat.fusion.steps import linear_luminance, quarter_turns, resolution_ratio, steps_for, without_lenses
from pat.fusion.tiles import MAX_HALO, SLACK, tiles_within, working_memory
from pat.fusion.views import Views
from pat.lab.data.pairs import folder_pairs
from pat.matching.inputs import Inputs, InputsSettings
from pat.media.colour import linear_from_srgb, luminance
from pat.media.images import read_image
from pat.media.raw import LIGHT
from pat.networks.configs import GuidedPATConfig, PATConfig
from pat.networks.guided import GuidedPAT
from pat.networks.paper import PAT
from pat.networks.weights import load_weights
from pat.support.metrics import score
from tests.pat.layered_array import load_sample


def rig_of(hw, beta_hw, focal=300.0, beta_focal=200.0) -> Rig:
    R = rotation_from_vector(torch.tensor([0.004, -0.01, 0.02], dtype=torch.float64))
    t = torch.tensor([-0.1, 0.01, 0.0], dtype=torch.float64)
    return Rig(
        {
            "mono": Camera(K=intrinsics(focal, hw), cam_from_world=Pose.identity(), hw=hw),
            "colour": Camera(K=intrinsics(beta_focal, beta_hw), cam_from_world=Pose(R, t), hw=beta_hw),
        },
        depth=(2.0, 20.0),
    )


def network_of(kind: str):
    torch.manual_seed(1)
    if kind == "PAT":
        return PAT(PATConfig(dim=8, interpolation="bilinear")).eval()
    return GuidedPAT(GuidedPATConfig(bands=None if kind == "any bands" else 3)).eval()


def texture(channels: int, hw: tuple[int, int]) -> torch.Tensor:
    """Blobs of some pixels: in float32 positions at 1000 pixels are rounded to 6e-5, which noise shows."""
    g = torch.Generator().manual_seed(0)
    rough = torch.rand(1, channels, hw[0] // 5, hw[1] // 5, generator=g)
    return torch.nn.functional.interpolate(rough, hw, mode="bicubic", align_corners=False)[0].clamp(0, 1)


def scene(hw=(64, 96), beta_hw=(64, 96), **focal) -> tuple[Rig, dict[str, torch.Tensor]]:
    """A rig, and images of its cameras."""
    return rig_of(hw, beta_hw, **focal), {"mono": texture(1, hw), "colour": texture(3, beta_hw)}


def in_tiles(patched, hw, side, halo):
    """Fuse in these tiles from here on."""
    tiles = list(tiles_of(hw, side, halo))
    patched.setattr(pat.fusion.tiles, "tiles_within", lambda *_: tiles)
    return tiles


@pytest.mark.parametrize(
    ("kind", "dtype", "bound"),
    [
        ("PAT", torch.float32, 1e-5),
        ("GuidedPAT", torch.float64, 1e-9),
        ("GuidedPAT", torch.float32, 1e-5),
        ("any bands", torch.float32, 1e-5),
    ],
)
def test_tiled_equals_whole(kind, dtype, bound, monkeypatch):
    """At every pixel, the tiles' borders included. The frame is wider than a tile with its halo."""
    hw, network = (34, 1620), network_of(kind).to(dtype)
    rig, images = scene(hw, (30, 1110))
    images = {name: image.to(dtype) for name, image in images.items()}
    whole = fuse(images, rig, alpha="mono", network=network)
    assert any(t.outer[3] - t.outer[2] < hw[1] for t in in_tiles(monkeypatch, hw, 160, network.halo))
    tiled = fuse(images, rig, alpha="mono", network=network)
    assert (tiled.image - whole.image).abs().max() < bound
    assert torch.equal(tiled.depth.isnan(), whole.depth.isnan())
    assert (tiled.confidence - whole.confidence).abs().max() < bound
    assert torch.allclose(1 / tiled.depth, 1 / whole.depth, atol=10 * bound, equal_nan=True)
    monkeypatch.setattr(type(network), "halo", 16)
    in_tiles(monkeypatch, hw, 160, 16)
    assert (fuse(images, rig, alpha="mono", network=network).image - whole.image).abs().max() > bound


def test_matching_in_pieces_is_nearly_that_of_the_whole_and_tiles_do_not_matter(monkeypatch):
    sample, network = load_sample(), load_weights("mono-colour")
    images = {name: sample.images[name] for name in sample.rig.names}
    whole = fuse(images, sample.rig, alpha="mono", network=network)
    monkeypatch.setattr(pat.matching.inputs, "SETTINGS", InputsSettings(halo=128, at_once=150_000))
    assert sample.rig["mono"].hw[0] * sample.rig["mono"].hw[1] > 150_000
    pieces = fuse(images, sample.rig, alpha="mono", network=network)
    ground_truth = sample.ground_truth
    assert (
        score(pieces.image.clamp(0, 1), ground_truth).psnr
        > score(whole.image.clamp(0, 1), ground_truth).psnr - 0.1
    )
    off = (pieces.image - whole.image).abs().amax(0)
    assert (off > 0.005).float().mean() < 2.5e-3
    in_tiles(monkeypatch, sample.rig["mono"].hw, 192, MAX_HALO)
    tiled = fuse(images, sample.rig, alpha="mono", network=network)
    assert (tiled.image - pieces.image).abs().max() < 1e-5
    assert (tiled.confidence - pieces.confidence).abs().max() < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("folder", ["kitti", "flickr1024/train"])
def test_halos_are_wide_enough_for_the_weights(folder, shared_data):
    """Tiles of real images equal the whole with the shipped weights, but for rounding of positions."""
    pair, network = next(folder_pairs(shared_data / folder)), load_weights("mono-colour")
    images = {"left": luminance(pair.left), "right": pair.right}
    rig = Rig({name: View(hw=image.shape[1:]) for name, image in images.items()})
    field = Rectified(alpha_is="left", max_disparity=pair.max_disparity)
    whole = fuse(images, rig, alpha="left", network=network, settings=FuseSettings(field=field))
    h, w = rig["left"].hw
    with pytest.MonkeyPatch.context() as patched:
        in_tiles(patched, (h, w), (-(-h // 32) * 16, -(-w // 64) * 16), MAX_HALO)
        tiled = fuse(images, rig, alpha="left", network=network, settings=FuseSettings(field=field))
    assert (tiled.image - whole.image).abs().max() < 3e-5
    assert (tiled.confidence - whole.confidence).abs().max() < 3e-5


WRONG = """
import numpy as np
import torch
from pat import FuseSettings, fuse
from pat.app.sample_array import load_sample
from pat.fusion.align import align_frame, resampled_values
from pat.app.aligned_files import save_aligned
from pat.fusion.fuse import corrections_of, fuse_frame
from pat.fusion.sequence import SequenceFusion
from pat.media.images import write_image
from pat.networks.weights import load_weights

sample = load_sample()
rig, images = sample.rig, sample.images
for use in (
    lambda: fuse({name: f"{name}.png" for name in images}, rig, alpha="mono"),
    lambda: fuse({name: image.numpy() for name, image in images.items()}, rig, alpha="mono"),
    lambda: fuse(images, {"mono": 1}, alpha="mono"),
    lambda: fuse("mono-colour", rig, alpha="mono"),
    lambda: fuse(images, rig, alpha="mono", settings=FuseSettings(noise="much")),
    lambda: fuse(images, rig, alpha="mono", settings=FuseSettings(response="luma")),
    lambda: fuse(images, rig, alpha="mono", settings=FuseSettings(response=None)),
    lambda: fuse(images, rig, alpha="mono", settings=FuseSettings(response=("1", "2", "3"))),
    lambda: fuse(images, rig, alpha="mono", settings=FuseSettings(noise=0.1)),
    lambda: fuse(images, rig, alpha="mono", settings=FuseSettings(noise={"mono": 200})),
    lambda: fuse([*images.values()], rig, alpha="mono"),
    lambda: fuse([*images.values()]),
    lambda: fuse(images, rig, alpha="mono", network=torch.nn.Linear(2, 2)),
    lambda: fuse(images, rig, alpha="mono", settings={"noise": None}),
    lambda: fuse_frame(images, rig, alpha="mono", network=None, settings={"noise": None}),
    lambda: fuse(images, rig, alpha="mono", corrections={"colour": 1}),
    lambda: fuse_frame(images, rig, alpha="mono", network=load_weights("mono-colour"), corrections={}),
    lambda: align_frame(images, rig, alpha="mono", network=load_weights("mono-colour"), settings={}),
    lambda: corrections_of(images, rig, alpha="mono", network=load_weights("mono-colour"), settings={}),
    lambda: SequenceFusion(None, rig, {}, "mono", settings={}),
    lambda: fuse(images, rig, alpha="mono", matcher=lambda inputs: 3),
    lambda: fuse(images, rig, alpha=0),
    lambda: resampled_values(np.zeros((1, 4, 5)), np.zeros((1, 1, 2), np.float32), "lanczos"),
    lambda: save_aligned(None, None, positions="csv"),
    lambda: write_image("x.png", torch.zeros(3, 8, 8, dtype=torch.uint8)),
):
    try:
        print("taken", use())
    except (OSError, TypeError, ValueError) as error:
        print(error)
"""


def test_what_is_not_what_it_should_be_is_refused_in_a_line():
    """Apart, where nothing else checks types."""
    done = subprocess.run([sys.executable, "-c", WRONG], capture_output=True, text=True)
    expected = (
        "mono: mono.png: no such",
        "the image of 'mono' is a ndarray: give a tensor",
        "the rig is a dict",
        "an array has two images or more, got mono-colour",
        "noise is 'estimate', 'auto' or a NoiseLevel of each camera; got 'much'",
        "response is 'fit', 'rec601' or three weights; got 'luma'",
        "a response is three weights, of red, green and blue, none negative; got None",
        "a response is three weights, of red, green and blue, none negative; got ('1', ",
        "noise is 'estimate', 'auto' or a NoiseLevel of each camera; got 0.1: give {NAME",
        "noise is 'estimate', 'auto' or a NoiseLevel of each camera; got {'mono': 200}: give {NAME",
        "an image is a Tensor without a name",
        "an image is a Tensor without a name",
        "network is a Linear",
        "settings are a dict",
        "wanted FuseSettings, got a dict",
        "wanted Corrections, got a dict",
        "wanted Corrections, got a dict",
        "wanted FuseSettings, got a dict",
        "wanted FuseSettings, got a dict",
        "wanted FuseSettings, got a dict",
        "wanted Matches, got a int",
        "name is a int",
        "interpolation is 'lanczos': wanted nearest",
        "positions is 'csv': wanted npy",
        "x.png: the image to write is uint8: give floats in 0..1",
    )
    lines = done.stdout.splitlines()
    assert len(lines) == len(expected), done.stderr
    assert all(line.startswith(said) for line, said in zip(lines, expected))


def test_what_is_no_field_or_no_list_is_refused_in_a_line():
    rig, images = scene()

    def ends(pair, x):
        return x, x

    with pytest.raises(ValueError, match=r"ends.*tuple"):
        fuse(images, rig, alpha="mono", network=network_of("GuidedPAT"), settings=FuseSettings(field=ends))

    def fewer(pair, x):
        found = Epipolar()(pair, x)
        return Segments(found.start[:-1], found.end[:-1], found.valid[:-1])

    with pytest.raises(ValueError, match="fewer"):
        fuse(images, rig, alpha="mono", network=network_of("GuidedPAT"), settings=FuseSettings(field=fewer))
    with pytest.raises(ValueError, match=r"mono\.png"):
        fuse("mono.png")


def test_an_image_of_one_colour_is_named():
    """A black frame is not reported as a rig that does not fit."""
    rig, images = scene()
    images["colour"] = torch.ones(3, 64, 96)
    with pytest.warns(UserWarning, match="'colour'"):
        fuse(images, rig, alpha="mono", network=network_of("GuidedPAT"))


def test_a_network_elsewhere_is_refused():
    """Its result would be NaN."""
    rig, images = scene()
    with pytest.raises(ValueError, match="'mono'"):
        fuse(images, rig, alpha="mono", network=network_of("PAT").to("meta"))


def test_precision_is_that_of_the_weights():
    rig, images = scene()
    network, double = network_of("PAT"), {name: image.double() for name, image in images.items()}
    with pytest.raises(ValueError, match=r"float64.*float32"):
        fuse(double, rig, alpha="mono", network=network)
    whole = fuse(images, rig, alpha="mono", network=network).image
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(fuse(images, rig, alpha="mono", network=network).image, whole)
    found = fuse(
        double, rig, alpha="mono", network=network.double(), settings=FuseSettings(noise="estimate")
    ).image
    assert found.dtype == torch.float64


def test_images_are_asked_for_once_and_only_when_they_are_needed():
    (rig, given), network, asked = scene(beta_hw=(60, 80)), network_of("GuidedPAT"), []

    class Files(dict):
        def __getitem__(self, name):
            asked.append(name)
            return super().__getitem__(name)

    found = fuse(Files(given), rig, alpha="mono", network=network)
    assert torch.equal(found.image, fuse(given, rig, alpha="mono", network=network).image)
    assert sorted(asked) == ["colour", "mono"]


def alpha_alone(hw):
    """The inputs of a frame without betas, which takes no memory."""
    return FrameInputs(Inputs(torch.zeros(1).expand(1, 1, *hw), ()), [], hw)


def test_memory_decides_the_tiles():
    network, hw = network_of("PAT"), (3000, 4000)
    frame = alpha_alone(hw)
    assert tiles_within(network, frame, None) == [Tile((0, 3000, 0, 4000), (0, 3000, 0, 4000))]
    tiles = tiles_within(network, frame, 2.0**31)
    area = max((t.outer[1] - t.outer[0]) * (t.outer[3] - t.outer[2]) for t in tiles)
    assert network.working_bytes(area, [0]) <= 2**31
    assert sum((t.inner[1] - t.inner[0]) * (t.inner[3] - t.inner[2]) for t in tiles) == math.prod(hw)
    with pytest.raises(ValueError, match="80"):
        tiles_within(network, frame, 2.0**20)


def test_tiles_are_those_with_the_least_work():
    """Square tiles under the same limit make more."""
    network, hw, limit = network_of("GuidedPAT"), (3036, 4024), SLACK * 1.1e9

    def work(tiles):
        return sum((t.outer[1] - t.outer[0]) * (t.outer[3] - t.outer[2]) for t in tiles)

    frame = alpha_alone(hw)
    ours = tiles_within(network, frame, limit)
    side = int(math.sqrt(limit / SLACK / network.working_bytes(1, [0]))) - 2 * MAX_HALO
    assert work(ours) < 0.95 * work(tiles_of(hw, side, MAX_HALO))
    assert all(working_memory(network, frame.inputs, t) <= limit for t in ours)


def test_the_plan_is_announced_before_the_work():
    plans, (rig, images) = [], scene((50, 70), (40, 60))
    fuse(images, rig, alpha="mono", network=network_of("PAT"), announce=plans.append)
    assert str(plans[0]).startswith("1 piece, 0.4")
    assert plans[0].seconds is None


def test_a_wide_beta_is_enlarged_only_where_alpha_sees():
    """Beta sees ten times alpha's field: what fusing gives is the same, and what is worked on is small."""
    wide, network = (300, 440), network_of("GuidedPAT")
    rig, images = scene(beta_hw=wide, beta_focal=100.0)
    views = pat.fusion.steps.equal_resolution(network, Views.of(rig, images, alpha="mono")).views
    assert math.prod(views.images["colour"].shape[1:]) < 0.6 * 9 * math.prod(wide)
    cut = fuse(images, rig, alpha="mono", network=network)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(pat.fusion.steps, "_cropped", lambda network, views, name: views)
        whole = fuse(images, rig, alpha="mono", network=network)
    # What the views have in common sets the levels at which they are compared: that is where the two differ.
    assert (cut.image - whole.image).abs().mean() < 5e-2


def test_a_field_of_ones_own_is_fused_like_the_one_that_it_calls():
    rig, images = scene(beta_hw=(300, 440), beta_focal=100.0)
    network = network_of("GuidedPAT")
    known = fuse(images, rig, alpha="mono", network=network)
    settings = FuseSettings(field=lambda pair, x: Epipolar()(pair, x))
    own = fuse(images, rig, alpha="mono", network=network, settings=settings)
    assert all(torch.equal(a.nan_to_num(), b.nan_to_num()) for a, b in zip(known[:4], own[:4]))


def middle_third(pair, x):
    """Segments in the middle of beta's image, whatever its size."""
    h, w = pair.beta.hw
    ends = (x.new_tensor([share * w, h / 2]).expand_as(x) for share in (1 / 3, 2 / 3))
    return Segments(*ends, torch.ones(x.shape[:-1], dtype=torch.bool))


@pytest.mark.parametrize(
    ("field", "cropped"),
    [
        (Epipolar(), True),
        (Local(), True),
        (Rectified(20, alpha_is="either"), False),
        (middle_third, False),
    ],
)
def test_a_beta_is_cropped_if_its_field_says_the_same_of_the_crop(field, cropped):
    rig, images = scene(beta_hw=(300, 440), beta_focal=100.0)
    views = Views.of(rig, images, alpha="mono", field=field)
    kept = pat.fusion.steps._cropped(network_of("GuidedPAT"), views, "colour").images["colour"]
    assert (kept.shape != images["colour"].shape) == cropped


def test_a_stopped_frame_goes_on_with_its_tiles(tmp_path, monkeypatch):
    (rig, images), network = scene((34, 300), (30, 210)), network_of("PAT")
    in_tiles(monkeypatch, (34, 300), 64, network.halo)
    whole, made, fuse_tile = fuse(images, rig, alpha="mono", network=network), [], pat.fusion.tiles.fuse_tile

    def counted(network, frame, state, tile):
        if len(made) == 3:
            raise KeyboardInterrupt
        made.append(tile)
        return fuse_tile(network, frame, state, tile)

    monkeypatch.setattr(pat.fusion.tiles, "fuse_tile", counted)
    with pytest.raises(KeyboardInterrupt):
        fuse(images, rig, alpha="mono", network=network, store=tmp_path)
    made.clear()
    damaged = sorted(tmp_path.iterdir())[0]
    content = damaged.read_bytes()
    damaged.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    resumed = fuse(images, rig, alpha="mono", network=network, store=tmp_path)
    assert len(made) == 3
    assert all(torch.equal(a.nan_to_num(), b.nan_to_num()) for a, b in zip(resumed[:3], whole[:3]))
    made.clear()
    with pytest.raises(KeyboardInterrupt):
        fuse(images | {"mono": images["mono"] * 0.9}, rig, alpha="mono", network=network, store=tmp_path)


def test_tiles_of_another_depth_map_are_not_taken(tmp_path, monkeypatch):
    """A stored tile belongs to one depth map, compared at all pixels."""
    hw, network = (34, 130), network_of("GuidedPAT")
    rig, images = scene(hw, (30, 110))
    in_tiles(monkeypatch, hw, 64, 16)
    depth, counts = torch.full(hw, 2.0), []
    for value in (2.0, 3.0):
        depth[5:20, 10:50] = value
        known = AroundDepth(depth.clone())
        fuse(
            images,
            rig,
            alpha="mono",
            network=network,
            settings=FuseSettings(align=False, response="rec601", field=known),
            store=tmp_path,
        )
        counts.append(len(list(tmp_path.iterdir())))
    assert counts[1] == 2 * counts[0]


def test_fields_of_cameras_that_are_not_there_and_other_bands_of_alpha_are_refused():
    """A misspelt name, and an alpha of two or four bands."""
    (rig, images), network = scene(), network_of("GuidedPAT")
    with pytest.raises(ValueError, match="'color'"):
        fuse(images, rig, alpha="mono", network=network, settings=FuseSettings(field={"color": Epipolar()}))
    with pytest.raises(ValueError, match=r"'color'.*'colour'"):
        fuse({**images, "color": images["colour"]}, rig, alpha="mono", network=network)
    for bands in (2, 4):
        with pytest.raises(ValueError, match=f"'mono'.*{bands}"):
            fuse({**images, "mono": texture(bands, (64, 96))}, rig, alpha="mono", network=network)
    with pytest.raises(ValueError, match=r"'colour'.*float32"):
        fuse({**images, "colour": images["colour"][:0]}, rig, alpha="mono", network=network)


def test_tiles_of_another_luminance_or_scale_are_not_taken(tmp_path, monkeypatch):
    """A rig of other units has the same segments, and another depth."""
    hw, network = (34, 130), network_of("GuidedPAT")
    rig, images = scene(hw, (30, 110))
    in_tiles(monkeypatch, hw, 64, 16)
    larger = rig.replace(depth=tuple(2 * bound for bound in rig.depth))
    for name in rig.names:
        larger = larger.with_camera(
            name, rig[name].replace(cam_from_world=Pose(rig[name].R, 2 * rig[name].t))
        )

    def stored(rig, **changes):
        fuse(
            images,
            rig,
            alpha="mono",
            network=network,
            settings=FuseSettings(align=False, response="rec601", **changes),
            store=tmp_path,
        )
        return len(list(tmp_path.iterdir()))

    count = stored(rig)
    assert stored(rig) == count
    assert stored(rig, luminance="beta") == 2 * count
    assert stored(larger) == 3 * count


def test_resolution_ratio_is_that_of_pixels_an_angle():
    rig = rig_of((60, 80), (60, 80), focal=100.0, beta_focal=50.0)
    assert abs(resolution_ratio(rig.pair("mono", "colour")) - 0.5) < 0.01
    assert abs(resolution_ratio(rig.pair("colour", "mono")) - 2.0) < 0.04


def test_colour_comes_from_where_the_field_says():
    """A red half and a blue half: each alpha pixel gets its own side's colour, from a turned beta too."""
    hw = (64, 96)
    rig = rig_of(hw, hw, focal=100.0, beta_focal=100.0)
    g = torch.Generator().manual_seed(0)
    side = (torch.arange(96) < 48).float().expand(1, *hw)
    ground_truth = torch.cat([side, 0 * side, 1 - side]) * (0.5 + 0.5 * torch.rand(1, *hw, generator=g))
    network = network_of("GuidedPAT")
    for turns in (0, 1):
        images = {"mono": ground_truth, "colour": ground_truth.rot90(turns, (-2, -1))}
        image = fuse(
            images,
            rig.rot90("colour", turns),
            alpha="mono",
            network=network,
            settings=FuseSettings(depth=(5, 20)),
        ).image
        assert image[0, :, 10:40].mean() > image[2, :, 10:40].mean() + 0.1
        assert image[2, :, 56:86].mean() > image[0, :, 56:86].mean() + 0.1


def test_light_that_alpha_measured_stays():
    """Where the rig says that alpha measured it; else the coded values' luminance is alpha's."""
    (rig, images), network = scene((48, 64), (48, 64)), load_weights("mono-colour")
    plain = fuse(images, rig, alpha="mono", network=network).image
    rig = rig.with_camera("mono", rig["mono"].replace(sensor=Sensor(response=LIGHT)))
    light = fuse(images, rig, alpha="mono", network=network).image
    assert (luminance(plain) - images["mono"]).abs().max() < 1e-5
    assert (luminance(linear_from_srgb(light)) - linear_from_srgb(images["mono"])).abs().max() < 1e-4
    assert (luminance(light) - images["mono"]).abs().max() > 0.01
    four, undo = torch.rand(4, 48, 64), linear_luminance(Views.of(rig, images, alpha="mono")).undo
    assert torch.equal(undo(Frame(four, *four[:3])).image, four)


def test_uncalibrated_rigs_fuse_without_depth():
    hw = (48, 64)
    F = torch.tensor([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
    views = {name: View(hw=hw) for name in ("mono", "red", "green", "blue")}
    links = {("mono", name): Link(F) for name in ("red", "green", "blue")}
    images = {name: torch.rand(1, *hw) for name in views}
    frame = fuse(
        images,
        Rig(views, links=links),
        alpha="mono",
        network=network_of("GuidedPAT"),
        settings=FuseSettings(match_levels=True),
    )
    assert frame.image.shape == (3, *hw)
    assert frame.depth.isnan().all()


@pytest.mark.parametrize("names", [("mono",), ("colour",), ("mono", "colour")])
def test_cameras_of_several_types_are_fused(names):
    """K in float64 and the pose in float32, as a file's and an optimiser's."""
    rig, images = scene((50, 70), (40, 60))
    wanted = fuse(images, rig, alpha="mono", network=network_of("GuidedPAT")).image
    for name in names:
        pose = rig[name].cam_from_world
        rig = rig.with_camera(name, rig[name].replace(cam_from_world=Pose(pose.R.float(), pose.t.float())))
    assert rig[names[0]].K.dtype != rig[names[0]].R.dtype
    assert (
        fuse(images, rig, alpha="mono", network=network_of("GuidedPAT")).image - wanted
    ).abs().mean() < 1e-4


def test_depth_and_confidence_are_the_same_bits_on_any_number_of_threads():
    (rig, images), found = scene((96, 128), (80, 120)), []
    for threads in (1, 2, 3):
        with limited_to(threads):
            found.append(fuse(images, rig, alpha="mono", network=network_of("GuidedPAT")))
    for one in found[1:]:
        assert torch.equal(one.depth.nan_to_num(-1), found[0].depth.nan_to_num(-1))
        assert torch.equal(one.confidence, found[0].confidence)
        torch.testing.assert_close(one.image, found[0].image, atol=1e-4, rtol=0)


def test_views_must_overlap():
    rig, images = scene((50, 70), (40, 60))
    back = torch.diag(torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64))
    rig = rig.with_camera("colour", rig["colour"].replace(cam_from_world=Pose(back, torch.zeros(3).double())))
    with pytest.raises(ValueError, match=r"'colour'.* 2 and 20 m"):
        fuse(images, rig, alpha="mono", network=network_of("PAT"), settings=FuseSettings(field=Epipolar()))
    with pytest.raises(ValueError, match="0 < near <= far"):
        fuse(images, rig, alpha="mono", network=network_of("PAT"), settings=FuseSettings(depth=(20, 2)))


def has_lens(lens_of, rig, images):
    """The rig with lenses, and the images those would have taken."""
    for name, coefficients in lens_of.items():
        lens = Distortion("brown-conrady", torch.tensor(coefficients, dtype=torch.float64))
        camera = rig[name].replace(distortion=lens)
        images = images | {name: resampled(images[name], rig[name], camera).values[0]}
        rig = rig.with_camera(name, camera)
    return rig, images


def less_of_alpha() -> tuple[Rig, dict[str, torch.Tensor], torch.Tensor]:
    """The sample array with less of alpha: its rig, images and ground truth."""
    sample = load_sample()
    mono, ground_truth = (p[:, 80:320, 160:480] for p in (sample.images["mono"], sample.ground_truth))
    return sample.rig.crop("mono", 80, 160, (240, 320)), {**sample.images, "mono": mono}, ground_truth


LENSES = {"mono": [0.9, 0.0, 0.0, 0.0], "colour": [-0.6, 0.2, 0.005, 0.0]}


@pytest.mark.parametrize("with_lens", [("colour",), ("mono", "colour")])
def test_lenses_are_seen_through(with_lens):
    """The sample array behind lenses: the same colours at alpha's own, bent pixels, alpha's detail kept."""
    (rig, images, ground_truth), network = less_of_alpha(), load_weights("mono-colour")
    lensed, taken = has_lens({name: LENSES[name] for name in with_lens}, rig, images)
    clean = (fuse(images, rig, alpha="mono", network=network).image - ground_truth).square().mean()
    frame = fuse(taken, lensed, alpha="mono", network=network)
    if "mono" in with_lens:
        ground_truth = resampled(ground_truth, rig["mono"], lensed["mono"]).values[0]
    seen = ground_truth.sum(0) > 0
    error = (frame.image - ground_truth)[:, seen].square().mean()
    assert (luminance(frame.image) - taken["mono"]).abs().max() < 1e-5
    blind = fuse(taken, rig, alpha="mono", network=network)
    assert error < 1.3 * clean
    assert error < 0.85 * (blind.image - ground_truth)[:, seen].square().mean()
    assert torch.isfinite(frame.image).all()
    assert 0.7 < float((frame.depth.isfinite() & seen).float().sum() / seen.float().sum()) <= 1


def test_lenses_of_cameras_known_by_f_are_seen_through():
    """No pose and no focal length: F between straightened pixels, and lenses with a unit of their own."""
    (rig, images, ground_truth), network = less_of_alpha(), load_weights("mono-colour")
    lensed, taken = has_lens({"mono": LENSES["mono"], "colour": [-0.1, 0.01, 0.001, 0.0]}, rig, images)
    pair = rig.pair("mono", "colour")
    links = {("mono", "colour"): Link(pair.fundamental, pair.homography)}
    views = {name: LensView(hw=c.hw, K=c.K, distortion=c.distortion) for name, c in lensed.cameras.items()}
    frame = fuse(taken, Rig(views, links=links), alpha="mono", network=network)
    without = Rig({n: View(hw=v.hw) for n, v in views.items()}, links=links)
    blind = fuse(taken, without, alpha="mono", network=network, settings=FuseSettings(align=False))
    clean = fuse(images, without, alpha="mono", network=network)
    errors = [(clean.image - ground_truth).square().mean()]
    ground_truth = resampled(ground_truth, rig["mono"], lensed["mono"]).values[0]
    seen = ground_truth.sum(0) > 0
    errors += [(f.image - ground_truth)[:, seen].square().mean() for f in (frame, blind)]
    assert errors[1] < 1.3 * errors[0]
    assert errors[1] < 0.85 * errors[2]
    assert frame.depth.isnan().all()
    assert (luminance(frame.image) - taken["mono"]).abs().max() < 1e-5


def test_a_rotated_beta_is_brought_upright():
    (rig, images), network = scene((60, 80), (60, 80)), network_of("GuidedPAT")
    for turns in range(4):
        assert quarter_turns(rig.rot90("colour", turns).pair("mono", "colour")) == -turns % 4
    upright = fuse(images, rig, alpha="mono", network=network)
    images["colour"] = images["colour"].rot90(3, (1, 2))
    turned = fuse(images, rig.rot90("colour", 3), alpha="mono", network=network)
    assert (upright.image - turned.image).abs().max() < 1e-4


@pytest.mark.slow
def test_real_lenses(shared_data):
    """A real pair with barrel distortion of some 30 pixels: colour lands at alpha's own pixels."""
    folder, network = shared_data / "bumblebee2_scenes", load_weights("mono-colour")
    rig = Rig.load(folder / "stereo.yaml")
    left, right = (read_image(folder / f"chair01_{side}.jpg") for side in ("left", "right"))
    straight_rig, straight = without_lenses(rig, {"left": left, "right": right})
    depth = seen_depths(straight_rig.pair("left", "right"), match_points(*straight.values()))
    images = {"left": luminance(left), "right": right}
    frame = fuse(images, rig, alpha="left", network=network, settings=FuseSettings(depth=depth))
    no_lens = rig
    for name in rig.names:
        no_lens = no_lens.with_camera(name, rig[name].replace(distortion=None))
    ignored = fuse(images, no_lens, alpha="left", network=network, settings=FuseSettings(depth=depth))
    grey, seen, blind = (
        score(p.clamp(0, 1), left).psnr
        for p in (luminance(left).expand(3, -1, -1), frame.image, ignored.image)
    )
    assert seen > grey + 4
    assert seen > blind + 0.8


def test_an_image_that_is_not_needed_again_is_not_kept():
    """Alpha's own, whose padded copy the network has, where nothing is undone with it."""
    rig, images = scene((40, 60), (40, 60))
    views = Views.of(rig, images, alpha="mono")
    kept = weakref.ref(images["mono"])
    network = network_of("GuidedPAT")
    inputs, undo = prepared(network, views, steps_for(network, normalise=False))
    del views, images
    assert undo
    assert inputs.hw == (40, 60)
    assert kept() is None


def test_several_betas_of_float64_are_fused():
    rig, images = scene()
    beside = rig["colour"].replace(cam_from_world=Pose(rig["mono"].R, rig["colour"].t * -1))
    both = Rig({**rig.cameras, "other": beside}, depth=rig.depth)
    images = {name: image.double() for name, image in {**images, "other": images["colour"]}.items()}
    assert (
        fuse(images, both, alpha="mono", network=network_of("GuidedPAT").double()).image.dtype
        == torch.float64
    )
