"""Each file is read and developed once, each field evaluated once a pixel: whole frames, tiles, sequences."""

from collections import Counter

import numpy as np
import pytest
import torch

import pat.fusion.tiles
import pat.fusion.views
from arraygeom import Distortion, Epipolar, Sensor
from arraygeom.runtime.chunks import tiles_of
from pat import FuseSettings, fuse
from pat.fusion.frames import ImageFiles
from pat.fusion.sequence import fuse_sequence
from pat.fusion.tiles import MAX_HALO
from pat.fusion.views import ViewFiles, Views
from pat.media.images import write_image
from pat.networks.configs import GuidedPATConfig
from pat.networks.guided import GuidedPAT
from tests.arraygeom.rigs import parallel_rig

HW = (64, 96)


def rig_of(names, *, lens=False, places=None, **sensor):
    """Alpha first, the others 10 cm times their place to the right of it."""
    distortion = (
        Distortion("brown-conrady", torch.tensor([-0.05, 0, 0, 0], dtype=torch.float64)) if lens else None
    )
    centres = {n: (0.1 * i,) for n, i in zip(names, places or range(len(names)))}
    return parallel_rig(100.0, HW, centres, (1, 8), distortion=distortion, sensor=Sensor(**sensor))


def smooth(channels, seed):
    rough = torch.rand(1, channels, 12, 18, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.interpolate(rough, HW, mode="bicubic").clamp(0, 1)[0]


@pytest.fixture
def reads(monkeypatch):
    """Count the reads of each file, and all developments."""
    count = Counter()

    def counted(name):
        real = getattr(pat.fusion.views, name)

        def call(first, *args, **kwargs):
            count[str(first) if name == "read_image" else name] += 1
            return real(first, *args, **kwargs)

        return call

    for name in ("read_image", "develop"):
        monkeypatch.setattr(pat.fusion.views, name, counted(name))
    return count


@pytest.mark.parametrize(
    ("bands", "lens", "places"),
    [((1, 3), False, None), ((1, 3), True, None), ((1, 1, 1, 1), True, [0, 1, 1, 2])],
)
def test_each_file_is_read_and_developed_once(bands, lens, places, reads, tmp_path):
    torch.manual_seed(0)
    names = "abcd"[: len(bands)]
    rig, files = rig_of(names, lens=lens, places=places), {n: tmp_path / f"{n}.png" for n in names}
    for i, (name, channels) in enumerate(zip(names, bands)):
        write_image(files[name], smooth(channels, i))
    network = GuidedPAT(GuidedPATConfig(bands=None if len(bands) > 2 else 3))
    images = ViewFiles(rig, files, alpha="a")
    frame = fuse(
        images, images.developed, alpha="a", network=network.eval(), settings=FuseSettings(match_levels=True)
    )
    assert frame.image.shape == (3, *HW)
    assert reads == {**dict.fromkeys(map(str, files.values()), 1), "develop": len(names)}


def test_a_small_image_is_kept_and_a_large_one_read_again(reads, tmp_path, monkeypatch):
    rig, file = rig_of("ab"), tmp_path / "a.png"
    write_image(file, smooth(1, 0))
    for most, times in ((HW[0] * HW[1], 1), (HW[0] * HW[1] - 1, 2)):
        monkeypatch.setattr(pat.fusion.views, "KEPT", most)
        reads.clear()
        images = ViewFiles(rig, {"a": file}, alpha="a")
        assert torch.equal(images["a"], images["a"])
        assert reads[str(file)] == times


def test_each_file_of_a_sequence_is_read_once(reads, tmp_path):
    torch.manual_seed(0)
    rig = rig_of("ab", frame_rate=30.0)
    rig = rig.with_camera("b", rig["b"].replace(sensor=Sensor(frame_rate=10.0)))
    files = {"a": [tmp_path / f"a{i}.png" for i in range(9)], "b": [tmp_path / f"b{i}.png" for i in range(3)]}
    for i, file in enumerate(files["a"] + files["b"]):
        write_image(file, smooth(1 if file.name.startswith("a") else 3, i))
    frames = {name: ImageFiles(paths, rig, name, alpha="a") for name, paths in files.items()}
    network = GuidedPAT().eval()
    assert (
        len(
            list(
                fuse_sequence(
                    frames, rig, alpha="a", network=network, settings=FuseSettings(match_levels=True)
                )
            )
        )
        == 9
    )
    assert set(reads.values()) == {1, 12}
    assert reads["develop"] == 12


class Counted:
    """A field that counts the pixels at which it is asked, by position."""

    def __init__(self):
        self.asked = Counter()

    def __call__(self, pair, x):
        self.asked.update(map(tuple, np.asarray(x.reshape(-1, 2))))
        return Epipolar()(pair, x)


@pytest.mark.parametrize("tiled", [False, True])
def test_each_field_is_evaluated_once_a_pixel(tiled, monkeypatch):
    torch.manual_seed(0)
    if tiled:
        monkeypatch.setattr(pat.fusion.tiles, "tiles_within", lambda *_: list(tiles_of(HW, 32, MAX_HALO)))
    network, field = GuidedPAT().eval(), Counted()
    fuse(
        {"a": smooth(1, 0), "b": smooth(3, 1)},
        rig_of("ab"),
        alpha="a",
        network=network,
        settings=FuseSettings(field=field),
    )
    pixels = {xy: n for xy, n in field.asked.items() if xy[0] % 1 == 0}
    blocks = {xy: n for xy, n in field.asked.items() if xy[0] % 1 == 0.5}
    assert set(pixels.values()) == set(blocks.values()) == {1}
    assert (len(pixels), len(blocks)) == (HW[0] * HW[1], HW[0] * HW[1] // 4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda image: image.numpy(), "ndarray"),
        (lambda image: image[..., :60].movedim(0, -1), r"\(64, 60, 3\)"),
        (lambda image: (image * 255).to(torch.uint8), "uint8"),
        (lambda image: image * 30, "values"),
    ],
)
def test_images_without_a_rig_are_checked_alike(change, message):
    """Images of wrong kinds are refused by name before any rig is estimated."""
    with pytest.raises((TypeError, ValueError), match=f"'b'.*{message}"):
        fuse({"a": smooth(1, 0), "b": change(smooth(3, 1))})


def test_views_name_what_is_wrong():
    rig, images = rig_of("ab"), {"a": smooth(1, 0), "b": smooth(3, 1)}
    for wrong, message in (
        ({"b": images["b"]}, "'a'"),
        ({"a": images["a"]}, "alpha, 'a'"),
        (images | {"c": images["b"]}, "'c'"),
        (images | {"b": images["b"][:, :-1]}, "'b'.*96x63"),
        (images | {"b": images["b"] * torch.nan}, "NaN"),
        (images | {"b": images["b"] * 255}, "'b'"),
        (images | {"a": images["a"] * 30}, "'a'"),
        (images | {"b": 2 * images["b"] - 1}, "'b'"),
        (
            images | {"b": (images["b"] * 255).to(torch.uint8)},
            "'b'.*uint8",
        ),
        (images | {"a": images["a"].half()}, "'a'.*float16"),
        (images | {"a": images["a"][0]}, "'a'.*float32"),
        (images | {"b": images["b"].to("meta")}, "'b'.*torch.strided"),
        (images | {"b": images["b"].to_sparse()}, "'b'.*torch.sparse_coo"),
        (images | {"b": images["b"].movedim(0, -1)}, r"\(64, 96, 3\).*float32"),
    ):
        with pytest.raises(ValueError, match=message):
            Views.of(rig, wrong, alpha="a")
    exposed = rig.with_camera("b", rig["b"].replace(sensor=Sensor(exposure=0.01)))
    Views.of(exposed, images | {"b": images["b"] * 4}, alpha="a")
    Views.of(rig, images | {"b": images["b"] ** 8 * 16}, alpha="a")
