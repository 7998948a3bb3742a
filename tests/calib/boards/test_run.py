"""`pat calibrate` on photographs: real sets, published accuracy; mistakes in a line with nothing written."""

import shutil

import cv2
import numpy as np
import pytest

from arraygeom import Rig
from arraygeom.io import read_rig
from calib.boards.detect import collect_folder
from calib.boards.rig import calibrate
from calib.boards.simulation import simulate_photos
from calib.boards.solve import calibrate_single
from calib.boards.target import parse_board
from pat.app.cli.main import main
from tests.calib.board_scenes import camera, errors_of, four_cameras, pose_errors

BOARD = "charuco:9x7:60mm"


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """Six photographs of a board by two small cameras, in a folder for each."""
    folder = tmp_path_factory.mktemp("photos")
    cameras = {
        "a": camera(330.0, (240, 320), lens=(-0.2, 0.05, 0, 0, 0)),
        "b": camera(280.0, (220, 300), (0.15, 0, 0), (0, -6, 1)),
    }
    simulate_photos(Rig(cameras), parse_board(BOARD), folder, count=6, noise=0.0)
    return folder


@pytest.fixture
def without_report(monkeypatch):
    """Figures take as long as all else."""
    monkeypatch.setattr("calib.boards.run.report_html", lambda *_, **__: "")


def run(folder, *more, board=BOARD):
    main(["calibrate", str(folder), "--board", board, "-o", str(folder / "out" / "rig.yaml"), *more])


def fails(folder, capsys, *more, board=BOARD) -> str:
    with pytest.raises(SystemExit) as stop:
        run(folder, *more, board=board)
    assert stop.value.code == 2
    assert not (folder / "out").exists()
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("pat: ")]
    assert len(lines) == 1
    return lines[0]


@pytest.fixture
def mine(photos, tmp_path):
    """A copy of the images to corrupt."""
    return shutil.copytree(photos, tmp_path / "photos")


def test_photographs_become_a_rig_with_report_and_covariance(mine, capsys):
    run(mine, "--depth", "0.5", "3")
    out = mine / "out"
    assert sorted(p.name for p in out.glob("rig*")) == ["rig.covariance.json", "rig.html", "rig.yaml"]
    rig = Rig.load(out / "rig.yaml")
    assert float(rig["b"].centre[0]) == pytest.approx(0.15, abs=3e-3)
    assert [float(d) for d in rig.depth] == [0.5, 3.0]
    said = capsys.readouterr().out
    assert "2 cameras, 6 frames of charuco:9x7:60mm" in said
    assert float(said.split("reprojection error ")[1].split()[0]) < 0.3


def test_one_camera_is_enough_for_intrinsics(mine, without_report):
    shutil.rmtree(mine / "b")
    run(mine)
    assert abs(float(Rig.load(mine / "out" / "rig.yaml")["a"].K[0, 0]) - 330) < 2


def test_no_board(mine, capsys):
    for path in (mine / "b").iterdir():
        cv2.imwrite(str(path), np.full((220, 300), 90, np.uint8))
    message = fails(mine, capsys)
    assert "b: the board charuco:9x7:60mm" in message
    assert "none of 6 images (000.png, 001.png" in message
    assert "hardly any contrast" in message


def test_wrong_size(mine, capsys):
    assert "30" in fails(mine, capsys, board="charuco:5x4:60mm")


def test_mirrored(mine, capsys):
    for path in (mine / "b").iterdir():
        cv2.imwrite(str(path), cv2.imread(str(path))[:, ::-1])
    assert "found once the image is mirrored" in fails(mine, capsys)


def test_mixed_sizes(mine, capsys):
    path = mine / "a" / "003.png"
    cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), (640, 480)))
    message = fails(mine, capsys)
    assert "a: " in message
    assert "640x480 (003.png)" in message


def test_one_image(mine, capsys):
    for path in sorted((mine / "a").iterdir())[1:]:
        path.unlink()
    assert "a: " in fails(mine, capsys)


def test_a_few_bad_images_are_named_and_left_out(mine, without_report, capsys):
    cv2.imwrite(str(mine / "a" / "002.png"), np.full((240, 320), 90, np.uint8))
    run(mine)
    assert "a: no board in 1 of 6 images (002.png)" in capsys.readouterr().out


def test_other_mistakes(mine, capsys):
    assert str(mine / "none") in fails(mine / "none", capsys)
    assert "'left'" in fails(mine, capsys, "--camera", "left")
    assert "near <= far" in fails(mine, capsys, "--depth", "3", "1")
    assert "charuko:8x6:30mm" in fails(mine, capsys, board="charuko:8x6:30mm")


@pytest.mark.slow
def test_photographs_of_four_cameras(tmp_path):
    """Through prints, lenses, noise, detector: ground truth within 3.5 deviations for some 50 parameters.

    Sixteen boards and corners good to 0.1 px know the poses to about 0.1 degree and half a millimetre.
    """
    rig = four_cameras()
    simulate_photos(rig, parse_board(BOARD), tmp_path, count=16, noise=2.0)
    found = collect_folder(tmp_path, parse_board(BOARD))
    result = calibrate({name: found.views[name] for name in rig.names}, parse_board(BOARD))
    error = errors_of(result.fit, rig) / np.sqrt(result.fit.covariance.diagonal())
    degrees, metres = pose_errors(result.fit, rig)
    assert np.abs(error).max() < 3.5
    assert degrees < 0.15
    assert metres < 1e-3


@pytest.mark.slow
def test_opencvs_pairs(shared_data, tmp_path, capsys):
    """RMS 0.195 px left and 0.217 px together, f 535.9 and baseline 83.2 mm are published."""
    folder = shared_data / "calibration/opencv_stereo"
    main(["calibrate", str(folder), "--board", "chessboard:9x6:25mm", "-o", str(tmp_path / "rig.yaml")])
    rig = Rig.load(tmp_path / "rig.yaml")
    assert float(rig["left"].K[0, 0]) == pytest.approx(535.9, rel=0.01)
    assert 1e3 * float(rig["right"].centre.norm()) == pytest.approx(83.2, rel=0.005)
    said = capsys.readouterr().out
    assert float(said.split("reprojection error ")[1].split()[0]) <= 0.22


@pytest.mark.slow
def test_bumblebees_pairs(shared_data, tmp_path, capsys):
    """Epipolar error 0.08 px at most; stereo.yaml as published has 0.05 on the same corners; its numbers."""
    folder = shared_data / "calibration/bumblebee2_chess"
    main(["calibrate", str(folder), "--board", "chessboard:4x6:30mm", "-o", str(tmp_path / "rig.yaml")])
    assert float(capsys.readouterr().out.split("Epipolar error ")[1].split()[0]) <= 0.08
    rig, published = Rig.load(tmp_path / "rig.yaml"), read_rig(folder / "stereo.yaml", scale=1e-3)
    for name in ("left", "right"):
        assert float(rig[name].K[0, 0]) == pytest.approx(float(published[name].K[0, 0]), rel=0.003)
    ours, theirs = (r.pair("left", "right").beta_from_alpha for r in (rig, published))
    assert float(ours.t.norm()) == pytest.approx(float(theirs.t.norm()), rel=0.003)
    assert float((ours.R - theirs.R).norm()) / 2**0.5 < np.radians(0.35), (
        "eleven small boards know it to 0.1 degrees"
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("camera_name", "focal"),
    [
        ("int_cam01_img", 107599.7 / 64),
        ("int_cam02_img", 107118.7 / 64),
        ("int_cam03_img", 107622.3 / 64),
        ("int_cam04_img", 107215.0 / 64),
    ],
)
def test_action_cameras(camera_name, focal, shared_data):
    folder = shared_data / "calibration/pose2sim_4cam/intrinsics"
    board = parse_board("chessboard:4x7:60mm")
    found = collect_folder(folder, board, patterns={"cam": f"{camera_name}/*.jpg"})
    alone = calibrate_single("cam", found.views["cam"], board)
    assert float(alone.problem.cameras["cam"].K[0, 0]) == pytest.approx(focal, rel=0.015)


NARROW = {
    "opencv_stereo": ({"cam": "left*.jpg"}, "chessboard:9x6:25mm", "omni", 0.16),
    "pose2sim_4cam/intrinsics": (
        {"cam": "int_cam01_img/*.jpg"},
        "chessboard:4x7:60mm",
        "kannala-brandt",
        0.14,
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("folder", NARROW)
def test_narrow_lenses_by_models_of_fisheyes(shared_data, folder):
    """They ask for omni's xi below its bound, 0; and from a fisheye's focal length OpenCV finds no poses."""
    patterns, board, lens, wanted = NARROW[folder]
    board = parse_board(board)
    views = collect_folder(shared_data / "calibration" / folder, board, patterns=patterns).views
    assert calibrate(views, board, lens=lens).rms < wanted
