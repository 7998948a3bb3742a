"""Multiview operators beside OpenCV, kornia, pycolmap, SciPy: value, gradient, time; docs/reports/lenses.md.

    python -m tests.benchmarks.bench_operators [--write]

Values: the largest difference of the two, relative to the largest value, on what both have; of noisy
triangulation (one pixel, points at 3 to 6 m) each one's own median error against the true point, mm.
Gradients: ours against central differences, relative; "none" where the library has none. Times are of
processor time for 2,000 points or one image of 240 x 320, float64, one thread, theirs divided by ours: above
1, arraygeom is faster.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from statistics import median
from typing import Any, NamedTuple

import cv2
import kornia.geometry as kg
import numpy as np
import torch
from kornia.geometry.depth import warp_frame_depth
from scipy.optimize import least_squares
from torch import Tensor

from arraygeom import (
    Camera,
    Distortion,
    Pose,
    Rig,
    bundle_adjusted,
    intrinsics,
    plane_sweep,
    poses_from_essential,
    reprojection_residuals,
    rotation_from_vector,
    triangulate,
    warp,
    world_rays,
)
from arraygeom.lenses import FlatPort, RollingShutter
from docs.update_readme import write_block
from pat.app.cli.parser import script
from pat.lab.evaluation.tables import markdown_table
from tests.benchmarks.bench_kornia import gradient_error
from tests.benchmarks.printed import REPORTS, timed

try:
    import pycolmap
except ImportError:
    pycolmap = None

F64, HW, N = torch.float64, (240, 320), 2000
G = torch.Generator().manual_seed(0)


def vector(*numbers: float) -> Tensor:
    return torch.tensor(numbers, dtype=F64)


def rig_of(lens: Any = None, cameras: int = 2) -> Rig:
    made = {}
    for i in range(cameras):
        R = rotation_from_vector(vector(0.01, -0.02, 0.005) * i)
        pose = Pose(R, -R @ vector(0.2 * i, 0.02 * i, 0.01 * i))
        made[f"camera {i}"] = Camera(K=intrinsics(300.0, HW), cam_from_world=pose, hw=HW, distortion=lens)
    return Rig(made, depth=(3.0, 6.0))


X = torch.cat(
    [torch.rand(N, 2, dtype=F64, generator=G) * 2 - 1, 3 + 3 * torch.rand(N, 1, dtype=F64, generator=G)], 1
)
NOISE = torch.randn(2, N, 2, dtype=F64, generator=G)
PINHOLES = rig_of()
BROWN = rig_of(Distortion("brown-conrady", vector(-0.1, 0.02, 1e-3, -5e-4)))
NOT_CENTRAL = {
    "rolling shutter": RollingShutter(
        velocity=vector(0.5, 0.1, 0.2), rotation=vector(0.1, 0.3, 0.2), readout=vector(0.05)[0]
    ),
    "flat port": FlatPort(
        distance=vector(0.05)[0], thickness=vector(0.01)[0], glass=vector(1.52)[0], water=vector(1.333)[0]
    ),
}


class Row(NamedTuple):
    """Row of the table: operator, library, values and gradients in words, and ratio of times."""

    what: str
    library: str
    value: str
    ours: str
    theirs: str
    time: str


def ratio(ours: Callable[[], object], theirs: Callable[[], object], runs: int = 5) -> str:
    """Times of theirs divided by ours: medians, alternating."""
    mine, other = timed(ours, theirs, repeats=runs)
    return f"{median(other) / median(mine):.2g}"


def apart(ours: Tensor, theirs: Any) -> str:
    theirs = torch.as_tensor(np.asarray(theirs), dtype=F64)
    return f"{float((ours - theirs).abs().max() / theirs.abs().max()):.0e}"


def projection(camera: Camera) -> np.ndarray:
    return (camera.K @ torch.cat([camera.R, camera.t[:, None]], 1)).numpy()


def seen(rig: Rig) -> Tensor:
    return torch.stack([camera.project(X).x for camera in rig.cameras.values()])


def points_of(rig: Rig, x: Tensor) -> Tensor:
    return triangulate(list(rig.cameras.values()), x, residual=20.0).X


def opencv_points(x: Tensor) -> np.ndarray:
    P = [projection(camera) for camera in PINHOLES.cameras.values()]
    found = cv2.triangulatePoints(*P, *(part.T.numpy().copy() for part in x))
    return (found[:3] / found[3]).T


def kornia_points(x: Tensor) -> Tensor:
    P = [torch.from_numpy(projection(camera)) for camera in PINHOLES.cameras.values()]
    return kg.epipolar.triangulate_points(*P, *x)


def colmap_points(x: Tensor) -> np.ndarray:
    cameras = list(PINHOLES.cameras.values())
    poses = [torch.cat([c.R, c.t[:, None]], 1).numpy() for c in cameras]
    flat = [(c.rays(part)[0][:, :2]).numpy() for c, part in zip(cameras, x)]
    found = [pycolmap.triangulate_point(*poses, a, b) for a, b in zip(*flat)]
    return np.stack([np.full(3, np.nan) if p is None else p.reshape(3) for p in found])


def millimetres(found: Any) -> str:
    return f"{1e3 * float(np.nanmedian(np.linalg.norm(np.asarray(found) - X.numpy(), axis=1))):.1f} mm"


def triangulations() -> Iterator[Row]:
    x = seen(PINHOLES)
    noisy = x + NOISE
    few = x[:, :20].flatten()
    ours = gradient_error(lambda v: points_of(PINHOLES, v.reshape(2, 20, 2)), few)
    theirs = {"OpenCV": opencv_points, "kornia": kornia_points}
    theirs |= {"pycolmap": colmap_points} if pycolmap else {}
    own = millimetres(points_of(PINHOLES, noisy))
    for name, f in theirs.items():
        slope = "none"
        if name == "kornia":
            slope = f"{gradient_error(lambda v: kornia_points(v.reshape(2, 20, 2)), few):.0e}"
        value = f"{apart(points_of(PINHOLES, x), f(x))}; with noise {own}, theirs {millimetres(f(noisy))}"
        times = ratio(lambda: points_of(PINHOLES, x), lambda f=f: f(x), runs=3)
        yield Row("triangulate, two pinholes", name, value, f"{ours:.0e}", slope, times)
    bent = seen(BROWN)

    def undistorted() -> np.ndarray:
        cameras, c = list(BROWN.cameras.values()), np.array([-0.1, 0.02, 1e-3, -5e-4])
        flat = [cv2.undistortPoints(part.numpy()[:, None], cameras[0].K.numpy(), c)[:, 0] for part in bent]
        P = [torch.cat([k.R, k.t[:, None]], 1).numpy() for k in cameras]
        found = cv2.triangulatePoints(*P, *(part.T.copy() for part in flat))
        return (found[:3] / found[3]).T

    slope = f"{gradient_error(lambda v: points_of(BROWN, v.reshape(2, 20, 2)), bent[:, :20].flatten()):.0e}"
    own, theirs_ = (apart(torch.as_tensor(found), X) for found in (points_of(BROWN, bent), undistorted()))
    times = ratio(lambda: points_of(BROWN, bent), undistorted, 3)
    yield Row("triangulate, lenses", "OpenCV", f"true points {own}, theirs {theirs_}", slope, "none", times)
    for name, model in NOT_CENTRAL.items():
        rig = rig_of(model)
        x = seen(rig)
        error = gradient_error(lambda v, rig=rig: points_of(rig, v.reshape(2, 20, 2)), x[:, :20].flatten())
        value = f"true points {apart(points_of(rig, x), X)}"
        yield Row(f"triangulate, {name}", "no other", value, f"{error:.0e}", "", "")


def poses() -> Iterator[Row]:
    pair = PINHOLES.pair("camera 0", "camera 1")
    E = kg.epipolar.cross_product_matrix(pair.beta_from_alpha.t[None])[0] @ pair.beta_from_alpha.R
    ours = poses_from_essential(E)
    R1, R2, _ = cv2.decomposeEssentialMat(E.numpy())
    other = [min(float((R - torch.from_numpy(r)).abs().max()) for r in (R1, R2)) for R in ours.R[:2]]
    slope = f"{gradient_error(lambda v: poses_from_essential(v.reshape(3, 3)).R, E.flatten()):.0e}"
    times = ratio(lambda: poses_from_essential(E), lambda: cv2.decomposeEssentialMat(E.numpy()), 31)
    yield Row("poses from E", "OpenCV", f"{max(other):.0e}", slope, "none", times)


def images() -> Iterator[Row]:
    pair = PINHOLES.pair("camera 0", "camera 1")
    image = torch.rand(1, 3, *HW, dtype=F64, generator=G)
    depth = 3 + torch.rand(1, *HW, dtype=F64, generator=G)
    T, one = pair.beta_from_alpha.matrix[None], pair.cameras[0].K[None]

    def theirs(d: Tensor) -> Tensor:
        return warp_frame_depth(image, d[:, None], T, one)

    ones = warp_frame_depth(torch.ones_like(image), depth[:, None], T, one)
    inner = ones > 1 - 1e-9  # at the borders kornia and OpenCV blend with black
    value = apart(warp(pair, image, depth).values[inner], theirs(depth)[inner])
    smooth = image.new_tensor(1.0) * torch.linspace(0, 1, HW[1], dtype=F64).square().expand(1, 3, *HW)
    ours = gradient_error(lambda d: warp(pair, smooth, d[None]).values[inner], depth[0])
    slope = gradient_error(lambda d: warp_frame_depth(smooth, d[None, None], T, one)[inner], depth[0])
    times = ratio(lambda: warp(pair, image, depth), lambda: theirs(depth))
    yield Row("warp by depth, one K", "kornia", value, f"{ours:.0e}", f"{slope:.0e}", times)
    planes = torch.linspace(3, 6, 8, dtype=F64)
    picture = image[0].movedim(0, -1).numpy().copy()

    def swept(picture: np.ndarray = picture) -> np.ndarray:
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        maps = (pair.homography_at(d).numpy() for d in planes)
        return np.stack([cv2.warpPerspective(picture, H, HW[::-1], flags=flags) for H in maps])

    found = plane_sweep(pair, image, planes)
    inner = swept(np.ones_like(picture)) > 1 - 1e-9
    off = (found.values[0].permute(1, 2, 3, 0).numpy() - swept())[inner]
    value = f"{np.abs(off).max():.0e}, theirs rounded to 1/32 px"
    times = ratio(lambda: plane_sweep(pair, image, planes), swept)
    yield Row("plane sweep, 8 planes", "OpenCV", value, "as warp", "none", times)


def adjustment() -> Iterator[Row]:
    rig, points = rig_of(cameras=3), X[:100]
    cameras = list(rig.cameras.values())
    x = torch.stack([c.project(points).x for c in cameras]) + 0.3 * torch.randn(
        3, 100, 2, dtype=F64, generator=G
    )
    free = ["camera 1.rotation", "camera 2.rotation", "camera 2.translation"]
    zeros = rig.parameters(free=free)
    sizes = [v.numel() for v in zeros.values()]

    def cost(v: np.ndarray) -> np.ndarray:
        p = torch.from_numpy(v)
        moved = rig.perturbed(dict(zip(zeros, p[: sum(sizes)].split(sizes))))
        found = p[sum(sizes) :].reshape(-1, 3)
        return reprojection_residuals(list(moved.cameras.values()), found, x).flatten().numpy()

    def theirs() -> Any:
        start = np.concatenate([np.zeros(sum(sizes)), points.flatten().numpy()])
        return least_squares(cost, start, method="trf")

    ours = bundle_adjusted(rig, points, x, free=free)
    value = f"cost, relative {float(ours.cost[-1]) / (2 * theirs().cost) - 1:+.0e}"
    slope = gradient_error(
        lambda v: bundle_adjusted(rig, points, v.reshape(3, 100, 2), free=free).X, x.flatten()
    )
    times = ratio(lambda: bundle_adjusted(rig, points, x, free=free), theirs, 1)
    yield Row("bundle adjustment, 309 numbers", "SciPy", value, f"{slope:.0e}", "none", times)
    c = np.array([-0.1, 0.02, 1e-3, -5e-4])
    camera = BROWN["camera 1"]

    def projected() -> np.ndarray:
        rotation = cv2.Rodrigues(camera.R.numpy())[0]
        return cv2.projectPoints(X.numpy()[:, None], rotation, camera.t.numpy(), camera.K.numpy(), c)[0][:, 0]

    slope = gradient_error(lambda v: camera.project(v.reshape(-1, 3)).x, X[:20].flatten())
    times = ratio(lambda: camera.project(X), projected)
    value = apart(camera.project(X).x, projected())
    yield Row("projection through a lens", "OpenCV", value, f"{slope:.0e}", "none", times)
    rays = world_rays(camera, camera.project(X).x)
    away = torch.linalg.cross(X, rays.direction).sub(rays.plucker[:, 3:]).norm(dim=-1).max()
    value = f"true points off their rays by {float(away):.0e} m"
    yield Row("rays, Pluecker coordinates", "no other", value, "", "", "")


HEAD = ("operator", "beside", "value", "gradient error, ours", "theirs", "time, theirs / ours")


def main(write: bool = False) -> None:
    """Print the table, and put it into docs/reports/lenses.md if asked."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    lines = []
    for part in (triangulations, poses, images, adjustment):
        for row in part():
            print(" | ".join(row), flush=True)
            lines.append(row)
    if write:
        write_block(REPORTS / "lenses.md", "operators", markdown_table(HEAD, lines, align="l"))


if __name__ == "__main__":
    script(main)
