"""Boards: their names, their points, and prints of true size that the detector finds where they say."""

import re

import numpy as np
import pytest

from calib.boards.detect import detect
from calib.boards.simulation import printed
from calib.boards.target import Charuco, draw_board, parse_board, write_board


@pytest.mark.parametrize(
    "text",
    [
        "chessboard:9x6:25mm",
        "charuco:8x6:30mm:22.5mm:4x4_50",
        "charuco:8x6:30mm:20mm:5x5_50:legacy",
        "circles:7x5:20mm",
        "acircles:4x11:20mm",
    ],
)
def test_names_read_back(text):
    assert str(parse_board(text)) == text


def test_lengths_and_counts_mean_what_they_say():
    board = parse_board("charuco:8x6:1.5cm")
    assert isinstance(board, Charuco)
    assert (board.columns, board.rows) == (7, 5)
    assert (board.spacing, board.marker) == pytest.approx((0.015, 0.01125))
    assert parse_board("chessboard:9x6:1in").points[-1] == pytest.approx([8 * 0.0254, 5 * 0.0254, 0])
    assert len(parse_board("charuco:8x6:30mm").opencv.getChessboardCorners()) == len(board.points)


def test_points_are_numbered_as_opencv_numbers_them():
    board = parse_board("charuco:8x6:30mm")
    theirs = np.array(board.opencv.getChessboardCorners()) - [board.spacing, board.spacing, 0]
    assert np.abs(theirs - board.points).max() < 1e-8


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("charuko:8x6:30mm", "charuko:8x6:30mm"),
        ("charuco", "'charuco'"),
        ("chessboard:9by6:25mm", "'9by6'"),
        ("chessboard:9x6:25", "'25'"),
        ("chessboard:9x6:0mm", "'0mm'"),
        ("chessboard:2x6:25mm", "2x6"),
        ("chessboard:9x6:25mm:4x4", "'4x4'"),
        ("charuco:8x6:30mm:30mm", "30mm"),
        ("charuco:8x6:30mm:9x9", "'9x9'"),
        ("charuco:40x40:30mm:4x4_50", "800 markers"),
        ("charuco:3x4:30mm", "6 inner corners and 8 is the least"),
        ("charuco:8x6:30mm:30mm", "charuco:8x6:30mm:30mm"),
        ("charuco:8x6:30mm:22mm:blue", "'blue'"),
        ("charuco:8x6:30mm:22mm:blue", "charuco:8x6:30mm:22mm:4x4_50 (squares, markers, dictionary)"),
        ("charuco:8x6:30mm:22mm:20mm", "'22mm' and '20mm' say the same: give one"),
        ("aprilgrid:6x6:88mm:0.3:border1:border2", "'border1' and 'border2' say the same: give one"),
        ("aprilgrid:6x6:88mm:1.5", "'1.5' is not from 0.05 to 1 of a tag"),
    ],
)
def test_wrong_names_are_explained(text, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        parse_board(text)


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("chessboard:9x6:25mm", 2),
        ("chessboard:6x6:25mm", 4),
        ("charuco:8x6:30mm", 1),
        ("circles:7x5:20mm", 2),
        ("acircles:4x11:20mm", 1),
    ],
)
def test_symmetries_are_rotations_of_the_points(text, count):
    board = parse_board(text)
    assert len(board.symmetries) == count
    assert (board.symmetries[0] == np.arange(len(board.points))).all()
    for image in board.symmetries:
        moved = board.points[image]
        distances = [np.linalg.norm(p[:, None] - p[None], axis=-1) for p in (board.points, moved)]
        assert np.abs(distances[0] - distances[1]).max() < 1e-12


@pytest.mark.parametrize(
    "text",
    [
        "chessboard:9x6:25mm",
        "charuco:8x6:30mm",
        "charuco:7x6:30mm:20mm:5x5",
        "charuco:8x6:30mm:legacy",
        "circles:7x5:20mm",
        "acircles:4x11:15mm",
    ],
)
def test_prints_are_found_where_they_say(text):
    """Millimetres on paper, through the detector, to a fiftieth of a millimetre."""
    board = parse_board(text)
    grey, per_metre, origin = printed(board, 150)
    found = detect(grey, board)
    assert found is not None
    assert len(found.ids) == len(board.points)
    expected = [board.points[image[found.ids], :2] * per_metre + origin for image in board.symmetries]
    assert min(np.abs(found.x - e).max() for e in expected) < 0.02e-3 * per_metre


def test_files_have_the_true_size(tmp_path):
    board = parse_board("charuco:8x6:30mm")
    width, height = (72 / 25.4 * (1e3 * v + 24 + extra) for v, extra in zip(board.extent, (0, 14)))
    pdf = write_board("charuco:8x6:30mm", tmp_path / "b.pdf").read_bytes()
    box = re.search(rb"/MediaBox \[ ?0 0 ([\d.]+) ([\d.]+)", pdf)
    assert [float(v) for v in box.groups()] == pytest.approx([width, height], abs=0.01)
    svg = write_board("charuco:8x6:30mm", tmp_path / "b.svg").read_text()
    size = re.search(
        r'<svg [^>]*?width="([\d.]+)pt" height="([\d.]+)pt"|height="([\d.]+)pt"[^>]*width="([\d.]+)pt"', svg
    )
    assert sorted(float(v) for v in size.groups() if v) == pytest.approx(sorted([width, height]), abs=0.01)


def test_a_image_is_no_print(tmp_path):
    with pytest.raises(ValueError, match=r"b\.png"):
        write_board("charuco:8x6:30mm", tmp_path / "b.png")


def test_legacy_boards_differ():
    new, old = (printed(parse_board(f"charuco:8x6:30mm{tail}"), 72)[0] for tail in ("", ":legacy"))
    assert (new != old).mean() > 0.2


def test_the_figure_is_as_large_as_the_board():
    board = parse_board("chessboard:9x6:25mm")
    assert draw_board(board).get_size_inches() * 25.4 == pytest.approx([274, 213])


@pytest.mark.parametrize("marker", [0.0, 0.03, 0.05])
def test_markers_that_do_not_fit_are_refused(marker):
    with pytest.raises(ValueError, match="charuco"):
        Charuco(7, 5, 0.03, "4x4_50", range(24), marker=marker)
