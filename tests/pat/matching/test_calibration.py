"""Calibration of confidence: probabilities that hold, intervals that cover."""

import pytest
import torch

from pat.matching.calibration import ConfidenceCalibration, depth_interval, fit_calibration, reliability


def matches(count=200_000, seed=0):
    """Matches that are right with the square of their confidence; their errors are then up to a pixel, else
    up
    to 9."""
    g = torch.Generator().manual_seed(seed)
    confidence, draw, size = torch.rand(3, count, generator=g)
    right = draw < confidence.square()
    return confidence, torch.where(right, size, 1 + 8 * size), torch.ones(count, dtype=torch.bool)


def test_probability_is_the_share_that_is_right():
    found = fit_calibration(*matches())
    x = torch.linspace(0.05, 0.95, 10)
    assert (found.probabilities(x) - x.square()).abs().max() < 0.02


def test_calibrated_on_some_matches_others_have_little_error():
    confidence, error, _ = matches(seed=1)
    raw = reliability(confidence, error <= 1)
    calibrated = reliability(fit_calibration(*matches()).probabilities(confidence), error <= 1)
    assert raw.error > 0.15
    assert calibrated.error < 0.01


def test_intervals_cover_nine_of_ten_at_every_confidence():
    confidence, error, _ = matches(seed=1)
    covered = error <= fit_calibration(*matches()).half_widths(confidence)
    for low in (0.0, 0.3, 0.6, 0.9):
        part = covered[(confidence >= low) & (confidence < low + 0.1)]
        assert abs(float(part.float().mean()) - 0.9) < 0.02


def test_what_beta_does_not_see_is_not_right_however_near():
    confidence, error, same = matches()
    found = fit_calibration(confidence, error, ~same)
    assert found.probabilities(torch.tensor([0.1, 0.9])).tolist() == [0, 0]


def test_probability_never_falls_nor_width_rises():
    confidence, error, same = (x[:400] for x in matches())
    found = fit_calibration(confidence, error, same)
    x = torch.linspace(0, 1, 500)
    assert (found.probabilities(x).diff() >= 0).all()
    assert (found.half_widths(x).diff() <= 0).all()


def test_error_of_calibration_is_that_of_the_definition():
    stated = torch.tensor([0.1, 0.1, 0.9, 0.9])
    found = reliability(stated, torch.tensor([True, False, True, True]), bins=2)
    assert found.stated.tolist() == pytest.approx([0.1, 0.9])
    assert found.right.tolist() == [0.5, 1.0]
    assert found.error == pytest.approx(0.5 * 0.4 + 0.5 * 0.1)


def test_one_confidence_for_all_cannot_be_calibrated():
    with pytest.raises(ValueError, match="different confidence"):
        fit_calibration(torch.ones(10), torch.zeros(10), torch.ones(10, dtype=torch.bool))


def test_a_calibration_is_of_rising_confidences():
    with pytest.raises(ValueError, match="rise"):
        ConfidenceCalibration((0.5, 0.5), (0.1, 0.2), (1.0, 1.0))
    with pytest.raises(ValueError, match="one length"):
        ConfidenceCalibration((0.1, 0.5), (0.1,), (1.0, 1.0))


def test_depth_interval_of_a_rectified_pair():
    near, far = depth_interval(*(torch.tensor([x]) for x in (5.0, 50.0, 1.0)))
    assert near.item() == pytest.approx(50 / 11)
    assert far.item() == pytest.approx(50 / 9)
    assert depth_interval(*(torch.tensor([x]) for x in (5.0, 50.0, 10.0)))[1].item() == torch.inf
