"""Data that contradict what is stated of them are named, and only these."""

import warnings

import pytest
import torch

from arraygeom import Dense, Rig, Sensor, View
from pat import FuseSettings, fuse
from pat.app.cli.options import response_of
from pat.fusion.corrections import Corrections
from pat.fusion.views import read_view
from pat.matching.radiometry import Response
from pat.media.images import write_image
from pat.networks.weights import load_weights


def rig(**sensor) -> Rig:
    return Rig({"a": View(hw=(20, 30), sensor=Sensor(**sensor))})


def said(image, tmp_path, **sensor) -> str:
    """The warnings on reading an image, written with 8 bits, of a camera."""
    write_image(tmp_path / "a.png", image)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        read_view(rig(**sensor), "a", tmp_path / "a.png")
    return " ".join(str(warning.message) for warning in caught)


@pytest.mark.parametrize(
    ("weights", "named"),
    [
        ((0.12, 0.61, 0.28), True),  # a BGR file: 15.7 dB for 29.3
        ((0.114, 0.587, 0.299), True),
        ((0.299, 0.587, 0.114), False),
        ((0.33, 0.39, 0.28), False),
        ((1 / 3, 1 / 3, 1 / 3), False),
        ((0.2, 0.4, 0.4), False),
        ((0.25, 0.55, 0.2), False),
    ],
)
def test_red_and_blue_exchanged(weights, named):
    response = Response(torch.tensor(weights, dtype=torch.float64))
    lines = Corrections(response).described((20, 30))
    assert any("exchanged" in line for line in lines) == named
    unlike = Corrections(response._replace(explained=0.3)).described((20, 30))
    assert not any("exchanged" in line for line in unlike)


def test_saturation_and_one_band_in_colour(tmp_path):
    image = torch.rand(3, 20, 30) * 0.9
    assert said(image, tmp_path, response="rgb") == ""
    assert said(image[:1], tmp_path, response="blue") == ""
    assert "blue" in said(image, tmp_path, response="blue")
    image[0, :5] = 1
    assert "25% " in said(image, tmp_path)
    image[:, 5:] *= 0.9
    image[0, 1:5] = 0.5
    assert said(image, tmp_path) == ""


def test_fourteen_bits_in_sixteen_are_named(tmp_path):
    image = torch.linspace(0, 1, 600).reshape(1, 20, 30)
    for largest, named in ((2**14 - 1, True), (2**14 - 100, True), (12_000, False), (40_000, False)):
        write_image(tmp_path / "a.png", image * largest / 65535, bits=16)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            read_view(rig(), "a", tmp_path / "a.png")
            read_view(rig(bits=16), "a", tmp_path / "a.png")
        assert ["bits: 14" in str(warning.message) for warning in caught] == [True] * named


def test_a_dense_field_that_does_not_fit_is_refused_before_the_work():
    """Also without a limit: 640x400 would take 22 GB."""
    wide = Rig({name: View(hw=(400, 640)) for name in ("mono", "colour")})
    images = {"mono": torch.rand(1, 400, 640), "colour": torch.rand(3, 400, 640)}
    for settings in (FuseSettings(field=Dense()), FuseSettings(field=Dense(), max_memory="4GiB")):
        with pytest.raises(ValueError, match=r"dense field .*GiB"):
            fuse(images, wide, alpha="mono", network=load_weights("mono-colour"), settings=settings)


@pytest.mark.parametrize("text", ["1,1,1", "0.1,0.1,0.1", "30,59,11", "nan,1,0"])
def test_a_response_adds_up_to_one(text):
    with pytest.raises(ValueError, match="--response"):
        response_of(text)
    assert response_of("0.33,0.33,0.33") == (0.33, 0.33, 0.33)
