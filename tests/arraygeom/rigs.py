"""Rigs that the tests look at."""

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from arraygeom import (
    Camera,
    Distortion,
    LensView,
    Link,
    Pair,
    Pose,
    Rig,
    View,
    intrinsics,
    rotation_from_vector,
)

HW_ALPHA, HW_BETA = (48, 64), (40, 60)
PAIRS_HW = (800, 1280)
BARREL = Distortion("brown-conrady", torch.tensor([-0.1, 0.02, 1e-3, -5e-4], dtype=torch.float64))


def number(*values: float) -> Tensor:
    """One float64 number, or a vector of several."""
    return torch.tensor(values if len(values) > 1 else values[0], dtype=torch.float64)


def uniform(g: torch.Generator, low: float, high: float, *shape: int) -> Tensor:
    return low + (high - low) * torch.rand(shape, generator=g, dtype=torch.float64)


def directions(n: int, *, seed: int = 0) -> Tensor:
    X = torch.randn(n, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return X / X.norm(dim=-1, keepdim=True)


def random_camera(
    g: torch.Generator, hw: tuple[int, int], *, turn: float = 0.25, baseline: float = 0.4
) -> Camera:
    """A camera near the origin that looks roughly ahead, of about 60 degrees."""
    focal = (hw[1] * float(uniform(g, 0.7, 1.1)), hw[1] * float(uniform(g, 0.7, 1.1)))
    centre = (hw[1] * float(uniform(g, 0.4, 0.6)), hw[0] * float(uniform(g, 0.4, 0.6)))
    R = rotation_from_vector(uniform(g, -turn, turn, 3))
    return Camera(
        K=intrinsics(focal, hw, centre), cam_from_world=Pose(R, uniform(g, -baseline, baseline, 3)), hw=hw
    )


def random_rig(seed: int, *, near: float = 1.5, far: float = 10.0, **camera: float) -> Rig:
    """Two unlike cameras, alpha and beta, none of them in the world's own frame."""
    g = torch.Generator().manual_seed(seed)
    cameras = {"alpha": random_camera(g, HW_ALPHA, **camera), "beta": random_camera(g, HW_BETA, **camera)}
    return Rig(cameras, depth=(near, far))


def with_lenses(rig: Rig, alpha: Distortion | None, beta: Distortion | None) -> Rig:
    rig = rig.with_camera("alpha", rig["alpha"].replace(distortion=alpha))
    return rig.with_camera("beta", rig["beta"].replace(distortion=beta))


def known_by_f(rig: Rig) -> Rig:
    """The same pair known by F and H alone; lenses count in the unit of their camera's focal length."""
    pair, views = rig.pair(*rig.names), {}
    for name, c in rig.cameras.items():
        lens = c.distortion
        views[name] = View(hw=c.hw) if lens is None else LensView(hw=c.hw, K=c.K, distortion=lens)
    return Rig(views, links={rig.names: Link(pair.fundamental, pair.homography)})


def scene_points(rig: Rig, n: int = 200, *, seed: int = 0) -> Tensor:
    """World points that alpha sees, between the rig's depth bounds."""
    g = torch.Generator().manual_seed(seed)
    alpha, (near, far) = rig["alpha"], rig.depth
    h, w = alpha.hw
    x = torch.stack([uniform(g, 0, w - 1, n), uniform(g, 0, h - 1, n)], -1)
    inverse = torch.lerp(1 / far, 1 / near, torch.rand(n, generator=g, dtype=torch.float64))
    return alpha.unproject(x, 1 / inverse)


def parallel_rig(
    focal: float,
    hw: tuple[int, int],
    places: Mapping[str, tuple[float, ...]],
    depth: tuple[float, float] | None = None,
    **fields: object,
) -> Rig:
    """Equal cameras with parallel axes at places in metres: x, or x and y, or all three."""
    centres = {name: torch.tensor([*place, 0, 0, 0][:3]).double() for name, place in places.items()}
    one = Camera(K=intrinsics(focal, hw), cam_from_world=Pose.identity(), hw=hw, **fields)
    return Rig({n: one.replace(cam_from_world=Pose(one.R, 0 - c)) for n, c in centres.items()}, depth=depth)


def two_cameras(
    R: Tensor | None = None, centre: tuple[float, float, float] = (0.0, 0.0, 0.0), **rig: object
) -> Rig:
    """Alpha in the world's frame, beta turned by R with its centre where told; both of 90 degrees."""
    K = intrinsics(32.0, (48, 64))
    R = torch.eye(3, dtype=torch.float64) if R is None else R
    beta = Pose.from_centre(R, torch.tensor(centre, dtype=torch.float64))
    cameras = {
        "alpha": Camera(K=K, cam_from_world=Pose.identity(), hw=(48, 64)),
        "beta": Camera(K=K, cam_from_world=beta, hw=(48, 64)),
    }
    return Rig(cameras, depth=rig.get("depth", (1.0, 10.0)))


def half_rotation() -> Tensor:
    """Looking back: half a turn about y."""
    return rotation_from_vector(torch.tensor([0.0, math.pi, 0.0], dtype=torch.float64))


def pairs(lens: Distortion | None = None) -> list[Pair]:
    """One alpha and three betas about 10 cm apart, turned by a degree or two."""
    K = intrinsics(900.0, PAIRS_HW)
    places = torch.tensor(
        [[0, 0, 0], [0.1, 0.02, 0], [-0.1, 0.01, 0.03], [0.02, 0.12, -0.02]], dtype=torch.float64
    )
    cameras = [
        Camera(
            K=K,
            cam_from_world=Pose.from_centre(rotation_from_vector(0.3 * p), p),
            hw=PAIRS_HW,
            distortion=lens,
        )
        for p in places
    ]
    depth = (torch.tensor(1.0, dtype=torch.float64), torch.tensor(20.0, dtype=torch.float64))
    return [Pair(cameras[0], beta, depth) for beta in cameras[1:]]
