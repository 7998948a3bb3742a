"""The parameters of a camera as the bundle adjustment orders them: names, values, derivatives, priors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from arraygeom import Camera, Pose, Rig
from arraygeom.pose import cross_matrix, rotation_vector


def parameter_names(camera: Camera) -> list[str]:
    """The parameters of a camera as `Rig.parameters` orders them: "rotation.0", ..., "distortion.4"."""
    return [f"{key.removeprefix('.')}.{i}" for key, size in parameter_sizes(camera).items() for i in range(size)]


def intrinsic_values(camera: Camera) -> Float[np.ndarray, " p"]:
    """The parameters' values, in the order of `parameter_names`; 0 for those of the pose."""
    lens = () if camera.distortion is None else camera.distortion.coefficients.tolist()
    K = camera.K.detach().numpy()
    return np.array([*(0.0,) * 6, K[0, 0], K[1, 1], K[0, 2], K[1, 2], *lens])


def parameter_sizes(camera: Camera) -> dict[str, int]:
    """The length of each of a camera's parameter vectors, by its name in a rig with one camera called ""."""
    lens = {} if camera.distortion is None else {".distortion": camera.distortion.coefficients.shape[-1]}
    return {".rotation": 3, ".translation": 3, ".focal": 2, ".centre": 2} | lens


def changed(camera: Camera, change: torch.Tensor) -> Camera:
    """The camera after a change of all its parameters, in the order of `parameter_names`."""
    sizes = parameter_sizes(camera)
    changed = Rig({"": camera}).perturbed(dict(zip(sizes, change.split(list(sizes.values())))))[""]
    assert isinstance(changed, Camera)
    return changed


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
        return derivatives.T @ self.information @ derivatives, derivatives.T @ self.information @ self.offset(camera)

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


def centre_derivatives(camera: Camera) -> Float[np.ndarray, "3 6"]:
    """Derivatives of the optical centre in the world by the camera's rotation vector and translation."""
    return np.asarray(-camera.R.numpy().T @ np.concatenate([cross_matrix(camera.t).numpy(), np.eye(3)], 1))
