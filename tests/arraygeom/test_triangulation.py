import numpy as np
import pytest
import torch

from arraygeom import (
    Camera,
    Distortion,
    Pair,
    Pose,
    Rig,
    depth_of,
    intrinsics,
    rectify,
    rotation_from_vector,
    stack,
    triangulate,
)
from arraygeom.fields.ray_depth import ray_depth
from tests.arraygeom.rigs import parallel_rig, random_camera, uniform
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


@pytest.mark.parametrize(
    ("n", "model"), [(2, None), (3, None), (7, None), (4, "kannala-brandt"), (4, "brown-conrady")]
)
def test_points_come_back(n, model):
    lens = model and Distortion(model, torch.tensor([0.05, -0.01, 0.001, 0.0005], dtype=torch.float64))
    cameras = array_of(n, lens=lens)
    X, x = seen_points(cameras)
    found = triangulate(cameras, x)
    assert found.valid.all()
    torch.testing.assert_close(found.X, X, atol=1e-7 if model else 1e-9, rtol=0)


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

    assert torch.autograd.gradcheck(
        points, [x.requires_grad_(), cameras[0].t.clone().requires_grad_()], atol=1e-5
    )


@pytest.mark.parametrize("model", [None, "kannala-brandt", "brown-conrady"])
def test_depth_and_its_deviation_along_a_field(model):
    """Deviation against moving the point by a hundredth of a pixel along its curve."""
    lens = None if model is None else Distortion(model, torch.tensor([0.05, -0.01, 0.001, 0.0005]).double())
    cameras = array_of(2, lens=lens)
    pair = Pair(*cameras)
    X, x = seen_points(cameras)
    depth = cameras[0].project(X).depth
    sigma = torch.full_like(depth, 0.01)
    found = depth_of(pair, x[0], x[1], sigma)
    assert found.valid.all()
    torch.testing.assert_close(found.depth, depth, atol=1e-6, rtol=0)
    ends = [
        cameras[1].project(cameras[0].unproject(x[0], depth + s * found.deviation)).x for s in (0.5, -0.5)
    ]
    moved = (ends[0] - ends[1]).norm(dim=-1)
    torch.testing.assert_close(moved, sigma, rtol=1e-3, atol=0)


def wide_pair(dtype: torch.dtype = torch.float64) -> list[Camera]:
    """Two of 12 megapixels, 10 cm apart: 400 / depth pixels of disparity."""
    return list(parallel_rig(4000.0, (3000, 4000), {"a": (), "b": (0.1,)}).to(dtype).cameras.values())


def noisy_matches(disparity: torch.Tensor, noise: float) -> tuple[torch.Tensor, torch.Tensor]:
    g, (a, b) = torch.Generator().manual_seed(3), wide_pair()
    x = uniform(g, 0, 1, len(disparity), 2) * torch.tensor([3999.0, 2999.0])
    X = a.unproject(x, 400 / disparity)
    x = torch.stack([c.project(X).x for c in (a, b)])
    return X, x + noise * torch.randn(x.shape, generator=g, dtype=torch.float64)


@pytest.mark.parametrize("noise", [0.1, 0.3, 1.0])
def test_errors_are_within_three_stated_deviations(noise):
    """100,000 float32 matches at 1 to 100 px of disparity; those stated as unknown count as right."""
    X, x = noisy_matches(uniform(torch.Generator().manual_seed(4), 1, 100, 100_000), noise)
    found = triangulate(wide_pair(torch.float32), x.float(), deviation=noise)
    error = (found.X - X).abs()[..., 2]
    beyond = found.valid & (error > 3 * found.covariance[:, 2, 2].sqrt())
    assert float(beyond.float().mean()) < 0.003
    assert float(found.valid.float().mean()) > 0.96


def test_float32_at_12_megapixels_is_as_good_as_its_pixels():
    """A float32 pixel of 4000 is good to 1.2e-4 px: at 10 px of disparity to 4e-5 of the depth."""
    X, x = noisy_matches(torch.full((2000,), 10.0, dtype=torch.float64), 0.0)
    found = triangulate(wide_pair(torch.float32), x.float())
    assert found.valid.all()
    assert found.X.dtype == torch.float32
    torch.testing.assert_close(found.X.double(), X, rtol=4e-5, atol=1e-3)


def test_noise_does_not_draw_distant_points_to_the_cameras():
    _, x = noisy_matches(torch.full((5000,), 2.5, dtype=torch.float64), 1.0)
    found = triangulate(wide_pair(torch.float32), x.float())
    assert float(found.residual[found.valid].max()) < 5
    assert float(found.X[found.valid][:, 2].min()) > 0.25 * 160
    outlier = triangulate(wide_pair(), x + torch.tensor([[[0.0, 20.0]], [[0.0, -20.0]]]))
    assert not outlier.valid.any()


def test_batched_cameras_are_a_loop():
    cameras = array_of(3)
    _, x = seen_points(cameras, 12, noise=0.3)
    batch = [stack([c, c.replace(K=c.K * torch.tensor([1.1, 1.1, 1.0])[:, None])]) for c in cameras]
    both = triangulate(batch, x.reshape(3, 2, 6, 2))
    for i in range(2):
        one = triangulate([c[i] for c in batch], x.reshape(3, 2, 6, 2)[:, i], residual=torch.inf)
        torch.testing.assert_close(both.covariance[i], one.covariance)
        torch.testing.assert_close(both.residual[i], one.residual)


def test_two_noisy_views_are_opencvs_optimal_triangulation():
    """`correctMatches` (Hartley & Zisserman 12.5), then linear; its polynomial's roots are good to 1e-4 m."""
    cameras = array_of(2)
    _, x = seen_points(cameras, noise=0.5)
    pair = Pair(*cameras)
    corrected = cv2.correctMatches(pair.fundamental.numpy(), *(v.numpy()[None] for v in x))
    P = [(c.K @ torch.cat([c.R, c.t[:, None]], 1)).numpy() for c in cameras]
    homogeneous = cv2.triangulatePoints(*P, *(v[0].T.copy() for v in corrected))
    found = triangulate(cameras, x)
    np.testing.assert_allclose(found.X.numpy(), (homogeneous[:3] / homogeneous[3]).T, atol=2e-4)

    def cost(points):
        return sum((p - there).square().sum(-1) for p, there in zip(points, x))

    ours = cost([c.project(found.X).x for c in cameras])
    assert (ours <= cost([torch.from_numpy(c[0]) for c in corrected]) + 1e-12).all()


def test_what_is_not_a_number_leaves_no_gradient():
    """A match that is NaN, and said not to be seen, leaves the cameras' gradients finite."""
    cameras = array_of(3)
    _, x = seen_points(cameras)
    x[2, 0] = torch.nan
    seen = torch.ones(x.shape[:-1], dtype=torch.bool)
    seen[2, 0] = False
    K = cameras[2].K.clone().requires_grad_()
    found = triangulate([*cameras[:2], cameras[2].replace(K=K)], x, seen=seen)
    assert found.valid.all()
    found.X.sum().backward()
    assert K.grad.isfinite().all()
    K.grad = None
    x = x[:2].clone()
    x[1, 1] = torch.inf
    depth = depth_of(Pair(cameras[0].replace(K=K), cameras[1]), x[0], x[1])
    assert not depth.valid[1]
    assert depth.valid[2:].all()
    depth.depth.sum().backward()
    assert K.grad.isfinite().all()
    near, far = (torch.tensor(d, dtype=torch.float64) for d in (0.5, 50.0))
    pair = Pair(cameras[0], cameras[1].replace(K=K), depth=(near, far))
    depth = ray_depth(pair, x[0], x[1], deviation=torch.ones_like(x[0, :, 0]))
    assert not depth.valid[1]
    K.grad = None
    (depth.depth + depth.deviation).sum().backward()
    assert K.grad.isfinite().all()
    assert K.grad.any()


def test_depth_along_a_curve_has_the_gradients_of_depth_along_a_line():
    """Gradients by the position in beta, not only by the curve's ends."""
    cameras = wide_pair()
    x = torch.tensor([[2000.0, 1500.0], [2600.0, 1700.0]], dtype=torch.float64)
    near, far = (torch.tensor(d, dtype=torch.float64) for d in (0.5, 50.0))
    t = cameras[1].t.clone().requires_grad_()
    pair = Pair(cameras[0], cameras[1].replace(cam_from_world=Pose(cameras[1].R, t)), depth=(near, far))
    points = cameras[0].rays(x)[0] * torch.tensor([[3.0], [6.0]], dtype=torch.float64)
    x_beta = pair.beta.project_local(pair.beta_from_alpha.apply(points)).x.detach().requires_grad_()
    slopes = []
    for function in (depth_of, ray_depth):
        found = function(pair, x, x_beta)
        assert found.valid.all()
        slopes.append(torch.autograd.grad(found.depth.sum(), (x_beta, t), retain_graph=True))
    torch.testing.assert_close(slopes[1], slopes[0], rtol=2e-3, atol=2e-3)


@pytest.mark.parametrize(
    "lens", [None, Distortion("brown-conrady", torch.tensor([0.05, -0.01, 0, 0]).double())]
)
@pytest.mark.parametrize("unit", [1e-9, 1e-6, 1e6])
def test_depth_is_found_in_any_unit_of_length(unit, lens):
    cameras = array_of(2, lens=lens)
    _, x = seen_points(cameras)
    rig = Rig({"alpha": cameras[0], "beta": cameras[1]})
    wanted = depth_of(rig.pair("alpha", "beta"), *x)
    found = depth_of(rig.scaled(unit).pair("alpha", "beta"), *x)
    assert found.valid.equal(wanted.valid)
    torch.testing.assert_close(found.depth / unit, wanted.depth)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_baseline_that_is_rounding_is_none(dtype):
    """Cameras in one place, turned differently: their poses' product has a translation of rounding."""
    g = torch.Generator().manual_seed(0)
    for _ in range(20):
        rotations = rotation_from_vector(torch.randn(2, 3, generator=g, dtype=dtype))
        centre = torch.randn(3, generator=g, dtype=dtype)
        K = intrinsics(500.0, (480, 640)).to(dtype)
        poses = [Pose.from_centre(R, centre) for R in rotations]
        pair = Pair(*(Camera(K=K, cam_from_world=pose, hw=(480, 640)) for pose in poses))
        assert not pair.beta_from_alpha.t.any()
        x = 400 * torch.rand(2, 20, 2, generator=g, dtype=dtype)
        assert not depth_of(pair, *x).valid.any()
        with pytest.raises(ValueError, match="baseline"):
            rectify(pair)


def test_a_baseline_of_nothing_has_a_gradient():
    translation = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    camera = array_of(1)[0]
    moved = camera.replace(cam_from_world=Pose(camera.R, camera.t + translation))
    (gradient,) = torch.autograd.grad(Pair(camera, moved).beta_from_alpha.t[0], translation)
    assert gradient.tolist() == [1, 0, 0]
