"""Bent or stretched boards: found, modelled, said; flat ones stay flat; frames that do not fit are named."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from arraygeom import Pose
from calib.boards.deformation import BoardDeformation
from calib.boards.detect import BoardViews, Detection, detect
from calib.boards.rig import calibrate
from calib.boards.target import parse_board
from calib.boards.uncertainty import jackknife
from tests.calib.bent import photograph_bent
from tests.calib.board_scenes import BOARD, board_poses, camera, errors_of, see
from tests.calib.boards.test_rig import pair_rig, with_seen

CYLINDER = (0.0, 0.5, 0.0, 0.0)
"""A radius of 2 m."""


def shaped(values, board=BOARD):
    flat = BoardDeformation.flat(board.middle[None, :2], np.zeros(1, dtype=int))
    return replace(flat, values=np.array([values]))


def seen_of(values, *, count=14, seed=3, noise=0.1):
    class Bent:
        points = shaped(values).deformed(BOARD.points, BOARD.part)

    return see(pair_rig(), board_poses(count, seed=seed), Bent, noise=noise)


FLAT = (0.0, 0.0, 0.0, 0.0)


@cache
def calibrated(values, **options):
    """Calibrate with boards of a shape, `seen_of` them."""
    return calibrate(seen_of(values, **options), BOARD)


def test_a_cylinder_keeps_the_lengths_on_it():
    """The third-order formula against the exact cylinder."""
    p = BOARD.points
    bent = shaped(CYLINDER).deformed(p, BOARD.part)
    middle = (p[:, 0].max() + p[:, 0].min()) / 2
    u = p[:, 0] - middle
    assert np.abs(bent[:, 0] - middle - 2 * np.sin(u / 2)).max() < 1e-6
    assert np.abs(bent[:, 2] - 2 * (1 - np.cos(u / 2))).max() < 1e-6
    assert (bent[:, 1] == p[:, 1]).all()


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (
            CYLINDER,
            r"the board is bent: its middle lies 1\d\.\d+ ± .* mm in front of its edges \(radius 2.0\d m\)",
        ),
        (
            (0.003, 0.0, 0.0, 0.0),
            r"the board is stretched: squares are 0\.[23]\d ± .* % longer down than across",
        ),
        ((0.0, -0.1, 0.0, 0.0), r"the board is bent: its middle lies [23]\.\d+ ± .* mm behind"),
        (
            (0.25, 0.0, 0.0, 0.0),
            r"the board is stretched: squares are 2[45]\.\d+ ± .* % longer down than across",
        ),
    ],
)
def test_shapes_are_found_modelled_and_said(values, said):
    found = calibrated(values)
    estimate = found.fit.problem.deformation.values[0]
    assert np.abs(estimate - values)[0] < 0.001
    assert np.abs(estimate - values)[1:].max() < 0.02
    assert any(re.search(said, note) for note in found.notes), found.notes
    error = errors_of(found.fit, pair_rig())
    assert np.abs(error / np.sqrt(found.fit.covariance.diagonal())).max() < 5
    assert found.rms < 0.15


def test_six_frames_of_a_board_with_oblong_squares():
    found = calibrate(seen_of([0.05, 0.0, 0.0, 0.0], count=6), BOARD)
    assert found.fit.problem.deformation.values[0, 0] == pytest.approx(0.05, abs=1e-3)
    assert found.rms < 0.15
    assert calibrate(seen_of(FLAT, count=6), BOARD).fit.problem.deformation is None


def test_flat_boards_stay_flat():
    found = calibrated(FLAT)
    assert found.fit.problem.deformation is None
    assert not any("board is" in note for note in found.notes)


def test_a_rendered_cylinder_projects_where_it_should():
    board, c = parse_board("charuco:9x7:40mm"), camera(700.0, (480, 640), lens=(-0.2, 0.05, 0, 0, 0))
    pose = Pose(torch.eye(3, dtype=torch.float64), torch.tensor([-0.16, -0.12, 0.6], dtype=torch.float64))
    shape = shaped([0.003, 0.3, 0.2, 0.1], board)
    found = detect(photograph_bent(c, pose, board, shape), board)
    X = torch.from_numpy(shape.deformed(board.points, board.part)[found.ids])
    assert len(found.ids) > 40
    assert np.abs(c.project_local(pose.apply(X)).x.numpy() - found.x).max() < 0.1
    flat = c.project_local(pose.apply(torch.from_numpy(board.points[found.ids]))).x.numpy()
    assert np.abs(flat - found.x).max() > 1


def test_frames_that_do_not_fit_are_named():
    views = seen_of(FLAT)
    d = views["mono"].seen[5]
    torn = d.x + np.random.default_rng(0).normal(0, 0.35, d.x.shape)
    found = calibrate(with_seen(views, "mono", {**views["mono"].seen, 5: Detection(d.ids, torn)}), BOARD)
    (note,) = [note for note in found.notes if "do not fit" in note]
    assert note.startswith("mono: frames that do not fit: 5 (0.")


def test_every_frame_is_held_out_once():
    found = calibrated(FLAT)
    assert len(found.held_out["mono", "colour"]) == len(found.epipolar["mono", "colour"])


def test_the_covariance_over_frames_is_that_of_the_noise_where_nothing_else_is():
    """A plain jackknife is too large by a fifth and more; the stated one is corrected for it."""
    factors, plain = [], []
    for fit in (calibrated(FLAT).fit, *(calibrated(FLAT, seed=seed).fit for seed in range(3))):
        found = jackknife(fit.problem)
        for part, into in ((found.covariance, factors), (found.left_out, plain)):
            into.append(np.sqrt(np.trace(np.linalg.solve(fit.covariance, part)) / len(part)))
    assert 0.8 < np.mean(factors) < 1.15 < np.mean(plain)


def test_leaving_a_frame_out_keeps_the_others():
    problem = calibrated(CYLINDER).fit.problem
    kept = np.arange(len(problem.frames)) != 3
    part = problem.of_boards(kept)
    assert len(part.frames) == len(problem.frames) - 1 == len(part.deformation.part)
    before, after = problem.residuals["mono"], part.residuals["mono"]
    assert np.allclose(before[problem.seen["mono"].block != 3], after)


@pytest.mark.slow
def test_a_rendered_cylinder_is_recovered():
    """A board bent about 2 m, and printed 0.3 % too long, by photographs of it."""
    board, c = parse_board("charuco:9x7:40mm"), camera(700.0, (480, 640), lens=(-0.2, 0.05, 0, 0, 0))
    shape, poses = shaped([0.003, 0.5, 0.0, 0.0], board), board_poses(14, depth=(0.5, 0.9), spread=0.1)
    seen = {}
    for i in range(14):
        middle = poses.R[i] @ torch.from_numpy(board.points.mean(0) - BOARD.points.mean(0))
        pose = Pose(poses.R[i], poses.t[i] - middle)
        seen[i] = detect(photograph_bent(c, pose, board, shape), board)
    found = calibrate({"c": BoardViews(c.hw, {i: d for i, d in seen.items() if d is not None})}, board)
    assert np.abs(found.fit.problem.deformation.values[0] - [0.003, 0.5, 0.0, 0.0]).max() < 0.03
    assert float(found.rig["c"].K[0, 0]) == pytest.approx(700, rel=0.005)
