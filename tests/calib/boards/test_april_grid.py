"""AprilGrids as Kalibr lays them out, several boards at once, paper."""

import cv2
import numpy as np
import pytest
import torch

from arraygeom import Pose, Rig
from calib.boards.detect import collect_folder, detect, explain
from calib.boards.rig import calibrate
from calib.boards.simulation import photograph, printed
from calib.boards.target import draw_board, page_note, parse_board, parse_boards
from tests.calib.board_scenes import board_poses, camera, tensor

GRID = parse_board("aprilgrid:5x4:50mm:0.3")
CODE = 0xD5D628584
"""Of the first tag of 36h11, most significant bit first, as the family's authors publish it."""


KALIBR = "target_type: 'aprilgrid'\ntagCols: 5\ntagRows: 4\ntagSize: 0.05\ntagSpacing: 0.3\n"


def pose(x=-0.15, y=-0.12, z=0.5):
    return Pose(torch.eye(3, dtype=torch.float64), tensor(x, y, z))


def test_corners_of_tags_are_found_where_they_are():
    c = camera(700.0, (480, 640), lens=(-0.2, 0.05, 0, 0, 0))
    found = detect(photograph(c, pose(), GRID), GRID)
    x = c.project_local(pose().apply(torch.from_numpy(GRID.points[found.ids]))).x.numpy()
    assert len(found.ids) > 70
    assert np.abs(found.x - x).max() < 0.1


def test_tags_are_printed_as_kalibr_prints_them():
    """The first tag is at the lower left, upright as published: read from the print bit by bit."""
    grey, per_metre, origin = printed(GRID, 100)
    centres = (np.arange(6) + 2.5) * GRID.tag / 10
    left, top = GRID.points[GRID.corners[0][0], :2]
    columns, rows = (
        np.rint((first + centres) * per_metre + offset).astype(int)
        for first, offset in zip((left, top), origin)
    )
    white = grey[np.ix_(rows, columns)] > 127
    assert (white.ravel() == [bool(CODE >> (35 - i) & 1) for i in range(36)]).all()
    assert top > GRID.points[:, 1].max() - 1.5 * GRID.tag


def test_other_ways_up_are_recognised():
    c = camera(700.0, (480, 640))
    image = photograph(c, pose(), GRID)
    found = detect(np.ascontiguousarray(image[::-1, ::-1]), GRID)
    upright = detect(image, GRID)
    _, i, j = np.intersect1d(found.ids, upright.ids, return_indices=True)
    assert np.abs(found.x[i] - ([639, 479] - upright.x[j])).max() < 0.1
    assert len(i) > 70


def test_kalibrs_target_file(tmp_path):
    (tmp_path / "april.yaml").write_text(KALIBR)
    assert str(parse_board(str(tmp_path / "april.yaml"))) == str(GRID) == "aprilgrid:5x4:50mm:0.3"
    (tmp_path / "other.yaml").write_text("target_type: circlegrid\n")
    with pytest.raises(ValueError, match=r"other\.yaml"):
        parse_board(str(tmp_path / "other.yaml"))
    with pytest.raises(FileNotFoundError, match=r"none\.yaml"):
        parse_board(str(tmp_path / "none.yaml"))


def test_mirrored_images_and_other_borders_are_explained():
    image = photograph(camera(700.0, (480, 640)), pose(), GRID)
    assert "once the image is mirrored" in explain([np.ascontiguousarray(image[:, ::-1])], GRID)
    assert "add ':border2'" in explain([image], parse_board("aprilgrid:5x4:50mm:0.3:border1"))


def test_another_size_of_a_grid_is_explained():
    image = photograph(camera(700.0, (480, 640)), pose(), parse_board("aprilgrid:5x4:50mm:0.3:border1"))
    said = explain([image], parse_board("aprilgrid:4x6:50mm:0.3:border1"))
    assert "not at their positions" in said
    assert said.endswith("is the size right (across x down)?")


def test_two_boards_in_one_image(tmp_path):
    """Each board has its own poses; together they cover more."""
    boards = parse_boards(["charuco:6x5:40mm:30mm:5x5", "charuco:6x5:40mm:30mm:5x5:from15"])
    rig = Rig({"a": camera(420.0, (300, 400)), "b": camera(400.0, (300, 400), (0.1, 0, 0), (0, -4, 0))})
    poses = board_poses(6, depth=(0.7, 1.0), spread=0.02, tilt=30)
    for name, c in rig.cameras.items():
        (tmp_path / name).mkdir()
        for i in range(6):
            shots = []
            for side, board in zip((-0.17, 0.17), boards.members):
                place = Pose(poses.R[i], poses.t[i] + tensor(0.12 + side, 0.1, 0.0))
                shots.append(photograph(c, c.cam_from_world @ place, board))
            both = np.where(shots[0] == 90, shots[1], shots[0])
            cv2.imwrite(str(tmp_path / name / f"{i}.png"), both)
    views = collect_folder(tmp_path, boards).views
    assert {0, "0 board 2"} <= set(views["a"].seen)
    found = calibrate(views, boards)
    assert float((found.rig["b"].centre - rig["b"].centre).norm()) < 2e-3
    assert found.rms < 0.1


def test_boards_that_share_markers_are_refused():
    with pytest.raises(ValueError, match=":from15"):
        parse_boards(["charuco:6x5:40mm", "charuco:6x5:30mm"])
    with pytest.raises(ValueError, match=":from15"):  # larger dictionaries begin with the smaller one's
        parse_boards(["charuco:6x5:40mm", "charuco:6x5:30mm:20mm:4x4_100"])
    with pytest.raises(ValueError, match="chessboard:6x5:30mm"):
        parse_boards(["charuco:6x5:40mm", "chessboard:6x5:30mm"])
    with pytest.raises(ValueError, match="board"):
        parse_boards([])


def test_paper():
    board = parse_board("charuco:8x5:30mm")
    assert "print it on A4 or larger at 100 %" in page_note(board)
    assert draw_board(board, paper="A4").get_size_inches() * 25.4 == pytest.approx([297, 210])
    with pytest.raises(ValueError, match=r"A4.*A3"):
        draw_board(parse_board("charuco:10x8:30mm"), paper="A4")
