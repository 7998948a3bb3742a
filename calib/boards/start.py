"""Calibration from a rig that is known roughly: few images suffice, as what they leave open keeps near that rig."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch

from arraygeom import Camera, Distortion, Pose, Rig

from .board import Board
from .bundle import BundleResult
from .camera_parameters import CameraPrior, centre_derivatives, intrinsic_values
from .intrinsics import COEFFICIENTS, BoardViews, Lens, board_pose
from .observability import typical_prior
from .poses import CalibratedViews, InitialRig, average_pose, consistent_boards, nearest_pose, symmetry_poses

FAR_FROM_START = 4.0
"""Standard deviations from the start beyond which a camera is named."""


@dataclass(frozen=True)
class StartDeviations:
    """How far a rig may be from its start: standard deviations of each camera's parameters.

    position: of the optical centre along each axis, metres. rotation: about each axis, degrees. focal: a share of the
    focal length. centre: of the principal point, a share of the width.
    """

    position: float = 5e-4
    rotation: float = 3.0
    focal: float = 0.02
    centre: float = 0.01

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 < value < float("inf"):
                raise ValueError(f"the start's deviation {name}={value:g} is not a positive number")

    @classmethod
    def of(cls, given: Mapping[str, float]) -> StartDeviations:
        """By name. Raises ValueError for another name."""
        if unknown := given.keys() - vars(cls()).keys():
            raise ValueError(f"a start has no deviation '{min(unknown)}': it has {', '.join(vars(cls()))}")
        return cls(**given)


def start_prior(camera: Camera, deviations: StartDeviations) -> CameraPrior:
    """The prior of a camera by its start, and of what that does not state by ordinary cameras."""
    usual = typical_prior(camera)
    mean = intrinsic_values(camera)
    information = usual.information.copy()
    information[:3, :3] = np.eye(3) / np.radians(deviations.rotation) ** 2
    information[3:6, 3:6] = np.eye(3) / deviations.position**2
    focal = camera.K.diagonal()[:2].numpy()
    information[6:8, 6:8] += np.full((2, 2), 0.25) / (deviations.focal * float(focal.mean())) ** 2
    information[8:10, 8:10] = np.eye(2) / (deviations.centre * camera.hw[1]) ** 2
    return CameraPrior(mean, information, camera.cam_from_world)


def start_cameras(start: Rig, views: Mapping[str, BoardViews], lens: Mapping[str, Lens]) -> dict[str, Camera]:
    """The cameras of a start that have images, with a lens. Raises ValueError if one is missing or differs in size."""
    found = {}
    for name, v in views.items():
        camera = start.cameras.get(name)
        if not isinstance(camera, Camera):
            raise ValueError(
                f"{name}: the start has no camera of this name with K and pose; it has {list(start.names)}"
            )
        if camera.hw != v.hw:
            (h, w), (rows, columns) = camera.hw, v.hw
            raise ValueError(f"{name}: its images are {columns}x{rows} and the start states {w}x{h}")
        if camera.distortion is None and lens[name] != "none":
            model = "brown-conrady" if lens[name] in COEFFICIENTS else "kannala-brandt"
            coefficients = torch.zeros(COEFFICIENTS.get(lens[name], 4), dtype=torch.float64)
            camera = camera.replace(distortion=Distortion(model, coefficients))
        found[name] = camera.to(torch.float64)
    return found


def rig_near_start(cameras: Mapping[str, Camera], views: Mapping[str, BoardViews], board: Board) -> InitialRig:
    """Cameras at the start's positions, rotated so that they agree on the boards, and the boards in the start's world.

    The camera with most images keeps its orientation. Raises ValueError if a camera shares no moment with another.
    """
    for name, v in views.items():
        if len(views) > 1 and not any(v.seen.keys() & other.seen.keys() for n, other in views.items() if n != name):
            raise ValueError(f"{name}: never sees the board in the same frame as another camera: check the numbers")
    seen = [
        CalibratedViews(name, c, views[name], {key: board_pose(c, d, board) for key, d in views[name].seen.items()})
        for name, c in cameras.items()
    ]
    anchor = max(seen, key=lambda v: len(v.poses))
    poses = {v.name: _aligned(anchor, v, board) for v in seen}
    return consistent_boards(seen, poses, board)


def _aligned(a: CalibratedViews, b: CalibratedViews, board: Board) -> Pose:
    """`cam_from_world` of camera b with the orientation by the frames that it shares with a."""
    shared = [key for key in b.poses if key in a.poses]
    if not shared or a is b:
        return b.camera.cam_from_world
    nominal, symmetries = a.camera.cam_from_world @ b.camera.cam_from_world.inverse(), symmetry_poses(board)
    a_from_b = average_pose([nearest_pose(nominal, a.poses[key], b.poses[key], symmetries) for key in shared])
    return Pose.from_centre(a_from_b.R.T @ a.camera.R, b.camera.centre)


def start_notes(fit: BundleResult, deviations: StartDeviations) -> list[str]:
    """What the images add to the start, by kind of parameter, and which cameras lie far from it."""
    return [_gains(fit, deviations), *_far(fit)]


def _gains(fit: BundleResult, deviations: StartDeviations) -> str:
    assert fit.covariance is not None
    after = dict(zip(fit.names, np.sqrt(fit.covariance.diagonal()).tolist()))
    focal = np.mean([float(c.K[0, 0]) for c in fit.problem.cameras.values()])
    width = np.mean([c.hw[1] for c in fit.problem.cameras.values()])
    kinds = {
        "focal": ("focal lengths", deviations.focal * focal),
        "centre": ("principal points", deviations.centre * width),
    }
    texts = []
    for kind, (label, before) in kinds.items():
        found = [d for name, d in after.items() if f".{kind}." in name]
        texts += [f"{label} ±{before:.3g} > ±{np.median(found):.3g} px"] if found else []
    positions = np.median(_position_deviations(fit))
    texts.append(f"positions ±{1e3 * deviations.position:.3g} > ±{1e3 * positions:.3g} mm")
    return f"held to the start; standard deviations stated > with the images: {', '.join(texts)}"


def _position_deviations(fit: BundleResult) -> list[float]:
    """Of each camera's optical centre, root mean square of the axes, metres."""
    assert fit.covariance is not None
    found = []
    for name, camera in fit.problem.cameras.items():
        mine = [fit.names.index(f"{name}.{kind}.{i}") for kind in ("rotation", "translation") for i in range(3)]
        derivatives = centre_derivatives(camera)
        covariance = derivatives @ fit.covariance[np.ix_(mine, mine)] @ derivatives.T
        found.append(float(np.sqrt(np.trace(covariance) / 3)))
    return found


def _far(fit: BundleResult) -> list[str]:
    notes = []
    for name, camera in fit.problem.cameras.items():
        prior = fit.problem.priors[name]
        ratio = np.abs(prior.offset(camera)) / np.sqrt(np.linalg.inv(prior.information).diagonal())
        parts = np.split(ratio[:10], [3, 6, 8])
        kinds = zip(("orientation", "position", "focal length", "principal point"), (part.max() for part in parts))
        if far := [f"{kind} ({worst:.0f} deviations)" for kind, worst in kinds if worst > FAR_FROM_START]:
            listed = ", ".join(far)
            notes.append(f"{name}: far from the start: {listed}: is the start right, or its deviations too small?")
    return notes
