import numpy as np
import pytest
import torch

from arraygeom import (
    Epipolar,
    HomographyDisplacement,
    Pair,
    Pose,
    apply_homography,
    approximated,
    fit_homography,
    fit_similarity,
    sampling_locations,
)
from arraygeom.fields import covering_displacement
from arraygeom.pixels import coarse_grid, pixel_grid
from tests.arraygeom.rigs import random_rig, two_cameras, uniform
from tests.oracles import Oracle

cv2 = Oracle("cv2")
optimize = Oracle("scipy.optimize")


def noisy_points(seed: int = 0, n: int = 40) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    x = uniform(g, 0, 600, n, 2)
    H = torch.tensor([[1.1, 0.1, 30], [-0.08, 0.9, -12], [1e-4, -2e-4, 1]], dtype=torch.float64)
    return x, apply_homography(H, x).x + torch.randn(n, 2, generator=g, dtype=torch.float64)


def residual(h: np.ndarray, x: torch.Tensor, y: torch.Tensor) -> np.ndarray:
    H = torch.from_numpy(np.append(h, 1.0).reshape(3, 3))
    return (apply_homography(H, x).x - y).numpy().ravel()


def test_fitted_homography_is_scipys_least_squares():
    x, y = noisy_points()
    H = fit_homography(x, y)
    ours = (H / H[2, 2]).numpy().ravel()[:8]
    best = optimize.least_squares(
        residual, ours, args=(x, y), x_scale=np.abs(ours), xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    cost = 0.5 * np.square(residual(ours, x, y)).sum()
    assert cost == pytest.approx(best.cost, rel=1e-9)


def test_fitted_homography_is_exact_without_noise_and_keeps_its_sign():
    x, _ = noisy_points()
    H = torch.tensor([[1.1, 0.1, 30], [-0.08, 0.9, -12], [1e-4, -2e-4, 1]], dtype=torch.float64)
    transformed = apply_homography(H, x)
    fitted = fit_homography(x, transformed.x)
    torch.testing.assert_close(fitted / fitted[2, 2], H, atol=1e-9, rtol=1e-9)
    assert apply_homography(fitted, x).valid.all()


def test_fitted_similarity_is_opencvs():
    x, y = noisy_points()
    expected, _ = cv2.estimateAffinePartial2D(x.numpy(), y.numpy(), method=cv2.LMEDS, maxIters=1)
    H = fit_similarity(x, y)
    off = (apply_homography(H, x).x - y).square().sum()
    theirs = np.square(x.numpy() @ expected[:, :2].T + expected[:, 2] - y.numpy()).sum()
    assert off <= theirs + 1e-6
    turned = torch.tensor([[0.0, -2, 5], [2, 0, 7], [0, 0, 1]], dtype=torch.float64)
    torch.testing.assert_close(fit_similarity(x, apply_homography(turned, x).x), turned, atol=1e-9, rtol=0)


@pytest.mark.parametrize("fit", [fit_homography, fit_similarity])
def test_fits_are_differentiable(fit):
    x, y = noisy_points(n=8)
    x, y = (v.div(300).requires_grad_() for v in (x, y))

    def shape(x, y):
        H = fit(x, y)
        return H / H[2, 2]

    assert torch.autograd.gradcheck(shape, (x, y), atol=1e-4, rtol=1e-3)


def placement_error(pair):
    """Root mean square distance in pixels from H x to the middles of the pair's depth-bounded segments."""
    x = coarse_grid(pair.alpha.hw).to(pair.cameras[0].K)
    segments = Epipolar()(pair, x)
    transformed = apply_homography(pair.homography, x)
    off = (transformed.x - 0.5 * (segments.start + segments.end)).square().sum(-1)
    return off[segments.valid & transformed.valid].mean().sqrt()


@pytest.mark.parametrize("seed", range(4))
def test_fits_place_the_middles_better_than_the_middle_plane(seed):
    pair = random_rig(seed, near=1.0, far=30.0).pair("alpha", "beta")
    plane, homography = (placement_error(p) for p in (pair, approximated(pair)))
    assert homography < plane


def test_the_approximation_covers_near_to_far():
    pair = approximated(random_rig(1).pair("alpha", "beta"))
    x = pixel_grid(pair.alpha.hw, dtype=torch.float64)
    exact, rough = Epipolar()(pair, x), sampling_locations(HomographyDisplacement(), pair, x)
    assert rough.valid[exact.valid].all()
    for end in (exact.start, exact.end):
        on = rough.at(rough.fraction(end).clamp(0, 1))
        assert (on - end)[exact.valid].norm(dim=-1).max() < 1e-6
    assert rough.length.max() <= 2 * covering_displacement(pair) + 1e-6


def test_the_approximation_is_differentiable_in_the_rig():
    rig = random_rig(5)
    pair = rig.pair("alpha", "beta")

    def fitted(t, near):
        beta = pair.beta.replace(cam_from_world=Pose(pair.beta.R, t))
        H = approximated(Pair(pair.alpha, beta, (near, pair.depth[1]))).homography
        return H / H[2, 2]

    inputs = [v.detach().clone().requires_grad_() for v in (pair.beta.t, pair.depth[0])]
    assert torch.autograd.gradcheck(fitted, inputs, atol=1e-3, rtol=1e-2)


def test_nothing_in_common_is_said():
    with pytest.raises(ValueError, match="next to nothing"):
        approximated(two_cameras(centre=(0, 0, 30.0)).pair("alpha", "beta"))
