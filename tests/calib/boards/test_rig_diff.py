"""Differences of rigs by `pat rig diff`: simulated recalibrations of a rig that moved and one that did not;
refusals."""

import math
import re
import shutil
from itertools import pairwise

import numpy as np
import pytest
import torch

from arraygeom import Pose, Rig, View, rotation_from_vector
from arraygeom.runtime.text import UNSCALED
from calib.boards.bundle import changed, parameter_names
from calib.boards.rig_diff import _projections, draw_difference, rig_difference
from calib.boards.solve import adjust
from calib.boards.uncertainty import RigCovariance, rig_covariance
from pat.app.cli.main import main
from pat.app.sample_array import SAMPLE
from tests.calib.board_scenes import board_poses, four_cameras, scene_of, see

DEPTH = (1.0, 4.0)
TURN = math.radians(0.05)


@pytest.fixture(scope="module")
def rig():
    return Rig({name: four_cameras()[name] for name in ("mono", "nir")})


def recalibrated(rig, seed, *, frames=12):
    """The rig and its covariance from new images of a board, with .2 px of noise."""
    boards = board_poses(frames, seed=seed)
    fit = adjust(scene_of(rig, boards, see(rig, boards, noise=0.2, seed=seed + 5000)))
    return Rig(fit.problem.cameras, depth=DEPTH), rig_covariance(fit)


def turned(rig, seed):
    """The rig with one camera rotated by .05 degrees about a random axis."""
    axis = torch.from_numpy(np.random.default_rng(seed).normal(size=3))
    pose = rig["nir"].cam_from_world.perturbed(TURN * axis / axis.norm(), torch.zeros(3, dtype=torch.float64))
    return rig.with_camera("nir", rig["nir"].replace(cam_from_world=pose))


def compared(one, other):
    return rig_difference(one[0], other[0], covariances=(one[1], other[1]), depth=DEPTH)


def shares(rig, count):
    """Return the share of recalibrations of one rig that are called the same, and of a moved one called
    moved."""
    fits = [recalibrated(rig, seed) for seed in range(count + 1)]
    same = [not compared(*pair).significance.moved for pair in pairwise(fits)]
    moved = [compared(fits[i], recalibrated(turned(rig, i), 10_000 + i)).significance for i in range(count)]
    return np.mean(same), np.mean([found.moved for found in moved])


def test_a_few_recalibrations(rig):
    assert shares(rig, 3) == (1.0, 1.0)


@pytest.mark.slow
def test_two_hundred_recalibrations(rig, capsys):
    same, moved = shares(rig, 200)
    with capsys.disabled():
        print(
            f"\nunchanged rigs said to be the same: {same:.1%}; rotated by .05 degrees said to be moved: "
            f"{moved:.1%}"
        )
    assert same >= 0.95
    assert moved >= 0.95


TURNED = rotation_from_vector(torch.tensor([0.3, -0.2, 0.5]).double())
WORLD = Pose(TURNED, torch.tensor([1.0, 2.0, -0.5]).double())
"""Another world than the rig's, from it."""


def set_up_in(world, rig):
    poses = {n: c.cam_from_world @ world.inverse() for n, c in rig.cameras.items()}
    return Rig({n: c.replace(cam_from_world=poses[n]) for n, c in rig.cameras.items()})


def test_a_motion_of_the_whole_rig_is_no_difference(rig):
    found = rig_difference(rig, set_up_in(WORLD, rig), depth=DEPTH)
    assert max(np.abs(camera.change).max() for camera in found.cameras.values()) < 1e-6
    assert torch.allclose(found.motion.matrix, WORLD.matrix, atol=1e-8)
    assert np.abs(found.depths["nir"].change).max() < 1e-8


def row_of_five(rig):
    """Five cameras alike in two rows."""
    centres = torch.tensor([[0.0, 0, 0], [0.2, 0, 0], [0.4, 0, 0], [0, 0.2, 0], [0.2, 0.2, 0]]).double()
    poses = [Pose.from_centre(torch.eye(3, dtype=torch.float64), c) for c in centres]
    return Rig({f"c{i}": rig["mono"].replace(cam_from_world=pose) for i, pose in enumerate(poses)})


@pytest.mark.parametrize("name", ["c0", "c4"])
def test_differences_are_those_of_the_motion(rig, name):
    """One camera of many rotated, the first one too: its own pixels move, by f tan(angle)."""
    five = row_of_five(rig)
    pose = five[name].cam_from_world.perturbed(torch.tensor([0, TURN, 0]).double(), torch.zeros(3).double())
    found = rig_difference(five, five.with_camera(name, five[name].replace(cam_from_world=pose)), depth=DEPTH)
    off = {name: np.median(np.linalg.norm(camera.change, axis=1)) for name, camera in found.cameras.items()}
    assert off[name] == pytest.approx(1150 * TURN, rel=0.3)
    assert max(off[other] for other in off if other != name) < off[name] / 2
    if name == "c4":
        at = found.depths["c4"].depth == DEPTH[1]
        relative = TURN * DEPTH[1] / 0.2
        assert np.median(np.abs(found.depths["c4"].change[at])) == pytest.approx(relative, rel=0.5)


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_pixels_differ_alike_in_any_unit_of_length(rig, unit):
    """The end of the iteration is relative to the unit."""
    pose = rig["nir"].cam_from_world.perturbed(
        torch.zeros(3).double(), torch.tensor([0.1, 0.1, 0.1]).double()
    )
    moved = rig.with_camera("nir", rig["nir"].replace(cam_from_world=pose))
    bounds = (unit * DEPTH[0], unit * DEPTH[1])
    found = rig_difference(rig.scaled(unit), moved.scaled(unit), depth=bounds).cameras
    for name, expected in rig_difference(rig, moved, depth=DEPTH).cameras.items():
        np.testing.assert_allclose(found[name].change, expected.change, rtol=0, atol=1e-9)


def test_the_depths_deviation_is_that_of_recalibrations(rig):
    fits = [recalibrated(rig, seed) for seed in range(11)]
    found = [compared(*pair).depths["nir"] for pair in pairwise(fits)]
    ratio = np.concatenate([depth.change / depth.sigma for depth in found])
    assert 0.6 < np.sqrt(np.square(ratio).mean()) < 1.3


@pytest.fixture(scope="module")
def files(rig, tmp_path_factory):
    folder = tmp_path_factory.mktemp("rigs")
    for name, seed, one in (("a", 0, rig), ("b", 1, rig), ("turned", 2, turned(rig, 0))):
        made, covariance = recalibrated(one, seed)
        made.save(folder / f"{name}.yaml")
        covariance.save(folder / f"{name}.covariance.json", made)
    bare = Rig.load(folder / "a.yaml")
    bare.save(folder / "bare.yaml")
    bare.replace(depth=None).save(folder / "no_depth.yaml")
    bare.resize("nir", (240, 320)).save(folder / "small.yaml")
    Rig({"mono": bare["mono"], "red": bare["nir"]}, depth=DEPTH).save(folder / "other.yaml")
    Rig({"mono": bare["mono"], "nir": View(hw=bare["nir"].hw)}, depth=DEPTH).save(folder / "view.yaml")
    return folder


def diff(folder, one, other, *options):
    main(["rig", "diff", str(folder / f"{one}.yaml"), str(folder / f"{other}.yaml"), *options])


def test_the_verdict(files, capsys):
    diff(files, "a", "b", "--out", str(files / "diff.png"))
    assert "verdict: the same" in capsys.readouterr().out
    assert (files / "diff.png").stat().st_size > 10_000
    diff(files, "a", "turned")
    assert "verdict: moved" in capsys.readouterr().out


def test_without_deviations_there_is_no_verdict(files, capsys):
    diff(files, "bare", "bare")
    said = capsys.readouterr()
    assert "verdict: none" in said.out
    assert "no covariance file" in said.err
    diff(files, "a", "bare")
    said = capsys.readouterr()
    assert "verdict: the same" in said.out
    assert "bare.covariance.json: not there: that rig counts as calibrated as well" in said.err


def test_depths_of_rigs_of_unknown_scale_are_not_in_metres(files, tmp_path, capsys):
    for name in ("a", "turned"):
        Rig.load(files / f"{name}.yaml").replace(name=UNSCALED).save(tmp_path / f"{name}.yaml")
        shutil.copy(files / f"{name}.covariance.json", tmp_path)
    diff(tmp_path, "a", "turned")
    said = capsys.readouterr().out
    assert re.search(r"depth by \w+ and \w+, \S+ to \S+ baselines: differs", said)
    assert re.search(r"a shift of \S+ baselines explain", said)
    with pytest.raises(ValueError, match="baselines"):
        rig_difference(Rig.load(files / "a.yaml"), Rig.load(tmp_path / "a.yaml"), depth=(1.0, 2.0))


def test_a_covariance_is_of_the_rig_it_was_found_with(files, tmp_path, capsys):
    """A covariance file is refused for a rig whose lengths were changed; another depth range is no change."""
    for path in files.glob("a.*"):
        shutil.copy(path, tmp_path)
    rig = Rig.load(tmp_path / "a.yaml")
    rig.replace(depth=(2.0, 5.0)).save(tmp_path / "a.yaml")  # nothing that the covariance is of
    diff(tmp_path, "a", "a")
    assert "verdict: the same" in capsys.readouterr().out
    rig.scaled(1000.0).save(tmp_path / "a.yaml")
    with pytest.raises(SystemExit):
        diff(tmp_path, "a", "a")
    assert "a.covariance.json: is not of the rig beside it, which was changed" in capsys.readouterr().err


def test_images_say_which_rig_fits(tmp_path, capsys):
    """The sample's images fit its rig, not one with a camera turned .3 degrees, whichever comes first."""
    rig = Rig.load(SAMPLE / "rig.yaml")
    pose = rig["colour"].cam_from_world.perturbed(
        6 * TURN * torch.tensor([1.0, 0, 0]).double(), torch.zeros(3).double()
    )
    rig.with_camera("colour", rig["colour"].replace(cam_from_world=pose)).save(tmp_path / "turned.yaml")
    images = [word for name in rig.names for word in ("--image", f"{name}={SAMPLE / name}.png")]
    main(["rig", "diff", str(SAMPLE / "rig.yaml"), str(tmp_path / "turned.yaml"), *images])
    assert "A fits better" in capsys.readouterr().out
    main(["rig", "diff", str(tmp_path / "turned.yaml"), str(SAMPLE / "rig.yaml"), *images])
    assert "B fits better" in capsys.readouterr().out
    main(["rig", "diff", str(SAMPLE / "rig.yaml"), str(SAMPLE / "rig.yaml"), *images])
    assert "neither fits significantly better" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("one", "other", "message"),
    [
        ("a", "other", "the rigs are of other cameras (mono, nir; and mono, red)"),
        ("a", "small", "'nir' has 640x480 pixels in one rig and 320x240 in the other"),
        ("a", "view", "'nir' is not calibrated in both rigs"),
        ("no_depth", "no_depth", "--depth: neither rig states"),
        ("a", "missing", "missing.yaml"),
    ],
)
def test_mistakes_are_named(files, capsys, one, other, message):
    with pytest.raises(SystemExit):
        diff(files, one, other)
    said = capsys.readouterr().err.strip()
    assert message in said
    assert "\n" not in said


def test_derivatives_are_those_of_the_difference(rig):
    """Derivatives by the second rig's parameters in its own world, which is turned and shifted."""
    other, pixels = set_up_in(WORLD, rig), torch.tensor([[100.0, 80], [500, 400]]).double()
    X = rig["nir"].unproject(pixels, torch.tensor([1.5, 3.0]).double()).numpy()
    part = _projections(rig, other, WORLD, "nir", X)
    for i, step in enumerate(1e-6 * torch.eye(len(parameter_names(other["nir"])), dtype=torch.float64)):
        moved = other.with_camera("nir", changed(other["nir"], step))
        by_step = (_projections(rig, moved, WORLD, "nir", X).change - part.change) / 1e-6
        assert np.allclose(part.jacobians[1][..., i], by_step, rtol=1e-3, atol=1e-3 * abs(by_step).max()), i
    for i, step in enumerate(1e-6 * torch.eye(6, dtype=torch.float64)):
        moved = WORLD.perturbed(*step.split(3))
        by_step = (_projections(rig, other, moved, "nir", X).change - part.change).ravel() / 1e-6
        assert np.allclose(part.by_motion[:, i], by_step, rtol=1e-3, atol=1e-3 * abs(by_step).max())


def test_cameras_that_look_away_from_each_other_have_no_depths(rig):
    """The picture and the text failed on an empty list."""
    back = torch.tensor([0.0, math.pi, 0.0], dtype=torch.float64)
    pose = rig["nir"].cam_from_world.perturbed(back, torch.zeros(3, dtype=torch.float64))
    apart = rig.with_camera("nir", rig["nir"].replace(cam_from_world=pose))
    found = rig_difference(apart, apart, depth=DEPTH)
    assert found.depths == {}
    assert "depth by" not in found.as_text()
    assert len(draw_difference(found).axes) == 8


def test_covariances_of_a_single_camera_are_of_it_and_of_something(rig):
    alone = Rig({"mono": rig["mono"]})
    no_error = RigCovariance(("mono.focal.0",), np.zeros((1, 1)))
    found = rig_difference(alone, alone, covariances=(no_error, no_error), depth=DEPTH)
    assert "verdict: none" in found.verdict
    other = RigCovariance(("nir.focal.0",), np.ones((1, 1)))
    with pytest.raises(ValueError, match=r"nir\.focal\.0"):
        rig_difference(alone, alone, covariances=(other, None), depth=DEPTH)


@pytest.mark.parametrize("depth", [(0.0, 4.0), (4.0, 1.0)])
def test_depths_that_are_no_range_are_refused(rig, depth):
    with pytest.raises(ValueError, match="near"):
        rig_difference(rig, rig, depth=depth)
