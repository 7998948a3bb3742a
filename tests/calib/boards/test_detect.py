"""Finding boards: exact under perspective and lens, in dim, inverted, 16-bit images; why not found."""

from functools import cache

import cv2
import numpy as np
import pytest
import torch

from arraygeom import Distortion, Pose, rotation_from_vector
from calib.boards.detect import detect, explain, other_size
from calib.boards.photos import to_grey
from calib.boards.simulation import fine_rays, photograph
from calib.boards.target import parse_board
from tests.calib.board_scenes import camera, tensor

CAMERA = camera(700.0, (480, 640), lens=(-0.3, 0.1, 0.001, -0.001, 0.0))


def pose(board, turn=(18.0, -22.0, 7.0), depth=0.5):
    R = rotation_from_vector(torch.deg2rad(tensor(*turn)))
    return Pose(R, tensor(0.01, -0.01, depth) - R @ tensor(*board.points.mean(0)))


@cache
def image(text, **changes):
    """The photograph, not to be changed, and the board."""
    board = parse_board(text)
    grey = photograph(CAMERA, pose(board, **changes), board, rays=rays())
    grey.flags.writeable = False
    return grey, board


@cache
def rays():
    return fine_rays(CAMERA)


@pytest.mark.parametrize(
    ("text", "pixels"),
    [
        ("chessboard:9x6:25mm", 0.08),
        ("charuco:8x6:30mm", 0.12),
        ("circles:7x5:25mm", 0.15),
        ("acircles:4x11:16mm", 0.15),
    ],
)
def test_points_are_where_the_lens_puts_them(text, pixels):
    grey, board = image(text)
    found = detect(grey, board)
    assert found is not None
    assert len(found.ids) == len(board.points)
    ground_truth = CAMERA.project(pose(board).apply(torch.from_numpy(board.points))).x.numpy()
    errors = [np.linalg.norm(found.x - ground_truth[order[found.ids]], axis=1) for order in board.symmetries]
    assert min(np.sqrt((e**2).mean()) for e in errors) < pixels


@pytest.mark.parametrize("text", ["circles:7x5:25mm", "acircles:5x8:16mm"])
@pytest.mark.parametrize("degrees", [0.0, 120.0])
def test_circles_are_numbered_alike_however_their_board_is_turned(text, degrees):
    """OpenCV mirrors the order of some circles, and swaps the rows of each pair of asymmetric ones."""
    board = parse_board(text)
    where = pose(board, (12.0, -12.0, degrees), 0.6)
    found = detect(photograph(CAMERA, where, board, rays=rays()), board)
    ground_truth = CAMERA.project(where.apply(torch.from_numpy(board.points))).x.numpy()
    assert min(np.abs(found.x - ground_truth[order[found.ids]]).max() for order in board.symmetries) < 1


def dim(grey):
    """A dim and noisy image."""
    noisy = grey * 0.06 + np.random.default_rng(0).normal(8, 0.7, grey.shape)
    return noisy.round().clip(0, 255).astype(np.uint8)


CHANGES = {
    "inverted": lambda g: 255 - g,
    "dim and noisy": dim,
    "12 of 16 bits": lambda g: g.astype(np.uint16) * 16,
    "one channel": lambda g: g[..., None],
    "grey and alpha": lambda g: np.stack([g, np.full_like(g, 255)], -1),
    "colour": lambda g: np.stack([g, g // 2, g // 3], -1),
}


@pytest.mark.parametrize("text", ["chessboard:9x6:25mm", "charuco:8x6:30mm"])
@pytest.mark.parametrize("change", CHANGES)
def test_images_of_odd_cameras(text, change):
    grey, board = image(text)
    found, reference = detect(to_grey(CHANGES[change](grey)), board), detect(grey, board)
    off = found.x - reference.x[np.searchsorted(reference.ids, found.ids)]
    assert np.sqrt((off**2).sum(1).mean()) < 0.25


def test_a_part_of_a_charuco_board_is_enough():
    grey, board = image("charuco:8x6:30mm", depth=0.25)
    found = detect(grey, board)
    assert 8 <= len(found.ids) < len(board.points)


def oblique(board, tilt):
    """A view through a wide-angle lens, by ray casting, and the true corners."""
    K, D = np.array([[574.0, 0, 629], [0, 574, 382], [0, 0, 1]]), np.array([-0.312, 0.127, 0, 0, -0.027])
    scale, (h, w) = 40, (800, 1280)
    sheet = cv2.copyMakeBorder(board.opencv.generateImage((31 * 40, 16 * 40)), *[40] * 4, 0, value=255)
    R = cv2.Rodrigues(np.array([tilt, 0.0, 0.0]))[0]
    t = np.array([0, 0, 0.75]) - R @ np.array([31, 16, 0]) * board.spacing / 2
    pixels = (np.stack(np.meshgrid(np.arange(2 * w), np.arange(2 * h)), -1).reshape(-1, 1, 2) + 0.5) / 2 - 0.5
    lens = Distortion("brown-conrady", torch.from_numpy(D))
    straight, inside = lens.undistort(torch.from_numpy((pixels[:, 0] - K[:2, 2]) / K[0, 0]))
    rays, inside = np.c_[straight.numpy(), np.ones(len(pixels))], inside.numpy()
    along, origin = rays @ R, -R.T @ t
    depth = -origin[2] / along[:, 2]
    there = (origin + depth[:, None] * along)[:, :2] / board.spacing * scale + scale - 0.5
    there = np.where(((depth > 0) & inside)[:, None], there, -100).astype(np.float32).reshape(2 * h, 2 * w, 2)
    fine = cv2.remap(sheet, there, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=90)
    corners = board.opencv.getChessboardCorners().astype(np.float64)
    x = cv2.projectPoints(corners, cv2.Rodrigues(R)[0], t, K, D)[0][:, 0]
    return cv2.resize(fine, (w, h), interpolation=cv2.INTER_AREA), x


def test_steep_and_wide_views_have_corners():
    """OpenCV 4.12 finds four markers in five, and drops all corners."""
    board = parse_board("charuco:31x16:49.33mm:38.46mm:4x4_250")
    grey, true = oblique(board, -1.05)
    found = detect(grey, board)
    off = np.linalg.norm(found.x - true[found.ids], axis=1)
    assert len(found.ids) > 150
    assert np.median(off) < 0.03
    assert np.quantile(off, 0.95) < 0.2


def test_no_board_is_no_board():
    grey = np.random.default_rng(0).integers(0, 255, (240, 320)).astype(np.uint8)
    assert detect(cv2.GaussianBlur(grey, (0, 0), 3), parse_board("charuco:8x6:30mm")) is None
    assert detect(cv2.GaussianBlur(grey, (0, 0), 3), parse_board("chessboard:9x6:25mm")) is None


@pytest.mark.parametrize(
    ("shown", "asked", "words"),
    [
        ("charuco:8x6:30mm", "charuco:5x4:30mm", "markers up to number"),
        ("charuco:8x6:30mm:22mm:5x5", "charuco:8x6:30mm", "not of 4x4_50: name that one"),
        ("charuco:8x6:30mm:legacy", "charuco:8x6:30mm", "':legacy'"),
        ("charuco:8x6:30mm:22mm:5x5", "charuco:8x6:30mm", "markers of the dictionary 5x5"),
        ("chessboard:9x6:25mm", "chessboard:11x8:25mm", "9x6 inner corners"),
    ],
)
def test_another_board_is_named(shown, asked, words):
    grey, _ = image(shown, turn=(8.0, -8.0, 0.0))
    board = parse_board(asked)
    assert detect(grey, board) is None
    assert words in explain([grey], board)


def test_a_board_that_other_images_confirm_is_not_doubted():
    grey, board = image("charuco:8x6:30mm", depth=0.09)
    assert detect(grey, board) is None
    assert "name" in explain([grey], board)
    for shown in (board, parse_board("chessboard:9x6:25mm")):
        assert not {"size", "name"} & {*explain([grey], shown, confirmed=True).replace("?", " ").split()}


def test_images_of_another_board_among_those_of_the_right_one_are_named():
    grey, _ = image("charuco:8x6:30mm:22mm:5x5", turn=(8.0, -8.0, 0.0))
    assert "another board" in explain([grey], parse_board("charuco:8x6:30mm"), confirmed=True)


def test_two_boards_alike_are_named():
    grey, board = image("charuco:8x6:30mm", turn=(8.0, -8.0, 0.0))
    other, _ = image("charuco:8x6:30mm", turn=(-8.0, 4.0, 10.0))
    assert "twice" in explain([np.hstack([grey, other])], board)


def test_causes_in_the_image_are_named():
    grey, board = image("charuco:8x6:30mm")
    mirrored = np.ascontiguousarray(grey[:, ::-1])
    assert detect(mirrored, board) is None
    assert "mirrored" in explain([mirrored], board)
    assert "contrast" in explain([np.full((240, 320), 90, np.uint8)], board)
    flat = np.tile(np.linspace(0, 255, 320).astype(np.uint8), (240, 1))
    assert "blurred" in explain([flat], board)


def test_a_larger_chessboard_is_noticed_though_a_part_of_it_is_found():
    grey, board = image("chessboard:9x6:25mm", turn=(8.0, -8.0, 0.0))
    assert other_size([grey, grey], parse_board("chessboard:8x6:25mm")) == "9x6"
    assert other_size([grey, grey], board) is None
    assert other_size([grey, grey], parse_board("chessboard:6x9:25mm")) is None
    assert other_size([grey, grey], parse_board("chessboard:8x6:25mm"), larger=True) == "9x6"
    assert other_size([grey, grey], parse_board("chessboard:10x7:25mm")) == "9x6"
    assert other_size([grey, grey], parse_board("chessboard:10x7:25mm"), larger=True) is None, "a patch of it"
    assert (
        other_size([grey, *np.full((2, 48, 64), 90, np.uint8)], parse_board("chessboard:8x6:25mm")) is None
    ), "the margin of a board passes for a row of it in one real image of 26"
