"""Cameras of one body, whose orientations are roughly known: found from matches of one image of each."""

from __future__ import annotations

import pytest
import torch
from kornia.geometry import axis_angle_to_rotation_matrix

from arraygeom import Camera, Pose, Rig, intrinsics
from calib.images.known_intrinsics import SIGMA, _by_turning, centres_found
from calib.images.matches import PointMatches, line_distance
from calib.images.refinement import refine_matches


def test_poses_before_a_flat_scene_are_fitted_until_lines_are():
    """A flat scene hardly tells turns from shifts: a fit that stops early leaves lines a pixel off."""
    torch.manual_seed(0)
    turns = {"b": (0.0, 0.0, 0.3), "c": (0.25, 0.0, -0.25), "d": (0.25, -0.05, 0.3)}
    centres = {"b": (1.0, 0.0, 0.0), "c": (0.0, -0.7, 0.0), "d": (1.0, -0.7, 0.0)}
    K, hw = intrinsics(1450.0, (960, 1280)), (960, 1280)
    true = {"a": Camera(K=K, cam_from_world=Pose.identity(), hw=hw)}
    parallel = dict(true)
    for name, degrees in turns.items():
        centre = torch.tensor(centres[name], dtype=torch.float64)
        R = axis_angle_to_rotation_matrix(torch.tensor([degrees], dtype=torch.float64).deg2rad())[0]
        true[name] = Camera(K=K, cam_from_world=Pose.from_centre(R, centre), hw=hw)
        eye = torch.eye(3, dtype=torch.float64)
        parallel[name] = Camera(K=K, cam_from_world=Pose.from_centre(eye, 0.8 * centre), hw=hw)
    extent = torch.tensor([20.0, 15.0, 0.0], dtype=torch.float64)
    points = (torch.rand(600, 3, dtype=torch.float64) - 0.5) * extent + torch.tensor([0.0, 0.0, 25.0])
    seen = {name: camera.project(points).x + 0.1 * torch.randn(600, 2) for name, camera in true.items()}
    names = list(true)
    pairs = {(a, b): PointMatches(seen[a], seen[b]) for i, a in enumerate(names) for b in names[i + 1 :]}
    rig = Rig(parallel)
    free = [f"{name}.{kind}" for name in turns for kind in SIGMA]
    found = refine_matches(rig, [pairs], free=free, sigma=SIGMA, keep_depth=False).rig
    for pair, matches in pairs.items():
        assert line_distance(matches, found.pair(*pair).fundamental).median() < 0.15


@pytest.mark.parametrize("noise", [None, 8.0])
@pytest.mark.parametrize("lost", ["b", "c"])
def test_lengths_are_those_stated_of_cameras_that_match(lost, noise, monkeypatch):
    """With the first beta left out, the next one keeps its own baseline. A camera that matches at first, but
    hardly after lines are fitted, is left out."""
    torch.manual_seed(0)
    K, hw = intrinsics(700.0, (480, 640)), (480, 640)
    centres = {"a": (0.0, 0.0, 0.0), "b": (0.3, 0.0, 0.0), "c": (0.0, 0.1, 0.0), "d": (0.1, 0.1, 0.0)}
    eye = torch.eye(3, dtype=torch.float64)
    poses = {name: Pose.from_centre(eye, eye.new_tensor(centre)) for name, centre in centres.items()}
    rig = Rig({name: Camera(K=K, cam_from_world=pose, hw=hw) for name, pose in poses.items()})
    points = torch.rand(300, 3, dtype=torch.float64) * 2 - eye.new_tensor([1.0, 1.0, -2.0])
    seen = [camera.project(points).x + 0.05 * torch.randn(300, 2) for camera in rig.cameras.values()]

    def matched(one, other, *_, **__):
        i, j = int(one[0, 0, 0]), int(other[0, 0, 0])
        if list(centres).index(lost) not in (i, j):
            return PointMatches(seen[i], seen[j])
        count = 0 if noise is None else 40
        return PointMatches(seen[i][:count], seen[j][:count] + (noise or 0) * torch.randn(count, 2))

    monkeypatch.setattr("calib.images.known_intrinsics.guided_matches", matched)
    images = {name: torch.full((1, *hw), float(i)) for i, name in enumerate(centres)}
    shown = dict.fromkeys(centres, torch.ones(hw, dtype=torch.bool))
    found, _ = centres_found(rig, images, shown, alpha="a")
    assert lost not in found
    for name in found.names:
        assert (found[name].centre - rig[name].centre).norm() < 3e-3


@pytest.mark.parametrize(
    ("distance", "depth", "turned"), [(25.0, 0, False), (9e3, 0, True), (25.0, 9, False)]
)
def test_far_scenes_need_no_baseline(distance, depth, turned):
    """Over far ground no baseline, and no depth, is read into what orientations leave open."""
    torch.manual_seed(0)
    K, hw = intrinsics(1450.0, (960, 1280)), (960, 1280)
    known = {"a": Camera(K=K, cam_from_world=Pose.identity(), hw=hw)}
    eye = torch.eye(3, dtype=torch.float64)
    known["b"] = known["a"].replace(cam_from_world=Pose.from_centre(eye, eye[0]))
    R = axis_angle_to_rotation_matrix(torch.tensor([[0.3, -0.2, 0.4]], dtype=torch.float64).deg2rad())[0]
    true = {**known, "b": known["a"].replace(cam_from_world=Pose.from_centre(R, eye[0]))}
    points = torch.rand(400, 3, dtype=torch.float64) - torch.tensor([0.5, 0.5, 0.0])
    points = points * torch.tensor([0.8 * distance, 0.6 * distance, depth]) + distance * eye[2]
    seen = [camera.project(points).x + 0.1 * torch.randn(400, 2) for camera in true.values()]
    assert _by_turning(Rig(known), Rig(true), ("a", "b"), PointMatches(*seen)) == turned
