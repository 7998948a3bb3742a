import math
from importlib import import_module

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.autograd import gradgradcheck

from arraygeom import distortion
from arraygeom.checks import derived
from arraygeom.distortion import Distortion
from arraygeom.lenses import Equirectangular
from arraygeom.lenses import brown as brown_lens
from arraygeom.lenses.fisheye import fisheye_limit
from tests.arraygeom.rigs import directions
from tests.oracles import Oracle

cv2 = Oracle("cv2")

FOCAL = 1000.0
BROWN = [-0.3, 0.12, 1e-3, -2e-3, -0.02, 0.01, 0.02, -3e-3, 1e-3, -2e-3, 1.5e-3, 7e-4, 0.03, -0.05]
FISHEYES = [
    [0.05, -0.01, 0.003, -0.0005],
    [0.0, 0, 0, 0],
    [-0.04, -0.009, 0.009, -0.004],
    [0.3, 0.2, 0.1, 0.05],
]
COUNTS = [4, 5, 8, 12, 14]


def brown(n: int = 14) -> Distortion:
    return Distortion("brown-conrady", torch.tensor(BROWN[:n], dtype=torch.float64))


def fisheye(k: list[float]) -> Distortion:
    return Distortion("kannala-brandt", torch.tensor(k, dtype=torch.float64))


def plane_points(n: int = 2000, spread: float = 0.6, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return spread * torch.randn(n, 2, dtype=torch.float64, generator=generator)


def opencv(d: Distortion, X: torch.Tensor) -> np.ndarray:
    """OpenCV's pixels for focal length 1 and no principal point, in float64."""
    coefficients, zero = d.coefficients.numpy(), np.zeros(3)
    if d.model == "kannala-brandt":
        return cv2.fisheye.projectPoints(X.numpy()[None], zero, zero, np.eye(3), coefficients)[0][0]
    return cv2.projectPoints(X.numpy(), zero, zero, np.eye(3), coefficients)[0][:, 0]


@pytest.mark.parametrize("n", COUNTS)
def test_brown_conrady_is_opencvs(n):
    X = torch.cat([plane_points(), torch.ones(2000, 1)], -1) * torch.linspace(0.1, 30, 2000)[:, None]
    xy_d, valid = brown(n).project(X.double())
    error = FOCAL * np.abs(xy_d.numpy() - opencv(brown(n), X))
    assert valid.float().mean() > 0.95
    assert error[valid.numpy()].max() < 1e-9


@pytest.mark.parametrize("k", FISHEYES)
def test_fisheye_is_opencvs(k):
    X = directions(2000)
    X = X[X[:, 2] > 0.01]
    xy_d, valid = fisheye(k).project(X)
    assert valid.float().mean() > 0.9
    assert FOCAL * np.abs(xy_d.numpy() - opencv(fisheye(k), X))[valid.numpy()].max() < 1e-9


@pytest.mark.parametrize("d", [brown(), fisheye(FISHEYES[0])], ids=lambda d: d.model)
def test_unproject_is_undistort_ahead(d):
    xy_d = plane_points(spread=0.3)
    ray, valid = d.unproject(xy_d)
    xy, valid_too = d.undistort(xy_d)
    both = valid & valid_too
    assert both.float().mean() > 0.9
    torch.testing.assert_close((ray[..., :2] / ray[..., 2:])[both], xy[both], rtol=1e-12, atol=1e-12)
    assert bool((d.distort(xy)[0] - xy_d)[both].abs().max() < 1e-12)


@settings(max_examples=150, derandomize=True)
@given(st.integers(0, 10**6), st.sampled_from(COUNTS), st.sampled_from([torch.float32, torch.float64]))
def test_any_brown_conrady_lens(seed, n, dtype):
    """Whatever the radial coefficients: nothing wild, and what is valid comes back."""
    generator = torch.Generator().manual_seed(seed)
    scale = torch.tensor([0.5, 0.5, 2e-3, 2e-3, 0.3, 0.5, 0.3, 0.1, 2e-3, 2e-3, 2e-3, 2e-3, 0.05, 0.05])
    c = (torch.randn(14, generator=generator) * scale)[:n].to(dtype)
    d, xy = Distortion("brown-conrady", c), plane_points(300, 1.0, seed).to(dtype)
    xy_d, valid = d.distort(xy)
    back, valid_back = d.undistort(xy_d)
    assert bool(xy_d.isfinite().all() & back.isfinite().all())
    if dtype == torch.float64:
        assert bool((valid_back | ~valid).all())
        assert bool((FOCAL * (back - xy)[valid].abs() < 1e-6).all())
    else:
        assert (valid & ~valid_back).sum() <= 1


def test_past_the_turn_is_invalid_and_bounded():
    """k1 = -0.1: r - 0.1 r^3 turns where 1 = 0.3 r^2, at r = 1.82574, where it is 2/3 of r."""
    d, turn = Distortion("brown-conrady", torch.tensor([-0.1, 0, 0, 0], dtype=torch.float64)), 0.3**-0.5
    xy = torch.tensor([[0, turn * 0.999], [0, turn * 1.001], [30.0, 40.0], [0, 1e30]], dtype=torch.float64)
    xy_d, valid = d.distort(xy)
    assert valid.tolist() == [True, False, False, False]
    assert xy_d.norm(dim=-1).max() <= turn * 2 / 3 + 1e-6
    _, valid_back = d.undistort(torch.tensor([[0, turn * 0.6666], [0, turn * 0.6668]], dtype=torch.float64))
    assert valid_back.tolist() == [True, False]


def test_a_second_rise_is_not_valid():
    """k1 = -1, k2 = 0.3: falls between r^2 = 0.46 and 1.4, rises again beyond; only the first rise counts."""
    d = Distortion("brown-conrady", torch.tensor([-1, 0.3, 0, 0], dtype=torch.float64))
    _, valid = d.distort(torch.tensor([[0.6, 0.0], [1.0, 0.0], [2.0, 0.0]], dtype=torch.float64))
    assert valid.tolist() == [True, False, False]


def test_points_without_a_solution_take_no_time_from_others(monkeypatch):
    """Points out of reach are not iterated, and those just beyond the turn are iterated apart."""
    lens = Distortion("brown-conrady", torch.tensor([-0.1, 0, 1e-3, 0], dtype=torch.float64))
    found, beyond = 0.8 * torch.rand(500, 2, dtype=torch.float64), torch.tensor([[1.224, 0], [3, 4]]).double()
    planar, counts = brown_lens._brown_planar, []

    def counted(of, xy):
        counts.append(len(xy))
        return planar(of, xy)

    monkeypatch.setattr(brown_lens, "_brown_planar", counted)
    xy, valid = lens.undistort(found)
    assert valid.all()
    steps = len(counts)
    both, valid = lens.undistort(torch.cat([found, beyond[1:]]))
    assert valid.tolist() == [True] * 500 + [False]
    assert torch.allclose(both[:-1], xy, rtol=0, atol=1e-13)
    assert len(counts) <= 2 * steps + brown_lens.FEW
    counts.clear()
    both, valid = lens.undistort(torch.cat([found, beyond[:1]]))
    assert valid.tolist() == [True] * 500 + [False]
    assert torch.allclose(both[:-1], xy, rtol=0, atol=1e-13)
    assert counts.count(501) <= steps + brown_lens.FEW
    assert counts.count(1) > 60


def test_poles_are_not_crossed():
    """k4 = -1: 1 / (1 - r^2) is infinite at 1 and negative beyond."""
    d = Distortion("brown-conrady", torch.tensor([0, 0, 0, 0, 0, -1.0, 0, 0], dtype=torch.float64))
    xy_d, valid = d.distort(torch.tensor([[0.9, 0.0], [1.0, 0.0], [1.1, 0.0]], dtype=torch.float64))
    assert valid.tolist() == [True, False, False]
    assert xy_d.abs().max() < 20


def test_tangential_fold_is_invalid():
    """p1 = 0.1: dy'/dy = 1 + 0.6 y, so the lens mirrors below y = -1.67; dx'/dx too below y = -5."""
    d = Distortion("brown-conrady", torch.tensor([0, 0, 0.1, 0], dtype=torch.float64))
    _, valid = d.distort(torch.tensor([[0, -1.6], [0, -1.7], [0, -7.0]], dtype=torch.float64))
    assert valid.tolist() == [True, False, False]


def test_points_behind_a_perspective_camera_are_invalid():
    X = torch.tensor(
        [[0.1, 0.1, 1], [0.1, 0.1, 0], [0.1, 0.1, -1], [0, 0, 0], [1, 0, 1e-9]], dtype=torch.float64
    )
    xy_d, valid = brown().project(X)
    assert valid.tolist() == [True, False, False, False, False]
    assert bool(xy_d.isfinite().all())


def test_fisheye_sees_behind_itself():
    """With no coefficients theta is the radius: 90 degrees right is (pi/2, 0), straight back has no image."""
    X = torch.tensor([[1, 0, 0], [0, 1, -1], [0, 0, -1], [0, 0, 0], [0, 0, 2]], dtype=torch.float64)
    xy_d, valid = fisheye([0, 0, 0, 0]).project(X)
    assert valid.tolist() == [True, True, False, False, True]
    torch.testing.assert_close(xy_d[0], torch.tensor([np.pi / 2, 0], dtype=torch.float64))
    torch.testing.assert_close(xy_d[1], torch.tensor([0, 3 * np.pi / 4], dtype=torch.float64))
    _, no_pinhole_point = fisheye([0, 0, 0, 0]).undistort(xy_d[:2])
    assert not no_pinhole_point.any()


def test_fisheye_past_the_turn():
    """k1 = -0.1 turns at theta = 1.82574, 104.6 degrees."""
    d, turn = fisheye([-0.1, 0, 0, 0]), 0.3**-0.5
    theta = torch.tensor([turn - 0.01, turn + 0.01, 3.0], dtype=torch.float64)
    xy_d, valid = d.project(torch.stack([theta.sin(), 0 * theta, theta.cos()], -1))
    assert valid.tolist() == [True, False, False]
    assert xy_d.abs().max() <= turn * 2 / 3 + 1e-6
    ray, valid = d.unproject(torch.tensor([[1.21, 0.0], [1.22, 0.0], [1e6, 0.0]], dtype=torch.float64))
    assert valid.tolist() == [True, False, False]
    torch.testing.assert_close(ray.norm(dim=-1), torch.ones(3, dtype=torch.float64))


def test_fisheye_near_the_axis_in_float32():
    d = fisheye(FISHEYES[0])
    radii = torch.logspace(-12, 0, 200, dtype=torch.float32)
    X = torch.stack([radii, -0.5 * radii, torch.ones_like(radii)], -1)
    single, valid = d.to(torch.float32).project(X)
    double, _ = d.project(X.double())
    assert bool(valid.all())
    assert ((single - double) / double).abs().max() < 1e-6
    ray, _ = d.to(torch.float32).unproject(single)
    assert ((ray[:, :2] / ray[:, 2:] - X[:, :2]) / X[:, :2]).abs().max() < 2e-6


@pytest.mark.parametrize("count", [0, 4, 5, 8, 12, 14])
def test_derivatives_at_once_are_automatic_ones(count):
    """Behind the camera, on the axis and beyond the lens's range as well."""
    lens = brown(count) if count else None
    X = torch.randn(300, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    X[:2] = torch.tensor([[0, 0, 1.0], [0, 0, -1.0]])
    copies = X.clone().requires_grad_()
    c = torch.zeros(300, 0) if lens is None else lens.coefficients.clone().requires_grad_().expand(300, -1)
    if lens is None:
        x = copies[:, :2] / torch.where(copies[:, 2:] > 0, copies[:, 2:], 1.0)
    else:
        x = lens.with_coefficients(c).project(copies[:, None])[0][:, 0]
    found = distortion.lens_derivatives(lens, X)
    assert torch.equal(found[0], x.detach())
    assert not any(part.requires_grad for part in found)
    through = (copies, c) if count else (copies,)
    for i, v in enumerate(x.unbind(-1)):
        for slope, part in zip(torch.autograd.grad(v.sum(), through, retain_graph=True), found[1:]):
            assert torch.allclose(part[:, i], slope, rtol=1e-9, atol=1e-9 * float(slope.abs().max()))


def test_derivatives_of_a_lens_without_numbers_are_by_the_points_alone():
    X = torch.randn(9, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    _, by_point, by_lens = distortion.lens_derivatives(Equirectangular(), X)
    jacobian = torch.func.vmap(torch.func.jacrev(lambda x: Equirectangular().project(x)[0]))(X)
    torch.testing.assert_close(by_point, jacobian)
    assert by_lens.shape == (9, 2, 0)


def test_derivatives_in_closed_form_have_no_tilt():
    with pytest.raises(ValueError, match="14"):
        brown_lens.brown_derivatives(brown(14).coefficients, torch.zeros(1, 2, dtype=torch.float64))


def test_fisheye_derivatives_beyond_90_degrees():
    X = torch.tensor([[1.0, 0.2, -0.3], [-0.5, 0.7, 0.0]], dtype=torch.float64, requires_grad=True)
    c = torch.tensor(FISHEYES[0], dtype=torch.float64, requires_grad=True)
    assert gradgradcheck(lambda c, X: Distortion("kannala-brandt", c).project(X)[0], (c, X))
    xy_d = Distortion("kannala-brandt", c).project(X)[0].detach().requires_grad_()
    assert gradgradcheck(lambda c, x: Distortion("kannala-brandt", c).unproject(x)[0], (c, xy_d))


def test_no_points():
    for d in (brown(), fisheye(FISHEYES[0])):
        assert d.undistort(torch.zeros(0, 2).double())[0].shape == (0, 2)
        assert d.project(torch.zeros(4, 0, 3).double())[0].shape == (4, 0, 2)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_inverse_of_any_fisheye_is_right_or_invalid(dtype):
    """Newton's steps in a bracket can cycle: of 3,000 such lenses none may be off and valid."""
    g = torch.Generator().manual_seed(0)
    k = (torch.rand(3000, 4, generator=g, dtype=torch.float64) * 2 - 1) * 0.05
    lenses = Distortion("kannala-brandt", k.to(dtype))
    end = fisheye_limit(lenses.coefficients).sqrt()
    theta = torch.linspace(0.001, 0.999, 200, dtype=torch.float64) * end[:, None]
    X = torch.stack([theta.sin(), 0 * theta, theta.cos()], -1).to(dtype)
    xy, seen = lenses.project(X)
    ray, valid = lenses.unproject(xy)
    error = (ray - X).norm(dim=-1)
    assert valid[seen].all()
    assert error[seen].max() < (1e-9 if dtype == torch.float64 else 3e-2)


@pytest.mark.parametrize("huge", [1e20, 1e76, 1e154, 1e300, float("inf"), float("nan")])
def test_lenses_of_huge_coefficients_see_nothing_but_their_middle(huge):
    xy = torch.tensor([[0.1, 0.2], [2.0, 1.0]], dtype=torch.float64)
    for model, n in ((distortion.BROWN_CONRADY, 8), (distortion.KANNALA_BRANDT, 4)):
        for i in range(n):
            if model == distortion.BROWN_CONRADY and i in (2, 3):
                continue
            for sign in (1, -1):
                c = torch.full((n,), -0.1, dtype=torch.float64)
                c[i] = sign * huge
                lens = derived(Distortion, model, c)  # as an optimiser may step to
                bent, seen = lens.distort(xy)
                back, valid = lens.undistort(bent)
                assert ((back - xy).norm(dim=-1)[seen & valid] < 1e-6).all()
                assert seen.dtype == valid.dtype == torch.bool
                if not math.isfinite(huge):
                    assert not seen.any()


@pytest.mark.parametrize("bound", ["brown.brown_limit", "fisheye.fisheye_limit"])
def test_the_bound_of_a_lens_and_of_its_copies_is_computed_once(bound, monkeypatch):
    lens = brown(4) if bound.startswith("brown") else fisheye(FISHEYES[0])
    X = torch.rand(50, 1, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) + 0.5
    module, name = bound.split(".")
    limit, counts = getattr(import_module(f"arraygeom.lenses.{module}"), name), []

    def counted(given):
        counts.append(len(given))
        return limit(given)

    monkeypatch.setattr(f"arraygeom.lenses.{bound}", counted)
    copies = lens.with_coefficients(lens.coefficients.expand(50, -1))
    each = lens.with_coefficients(lens.coefficients.repeat(50, 1))
    for _ in range(2):
        for one, other in zip(copies.project(X), each.project(X)):
            assert torch.equal(one, other)
    assert counts == [1, 50]
    with torch.inference_mode():
        copies.project(X)
    assert counts == [1, 50, 1]
