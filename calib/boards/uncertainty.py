"""How uncertain a rig is: the covariance of its parameters, in a file beside the rig's, and what follows from it.

A camera's pose and its lens can stand for one another: what is compared are the pixels of points at a distance, after
the small motion of the camera that fits them best (as in mrcal's projection uncertainty and difference).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from arraygeom import Camera, Pose, Rig
from arraygeom.atomic import write_text
from arraygeom.io.source import float64_of
from arraygeom.safe_yaml import load_json

from .bundle import Solved, readjusted
from .parameters import camera_jacobian, centre_derivatives, parameter_names

FORMAT = "arraygeom-covariance 1"
GRID = 15, 20
"""Rows and columns of the pixels at which projections are compared."""
FEWEST_TO_HALVE = 8


@dataclass(frozen=True)
class RigCovariance:
    """The covariance of some parameters of a rig; all others are fixed.

    names: parameters as `Rig.parameters` names them with the index of a component, "left.rotation.0", "left.focal.1":
    rotation vectors in radians about the camera's axes, metres, pixels, distortion coefficients.
    """

    names: tuple[str, ...]
    matrix: Float[np.ndarray, "c c"]

    def deviation(self, name: str) -> float:
        """The standard deviation of one parameter; 0 for one that is fixed."""
        if name not in self.names:
            return 0.0
        i = self.names.index(name)
        return float(np.sqrt(self.matrix[i, i]))

    def of(self, name: str, camera: Camera) -> Float[np.ndarray, "p c"]:
        """The selection matrix of a camera's parameters, in the order of `parameter_names`, among these."""
        entries = np.array([f"{name}.{entry}" for entry in parameter_names(camera)])
        return (entries[:, None] == np.array(self.names, dtype=str)).astype(np.float64)

    def save(self, path: str | Path) -> None:
        """Write it as JSON, atomically."""
        document = {"format": FORMAT, "names": list(self.names), "covariance": self.matrix.tolist()}
        write_text(path, json.dumps(document))

    @classmethod
    def load(cls, path: str | Path) -> RigCovariance:
        """Read what `save` wrote. Raises FileNotFoundError, or ValueError for another file."""
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such covariance file")
        try:
            document = load_json(path.read_text(encoding="utf-8"))
            names, numbers = tuple(document["names"]), float64_of(document["covariance"])
            if numbers is None:
                raise TypeError
        except (ValueError, KeyError, OverflowError, RecursionError, TypeError):
            raise ValueError(f"{path}: is not a covariance file of this program") from None
        matrix = numbers.numpy()
        if not all(isinstance(name, str) for name in names) or not np.isfinite(matrix).all():
            raise ValueError(f"{path}: holds names that are no text, or NaN or infinity: calibrate again")
        if matrix.shape != (len(names), len(names)):
            raise ValueError(f"{path}: has {len(names)} names and a matrix of {matrix.shape}; is the file complete?")
        return cls(names, matrix)


def rig_covariance(fit: Solved) -> RigCovariance | None:
    """The covariance of a solution's free parameters, if they are observable."""
    matrix = fit.covariance
    return None if matrix is None else RigCovariance(fit.names, matrix)


def beta_covariance(
    rig: Rig, covariance: RigCovariance, alpha: str, beta: str, x: Float[np.ndarray, "n 2"], depth: float
) -> Float[np.ndarray, "n 2 2"]:
    """The covariance, in pixels^2 of beta, of the predicted positions of alpha's pixels at a depth (metres).

    To first order: the point moves in alpha's plane of that depth so that alpha's pixel is unchanged.
    NaN where alpha's lens has no ray or beta does not see the point.
    """
    a, b = rig.pair(alpha, beta).cameras
    X = a.unproject(torch.from_numpy(x), torch.full((len(x),), depth, dtype=torch.float64))
    usable = (X.isfinite().all(-1) & b.project(X.nan_to_num(1.0)).valid).numpy()
    found = np.full((len(x), 2, 2), np.nan)
    if usable.any():
        J_a, J_b = (camera_jacobian(camera, X.numpy()[usable]) for camera in (a, b))
        across = J_b[..., 3:6] @ (b.R @ a.R.T).numpy()[:, :2]
        change = J_b @ covariance.of(beta, b) - across @ np.linalg.solve(J_a[..., 3:5], J_a @ covariance.of(alpha, a))
        found[usable] = change @ covariance.matrix @ change.swapaxes(-1, -2)
    return found


def baseline_deviation(rig: Mapping[str, Camera], a: str, b: str, covariance: RigCovariance) -> float:
    """The standard deviation of the distance between two cameras, metres."""
    baseline = (rig[b].centre - rig[a].centre).numpy()
    direction = baseline / max(float(np.linalg.norm(baseline)), 1e-12)
    of_a, of_b = (direction @ centre_derivatives(rig[n]) @ covariance.of(n, rig[n])[:6] for n in (a, b))
    return float(np.sqrt((of_b - of_a) @ covariance.matrix @ (of_b - of_a)))


# One camera ---------------------------------------------------------------------------------------------------


class Intrinsics(NamedTuple):
    """A camera in its own frame, the covariance of its free intrinsics, which they are, and its noise in pixels."""

    camera: Camera
    covariance: Float[np.ndarray, "f f"]
    free: Float[np.ndarray, " p"]
    sigma: float


def intrinsics_of(fit: Solved, name: str) -> Intrinsics:
    """One camera of a fit that has a covariance."""
    assert fit.covariance is not None
    camera = fit.problem.cameras[name].replace(cam_from_world=Pose.identity())
    entries = [f"{name}.{entry}" for entry in parameter_names(camera)]
    free = np.array([i >= 6 and entry in fit.names for i, entry in enumerate(entries)])
    index = [fit.names.index(entry) for entry, is_free in zip(entries, free) if is_free]
    return Intrinsics(camera, fit.covariance[np.ix_(index, index)], free, fit.sigma[name])


def grid_points(camera: Camera, depth: float) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 3"]]:
    """Pixels over the image, and their points at a depth in the camera's frame, where the lens has a ray."""
    rows, columns = GRID
    h, w = camera.hw
    x = np.stack(np.meshgrid(np.linspace(0, w - 1, columns), np.linspace(0, h - 1, rows)), -1).reshape(-1, 2)
    X = camera.unproject(torch.from_numpy(x), torch.full((len(x),), depth, dtype=torch.float64)).numpy()
    usable = np.isfinite(X).all(1)
    return x[usable], X[usable]


def uncertainty(known: Intrinsics, depth: float) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
    """Standard deviations (pixels, worst direction) of the projection of points at a depth (metres), over the image."""
    x, change = moved_pixels(known, depth)
    return x, np.sqrt(np.linalg.eigvalsh(change @ known.covariance @ change.swapaxes(-1, -2))[:, -1])


def moved_pixels(known: Intrinsics, depth: float) -> tuple[np.ndarray, np.ndarray]:
    """Pixels, and how they move with the free intrinsics, after the best motion of the camera: (n, 2), (n, 2, f)."""
    x, X = grid_points(known.camera, depth)
    J = camera_jacobian(known.camera, X)
    moved, pose = J[..., known.free].reshape(2 * len(x), -1), J[..., :6].reshape(2 * len(x), 6)
    left = moved - pose @ np.linalg.lstsq(pose, moved, rcond=None)[0]
    return x, left.reshape(len(x), 2, -1)


def half_difference(fit: Solved, depth: float) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """By camera: pixels (n, 2), and how far (n, 2) projections differ between fits to every other frame.

    Empty if there are too few frames.
    """
    count = len(fit.problem.frames)
    if count < FEWEST_TO_HALVE:
        return {}
    even = np.arange(count) % 2 == 0
    try:
        halves = [readjusted(fit.problem.of_boards(kept)) for kept in (even, ~even)]
    except np.linalg.LinAlgError:
        return {}
    found = {}
    for name in fit.problem.cameras:
        a, b = (half.cameras[name].replace(cam_from_world=Pose.identity()) for half in halves)
        x, X = grid_points(a, depth)
        off = b.project_local(torch.from_numpy(X)).x.numpy() - x
        pose = camera_jacobian(a, X)[..., :6].reshape(2 * len(x), 6)
        off = off.ravel() - pose @ np.linalg.lstsq(pose, off.ravel(), rcond=None)[0]
        found[name] = x, off.reshape(-1, 2)
    return found
