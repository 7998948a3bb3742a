"""Public operators as functions of one vector (float64), each a small case away from kinks."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

import arraygeom as ag
from arraygeom import Distortion, Pose
from arraygeom.fields import covering_displacement
from pat.attention import attend, attend_with_statistics
from tests.arraygeom.rigs import random_rig
from tests.arraygeom.test_camera_models import MODELS, camera


class Operator(NamedTuple):
    """A function of a vector, and where to ask about it."""

    f: Callable[[Tensor], Tensor]
    x: Tensor
    autocast: float = 1e-9
    """How far autocast to bfloat16 may take the answer: attention casts its features, as it says."""


def vector(*numbers: float) -> Tensor:
    return torch.tensor(numbers, dtype=torch.float64)


RIG = random_rig(1)
PAIR = RIG.pair("alpha", "beta")
A, B = PAIR.cameras
ROWS = A.K.new_tensor([[1.0], [1.0], [0.0]])
BROWN = A.replace(distortion=Distortion("brown-conrady", vector(-0.1, 0.02, 1e-3, -5e-4)))
FISHEYE = A.replace(distortion=Distortion("kannala-brandt", vector(0.05, -0.01, 0.002, -1e-3)))
SPHERES = Distortion("double-sphere", vector(-0.2, 0.57))
PRISM = Distortion("thin-prism-fisheye", vector(0.05, -0.01, 1e-3, -2e-3, 3e-3, -5e-4, 1e-3, -7e-4))
OMNI = Distortion("scaramuzza", vector(-0.3, 0.02, -0.01))
CURVED = RIG.with_camera("alpha", BROWN).pair("alpha", "beta")
X = vector(30.2, 20.7, 11.4, 33.1)
POINTS = vector(0.2, -0.1, 2.5, -0.4, 0.3, 4.0)
NEAR, FAR = (d.clone() for d in RIG.depth)
EIGHT = vector(*(float(v) for v in torch.linspace(3, 44, 16, dtype=torch.float64).sin() * 20 + 30))
MAP = vector(1.02, 0.03, 2.0, -0.02, 0.98, 1.0, 1e-4, -2e-4, 1.0).reshape(3, 3)
MAPPED = ag.apply_homography(MAP, EIGHT.reshape(-1, 2)).x.flatten() + 0.1 * EIGHT.cos()


def pixels(x: Tensor) -> Tensor:
    return x.reshape(-1, 2)


def moved_pair(w: Tensor) -> ag.Pair:
    """Beta's rotation and translation changed: the geometry of a calibration."""
    pose = Pose(ag.rotation_from_vector(w[:3]) @ B.R, B.t + w[3:])
    return ag.Pair(A, B.replace(cam_from_world=pose), RIG.depth)


def ends(found: ag.Segments | ag.Positions) -> Tensor:
    return torch.cat([found.start, found.end], -1) if isinstance(found, ag.Segments) else found.xy


def field(made: ag.ReceptiveField, pair: ag.Pair = PAIR) -> Callable[[Tensor], Tensor]:
    return lambda x: ends(made(pair, pixels(x)))


def attention(run: Callable[..., Tensor], of: str) -> Operator:
    g = torch.Generator().manual_seed(0)
    given = {n: torch.randn(1, 2, 2, 2, dtype=torch.float64, generator=g) for n in ("query", "key", "value")}
    start, end = (torch.rand(2, 2, 2, dtype=torch.float64, generator=g) * 0.8 + 0.1 for _ in range(2))
    valid = torch.ones(2, 2, dtype=torch.bool)

    def f(x: Tensor) -> Tensor:
        here = dict(given)
        segments = ag.Segments(start, end, valid)
        if of == "geometry":
            segments = ag.Segments(x.reshape(2, 2, 2), end, valid)
        else:
            here[of] = x.reshape(1, 2, 2, 2)
        return run(here["query"], here["key"], here["value"], segments, samples=3)

    return Operator(f, (start if of == "geometry" else given[of]).flatten().clone(), 0.05)


def measured(*given: Tensor, **options: object) -> Tensor:
    found = attend_with_statistics(*given, **options)  # type: ignore[arg-type]
    return torch.cat(
        [found.value.flatten(), found.position.flatten(), found.deviation.flatten(), found.peak.flatten()]
    )


def cpu(*given: Tensor, **options: object) -> Tensor:
    return attend(*given, backend="cpu", **options)  # type: ignore[arg-type]


MATCHED = B.project(A.unproject(pixels(X), vector(2.0, 3.0))).x + 0.3
W = vector(0.01, -0.02, 0.005, 0.03, -0.01, 0.02)
GEOMETRY = {
    "apply_homography": Operator(lambda x: ag.apply_homography(MAP, pixels(x)).x, X),
    "epipolar_lines": Operator(lambda x: ag.epipolar_lines(PAIR.fundamental, pixels(x)), X),
    "epipolar_distance": Operator(
        lambda x: ag.epipolar_distance(PAIR.fundamental, pixels(x), pixels(x) + 1), X
    ),
    "epipoles": Operator(lambda w: ag.epipoles(moved_pair(w).fundamental)[1].square(), W),
    "essential_matrix": Operator(lambda w: ag.essential_matrix(moved_pair(w).beta_from_alpha), W),
    "fundamental_matrix": Operator(lambda w: moved_pair(w).fundamental * 1e3, W),
    "infinite_homography": Operator(
        lambda w: ag.infinite_homography(A.K, B.K, ag.rotation_from_vector(w[:3])), W
    ),
    "homography_at": Operator(lambda w: moved_pair(w).homography_at(vector(3.0)[0]), W),
    "plane_homography": Operator(lambda w: _of_plane(moved_pair(w).beta_from_alpha), W),
    "rectify": Operator(lambda w: ag.rectify(moved_pair(w)).H_beta, W),
    "approximated": Operator(lambda w: ag.approximated(moved_pair(w)).homography, W),
    "rotation_from_vector": Operator(lambda w: ag.rotation_from_vector(w[:3]), W),
    "intrinsics": Operator(lambda w: ag.intrinsics(w[:2] + 100, (48, 64), w[2:4] + 30), W),
    "shift_origin": Operator(lambda w: ag.shift_origin(moved_pair(w).fundamental, 1) * 1e3, W),
    "track": Operator(lambda x: ag.track(A.K, B.K, PAIR.beta_from_alpha, pixels(x)).a, X),
    "segments_between": Operator(lambda x: ends(ag.segments_between(_track(x), NEAR, FAR, B.hw)), X),
    "depth_from_track": Operator(lambda x: ag.depth_from_track(_track(X), pixels(x)).depth, X + 2),
    "depth_of": Operator(lambda x: ag.depth_of(PAIR, pixels(X), pixels(x)).depth, X + 2),
    "depth_of, through lenses": Operator(lambda x: ag.depth_of(CURVED, pixels(X), pixels(x)).depth, X + 2),
    "triangulate": Operator(lambda x: ag.triangulate([A, B], torch.stack([pixels(x), MATCHED])).X, X),
    "fit_similarity": Operator(
        lambda x: ag.fit_similarity(pixels(EIGHT), pixels(x)), EIGHT * 1.1 + EIGHT.flip(0) * 0.1
    ),
    "fit_homography": Operator(lambda x: ag.fit_homography(pixels(EIGHT), pixels(x)), MAPPED),
    "sample": Operator(lambda x: ag.sample(_image(), x.reshape(1, -1, 2) / 10).values, X),
    "to_grid": Operator(lambda x: ag.to_grid(pixels(x), (48, 64)), X),
    "Camera.project": Operator(lambda x: A.project(x.reshape(-1, 3) @ A.R + A.centre).x, POINTS),
    "Camera.resize": Operator(lambda w: A.replace(K=A.K + w[0] * ROWS).resize((24, 30)).rot90(1).K, W),
    "Pose.perturbed, inverse": Operator(lambda w: A.cam_from_world.perturbed(w[:3], w[3:]).inverse().t, W),
    "Camera.unproject": Operator(lambda x: A.unproject(pixels(x), x[::2]), X),
    "Camera.rays": Operator(lambda x: A.rays(pixels(x))[0], X),
    "distort, brown-conrady": Operator(lambda x: BROWN.distort(pixels(x))[0], X),
    "undistort, brown-conrady": Operator(lambda x: BROWN.undistort(pixels(x))[0], X),
    "distort, kannala-brandt": Operator(lambda x: FISHEYE.distort(pixels(x))[0], X),
    "undistort, kannala-brandt": Operator(lambda x: FISHEYE.undistort(pixels(x))[0], X),
    "project, double-sphere": Operator(lambda x: SPHERES.project(x.reshape(-1, 3))[0], POINTS),
    "unproject, thin-prism-fisheye": Operator(lambda x: PRISM.unproject(pixels(x) / 50)[0], X),
    "project, scaramuzza": Operator(lambda x: OMNI.project(x.reshape(-1, 3))[0], POINTS),
    "covering_displacement": Operator(lambda w: covering_displacement(moved_pair(w)), W),
}
FIELDS = {
    "Epipolar": Operator(field(ag.Epipolar()), X),
    "Epipolar, by calibration": Operator(lambda w: ends(ag.Epipolar()(moved_pair(w), pixels(X))), W),
    "EpipolarLine": Operator(field(ag.EpipolarLine()), X),
    "HomographyDisplacement": Operator(field(ag.HomographyDisplacement(8.0)), X),
    "Rectified": Operator(field(ag.Rectified(10.0, alpha_is="either")), X),
    "NearestVoxels": Operator(field(ag.NearestVoxels(6, 4)), X),
    "Local": Operator(field(ag.Local(3)), X),
    "Dense": Operator(field(ag.Dense(16)), X),
    "Curved": Operator(field(ag.Curved(5, nodes=8), CURVED), X),
    "Curved, by calibration": Operator(lambda w: ends(ag.Curved(5, nodes=8)(moved_pair(w), pixels(X))), W),
    "ThroughLenses": Operator(field(ag.ThroughLenses(ag.Epipolar(), 5), CURVED), X),
    "Widened": Operator(field(ag.Widened(ag.Epipolar(), across=1, along=1, samples=5)), X),
    "Moved": Operator(field(ag.Moved(ag.Epipolar(), torch.full((2, 48, 64), 0.25, dtype=torch.float64))), X),
}
ATTENTION = {
    **{f"attend, by {of}": attention(attend, of) for of in ("query", "key", "value", "geometry")},
    "attend, border": attention(partial(attend, border=0.5), "geometry"),
    "attend_with_statistics": attention(measured, "query"),
    'attend, backend="cpu"': attention(cpu, "query"),
}


def of_model(name: str) -> dict[str, Operator]:
    """Projection, rays and the curve of a camera model, as beta."""
    beta = camera(name, beta=True)
    pair = ag.Pair(camera("own"), beta, RIG.depth)
    ahead = POINTS.reshape(-1, 3) @ beta.R + beta.centre
    return {
        f"project, {name}": Operator(lambda x: beta.project(x.reshape(-1, 3)).x, ahead.flatten()),
        f"unproject, {name}": Operator(lambda x: beta.unproject(pixels(x), 1 + x[::2] / 50), SHOWN),
        f"Curved, {name}": Operator(lambda x: ends(ag.Curved(5, nodes=8)(pair, pixels(x))), SHOWN),
    }


SHOWN = vector(60.2, 44.7, 71.4, 53.1)
MODEL_OPERATORS = {key: operator for name in MODELS for key, operator in of_model(name).items()}
OPERATORS = {**GEOMETRY, **FIELDS, **ATTENTION, **MODEL_OPERATORS}


def _of_plane(pose: Pose) -> Tensor:
    return ag.plane_homography(A.K, B.K, pose.R, pose.t, normal=vector(0, 0, 1), d=vector(-3)[0])


def _track(x: Tensor) -> ag.Track:
    return ag.track(A.K, B.K, PAIR.beta_from_alpha, pixels(x))


def _image() -> Tensor:
    return torch.arange(36, dtype=torch.float64).reshape(1, 1, 6, 6).sin()
