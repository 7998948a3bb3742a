import dataclasses

import pytest
import torch

from arraygeom.camera import Camera, intrinsics
from arraygeom.pixels import pixel_grid
from arraygeom.rig import Rig
from pat.lab.synthesis.check import CheckLimits, _chosen, check_views
from pat.lab.synthesis.rendered import RenderedFrame, depth_between
from tests.pat.lab.synthesis.scenes import LENS, posed

HW = (60, 80)


def seen(camera: Camera) -> RenderedFrame:
    """A slanted wall with a smaller wall in front of its left part, both with smooth colours."""
    x = pixel_grid(camera.hw, dtype=torch.float64)
    rays = camera.unproject(x, torch.ones(camera.hw, dtype=torch.float64)) - camera.centre

    def disparity(normal, d):
        n = torch.tensor(normal, dtype=torch.float64)
        return (d - n @ camera.centre) / (rays @ n)

    wall, front = disparity([0.3, 0.1, 1.0], 6.0), disparity([-0.1, 0.2, 1.0], 3.0)
    X = camera.centre + front[..., None] * rays
    near = (X[..., 0] < 0) & (X[..., 1].abs() < 0.8)
    depth = torch.where(near, front, wall)
    X = camera.centre + depth[..., None] * rays
    rgb = 0.5 + 0.3 * torch.sin(3 * X + near[..., None])
    return RenderedFrame(time=0.0, rgb=rgb.movedim(-1, 0).float(), depth=depth.float(), index=near.long() + 1)


@pytest.fixture(scope="module")
def rig() -> Rig:
    near = Camera(K=intrinsics(80.0, HW), cam_from_world=posed(), hw=HW)
    return Rig(
        {
            "a": near,
            "b": near.replace(cam_from_world=posed((1, -3, 2), (0.3, 0.0, 0.1))),
            "c": near.replace(cam_from_world=posed((0, 2, 0), (-0.2, 0.1, 0)), distortion=LENS),
        }
    )


@pytest.fixture(scope="module")
def frames(rig) -> dict[str, RenderedFrame]:
    return {name: seen(camera) for name, camera in rig.cameras.items()}


def test_true_views_are_accepted(rig, frames):
    report = check_views(rig, frames)
    assert report["accepted"], report["reasons"]
    assert set(report["pairs"]) == {f"{a} > {b}" for a in "abc" for b in "abc" if a != b}
    for figures in report["pairs"].values():
        assert figures["p95"] < 1e-3
        assert figures["contradicted"] == 0
        assert figures["visible"] + figures["hidden"] <= figures["inside"] + 1e-3
    assert report["pairs"]["b > a"]["hidden"] > 0.02
    assert report["views"]["a"]["near"] == pytest.approx(float(frames["a"].depth.min()), rel=1e-3)


@pytest.mark.parametrize(
    "wrong",
    [
        {"cam_from_world": posed((1, -3, 2), (0.34, 0.0, 0.1))},
        {"cam_from_world": posed((1, -3.5, 2), (0.3, 0.0, 0.1))},
        {"K": intrinsics(80.0, HW, (40.0, 30.0))},
    ],
)
def test_a_wrong_camera_is_found(rig, frames, wrong):
    """Four centimetres, half a degree, or half a pixel."""
    report = check_views(rig.with_camera("b", rig["b"].replace(**wrong)), frames)
    assert not report["accepted"]
    assert any("colours are displaced" in reason for reason in report["reasons"])


def test_a_view_that_sees_through_surfaces_is_found(rig, frames):
    hollow = seen(rig["b"].replace(cam_from_world=posed((1, -3, 2), (0.3, 5.0, 0.1))))
    report = check_views(rig, {**frames, "b": dataclasses.replace(hollow, rgb=frames["b"].rgb)})
    assert any("seen through" in reason for reason in report["reasons"])


@pytest.mark.parametrize(
    ("rgb", "said"),
    [
        (torch.zeros(3, *HW), "black"),
        (torch.full((3, *HW), 2.0), "saturated"),
        (torch.full((3, *HW), 0.5), "0% of the image has texture"),
    ],
)
def test_poor_images_are_found(rig, frames, rgb, said):
    report = check_views(rig, {**frames, "a": dataclasses.replace(frames["a"], rgb=rgb)})
    assert any(reason.startswith("a: ") and said in reason for reason in report["reasons"])


def test_views_that_share_nothing_are_found(rig, frames):
    away = rig["b"].replace(cam_from_world=posed((0, 120, 0)))
    report = check_views(rig.with_camera("b", away), {"a": frames["a"], "b": seen(away)})
    assert any("the other cameras see 0%" in reason for reason in report["reasons"])


def test_frames_of_different_times_are_not_compared(rig, frames):
    later = dataclasses.replace(frames["b"], time=1.0)
    assert set(check_views(rig, {**frames, "b": later})["pairs"]) == {"a > c", "c > a"}


def test_limits_can_be_set(rig, frames):
    assert not check_views(rig, frames, CheckLimits(overlap=0.99))["accepted"]


def test_no_more_pixels_than_stated_are_checked(frames):
    """More than half of the limit, and never more than it."""
    frame = dataclasses.replace(frames["a"], depth=torch.ones(HW))
    for most in (HW[0] * HW[1], 3000, 2400, 7):
        assert most / 2 < len(_chosen(frame, most)[0]) <= most


def test_depth_between_pixels_is_that_of_the_image_alone():
    x = torch.tensor([[1.5, 1.5], [3.3, 1.0], [3.7, 1.0], [-5.0, 1.0], [1.0, 40.0]])
    depth, clean = depth_between(torch.full((4, 4), 2.0), torch.ones(4, 4, dtype=torch.long), x)
    assert depth[clean].tolist() == [2.0]
