"""Whether a camera's model is adequate and its images enough: uncertainty of projection, halves of the frames compared.

A camera's pose and its lens can stand for one another: what is compared are the pixels of points at a distance, after
the small motion of the camera that fits them best (as in mrcal's projection uncertainty and difference).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from arraygeom import Camera, Pose, rotation_from_vector

from .board import Board
from .bundle import BundleResult, readjusted
from .camera_parameters import camera_jacobian, parameter_names
from .validation import without_blocks

GRID = 15, 20
"""Rows and columns of the pixels at which projections are compared."""
FEWEST_TO_HALVE = 8
TILT = 30.0
"""Degrees by which a proposed board is tilted."""
FILLS = 0.35, 0.7
"""Widths of proposed boards, as shares of the image's."""
NAMES = {(-1, -1): "upper left", (0, -1): "top", (1, -1): "upper right", (-1, 0): "left", (0, 0): "middle"}
NAMES |= {(1, 0): "right", (-1, 1): "lower left", (0, 1): "bottom", (1, 1): "lower right"}
TILTS = {(0, 1): "right edge nearer", (0, -1): "left edge nearer", (1, 0): "upper edge nearer"}
TILTS |= {(-1, 0): "lower edge nearer"}


class Intrinsics(NamedTuple):
    """A camera in its own frame, the covariance of its free intrinsics, which they are, and its noise in pixels."""

    camera: Camera
    covariance: Float[np.ndarray, "f f"]
    free: Float[np.ndarray, " p"]
    sigma: float


def intrinsics_of(fit: BundleResult, name: str) -> Intrinsics:
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
    x, change = _changes(known, depth)
    return x, np.sqrt(np.linalg.eigvalsh(change @ known.covariance @ change.swapaxes(-1, -2))[:, -1])


def _changes(known: Intrinsics, depth: float) -> tuple[np.ndarray, np.ndarray]:
    """Pixels, and how they move with the free intrinsics, after the best motion of the camera: (n, 2), (n, 2, f)."""
    x, X = grid_points(known.camera, depth)
    J = camera_jacobian(known.camera, X)
    moved, pose = J[..., known.free].reshape(2 * len(x), -1), J[..., :6].reshape(2 * len(x), 6)
    left = moved - pose @ np.linalg.lstsq(pose, moved, rcond=None)[0]
    return x, left.reshape(len(x), 2, -1)


def half_difference(fit: BundleResult, depth: float) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """By camera: pixels (n, 2), and how far (n, 2) projections differ between fits to every other frame.

    Empty if there are too few frames.
    """
    count = len(fit.problem.structure)
    if count < FEWEST_TO_HALVE:
        return {}
    even = np.arange(count) % 2 == 0
    try:
        halves = [readjusted(without_blocks(fit.problem, kept), fit.free(), fit.sigma) for kept in (even, ~even)]
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


class NextView(NamedTuple):
    """A view of the board that would help, in words, and the median uncertainty (pixels) with and without it."""

    text: str
    before: float
    after: float


def next_views(known: Intrinsics, board: Board, depth: float, *, count: int = 2) -> list[NextView]:
    """The views that lower a camera's uncertainty of projection most, one after the other."""
    _, change = _changes(known, depth)
    gains = {text: _gain(known, X) for text, X in proposed_views(known.camera, board.members[0]).items()}
    candidates = {text: gain for text, gain in gains.items() if gain is not None}
    information, found = np.linalg.inv(known.covariance), []
    before = _median(change, known.covariance)
    for _ in range(count):
        after = {text: _median(change, np.linalg.inv(information + gain)) for text, gain in candidates.items()}
        best = min(after, key=lambda text: after[text])
        found.append(NextView(best, before, after[best]))
        before, information = after[best], information + candidates[best]
    return found


def _median(change: np.ndarray, covariance: np.ndarray) -> float:
    return float(np.median(np.sqrt(np.einsum("nif,fg,nig->n", change, covariance, change))))


def proposed_views(camera: Camera, board: Board) -> Mapping[str, Float[np.ndarray, "n 3"]]:
    """Views of a board in words, and its points in the camera's frame."""
    found, (h, w) = {}, camera.hw
    middle = torch.from_numpy((board.points.max(0) + board.points.min(0)) / 2)
    for fill in FILLS:
        depth = float(camera.K[0, 0]) * max(board.extent) / (fill * w)
        for (i, j), position in NAMES.items():
            share = 0.5 + np.array([i, j]) * (0.5 - 0.4 * fill)
            pixel = torch.from_numpy(share * (w - 1, h - 1))
            centre = camera.unproject(pixel, torch.tensor(depth, dtype=torch.float64))
            for (a, b), tilt in TILTS.items():
                R = rotation_from_vector(torch.deg2rad(TILT * torch.tensor([a, b, 0.0], dtype=torch.float64)))
                X = Pose(R, centre - R @ middle).apply(torch.from_numpy(board.points)).numpy()
                found[f"the board at the {position}, {depth:.2g} m away, tilted, {tilt}"] = X
    return found


def _gain(known: Intrinsics, X: np.ndarray) -> np.ndarray | None:
    """The information of a view on the free intrinsics, its pose unknown; None if hardly any of it is visible."""
    seen = known.camera.project_local(torch.from_numpy(X))
    inside = (seen.valid & known.camera.contains(seen.x)).numpy()
    if inside.sum() < 0.6 * len(X) or not inside.any():
        return None
    J = camera_jacobian(known.camera, X[inside]) / known.sigma
    pose, own = J[..., :6].reshape(-1, 6), J[..., known.free].reshape(2 * int(inside.sum()), -1)
    left = own - pose @ np.linalg.lstsq(pose, own, rcond=None)[0]
    return np.asarray(left.T @ left)
