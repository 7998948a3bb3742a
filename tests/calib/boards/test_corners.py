"""Corners by how they look: where they are, whatever gamma, noise and what hides them."""

from functools import cache

import cv2
import numpy as np
import pytest
import torch

from arraygeom import Pose, rotation_from_vector
from calib.boards.corners import refine_corners, smooth_map
from calib.boards.simulation import fine_rays, photograph
from calib.boards.target import parse_board
from tests.calib.board_scenes import camera, tensor

CAMERA = camera(600.0, (480, 640), lens=(-0.25, 0.08, 0.001, -0.001, 0.0))
CLEAR = {"chessboard:9x6:25mm": 0.5, "charuco:9x7:25mm": 0.125}
RANDOM = np.random.default_rng(0)
SEEDED = RANDOM.bit_generator.state


@pytest.fixture(autouse=True)
def the_same_draws_in_any_order():
    """Each test draws as if it were the first: alone, or after others."""
    RANDOM.bit_generator.state = SEEDED


@cache
def rays():
    return fine_rays(CAMERA)


@cache
def rendered(text):
    """A board, its pose, and an image of it without noise."""
    board = parse_board(text)
    R = rotation_from_vector(torch.deg2rad(tensor(24.0, -28.0, 9.0)))
    pose = Pose(R, tensor(0.01, -0.005, 0.34) - R @ tensor(*board.points.mean(0)))
    return board, pose, photograph(CAMERA, pose, board, rays=rays()).astype(float)


def seen(text, *, noise=1.5):
    """An image of a board, its true corners, and their positions in squares."""
    board, pose, image = rendered(text)
    grey = (image + RANDOM.normal(0, noise, image.shape)).round().clip(0, 255).astype(np.uint8)
    ground_truth = CAMERA.project(pose.apply(torch.from_numpy(board.points))).x.numpy()
    inside = ((ground_truth > 12) & (ground_truth < np.array(grey.shape)[::-1] - 13)).all(1)
    return grey, ground_truth[inside], board.points[inside, :2] / board.spacing


def rms(error):
    return float(np.sqrt((error**2).sum(1).mean()))


@pytest.mark.parametrize("text", list(CLEAR))
def test_corners_return_from_a_pixel_off(text):
    grey, ground_truth, p = seen(text)
    start = ground_truth + RANDOM.normal(0, 0.5, ground_truth.shape)
    found, good = refine_corners(grey, start, p, clear=CLEAR[text])
    by_gradients = cv2.cornerSubPix(
        grey, ground_truth.astype(np.float32)[:, None].copy(), (3, 3), (-1, -1), (3, 60, 1e-4)
    ).reshape(-1, 2)
    assert good.mean() > 0.95
    off = np.linalg.norm((found - ground_truth)[good], axis=1)
    assert np.median(off) < 0.012
    assert rms((found - ground_truth)[good]) < 0.04
    assert np.abs((found - ground_truth)[good].mean(0)).max() < 0.01
    assert np.median(off) < 0.3 * np.median(np.linalg.norm(by_gradients - ground_truth, axis=1))


@pytest.mark.parametrize(
    ("change", "pixels"), [(lambda v: 255 * (v / 255) ** 0.4, 0.04), (lambda v: 255 - v, 0.012)]
)
def test_gamma_and_inversion_hardly_move_corners(change, pixels):
    grey, ground_truth, p = seen("chessboard:9x6:25mm", noise=0.0)
    found, good = refine_corners(change(grey.astype(float)).round().astype(np.uint8), ground_truth, p)
    assert good.all()
    assert np.median(np.linalg.norm(found - ground_truth, axis=1)) < pixels


def test_a_hidden_corner_is_named_and_the_others_stay():
    grey, ground_truth, p = seen("charuco:9x7:25mm")
    hidden = len(ground_truth) // 2
    cv2.circle(grey, np.rint(ground_truth[hidden]).astype(int).tolist(), 9, 120, -1)
    found, good = refine_corners(grey, ground_truth, p, clear=0.125)
    assert not good[hidden]
    assert good.sum() >= len(good) - 3
    assert rms((found - ground_truth)[good]) < 0.04
    assert (found[hidden] == ground_truth[hidden]).all()


def test_corners_too_close_to_see_are_left_alone():
    small = cv2.resize(seen("chessboard:9x6:25mm")[0], (60, 45), interpolation=cv2.INTER_AREA)
    _, ground_truth, p = seen("chessboard:9x6:25mm")
    x = ground_truth * 60 / 640
    found, good = refine_corners(small, x, p)
    assert not good.any()
    assert (found == x).all()


def test_the_map_of_the_board_is_smooth_and_minds_no_outlier():
    _, ground_truth, p = seen("charuco:9x7:25mm")
    off = ground_truth.copy()
    off[5] += 20
    board = smooth_map(p, off, np.ones(len(p), dtype=bool))
    assert rms(board(p) - ground_truth) < 0.1
