"""Rays, warps, plane sweeps and consistent depth, against kornia and closed forms."""

import pytest
import torch

from arraygeom import (
    Camera,
    Pair,
    Pose,
    Rig,
    consistent_depth,
    intrinsics,
    pixel_grid,
    plane_sweep,
    stack,
    warp,
    world_rays,
)
from tests.arraygeom.rigs import BARREL, random_rig, scene_points, two_cameras, with_lenses

F64 = torch.float64


def bent_rig(seed: int = 1) -> Rig:
    return with_lenses(random_rig(seed), BARREL, None)


def smooth(hw: tuple[int, int]) -> torch.Tensor:
    """An image (1, 2, H, W) whose values are close to linear between pixels."""
    x, y = pixel_grid(hw, dtype=F64).unbind(-1)
    return torch.stack([0.02 * x + 0.01 * y, (0.05 * x).sin()])[None]


def test_points_lie_on_their_rays():
    rig = bent_rig()
    X = scene_points(random_rig(1), 50)
    seen = rig["alpha"].project(X)
    rays = world_rays(rig["alpha"], seen.x)
    off = torch.linalg.cross(X - rays.origin, rays.direction).norm(dim=-1)
    assert float(off[rays.valid & seen.valid].max()) < 1e-9
    moment = torch.linalg.cross(X, rays.direction)  # the same from any point of the ray
    torch.testing.assert_close(rays.plucker[:, 3:], moment)
    assert world_rays(stack([rig["alpha"]] * 2)).plucker.shape == (2, 48, 64, 6)


def test_rays_of_a_batch_are_a_loop():
    cameras = [random_rig(seed)["alpha"] for seed in (1, 2)]
    both = world_rays(stack(cameras))
    for i, camera in enumerate(cameras):
        for mine, one in zip(both, world_rays(camera)):
            torch.testing.assert_close(mine[i], one)


def test_a_warp_is_kornias():
    from kornia.geometry.depth import warp_frame_depth

    rig = two_cameras(centre=(0.1, 0.05, -0.02))
    pair = rig.pair("alpha", "beta")
    g = torch.Generator().manual_seed(0)
    image = torch.rand(1, 3, 48, 64, dtype=F64, generator=g)
    depth = (1 + torch.rand(1, 48, 64, dtype=F64, generator=g)).requires_grad_()
    theirs = warp_frame_depth(image, depth[:, None], pair.beta_from_alpha.matrix[None], pair.alpha.K[None])
    ours = warp(pair, image, depth)
    inner = warp(pair, torch.ones_like(image), depth.detach() * 1.0).valid[:, None] & (theirs != 0)
    inner[..., :2, :], inner[..., -2:, :], inner[..., :3], inner[..., -3:] = False, False, False, False
    torch.testing.assert_close(ours.values[inner.expand_as(image)], theirs[inner.expand_as(image)])
    slopes = [torch.autograd.grad((v * inner).square().sum(), depth)[0] for v in (ours.values, theirs)]
    torch.testing.assert_close(*slopes)


def test_a_warp_through_a_lens_sees_what_is_there():
    """Beta's image of a plane painted in world coordinates, warped by its depth, is alpha's image of it."""
    rig = bent_rig()
    pair = rig.pair("alpha", "beta")
    depths = {}
    for name in rig.names:
        rays = world_rays(rig[name])
        s = (4.0 - rays.origin[..., 2]) / rays.direction[..., 2]
        X = rays.origin + s[..., None] * rays.direction
        depths[name] = rig[name].project(X).depth, (0.5 * X[..., 0]).sin() + 0.3 * X[..., 1]
    found = warp(pair, depths["beta"][1][None, None], depths["alpha"][0][None])
    assert float(found.valid.double().mean()) > 0.4
    inner = torch.nn.functional.pad(torch.ones(1, 1, 38, 58, dtype=F64), (1, 1, 1, 1))
    inside = warp(pair, inner, depths["alpha"][0][None]).values[0, 0] == 1
    difference = (found.values[0, 0] - depths["alpha"][1]).abs()
    assert float(difference[inside].max()) < 2e-3


def test_unknown_depths_are_not_valid():
    pair = random_rig(1).pair("alpha", "beta")
    depth = torch.tensor([0.0, -1.0, torch.nan, torch.inf]).repeat(12)[:, None].expand(48, 64)
    found = warp(pair, torch.ones(1, 1, 40, 60), depth[None])
    assert not found.valid.any()
    assert found.values.isfinite().all()


def test_warps_have_gradients():
    pair = bent_rig().pair("alpha", "beta")
    depth = torch.full((1, 48, 64), 3.0, dtype=F64)
    image, t = smooth(pair.beta.hw), pair.beta.t.clone()
    mask = torch.zeros(48, 64, dtype=torch.bool)
    mask[20:23, 30:32] = True

    def values(few, t):
        beta = pair.beta.replace(cam_from_world=Pose(pair.beta.R, t))
        return warp(Pair(pair.alpha, beta), image, depth.masked_scatter(mask, few)).values[..., mask]

    few = torch.linspace(2.5, 3.5, 6, dtype=F64)
    assert torch.autograd.gradcheck(values, [few.requires_grad_(), t.requires_grad_()], atol=1e-5)


def test_batches_and_float32_of_warps():
    rigs = [random_rig(seed) for seed in (1, 2)]
    both, image = stack(rigs).pair("alpha", "beta"), torch.cat([smooth((40, 60)), smooth((40, 60)) ** 2])
    depth = torch.stack([torch.full((48, 64), 2.0, dtype=F64), torch.full((48, 64), 4.0, dtype=F64)])
    found = warp(both, image, depth)
    swept = plane_sweep(both, image, torch.tensor([2.0, 4.0], dtype=F64))
    for i, rig in enumerate(rigs):
        one = warp(rig.pair("alpha", "beta"), image[i : i + 1], depth[i : i + 1])
        torch.testing.assert_close(found.values[i], one.values[0])
        torch.testing.assert_close(swept.values[i, :, i], one.values[0])
    same = warp(both, image[:1], depth[:1])
    alike = plane_sweep(both, image[:1], torch.tensor([2.0, 4.0], dtype=F64))
    for i, rig in enumerate(rigs):
        one = warp(rig.pair("alpha", "beta"), image[:1], depth[:1])
        torch.testing.assert_close(same.values[i], one.values[0])
        torch.testing.assert_close(alike.values[i, :, 0], one.values[0])
    single = warp(rigs[0].to(torch.float32).pair("alpha", "beta"), image[:1].float(), depth[:1].float())
    valid = single.valid[0] & found.valid[0]
    assert float((single.values[0] - found.values[0]).abs()[:, valid].max()) < 1e-5


def plane_depths(rig: Rig) -> dict[str, torch.Tensor]:
    """Depth maps of the plane z = 4 of the world, tilted by a tenth."""
    depths = {}
    for name in rig.names:
        rays = world_rays(rig[name])
        normal = torch.tensor([0.1, 0.0, 1.0], dtype=F64)
        s = (4.0 - rays.origin @ normal) / (rays.direction @ normal)
        depths[name] = rig[name].project(rays.origin + s[..., None] * rays.direction).depth
    return depths


def test_depth_maps_that_agree_are_fused():
    rig = bent_rig()
    depths = plane_depths(rig)
    g = torch.Generator().manual_seed(0)
    noisy = {n: d * (1 + 2e-3 * torch.randn(d.shape, generator=g, dtype=F64)) for n, d in depths.items()}
    noisy["alpha"][10:20, 10:20] *= 1.3
    noisy["alpha"][0, 0] = torch.nan
    found = consistent_depth(rig, noisy, "alpha")
    shared = warp(
        rig.pair("alpha", "beta"), torch.ones(1, 1, 40, 60, dtype=F64), depths["alpha"][None]
    ).valid[0]
    wrong = torch.zeros_like(shared)
    wrong[10:20, 10:20], wrong[0, 0] = True, True
    assert not found.valid[wrong].any()
    assert float(found.valid[shared & ~wrong].double().mean()) > 0.95
    errors = [(d - depths["alpha"]).abs()[found.valid].mean() for d in (found.depth, noisy["alpha"])]
    assert errors[0] < 0.9 * errors[1]
    assert not consistent_depth(rig, noisy, "alpha", views=2).valid.any()


def test_float32_rays_at_12_megapixels():
    camera = Camera(K=intrinsics(4000.0, (3000, 4000)), cam_from_world=Pose.identity(), hw=(3000, 4000))
    x = torch.rand(1000, 2, generator=torch.Generator().manual_seed(0)) * torch.tensor([4000.0, 3000])
    exact, single = world_rays(camera, x.double()), world_rays(camera.to(torch.float32), x)
    assert float((exact.direction - single.direction).abs().max()) * 4000 < 1e-3


def test_planes_of_another_size_than_their_camera_are_refused():
    camera = Camera(K=intrinsics(10.0, (8, 10)), hw=(8, 10), cam_from_world=Pose.identity())
    rig = Rig({"a": camera, "b": camera})
    with pytest.raises(ValueError, match=r"\(4, 5\).*\(8, 10\)"):
        warp(rig.pair("a", "b"), torch.ones(1, 3, 4, 5), torch.ones(1, 8, 10))
    with pytest.raises(ValueError, match="'b'"):
        consistent_depth(rig, {"a": torch.ones(8, 10), "b": torch.ones(4, 5)}, "a")
    with pytest.raises(ValueError, match="'a'"):
        consistent_depth(rig, {"b": torch.ones(8, 10)}, "a")
