"""Arrays of `pat demo`, a rendered scene and a photograph, ideal and as cameras record them; its figure."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from torch import Generator, Tensor

from ..fusion.classical import classical, denoised_knowing
from ..fusion.fuse import FuseSettings, corrections_of
from ..media.colour import luminance
from ..media.figures import save_panels
from ..networks.protocol import FusionNetwork
from ..sensors.noise_level import NoiseLevel
from .sample_array import ALPHA, BETA, SampleArray

RESPONSE = (0.2, 0.4, 0.4)
"""Weights of red, green and blue in the real mono camera, whose luminance is not Rec. 601's."""
EXPOSURE = 0.6
"""Ratio of the real colour camera's values to the mono camera's."""
NOISE = NoiseLevel.from_electrons(300, 2.0)
"""Noise of both real cameras."""
CROP = 4
"""Enlargement of the figure's lower row."""


def as_real_cameras(array: SampleArray) -> tuple[SampleArray, dict[str, NoiseLevel]]:
    """Simulate an array's images as real cameras record them: another response and exposure, in low light.

    Returns:
        The array with these images, the same for each call, and the noise level by camera.
    """
    generator = Generator().manual_seed(0)
    ideal = {ALPHA: luminance(array.ground_truth, RESPONSE), BETA: EXPOSURE * array.images[BETA]}
    images = {name: NOISE.recorded(image[None], generator)[0] for name, image in ideal.items()}
    return array._replace(images=images), dict.fromkeys(images, NOISE)


def classical_methods(
    network: FusionNetwork, array: SampleArray, noise: Mapping[str, NoiseLevel] | None
) -> dict[str, Tensor]:
    """Run the classical fusion: plain, with alpha's response corrected, denoised first, and both.

    Images are denoised by non-local means with known noise; the response is the one that this package's
    fusion estimates from the denoised images.

    Args:
        network: network of that fusion.
        array: array to fuse.
        noise: noise level by camera; None for ideal cameras.

    Returns:
        Fused images (3, h, w) by method: "classical", "classical, corrected", "classical, denoised" and
        "classical, denoised and corrected"; the first alone for ideal cameras (`noise` None).

    Raises:
        ValueError: as `classical`, and for images that do not fit the rig or the network.
    """
    rig, images, _ = array
    methods = {"classical": classical(rig, images, ALPHA, BETA)}
    if noise is None:
        return methods
    denoised = {name: denoised_knowing(image, noise[name]) for name, image in images.items()}
    settings = FuseSettings(align=False)
    response = corrections_of(denoised, rig, alpha=ALPHA, network=network, settings=settings).response

    def corrected(given: Mapping[str, Tensor]) -> Tensor:
        scaled = {ALPHA: response.of_alpha(given[ALPHA]), BETA: response.of_beta(given[BETA])}
        return response.undone(classical(rig, scaled, ALPHA, BETA)).clamp(0, 1)

    methods["classical, corrected"] = corrected(images)
    methods["classical, denoised"] = classical(rig, denoised, ALPHA, BETA)
    methods["classical, denoised and corrected"] = corrected(denoised)
    return methods


def save_demo_figure(panels: Mapping[str, Tensor], corner: tuple[int, int], path: Path) -> None:
    """Write a figure of images of one size, three in a row, followed by an enlarged window of each.

    Args:
        panels: images (c, h, w), grey or RGB, values 0..1, by title; at least one.
        corner: (row, column) of the window's first pixel; it has `1 / CROP` of the height and width.
        path: image file to write, of a format that Pillow writes.

    Raises:
        ValueError: for another suffix.
        OSError: if it cannot be written.
    """
    h, w = next(iter(panels.values())).shape[-2:]
    top, left = corner
    window = (..., slice(top, top + h // CROP), slice(left, left + w // CROP))
    enlarged = {f"{name}, {CROP} x": image[window] for name, image in panels.items()}
    save_panels({**panels, **enlarged}, path, columns=3)
