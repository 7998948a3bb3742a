import numpy as np
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
    essential_matrix,
    segments_between,
    shift_origin,
    track,
)
from arraygeom.pixels import pixel_grid, to_homogeneous
from tests.arraygeom.rigs import random_rig, scene_points, two_cameras
from tests.oracles import Oracle

cv2 = Oracle("cv2")

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


@pytest.mark.parametrize("seed", range(5))
def test_lines_are_opencvs(seed):
    rig = random_rig(seed)
    x_alpha, _, _ = correspondences(rig)
    F = rig.pair("alpha", "beta").fundamental
    expected = cv2.computeCorrespondEpilines(x_alpha.numpy()[:, None], 1, F.numpy())[:, 0]
    lines = epipolar_lines(F, x_alpha).numpy()
    signs = np.sign((lines * expected).sum(-1, keepdims=True))
    np.testing.assert_allclose(lines, signs * expected, atol=1e-9)


def test_essential_matrix_is_that_of_opencv_decomposition():
    rig = random_rig(3)
    pose = rig.pair("alpha", "beta").beta_from_alpha
    R1, R2, t = cv2.decomposeEssentialMat(essential_matrix(pose).numpy())
    assert min(np.abs(R - pose.R.numpy()).max() for R in (R1, R2)) < 1e-9
    direction = (pose.t / pose.t.norm()).numpy()
    assert min(np.abs(s * t[:, 0] - direction).max() for s in (1, -1)) < 1e-9


def test_epipoles_are_the_images_of_the_other_camera():
    rig = random_rig(4)
    pair = rig.pair("alpha", "beta")
    for e, camera, other in zip(epipoles(pair.fundamental), pair.cameras, pair.cameras[::-1]):
        seen = camera.K @ camera.cam_from_world.apply(other.centre[None])[0]
        assert torch.linalg.cross(e, seen / seen.norm()).abs().max() < 1e-9


def test_at_the_epipole_and_without_baseline_there_is_no_line():
    rig = two_cameras(centre=(0, 0, 1.0))
    F = rig.pair("alpha", "beta").fundamental
    x = torch.tensor([[31.5, 23.5], [10.0, 10.0]], dtype=torch.float64)
    lines = epipolar_lines(F, x)
    assert not lines[0].any()
    assert lines[1, :2].norm() == pytest.approx(1)
    assert not epipolar_lines(0 * F, x).any()


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


def sampled_visible(pair, x: torch.Tensor, depths: tuple[torch.Tensor, torch.Tensor], n: int = 400):
    """(x in beta, visible) of n points along each ray: what a clipped segment has to agree with."""
    near, far = depths
    w = torch.linspace(0, 1, n, dtype=torch.float64)[:, None] * (1 / near - 1 / far) + 1 / far
    path = track(pair.alpha.K, pair.beta.K, pair.beta_from_alpha, x)
    P = path.a + w[..., None] * path.b
    z = P[..., 2]
    xy = P[..., :2] / torch.where(z > 0, z, 1.0)[..., None]
    return xy, (z > 2e-3) & pair.beta.contains(xy)


@settings(max_examples=60)
@given(seeds, st.sampled_from([0.1, 1.0, 3.0]))
def test_clipped_segments_hold_all_that_is_visible_and_no_more(seed, turn):
    rig = random_rig(seed, near=0.3, far=50.0, turn=turn, baseline=1.0)
    pair = rig.pair("alpha", "beta")
    x = pixel_grid(pair.alpha.hw, dtype=torch.float64)[::6, ::6].reshape(-1, 2)
    path = track(pair.alpha.K, pair.beta.K, pair.beta_from_alpha, x)
    segments = segments_between(path, *rig.depth, pair.beta.hw)
    xy, visible = sampled_visible(pair, x, rig.depth)
    assert segments.valid[visible.any(0)].all()
    assert pair.beta.contains(segments.start).all()
    assert pair.beta.contains(segments.end).all()
    fraction = ((xy - segments.start) * (segments.end - segments.start)).sum(-1)
    length = segments.length
    assert (fraction[visible] >= -1e-6).all()
    assert (fraction <= length.square() + 1e-6)[visible].all()
    off = (
        xy
        - segments.start
        - (fraction / length.square().clamp(min=1e-9))[..., None] * (segments.end - segments.start)
    )
    long = length.expand(visible.shape) > 1e-3
    assert off[visible & long].abs().max() < 1e-6 if (visible & long).any() else True
