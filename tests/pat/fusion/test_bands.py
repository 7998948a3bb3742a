"""Bands that cameras record one by one: their names, their values, their confidences; and noise."""

import warnings

import cv2
import numpy as np
import pytest
import torch

from arraygeom import Rig
from pat import FuseSettings, fuse
from pat.app.from_images import _ordered_betas, show_colour
from pat.app.results import band_names, save_frame
from pat.app.sample_array import load_sample
from pat.fusion.checks import LowConfidenceWarning, noise_advice, warn_of_confidence
from pat.fusion.frame import Frame
from pat.fusion.inputs import FrameInputs
from pat.fusion.steps import join
from pat.fusion.views import Views
from pat.matching.inputs import Inputs
from pat.networks.weights import load_weights
from pat.sensors import NoiseLevel
from tests.arraygeom.rigs import parallel_rig
from tests.pat.app.test_results import frame_of
from tests.pat.commands import pat


def sample_of_bands(scales: dict[str, float]) -> tuple[Rig, dict[str, torch.Tensor]]:
    """The sample array reduced, its colour camera's bands as cameras of a band each, a pixel apart."""
    sample = load_sample()
    rig, cameras = sample.rig, {"mono": sample.rig["mono"].resize((200, 320))}
    images = {"mono": torch.nn.functional.avg_pool2d(sample.images["mono"], 2)}
    half = torch.nn.functional.avg_pool2d(sample.images["colour"], 2)
    for i, (name, scale) in enumerate(scales.items()):
        camera = rig["colour"].resize((180, 280))
        pose = camera.cam_from_world
        cameras[name] = camera.replace(cam_from_world=type(pose)(pose.R, pose.t * (1 + 0.01 * i)))
        images[name] = half[i : i + 1] * scale
    return Rig(cameras, depth=rig.depth), images


@pytest.mark.parametrize(
    ("names", "colour"),
    [
        (("red", "green", "blue"), True),
        (("cam1_600nm", "cam2_550nm", "cam3_450nm"), True),
        (("red_edge", "red", "green"), False),
        (("green", "red", "blue"), False),
        (("a", "b", "c"), False),
        (("red", "green"), False),
    ],
)
def test_three_bands_are_colours_only_if_their_names_say_so(names, colour):
    """Red edge, red and green are not shown as red, green and blue."""
    assert show_colour(names, [1] * len(names)) == colour
    assert not show_colour(names, [3] * len(names))


def test_a_red_edge_is_ordered_before_red():
    images = {name: torch.rand(1, 4, 4) for name in ("nir", "green", "red", "red_edge")}
    said = []
    assert _ordered_betas(images, "nir", said.append) == ["red_edge", "red", "green"]
    assert said == ["bands: red_edge, red, green, each at alpha's view"]


def test_bands_keep_their_own_values_where_levels_are_matched():
    """They are not scaled to alpha's mean and contrast."""
    rig, images = sample_of_bands({"a": 1.0, "b": 0.25})
    frame = fuse(
        images,
        rig,
        alpha="mono",
        network=load_weights("mono-spectral"),
        settings=FuseSettings(match_levels=True, align=False),
    )
    truth = load_sample().ground_truth[:2].flatten(1).mean(1)
    for mean, wanted in zip(frame.image.flatten(1).mean(1), (float(truth[0]), 0.25 * float(truth[1]))):
        assert float(mean) == pytest.approx(wanted, rel=0.1)
    assert frame.by_band.shape == frame.image.shape
    assert band_names(frame, ["a", "b"]) == ["a", "b"]
    assert torch.allclose(frame.by_band.amin(0).float(), frame.confidence, atol=2e-3)


@pytest.mark.parametrize("by_band", [None, torch.rand(3, 6, 8).half()])
def test_confidences_of_bands_have_one_type(by_band):
    """However many betas were joined."""
    rig = parallel_rig(8.0, (6, 8), {"mono": (), "a": (0.1,)}, (2.0, 50.0))
    rig = Rig({**rig.cameras, "b": rig["a"], "c": rig["a"]}, depth=rig.depth)
    views = Views.of(rig, {name: torch.rand(1, 6, 8) for name in rig.names}, alpha="mono")
    _, back = join("all", views)
    assert back(frame_of(3)._replace(by_band=by_band)).by_band.dtype == torch.float16


@pytest.mark.parametrize("bands", [["red"], ["red", "nir", "red"], ["red", "nir", "edge", "far"]])
def test_bands_are_never_left_out(bands, tmp_path):
    with pytest.raises(ValueError, match="red"):
        save_frame(frame_of(3), tmp_path, bands=bands)
    assert not list(tmp_path.iterdir())


def test_bands_are_files_by_name_with_their_confidences(tmp_path):
    frame = frame_of(3)._replace(by_band=torch.rand(3, 6, 8).half())
    written = save_frame(frame, tmp_path, bands=["red", "nir", "edge"])
    assert {path.name for path in written} == {"fused.png", "confidence.png"} | {
        f"{kind}_{name}.png" for kind in ("fused", "confidence") for name in ("red", "nir", "edge")
    }
    assert cv2.imread(str(tmp_path / "fused.png"), cv2.IMREAD_UNCHANGED).shape == (6, 8, 3)
    read = cv2.imread(str(tmp_path / "confidence_nir.png"), cv2.IMREAD_UNCHANGED) / 255
    assert np.allclose(read, frame.by_band[1].numpy(), atol=3e-3)


def confidence_warning(
    by_band: list[float] | None, confidence: torch.Tensor | None = None
) -> list[warnings.WarningMessage]:
    maps = None if by_band is None else torch.tensor(by_band)[:, None, None].expand(-1, 8, 8)
    confidence = torch.full((8, 8), min(by_band or [0.04])) if confidence is None else confidence
    frame = Frame(torch.rand(9, 8, 8), torch.ones(8, 8), confidence, torch.ones(8, 8), maps)
    inputs = FrameInputs(Inputs(torch.full((1, 1, 8, 8), 0.5), ()), [], (8, 8))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        warn_of_confidence(load_weights("mono-spectral"), frame, inputs)
    return caught


def test_one_band_that_matches_badly_is_no_wrong_rig():
    """The median of the bands' confidences decides, not the least."""
    assert confidence_warning([0.04, 0.1, *[0.6] * 7]) == []
    (none,), (most,) = confidence_warning(None), confidence_warning([0.04] * 7 + [0.6] * 2)
    assert none.category is LowConfidenceWarning
    assert most.category is LowConfidenceWarning
    assert "median" in str(most.message)


def test_low_confidence_is_named_by_where_it_is():
    """A low mean is warned of, and so is a large part of low confidence, with its place."""
    confidence = torch.full((8, 8), 0.8)
    confidence[:, 7:] = 0.0
    assert confidence_warning(None, confidence) == []
    confidence[2:, 5:] = 0.0
    (third,) = confidence_warning(None, confidence)
    assert third.category is UserWarning
    assert "right" in str(third.message)
    (everywhere,) = confidence_warning(None, torch.full((8, 8), 0.39))
    assert everywhere.category is UserWarning


def test_plain_noise_names_the_option_that_it_needs():
    rough = torch.rand(1, 1, 16, 16)
    image = torch.nn.functional.interpolate(rough, size=(200, 200), mode="bicubic").clamp(0, 1)
    noisy = NoiseLevel.from_electrons(60, 2).recorded(image, torch.Generator().manual_seed(0))
    assert noise_advice(Inputs(image, ())) == ""
    assert "try `--noise estimate`" in noise_advice(Inputs(noisy, ()))


def test_sixteen_bits_are_written_for_sixteen(tmp_path):
    """Unless another depth is requested."""
    rig, images = sample_of_bands({"a": 1.0, "b": 0.25})
    rig.save(tmp_path / "rig.yaml")
    for name, image in images.items():
        deep = name == "a"
        values = (image[0].numpy() * (65535 if deep else 255)).round().astype(np.uint16 if deep else np.uint8)
        cv2.imwrite(str(tmp_path / f"{name}.png"), values)
    files = " ".join(str(tmp_path / f"{name}.png") for name in images)
    given = (
        f"{tmp_path / 'rig.yaml'} {files} --alpha mono --network mono-spectral --extras none --misfit warn"
    )
    for extra, kind in (("", np.uint16), ("--format png8", np.uint8)):
        pat(f"fuse {given} -o {tmp_path / 'out'} {extra}")
        for name in ("fused", "fused_a", "fused_b"):
            assert cv2.imread(str(tmp_path / "out" / f"{name}.png"), cv2.IMREAD_UNCHANGED).dtype == kind
