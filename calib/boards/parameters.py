"""The parameters of a camera as the bundle adjustment orders them: names, values, derivatives, usual sizes, priors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from arraygeom import Camera, Pose, Rig
from arraygeom.lenses.model import LensModel
from arraygeom.pose import cross_matrix, rotation_vector

TYPICAL_COEFFICIENTS = {
    "brown-conrady": (1.0, 1.0, 0.02, 0.02, 1.0, 1.0, 1.0, 1.0, 0.02, 0.02, 0.02, 0.02, 0.1, 0.1),
    "kannala-brandt": (0.3, 0.3, 0.3, 0.3),
    "thin-prism-fisheye": (0.3, 0.3, 0.02, 0.02, 0.3, 0.3, 0.02, 0.02),
    "double-sphere": (0.3, 0.3),
    "extended-unified": (0.3, 0.5),
    "unified": (1.0, 1.0, 1.0, 0.02, 0.02),
    "fov": (0.5,),
    "scaramuzza": (0.5, 0.5, 0.5),
}
"""Upper bounds of the usual sizes of distortion coefficients."""
LENS_TERMS = {
    "brown-conrady": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tx", "ty"),
    "kannala-brandt": ("k1", "k2", "k3", "k4"),
    "thin-prism-fisheye": ("k1", "k2", "p1", "p2", "k3", "k4", "sx", "sy"),
    "double-sphere": ("xi", "alpha"),
    "extended-unified": ("alpha", "beta"),
    "unified": ("xi", "k1", "k2", "p1", "p2"),
    "fov": ("omega",),
    "scaramuzza": ("b2", "b3", "b4"),
}
"""Names of the coefficients, in order."""


def typical_coefficients(lens: LensModel) -> tuple[float, ...]:
    """Usual sizes of a lens's numbers; 1 for those of a camera model."""
    count = lens.coefficients.shape[-1]
    return TYPICAL_COEFFICIENTS.get(lens.model, (1.0,) * count)[:count]


def term(lens: LensModel, index: int) -> str:
    """The name of a lens's number."""
    return LENS_TERMS[lens.model][index] if lens.model in LENS_TERMS else f"number {index + 1}"


TYPICAL_FOCAL_ERROR, TYPICAL_CENTRE_ERROR = 0.1, 0.1
"""Likewise of the error of a guessed focal length, as a share of it, and of the principal point, of the width."""
CENTRE_DEVIATION, ASPECT_DEVIATION = 0.03, 0.01
"""Standard deviations of the principal point about the centre (share of the width), and of the aspect ratio."""


def parameter_sizes(camera: Camera) -> dict[str, int]:
    """The length of each of a camera's parameter vectors, by its name in a rig with one camera called ""."""
    lens = {} if camera.distortion is None else {".distortion": camera.distortion.coefficients.shape[-1]}
    return {".rotation": 3, ".translation": 3, ".focal": 2, ".centre": 2} | lens


def parameter_names(camera: Camera) -> list[str]:
    """The parameters of a camera as `Rig.parameters` orders them: "rotation.0", ..., "distortion.4"."""
    return [f"{key.removeprefix('.')}.{i}" for key, size in parameter_sizes(camera).items() for i in range(size)]


def intrinsic_values(camera: Camera) -> Float[np.ndarray, " p"]:
    """The parameters' values, in the order of `parameter_names`; 0 for those of the pose."""
    lens = () if camera.distortion is None else camera.distortion.coefficients.tolist()
    K = camera.K.detach().numpy()
    return np.array([*(0.0,) * 6, K[0, 0], K[1, 1], K[0, 2], K[1, 2], *lens])


def changed(camera: Camera, change: torch.Tensor) -> Camera:
    """The camera after a change of all its parameters, in the order of `parameter_names`."""
    sizes = parameter_sizes(camera)
    moved = Rig({"": camera}).perturbed(dict(zip(sizes, change.split(list(sizes.values())))))[""]
    assert isinstance(moved, Camera)
    return moved


def camera_jacobian(camera: Camera, X: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2 p"]:
    """Derivatives of the pixels of world points with respect to the camera, in the order of `parameter_names`.

    Two reverse passes with a copy of the intrinsics per point; those of the pose follow by the chain rule.
    """
    local = camera.cam_from_world.apply(torch.from_numpy(X)).detach().requires_grad_()
    sizes = {key: size for key, size in parameter_sizes(camera).items() if key not in (".rotation", ".translation")}
    change = torch.zeros(len(X), sum(sizes.values()), dtype=local.dtype, requires_grad=True)
    copies = Rig({"": camera}).perturbed(dict(zip(sizes, change.split(list(sizes.values()), -1))))[""]
    assert isinstance(copies, Camera)
    x = copies.project_local(local[:, None]).x[:, 0]
    by_point, by_change = zip(*(torch.autograd.grad(v.sum(), (local, change), retain_graph=True) for v in x.unbind(-1)))
    along = torch.stack(by_point, 1)
    rotational = torch.linalg.cross((local.detach() - camera.t)[:, None].expand_as(along), along)
    return torch.cat([rotational, along, torch.stack(by_change, 1)], -1).numpy()


def centre_derivatives(camera: Camera) -> Float[np.ndarray, "3 6"]:
    """Derivatives of the optical centre in the world by the camera's rotation vector and translation."""
    return np.asarray(-camera.R.numpy().T @ np.concatenate([cross_matrix(camera.t).numpy(), np.eye(3)], 1))


def with_default(camera: Camera, entry: str) -> Camera:
    """The camera with one parameter at its default: principal point centred, coefficient 0."""
    kind, index = entry.split(".")
    if kind == "centre":
        K = camera.K.clone()
        K[int(index), 2] = (camera.hw[1 - int(index)] - 1) / 2
        return camera.replace(K=K)
    assert camera.distortion is not None
    coefficients = camera.distortion.coefficients.clone()
    coefficients[int(index)] = 0.0
    return camera.replace(distortion=camera.distortion.with_coefficients(coefficients))


def described_default(camera: Camera, entry: str) -> str:
    """What `with_default` does, in words."""
    kind, index = entry.split(".")
    if kind == "centre":
        return f"the principal point's {'xy'[int(index)]} is fixed at the image's centre"
    assert camera.distortion is not None
    return f"the lens's {term(camera.distortion, int(index))} is fixed at 0"


# Priors -------------------------------------------------------------------------------------------------------


class CameraPrior(NamedTuple):
    """A normal prior of a camera's parameters: mean and inverse covariance, in the order of `parameter_names`.

    pose: the mean of its pose, whose entries are a rotation vector about the camera's axes and the optical centre in
    the world (not the translation), metres. Without it, the entries of the pose are zero.
    """

    mean: Float[np.ndarray, " p"]
    information: Float[np.ndarray, "p p"]
    pose: Pose | None = None

    def equations(self, camera: Camera) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, " p"]]:
        """The prior's part of the normal equations: inverse covariance and negative gradient by each parameter."""
        derivatives = np.eye(len(self.mean))
        if self.pose is not None:
            derivatives[3:6, :6] = centre_derivatives(camera)
        weighted = derivatives.T @ self.information
        return weighted @ derivatives, weighted @ self.offset(camera)

    def loss(self, camera: Camera) -> float:
        """Half the squared Mahalanobis distance from the mean."""
        offset = self.offset(camera)
        return float(offset @ self.information @ offset) / 2

    def offset(self, camera: Camera) -> Float[np.ndarray, " p"]:
        """The mean minus the camera's values, in the prior's own terms."""
        offset = self.mean - intrinsic_values(camera)
        if self.pose is not None:
            offset[:3] = rotation_vector(self.pose.R @ camera.R.T).numpy()
            offset[3:6] = (self.pose.inverse().t - camera.centre).numpy()
        return offset


def typical_sizes(camera: Camera) -> Float[np.ndarray, " p"]:
    """Typical errors of a camera's parameters before any measurement, in the order of `parameter_names`."""
    focal = TYPICAL_FOCAL_ERROR * _mean_focal(camera)
    lens = camera.distortion
    coefficients = () if lens is None else typical_coefficients(lens)
    return np.array([3.0] * 3 + [100.0] * 3 + [focal] * 2 + [TYPICAL_CENTRE_ERROR * camera.hw[1]] * 2 + [*coefficients])


def typical_prior(camera: Camera) -> CameraPrior:
    """Prior of ordinary cameras: square pixels, a principal point near the centre, moderate distortion.

    Negligible where boards were observed at many positions and tilts; elsewhere it keeps a camera plausible.
    """
    h, w = camera.hw
    deviation = typical_sizes(camera)
    deviation[8:10] = CENTRE_DEVIATION * w
    mean = np.zeros(len(deviation))
    mean[8:10] = (w - 1) / 2, (h - 1) / 2
    information = np.diag(deviation**-2.0)
    information[:8, :8] = 0.0
    information[6:8, 6:8] = np.array([[1, -1], [-1, 1]]) / (ASPECT_DEVIATION * _mean_focal(camera)) ** 2
    return CameraPrior(mean, information)


def _mean_focal(camera: Camera) -> float:
    return camera.K[:2, :2].det().abs().sqrt().item()


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
    information = typical_prior(camera).information.copy()
    information[:3, :3] = np.eye(3) / np.radians(deviations.rotation) ** 2
    information[3:6, 3:6] = np.eye(3) / deviations.position**2
    focal = camera.K.diagonal()[:2].numpy()
    information[6:8, 6:8] += np.full((2, 2), 0.25) / (deviations.focal * float(focal.mean())) ** 2
    information[8:10, 8:10] = np.eye(2) / (deviations.centre * camera.hw[1]) ** 2
    return CameraPrior(intrinsic_values(camera), information, camera.cam_from_world)
