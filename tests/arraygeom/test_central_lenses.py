"""Other tools' lens models against those tools' own formulas, written in plain numpy, and themselves."""

import math

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

from arraygeom import Camera, Curved, Pose, Rig, intrinsics, unchecked
from arraygeom.distortion import COEFFICIENT_COUNTS, LENS_TERMS, Distortion
from arraygeom.lenses import PolynomialFisheye
from arraygeom.lenses.central import MODELS
from arraygeom.lenses.model import LensModel
from tests.arraygeom.rigs import directions
from tests.arraygeom.test_distortion import BROWN, COUNTS, FISHEYES


def double_sphere(X, xi, alpha):
    """Usenko et al. 2018, equations 40 to 42. Valid: in the cone of the second sphere, where the radius
    rises; their cone about the axis (w2) is a little wider or narrower."""
    x, y, z = X.T
    d1 = np.sqrt(x**2 + y**2 + z**2)
    d2 = np.sqrt(x**2 + y**2 + (xi * d1 + z) ** 2)
    w1 = alpha / (1 - alpha) if alpha <= 0.5 else (1 - alpha) / alpha
    m = np.stack([x, y], -1) / (alpha * d2 + (1 - alpha) * (xi * d1 + z))[:, None]
    return m, xi * d1 + z > -w1 * d2


def extended_unified(X, alpha, beta):
    """Khomutenko et al. 2016; Kalibr's EXTENDED UNIFIED."""
    x, y, z = X.T
    d = np.sqrt(beta * (x**2 + y**2) + z**2)
    w = alpha / (1 - alpha) if alpha <= 0.5 else (1 - alpha) / alpha
    return np.stack([x, y], -1) / (alpha * d + (1 - alpha) * z)[:, None], z > -w * d


def unified(X, xi, k1, k2, p1, p2):
    """Kalibr's OmniProjection and RadialTangentialDistortion."""
    d = np.linalg.norm(X, axis=-1)
    m = X[:, :2] / (X[:, 2] + xi * d)[:, None]
    seen = X[:, 2] > -(xi if xi <= 1 else 1 / xi) * d
    mx2, my2, mxy = m[:, 0] ** 2, m[:, 1] ** 2, m[:, 0] * m[:, 1]
    rho2 = mx2 + my2
    rad = k1 * rho2 + k2 * rho2**2
    u = m[:, 0] + m[:, 0] * rad + 2 * p1 * mxy + p2 * (rho2 + 2 * mx2)
    v = m[:, 1] + m[:, 1] * rad + 2 * p2 * mxy + p1 * (rho2 + 2 * my2)
    return np.stack([u, v], -1), seen


def fov(X, omega):
    """COLMAP's FOVCameraModel."""
    uv = X[:, :2] / X[:, 2:]
    radius = np.linalg.norm(uv, axis=-1)
    factor = np.arctan(radius * 2 * np.tan(omega / 2)) / (radius * omega)
    return uv * factor[:, None], X[:, 2] > 0


def thin_prism_fisheye(X, k1, k2, p1, p2, k3, k4, sx1, sy1):
    """COLMAP's ThinPrismFisheyeCameraModel."""
    uv = X[:, :2] / X[:, 2:]
    r = np.linalg.norm(uv, axis=-1)
    u, v = (uv * (np.arctan(r) / r)[:, None]).T
    u2, uv, v2 = u * u, u * v, v * v
    r2 = u2 + v2
    radial = k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
    du = u * radial + 2 * p1 * uv + p2 * (r2 + 2 * u2) + sx1 * r2
    dv = v * radial + 2 * p2 * uv + p1 * (r2 + 2 * v2) + sy1 * r2
    return np.stack([u + du, v + dv], -1), X[:, 2] > 0


def scaramuzza(X, b2, b3, b4):
    """The smallest radius whose direction (r, 1 + b2 r^2 + b3 r^3 + b4 r^4) is the point's, by `np.roots`."""
    points, seen = np.zeros((len(X), 2)), np.zeros(len(X), bool)
    for i, (x, y, z) in enumerate(X):
        rho = math.hypot(x, y)
        roots = np.roots([b4, b3, b2, -z / rho, 1])
        real = sorted(r.real for r in roots if abs(r.imag) < 1e-9 * abs(r) and r.real > 0)
        if real:
            points[i], seen[i] = np.array([x, y]) / rho * real[0], True
    return points, seen


def polynomial_fisheye(X, k2, k3, k4):
    rho, angle = np.hypot(X[:, 0], X[:, 1]), np.arctan2(np.hypot(X[:, 0], X[:, 1]), X[:, 2])
    r = np.polyval([k4, k3, k2, 1, 0], angle)
    rising = [np.polyval([4 * k4, 3 * k3, 2 * k2, 1], np.linspace(0, a, 200)).min() > 0 for a in angle]
    return X[:, :2] / rho[:, None] * r[:, None], np.array(rising)


FORMULAS = {
    "double-sphere": (double_sphere, [(-0.2, 0.57), (0.3, 0.4), (-0.6, 0.9), (0.0, 0.0)]),
    "extended-unified": (extended_unified, [(0.6, 1.1), (0.4, 0.9), (1.0, 1.0), (0.0, 2.0)]),
    "unified": (
        unified,
        [(0.9, -0.1, 0.02, 1e-3, -2e-3), (1.7, -0.2, 0.05, 0, 0), (0.0, 0.1, 0.0, 0.0, 1e-3)],
    ),
    "fov": (fov, [(0.9,), (1.6,), (1e-4,)]),
    "thin-prism-fisheye": (
        thin_prism_fisheye,
        [(0.05, -0.01, 1e-3, -2e-3, 3e-3, -5e-4, 1e-3, -7e-4), (-0.03, 0, 0, 0, 0, 0.002, 0, 0), (0.0,) * 8],
    ),
    "polynomial-fisheye": (polynomial_fisheye, [(0.006, -0.056, 0.0), (-0.1, 0.02, 0.004), (0.0, 0.0, 0.0)]),
    "scaramuzza": (scaramuzza, [(-0.3, 0.02, -0.01), (-0.2, 0.0, 0.0), (0.05, -0.1, -0.02), (0.0, 0.0, 0.0)]),
}
CASES = [(model, c) for model, (_, sets) in FORMULAS.items() for c in sets]
EVERY = [
    *CASES,
    *(("brown-conrady", tuple(BROWN[:n])) for n in COUNTS),
    *(("kannala-brandt", tuple(k)) for k in FISHEYES),
]
BEHIND = ("double-sphere", "extended-unified", "unified", "polynomial-fisheye", "scaramuzza")


def lens(model: str, c, dtype=torch.float64) -> LensModel:
    if model == "polynomial-fisheye":
        return PolynomialFisheye(torch.as_tensor(c, dtype=dtype))
    return Distortion(model, torch.as_tensor(c, dtype=dtype))


def test_every_model_is_tested_and_has_names_and_sizes_for_refinement():
    assert {"brown-conrady", "kannala-brandt", *FORMULAS} == {"polynomial-fisheye", *COEFFICIENT_COUNTS}
    for name, counts in COEFFICIENT_COUNTS.items():
        assert len(LENS_TERMS[name]) == counts[-1]
    for name, model in MODELS.items():
        assert COEFFICIENT_COUNTS[name] == (len(model.harmless),)


@pytest.mark.parametrize(("model", "c"), CASES)
def test_the_tools_own_formula(model, c):
    """Where both are valid; directions where the formula is and we are not: few, at the very border."""
    X = directions(3000) * torch.linspace(0.1, 30, 3000)[:, None]
    if model not in BEHIND:
        X = X[X[:, 2] > 0.02 * X.norm(dim=-1)]
    found, valid = lens(model, c).project(X)
    expected, seen = FORMULAS[model][0](X.numpy(), *c)
    assert not (valid.numpy() & ~seen).any()
    radius = np.linalg.norm(expected, axis=-1)
    missed = seen & ~valid.numpy()
    # the polynomials turn back somewhere
    if model == "thin-prism-fisheye" or (model == "unified" and any(c[1:])):
        assert missed.mean() < 0.35
    else:
        assert (radius[missed] > 300).all() or missed.mean() < 0.002
    assert valid.float().mean() > 0.2
    error = np.abs(found.numpy() - expected)[valid.numpy()]
    assert (error / (1 + radius[valid.numpy(), None])).max() < 1e-11


@pytest.mark.parametrize(("model", "c"), EVERY)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_round_trips(model, c, dtype):
    d, X = lens(model, c, dtype), directions(3000).to(dtype)
    xy_d, valid = d.project(X)
    ray, back = d.unproject(xy_d)
    assert xy_d.isfinite().all()
    assert ray.isfinite().all()
    assert (ray.norm(dim=-1) - 1).abs().max() < 1e-5
    close = valid & (xy_d.norm(dim=-1) < 20)
    assert close.float().mean() > 0.2
    assert (back | ~close).all() if dtype == torch.float64 else (close & ~back).sum() <= 3
    error = (ray - X).norm(dim=-1)[close & back]
    assert error.max() < (2e-9 if dtype == torch.float64 else 2e-2)
    assert error.median() < (1e-13 if dtype == torch.float64 else 1e-5)
    again, _ = d.project(ray)
    assert ((again - xy_d).norm(dim=-1) / (1 + xy_d.norm(dim=-1)))[close & back].max() < (
        1e-9 if dtype == torch.float64 else 1e-3
    )


@pytest.mark.parametrize(("model", "c"), EVERY)
def test_every_pixel_has_one_ray_or_is_not_valid(model, c):
    """Pixels of a wide area: what is valid comes back, what is not stays finite, both have gradients."""
    xy_d = (torch.rand(2000, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) - 0.5) * 8
    xy_d[0], xy_d[1] = torch.nan, torch.inf
    xy_d.requires_grad_()
    coefficients = torch.tensor(c, dtype=torch.float64, requires_grad=True)
    ray, valid = lens(model, coefficients).unproject(xy_d)
    assert not valid[:2].any()
    assert valid.any()
    again, seen = lens(model, coefficients).project(ray)
    assert (seen | ~valid).float().mean() > 0.995
    assert (again - xy_d).norm(dim=-1)[valid & seen].max() < 1e-7
    slopes = torch.autograd.grad(ray.sum() + again.sum(), (xy_d, coefficients))
    assert all(slope.isfinite().all() for slope in slopes)


@pytest.mark.parametrize(("model", "c"), EVERY)
def test_gradients_are_finite_everywhere(model, c):
    X = torch.cat(
        [directions(300), torch.tensor([[0, 0, 0], [0, 0, 1], [0, 0, -1], [1, 0, 0], [0, -1e-200, -1]])]
    )
    X = X.double().requires_grad_()
    coefficients = torch.tensor(c, dtype=torch.float64, requires_grad=True)
    xy_d, valid = lens(model, coefficients).project(X)
    assert xy_d.isfinite().all()
    assert not valid[300]
    assert valid[301]
    assert not valid[302]
    assert all(slope.isfinite().all() for slope in torch.autograd.grad(xy_d.sum(), (X, coefficients)))


@pytest.mark.parametrize(("model", "c"), EVERY)
def test_derivatives(model, c):
    X = torch.tensor(
        [[0.2, -0.1, 1.0], [0.5, 0.6, 0.9], [1e-3, 0.0, 2.0]], dtype=torch.float64, requires_grad=True
    )
    low = torch.tensor(c, dtype=torch.float64)
    at_bound = model != "thin-prism-fisheye" and model != "scaramuzza" and any(v in (0.0, 1.0) for v in c)
    coefficients = low.clone().requires_grad_(not at_bound)
    xy_d = lens(model, c).project(X)[0].detach().requires_grad_()
    for method, points in (("project", X), ("unproject", xy_d)):

        def f(k, p, method=method):
            return getattr(lens(model, k), method)(p)[0]

        assert gradcheck(f, (coefficients, points))
        assert gradgradcheck(f, (coefficients, points))


def test_the_axis_is_straight_in_float32():
    for model, c in EVERY:
        if model in ("double-sphere", "unified", "fov") or len(c) == len(BROWN):
            continue  # their scale on the axis is not 1, or they are tilted
        for method in ("distort", "undistort"):
            found = torch.autograd.functional.jacobian(
                lambda x, m=model, k=c, f=method: getattr(lens(m, k, x.dtype), f)(x)[0], torch.zeros(2)
            )
            torch.testing.assert_close(found, torch.eye(2))


OPENCVS = {"brown-conrady": BROWN, "kannala-brandt": FISHEYES[0]}


@pytest.mark.parametrize("model", [*FORMULAS, *OPENCVS])
def test_a_batch_of_lenses_is_each_lens(model):
    sets = FORMULAS[model][1][:2] if model in FORMULAS else np.outer((0.5, 1.5), OPENCVS[model])
    batch, xy = lens(model, sets), directions(2 * 40)[:, :2].reshape(2, 4, 10, 2) * 0.4
    for method in ("distort", "undistort", "unproject"):
        values, valid = getattr(batch, method)(xy)
        for i, c in enumerate(sets):
            one, one_valid = getattr(lens(model, c), method)(xy[i])
            torch.testing.assert_close(values[i], one, rtol=1e-9, atol=1e-9)
            assert torch.equal(valid[i], one_valid)


@pytest.mark.parametrize(
    ("model", "c"),
    [
        ("double-sphere", (1.5, 0.5)),
        ("double-sphere", (0.0, -0.1)),
        ("extended-unified", (0.5, 0.0)),
        ("unified", (-0.1, 0, 0, 0, 0)),
        ("fov", (0.0,)),
        ("fov", (3.5,)),
        ("scaramuzza", (math.nan, 0, 0)),
        ("thin-prism-fisheye", (math.inf, 0, 0, 0, 0, 0, 0, 0)),
    ],
)
def test_coefficients_that_are_no_lens_see_nothing(model, c):
    with unchecked():
        made = lens(model, c)
    for method, points in (("project", directions(50)), ("unproject", directions(50)[:, :2])):
        values, valid = getattr(made, method)(points)
        assert not valid.any()
        assert values.isfinite().all()


@pytest.mark.parametrize(("model", "c"), CASES)
def test_curved_fields_hold_the_points_that_beta_sees(model, c):
    """Points on rays of alpha, projected explicitly by the tool's formula, lie at the field's positions."""
    view = {"hw": (60, 80), "distortion": lens(model, c)}
    K = intrinsics(24.0, (60, 80))
    beta = Pose.from_centre(
        torch.eye(3, dtype=torch.float64), torch.tensor([0.4, 0.1, 0.0], dtype=torch.float64)
    )
    rig = Rig(
        {
            "alpha": Camera(K=K, cam_from_world=Pose.identity(), **view),
            "beta": Camera(K=K, cam_from_world=beta, **view),
        },
        depth=(0.5, 20.0),
    )
    x = torch.tensor([[40.0, 30], [20, 12], [60, 50], [30, 40]], dtype=torch.float64)
    found = Curved(96)(rig.pair("alpha", "beta"), x)
    rays, seen = rig["alpha"].rays(x)
    checked = 0
    for i in range(len(x)):
        if not seen[i] or rays[i, 2] < 0.05:
            continue
        depth = 1 / np.linspace(1 / 20, 1 / 0.5, 60)
        X = (rays[i] / rays[i, 2]).numpy() * depth[:, None] + beta.t.numpy()
        points, valid = FORMULAS[model][0](X, *c)
        points = points @ K[:2, :2].numpy() + K[:2, 2].numpy()
        inside = valid & ((points > 0.5) & (points < [78.5, 58.5])).all(-1)
        xy = found.xy[i][found.mask[i]].numpy()
        for p in points[inside]:
            assert np.linalg.norm(xy - p, axis=-1).min() < 0.75
            checked += 1
    assert checked > 50
