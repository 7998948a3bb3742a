"""Covariance of a rig's parameters, in a file beside the rig's, and its propagation to pixels and baselines."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from arraygeom import Camera, Rig
from arraygeom.atomic import write_text
from arraygeom.io.source import float64_of
from arraygeom.safe_yaml import load_json

from .camera_parameters import camera_jacobian, centre_derivatives, parameter_names

FORMAT = "arraygeom-covariance 1"


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
