import pytest
import torch
import yaml

from arraygeom.sensor import Band, Curve
from experiments.sensors import STEPS, DecodeSRGB, Mosaic, MotionBlur, Spectral, read_chain, read_chains
from pat.sensors import Clip, Noise, Quantise, Resample, record

TEXT = """
mono:
  - decode-srgb
  - spectral: luminance
  - motion-blur: {shutter: 0.01, velocity: [300, 0]}
  - resample: 0.5
  - noise: {full_well: 8e3, read: 3, counts: poisson}
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
        *(Noise(8000.0, 3.0, "poisson"), Clip(), Quantise(12)),
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
        ("[{nois: {full_well: 3}}]", r"chain\[0\]: no step is called 'nois'; did you mean 'noise'"),
        (
            "[clip, {noise: {fullwell: 3}}]",
            r"chain\[1\].noise.fullwell: unknown key; did you mean 'full_well'",
        ),
        ("[{noise: {read: 3}}]", r"full_well: missing"),
        ("[{noise: {full_well: many}}]", r"noise.full_well: is 'many'; wanted a number"),
        ("[{noise: {full_well: -3}}]", r"full_well > 0"),
        ("[{resample: {to: 0.5, method: cubic}}]", r"method: is 'cubic'; did you mean 'bicubic'"),
        ("[{box-blur: 4}]", r"box-blur: the width of a box blur must be an odd"),
        ("[{box-blur: 2.5}]", r"width: is 2.5; wanted a whole number"),
        ("[{spectral: lumnance}]", r"did you mean 'luminance'"),
        ("[{spectral: {center: 450, width: 3}}]", r"did you mean 'centre'"),
        ("[{motion-blur: {shutter: 0, velocity: [3]}}]", r"velocity: has 1 entries; wanted 2"),
        ("[{mosaic: RGBG}]", r"pattern: is 'RGBG'; did you mean 'RGGB'"),
        ("[{clip: 3}]", r"clip: takes no options"),
        ("[[clip]]", r"wanted a step's name"),
        ("{clip: 1}", r"wanted a list of steps"),
    ],
)
def test_typos_are_named_with_their_entry(text, words):
    with pytest.raises(ValueError, match=words):
        read_chain(yaml.safe_load(text))
