"""Which camera parameters the images determine; unobservable ones are fixed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from arraygeom import Camera

from .bundle import BundleProblem, Free, normal_equations
from .camera_parameters import CameraPrior, intrinsic_values, parameter_names

TYPICAL_COEFFICIENTS = {
    "brown-conrady": (1.0, 1.0, 0.02, 0.02, 1.0, 1.0, 1.0, 1.0, 0.02, 0.02, 0.02, 0.02, 0.1, 0.1),
    "kannala-brandt": (0.3, 0.3, 0.3, 0.3),
    "thin-prism-fisheye": (0.3, 0.3, 0.02, 0.02, 0.3, 0.3, 0.02, 0.02),
    "pix4d-fisheye": (0.1, 0.1, 0.1),
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
    "pix4d-fisheye": ("k2", "k3", "k4"),
    "double-sphere": ("xi", "alpha"),
    "extended-unified": ("alpha", "beta"),
    "unified": ("xi", "k1", "k2", "p1", "p2"),
    "fov": ("omega",),
    "scaramuzza": ("b2", "b3", "b4"),
}
"""Names of the coefficients, in order."""
TYPICAL_FOCAL_ERROR, TYPICAL_CENTRE_ERROR = 0.1, 0.1
"""Likewise of the error of a guessed focal length, as a share of it, and of the principal point, of the width."""
CENTRE_DEVIATION, ASPECT_DEVIATION = 0.03, 0.01
"""Standard deviations of the principal point about the centre (share of the width), and of the aspect ratio."""
UNOBSERVABLE = 0.5
"""A parameter is unobservable if its posterior deviation stays above this share of its typical size."""


def typical_sizes(camera: Camera) -> Float[np.ndarray, " p"]:
    """Typical errors of a camera's parameters before any measurement, in the order of `parameter_names`."""
    focal = TYPICAL_FOCAL_ERROR * camera.K[:2, :2].det().abs().sqrt().item()
    lens = camera.distortion
    coefficients = () if lens is None else TYPICAL_COEFFICIENTS[lens.model][: len(lens.coefficients)]
    return np.array([3.0] * 3 + [100.0] * 3 + [focal] * 2 + [TYPICAL_CENTRE_ERROR * camera.hw[1]] * 2 + [*coefficients])


def typical_prior(camera: Camera) -> CameraPrior:
    """Prior of ordinary cameras: square pixels, a principal point near the centre, moderate distortion.

    Negligible where boards were observed at many positions and tilts; elsewhere it keeps a camera plausible.
    """
    h, w = camera.hw
    mean = np.zeros(len(intrinsic_values(camera)))
    mean[8:10] = (w - 1) / 2, (h - 1) / 2
    deviation = typical_sizes(camera)
    deviation[8:10] = CENTRE_DEVIATION * w
    information = np.diag(deviation**-2.0)
    information[:8, :8] = 0.0
    focal = camera.K[:2, :2].det().abs().sqrt().item()
    information[6:8, 6:8] = np.array([[1, -1], [-1, 1]]) / (ASPECT_DEVIATION * focal) ** 2
    return CameraPrior(mean, information)


def gate(
    problem: BundleProblem, free: Free, sigma: dict[str, float], *, final: bool = True
) -> tuple[BundleProblem, dict[str, np.ndarray], list[str]]:
    """Fix every unobservable parameter of the lens and the principal point at its default, worst first.

    Returns the problem with those parameters set, the remaining free ones, and a note on each. Once the fit is `final`,
    raises ValueError where a focal length is unobservable.
    """
    observable = {name: mask.copy() for name, mask in free.items()}
    notes: list[str] = []
    candidates = [(name, int(i)) for name in problem.cameras for i in np.flatnonzero(free[name])]
    information = _relative_information(problem, free, sigma)
    while (worst := _worst(candidates, information)) is not None:
        name, index = candidates[worst]
        entry = parameter_names(problem.cameras[name])[index]
        if entry.startswith("focal"):
            if not final:
                break
            raise ValueError(
                f"{name}: the images do not determine the focal length: tilt the board by 20 to 40 degrees, to "
                "different sides, and bring it close in some of them"
            )
        observable[name][index] = False
        candidates.pop(worst)
        information = np.delete(np.delete(information, worst, 0), worst, 1)
        problem = _with_default(problem, name, entry)
        notes.append(f"{name}: {_described(problem.cameras[name], entry)}: the images do not determine it")
    return problem, observable, notes


def _relative_information(problem: BundleProblem, free: Free, sigma: dict[str, float]) -> np.ndarray:
    """The inverse covariance of the free parameters in units of their typical sizes, by pixels and stated priors."""
    sizes = np.concatenate([typical_sizes(camera)[free[name]] for name, camera in problem.cameras.items()])
    stated = {name: prior for name, prior in problem.priors.items() if prior.pose is not None}
    information = normal_equations(replace(problem, priors=stated), free, sigma).information()
    return information * sizes[:, None] * sizes


def _worst(candidates: list[tuple[str, int]], information: np.ndarray) -> int | None:
    """The parameter whose deviation is the largest share of its typical size, if too large; focal lengths last."""
    covariance = np.linalg.inv(information + np.eye(len(candidates)))
    shares = np.sqrt(np.maximum(covariance.diagonal(), 0))
    order = np.array([2 if i >= 8 else 1 if i >= 6 else 0 for _, i in candidates]) * (shares > UNOBSERVABLE)
    worst = int(np.lexsort((shares, order))[-1])
    return worst if order[worst] else None


def _with_default(problem: BundleProblem, name: str, entry: str) -> BundleProblem:
    """The problem with one parameter of a camera at its default: principal point centred, coefficient 0."""
    camera = problem.cameras[name]
    kind, index = entry.split(".")
    if kind == "centre":
        K = camera.K.clone()
        K[int(index), 2] = (camera.hw[1 - int(index)] - 1) / 2
        camera = camera.replace(K=K)
    elif camera.distortion is not None:
        coefficients = camera.distortion.coefficients.clone()
        coefficients[int(index)] = 0.0
        camera = camera.replace(distortion=camera.distortion.with_coefficients(coefficients))
    return replace(problem, cameras={**problem.cameras, name: camera})


def _described(camera: Camera, entry: str) -> str:
    kind, index = entry.split(".")
    if kind == "centre":
        return f"the principal point's {'xy'[int(index)]} is fixed at the image's centre"
    assert camera.distortion is not None
    return f"the lens's {LENS_TERMS[camera.distortion.model][int(index)]} is fixed at 0"
