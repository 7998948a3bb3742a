"""Data that contradict what is stated of them are named, and only these."""

import warnings
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from arraygeom import Dense, Rig, Sensor, View
from pat import FuseSettings, fuse
from pat.app.cli.options import response_of
from pat.app.sample_array import SAMPLE
from pat.fusion.corrections import Corrections
from pat.fusion.views import ViewFiles, Views, read_view
from pat.matching.band_mix import Response
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


def test_bits_that_the_counts_contradict_are_named(tmp_path):
    """Values cut off where a camera of 12 bits ends contradict 14 stated bits."""
    image = (torch.linspace(0, 1.2, 600).reshape(1, 20, 30).clamp(max=1) * 4095 / 65535).double()
    write_image(tmp_path / "a.png", image, bits=16)
    for bits, named in ((12, False), (14, True), (16, True)):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            read_view(rig(bits=bits), "a", tmp_path / "a.png")
        assert any("'bits'" in str(warning.message) for warning in caught) == named


@pytest.mark.parametrize("text", ["RGB", "colour", "", 5])
def test_a_response_is_a_name_that_is_known(text, tmp_path):
    """RGB, in capitals, is refused, not taken for one band."""
    with pytest.raises((ValueError, TypeError), match=r"response[^/]*$"):
        Sensor(response=text)
    (tmp_path / "rig.yaml").write_text(
        f"format: arraygeom-rig 1\ncameras:\n  a: {{size: [4, 4], response: {text or repr('')}}}\n"
    )
    with pytest.raises(ValueError, match=r"rig\.yaml"):
        Rig.load(tmp_path / "rig.yaml")


def test_exposures_in_another_unit_are_named():
    """Exposures of 10 and 0.01 seconds for images of equal brightness are refused by name."""
    sample = Rig.load(SAMPLE / "rig.yaml")
    for exposures, wrong in (((0.01, 0.01), False), ((10.0, 0.01), True), ((0.01, 10.0), True)):
        stated = sample
        for name, exposure in zip(sample.names, exposures):
            sensor = replace(sample[name].sensor, exposure=exposure)
            stated = stated.with_camera(name, sample[name].replace(sensor=sensor))
        images = ViewFiles(stated, {n: SAMPLE / f"{n}.png" for n in sample.names}, alpha="mono")
        if wrong:
            with pytest.raises(ValueError, match="'exposure'"):
                Views.of(stated, images, alpha="mono")
        else:
            Views.of(stated, images, alpha="mono")


def test_a_dense_field_that_does_not_fit_is_refused_before_the_work():
    """Also without a limit: 640x400 would take 22 GB."""
    wide = Rig({name: View(hw=(400, 640)) for name in ("mono", "colour")})
    images = {"mono": torch.rand(1, 400, 640), "colour": torch.rand(3, 400, 640)}
    for settings in (FuseSettings(field=Dense()), FuseSettings(field=Dense(), max_memory="4GiB")):
        with pytest.raises(ValueError, match=r"dense.*GiB"):
            fuse(images, wide, alpha="mono", network=load_weights("mono-colour"), settings=settings)


class Unread(dict):
    """Images that nobody may ask for."""

    def __getitem__(self, name):
        raise AssertionError(f"{name} was read")


@pytest.mark.parametrize("limit", ["1GiB", "2GiB"])
def test_a_limit_that_cannot_be_kept_is_known_from_the_sizes(limit, tmp_path, refusal):
    """Nothing is read before 24 megapixels are refused."""
    large = Rig({name: View(hw=(4000, 6000)) for name in ("mono", "colour")})
    with pytest.raises(ValueError, match=r"max_memory.*24\.0 megapixels"):
        fuse(
            Unread(mono=None, colour=None),
            large,
            alpha="mono",
            network=load_weights("mono-colour"),
            settings=FuseSettings(max_memory=limit),
        )
    for name in ("mono", "colour"):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.full((4000, 6000), ord(name[0]), np.uint8))
    large.save(tmp_path / "rig.yaml")
    files = [str(tmp_path / f"{name}.png") for name in ("mono", "colour")]
    out = ["--out", str(tmp_path / "out"), "--max-memory", limit]
    assert "24.0 megapixels" in refusal("fuse", *files, *out)
    rig_and_files = [str(tmp_path / "rig.yaml"), *files, "--alpha", "mono", *out]
    for command in ("fuse", "align", "batch"):
        assert "24.0 megapixels" in refusal(command, *rig_and_files)


@pytest.mark.parametrize("text", ["1,1,1", "0.1,0.1,0.1", "30,59,11", "nan,1,0"])
def test_a_response_adds_up_to_one(text):
    with pytest.raises(ValueError, match="--response"):
        response_of(text)
    assert response_of("0.33,0.33,0.33") == (0.33, 0.33, 0.33)
