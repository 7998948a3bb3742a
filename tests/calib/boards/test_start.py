"""Calibration from a rig known roughly: what images leave open keeps near it, with stated deviations."""

import re
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from arraygeom import Distortion, Pose, Rig, rotation_from_vector
from calib.boards.bundle import CameraPrior, changed, intrinsic_values
from calib.boards.detect import BoardViews
from calib.boards.poses import StartDeviations, start_prior
from calib.boards.rig import calibrate
from calib.boards.simulation import photograph
from calib.boards.validation import start_notes
from calib.images.matches import match_cameras
from calib.images.residuals import line_distances
from experiments.alignment import nine_band_calibration
from pat.app.cli.main import main
from pat.media.images import read_image
from tests.benchmarks.bench_start import GRID, neighbours
from tests.calib.board_scenes import BOARD, board_poses, camera, errors_of, see, tensor

STATED = StartDeviations(position=1e-3, rotation=1.0, focal=0.02, centre=0.01)


def four() -> Rig:
    """Cameras of one kind on a square of 80 mm, all parallel, at nominal values."""
    corners = [(x, y, 0.0) for y in (0.0, 0.08) for x in (0.0, 0.08)]
    cameras = [camera(1400.0, (480, 640), corner, offset=(0.0, 0.0)) for corner in corners]
    return Rig({f"c{i}": c for i, c in enumerate(cameras)})


def drawn(start: Rig, seed: int) -> Rig:
    """A rig that differs from the start by the stated deviations."""
    g, cameras = np.random.default_rng(seed), {}
    for name, c in start.cameras.items():
        centre = c.centre + torch.from_numpy(g.normal(0, STATED.position, 3))
        R = Pose(c.R, c.t).perturbed(rotation=torch.from_numpy(g.normal(0, np.radians(STATED.rotation), 3))).R
        K = c.K.clone()
        K[0, 0] = K[1, 1] = K[0, 0] * (1 + g.normal(0, STATED.focal))
        K[:2, 2] += torch.from_numpy(g.normal(0, STATED.centre * c.hw[1], 2))
        cameras[name] = c.replace(K=K, cam_from_world=Pose.from_centre(R, centre))
    return Rig(cameras)


def one_board(seed: int) -> Pose:
    return board_poses(1, seed=seed, depth=(1.6, 1.9), spread=0.02)


def calibrated(rig, *, seed=0, start=None):
    """Calibrate a rig that is near a start with one image of each camera."""
    views = see(rig, one_board(seed), noise=0.1, seed=seed)
    return calibrate(views, BOARD, lens="none", start=start or four(), deviations=STATED)


def test_the_stated_deviations_hold():
    """One image a camera: errors of all parameters in stated deviations, over rigs drawn around the start."""
    errors = []
    for seed in range(6):
        rig = drawn(four(), seed)
        found = calibrated(rig, seed=seed)
        errors.append(errors_of(found.fit, rig) / np.sqrt(found.fit.covariance.diagonal()))
        assert len(errors[-1]) == 40
        assert not any("far from the start" in note for note in found.notes)
    assert 0.7 < np.sqrt(np.mean(np.square(errors))) < 1.3
    assert np.abs(errors).max() < 4


def test_images_that_are_turned_have_their_start():
    """The focal length of a turned image is beside K's diagonal."""
    turned = {}
    for kind, rig in (("true", drawn(four(), 0)), ("start", four())):
        turned[kind] = Rig({name: c.rot90(1) for name, c in rig.cameras.items()})
    found = calibrated(turned["true"], start=turned["start"])
    for name, c in found.rig.cameras.items():
        deviation = found.deviations()[f"{name}.focal.0"]
        assert (c.K - turned["true"][name].K)[:2, :2].abs().max() < 4 * deviation
    assert "focal lengths ±28" in found.notes[0]


@pytest.mark.parametrize(
    ("own", "wanted", "terms", "kept"),
    [
        (("brown-conrady", (-0.1, 0.0, 0.0, 0.0)), "rational", 8, False),
        (("brown-conrady", (-0.1, *[0.0] * 7)), "brown-conrady", 8, False),
        (("kannala-brandt", (0.02, 0.0, 0.0, 0.0)), "brown-conrady", 4, True),
        (("brown-conrady", (-0.1, 0.0, 0.0, 0.0)), "none", 4, True),
    ],
)
def test_the_lens_that_is_wanted_of_a_start_with_another(own, wanted, terms, kept):
    """A rational lens begins with the terms of the start and has all of its own."""
    lens = Distortion(own[0], tensor(*own[1]))
    rig = Rig({name: c.replace(distortion=lens) for name, c in four().cameras.items()})
    found = calibrate(see(rig, one_board(0), noise=0.1), BOARD, lens=wanted, start=rig, deviations=STATED)
    assert [c.distortion.coefficients.numel() for c in found.rig.cameras.values()] == [terms] * 4
    assert (f"c0: keeps the start's lens, {own[0]}" in found.notes) == kept


def test_what_one_board_leaves_open_is_said():
    """One board does not show where a camera is: the deviation of its position stays as stated."""
    found = calibrated(drawn(four(), 0))
    focal, centre, position = (
        tuple(map(float, re.search(rf"{kind} ±([\d.]+) > ±([\d.]+)", found.notes[0]).groups()))
        for kind in ("focal lengths", "principal points", "positions")
    )
    assert focal[0] == pytest.approx(0.02 * 1400, rel=0.02)
    assert focal[1] < 0.5 * focal[0]
    assert centre[1] < centre[0] == pytest.approx(6.4)
    assert 0.6 < position[1] <= position[0] == 1.0


def test_without_a_covariance_no_gain_is_said():
    fit = replace(calibrated(four()).fit, covariance=None)
    notes = list(start_notes(fit.views, fit, STATED, dict.fromkeys(fit.views, "none")))
    assert not any("positions" in note for note in notes)


def test_a_wrong_start_is_named():
    wrong = four().perturbed({"c2.focal": torch.full((2,), 250.0, dtype=torch.float64)})
    found = calibrated(four(), start=wrong)
    assert any(note.startswith("c2: far from the start: focal length") for note in found.notes)


def test_a_start_in_millimetres_is_refused():
    """The message names a camera whose boards are nowhere near the start's, and asks for metres."""
    with pytest.raises(ValueError, match="c1: "):
        calibrated(four(), start=four().scaled(1000.0))


def test_the_priors_derivatives_are_those_of_finite_differences():
    prior, at = start_prior(four()["c3"], STATED), drawn(four(), 1)["c3"]
    information, slope = prior.equations(at)
    steps = np.concatenate([np.full(6, 1e-6), np.full(4, 1e-3)])
    for i, step in enumerate(steps):
        change = torch.zeros(10, dtype=torch.float64)
        change[i] = step
        loss = [prior.loss(changed(at, sign * change)) for sign in (1, -1)]
        assert -slope[i] == pytest.approx((loss[0] - loss[1]) / (2 * step), rel=1e-3, abs=1e-3)
    assert np.linalg.eigvalsh(information).min() > 0
    still = CameraPrior(intrinsic_values(at), prior.information, at.cam_from_world)
    assert still.loss(at) == pytest.approx(0, abs=1e-12)


@pytest.fixture
def photos(tmp_path):
    """One photograph of a board by each of two cameras, called like them, and the start."""
    start = Rig({name: four()[name] for name in ("c0", "c1")}, depth=(1.5, 20.0))
    start.save(tmp_path / "start.yaml")
    (tmp_path / "photos").mkdir()
    boards, rig = one_board(0), drawn(start, 3)
    for name, c in rig.cameras.items():
        image = photograph(c, c.cam_from_world @ boards[0], BOARD)
        cv2.imwrite(str(tmp_path / "photos" / f"{name}.png"), image)
    return tmp_path


def calibrating(photos):
    """The command that calibrates the rig of these photographs."""
    board = ("--board", "charuco:9x7:60mm")
    return ["calibrate", str(photos / "photos"), *board, "-o", str(photos / "rig.yaml")]


def test_one_photograph_of_each_camera(photos, capsys):
    command = calibrating(photos)
    main([*command, "--start", str(photos / "start.yaml"), "--deviation", "position=0.001"])
    said = capsys.readouterr().out
    assert "2 cameras, 1 frame of" in said
    assert "positions ±1 >" in said
    rig = Rig.load(photos / "rig.yaml")
    assert [float(bound) for bound in rig.depth] == [1.5, 20.0]  # the start's, which was lost
    centres = [c.centre for c in rig.cameras.values()]
    assert float((centres[0] - centres[1]).norm()) == pytest.approx(0.08, abs=3e-3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--deviation", "place=1"], "'place': it has position, rotation, focal, centre"),
        (["--deviation", "focal=0"], "focal=0"),
        (["--lens", "auto"], "--lens: auto"),
        (["--start", "other.yaml"], "c1: "),
        (["--start", "smaller.yaml"], "c0: its images are 640x480"),
    ],
)
def test_mistakes_with_a_start(options, message, photos, refusal):
    start = Rig.load(photos / "start.yaml")
    Rig({"c0": start["c0"]}).save(photos / "other.yaml")
    Rig({name: c.replace(hw=(240, 320)) for name, c in start.cameras.items()}).save(photos / "smaller.yaml")
    (photos / "photos" / "c0").mkdir()
    (photos / "photos" / "c1").mkdir()
    for name in ("c0", "c1"):
        shutil.move(photos / "photos" / f"{name}.png", photos / "photos" / name / "1.png")
    options = [str(photos / o) if o.endswith(".yaml") else o for o in options]
    if "--start" not in options:
        options = [*options, "--start", str(photos / "start.yaml")]
    assert message in refusal(*calibrating(photos), *options)
    assert not (photos / "rig.yaml").exists()


@pytest.mark.slow
def test_the_nine_band_array(shared_data):
    """Baselines of 40 mm, and a scene whose points lie near their lines though no image of it was used."""
    found = nine_band_calibration(shared_data / "nine_band_array", StartDeviations())
    off = [float((found.rig[b].centre - found.rig[a].centre).norm()) - GRID for a, b in neighbours()]
    assert np.abs(off).max() < 5e-4
    assert found.rms < 0.11
    folder = shared_data / "nine_band_array" / "scene"
    images = {name: read_image(folder / f"{name}.png") for name in ("Cam-3", "Cam-6")}
    assert float(line_distances(found.rig, match_cameras(images)).abs().median()) < 0.25


def test_cameras_far_apart_are_rotated_by_way_of_those_between():
    """Each sees boards with the next alone; the last, 8 degrees off against the second, is accepted."""
    row = Rig({f"c{i}": camera(600.0, (480, 640), (0.5 * i, 0.0, 0.0)) for i in range(4)})
    views, middle = {name: {} for name in row.names}, torch.from_numpy(BOARD.middle)
    for frame, x in enumerate((0.25, 0.75, 1.25, 0.2, 0.8, 1.3)):
        R = rotation_from_vector(torch.deg2rad(tensor(*((20, -25, 5) if frame < 3 else (-25, 15, -5)))))
        pose = Pose(R[None], (tensor(x, 0, 1.6) - R @ middle)[None])
        for name in row.names[int(2 * x) :][:2]:
            views[name][frame] = see(Rig({name: row[name]}), pose, noise=0.1)[name].seen[0]
    views = {name: BoardViews((480, 640), seen) for name, seen in views.items()}
    turns = {"c0": 0.0, "c1": 4.0, "c2": 0.0, "c3": -4.0}
    off = {
        name: c.replace(
            cam_from_world=Pose.from_centre(
                rotation_from_vector(torch.deg2rad(tensor(0, turns[name], 0))) @ c.R, c.centre
            )
        )
        for name, c in row.cameras.items()
    }
    found = calibrate(views, BOARD, lens="none", start=Rig(off))
    assert not found.fit.left_out
    assert found.rms < 0.2


def test_cameras_of_the_start_without_images_are_named():
    views = see(four(), one_board(0), noise=0.1)
    found = calibrate({name: views[name] for name in ("c0", "c2")}, BOARD, lens="none", start=four())
    assert found.rig.names == ("c0", "c2")
    assert [note[:2] for note in found.notes if "has no images" in note] == ["c1", "c3"]
