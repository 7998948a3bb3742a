"""The one policy for which field a pair has."""

import dataclasses

import pytest
import torch

from arraygeom import (
    Curved,
    Distortion,
    Epipolar,
    EpipolarLine,
    HomographyDisplacement,
    Link,
    Pair,
    Rectified,
    ThroughLenses,
    View,
    sampling_locations,
)
from arraygeom.fields import FIELDS, default_field, recorded_field
from arraygeom.fields.default import straight_field
from tests.arraygeom.rigs import random_rig

HW, BETA_HW = (20, 30), (60, 40)


def sized() -> Pair:
    return Pair(View(hw=HW), View(hw=BETA_HW))


def calibrated(lens: bool = False) -> Pair:
    pair = random_rig(0).pair("alpha", "beta")
    if not lens:
        return pair
    bent = Distortion("brown-conrady", torch.tensor([-0.1, 0, 0, 0], dtype=torch.float64))
    return dataclasses.replace(pair, beta=pair.beta.replace(distortion=bent))


def linked(pair: Pair) -> Pair:
    return dataclasses.replace(pair, link=Link(torch.eye(3, dtype=torch.float64)))


def without_depth(pair: Pair) -> Pair:
    return dataclasses.replace(pair, depth=None)


def test_the_default_field_of_pinhole_pairs():
    assert default_field(calibrated()) == Epipolar()
    assert default_field(linked(sized())) == HomographyDisplacement(0.06 * 60)
    assert default_field(linked(calibrated())) == HomographyDisplacement(0.06 * max(calibrated().beta.hw))
    assert default_field(sized()) == Rectified(0.12 * 40, alpha_is="either")


def test_fusion_asks_for_a_depth_range():
    pair = without_depth(calibrated())
    with pytest.raises(ValueError, match="`depth: "):
        sampling_locations(default_field(pair), pair)


def test_recorded_images_are_seen_through_their_lenses():
    assert recorded_field(calibrated()) == Epipolar()
    assert recorded_field(sized()) == default_field(sized())
    assert recorded_field(linked(calibrated())) == default_field(linked(calibrated()))
    assert recorded_field(calibrated(lens=True)) == Curved(256)
    assert recorded_field(calibrated(lens=True), samples=64, nodes=16) == Curved(64, nodes=16)
    through = recorded_field(linked(calibrated(lens=True)), samples=9)
    assert through == ThroughLenses(straight_field(linked(calibrated(lens=True))), 9)
    assert default_field(calibrated(lens=True)) == Curved()


def test_drawings_need_no_depth_range():
    assert recorded_field(without_depth(calibrated())) == EpipolarLine()
    pair = without_depth(calibrated(lens=True))
    assert recorded_field(pair) == ThroughLenses(EpipolarLine(), 256)
    assert recorded_field(pair)(pair, torch.tensor([[20.0, 15.0]])).mask.any()


@pytest.mark.parametrize("name", FIELDS)
def test_fields_by_name_need_no_arguments(name):
    pair = calibrated()
    found = FIELDS[name]()(pair, torch.tensor([[20.0, 15.0]], dtype=torch.float64))
    assert (found.valid if hasattr(found, "valid") else found.mask.any(-1)).shape == (1,)
