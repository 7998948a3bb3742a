"""Markers at known positions as a target: their file, detection, and rigs from one image a camera."""

import cv2
import numpy as np
import pytest
import torch

from arraygeom import Pose, Rig, rotation_from_vector
from calib.boards.adequacy import coverage_advice
from calib.boards.board import marker_dictionary
from calib.boards.detect import detect, explain
from calib.boards.rig import calibrate
from calib.boards.simulation import printed
from calib.boards.target import parse_board, parse_boards
from tests.calib.board_scenes import errors_of, four_cameras, see


@pytest.fixture
def room(tmp_path):
    """Forty markers on the walls of a corner, two metres away."""
    return parse_board(str(written(tmp_path, in_a_room(40))))


def in_a_room(count, relief=0.6):
    random = np.random.default_rng(0)
    return np.column_stack([random.uniform(-0.7, 0.7, (count, 2)), random.uniform(-relief, relief, count)])


def written(folder, points, head="id,x,y,z"):
    lines = [f"{i},{x:.6f},{y:.6f},{z:.6f}" for i, (x, y, z) in enumerate(points)]
    path = folder / "Targets.csv"
    path.write_text("\n".join([head, *lines]) + "\n")
    return path


def seen(board, count=1, noise=0.1):
    rig = Rig({name: four_cameras()[name] for name in ("mono", "colour")})
    turn, shift = (np.linspace(*ends, count)[:, None] * np.ones(3) for ends in ((-0.5, 0.5), (0.0, 0.2)))
    R = rotation_from_vector(torch.from_numpy(turn))
    return rig, see(rig, Pose(R, torch.from_numpy(shift + np.array([0, 0, 2.2]))), board, noise=noise)


def test_a_room_has_no_print(room):
    with pytest.raises(ValueError, match=r"Targets\.csv"):
        printed(room, 50)


def test_another_dictionary_is_asked_for(room):
    grey = np.random.default_rng(0).integers(0, 256, (240, 320)).astype(np.uint8)
    assert explain([grey], room) == (
        "0 of its markers are visible, too few, all on a line, or not of 4x4_50: name their dictionary"
    )


def test_one_image_of_a_room_is_enough(room):
    rig, views = seen(room)
    found = calibrate(views, room)
    errors = errors_of(found.fit, rig) / np.sqrt(found.fit.covariance.diagonal())
    assert len(found.frames) == 1
    assert np.abs(errors).max() < 4
    assert float((found.rig["colour"].centre - rig["colour"].centre).norm()) < 0.01
    assert found.rig["mono"].K[0, 0] == pytest.approx(1150, rel=0.01)


def test_a_room_beside_a_board_is_no_plane(room):
    board = "charuco:5x7:40mm:30mm:5x5"
    assert not parse_boards([room.file, board]).flat
    assert parse_boards([board, "charuco:5x7:40mm:30mm:4x4"]).flat


def test_nobody_is_told_to_tilt_a_room(room):
    calibration = calibrate(seen(room)[1], room)
    said = " ".join(coverage_advice(calibration))
    assert "no points at the" in said
    assert "tilt" not in said


def test_markers_on_a_wall_need_several_images(tmp_path):
    turned = in_a_room(40, relief=0.002) @ np.linalg.qr(np.ones((3, 3)) + np.eye(3))[0]
    wall = parse_board(str(written(tmp_path, turned)))
    assert wall.flat
    with pytest.raises(ValueError, match="1 of"):
        calibrate(seen(wall)[1], wall)
    rig, views = seen(wall, count=8)
    fit = calibrate(views, wall).fit
    assert np.abs(errors_of(fit, rig) / np.sqrt(fit.covariance.diagonal())).max() < 4


def six_markers(dictionary="4x4_50"):
    """An image of markers seen at an angle, and their corners."""
    image, squares, known = np.full((480, 640), 200, np.uint8), {}, marker_dictionary(dictionary)
    for number in range(6):
        left, top = 40 + 200 * (number % 3), 60 + 220 * (number // 3)
        squares[number] = np.array([[0, 0], [90, 12], [80, 130], [-5, 150]]) + np.array([left, top])
        marker = cv2.aruco.generateImageMarker(known, number, 120)
        marker = np.pad(marker, 20, constant_values=200)
        corners = np.array([[20, 20], [139, 20], [139, 139], [20, 139]], float)
        H, _ = cv2.findHomography(corners, squares[number].astype(float))
        cv2.warpPerspective(marker, H, (640, 480), image, cv2.INTER_LINEAR, cv2.BORDER_TRANSPARENT)
    return image, squares


def crossing(square):
    a, b, c, d = square.astype(float)
    s, _ = np.linalg.solve(np.stack([c - a, b - d], -1), b - a)
    return a + s * (c - a)


@pytest.mark.parametrize("dictionary", ["5x5_50", "apriltag_36h11"])
def test_centres_are_found_to_a_fraction_of_a_pixel(dictionary, tmp_path):
    """OpenCV counts AprilTags' pixels from the first one's corner, which is corrected by half a pixel."""
    image, squares = six_markers(dictionary)
    found = detect(image, parse_board(f"{written(tmp_path, in_a_room(6))}:{dictionary}"))
    off = found.x - [crossing(squares[number]) for number in found.ids]
    assert np.abs(off.mean(0)).max() < 0.25


def test_an_image_with_markers_on_a_line_alone_is_not_used(tmp_path):
    """A camera could turn about that line."""
    places = np.concatenate([np.arange(6)[:, None] * np.array([1.0, 2.0, 3.0]), in_a_room(2)])
    image, board = six_markers()[0], parse_board(str(written(tmp_path, places)))
    assert detect(image, board) is None
    assert "all on a line" in explain([image], board)


def test_centres_and_corners_of_markers_are_found(tmp_path):
    """Markers seen at an angle: their centres are where the diagonals cross, not the mean of the corners."""
    image, squares = six_markers()
    board = parse_board(str(written(tmp_path, in_a_room(6))))
    found = detect(image, board)
    assert found.ids.tolist() == list(range(6))
    for number, x in zip(found.ids, found.x):
        assert np.abs(x - crossing(squares[number])).max() < 0.5
        assert np.abs(x - squares[number].mean(0)).max() > 1
    path = tmp_path / "corners.csv"
    path.write_text("id,corner,x,y,z\n" + "".join(f"{n},{n % 4},{n},{n * n},{n % 3}\n" for n in range(6)))
    found = detect(image, parse_board(str(path)))
    assert np.abs(found.x - [squares[n][n % 4] for n in range(6)]).max() < 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,y,z\n1,2,3\n", "id,corner,x,y,z"),
        ("id,x,y,z\n1,0,0,0\n", "points.csv"),
        ("id,x,y,z\n1,0,0\n", "line 2"),
        ("id,x,y,z\n1,0,0,nan\n", "line 2"),
        ("id,corner,x,y,z\n1,4,0,0,0\n", "0 to 3"),
        ("id,x,y,z\n" + "3,0,0,0\n" * 6, "marker 3"),
        ("id,x,y,z\n" + "".join(f"{2000 + i},0,{i},0\n" for i in range(6)), "4x4"),
        (
            "id,x,y,z\n" + "".join(f"{i},{0.1 * i},{0.2 * i + 1},{i % 2 / 500}\n" for i in range(8)),
            "line",
        ),
    ],
)
def test_wrong_files_are_explained(text, message, tmp_path):
    path = tmp_path / "points.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        parse_board(str(path))
    with pytest.raises(FileNotFoundError):
        parse_board(str(tmp_path / "none.csv"))


def test_spreadsheets_mark_the_beginning_of_their_files(tmp_path):
    """The byte order mark of UTF-8 is no part of the first column's name."""
    path = written(tmp_path, in_a_room(8))
    plain = parse_board(str(path)).positions
    path.write_text(path.read_text(), encoding="utf-8-sig")
    assert parse_board(str(path)).positions == plain


@pytest.mark.parametrize("content", [b"id,x,y,z\n\xe9,1,2,3\n", b'id,x,y,z\n"' + b"a" * 200_000])
def test_files_that_are_no_csv_are_named(content, tmp_path):
    (tmp_path / "targets.csv").write_bytes(content)
    with pytest.raises(ValueError, match=r"targets\.csv.*CSV"):
        parse_board(str(tmp_path / "targets.csv"))
