import numpy as np
import pytest
import torch

from arraygeom import Camera, Distortion, depth_of, triangulate
from tests.arraygeom.rigs import random_camera, uniform
from tests.oracles import Oracle

cv2 = Oracle("cv2")
optimize = Oracle("scipy.optimize")


def array_of(n: int, *, lens: Distortion | None = None) -> list[Camera]:
    g = torch.Generator().manual_seed(n)
    return [random_camera(g, (480, 640), baseline=0.6).replace(distortion=lens) for _ in range(n)]


def seen_points(cameras: list[Camera], n: int = 30, noise: float = 0.0) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(1)
    X = torch.cat([uniform(g, -0.8, 0.8, n, 2), uniform(g, 3, 6, n, 1)], -1)
    x = torch.stack([c.project(X).x for c in cameras])
    return X, x + noise * torch.randn(x.shape, generator=g, dtype=torch.float64)


@pytest.mark.parametrize("n", [2, 3, 7])
def test_points_come_back(n):
    cameras = array_of(n)
    X, x = seen_points(cameras)
    found = triangulate(cameras, x)
    assert found.valid.all()
    torch.testing.assert_close(found.X, X, atol=1e-9, rtol=0)


@pytest.mark.parametrize("model", ["kannala-brandt", "brown-conrady"])
def test_points_come_back_through_lenses(model):
    lens = Distortion(model, torch.tensor([0.05, -0.01, 0.001, 0.0005], dtype=torch.float64))
    cameras = array_of(4, lens=lens)
    X, x = seen_points(cameras)
    torch.testing.assert_close(triangulate(cameras, x).X, X, atol=1e-7, rtol=0)


def test_two_views_are_opencvs():
    cameras = array_of(2)
    _, x = seen_points(cameras)
    P = [(c.K @ torch.cat([c.R, c.t[:, None]], 1)).numpy() for c in cameras]
    homogeneous = cv2.triangulatePoints(*P, *(v.T.numpy().copy() for v in x))
    np.testing.assert_allclose(triangulate(cameras, x).X.numpy(), (homogeneous[:3] / homogeneous[3]).T, atol=1e-8)


def test_with_noise_it_is_nearly_the_least_reprojection_error():
    cameras = array_of(5)
    X, x = seen_points(cameras, noise=0.5)
    found = triangulate(cameras, x)

    def residual(X, i):
        X = torch.from_numpy(X)
        return torch.cat([c.project(X).x - x[v, i] for v, c in enumerate(cameras)]).numpy()

    for i in range(10):
        best = optimize.least_squares(residual, X[i].numpy(), args=(i,)).x
        sigma = 0.5 * found.covariance[i].diagonal().sum().sqrt()
        assert np.linalg.norm(found.X[i].numpy() - best) < 0.6 * sigma


def test_the_covariance_is_that_of_the_points():
    cameras = array_of(4)
    _, x = seen_points(cameras, 3)
    g = torch.Generator().manual_seed(2)
    noise = 0.3 * torch.randn(4, 5000, 3, 2, generator=g, dtype=torch.float64)
    found = triangulate(cameras, x[:, None] + noise)
    for i in range(3):
        spread = torch.cov(found.X[:, i].T)
        stated = 0.09 * triangulate(cameras, x).covariance[i]
        # f differs along x and y, and off axis a pixel is a smaller angle: hence tens of per cent
        assert 0.5 < float(spread.diagonal().sum() / stated.diagonal().sum()) < 1.5


def test_unseen_views_are_left_out():
    cameras = array_of(4)
    X, x = seen_points(cameras)
    seen = torch.ones(4, len(X), dtype=torch.bool)
    seen[1, :10] = False
    x[1, :10] += 100
    found = triangulate(cameras, x, seen=seen)
    torch.testing.assert_close(found.X, X, atol=1e-9, rtol=0)
    seen[1:, 0] = False
    assert not triangulate(cameras, x, seen=seen).valid[0]


def test_parallel_rays_and_points_behind_are_invalid():
    a = array_of(1)[0]
    x = torch.tensor([[300.0, 200.0]], dtype=torch.float64)
    assert not triangulate([a, a], torch.stack([x, x])).valid.any()
    b = a.replace(cam_from_world=type(a.cam_from_world).from_centre(a.R, a.centre + a.R[0]))
    diverging = torch.stack([x, x + torch.tensor([50.0, 0])])
    found = triangulate([a, b], diverging)
    assert not found.valid.any()
    assert found.X.isfinite().all()


def test_gradients():
    cameras = array_of(3)
    _, x = seen_points(cameras, 2, noise=0.5)

    def points(x, t):
        moved = cameras[0].replace(cam_from_world=type(cameras[0].cam_from_world)(cameras[0].R, t))
        return triangulate([moved, *cameras[1:]], x).X

    assert torch.autograd.gradcheck(points, [x.requires_grad_(), cameras[0].t.clone().requires_grad_()], atol=1e-5)


def test_wrong_numbers_of_views_are_refused():
    with pytest.raises(ValueError, match=">= 2 cameras"):
        triangulate(array_of(1), torch.zeros(1, 2, 2))


@pytest.mark.parametrize("model", [None, "kannala-brandt", "brown-conrady"])
def test_depth_and_its_deviation_along_a_field(model):
    """Deviation against moving the point by a hundredth of a pixel along its curve."""
    from arraygeom import Pair

    lens = None if model is None else Distortion(model, torch.tensor([0.05, -0.01, 0.001, 0.0005]).double())
    cameras = array_of(2, lens=lens)
    pair = Pair(*cameras)
    X, x = seen_points(cameras)
    depth = cameras[0].project(X).depth
    sigma = torch.full_like(depth, 0.01)
    found = depth_of(pair, x[0], x[1], sigma)
    assert found.valid.all()
    torch.testing.assert_close(found.depth, depth, atol=1e-6, rtol=0)
    ends = [cameras[1].project(cameras[0].unproject(x[0], depth + s * found.deviation)).x for s in (0.5, -0.5)]
    moved = (ends[0] - ends[1]).norm(dim=-1)
    torch.testing.assert_close(moved, sigma, rtol=1e-3, atol=0)
