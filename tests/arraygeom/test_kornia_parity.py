"""Functions of both arraygeom and kornia agree in values and in gradients; and both sides'
cameras convert."""

from collections.abc import Callable
from typing import NamedTuple

import pytest
import torch
from kornia.geometry import calibration, epipolar
from kornia.geometry.camera import PinholeCamera, project_points, unproject_points
from kornia.geometry.grid import create_meshgrid
from kornia.geometry.liegroup import Se3, So3
from kornia.geometry.linalg import inverse_transformation, transform_points
from kornia.geometry.transform import remap
from kornia.geometry.vector import Vector2, Vector3
from kornia.image import ImageSize
from kornia.sensors.camera import CameraModel as KorniaModel
from kornia.sensors.camera import CameraModelType
from torch import Tensor

from arraygeom import (
    Camera,
    Distortion,
    LensView,
    Rig,
    apply_homography,
    epipolar_distance,
    epipolar_lines,
    essential_matrix,
    fundamental_matrix,
    intrinsics,
    pixel_grid,
    rotation_from_vector,
    sample,
    stack,
    triangulate,
)
from arraygeom.kornia_models import to_kornia_model
from arraygeom.lenses import Orthographic
from arraygeom.pose import cross_matrix, rotation_vector
from tests.arraygeom.rigs import random_rig, scene_points

F64 = torch.float64
RIG = random_rig(3)
ALPHA, BETA = RIG["alpha"], RIG["beta"]
PAIR = RIG.pair("alpha", "beta")
IMAGE = torch.rand(1, 2, 48, 64, dtype=F64, generator=torch.Generator().manual_seed(0))
LENS = torch.tensor([-0.2, 0.05, 0.001, -0.002, 0.01, 0.02, -0.01, 0.003], dtype=F64)


def projection(camera: Camera) -> Tensor:
    return camera.K @ torch.cat([camera.R, camera.t[:, None]], -1)


class Parity(NamedTuple):
    """The same map in both libraries, at a value, and what they may differ by."""

    ours: Callable[[Tensor], Tensor]
    theirs: Callable[[Tensor], Tensor]
    at: Tensor
    tolerance: float = 1e-9


def up_to_scale(F: Tensor) -> Tensor:
    return F / F.norm() * F[2, 2].sign()


def cases(points: int, dtype: torch.dtype = F64) -> dict[str, Parity]:
    """List the functions of both libraries, with points that both cameras of RIG see."""
    X = scene_points(RIG, points)
    x_alpha, x_beta, X = (v.to(dtype) for v in (ALPHA.project(X).x, BETA.project(X).x, X))
    vectors = torch.randn(points, 3, dtype=F64, generator=torch.Generator().manual_seed(1)).to(dtype)
    rig = RIG.to(dtype)
    alpha, beta, pair = rig["alpha"], rig["beta"], rig.pair("alpha", "beta")
    F, H, image = PAIR.fundamental.to(dtype), PAIR.homography.to(dtype), IMAGE.to(dtype)

    def lens_view(c: Tensor) -> LensView:
        return LensView(hw=alpha.hw, K=alpha.K, distortion=Distortion("brown-conrady", c))

    return {
        "epipolar lines": Parity(
            lambda F: epipolar_lines(F, x_alpha),
            lambda F: epipolar.compute_correspond_epilines(x_alpha[None], F[None])[0],
            F,
        ),
        "epipolar distance": Parity(
            lambda F: epipolar_distance(F, x_alpha, x_beta + 1).abs(),
            lambda F: epipolar.left_to_right_epipolar_distance(x_alpha[None], x_beta[None] + 1, F[None])[0],
            F,
        ),
        "essential matrix": Parity(
            lambda t: essential_matrix(pair.beta_from_alpha.replace(t=t)),
            lambda t: epipolar.cross_product_matrix(t) @ pair.beta_from_alpha.R,
            pair.beta_from_alpha.t,
        ),
        "fundamental matrix": Parity(
            lambda K: up_to_scale(fundamental_matrix(K, beta.K, pair.beta_from_alpha)),
            lambda K: up_to_scale(
                epipolar.fundamental_from_projections(
                    projection(alpha.replace(K=K))[None], projection(beta)[None]
                )[0]
            ),
            alpha.K,
            1e-7,
        ),
        "cross product matrix": Parity(cross_matrix, epipolar.cross_product_matrix, vectors),
        "homography of points": Parity(
            lambda H: apply_homography(H, x_alpha).x, lambda H: transform_points(H[None], x_alpha[None])[0], H
        ),
        "projection": Parity(
            lambda X: alpha.project_local(X).x,
            lambda X: project_points(X, alpha.K),
            alpha.cam_from_world.apply(X),
        ),
        "unprojection": Parity(
            lambda x: torch.cat(alpha.rays(x)[:1]) * 2.0,
            lambda x: unproject_points(
                x, torch.full((len(x), 1), 2.0, dtype=dtype), alpha.K.expand(len(x), 3, 3)
            ),
            x_alpha,
        ),
        "exp of a rotation": Parity(rotation_from_vector, lambda w: So3.exp(w).matrix(), vectors),
        "log of a rotation": Parity(
            lambda w: rotation_vector(rotation_from_vector(w)), lambda w: So3.exp(w).log(), vectors, 1e-7
        ),
        "inverse pose": Parity(
            lambda w: alpha.cam_from_world.perturbed(w).inverse().t,
            lambda w: (
                Se3(So3.from_matrix(rotation_from_vector(w) @ alpha.R), alpha.t).inverse().matrix()[:3, 3]
            ),
            0.1 * vectors[0],
            1e-8,
        ),
        "composed poses": Parity(
            lambda t: (beta.cam_from_world @ alpha.cam_from_world.replace(t=t).inverse()).t,
            lambda t: (
                beta.cam_from_world.matrix @ inverse_transformation(alpha.cam_from_world.replace(t=t).matrix)
            )[:3, 3],
            alpha.t,
        ),
        "triangulation": Parity(
            lambda x: triangulate([alpha, beta], torch.stack([x_alpha, x]), deviation=0.01).X,
            lambda x: epipolar.triangulate_points(projection(alpha), projection(beta), x_alpha, x),
            x_beta,
            2e-6,
        ),
        "distortion": Parity(
            lambda c: lens_view(c).distort(x_alpha)[0],
            lambda c: calibration.distort_points(x_alpha[None], alpha.K[None], c[None])[0],
            LENS.to(dtype),
        ),
        "undistortion": Parity(
            lambda c: lens_view(c).undistort(x_alpha)[0],
            lambda c: calibration.undistort_points(x_alpha[None], alpha.K[None], c[None], num_iters=60)[0],
            LENS.to(dtype),
            1e-6,
        ),
        "sampling": Parity(
            lambda x: sample(image, x[None]).values[0],
            lambda x: remap(image, x[None, None, :, 0], x[None, None, :, 1], align_corners=True)[0, :, 0],
            x_alpha.clamp(1.3, 46.3),
        ),
        "pixel grid": Parity(
            lambda s: s * pixel_grid((3, 5), dtype=dtype),
            lambda s: s * create_meshgrid(3, 5, normalized_coordinates=False, dtype=dtype)[0],
            torch.ones((), dtype=dtype),
        ),
    }


X = scene_points(RIG, 40)
CASES = cases(40)


@pytest.mark.parametrize("name", CASES)
def test_values_and_gradients_agree(name):
    ours, theirs, at, tolerance = CASES[name]
    torch.testing.assert_close(ours(at), theirs(at), atol=tolerance, rtol=tolerance)
    gradients = []
    for f in (ours, theirs):
        leaf = at.clone().requires_grad_()
        value = f(leaf)
        cotangent = torch.randn(value.shape, dtype=F64, generator=torch.Generator().manual_seed(2))
        gradients.append(torch.autograd.grad((value * cotangent).sum(), leaf)[0])
    # triangulation: two different least squares, equal for exact matches but not in what noise does to them
    if name != "triangulation":
        torch.testing.assert_close(gradients[0], gradients[1], atol=100 * tolerance, rtol=100 * tolerance)


def pinhole(n: int = 1, sizes: tuple[int, ...] = (48,)) -> PinholeCamera:
    """A batch of kornia cameras, all of RIG's alpha but for their heights."""
    K, E = torch.eye(4, dtype=F64).repeat(n, 1, 1), torch.eye(4, dtype=F64).repeat(n, 1, 1)
    K[:, :3, :3], E[:, :3, :3], E[:, :3, 3] = ALPHA.K, ALPHA.R, ALPHA.t
    return PinholeCamera(K, E, torch.tensor(sizes).expand(n), torch.tensor([64]).expand(n))


def test_a_rig_is_made_of_kornia_pinholes():
    for rig in (
        Rig.from_kornia({"a": pinhole(), "b": BETA.to_kornia()}, depth=(1, 2)),
        Rig({"a": pinhole(), "b": BETA}, (1, 2)),
    ):
        assert rig == Rig({"a": ALPHA, "b": BETA}, depth=(1, 2))
    with pytest.raises(TypeError, match="'b'"):
        Rig({"a": ALPHA, "b": "colour"})


def test_batches_of_one_are_one_camera_and_larger_ones_stay():
    assert Camera.from_kornia(pinhole()) == ALPHA
    assert Camera.from_kornia(pinhole(3)) == stack([ALPHA] * 3)
    assert len(Rig({"a": pinhole(3), "b": stack([BETA] * 3)})) == 3
    with pytest.raises(ValueError, match="64x40 and 64x48"):
        Camera.from_kornia(pinhole(2, (48, 40)))


def test_kornia_cameras_are_kept_up_to_date_by_gradients():
    t = ALPHA.t.clone().requires_grad_()
    camera = ALPHA.replace(cam_from_world=ALPHA.cam_from_world.replace(t=t))
    there = camera.to_kornia()
    torch.testing.assert_close(there.project(X[None])[0], camera.project(X).x)
    there.project(X[None]).sum().backward()
    assert t.grad.abs().min() > 0
    again = t.grad.clone()
    t.grad = None
    Camera.from_kornia(camera.to_kornia()).project(X).x.sum().backward()
    torch.testing.assert_close(t.grad, again)


def test_rigs_go_there_and_back():
    for rig in (RIG, stack([RIG, RIG.perturbed({"alpha.focal": torch.tensor([1.0, 2.0], dtype=F64)})])):
        assert Rig.from_kornia(rig.to_kornia(), depth=rig.depth) == rig
    one = stack([RIG])
    assert Rig.from_kornia(one.to_kornia(), batched=True, depth=one.depth) == one
    shared = Rig({"alpha": ALPHA, "beta": stack([BETA, BETA])})
    assert {camera.batch_size for camera in shared.to_kornia().values()} == {2}


def test_a_stereo_camera_of_kornia_is_refused():
    from kornia.geometry.camera import StereoCamera

    P = torch.tensor([[[500.0, 0, 320, 0], [0, 500, 240, 0], [0, 0, 1, 0]]])
    right = P - torch.tensor([0.0, 0, 0, 50])[None, None] * torch.tensor([1.0, 0, 0])[None, :, None]
    with pytest.raises(TypeError, match="StereoCamera"):
        Camera.from_kornia(StereoCamera(P, right))


def test_unequal_batches_and_lenses_are_refused():
    with pytest.raises(ValueError, match=r"{'a': 2, 'b': 3}"):
        Rig.from_kornia({"a": pinhole(2), "b": pinhole(3)})
    bent = RIG.with_camera("beta", BETA.replace(distortion=Distortion("brown-conrady", LENS)))
    with pytest.raises(ValueError, match="beta"):
        bent.to_kornia()
    with pytest.raises(ValueError, match=r"\bb\b"):
        Rig({"a": ALPHA, "b": LensView(hw=(4, 4), K=ALPHA.K)}).to_kornia()


MODELS = {
    "pinhole": (None, ALPHA),
    "brown": (Distortion("brown-conrady", LENS), ALPHA),
    "four": (Distortion("brown-conrady", LENS[:4]), ALPHA),
    "fisheye": (Distortion("kannala-brandt", torch.tensor([0.05, -0.01, 0.002, -1e-3], dtype=F64)), ALPHA),
    "parallel": (Orthographic(), ALPHA.replace(K=intrinsics(20.0, ALPHA.hw))),
}


@pytest.mark.parametrize("name", MODELS)
def test_lenses_are_kornias_camera_models(name):
    """Values and gradients in the numbers, there; the same camera, back."""
    lens, camera = MODELS[name]
    camera = camera.replace(distortion=lens)
    theirs = to_kornia_model(camera.K, camera.hw, lens)
    X = (
        torch.rand(40, 3, dtype=F64, generator=torch.Generator().manual_seed(0))
        - 0.5
        + torch.tensor([0, 0, 2.0])
    )
    back = Camera.from_kornia(theirs, cam_from_world=camera.cam_from_world)
    params = theirs.params.clone().requires_grad_()
    kinds = {
        4: "ORTHOGRAPHIC" if name == "parallel" else "PINHOLE",
        8: "KANNALA_BRANDT_K3",
        12: "BROWN_CONRADY",
    }
    free = KorniaModel(ImageSize(*camera.hw), CameraModelType[kinds[len(params)]], params)
    expected = free.project(Vector3(X)).data
    found = Camera.from_kornia(free, cam_from_world=camera.cam_from_world).project_local(X)
    assert bool(found.valid.all())
    torch.testing.assert_close(found.x, expected, rtol=0, atol=1e-9)
    slopes = [
        torch.autograd.grad(x.square().sum(), params, retain_graph=True)[0] for x in (found.x, expected)
    ]
    torch.testing.assert_close(*slopes, rtol=1e-9, atol=1e-6)
    rays, _ = back.rays(found.x.detach())
    if name != "parallel":
        near = theirs.unproject(Vector2(found.x.detach()), torch.ones(40, dtype=F64)).data
        # theirs stops after 5 or 10 steps
        torch.testing.assert_close(rays / rays[:, 2:], near, rtol=0, atol=1e-3)
        torch.testing.assert_close(rays / rays[:, 2:], X / X[:, 2:], rtol=0, atol=1e-9)
    if name != "four":
        assert back == camera
    assert type(camera.to_kornia()).__name__ == ("PinholeCamera" if lens is None else "CameraModel")
    two = stack([camera, camera])
    both = Camera.from_kornia(to_kornia_model(two.K, two.hw, two.distortion))
    assert both.batch_shape == (2,)
    torch.testing.assert_close(both.project_local(X.expand(2, 40, 3)).x[1], found.x.detach())


def test_lenses_that_kornia_lacks_are_named():
    prism = torch.cat([LENS, torch.full((4,), 0.01, dtype=F64)])
    for lens, what in (
        (Distortion("double-sphere", LENS[:2]), "kornia.*double-sphere"),
        (Distortion("brown-conrady", prism), "prism"),
    ):
        with pytest.raises(ValueError, match=what):
            ALPHA.replace(distortion=lens).to_kornia()
    with pytest.raises(ValueError, match="rotated"):
        ALPHA.replace(distortion=Distortion("brown-conrady", LENS)).rot90(1).to_kornia()


MODEL = ALPHA.replace(distortion=Distortion("brown-conrady", LENS)).to_kornia()


@pytest.mark.parametrize("cameras", [3, [None], {"left": None}, {"left": MODEL}])
def test_other_things_than_kornias_pinholes_by_name_are_refused(cameras):
    with pytest.raises(TypeError, match="PinholeCamera"):
        Rig.from_kornia(cameras)
