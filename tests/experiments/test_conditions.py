"""Conditions: how pairs are recorded, regions, methods, tables; and which pairs may be tuned on."""

import pytest
import torch

from experiments.evaluation import conditions
from experiments.evaluation.conditions import (
    CONDITIONS,
    ConditionRow,
    conditions_markdown,
    depth_errors,
    evaluate_conditions,
)
from experiments.evaluation.halves import of_half
from pat.lab.data.pairs import Disparity, StereoPair
from pat.media.colour import luminance
from pat.networks.weights import load_weights


def pair(name="pair", hw=(64, 96), disparity=8):
    """A wall at a constant disparity."""
    g = torch.Generator().manual_seed(0)
    wide = torch.rand(1, 3, hw[0] // 4, hw[1] // 4 + 8, generator=g)
    wide = torch.nn.functional.interpolate(wide, size=(hw[0], hw[1] + 32), mode="bicubic")[0].clamp(0, 1)
    truth = Disparity(torch.full(hw, float(disparity)), torch.ones(hw, dtype=torch.bool))
    left, right = wide[:, :, : hw[1]], wide[:, :, disparity : hw[1] + disparity]
    return StereoPair(name, left, right, 16.0, truth)


def test_halves_are_distinguished_by_whole_parts_of_names():
    names = [
        "2006_third/Wood1",
        "2006_third/Wood2",
        "2005_half/Bowling1x",
        "train/0001",
        "x/2006_third/Cloth1",
    ]
    pairs = [pair(name) for name in names]
    assert [p.name for p in of_half(pairs, "tune")] == [
        "2006_third/Wood1",
        "train/0001",
        "x/2006_third/Cloth1",
    ]
    assert [p.name for p in of_half(pairs, "report")] == ["2006_third/Wood2", "2005_half/Bowling1x"]
    assert len(list(of_half(pairs, "all"))) == 5


def test_rows_are_moved_down():
    moved = CONDITIONS["rows off 3 px"].right(pair().right)
    torch.testing.assert_close(moved[:, 10:60], pair().right[:, 7:57], atol=1e-5, rtol=0)


def test_alpha_weighs_the_ground_truth_which_stays_as_it_was():
    p = pair()
    task = CONDITIONS["alpha = .2/.4/.4"].recorded(p)
    torch.testing.assert_close(task.alpha, luminance(p.left, (0.2, 0.4, 0.4)))
    torch.testing.assert_close(task.ground_truth, p.left)
    assert CONDITIONS["alpha = .2/.4/.4"].noise is None


def test_random_conditions_depend_on_the_pair_alone():
    random = CONDITIONS["alpha random"]
    one, same, other = (random.recorded(pair(name)).alpha for name in ("a", "a", "b"))
    assert torch.equal(one, same)
    assert not torch.equal(one, other)


def test_fewer_electrons_are_noisier():
    p = pair()
    errors = [
        (CONDITIONS[f"{n} electrons"].recorded(p).alpha - luminance(p.left)).std() for n in (1000, 200, 50)
    ]
    assert errors[0] < errors[1] < errors[2]


def test_every_method_is_scored_under_every_condition(tmp_path):
    rows = evaluate_conditions(
        [pair()],
        load_weights("mono-colour"),
        ["ideal", "rows off 1 px", "rows off 3 px"],
    )
    ours = [row for row in rows if row.method == "fusion"]
    assert [row.condition for row in ours] == ["ideal", "rows off 1 px", "rows off 3 px"]
    as_it_is = [row for row in rows if row.method == "uncorrected"]
    assert ours[1].psnr["whole"] > as_it_is[1].psnr["whole"] + 1.0
    assert ours[0].within_one[1] > 0.9
    text = conditions_markdown(rows)
    assert "| rows off 3 px |" in text
    assert "OpenCV's SGBM" in text
    conditions.save_condition_curves(rows, tmp_path / "curves.png")
    assert (tmp_path / "curves.png").stat().st_size > 1000


def test_shares_within_a_pixel_are_of_all_and_of_what_beta_sees():
    truth = Disparity(torch.full((4, 10), 3.0), (torch.arange(10) > 0).expand(4, 10))
    found = torch.where(torch.arange(10) < 5, truth.value, 9.0)
    found[:, 1] = torch.nan
    seen = truth.valid & (torch.arange(10) < 5)
    error, shares = depth_errors(found, truth, {"seen": seen})
    assert (error, *shares) == pytest.approx((30 / 8, 12 / 36, 12 / 16))
    assert depth_errors(None, truth, {"seen": seen}) == (None, None)


def test_gains_are_of_the_same_pairs():
    rows = [
        ConditionRow(name, "ideal", method, 0.9, {"whole": value})
        for name, method, value in (
            ("a", "classical", 30.0),
            ("a", "fusion", 31.0),
            ("b", "fusion", 25.0),
            ("b", "classical", 22.0),
        )
    ]
    assert "+2.00" in conditions_markdown(rows)


def test_an_unknown_condition_is_refused():
    with pytest.raises(KeyError):
        evaluate_conditions([pair()], load_weights("mono-colour"), ["fog"])
