"""Numbers of a camera for every writer, with errors that state what a format cannot hold."""

from __future__ import annotations

import torch

from ..camera import Camera
from ..distortion import BROWN_CONRADY
from ..lenses.model import LensModel
from ..pose import Pose
from ..rig import Rig


def calibrated(rig: Rig, format: str) -> list[tuple[str, Camera]]:
    """Return the rig's cameras with their names, for a file format that holds calibrated cameras only.

    Args:
        rig: the rig.
        format: name of the format, for messages.

    Returns:
        Names and cameras, in the rig's order; at least one.

    Raises:
        ValueError: if there are none, or one is uncalibrated or a batch.
    """
    cameras = []
    for name, camera in rig.cameras.items():
        if not isinstance(camera, Camera):
            raise ValueError(
                f"{format} files hold calibrated cameras and '{name}' is not one: use the native format"
            )
        if camera.batch_shape:
            raise ValueError(
                f"camera '{name}' is a batch of cameras; rig files hold one of each: write one rig each"
            )
        cameras.append((name, camera))
    if not cameras:
        raise ValueError("the rig has no cameras to write")
    return cameras


def focal_and_centre(
    name: str, camera: Camera, *, first_pixel: float = 0.0
) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy of a camera, for a file format that holds nothing else of K.

    Args:
        name: name of the camera, for messages.
        camera: camera, not a batch.
        first_pixel: coordinate of the first pixel's centre in the format.

    Returns:
        Four numbers, pixels.

    Raises:
        ValueError: if K has skew, or is rotated or mirrored.
    """
    (fx, skew, cx), (other, fy, cy) = camera.K[:2].tolist()
    if skew != 0 or other != 0 or min(fx, fy) <= 0:
        raise ValueError(
            f"camera '{name}' has a skewed, rotated or mirrored K, "
            "which this format cannot hold: use the native format"
        )
    return fx, fy, cx + first_pixel, cy + first_pixel


def brown_conrady(name: str, lens: LensModel | None, *, at_most: int) -> list[float]:
    """Return a lens's Brown-Conrady coefficients, for a file format that holds at most `at_most`.

    Args:
        name: name of the camera, for messages.
        lens: the lens; None for a pinhole.
        at_most: number of coefficients, 4 or more.

    Returns:
        The lens's coefficients, at most so many, in OpenCV's order; four zeros for a pinhole.

    Raises:
        ValueError: for another lens model, or coefficients beyond these that are not 0.
    """
    if lens is None:
        return [0.0] * 4
    c = lens.coefficients.tolist()
    if lens.model != BROWN_CONRADY or any(c[at_most:]):
        raise ValueError(
            f"camera '{name}' has a {lens.model} lens of {len(c)} coefficients, "
            f"which this format cannot hold (brown-conrady with {at_most}): use the native format"
        )
    return c[:at_most]


def at_origin(pose: Pose) -> bool:
    """Return True if a camera's frame is the world's, exactly."""
    return pose.matrix.tolist() == torch.eye(4).tolist()
