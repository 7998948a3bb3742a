"""Lens models beside OpenCV, kornia, pycolmap: answers, derivatives, vmap, time; docs/reports/lenses.md.

    python -m tests.benchmarks.bench_lenses [--lenses 1000] [--write]

1,000 random lenses of each model, 100 directions each, f = 1000 px, float64. The truth is the model's
formula, written here in numpy, along the path from the axis to the direction: a lens is followed until its
image folds (its Jacobian no longer keeps orientation). `project` is wrong where an answer that is not flagged
is more than .1 px off, or is given beyond the fold, where the pixel is another direction's. `unproject` is
asked for the pixels of directions before the fold, and elsewhere for some beyond all that the lens can show;
it is wrong where the formula does not lead from its answer back to the pixel within .1 px, or from beyond the
fold. Missed: a direction before the fold, or its pixel, flagged as not valid. A library's flag is its own, or
NaN, infinity, or OpenCV's -1000000.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from statistics import median
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from arraygeom import Distortion
from arraygeom.kornia_models import to_kornia_model
from arraygeom.lenses import PolynomialFisheye
from arraygeom.lenses.model import LensModel
from docs.update_readme import write_block
from pat.app.cli.parser import script
from pat.lab.evaluation.tables import markdown_table
from tests.benchmarks.printed import REPORTS, timed

try:
    import pycolmap
except ImportError:
    pycolmap = None

Array = NDArray[np.float64]
Answer = tuple[Array, NDArray[np.bool_]]
FOCAL, POINTS, STEPS, OFF = 1000.0, 100, 48, 0.1
K = np.diag([FOCAL, FOCAL, 1.0])


class Family(NamedTuple):
    """A model: coefficients by a generator, its formula of c (n, k) and X (n, 3), the widest angle asked."""

    draw: Callable[[np.random.Generator], list[float]]
    formula: Callable[[Any, Array], Array]
    widest: float


def tangential(x: Array, y: Array, radial: Array, p1: Array, p2: Array) -> Array:
    """Points times a radial factor, and Brown's tangential terms."""
    u = x * x + y * y
    across, down = 2 * p1 * x * y + p2 * (u + 2 * x * x), p1 * (u + 2 * y * y) + 2 * p2 * x * y
    return np.stack([x * radial + across, y * radial + down], -1)


def polynomials(c: Any, x: Array, y: Array) -> Array:
    """Brown's radial and tangential terms: k1 k2 p1 p2 k3 k4 k5 k6."""
    k1, k2, p1, p2, k3, k4, k5, k6 = c
    u = x * x + y * y
    radial = (1 + u * (k1 + u * (k2 + u * k3))) / (1 + u * (k4 + u * (k5 + u * k6)))
    return tangential(x, y, radial, p1, p2)


def flat(X: Array) -> tuple[Array, Array]:
    return X[:, 0] / X[:, 2], X[:, 1] / X[:, 2]


def by_angle(X: Array, radius: Callable[[Array], Array]) -> Array:
    rho = np.hypot(X[:, 0], X[:, 1])
    return X[:, :2] * (radius(np.arctan2(rho, X[:, 2])) / np.maximum(rho, 1e-300))[:, None]


def fisheye(c: Any, X: Array) -> Array:
    k1, k2, k3, k4 = c
    return by_angle(X, lambda t: t * (1 + k1 * t**2 + k2 * t**4 + k3 * t**6 + k4 * t**8))


def prism(c: Any, X: Array) -> Array:
    k1, k2, p1, p2, k3, k4, sx, sy = c
    x, y = by_angle(X, lambda t: t).T
    u = x * x + y * y
    radial = 1 + u * (k1 + u * (k2 + u * (k3 + u * k4)))
    return tangential(x, y, radial, p1, p2) + np.stack([sx * u, sy * u], -1)


def double_sphere(c: Any, X: Array) -> Array:
    xi, alpha = c
    u = X[:, 0] ** 2 + X[:, 1] ** 2
    z = xi * np.sqrt(u + X[:, 2] ** 2) + X[:, 2]
    return X[:, :2] / (alpha * np.sqrt(u + z**2) + (1 - alpha) * z)[:, None]


def extended(c: Any, X: Array) -> Array:
    alpha, beta = c
    u = X[:, 0] ** 2 + X[:, 1] ** 2
    return X[:, :2] / (alpha * np.sqrt(beta * u + X[:, 2] ** 2) + (1 - alpha) * X[:, 2])[:, None]


def unified(c: Any, X: Array) -> Array:
    xi, k1, k2, p1, p2 = c
    x, y = X[:, :2].T / (X[:, 2] + xi * np.linalg.norm(X, axis=1))
    return polynomials((k1, k2, p1, p2, 0, 0, 0, 0), x, y)


def fov(c: Any, X: Array) -> Array:
    (omega,) = c
    double = 2 * np.tan(omega / 2)
    rho = np.hypot(X[:, 0], X[:, 1])
    return X[:, :2] * (np.arctan2(double * rho, X[:, 2]) / omega / np.maximum(rho, 1e-300))[:, None]


def spread(rng: np.random.Generator, *sizes: float) -> list[float]:
    return [float(v) for v in rng.uniform(-1, 1, len(sizes)) * sizes]


WIDE = math.radians(80)
FAMILIES = {
    "brown-conrady": Family(
        lambda g: (
            spread(g, 0.5, 0.2, 0.01, 0.01, 0.05)
            + (spread(g, 0.2, 0.1, 0.02) if g.random() < 0.5 else [0.0] * 3)
        ),
        lambda c, X: polynomials(c, *flat(X)),
        math.radians(60),
    ),
    "kannala-brandt": Family(lambda g: spread(g, 0.2, 0.1, 0.05, 0.02), fisheye, WIDE),
    "thin-prism-fisheye": Family(
        lambda g: spread(g, 0.2, 0.1, 0.01, 0.01, 0.05, 0.02, 0.01, 0.01), prism, WIDE
    ),
    "fov": Family(lambda g: [float(g.uniform(0.3, 2.0))], fov, WIDE),
    "unified": Family(lambda g: [float(g.uniform(0, 2)), *spread(g, 0.3, 0.1, 0.01, 0.01)], unified, WIDE),
    "extended-unified": Family(lambda g: [float(g.uniform(0, 1)), float(g.uniform(0.5, 2))], extended, WIDE),
    "double-sphere": Family(
        lambda g: [float(g.uniform(-0.8, 0.8)), float(g.uniform(0, 1))], double_sphere, WIDE
    ),
    "polynomial-fisheye": Family(
        lambda g: spread(g, 0.2, 0.2, 0.1),
        lambda c, X: by_angle(X, lambda t: t + c[0] * t**2 + c[1] * t**3 + c[2] * t**4),
        WIDE,
    ),
}


def direction(angle: Array) -> Array:
    """Unit directions of points (n, 2) whose length is the angle from the axis."""
    theta = np.linalg.norm(angle, axis=1, keepdims=True)
    return np.concatenate([np.sinc(theta / np.pi) * angle, np.cos(theta)], 1)


def before_fold(family: Family, c: Array, angle: Array) -> NDArray[np.bool_]:
    """Return True if the formula keeps orientation all the way from the axis."""
    h, kept = 1e-6, np.ones(len(angle), bool)
    for share in np.linspace(1 / STEPS, 1, STEPS):
        at = share * angle
        with np.errstate(all="ignore"):
            middle, right, down = (
                family.formula(c.T, direction(at + step)) for step in ([0, 0], [h, 0], [0, h])
            )
        (a, b), (p, q) = ((right - middle) / h).T, ((down - middle) / h).T
        kept &= (a * q - b * p > 0) & (a + q > 0)
    return kept


class Drawn(NamedTuple):
    """Lenses c (l, k); directions (l p, 3), their pixels, whether before the fold; pixels to unproject."""

    c: Array
    X: Array
    pixels: Array
    seen: NDArray[np.bool_]
    asked: Array


def drawn(name: str, lenses: int) -> Drawn:
    family, rng = FAMILIES[name], np.random.default_rng(0)
    c = np.array([family.draw(rng) for _ in range(lenses)])
    each = np.repeat(c, POINTS, 0)
    around, theta = (
        rng.uniform(0, 2 * np.pi, len(each)),
        family.widest * np.sqrt(rng.uniform(0, 1, len(each))),
    )
    angle = theta[:, None] * np.stack([np.cos(around), np.sin(around)], -1)
    X, seen = direction(angle), before_fold(family, each, angle)
    with np.errstate(all="ignore"):
        pixels = FOCAL * family.formula(each.T, X)
    known = np.where(seen[:, None], pixels, 0).reshape(lenses, POINTS, 2)
    edge = np.linalg.norm(known, axis=2).max(1).repeat(POINTS)
    beyond = 1.2 * edge[:, None] * np.stack([np.cos(around), np.sin(around)], -1)
    return Drawn(c, X, pixels, seen, np.where(seen[:, None], pixels, beyond))


class Library(NamedTuple):
    """Functions of points: lenses c (l, k) with X (l, p, 3) to pixels, and pixels (l, p, 2) to directions."""

    project: Callable[[Array, Array], Answer]
    unproject: Callable[[Array, Array], Answer]


def own(name: str, c: Array | Tensor) -> LensModel:
    """Ours, of one lens or of many."""
    t = torch.as_tensor(c)
    return PolynomialFisheye(t) if name == "polynomial-fisheye" else Distortion(name, t)


def ours(name: str) -> Library:
    def project(c: Array, X: Array) -> Answer:
        xy, valid = own(name, c).project(torch.from_numpy(X))
        return FOCAL * xy.numpy(), valid.numpy()

    def unproject(c: Array, x: Array) -> Answer:
        ray, valid = own(name, c).unproject(torch.from_numpy(x / FOCAL))
        return ray.numpy(), valid.numpy()

    return Library(project, unproject)


def one_by_one(f: Callable[[Array, Array], Array]) -> Callable[[Array, Array], Answer]:
    """A function of one lens, flagged where it is not finite or OpenCV's -1000000."""

    def every(c: Array, points: Array) -> Answer:
        found = np.stack([f(lens, p) for lens, p in zip(c, points)])
        return found, np.isfinite(found).all(-1) & (found > -1e5 * FOCAL).all(-1) & (found[..., 0] != -1e6)

    return every


def homogeneous(xy: Array) -> Array:
    return np.concatenate([xy, np.ones_like(xy[:, :1])], 1)


def opencv(name: str) -> Library | None:
    zero, eye = np.zeros(3), np.eye(3)
    maps: dict[str, tuple[Callable[[Array, Array], Array], Callable[[Array, Array], Array]]] = {
        "brown-conrady": (
            lambda c, X: cv2.projectPoints(X[:, None], zero, zero, K, c)[0],
            lambda c, x: cv2.undistortPoints(x[:, None], K, c),
        ),
        "kannala-brandt": (
            lambda c, X: cv2.fisheye.projectPoints(X[:, None], zero, zero, K, c)[0],
            lambda c, x: cv2.fisheye.undistortPoints(x[:, None], K, c),
        ),
        "unified": (
            lambda c, X: cv2.omnidir.projectPoints(X[:, None], zero, zero, K, c[0], c[1:])[0],
            lambda c, x: cv2.omnidir.undistortPoints(x[:, None], K, c[1:], c[:1], eye),
        ),
    }
    if name not in maps:
        return None
    there, back = maps[name]
    return Library(
        one_by_one(lambda c, X: there(c, X).reshape(-1, 2)),
        one_by_one(lambda c, x: homogeneous(back(c, x).reshape(-1, 2))),
    )


def kornia(name: str) -> Library | None:
    if name not in ("brown-conrady", "kannala-brandt"):
        return None

    def model(c: Array, points: int) -> Any:
        wide = np.repeat(c, points, 0)
        intrinsic = torch.from_numpy(K).expand(len(wide), 3, 3)
        lens = Distortion(name, torch.from_numpy(wide))
        return to_kornia_model(intrinsic, (1000, 1000), lens)

    from kornia.geometry.vector import Vector2, Vector3

    def project(c: Array, X: Array) -> Answer:
        found = model(c, X.shape[1]).project(Vector3(torch.from_numpy(X.reshape(-1, 3)))).data.numpy()
        return found.reshape(*X.shape[:2], 2), np.isfinite(found).all(-1).reshape(X.shape[:2])

    def unproject(c: Array, x: Array) -> Answer:
        flat = torch.from_numpy(x.reshape(-1, 2))
        found = model(c, x.shape[1]).unproject(Vector2(flat), torch.ones(len(flat)).double()).data.numpy()
        return found.reshape(*x.shape[:2], 3), np.isfinite(found).all(-1).reshape(x.shape[:2])

    return Library(project, unproject)


COLMAP = {
    "brown-conrady": "FULL_OPENCV",
    "kannala-brandt": "OPENCV_FISHEYE",
    "thin-prism-fisheye": "THIN_PRISM_FISHEYE",
    "fov": "FOV",
    "extended-unified": "EUCM",
}


def colmap(name: str) -> Library | None:
    if pycolmap is None or name not in COLMAP:
        return None

    def camera(c: Array) -> Any:
        params = [FOCAL, FOCAL, 0.0, 0.0, *c]
        return pycolmap.Camera(model=COLMAP[name], width=1000, height=1000, params=params)

    def back(c: Array, x: Array) -> Array:
        found = np.asarray(camera(c).cam_from_img(x))
        return homogeneous(found) if found.shape[1] == 2 else found

    return Library(one_by_one(lambda c, X: np.asarray(camera(c).img_from_cam(X))), one_by_one(back))


LIBRARIES = {"arraygeom": ours, "OpenCV": opencv, "kornia": kornia, "pycolmap": colmap}


def angles(X: Array) -> Array:
    """The inverse of `direction`."""
    rho = np.hypot(X[:, 0], X[:, 1])
    return X[:, :2] * (np.arctan2(rho, X[:, 2]) / np.maximum(rho, 1e-300))[:, None]


def counted(name: str, library: Library, lenses: Drawn) -> list[str]:
    """Wrong and missed of project and unproject; median and 99th percentile of the error elsewhere, px."""
    family, each, shape = FAMILIES[name], np.repeat(lenses.c, POINTS, 0), (len(lenses.c), POINTS)
    with np.errstate(all="ignore"):
        pixels, valid = library.project(lenses.c, lenses.X.reshape(*shape, 3))
        pixels, valid = pixels.reshape(-1, 2), valid.reshape(-1)
        near = np.linalg.norm(pixels - lenses.pixels, axis=1)
        right = lenses.seen & (near <= OFF)
        rays, found = library.unproject(lenses.c, lenses.asked.reshape(*shape, 2))
        rays, found = rays.reshape(-1, 3), found.reshape(-1)
        rays = np.where(found[:, None], rays, [0, 0, 1.0])
        off = np.linalg.norm(FOCAL * family.formula(each.T, rays) - lenses.asked, axis=1)
        back = found & (off <= OFF) & before_fold(family, each, angles(rays))
    counts = (valid & ~right, lenses.seen & ~valid, found & ~back, lenses.seen & ~found)
    largest = max(near[valid & right].max(initial=0), off[back].max(initial=0))
    return [*(f"{int(wrong.sum()):,}" for wrong in counts), f"{largest:.0e}"]


def milliseconds(library: Library, lenses: Drawn) -> list[str]:
    """Return the milliseconds of 100,000 points through the first lens."""
    seen = lenses.X[lenses.seen]
    X = np.resize(seen, (1, 100_000, 3))
    x = np.resize(lenses.asked[:POINTS][lenses.seen[:POINTS]], (1, 100_000, 2))
    c = lenses.c[:1]
    found = timed(lambda: library.project(c, X), lambda: library.unproject(c, x))
    return [f"{1e3 * median(seconds):.0f}" for seconds in found]


def derivatives(name: str, library: str) -> list[str]:
    """Return True if second derivatives are right (by differences of first ones), and vmap over points and
    lenses."""
    if library not in ("arraygeom", "kornia"):
        return ["none", "none"]
    rng = np.random.default_rng(1)
    c = torch.tensor(FAMILIES[name].draw(rng), dtype=torch.float64) * 0.3
    x = torch.tensor([0.11, -0.07], dtype=torch.float64)

    def there_and_back(x: Tensor, c: Tensor) -> Tensor:
        if library == "arraygeom":
            lens = own(name, c)
            ray = lens.unproject(x)[0]
            return (
                ray[..., :2] / ray[..., 2:] + lens.project(torch.nn.functional.pad(x, (0, 1), value=1.0))[0]
            )
        return _kornia_maps(name, x, c)

    answers = []
    try:
        ok = torch.autograd.gradgradcheck(
            there_and_back, (x.clone().requires_grad_(), c.clone().requires_grad_())
        )
        answers.append("right" if ok else "wrong")
    except Exception:
        answers.append("wrong")
    try:
        xs, cs = x * torch.rand(6, 1).double(), c * torch.rand(6, 1).double()
        found = torch.func.vmap(there_and_back)(xs, cs)
        loop = torch.stack([there_and_back(a, b) for a, b in zip(xs, cs)])
        answers.append("right" if torch.allclose(found, loop, atol=1e-9) else "wrong")
    except Exception:
        answers.append("refused")
    return answers


def _kornia_maps(name: str, x: Tensor, c: Tensor) -> Tensor:
    from kornia.geometry.vector import Vector2
    from kornia.sensors.camera.distortion_model import BrownConradyTransform, KannalaBrandtK3Transform

    maps = BrownConradyTransform() if name == "brown-conrady" else KannalaBrandtK3Transform()
    params = torch.cat([x.new_tensor([1.0, 1, 0, 0]), c])
    return maps.undistort(params, Vector2(x)).data + maps.distort(params, Vector2(x)).data


HEAD = (
    *("lens", "library", "project, wrong", "missed", "unproject, wrong", "missed", "largest other error, px"),
    *("second derivative", "vmap", "project, ms", "unproject, ms"),
)


def rows(lenses: int) -> list[list[str]]:
    """One row a model and library."""
    made = []
    for name in FAMILIES:
        points = drawn(name, lenses)
        for library, of in LIBRARIES.items():
            chosen = of(name)
            if chosen is not None:
                row = [name, library, *counted(name, chosen, points), *derivatives(name, library)]
                made.append([*row, *milliseconds(chosen, points)])
                print(" | ".join(made[-1]), flush=True)
    return made


def main(lenses: int = 1000, write: bool = False) -> None:
    """Print the table, and put it into docs/reports/lenses.md if asked."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    made = markdown_table(HEAD, rows(lenses), align="l")
    if write:
        write_block(REPORTS / "lenses.md", "lenses", made)


if __name__ == "__main__":
    script(main)
