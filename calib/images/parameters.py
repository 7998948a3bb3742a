"""Free parameters of a rig with prior standard deviations, and the rig after they change."""

from __future__ import annotations

import fnmatch
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import Camera, LensView, Link, Rig, intrinsics, rotation_from_vector
from arraygeom.distortion import typical_coefficients
from arraygeom.runtime.text import length_unit

SIGMA = {"rotation": math.radians(0.5), "translation": 0.01, "focal": 0.01, "centre": 5.0, "distortion": 0.02}
"""Default standard deviations: radians, a share of the longest baseline, a share of the focal length, pixels
of the principal point, and a share of `typical_coefficients`."""
LARGEST_CHANGE = 4.0
"""Largest plausible change of a parameter in prior deviations: beyond it the rig is not the prior's."""
UNCERTAIN = ("rotation", "translation", "focal", "centre")
"""Kinds of parameters that are uncertain even where they are not free."""
ALIASES = {"principal_point": "centre", "focal_length": "focal"}
AXES = {"rotation": "xyz", "translation": "xyz", "focal": "xy", "centre": "xy"}
UNITS = {
    "rotation": ("degrees", 180 / math.pi),
    "translation": ("mm", 1e3),
    "focal": ("px", 1.0),
    "centre": ("px", 1.0),
}
FOCAL_CORRELATION = 0.995
"""Correlation of fx and fy: pixels keep their shape, to a tenth of the focal length's deviation."""
LENS_SIGMA = 0.2
"""The share of `typical_coefficients` for uncalibrated lenses, whose unit is half the image's longer side."""
LINK_SIGMA = 0.1
"""Standard deviation of the seven degrees of freedom of an F in coordinates of about -1 to 1: wide."""


@dataclass(frozen=True)
class FreeParameter:
    """One parameter vector of a rig that may change.

    Attributes:
        name: name as in `Rig.parameters`, such as "left.rotation", or "alpha > beta" for an F.
        sigma: prior standard deviation of each component, float64, in the rig's units (radians, metres,
            pixels; a lens model's coefficients; for an F its seven degrees of freedom, without unit).
        unit: unit for display, such as "degrees"; "F" for an F, empty for coefficients.
        factor: factor that converts to that unit.
        correlation: prior correlation between components, as fx and fy change together.
    """

    name: str
    sigma: Float[Tensor, " k"]
    unit: str
    factor: float
    correlation: float = 0.0

    @cached_property
    def root(self) -> Float[Tensor, "k k"]:
        """Lower triangular root of the prior covariance, float64: the change is root z."""
        eye = torch.eye(len(self.sigma), dtype=torch.float64)
        correlation = torch.where(eye > 0, eye, self.correlation)
        return self.sigma[:, None] * torch.linalg.cholesky(correlation)

    def label(self, index: int) -> str:
        """Return the name of one component, such as "left.rotation x"."""
        axes = AXES.get(self.name.rpartition(".")[2])
        return f"{self.name} {axes[index]}" if axes else f"{self.name} {index + 1}"


def free_parameters(
    rig: Rig, names: Sequence[str], *, free: Iterable[str], sigma: Mapping[str, float] | None = None
) -> list[FreeParameter]:
    """List the free parameters of these cameras.

    The first camera keeps its pose, as only relative poses are observable. A link between two of the cameras
    has its F free, unless it is of H alone, and lenses of uncalibrated views are free.

    Args:
        names: names of the cameras, one at least.
        free: kinds ("rotation", "translation", "focal" or "focal_length", "centre" or "principal_point",
            "distortion"), or patterns over "camera.kind"; without calibrated cameras they are not looked at.
        sigma: standard deviations by kind, in the units of `SIGMA`, instead of its values; None for these.

    Returns:
        One parameter vector per camera and kind, then one per link; possibly none.

    Raises:
        ValueError: for a camera that the rig lacks, a pattern that matches no calibrated camera of the rig,
            or a `sigma` of an unknown kind or not positive.
    """
    stated = {ALIASES.get(k, k): v for k, v in (sigma or {}).items()}
    if wrong := [k for k, v in stated.items() if k not in SIGMA or not v > 0]:
        raise ValueError(f"sigma: wanted a positive number for one of {', '.join(SIGMA)}; got '{wrong[0]}'")
    sigma = {**SIGMA, **stated}
    views = [rig[name] for name in names]
    parameters = rig.parameters(free=["*"]) if any(isinstance(v, LensView) for v in views) else {}
    parameters = {n: like for n, like in parameters.items() if n not in ("depth.near", "depth.far")}
    calibrated = [name for name in parameters if isinstance(rig[_camera_of(name)], Camera)]
    wanted = [*_matching(calibrated, free), *(name for name in parameters if name not in calibrated)]
    fixed = {f"{names[0]}.rotation", f"{names[0]}.translation"}
    of_cameras = [
        _free_parameter(rig, name, parameters[name], sigma)
        for name in wanted
        if _camera_of(name) in names and name not in fixed
    ]
    links = [f"{a} > {b}" for (a, b), link in rig.links.items() if {a, b} <= {*names} and link.F.any()]
    return of_cameras + [
        FreeParameter(name, torch.full((7,), LINK_SIGMA).double(), "F", 1.0) for name in links
    ]


def considered_parameters(
    rig: Rig, names: Sequence[str], free: Sequence[FreeParameter], *, sigma: Mapping[str, float] | None
) -> list[FreeParameter]:
    """List these cameras' poses, focal lengths and principal points that are uncertain but not free.

    Their uncertainty counts, but they are not changed.

    Args:
        names: names of the cameras, one at least; the first one's pose is certain.
        free: free parameters.
        sigma: standard deviations by kind, in the units of `SIGMA`, instead of its values; None for these.

    Returns:
        One parameter vector per calibrated camera and kind.

    Raises:
        ValueError: for a camera that the rig lacks, or a `sigma` of an unknown kind or not positive.
    """
    fixed = {f.name for f in free}
    parameters = free_parameters(rig, names, free=UNCERTAIN, sigma=sigma)
    return [
        f for f in parameters if f.name not in fixed and f.unit != "F" and not f.name.endswith(".distortion")
    ]


def apply_change(rig: Rig, parameters: Sequence[FreeParameter], z: Float[Tensor, " n"]) -> Rig:
    """Change a rig's parameters.

    Args:
        z: changes of all components of `parameters`, one vector after the other: standard normal
            coordinates of the prior, each vector's change being its `root` times them.

    Returns:
        The changed rig, differentiable in z.

    Raises:
        RuntimeError: by torch, for a z of another length.
        ValueError: for a camera that the rig lacks.
    """
    parts = z.split([len(u.sigma) for u in parameters])
    values = {u.name: u.root.to(deviations) @ deviations for u, deviations in zip(parameters, parts)}
    links = {
        names: _perturbed_link(link, values.get(" > ".join(names)), rig, names)
        for names, link in rig.links.items()
    }
    cameras = {name: value for name, value in values.items() if " > " not in name}
    return rig.perturbed(cameras).replace(links=links)


def _camera_of(parameter: str) -> str:
    return parameter.rpartition(".")[0]


def _matching(parameters: Sequence[str], free: Iterable[str]) -> list[str]:
    wanted: dict[str, None] = {}
    for pattern in free if parameters else ():
        kind = ALIASES.get(pattern, pattern)
        names = fnmatch.filter(parameters, kind if "." in kind else f"*.{kind}")
        if not names:
            kinds = ", ".join(dict.fromkeys(name.rpartition(".")[2] for name in parameters))
            raise ValueError(f"free: the rig has no '{pattern}' (it has: {kinds})")
        wanted |= dict.fromkeys(names)
    return list(wanted)


def _free_parameter(rig: Rig, name: str, like: Tensor, sigma: Mapping[str, float]) -> FreeParameter:
    """Return a parameter with its prior deviation, in its own unit and in that for display."""
    camera, _, kind = name.rpartition(".")
    size = torch.full((like.shape[-1],), sigma[kind], dtype=torch.float64)
    view = rig[camera]
    if kind == "focal" and isinstance(view, Camera):
        size = size * view.K[:2, :2].abs().amax(0)
    if kind == "distortion" and isinstance(view, LensView) and view.distortion is not None:
        natural = torch.tensor(typical_coefficients(view.distortion), dtype=torch.float64)
        size = natural * (sigma[kind] if isinstance(view, Camera) else LENS_SIGMA)
    if kind == "translation":
        centres = torch.stack([c.centre for c in rig.cameras.values() if isinstance(c, Camera)])
        size = size * (float(torch.pdist(centres).max()) or 1e-6 if len(centres) > 1 else 1.0)
    unit, factor = UNITS.get(kind, ("", 1.0))
    if kind == "translation" and (rig_unit := length_unit(rig)) != "m":
        unit, factor = rig_unit, 1.0
    return FreeParameter(name, size, unit, factor, FOCAL_CORRELATION if kind == "focal" else 0.0)


def _perturbed_link(link: Link, value: Tensor | None, rig: Rig, names: tuple[str, str]) -> Link:
    """Return F after seven small changes: rotations of the singular vectors, the second singular value."""
    if value is None:
        return link
    K, K_beta = (intrinsics(max(rig[name].hw) / 2, rig[name].hw).to(link.F) for name in names)
    U, S, Vh = torch.linalg.svd(K_beta.T @ link.F @ K)
    second = (S[1] / S[0]) * (1 + value[6])
    U, Vh = U @ rotation_from_vector(value[:3]), rotation_from_vector(value[3:6]) @ Vh
    F = U @ torch.diag(torch.stack([torch.ones_like(second), second, torch.zeros_like(second)])) @ Vh
    return Link(torch.linalg.inv(K_beta).T @ F @ torch.linalg.inv(K), link.H)
