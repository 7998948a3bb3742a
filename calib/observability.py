"""What the pictures can tell of a camera, and what had better be left alone."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from arraygeom import Camera

from .bundle import Free, Scene, normal_equations, parameter_names

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
UNTOLD = 0.5
"""A number whose deviation, all others unknown, stays above this share of its natural size is not told."""


def natural_sizes(camera: Camera) -> Float[np.ndarray, " p"]:
    """What each number of a camera may be off by when nothing is measured, in the order of `parameter_names`."""
    focal = NATURAL_FOCAL * camera.K[:2, :2].det().abs().sqrt().item()
    lens = camera.distortion
    coefficients = () if lens is None else NATURAL[lens.model][: len(lens.coefficients)]
    return np.array([3.0] * 3 + [100.0] * 3 + [focal] * 2 + [NATURAL_CENTRE * camera.hw[1]] * 2 + [*coefficients])


def gate(scene: Scene, free: Free, sigma: dict[str, float]) -> tuple[Scene, dict[str, np.ndarray], list[str]]:
    """Keep fixed, at what a plain camera has, every number of a lens that the pictures do not tell, worst first.

    Returns the scene with those numbers set, what is still free, and sentences that say so. Raises ValueError where
    a focal length is not told.
    """
    mine, notes = {name: mask.copy() for name, mask in free.items()}, []
    while (worst := _worst(scene, mine, sigma)) is not None:
        name, index, share = worst
        entry = parameter_names(scene.cameras[name])[index]
        if entry.startswith("focal"):
            raise ValueError(
                f"{name}: the pictures do not tell the focal length (to {100 * share * NATURAL_FOCAL:.0f} % at best): "
                "tilt the board by 20 to 40 degrees, to different sides, and bring it close"
            )
        mine[name][index] = False
        scene = _plain(scene, name, entry)
        notes.append(f"{name}: {_described(scene.cameras[name], entry)}: the pictures do not tell it")
    return scene, mine, notes


def _worst(scene: Scene, free: Free, sigma: dict[str, float]) -> tuple[str, int, float] | None:
    """The free number whose deviation is the largest share of its natural size, if that is too large."""
    natural = {name: natural_sizes(camera)[free[name]] for name, camera in scene.cameras.items()}
    sizes = np.concatenate(list(natural.values()))
    information = normal_equations(scene, free, sigma).information()
    covariance = np.linalg.inv(information * sizes[:, None] * sizes + np.eye(len(sizes)))
    shares = np.sqrt(np.maximum(covariance.diagonal(), 0))
    places = [(name, int(i)) for name in scene.cameras for i in np.flatnonzero(free[name])]
    lens = np.array([i >= 6 for _, i in places])
    worst = int(np.argmax(np.where(lens, shares, 0.0)))
    return (*places[worst], float(shares[worst])) if lens[worst] and shares[worst] > UNTOLD else None


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
    return Scene({**scene.cameras, name: camera}, scene.structure, scene.seen)


def _described(camera: Camera, entry: str) -> str:
    kind, index = entry.split(".")
    if kind == "centre":
        return f"the principal point's {'xy'[int(index)]} is kept at the picture's middle"
    assert camera.distortion is not None
    return f"the lens's {LENS_TERMS[camera.distortion.model][int(index)]} is kept at 0"
