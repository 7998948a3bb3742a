import pytest
import torch
from torch.nn.functional import interpolate, pad

from arraygeom import Camera, Distortion, Pose, intrinsics, rotation_from_vector
from tests.arraygeom.rigs import random_camera, uniform
from tests.arraygeom.test_pixels import blob, centroid

CHANGES = {
    "smaller": (lambda c: c.resize((20, 31)), lambda i: interpolate(i, (20, 31), mode="area")),
    "larger": (lambda c: c.resize((100, 130)), lambda i: interpolate(i, (100, 130), mode="bilinear")),
    "cropped": (lambda c: c.crop(6, 18, (32, 32)), lambda i: i[..., 6:38, 18:50]),
    "padded": (lambda c: c.crop(-4, -7, (60, 80)), lambda i: pad(i, (7, 9, 4, 8))),
    "turned": (lambda c: c.rot90(1), lambda i: torch.rot90(i, 1, (-2, -1))),
    "turned back": (lambda c: c.rot90(-1), lambda i: torch.rot90(i, -1, (-2, -1))),
    "upside down": (lambda c: c.rot90(2), lambda i: torch.rot90(i, 2, (-2, -1))),
}
"""What is done to a camera, and the same to its image."""


def camera(seed: int = 0) -> Camera:
    return random_camera(torch.Generator().manual_seed(seed), (48, 64))


def points_ahead(camera: Camera, n: int = 50) -> torch.Tensor:
    g = torch.Generator().manual_seed(1)
    local = torch.cat([uniform(g, -1, 1, n, 2), uniform(g, 1.5, 6, n, 1)], -1)
    return camera.cam_from_world.inverse().apply(local)


def test_depths_that_a_ray_does_not_reach_have_no_point():
    """The point opposite is none: the camera sees it at another pixel or not at all."""
    fisheye = Distortion("kannala-brandt", torch.zeros(4, dtype=torch.float64))
    c = Camera(K=intrinsics(20.0, (48, 96)), cam_from_world=Pose.identity(), hw=(48, 96), distortion=fisheye)
    x = torch.tensor([[50.0, 20.0], [95.0, 24.0]], dtype=torch.float64)  # ahead, and 136 degrees off axis
    for depth in ([2.0, -2.0], [-2.0, 2.0]):
        z = torch.tensor(depth, dtype=torch.float64)
        X, reached = c.unproject(x, z), torch.tensor([depth[0] > 0] * 2)
        assert torch.equal(X.isfinite().all(-1), reached)
        torch.testing.assert_close(c.project(X[reached]).x, x[reached])


def test_points_behind_are_invalid_and_finite_with_their_gradients():
    c = camera()
    X = c.cam_from_world.inverse().apply(
        torch.tensor([[0.1, 0, -1], [0.1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    )
    X.requires_grad_()
    projected = c.project(X)
    projected.x.sum().backward()
    assert projected.valid.tolist() == [False, False, True]
    assert projected.x.isfinite().all()
    assert X.grad.isfinite().all()


@pytest.mark.parametrize("change", CHANGES)
def test_projections_stay_the_same_point_of_the_actual_image(change):
    """A blob painted where a point projects stays where the changed camera projects it."""
    c = camera()
    X = c.unproject(torch.tensor([33.3, 21.7], dtype=torch.float64), torch.tensor(3.0, dtype=torch.float64))
    image = blob(c.hw, *c.project(X).x.tolist(), sigma=3.5)
    changed, changed_image = (f(v) for f, v in zip(CHANGES[change], (c, image)))
    assert changed.hw == tuple(changed_image.shape[-2:])
    # cropping cuts the blob's tails; resampling is uneven where pixels do not divide: hence a few hundredths
    tolerance = {"cropped": 0.01, "smaller": 0.05, "larger": 0.02}.get(change, 2e-3)
    torch.testing.assert_close(centroid(changed_image), changed.project(X).x, atol=tolerance, rtol=0)


@pytest.mark.parametrize("change", CHANGES)
def test_changed_cameras_still_invert(change):
    c = CHANGES[change][0](camera())
    X = points_ahead(c)
    x, depth, _ = c.project(X)
    torch.testing.assert_close(c.unproject(x, depth), X, atol=1e-12, rtol=0)


def test_gradients_of_projection_and_its_inverse():
    c = camera()
    X = points_ahead(c, 3)

    def there_and_back(K, w, t, X):
        moved = c.replace(K=K, cam_from_world=Pose(rotation_from_vector(w) @ c.R, t))
        x, depth, _ = moved.project(X)
        return x, c.unproject(x, depth)

    inputs = [v.detach().clone().requires_grad_() for v in (c.K, torch.zeros(3, dtype=torch.float64), c.t, X)]
    assert torch.autograd.gradcheck(there_and_back, inputs)


def test_a_pixel_without_a_ray_leaves_gradients_of_the_pose_to_the_others():
    """The NaN of a pixel outside the lens's range does not reach the gradients of R."""
    lens = Distortion("kannala-brandt", torch.zeros(4, dtype=torch.float64))
    w = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    pose = Pose(rotation_from_vector(w), torch.zeros(3, dtype=torch.float64))
    seen = Camera(K=intrinsics(20.0, (60, 100)), cam_from_world=pose, hw=(60, 100), distortion=lens)
    x = torch.tensor([[60.0, 20.0], [1e4, 0.0]], dtype=torch.float64)
    X = seen.unproject(x, torch.full((2,), 2.0, dtype=torch.float64))
    assert X.isnan().all(-1).tolist() == [False, True]
    (slope,) = torch.autograd.grad(X[0].sum(), w)
    assert slope.isfinite().all()
    assert slope.any()


def test_contains_is_the_images_area():
    c = camera()
    x = torch.tensor([[-0.5, 0], [-0.51, 0], [63.5, 47.5], [63.6, 0], [0, 47.6]], dtype=torch.float64)
    assert c.contains(x).tolist() == [True, False, True, False, False]


def test_intrinsics_put_the_principal_point_in_the_middle():
    K = intrinsics((500, 510), (480, 640))
    assert K.tolist() == [[500, 0, 319.5], [0, 510, 239.5], [0, 0, 1]]
