"""Calibration of confidence on pairs: each is judged by what the others taught."""

import torch

from pat.evaluation.calibration import Judged, calibration_markdown, calibration_of, held_out


def judged(pair, power, condition="ideal", count=40_000):
    """Matches that are right with this power of their confidence."""
    g = torch.Generator().manual_seed(sum(map(ord, pair + condition)))
    confidence, draw, size = torch.rand(3, count, generator=g)
    error = torch.where(draw < confidence**power, size, 1 + 8 * size)
    return Judged(pair, condition, confidence, error, torch.ones(count, dtype=torch.bool))


def test_pairs_that_are_alike_teach_each_other():
    held = held_out([judged(name, 2.0) for name in "abc"])
    assert held["all"].raw.error > 0.15
    assert held["all"].calibrated.error < 0.02
    assert abs(held["all"].covered - 0.9) < 0.02


def test_a_pair_does_not_teach_itself():
    held = held_out([judged("a", 2.0), judged("b", 2.0), judged("c", 0.2)])
    alone = calibration_of([judged("c", 0.2)])
    assert held["all"].calibrated.error > 0.05
    assert alone.probabilities(torch.tensor([0.2])).item() > 0.6


def test_conditions_are_summed_up_for_themselves():
    powers = {"ideal": 1.0, "x8": 3.0}
    found = [judged(name, power, condition) for name in "ab" for condition, power in powers.items()]
    held = held_out(found)
    assert list(held) == ["ideal", "x8", "all"]
    assert held["x8"].raw.error > held["ideal"].raw.error
    assert "90 % interval" in calibration_markdown(held)
