"""Residuals and bundle adjustment, against SciPy."""

import numpy as np
import pytest
import torch

from arraygeom import Rig, bundle_adjusted, reprojection_residuals, stack, triangulate
from arraygeom.reprojection import projection_slopes
from tests.arraygeom.test_triangulation import array_of, seen_points
from tests.oracles import Oracle

optimize = Oracle("scipy.optimize")
FREE = ["b.rotation", "c.rotation", "c.translation", "a.focal"]


def bundle(noise: float = 0.3, n: int = 12) -> tuple[Rig, torch.Tensor, torch.Tensor]:
    """A rig that is a little wrong, its points as it triangulates them, and their noisy pixels."""
    cameras = array_of(3)
    X, x = seen_points(cameras, n, noise=noise)
    rig = Rig(dict(zip("abc", cameras)))
    changes = {
        name: 0.003 * torch.randn_like(zero) for name, zero in rig.parameters(free=["*.rotation"]).items()
    }
    return rig.perturbed(changes), X, x


def test_slopes_are_those_of_autograd():
    camera = array_of(1)[0]
    X, _ = seen_points([camera, camera], 5)
    J = torch.func.vmap(torch.func.jacrev(lambda X: camera.project(X).x))(X)
    torch.testing.assert_close(
        projection_slopes(camera, X, (X - camera.centre).norm(dim=-1))[1], J, rtol=1e-8, atol=1e-7
    )


def test_residuals_are_what_is_left():
    cameras = array_of(3)
    X, x = seen_points(cameras, 8)
    shift = torch.tensor([0.5, -1.0])
    seen = torch.ones(3, 8, dtype=torch.bool)
    seen[1, 3] = False
    r = reprojection_residuals(cameras, X, x + shift, seen=seen)
    torch.testing.assert_close(r, torch.where(seen[..., None], shift.double(), 0.0).expand_as(r))


def test_adjustment_reaches_scipys_optimum():
    torch.manual_seed(0)
    rig, X, x = bundle()
    found = bundle_adjusted(rig, X, x, free=FREE, steps=12)
    names = {n: z.shape for n, z in rig.parameters(free=FREE).items()}
    sizes = [int(np.prod(s)) for s in names.values()]

    def residuals(v):
        v = torch.from_numpy(v)
        parts = v[: sum(sizes)].split(sizes)
        moved = rig.perturbed({n: p.reshape(s) for (n, s), p in zip(names.items(), parts)})
        return (
            reprojection_residuals(list(moved.cameras.values()), v[sum(sizes) :].reshape(-1, 3), x)
            .flatten()
            .numpy()
        )

    best = optimize.least_squares(
        residuals, np.r_[np.zeros(sum(sizes)), X.flatten().numpy()], xtol=1e-14, ftol=1e-14
    )
    assert abs(float(found.cost[-1]) / (2 * best.cost) - 1) < 1e-6
    assert (found.cost.diff() <= 1e-9 * found.cost[0]).all()
    torch.testing.assert_close(found.X.flatten().numpy(), best.x[sum(sizes) :], atol=1e-4, rtol=0)


def test_what_is_not_free_stays():
    rig, X, x = bundle()
    found = bundle_adjusted(rig, X, x, free=["b.rotation"], steps=3).rig
    assert found["a"] == rig["a"]
    assert found["b"].t.equal(rig["b"].t)
    assert not found["b"].R.equal(rig["b"].R)


def test_a_layer_has_gradients():
    torch.manual_seed(0)
    rig, X, x = bundle(n=6)
    start = bundle_adjusted(rig, X, x, free=["b.rotation"], steps=8)

    def layer(x):
        found = bundle_adjusted(start.rig, start.X, x, free=["b.rotation"], steps=6, damping=1e-6)
        return torch.cat([found.X.flatten(), found.rig["b"].R.flatten()])

    x = x.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(layer(x).sum(), x)
    step = 1e-3 * torch.randn(x.shape, dtype=x.dtype)
    expected = (layer(x.detach() + step) - layer(x.detach() - step)).sum() / 2
    assert abs(float((gradient * step).sum() / expected) - 1) < 1e-4


def test_float32_is_adjusted_in_float64():
    rig, X, x = bundle()
    found = bundle_adjusted(rig.to(torch.float32), X.float(), x.float(), free=["*.rotation"])
    assert found.X.dtype == torch.float64
    assert float(found.cost[-1]) < 0.1 * float(found.cost[0])


def test_batches_and_wrong_shapes_are_refused():
    rig, X, x = bundle()
    with pytest.raises(ValueError, match="calibrated"):
        bundle_adjusted(stack([rig, rig]), X, x, free=["*"])
    with pytest.raises(ValueError, match=r"\(3, 12, 2\)"):
        bundle_adjusted(rig, X, x[:2], free=["*"])
    assert triangulate(list(rig.cameras.values()), x, residual=torch.inf).valid.all()


def test_points_that_fit_exactly_count_too():
    """A residual of 0 is that of a seen point: it has gradients."""
    rig, X, _ = bundle(noise=0.0)
    exact = torch.stack([camera.project(X).x for camera in rig.cameras.values()]).requires_grad_()
    found = bundle_adjusted(rig, X, exact, free=("*.rotation",), steps=1)
    (slope,) = torch.autograd.grad(found.X[:, 2].sum(), exact)
    near = bundle_adjusted(rig, X, exact + 1e-9 * torch.randn(exact.shape), free=("*.rotation",), steps=1)
    (wanted,) = torch.autograd.grad(near.X[:, 2].sum(), exact)
    assert slope.abs().sum() > 1
    torch.testing.assert_close(slope, wanted, rtol=1e-4, atol=1e-4)


def test_pixels_that_are_nan_are_not_seen():
    """The cost stays finite, and the other pixels count."""
    rig, X, x = bundle()
    seen = torch.ones(x.shape[:-1], dtype=torch.bool)
    seen[1, 3] = False
    wanted = bundle_adjusted(rig, X, x, free=FREE, seen=seen)
    found = bundle_adjusted(rig, X, torch.where(seen[..., None], x, torch.nan), free=FREE)
    assert found.cost.equal(wanted.cost)
    assert found.X.equal(wanted.X)
