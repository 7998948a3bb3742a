"""What the images can tell of a camera, and what had better be left alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from arraygeom import Camera

from .bundle import Expected, Free, Scene, intrinsic_numbers, normal_equations, parameter_names

NATURAL = {
    "brown-conrady": (1.0, 1.0, 0.02, 0.02, 1.0, 1.0, 1.0, 1.0, 0.02, 0.02, 0.02, 0.02, 0.1, 0.1),
    "kannala-brandt": (0.3, 0.3, 0.3, 0.3),
}
"""How large the coefficients of lenses usually are, at most."""
LENS_TERMS = {
    "brown-conrady": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tx", "ty"),
    "kannala-brandt": ("k1", "k2", "k3", "k4"),
}
"""What the coefficients are called, in their order."""
NATURAL_FOCAL, NATURAL_CENTRE = 0.1, 0.1
"""The same for the error of a guessed focal length, as a share of it, and of the principal point, of the width."""
USUAL_CENTRE, USUAL_ASPECT = 0.03, 0.01
"""Cameras tend to have the principal point so near to the middle (as a share of the width), and pixels so square."""
UNTOLD = 0.5
"""A number whose deviation, all others unknown, stays above this share of its natural size is not told."""


def natural_sizes(camera: Camera) -> Float[np.ndarray, " p"]:
    """What each number of a camera may be off by when nothing is measured, in the order of `parameter_names`."""
    focal = NATURAL_FOCAL * camera.K[:2, :2].det().abs().sqrt().item()
    lens = camera.distortion
    coefficients = () if lens is None else NATURAL[lens.model][: len(lens.coefficients)]
    return np.array([3.0] * 3 + [100.0] * 3 + [focal] * 2 + [NATURAL_CENTRE * camera.hw[1]] * 2 + [*coefficients])


def usual(camera: Camera) -> Expected:
    """What cameras are like: square pixels, the principal point about the middle, a lens that does not bend wildly.

    Next to nothing where boards were seen at many places and tilts; where they were not, it keeps a camera plausible.
    """
    h, w = camera.hw
    mean = np.zeros(len(intrinsic_numbers(camera)))
    mean[8:10] = (w - 1) / 2, (h - 1) / 2
    deviation = natural_sizes(camera)
    deviation[8:10] = USUAL_CENTRE * w
    information = np.diag(deviation**-2.0)
    information[:8, :8] = 0.0
    focal = camera.K[:2, :2].det().abs().sqrt().item()
    information[6:8, 6:8] = np.array([[1, -1], [-1, 1]]) / (USUAL_ASPECT * focal) ** 2
    return Expected(mean, information)


def gate(
    scene: Scene, free: Free, sigma: dict[str, float], *, final: bool = True
) -> tuple[Scene, dict[str, np.ndarray], list[str]]:
    """Keep fixed, at what a plain camera has, every number of a lens that the images do not tell, worst first.

    Returns the scene with those numbers set, what is still free, and sentences that say so. Once the fit is `final`,
    raises ValueError where a focal length is not told.
    """
    mine, notes = {name: mask.copy() for name, mask in free.items()}, []
    places = [(name, int(i)) for name in scene.cameras for i in np.flatnonzero(free[name])]
    information = _relative_information(scene, free, sigma)
    while (worst := _worst(places, information)) is not None:
        name, index = places[worst]
        entry = parameter_names(scene.cameras[name])[index]
        if entry.startswith("focal"):
            if not final:
                break
            raise ValueError(
                f"{name}: the images do not tell the focal length: tilt the board by 20 to 40 degrees, to different "
                "sides, and bring it close in some of them"
            )
        mine[name][index] = False
        places.pop(worst)
        information = np.delete(np.delete(information, worst, 0), worst, 1)
        scene = _plain(scene, name, entry)
        notes.append(f"{name}: {_described(scene.cameras[name], entry)}: the images do not tell it")
    return scene, mine, notes


def _relative_information(scene: Scene, free: Free, sigma: dict[str, float]) -> np.ndarray:
    """The inverse covariance of the free numbers in units of their natural sizes."""
    sizes = np.concatenate([natural_sizes(camera)[free[name]] for name, camera in scene.cameras.items()])
    told = normal_equations(replace(scene, expected={}), free, sigma).information()
    return told * sizes[:, None] * sizes


def _worst(places: list[tuple[str, int]], information: np.ndarray) -> int | None:
    """The number whose deviation is the largest share of its natural size, if too large; focal lengths last."""
    covariance = np.linalg.inv(information + np.eye(len(places)))
    shares = np.sqrt(np.maximum(covariance.diagonal(), 0))
    order = np.array([2 if i >= 8 else 1 if i >= 6 else 0 for _, i in places]) * (shares > UNTOLD)
    worst = int(np.lexsort((shares, order))[-1])
    return worst if order[worst] else None


def _plain(scene: Scene, name: str, entry: str) -> Scene:
    """The scene with one number of a camera as a plain camera has it."""
    camera = scene.cameras[name]
    kind, index = entry.split(".")
    if kind == "centre":
        K = camera.K.clone()
        K[int(index), 2] = (camera.hw[1 - int(index)] - 1) / 2
        camera = camera.replace(K=K)
    elif camera.distortion is not None:
        coefficients = camera.distortion.coefficients.clone()
        coefficients[int(index)] = 0.0
        camera = camera.replace(distortion=type(camera.distortion)(camera.distortion.model, coefficients))
    return replace(scene, cameras={**scene.cameras, name: camera})


def _described(camera: Camera, entry: str) -> str:
    kind, index = entry.split(".")
    if kind == "centre":
        return f"the principal point's {'xy'[int(index)]} is kept at the image's middle"
    assert camera.distortion is not None
    return f"the lens's {LENS_TERMS[camera.distortion.model][int(index)]} is kept at 0"
