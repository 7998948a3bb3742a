from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from arraygeom import (
    Rig,
    depth_from_track,
    epipolar_distance,
    epipolar_lines,
    epipoles,
    fundamental_matrix,
    segments_between,
    shift_origin,
    track,
)
from arraygeom.pixels import pixel_grid, to_homogeneous
from tests.arraygeom.rigs import random_rig, scene_points, two_cameras

seeds = st.integers(0, 10**9)


def correspondences(rig: Rig) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """(x_alpha, x_beta, depth in alpha) of scene points in front of both."""
    X = scene_points(rig)
    a, b = (rig[n].project(X) for n in ("alpha", "beta"))
    return a.x[b.valid], b.x[b.valid], a.depth[b.valid]


def normalised(F: torch.Tensor) -> torch.Tensor:
    return F / F.norm()


@settings(max_examples=50)
@given(seeds)
def test_real_points_satisfy_the_epipolar_constraint(seed):
    rig = random_rig(seed)
    x_alpha, x_beta, _ = correspondences(rig)
    F = normalised(rig.pair("alpha", "beta").fundamental)
    residual = (to_homogeneous(x_beta) * (to_homogeneous(x_alpha) @ F.T)).sum(-1)
    assert residual.abs().max() < 1e-9
    assert epipolar_distance(F, x_alpha, x_beta).abs().max() < 1e-9


def test_epipoles_are_the_images_of_the_other_camera():
    rig = random_rig(4)
    pair = rig.pair("alpha", "beta")
    for e, camera, other in zip(epipoles(pair.fundamental), pair.cameras, pair.cameras[::-1]):
        seen = camera.K @ camera.cam_from_world.apply(other.centre[None])[0]
        assert torch.linalg.cross(e, seen / seen.norm()).abs().max() < 1e-9


def test_a_singular_K_has_neither_F_nor_tracks():
    pose, K = random_rig(4).pair("alpha", "beta").beta_from_alpha, torch.eye(3).double()
    for call in (partial(track, x=torch.zeros(1, 2)), fundamental_matrix):
        with pytest.raises(RuntimeError, match="singular"):
            call(0 * K, K, pose)


def test_tiny_baselines_still_have_lines_in_float32():
    pair = two_cameras(centre=(1e-9, 0, 0)).pair("alpha", "beta")
    x = torch.tensor([[10.0, 12.0]])
    torch.testing.assert_close(epipolar_lines(pair.fundamental, x).abs(), torch.tensor([[0.0, 1.0, 12.0]]))


def test_matlabs_origin_moves_f():
    F = random_rig(0).pair("alpha", "beta").fundamental
    x_alpha, x_beta, _ = correspondences(random_rig(0))
    T = torch.eye(3, dtype=torch.float64)
    T[:2, 2] = -1  # F counted from 1: (T x')^T F (T x') with x' = x + 1
    matlab = T.T @ F @ T
    assert epipolar_distance(normalised(matlab), x_alpha, x_beta).abs().max() > 1e-3
    assert epipolar_distance(shift_origin(matlab, 1), x_alpha, x_beta).abs().max() < 1e-9


def test_tracks_pass_through_what_beta_sees():
    rig = random_rig(6)
    x_alpha, x_beta, depth = correspondences(rig)
    pair = rig.pair("alpha", "beta")
    path = track(pair.alpha.K, pair.beta.K, pair.beta_from_alpha, x_alpha)
    torch.testing.assert_close(path.at(1 / depth), x_beta, atol=1e-9, rtol=0)
    found = depth_from_track(path, x_beta)
    assert found.valid.all()
    torch.testing.assert_close(found.depth, depth, rtol=1e-7, atol=0)


def test_depth_of_a_point_beside_the_track_is_that_of_its_foot():
    rig = random_rig(6)
    x_alpha, x_beta, depth = correspondences(rig)
    pair = rig.pair("alpha", "beta")
    lines = epipolar_lines(pair.fundamental, x_alpha)
    path = track(pair.alpha.K, pair.beta.K, pair.beta_from_alpha, x_alpha)
    torch.testing.assert_close(
        depth_from_track(path, x_beta + 3 * lines[:, :2]).depth, depth, rtol=1e-7, atol=0
    )


def test_the_deviation_of_depth_is_what_moving_the_point_gives():
    """Finite differences, and the spread over 20,000 disturbed points."""
    rig = random_rig(6)
    x_alpha, x_beta, depth = correspondences(rig)
    pair = rig.pair("alpha", "beta")
    lines = epipolar_lines(pair.fundamental, x_alpha)
    along = torch.stack([lines[:, 1], -lines[:, 0]], -1)
    path = track(pair.alpha.K, pair.beta.K, pair.beta_from_alpha, x_alpha)
    sigma = torch.full_like(depth, 1e-3)
    stated = depth_from_track(path, x_beta, sigma).deviation
    ends = [depth_from_track(path, x_beta + s * 1e-3 * along).depth for s in (1, -1)]
    torch.testing.assert_close(stated, 0.5 * (ends[0] - ends[1]).abs(), rtol=1e-3, atol=0)

    g = torch.Generator().manual_seed(0)
    noise = 0.05 * torch.randn(20000, 1, 2, generator=g, dtype=torch.float64)
    spread = depth_from_track(
        track(pair.alpha.K, pair.beta.K, pair.beta_from_alpha, x_alpha[:5]), x_beta[:5] + noise
    )
    torch.testing.assert_close(spread.depth.std(0), 50 * stated[:5], rtol=0.05, atol=0)


def test_no_depth_without_baseline_or_behind():
    pair = two_cameras().pair("alpha", "beta")
    x = torch.tensor([[20.0, 20.0]], dtype=torch.float64)
    assert not depth_from_track(track(pair.alpha.K, pair.beta.K, pair.beta_from_alpha, x), x + 1).valid.any()
    pair = two_cameras(centre=(0.5, 0, 0)).pair("alpha", "beta")
    path = track(pair.alpha.K, pair.beta.K, pair.beta_from_alpha, x)
    beyond = depth_from_track(path, x + torch.tensor([1.0, 0], dtype=torch.float64))
    assert beyond.valid.tolist() == [False]
    assert beyond.depth.isfinite().all()


def test_segments_end_where_the_bounds_project():
    rig = random_rig(6, near=3.0)
    pair = rig.pair("alpha", "beta")
    x = pixel_grid(pair.alpha.hw, dtype=torch.float64)
    path = track(pair.alpha.K, pair.beta.K, pair.beta_from_alpha, x)
    segments = segments_between(path, *rig.depth, pair.beta.hw)
    whole = torch.ones_like(segments.valid)
    for depth in rig.depth:
        seen = pair.beta.project(pair.alpha.unproject(x, depth.expand(x.shape[:-1])))
        whole &= seen.valid & pair.beta.contains(seen.x)
    assert whole.any()
    assert segments.valid[whole].all()
    for end, depth in zip((segments.start, segments.end), rig.depth):
        seen = pair.beta.project(pair.alpha.unproject(x, depth.expand(x.shape[:-1])))
        torch.testing.assert_close(end[whole], seen.x[whole], atol=1e-9, rtol=0)
