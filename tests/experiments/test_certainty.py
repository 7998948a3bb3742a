"""The fit of certainty: its statements hold on pairs outside the fit."""

import pytest
import torch

from experiments.evaluation.certainty import (
    Judged,
    Reliability,
    Stated,
    by_thirds,
    fitted,
    held,
    held_markdown,
    widened,
)
from pat.matching.choice import MEASURED


def judged(pair, power=2.0, condition="ideal", count=4000):
    """Matches right with this power of their first number; errors then up to a pixel, else up to 9."""
    g = torch.Generator().manual_seed(sum(map(ord, pair + condition)))
    numbers = torch.rand(count, MEASURED, generator=g)
    draw, size = torch.rand(2, count, generator=g)
    right = draw < numbers[:, 0] ** power
    return Judged(pair, condition, numbers, right, torch.where(right, size, 1 + 8 * size))


def test_pairs_that_are_alike_teach_each_other():
    found = [judged(name) for name in "abc"]
    shown = held(found, by_thirds(found, steps=200))
    assert shown["all"].stated.error < 0.03
    assert abs(shown["all"].covered - 0.9) < 0.03


def test_a_pair_does_not_teach_itself():
    found = [judged("a"), judged("b"), judged("c", 0.2)]
    assert held([found[2]], by_thirds(found, steps=200))["all"].stated.error > 0.2
    network = fitted([found[2]], steps=200)
    assert held([found[2]], lambda one: Stated.by(network, one.numbers))["all"].stated.error < 0.05


def test_intervals_are_wide_where_matches_are_doubtful():
    network = fitted([judged(name) for name in "abc"], steps=300)
    numbers = torch.full((2, MEASURED), 0.5)
    numbers[:, 0] = torch.tensor([0.1, 0.98])
    stated = Stated.by(network, numbers)
    assert stated.half_width[0] > 6
    assert stated.half_width[1] < 3


def test_intervals_are_wider_where_pairs_are_not_alike():
    found = [judged("a"), judged("b"), judged("c")]
    found[2] = found[2]._replace(error=5 * found[2].error)
    numbers = torch.full((1, MEASURED), 0.9)
    alone, wide = (
        Stated.by(network, numbers).half_width.item()
        for network in (fitted(found, steps=200), widened(found, steps=200))
    )
    assert wide > 1.3 * alone


def test_conditions_are_summed_up_for_themselves():
    found = [
        judged(name, power, condition) for name in "ab" for condition, power in (("ideal", 1.0), ("x8", 3.0))
    ]
    network = fitted([one for one in found if one.condition == "ideal"], steps=200)
    shown = held(found, lambda one: Stated.by(network, one.numbers))
    assert list(shown) == ["ideal", "x8", "all"]
    assert shown["x8"].stated.error > 0.1 > shown["ideal"].stated.error
    assert "90 % interval" in held_markdown(shown)


def test_error_of_calibration_is_that_of_the_definition():
    found = Reliability.from_samples(
        torch.tensor([0.1, 0.1, 0.9, 0.9]), torch.tensor([True, False, True, True]), bins=2
    )
    assert found.stated.tolist() == pytest.approx([0.1, 0.9])
    assert found.right.tolist() == [0.5, 1.0]
    assert found.error == pytest.approx(0.5 * 0.4 + 0.5 * 0.1)
