"""Photographs of boards never printed: corners at their projections."""

import numpy as np
import pytest
import torch

from arraygeom import Pose, Rig
from calib.boards.detect import collect_folder
from calib.boards.simulation import board_poses, photograph, simulate_photos
from calib.boards.target import parse_board
from tests.calib.board_scenes import camera

BOARD = parse_board("charuco:7x5:60mm")


@pytest.fixture(scope="module")
def rig():
    return Rig(
        {
            "a": camera(330.0, (240, 320), lens=(-0.2, 0.05, 0, 0, 0)),
            "b": camera(260.0, (220, 300), (0.15, 0.02, 0), (0, -6, 1)),
        }
    )


@pytest.fixture(scope="module")
def rehearsed(rig, tmp_path_factory):
    folder = tmp_path_factory.mktemp("photos")
    return simulate_photos(rig, BOARD, folder, count=7, seed=3), collect_folder(folder, BOARD).views


def test_corners_are_where_the_cameras_put_them(rig, rehearsed):
    boards, views = rehearsed
    for name, seen in views.items():
        off = []
        for frame, found in seen.seen.items():
            X = boards[frame].apply(torch.from_numpy(BOARD.points))
            off.append(found.x - rig[name].project(X).x.numpy()[found.ids])
        off = np.concatenate(off)
        assert np.abs(off.mean(0)).max() < 0.03
        assert off.std() < 0.3


def test_boards_are_tilted_and_at_several_depths(rig):
    boards = board_poses(rig, BOARD, 20)
    depth = boards.apply(torch.zeros(20, 1, 3, dtype=torch.float64))[..., 2].flatten()
    assert float(depth.max() / depth.min()) > 1.7
    normals = boards.R[..., 2]
    assert float((normals @ normals.T).min()) < np.cos(np.radians(30))
    again = board_poses(rig, BOARD, 20)
    assert torch.equal(boards.t, again.t)


def test_images_that_are_turned_show_boards_as_large(rig):
    """The focal length of a turned image is beside K's diagonal; the board's distance follows from it."""
    turned = Rig({name: c.rot90(1) for name, c in rig.cameras.items()})
    depths = [board_poses(each, BOARD, 8).t[:, 2].mean() for each in (rig, turned)]
    assert 0.5 < depths[1] / depths[0] < 2


def test_cameras_with_no_common_view_are_named(rig, monkeypatch):
    monkeypatch.setattr("calib.boards.simulation.TRIES", 200)
    apart = Rig({"a": rig["a"], "b": camera(260.0, (220, 300), (5.0, 0, 0), (0, 170, 0))})
    with pytest.raises(ValueError, match="charuco:7x5:60mm"):
        board_poses(apart, BOARD, 3)


def test_what_is_behind_a_camera_is_not_seen(rig):
    behind = Pose(torch.eye(3, dtype=torch.float64), torch.tensor([0.0, 0, -1.0], dtype=torch.float64))
    assert np.ptp(photograph(rig["b"], behind, BOARD)) == 0


def test_a_rig_of_an_optimiser_is_photographed(rig, tmp_path):
    free = Rig({name: c.replace(K=c.K.clone().requires_grad_()) for name, c in rig.cameras.items()})
    boards = simulate_photos(free, BOARD, tmp_path, count=1)
    assert not boards.t.requires_grad
    assert (tmp_path / "a/000.png").is_file()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"count": 0}, "count"),
        ({"noise": -1.0}, "noise"),
        ({"noise": float("nan")}, "noise"),
    ],
)
def test_bad_numbers_are_refused_before_anything_is_written(rig, tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        simulate_photos(rig, BOARD, tmp_path, **options)
    assert not list(tmp_path.iterdir())
