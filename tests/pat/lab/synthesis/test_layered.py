from typing import NamedTuple

import cv2
import numpy as np
import pytest
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from arraygeom.camera import Camera, intrinsics
from arraygeom.pixels import pixel_grid
from arraygeom.pose import Pose, rotation_from_vector
from arraygeom.sampling import sample
from pat.lab.synthesis.layered import ArrayBatch, LayeredScenes
from pat.lab.synthesis.patterns import patterns
from pat.lab.synthesis.photos import PhotoBank
from pat.lab.synthesis.rig_distribution import RigDistribution
from pat.lab.synthesis.rigs import RigBatch

HW = (48, 128)


class Across(NamedTuple):
    """Correspondence of every pixel of one view: position in another, visibility, and colour there."""

    x: Float[Tensor, "b h w 2"]
    visible: Bool[Tensor, "b h w"]
    image: Float[Tensor, "b 3 h w"]


def transferred(batch: ArrayBatch, alpha: int = 0, beta: int = 1, *, tolerance: float = 0.01) -> Across:
    """Follow every pixel of view `alpha` into view `beta` by its depth.

    Visible means on beta's image and as far from beta as the surface recorded there, to the relative
    `tolerance`. Inverse depth is interpolated, which is exact on planes; points beside an edge in beta count
    as not visible.
    """
    a, b = batch.cameras[alpha], batch.cameras[beta]
    grid = pixel_grid(a.hw, device=batch.images[alpha].device).flatten(0, 1).expand(len(a.K), -1, 2)
    x, depth, in_front = b.project(a.unproject(grid, batch.depth[alpha].flatten(1)))
    seen = sample(torch.cat([batch.images[beta], 1 / batch.depth[beta][:, None]], 1), x)
    same = (seen.values[:, 3] * depth - 1).abs() < tolerance
    visible = in_front & seen.valid & same
    h, w = a.hw
    return Across(
        x.unflatten(1, (h, w)), visible.unflatten(1, (h, w)), seen.values[:, :3].unflatten(2, (h, w))
    )


@pytest.fixture(scope="module")
def smooth() -> PhotoBank:
    """Textures without fine detail, so that differences between views are due to geometry alone."""
    rng = np.random.default_rng(0)
    return PhotoBank(
        [cv2.GaussianBlur(p, (0, 0), 5) for i, p in enumerate(patterns(rng, 40)) if i % 5 in (0, 4)]
    )


@pytest.fixture(scope="module")
def rich() -> PhotoBank:
    return PhotoBank(patterns(np.random.default_rng(1), 20))


def draw(bank: PhotoBank, rigs: RigDistribution, batch: int = 4, seed: int = 0) -> ArrayBatch:
    return LayeredScenes(bank, rigs, hw=HW).sample(batch, torch.Generator().manual_seed(seed))


def mean_shift(batch: ArrayBatch) -> torch.Tensor:
    """Least-squares displacement (x, y), alpha's pixels, of beta's colours against alpha's, off outlines."""
    across = transferred(batch)
    dy, dx = torch.gradient(batch.images[0], dim=(-2, -1))
    difference = across.image - batch.images[0]
    keep = (across.visible & (difference.abs().amax(1) < 0.03))[:, None].expand_as(dx)
    A = torch.stack([dx[keep], dy[keep]], -1).double()
    return torch.linalg.lstsq(A, difference[keep].double()[:, None]).solution[:, 0]


@pytest.mark.parametrize("mode", ["rectified", "general"])
@pytest.mark.parametrize("resolution", [1.0, 0.5, 0.25])
def test_depth_and_cameras_predict_the_other_view(smooth, mode, resolution):
    batch = draw(smooth, RigDistribution(mode=mode, resolutions=(resolution,), focal_ratio=(0.8, 1.25)))
    across = transferred(batch)
    assert across.visible.float().mean() > 0.3
    error = (across.image - batch.images[0]).abs().amax(1)[across.visible]
    assert error.median() < 0.005
    assert error.quantile(0.9) < 0.06


@pytest.mark.parametrize("mode", ["rectified", "general"])
@pytest.mark.parametrize("resolution", [1.0, 0.5, 0.25])
def test_no_shift_between_views_of_different_resolution(smooth, mode, resolution):
    batch = draw(
        smooth, RigDistribution(mode=mode, resolutions=(resolution,), focal_ratio=(0.8, 1.25)), 12, 3
    )
    assert mean_shift(batch).abs().max() < 0.02


def test_occlusion_is_seen_from_both_sides(rich):
    """A point that alpha sees and beta's image covers is either visible there or behind a nearer one."""
    batch = draw(rich, RigDistribution(resolutions=(1.0,)), 8)
    across = transferred(batch)
    inside = batch.cameras[1].contains(across.x)
    hidden = inside & ~across.visible
    assert 0.005 < hidden.float().mean() < 0.4
    x, y = across.x.round().long().unbind(-1)
    b = torch.arange(8)[:, None, None]
    nearest = batch.depth[1][b, y.clamp(0, HW[0] - 1), x.clamp(0, HW[1] - 1)]
    assert (nearest < 1.01 * batch.depth[0])[hidden].float().mean() > 0.9


def test_rectified_rigs_have_rows_in_common_and_the_wanted_side(rich):
    for side, sign in (("left", 1), ("right", -1)):
        rigs = RigDistribution(alpha=side, resolutions=(0.5,))
        batch = draw(rich, rigs)
        x = transferred(batch).x
        rows = torch.arange(HW[0])[:, None].expand(HW).float()
        torch.testing.assert_close(x[..., 1], ((rows + 0.5) * 0.5 - 0.5).expand(4, *HW), atol=1e-3, rtol=0)
        columns = torch.arange(HW[1]).float()
        disparity = columns - (2 * (x[..., 0] + 0.5) - 0.5)
        assert (sign * disparity > 0).all()
        assert disparity.abs().max() < 130


def test_everything_is_covered_and_within_bounds(rich):
    for mode in ("rectified", "general"):
        batch = draw(rich, RigDistribution(mode=mode, betas=2), 8, 5)
        assert [len(x) for x in (batch.images, batch.depth, batch.cameras)] == [3, 3, 3]
        for image, depth, hw in zip(batch.images, batch.depth, (c.hw for c in batch.cameras)):
            assert image.shape == (8, 3, *hw)
            assert depth.shape == (8, *hw)
            assert ((depth > 0) & depth.isfinite()).all()
            assert ((image >= 0) & (image <= 1)).all()
        near, far = batch.depth_range.unbind(-1)
        assert (near < far).all()


def test_same_seed_same_samples(rich):
    rigs = RigDistribution(mode="general")
    one, two, other = (draw(rich, rigs, 2, seed) for seed in (7, 7, 8))
    assert torch.equal(one.images[1], two.images[1])
    assert torch.equal(one.depth[0], two.depth[0])
    assert not torch.equal(one.images[0], other.images[0])


def test_a_given_rig_keeps_its_cameras(rich):
    K = intrinsics(300.0, (60, 90))[None]
    still = Pose(torch.eye(3, dtype=torch.float64)[None], torch.zeros(1, 3, dtype=torch.float64))
    turned = Pose(
        rotation_from_vector(torch.tensor([[0.02, -0.03, 0.1]]).double()),
        torch.tensor([[0.2, 0.1, 0]]).double(),
    )
    cameras = [
        Camera(K=K, cam_from_world=still, hw=(60, 90)),
        Camera(K=K * 1.0, cam_from_world=turned, hw=(50, 80)),
    ]
    rig = RigBatch(cameras, torch.tensor([2.0]).double(), torch.tensor([10.0]).double())
    scenes = LayeredScenes(rich, RigDistribution(), hw=HW)
    batch = scenes.render(rig, torch.Generator().manual_seed(0), oversampling=2)
    assert [c.hw for c in batch.cameras] == [(60, 90), (50, 80)]
    torch.testing.assert_close(batch.cameras[1].R.double(), turned.R)
    assert 1.9 < batch.depth[0].min() < batch.depth[0].max() < 14


def test_a_pixel_without_a_layer_has_no_index(rich):
    K = intrinsics(64.0, HW)[None]
    poses = [rotation_from_vector(torch.tensor([[0.0, angle, 0.0]]).double()) for angle in (0.0, np.pi)]
    cameras = [Camera(K=K, cam_from_world=Pose(R, torch.zeros(1, 3).double()), hw=HW) for R in poses]
    rig = RigBatch(cameras, torch.tensor([1.0]).double(), torch.tensor([10.0]).double())
    batch = LayeredScenes(rich, RigDistribution(), hw=HW).render(rig, torch.Generator().manual_seed(0))
    assert batch.depth[1].isinf().any()
    assert torch.equal(batch.index[1] == 0, batch.depth[1].isinf())
    assert (batch.index[0] > 0).all()


def test_chroma_is_not_a_function_of_luminance(rich):
    """At one luminance the spread of chroma is as large as that of chroma overall."""
    image = draw(rich, RigDistribution(), 16).images[0].movedim(1, 0).flatten(1)
    luminance = torch.tensor([0.299, 0.587, 0.114]) @ image
    chroma = image[2] - luminance
    middle = (luminance - 0.5).abs() < 0.03
    assert chroma[middle].std() > 0.8 * chroma.std() > 0.05
