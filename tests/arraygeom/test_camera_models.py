"""Camera models against projection in numpy, in fields, in rig files; a model of one's own."""

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest
import torch

from arraygeom import (
    Camera,
    Curved,
    LensView,
    Pose,
    Rig,
    default_field,
    intrinsics,
    rotation_from_vector,
    sampling_locations,
    stack,
)
from arraygeom.fields.ray_depth import ray_depth
from arraygeom.lenses import (
    CAMERA_MODELS,
    CameraModel,
    Equirectangular,
    FlatPort,
    Orthographic,
    PolynomialFisheye,
    RollingShutter,
    Splined,
    beside_points,
)
from tests.arraygeom.rigs import number

HW = (96, 128)


@dataclass(frozen=True, eq=False, repr=False)
class Stereographic(CameraModel, name="stereographic"):
    """The page's example of a camera of one's own."""

    def project(self, X):
        distance = X.norm(dim=-1)
        ahead = distance + X[..., 2]
        return 2 * X[..., :2] / ahead.clamp(min=1e-9)[..., None], ahead > 1e-6

    def unproject(self, xy):
        quarter = xy.square().sum(-1, keepdim=True) / 4
        return torch.cat([xy, 1 - quarter], -1), quarter[..., 0] < 1e6


K = (0.02, -0.03, 0.005)
MOTION = {"velocity": (0.5, 0.1, 0.2), "rotation": (0.1, 0.3, 0.2), "readout": 0.05}
PORT = {"distance": 0.05, "thickness": 0.01, "glass": 1.52, "water": 1.333}
KNOTS = torch.from_numpy(np.random.default_rng(3).normal(size=(7, 8, 2)) * 0.03)
MODELS = {
    "polynomial": (PolynomialFisheye(number(*K), number(1.9)), 35.0),
    "equirectangular": (Equirectangular(), HW[1] / (2 * math.pi)),
    "orthographic": (Orthographic(), 40.0),
    "rolling shutter": (RollingShutter(**{n: number(*np.atleast_1d(v)) for n, v in MOTION.items()}), 110.0),
    "port": (FlatPort(**{n: number(v) for n, v in PORT.items()}), 110.0),
    "splined": (Splined(KNOTS, number(0.75, 0.7), 2), 35.0),
    "splined pinhole": (Splined(KNOTS, number(0.6, 0.55), base="pinhole"), 90.0),
    "own": (Stereographic(), 35.0),
}


def camera(name: str, *, beta: bool = False) -> Camera:
    model, focal = MODELS[name]
    R = rotation_from_vector(number(0.02, -0.03, 0.01)) if beta else torch.eye(3, dtype=torch.float64)
    pose = Pose(R, number(-0.3, 0.02, 0.05) if beta else number(0.0, 0.0, 0.0))
    return Camera(K=intrinsics(focal, HW), cam_from_world=pose, hw=HW, distortion=model)


def rig(alpha: str, beta: str) -> Rig:
    return Rig({"a": camera(alpha), "b": camera(beta, beta=True)}, depth=(1.0, 8.0))


def points(count: int, *, ahead: bool) -> np.ndarray:
    X = np.random.default_rng(0).normal(size=(count, 3)) * 3
    X[:, 2] = np.abs(X[:, 2]) - 0.2 if ahead else X[:, 2]
    return X


def of_polynomial(X):
    theta = np.arctan2(np.hypot(X[:, 0], X[:, 1]), X[:, 2])
    radius = theta + sum(k * theta ** (i + 2) for i, k in enumerate(K))
    around = np.arctan2(X[:, 1], X[:, 0])
    return np.stack([radius * np.cos(around), radius * np.sin(around)], -1), theta <= 1.9


def of_sphere(X):
    unit = X / np.linalg.norm(X, axis=1, keepdims=True)
    return np.stack([np.arctan2(X[:, 0], X[:, 2]), np.arcsin(unit[:, 1])], -1), np.ones(len(X), bool)


def of_parallel(X):
    return X[:, :2], X[:, 2] > 0


def of_moving(X):
    """Project by bisection of the row at which a point is seen, over the image's rows alone."""
    Rotation = pytest.importorskip("scipy.spatial.transform").Rotation

    def at(row):
        time = MOTION["readout"] * row
        turn = Rotation.from_rotvec(time[:, None] * np.array(MOTION["rotation"]))
        there = turn.inv().apply(X - time[:, None] * np.array(MOTION["velocity"]))
        z = there[:, 2]
        return there[:, :2] / np.where(z == 0, 1.0, z)[:, None], z

    low, high = np.full(len(X), -1.0), np.full(len(X), 1.0)
    for _ in range(70):
        middle = (low + high) / 2
        later = at(middle)[0][:, 1] > middle
        low, high = np.where(later, middle, low), np.where(later, high, middle)
    xy, z = at(low)
    return xy, (z > 0) & (np.abs(xy[:, 1] - low) < 1e-9)


def of_port(X):
    """Project by bisection of the angle in air, traced through the layers by Snell's law."""
    radius, depth = np.hypot(X[:, 0], X[:, 1]), X[:, 2] - PORT["distance"] - PORT["thickness"]
    low, high = np.zeros(len(X)), np.full(len(X), np.pi / 2)
    for _ in range(80):
        angle = (low + high) / 2
        in_glass, in_water = (np.arcsin(np.sin(angle) / PORT[n]) for n in ("glass", "water"))
        reached = (
            PORT["distance"] * np.tan(angle) + PORT["thickness"] * np.tan(in_glass) + depth * np.tan(in_water)
        )
        low, high = np.where(reached < radius, angle, low), np.where(reached < radius, high, angle)
    return X[:, :2] / radius[:, None] * np.tan(low)[:, None], depth > 0


def of_splines(X, *, spacing, order, pinhole):
    """Project by SciPy's B-splines: knots evenly spaced, the middle one at u = 0."""
    spline = pytest.importorskip("scipy.interpolate").BSpline
    length = np.linalg.norm(X, axis=1)
    some = length + X[:, 2] > 1e-6 * length
    u = 2 * X[:, :2] / np.where(some, length + X[:, 2], 1.0)[:, None]
    counts = np.array([8, 7])
    at = u / np.array(spacing) + (counts - 1) / 2
    margin = (order - 1) / 2
    inside = (
        some & (at >= margin).all(1) & (at <= counts - 1 - margin).all(1) & (X[:, 2] > 0 if pinhole else True)
    )
    clipped = np.clip(at, margin, counts - 1 - margin - 1e-9)
    weights = [
        spline.design_matrix(
            clipped[:, i], np.arange(counts[i] + order + 1) - (order + 1) / 2, order
        ).toarray()
        for i in range(2)
    ]
    moved = np.einsum("nx,ny,yxc->nc", *weights, KNOTS.numpy())
    base = X[:, :2] / np.where(X[:, 2] > 0, X[:, 2], 1.0)[:, None] if pinhole else u
    return base + moved, inside


def of_own(X):
    direction = X / np.linalg.norm(X, axis=1, keepdims=True)
    half = np.arccos(direction[:, 2]) / 2
    around = np.arctan2(X[:, 1], X[:, 0])
    return 2 * np.tan(half)[:, None] * np.stack([np.cos(around), np.sin(around)], -1), half < np.pi / 2 - 1e-4


ORACLES = {
    "polynomial": of_polynomial,
    "equirectangular": of_sphere,
    "orthographic": of_parallel,
    "rolling shutter": of_moving,
    "port": of_port,
    "splined": partial(of_splines, spacing=(0.75, 0.7), order=2, pinhole=False),
    "splined pinhole": partial(of_splines, spacing=(0.6, 0.55), order=3, pinhole=True),
    "own": of_own,
}


@pytest.mark.parametrize("name", MODELS)
def test_projections_and_their_flags_are_those_of_numpy(name):
    """100,000 points; which are on the image and seen, and where to 1e-8 px."""
    X = points(100_000, ahead=name in ("rolling shutter", "port"))
    alpha = camera(name)
    found = alpha.project(torch.from_numpy(X))
    xy, valid = ORACLES[name](X)
    x = xy * alpha.K.numpy()[[0, 1], [0, 1]] + alpha.K.numpy()[:2, 2]
    h, w = HW
    on = valid & (x > -0.5).all(1) & (x[:, 0] < w - 0.5) & (x[:, 1] < h - 0.5)
    wrong = on != (found.valid & alpha.contains(found.x)).numpy()
    assert int(wrong.sum()) == 0
    assert np.abs(found.x.numpy() - x)[on].max() < 1e-8


@pytest.mark.parametrize("name", MODELS)
def test_rays_go_through_what_is_seen(name):
    alpha = camera(name)
    X = torch.from_numpy(points(2000, ahead=name in ("rolling shutter", "port")))
    found = alpha.project(X)
    seen = found.valid & alpha.contains(found.x)
    (ray, valid), start = alpha.rays(found.x[seen]), alpha.ray_origins(found.x[seen])
    assert bool(valid.all())
    ray, step = ray / ray.norm(dim=-1, keepdim=True), X[seen] - start
    along = (step * ray).sum(-1, keepdim=True)
    assert bool((along > 0).all())
    assert float((step - along * ray).norm(dim=-1).max()) < 1e-8
    project, back = (lambda X: alpha.project(X).x), (lambda x: alpha.rays(x)[0])
    assert torch.autograd.gradcheck(project, X[seen][:4].clone().requires_grad_())
    assert torch.autograd.gradcheck(back, found.x[seen][:4].clone().requires_grad_())


@pytest.mark.parametrize("alpha", MODELS)
@pytest.mark.parametrize("beta", MODELS)
def test_the_default_field_passes_through_every_point(alpha, beta):
    pair, g = rig(alpha, beta).pair("a", "b"), torch.Generator().manual_seed(0)
    x = torch.rand(300, 2, generator=g, dtype=torch.float64) * number(HW[1], HW[0]) - 0.5
    wanted = 1 + 7 * torch.rand(300, generator=g, dtype=torch.float64)
    field = default_field(pair)
    assert isinstance(field, Curved)
    (ray, seen), start = pair.cameras[0].rays(x), pair.cameras[0].ray_origins(x)
    along = wanted / ray.norm(dim=-1) if field.bounds == "distance" else (wanted - start[:, 2]) / ray[:, 2]
    there = pair.cameras[1].project(
        pair.cameras[0].cam_from_world.inverse().apply(start + along[:, None] * ray)
    )
    visible = seen & there.valid & pair.beta.contains(there.x)
    assert int(visible.sum()) > 2
    found = Curved(256, bounds=field.bounds)(pair, x)
    apart = torch.where(found.mask, (found.xy - there.x[:, None]).norm(dim=-1), torch.inf).amin(-1)
    assert float(apart[visible].max()) < 0.2
    depth = ray_depth(pair, x[visible], there.x[visible], field.bounds)
    assert float((depth.depth / wanted[visible] - 1).abs().quantile(0.9)) < 2e-4


@pytest.mark.parametrize("name", MODELS)
def test_rig_files_hold_a_model_with_its_own_numbers(name, tmp_path):
    before = rig(name, name)
    before.save(tmp_path / "rig.yaml")
    after = Rig.load(tmp_path / "rig.yaml")
    assert after == before
    resized, turned = after.resize("b", (48, 64)), after.rot90("a", 1)
    X = number(0.1, 0.2, 4.0)
    torch.testing.assert_close(resized["b"].project(X).x, (after["b"].project(X).x + 0.5) / 2 - 0.5)
    assert bool(turned["a"].project(X).valid)
    assert after.check() == ()


def test_a_model_whose_unproject_is_not_the_inverse_is_odd():
    """A model whose two maps disagree is reported: its segments would lie beside the points."""

    @dataclass(frozen=True, eq=False, repr=False)
    class NotInverse(Stereographic):
        def unproject(self, xy):
            return Stereographic.unproject(self, xy / 1.01)

    (odd,) = Rig({"own": camera("own").replace(distortion=NotInverse())}).check()
    assert "projects the rays of its pixels up to 0.785 px off them" in odd


def test_a_batch_of_rigs_has_the_fields_of_its_rigs():
    one, two = (
        rig("rolling shutter", "port"),
        rig("rolling shutter", "port").perturbed({"b.distortion": number(*[0.001] * 4)}),
    )
    x = torch.rand(1, 20, 2, dtype=torch.float64) * 90
    both = sampling_locations(Curved(16), stack([one, two]).pair("a", "b"), x)
    for i, each in enumerate((one, two)):
        torch.testing.assert_close(both.xy[i], sampling_locations(Curved(16), each.pair("a", "b"), x[0]).xy)


def test_what_a_model_lacks_is_said():
    with pytest.raises(ValueError, match="fundamental"):
        _ = rig("orthographic", "own").pair("a", "b").fundamental
    with pytest.raises(TypeError, match="rays"):

        class Silent(Camera):
            def rays(self, x):
                return x, x

    with pytest.raises(ValueError, match="named 'stereographic' exists"):

        class Another(CameraModel, name="stereographic"):
            pass

    with pytest.raises(ValueError, match="central"):
        FlatPort(lens=Orthographic(), **{n: number(v) for n, v in PORT.items()})
    assert {"equirectangular", "orthographic", "polynomial-fisheye", "rolling-shutter", "flat-port"} <= {
        *CAMERA_MODELS
    }


def test_a_file_that_lacks_a_number_of_its_model_says_which(tmp_path):
    rig("port", "port").save(tmp_path / "rig.yaml")
    text = (tmp_path / "rig.yaml").read_text()
    (tmp_path / "rig.yaml").write_text("\n".join(line for line in text.splitlines() if "water" not in line))
    with pytest.raises(ValueError, match="water"):
        Rig.load(tmp_path / "rig.yaml")


def test_a_file_of_a_model_that_is_not_imported_says_how_to_import_it(tmp_path):
    rig("port", "port").save(tmp_path / "rig.yaml")
    text = (tmp_path / "rig.yaml").read_text()
    (tmp_path / "rig.yaml").write_text(text.replace("flat-port", "of-my-own"))
    with pytest.raises(ValueError, match=r"'of-my-own'.*--plugin"):
        Rig.load(tmp_path / "rig.yaml")


@pytest.mark.parametrize("factor", [1000.0, 1e-3])
def test_another_unit_changes_no_pixel(factor):
    """Lengths of models scale with the rig: velocities, distances, parallel rays."""
    t = partial(torch.tensor, dtype=torch.float64)
    moving = RollingShutter(velocity=t([1.0, 0.2, 0.1]), rotation=t([0.1, 0.2, 0.3]), readout=t(0.02))
    port = FlatPort(distance=t(0.05), thickness=t(0.01), glass=t(1.5), water=t(1.33))
    X = t([[0.1, -0.05, 2.0], [0.2, 0.1, 3.0]])
    for model in (None, Orthographic(), moving, port):
        camera = Camera(
            K=intrinsics(80.0, (40, 60)), hw=(40, 60), cam_from_world=Pose.identity(), distortion=model
        )
        rig = Rig({"a": camera}).scaled(factor)
        torch.testing.assert_close(rig["a"].project(factor * X).x, camera.project(X).x)


def test_a_model_that_does_not_state_its_lengths_cannot_be_in_another_unit():
    class Mine(CameraModel):
        central = False

    with pytest.raises(ValueError, match="`lengths`"):
        Mine().scaled(10.0)


def project(X):
    return Stereographic().project(X)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (
            lambda X: project(X)[0],
            "Sloppy.project.*torch.float32",
        ),
        (lambda X: (project(X)[0], True), "bool"),
        (lambda X: (project(X)[0], None), "NoneType"),
        (lambda X: (project(X)[0], project(X)[1].float()), r"torch.float32.*\(2, 3\)"),
        (lambda X: (project(X)[0], project(X)[1][..., None]), r"torch.bool.*\(2, 3, 1\)"),
        (lambda X: tuple(v.numpy() for v in project(X)), "ndarray"),
        (lambda X: project(X.double()), "torch.float64.*torch.float32"),
        (lambda X: project(X.float()), "torch.float32.*torch.float64"),
        (lambda X: project(X.reshape(-1, 3)), r"torch.float32.*\(6, 2\)"),
        (lambda X: (X, project(X)[1]), r"torch.float32.*\(2, 3, 3\)"),
        (lambda X: project(X.div_(X[..., 2:])), "changes"),
        (lambda X: X.x, "Sloppy.project.*AttributeError"),
    ],
)
def test_a_model_that_returns_something_else_is_refused_with_what_is_wanted(wrong, said):
    """A result of another kind is a message that names the model and the expected result."""

    @dataclass(frozen=True, eq=False, repr=False)
    class Sloppy(Stereographic):
        def project(self, X):
            return wrong(X)

    with pytest.raises(TypeError, match=said):
        camera("own").replace(distortion=Sloppy())


@dataclass(frozen=True, eq=False, repr=False)
class Division(CameraModel, name="tests-division"):
    k: torch.Tensor

    def project(self, X):
        z = X[..., 2]
        root = z.square() - 4 * beside_points(self.k, z[..., None]) * X[..., :2].square().sum(-1)
        ahead = (z > 0) & (root > 0)
        return 2 * X[..., :2] / (z + root.clamp(min=1e-12).sqrt()).clamp(min=1e-12)[..., None], ahead

    def unproject(self, xy):
        z = 1 + beside_points(self.k, xy) * xy.square().sum(-1)
        return torch.cat([xy, z[..., None]], -1), z > 0


@pytest.mark.parametrize(
    ("k", "said"),
    [
        (np.array(-0.1), "Division"),
        (torch.tensor(1), "torch.int64"),
        (number(math.nan), "NaN"),
    ],
)
def test_numbers_of_a_model_are_finite_tensors(k, said):
    with pytest.raises((TypeError, ValueError), match=said):
        camera("own").replace(distortion=Division(k))


def test_batches_of_lenses_are_as_large_as_those_of_cameras():
    one = camera("own")
    with pytest.raises(ValueError, match=r"\(3,\).*\(2,\)"):
        one.replace(K=one.K.expand(3, 3, 3), distortion=Division(number(0.0, 0.1)))


def test_a_model_with_rays_that_it_does_not_see_covers_nothing():
    @dataclass(frozen=True, eq=False, repr=False)
    class Nothing(Stereographic):
        def unproject(self, xy):
            return Stereographic.unproject(self, xy)[0] * torch.nan, torch.ones_like(xy[..., 0]).bool()

    (odd,) = Rig({"own": camera("own").replace(distortion=Nothing())}).check()
    assert "100 % of its image" in odd


@pytest.mark.parametrize("k", [[], [0.01]])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_fisheye_does_not_see_straight_behind(k, dtype):
    lens = PolynomialFisheye(torch.tensor(k, dtype=dtype))
    _, valid = lens.project(torch.tensor([[0.0, 0, 1], [0, 0, -1], [0, 0, 0], [1e-3, 0, -1]], dtype=dtype))
    assert valid.tolist() == [True, False, False, True]


def test_an_uncalibrated_view_keeps_its_model_in_a_file(tmp_path):
    """A written file is read again."""
    view = LensView(hw=HW, K=intrinsics(100.0, HW), distortion=Division(number(-0.1)))
    rig = Rig({"a": view, "b": view})
    rig.save(tmp_path / "rig.yaml")
    assert Rig.load(tmp_path / "rig.yaml") == rig


def test_what_no_file_gives_back_is_not_written(tmp_path):
    @dataclass(frozen=True, eq=False, repr=False)
    class Untyped(Stereographic, name="tests-untyped"):
        k: object

    for k, said in ((number(0.1), "torch.Tensor"), ({0.1}, "set")):
        with pytest.raises(ValueError, match=said):
            Rig({"own": camera("own").replace(distortion=Untyped(k))}).save(tmp_path / "rig.yaml")
