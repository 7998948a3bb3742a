"""From detections to a rig: ground truth within its uncertainty, and a message for every unusable set."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from arraygeom import Distortion, Pose, Rig, rotation_from_vector, triangulate
from calib.boards import intrinsics
from calib.boards.adequacy import coverage
from calib.boards.detect import BoardViews, Detection
from calib.boards.poses import symmetry_poses
from calib.boards.report import report_html, verdict
from calib.boards.rig import calibrate
from calib.boards.solve import calibrate_single, many_wrong
from calib.boards.target import parse_board
from calib.boards.uncertainty import (
    RigCovariance,
    beta_covariance,
    jackknife,
    rig_covariance,
    with_disagreement,
)
from calib.boards.validation import FOLDS, epipolar_errors
from tests.benchmarks.bench_robust import drawn
from tests.calib.board_scenes import BOARD, board_poses, camera, errors_of, four_cameras, see, tensor
from tests.calib.tracks import CALISCOPE_BOARD, caliscope_views

CHESS = parse_board("chessboard:8x6:60mm")
"""The corners of `BOARD`, without their names."""


def pair_rig():
    return Rig({name: four_cameras()[name] for name in ("mono", "colour")})


@pytest.fixture(scope="module")
def pair():
    rig, boards = pair_rig(), board_poses(10, spread=0.2)
    return rig, boards, see(rig, boards, noise=0.1)


@pytest.fixture(scope="module")
def found(pair):
    return calibrate(pair[2], BOARD)


def kept(views, **keys):
    return {name: v.only(keys.get(name, v.seen)) for name, v in views.items()}


def with_seen(views, name, seen):
    """The views with other detections of one camera."""
    return {**views, name: BoardViews(views[name].hw, seen)}


def test_a_pair_without_points_within_its_lenses_has_no_epipolar_errors(pair):
    rig, _, views = pair
    ends = Distortion("brown-conrady", tensor([-1e4, 0.0, 0.0, 0.0]))
    rig = rig.with_camera("colour", rig["colour"].replace(distortion=ends))
    assert epipolar_errors(rig, views) == {}


def test_a_pair_is_found_within_its_uncertainty(pair, found):
    assert found.rms == pytest.approx(0.1 * 2**0.5, rel=0.1)
    deviations = np.array(list(found.deviations().values()))
    assert np.abs(errors_of(found.fit, pair[0]) / deviations).max() < 4
    assert torch.equal(found.rig["mono"].t, torch.zeros(3, dtype=torch.float64))


def test_the_covariance_says_how_far_predictions_are_off(pair, found):
    """A point of alpha at 2 m, predicted in beta, by the true rig and by the calibration."""
    rig, covariance = pair[0], rig_covariance(found.fit)
    x = np.stack(np.meshgrid(np.linspace(200, 760, 5), np.linspace(150, 570, 4)), -1).reshape(-1, 2)
    depth = torch.full((len(x),), 2.0, dtype=torch.float64)
    true, both = (
        r["colour"].project(r["mono"].unproject(torch.from_numpy(x), depth)).x.numpy()
        for r in (rig, found.rig)
    )
    difference = both - true
    spread = beta_covariance(found.rig, covariance, "mono", "colour", x, 2.0)
    squared = np.einsum("ni,nij,nj->n", difference, np.linalg.inv(spread), difference)
    assert squared.max() < 20
    assert 0.01 < np.sqrt(spread[:, 0, 0]).mean() < 1.0


def test_the_verdict_says_how_far_depth_is_off(pair, found):
    """Points of the true rig at the largest depth of the verdict, triangulated by the calibration."""
    rig, text = pair[0], verdict(found)
    far, stated = (float(re.search(p, text)[1]) for p in (r"to ([\d.]+) m", r"depth by ([\d.]+)%"))
    x = torch.tensor([[x, y] for x in range(200, 800, 100) for y in range(150, 600, 100)]).double()
    y = rig["colour"].project(rig["mono"].unproject(x, torch.full((len(x),), far).double())).x
    depth = triangulate([found.rig[name] for name in ("mono", "colour")], torch.stack([x, y])).X[:, 2]
    off = 100 * float((depth / far - 1).abs().median())
    assert 0.1 * stated < off < 3 * stated


def test_held_out_frames_are_no_worse(found):
    assert found.held_out["mono", "colour"].mean() < 1.6 * found.epipolar["mono", "colour"].mean() < 0.25


def test_the_covariance_is_kept_in_a_file(found, tmp_path):
    covariance = rig_covariance(found.fit)
    covariance.save(tmp_path / "c.json", found.rig)
    again = RigCovariance.load(tmp_path / "c.json")
    assert again.names == covariance.names
    assert (again.matrix == covariance.matrix).all()
    assert "colour.translation.0" in again.names
    assert "mono.translation.0" not in again.names
    (tmp_path / "d.json").write_text("{}")
    with pytest.raises(ValueError, match=r"d\.json"):
        RigCovariance.load(tmp_path / "d.json")


def test_the_report_holds_the_figures_and_escapes_names(found):
    text = report_html(found, title="<b>&", notes=["left: '<script>' $x$.png"])
    assert "<title>&lt;b&gt;&amp;</title>" in text
    assert "<script>" not in text
    assert f"{found.rms:.3f} px (RMS)" in text
    assert text.count("data:image/png;base64,") == 6
    assert text.index("Good enough to fuse at") < text.index(f"{found.rms:.3f} px (RMS)")


def test_the_verdict_doubts_lines_that_miss_and_too_few_images(found, monkeypatch):
    assert verdict(found).startswith("Good enough")
    assert verdict(replace(found, fit=replace(found.fit, covariance=None))).startswith("Not good enough")
    uncertain = replace(found.fit, covariance=1e6 * found.fit.covariance)
    assert verdict(replace(found, fit=uncertain)).startswith("Not good enough")
    missed = {pair: errors + 2 for pair, errors in found.held_out.items()}
    monkeypatch.setitem(vars(found), "held_out", missed)  # where the cached property keeps it
    assert verdict(found).startswith("Not good enough")


def test_chessboards_that_are_numbered_from_either_end(pair):
    """Half a turn of the numbering in some images of one camera is found out."""
    rig, boards, _ = pair
    turn = CHESS.symmetries[1]
    views = see(rig, boards, CHESS, noise=0.1)
    for name, v in views.items():
        whole = {k: d for k, d in v.seen.items() if len(d.ids) == len(CHESS.points)}
        views = with_seen(views, name, whole)
    turned = {k: Detection(turn[d.ids], d.x) for k, d in views["colour"].seen.items() if k % 3 == 1}
    result = calibrate(with_seen(views, "colour", {**views["colour"].seen, **turned}), CHESS)
    assert result.rms < 0.2
    assert float((result.rig["colour"].centre - rig["colour"].centre).norm()) < 2e-3


def test_a_chessboard_detected_a_square_off_is_left_out(pair):
    """Detectors take the board's edge for a row of its corners now and then."""
    rig, boards, _ = pair
    views = see(rig, boards, CHESS, noise=0.1)

    class Shifted:
        points = CHESS.points + np.array([0.06, 0, 0])

    off = see(rig, boards, Shifted, noise=0.1)["colour"].seen
    seen = views["colour"].seen
    key = next(k for k, d in seen.items() if len(d.ids) == len(off[k].ids) == len(CHESS.points))
    result = calibrate(with_seen(views, "colour", {**seen, key: off[key]}), CHESS)
    assert result.rms < 0.2
    assert any(f": left out {key}: " in note and "contradict" in note for note in result.notes), result.notes
    assert float((result.rig["colour"].centre - rig["colour"].centre).norm()) < 2e-3


@pytest.mark.parametrize(("before", "many"), [(0, False), (5, True)])
def test_no_more_than_a_third_of_a_cameras_images_are_left_out_however_often_the_rest_is_fitted(before, many):
    assert many_wrong(["a"] * 3, ["a"] * before + ["b"] * 9, {"a": 10, "b": 0}) is many


def test_symmetry_poses_move_points_to_their_images():
    for turn, image in zip(symmetry_poses(CHESS), CHESS.symmetries):
        assert np.abs(turn.apply(torch.from_numpy(CHESS.points)).numpy() - CHESS.points[image]).max() < 1e-12


def test_cameras_joined_only_through_others():
    """a and c share no frame; b joins them."""
    rig = Rig({name: four_cameras()[name] for name in ("mono", "colour", "nir")})
    views = kept(see(rig, board_poses(14), noise=0.05), mono=range(7), nir=range(7, 14))
    result = calibrate(views, BOARD)
    assert result.rms < 0.12
    assert float((result.rig["nir"].centre - rig["nir"].centre).norm()) < 5e-3


def test_cameras_that_share_no_frame_are_refused(pair):
    with pytest.raises(ValueError, match=r"colour.*mono"):
        calibrate(kept(pair[2], mono=range(5), colour=range(5, 10)), BOARD)


def test_sets_a_frame_late_are_refused(pair):
    late = with_seen(pair[2], "colour", {k + 1: d for k, d in pair[2]["colour"].seen.items()})
    with pytest.raises(ValueError, match=r"mono.*colour"):
        calibrate(late, BOARD)


def test_mirrored_sets_are_refused(pair):
    rig, boards, _ = pair
    views = see(rig, boards, CHESS, noise=0.1)
    width = rig["colour"].hw[1]
    mirrored = {}
    for key, d in views["colour"].seen.items():
        ids = (d.ids // 8) * 8 + 7 - d.ids % 8
        mirrored[key] = Detection(ids, np.stack([width - 1 - d.x[:, 0], d.x[:, 1]], -1))
    with pytest.raises(ValueError, match="mirrored"):
        calibrate(with_seen(views, "colour", mirrored), CHESS)


def test_boards_that_move_between_the_exposures_do_not_distort_the_lenses(pair):
    """Frames a moment apart: intrinsics stay those of each camera's own images, and the note states so."""
    rig, boards, views = pair
    moved = Pose(boards.R, boards.t + torch.from_numpy(np.random.default_rng(0).normal(0, 0.004, (10, 3))))
    views = {"mono": views["mono"], "colour": see(rig, moved, noise=0.1)["colour"]}
    result = calibrate(views, BOARD)
    assert any("taken at the same moments" in note for note in result.notes)
    alone = calibrate_single("colour", views["colour"], BOARD)
    for i in range(2):
        change = abs(float(result.rig["colour"].K[i, i] - alone.problem.cameras["colour"].K[i, i]))
        assert change < alone.deviations[f"colour.focal.{i}"]
    assert len(set(result.fit.problem.sigma.values())) == 1


def test_boards_that_moved_in_a_few_frames_are_left_out(pair, found):
    """Each image fits its own camera, and the two contradict each other by some pixels."""
    rig, boards, views = pair
    moved = Pose(boards.R, boards.t + tensor(0.004, 0.003, 0))
    off = see(rig, moved, noise=0.1)["colour"].seen
    seen = views["colour"].seen
    keys = [key for key in seen if key in off and key in views["mono"].seen][1:6:2]
    result = calibrate(with_seen(views, "colour", {**seen, **{key: off[key] for key in keys}}), BOARD)
    assert {key for _, key in result.fit.left_out} == set(keys)
    assert result.rms < 1.2 * found.rms
    assert all(any(str(key) in note for note in result.notes) for key in keys)


def fisheye_views(seed, *, focal=200.0, widest=80.0, count=14):
    """Boards all over a fisheye's image, many of them beside the camera."""
    g, points = np.random.default_rng(seed), torch.from_numpy(CHESS.points - CHESS.points.mean(0))
    fisheye = camera(focal, (480, 640), lens=(0.02, -0.01, 0.002, 0.0), model="kannala-brandt")
    seen = {}
    while len(seen) < count:
        azimuth, angle = g.uniform(0, 2 * np.pi), np.radians(widest) * np.sqrt(g.uniform())
        sideways = tensor(np.cos(azimuth), np.sin(azimuth), 0)
        direction = np.sin(angle) * sideways + np.cos(angle) * tensor(0, 0, 1)
        axis = torch.linalg.cross(tensor(0, 0, 1), sideways)
        R = rotation_from_vector(angle * axis) @ rotation_from_vector(
            torch.from_numpy(g.normal(0, (0.4, 0.4, 0.3)))
        )
        x, _, valid = fisheye.project_local(points @ R.T + g.uniform(0.3, 0.8) * direction)
        inside = (valid & fisheye.contains(x)).numpy()
        if inside.sum() > 20:
            noisy = x.numpy() + g.normal(0, 0.1, x.shape)
            seen[len(seen)] = Detection(np.flatnonzero(inside), noisy[inside])
    return {"cam": BoardViews(fisheye.hw, seen)}


@pytest.mark.parametrize(("seed", "widest"), [(0, 80.0), (2, 80.0), (1, 95.0)])
def test_fisheyes_with_boards_beside_the_camera(seed, widest):
    """OpenCV's own start ends in an assertion of its, or tens of pixels off."""
    views = fisheye_views(seed, widest=widest)
    found = calibrate(views, CHESS, lens="kannala-brandt")
    assert found.rms == pytest.approx(0.1 * 2**0.5, rel=0.15)
    assert len(found.views["cam"].seen) == len(views["cam"].seen)
    assert float(found.rig["cam"].K[0, 0]) == pytest.approx(200, abs=0.5)


def test_a_fisheye_taken_for_a_pinhole_is_named(monkeypatch):
    def failing(*_):
        raise ValueError("t holds NaN or infinity")

    monkeypatch.setattr(intrinsics, "_pinhole", failing)
    with pytest.raises(ValueError, match=r"--lens.*kannala-brandt"):
        calibrate(fisheye_views(1), CHESS)


def test_one_image_is_too_few(pair):
    with pytest.raises(ValueError, match="mono: "):
        calibrate(kept(pair[2], mono=[0]), BOARD)


def test_parallel_boards_are_refused():
    c = camera(700.0, (480, 640))
    boards = board_poses(6, tilt=0.5)
    with pytest.raises(ValueError, match=r"cam: .*parallel"):
        calibrate(see(Rig({"cam": c}), boards), BOARD)


def test_unobservable_parameters_are_fixed():
    """A long lens hardly distorts: k2 and k3 stay 0, with a note; the coverage names what is missing."""
    c = camera(4000.0, (480, 640), lens=(0.0, 0.0, 0.0, 0.0, 0.0))
    board = parse_board("charuco:9x7:20mm")
    boards = board_poses(8, depth=(2.5, 2.8), spread=0.02)
    shift = boards.R @ torch.from_numpy(BOARD.points.mean(0) - board.points.mean(0))
    views = see(Rig({"tele": c}), Pose(boards.R, boards.t + shift), board, noise=0.1)
    result = calibrate(views, board)
    assert result.rig["tele"].distortion.coefficients[[1, 4]].tolist() == [0, 0]
    assert any(note.startswith("tele: ") and "k3" in note for note in result.notes)
    assert "tele.distortion.4" not in result.deviations()


def test_a_poorly_constrained_camera_stays_plausible():
    """Four boards in the middle, hardly tilted, corners to half a pixel: square pixels, a central middle."""
    true = camera(900.0, (480, 640), lens=(-0.1, 0.0, 0.0, 0.0, 0.0))
    views = see(Rig({"cam": true}), board_poses(4, tilt=18.0, depth=(1.3, 1.6), spread=0.02), noise=0.5)
    found = calibrate_single("cam", views["cam"], BOARD, final=False).problem.cameras["cam"]
    assert float(found.K[0, 0] / found.K[1, 1]) == pytest.approx(1, abs=0.01)
    assert np.abs(found.K[:2, 2].numpy() - (319.5, 239.5)).max() < 0.06 * 640


@pytest.mark.parametrize("seed", [0, 1, 3])
def test_a_narrow_view_by_a_fisheyes_model(seed):
    """OpenCV's start from half a sphere would leave out good images."""
    views = see(
        Rig({"a": camera(300.0, (240, 320))}), board_poses(4, seed=seed, depth=(0.5, 1.5)), noise=0.02
    )
    found = calibrate(views, BOARD, lens="kannala-brandt")
    assert len(found.views["a"].seen) == 4
    assert float(found.rig["a"].K[0, 0]) == pytest.approx(300, abs=1)


def test_coverage_names_what_is_missing():
    pose = Pose(torch.eye(3, dtype=torch.float64), tensor(-0.24, -0.18, 2.0))
    c = camera(600.0, (480, 640))
    x = c.project(pose.apply(torch.from_numpy(BOARD.points))).x.numpy()
    found = coverage(BoardViews(c.hw, {0: Detection(np.arange(len(x)), x)}), {0: pose}, BOARD)
    assert found.depths == pytest.approx((2.0, 2.0))
    assert found.tilts[1] == pytest.approx(0, abs=1e-6)
    places, depth, tilt = found.missing
    assert "the top left, top, top right, left, right, bottom left, bottom, bottom right of" in places
    assert "boards at one depth only" in depth
    assert "boards tilted by 0 degrees at most" in tilt


@cache
def names_without_wrong_corners(draw):
    return set(drawn(0.0, draw)[1].fit.names)


@pytest.mark.parametrize(("share", "draw"), [(0.05, 3), (0.2, 3), (0.05, 108)])
def test_wrong_corners_do_not_matter(share, draw):
    """Left out and counted from the first step: all parameters within five stated deviations.

    In draw 108 an image shows two rows of corners, of which one would be left.
    """
    rig, found = drawn(share, draw)
    assert set(found.fit.names) == names_without_wrong_corners(draw)
    assert np.abs(errors_of(found.fit, rig) / np.sqrt(found.fit.covariance.diagonal())).max() < 5
    assert found.rms < 0.2
    assert any("points left out as outliers" in note for note in found.notes)


def test_a_board_that_bends_raises_the_deviations():
    """Each frame's board is bent anew: the jackknife over frames says so, the points' noise does not."""
    rig, boards, g = pair_rig(), board_poses(12, spread=0.2), np.random.default_rng(0)
    views = {name: BoardViews(rig[name].hw, {}) for name in rig.names}
    off = (BOARD.points[:, 0] - BOARD.middle[0]) / BOARD.middle[0]
    for frame in range(12):

        class Bent:
            points = BOARD.points + np.outer(g.normal(0, 2e-3) * off**2, [0, 0, 1])

        for name, v in see(rig, boards[frame : frame + 1], Bent, noise=0.05, seed=frame).items():
            views[name].seen.update({frame + key: d for key, d in v.seen.items()})
    bent = calibrate(views, BOARD)
    assert bent.fit.raised > 1.3
    assert any("is the board flat" in note for note in bent.notes)


@pytest.mark.parametrize(("frames", "raised"), [(4, 3.0), (7, 1.0)])
def test_deviations_that_few_frames_cannot_check_are_raised(frames, raised):
    """Baselines of three frames of a real pair are up to 6.8 deviations off unless these are raised."""
    found = calibrate(see(pair_rig(), board_poses(frames, spread=0.2), noise=0.05), BOARD)
    assert found.fit.raised == raised
    assert any("too few to check standard deviations" in note for note in found.notes) == (raised > 1)


def test_frames_that_disagree_about_the_focal_lengths_raise_those_alone(found, monkeypatch):
    """The jackknife makes their deviations five times as large, and leaves the others."""
    factor = np.array([5.0 if "focal" in name else 1.0 for name in found.fit.names])
    disagreeing = found.fit.covariance * factor[:, None] * factor
    given = jackknife(found.fit.problem)._replace(covariance=disagreeing, left_out=disagreeing)
    assert found.fit.raised == 1.0
    monkeypatch.setattr("calib.boards.uncertainty.jackknife", lambda _: given)
    raised = with_disagreement(found.fit, BOARD)
    ratio = np.sqrt(raised.covariance.diagonal() / found.fit.covariance.diagonal())
    assert ratio == pytest.approx(np.where(factor > 1, np.sqrt((1 + 25) / 2), 1.0))
    assert raised.raised == pytest.approx(np.sqrt(13))


@pytest.mark.parametrize("part", [0, 2])
def test_small_boards_around_the_centre_do_not_lead_the_start_astray(shared_data, part):
    """Four fifths of a recording, and random subsets of a camera's boards, on which aspect and k2 can run
    off."""
    views = caliscope_views(shared_data)
    frames = dict.fromkeys(key for v in views.values() for key in v.seen)
    left_out = [key for key in frames if sum(key in v.seen for v in views.values()) > 1][part::FOLDS]
    seen = views["cam3"].only(views["cam3"].seen.keys() - set(left_out))
    camera = calibrate_single("cam3", seen, parse_board(CALISCOPE_BOARD), final=False).problem.cameras["cam3"]
    fx, fy = camera.K[:2, :2].diagonal().tolist()
    assert fx == pytest.approx(800, rel=0.1)
    assert fx == pytest.approx(fy, rel=0.01)


def test_without_views_there_is_nothing_to_calibrate():
    with pytest.raises(ValueError, match="views"):
        calibrate({}, parse_board("chessboard:9x6:25mm"))


def test_points_on_a_line_have_no_pose():
    camera = four_cameras()["mono"]
    row = np.arange(BOARD.columns)
    x = camera.project_local(torch.from_numpy(BOARD.points[row]) + torch.tensor([0.0, 0, 1.5])).x.numpy()
    with pytest.raises(ValueError, match="line"):
        intrinsics.board_pose(camera, Detection(row, x), BOARD)
    views = BoardViews(camera.hw, dict.fromkeys(range(3), Detection(row, x)))
    with pytest.raises(ValueError, match=r"^mono: "):
        intrinsics.initial_camera("mono", views, BOARD, "kannala-brandt")
