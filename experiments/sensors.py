"""Recording of ideal images by cameras: responses, filters, motion; chains of steps, from files too.

A chain is a list of steps, applied in order to images (B, C, H, W) with values 0..1. Light adds up in linear
values only, so a chain for ordinary images begins with `DecodeSRGB()` and ends with `EncodeSRGB()`:

    mono:
      - decode-srgb
      - spectral: luminance
      - gaussian-blur: 0.8
      - resample: 0.5
      - noise: {full_well: 8000, read: 3}
      - clip
      - encode-srgb
      - quantise: 8

A step is its name, or its name with its options; a single value is its first option. Steps are named as their
classes are, in small letters with hyphens.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from arraygeom import Band, Curve, Rig, Sensor, pixel_grid, sample
from pat.lab.data.windows import read_view, scene_rig
from pat.lab.synthesis.rendered import Rendered
from pat.media.colour import REC601, linear_from_srgb, srgb_from_linear
from pat.media.images import write_image
from pat.sensors import BoxBlur, Clip, GaussianBlur, Jitter, Noise, Quantise, Resample, Step, generator_for
from pat.support.schema import from_document, near

CHANNELS = ((600.0, 35.0), (540.0, 35.0), (460.0, 35.0), (850.0, 60.0))
"""Assumed responses of the channels R, G, B and NIR of an ideal image: Gaussians, centre and sigma in nm."""

_KORNIA = {"RGGB": "BG", "GRBG": "GB", "BGGR": "RG", "GBRG": "GR"}
"""kornia's names of the patterns. It is imported where it is used: that takes a quarter of a second."""
_VISIBLE, _NEAR_INFRARED = (400.0, 700.0), (400.0, 1000.0)


@dataclass(frozen=True)
class DecodeSRGB(Step):
    """sRGB values to linear light (IEC 61966-2-1)."""

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        """The linear values; the linear part of the curve continues below zero."""
        return linear_from_srgb(image)


@dataclass(frozen=True)
class EncodeSRGB(Step):
    """Linear light to sRGB values, the inverse of `DecodeSRGB`."""

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        return srgb_from_linear(image)


@dataclass(frozen=True)
class Exposure(Step):
    """Linear light times a gain: exposure time, aperture and amplification together."""

    gain: float | Tensor

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        return image * self.gain


@dataclass(frozen=True)
class MotionBlur(Step):
    """The mean over the time the shutter is open, `shutter` seconds, about the moment of the sharp image.

    Everything moves with `velocity` (x, y) in pixels a second. The border is replicated.
    """

    shutter: float
    velocity: tuple[float, float]

    def __post_init__(self) -> None:
        if self.shutter < 0:
            raise ValueError(f"motion blur: shutter is a time in seconds, got {self.shutter:g}")

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        path = self.shutter * image.new_tensor(self.velocity)
        steps = max(math.ceil(2 * float(path.norm())), 1)
        times = (torch.arange(steps, dtype=path.dtype) + 0.5) / steps - 0.5
        grid = pixel_grid((image.shape[-2], image.shape[-1]), dtype=path.dtype, device=path.device)
        frames = [sample(image, (grid - t * path)[None], extended=True).values for t in times.tolist()]
        return torch.stack(frames).mean(0)


@dataclass(frozen=True)
class Spectral(Step):
    """The image of a sensor with another spectral response, from an RGB or an RGB + NIR image.

    "rgb" is the first three channels; "luminance" is Rec. 601 (0.299, 0.587, 0.114); "nir" is the fourth
    channel; a `Band` or a `Curve` is one channel: the channels taken as Gaussians (`CHANNELS`), weighted by
    how much of each the response collects, and scaled so that white stays white. An image does not hold a
    spectrum: this approximation is right for greys and only plausible for colours. Beyond 700 nm it needs a
    NIR channel.
    """

    response: Literal["rgb", "luminance", "nir"] | Band | Curve

    def __post_init__(self) -> None:
        if isinstance(self.response, Band) and self.response.width <= 0:
            raise ValueError(f"the width of a band must be positive, in nm; got {self.response.width:g}")

    def apply(self, image: Float[Tensor, "b c1 h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        """One channel, or three for "rgb"."""
        channels = image.shape[1]
        if channels not in (3, 4):
            raise ValueError(f"a spectral response needs RGB or RGB + NIR, got {channels} channels")
        if self.response == "rgb":
            return image[:, :3]
        return (image * image.new_tensor(self._weights(channels))[:, None, None]).sum(1, keepdim=True)

    def _weights(self, channels: int) -> tuple[float, ...]:
        if self.response == "luminance":
            return (*REC601, 0.0)[:channels]
        if self.response == "nir":
            if channels == 3:
                raise ValueError("the response 'nir' needs an image with NIR, got RGB: render infrared too")
            return 0.0, 0.0, 0.0, 1.0
        if isinstance(self.response, Band):
            return band_weights(self.response, channels)
        assert isinstance(self.response, Curve)
        return curve_weights(self.response, channels)


@dataclass(frozen=True)
class Mosaic(Step):
    """A Bayer filter: each pixel keeps one of R, G and B. `pattern` is read from the top left, row by row."""

    pattern: Literal["RGGB", "GRBG", "BGGR", "GBRG"] = "RGGB"

    def apply(self, image: Float[Tensor, "b 3 h w"], generator: Generator) -> Float[Tensor, "b 1 h w"]:
        """The raw images. Raises ValueError for odd sizes."""
        h, w = image.shape[-2:]
        if h % 2 or w % 2:
            raise ValueError(f"a colour filter needs even sizes, got {w}x{h}: crop first")
        from kornia.color import CFA, rgb_to_raw

        return rgb_to_raw(image, CFA[_KORNIA[self.pattern]])


def band_weights(band: Band, channels: int = 3) -> tuple[float, ...]:
    """Weights of R, G, B (and NIR) of sum 1, for a Gaussian of full width at half maximum `band.width`.

    Raises ValueError for a band that lies beyond what the channels hold: 400 to 700 nm, or to 1000 nm with
    NIR.

    >>> [round(w, 2) for w in band_weights(Band(600, 40))]
    [0.77, 0.23, 0.0]
    """
    low, high = _VISIBLE if channels == 3 else _NEAR_INFRARED
    if not low <= band.centre <= high:
        kind = "an RGB image" if channels == 3 else "an RGB + NIR image"
        raise ValueError(f"{kind} holds no band at {band.centre:g} nm; use {low:g} to {high:g} nm")
    own = (band.width / (8 * math.log(2)) ** 0.5) ** 2
    variances = [own + sigma**2 for _, sigma in CHANNELS[:channels]]
    exponents = [-((band.centre - c) ** 2) / (2 * v) for (c, _), v in zip(CHANNELS, variances)]
    return _shares([math.exp(e - max(exponents)) / v**0.5 for e, v in zip(exponents, variances)])


def curve_weights(curve: Curve, channels: int = 3) -> tuple[float, ...]:
    """Weights of R, G, B (and NIR) that add up to 1, for a sampled response.

    Raises ValueError if it sees none of them.
    """
    wavelength, response = torch.tensor([curve.wavelength, curve.response], dtype=torch.float64)
    gaussians = [(-0.5 * ((wavelength - c) / s) ** 2).exp() / s for c, s in CHANNELS[:channels]]
    overlaps = [float(torch.trapezoid(response * g, wavelength)) for g in gaussians]
    if sum(overlaps) < 1e-6:
        raise ValueError("the response curve collects no light of the image: check its wavelengths, in nm")
    return _shares(overlaps)


def _shares(overlaps: list[float]) -> tuple[float, ...]:
    return tuple(o / sum(overlaps) for o in overlaps)


class RecordedArray(NamedTuple):
    """Images of every camera after its chain, and the rig of those images."""

    images: dict[str, Float[Tensor, "b _ _ _"]]
    rig: Rig


def record_array(
    images: Mapping[str, Float[Tensor, "b _ _ _"]],
    rig: Rig,
    chains: Mapping[str, Sequence[Step]],
    *,
    seed: int,
) -> RecordedArray:
    """Each camera's chain on its images; cameras without one record the ideal image.

    Each camera draws from its own generator, seeded by `seed` and its name, independently of the other
    cameras. The rig's cameras are transformed as the steps transform the pixels. Raises ValueError for a
    camera that the rig does not have.
    """
    for name in chains:
        rig.require(name)
    recorded = {}
    for name, image in images.items():
        generator = generator_for(seed, name, device=image.device)
        A = torch.eye(3, dtype=torch.float64)
        for step in chains.get(name, ()):
            A = step.pixel_matrix((image.shape[-2], image.shape[-1])) @ A
            image = step.apply(image, generator)
        recorded[name] = image
        rig = rig.transformed(name, A, (image.shape[-2], image.shape[-1]))
    return RecordedArray(recorded, rig)


def record_rendered(
    folder: Path, out: Path, chains: Mapping[str, Sequence[Step]] | None = None, *, seed: int = 0
) -> None:
    """Write the images (16-bit PNG) that a rig's cameras record of a rendered scene, and their rig.yaml.

    `chains` are `default_chains` of the rig unless given; one without a spectral response is of colours. Near
    infrared is recorded where the scene was rendered with it. Raises ValueError for a scene that cannot be
    read.
    """
    rig = scene_rig(folder)
    images = {name: _ideal(folder, name)[None] for name in rig.names}
    given = default_chains(rig) if chains is None else {**dict.fromkeys(rig.names, ()), **chains}
    coloured = {name: c if _has_response(c) else (Spectral("rgb"), *c) for name, c in given.items()}
    recorded = record_array(images, rig, coloured, seed=seed)
    for name, image in recorded.images.items():
        write_image(out / f"{name}.png", image[0], bits=16)
    recorded.rig.save(out / "rig.yaml")


def _ideal(folder: Path, name: str) -> Float[Tensor, "c h w"]:
    """Read the ideal image of a camera of a scene: red, green, blue, and near infrared if that
    was rendered."""
    rgb, nir = read_view(folder, name).rgb, Rendered(folder).frame(name).nir
    return rgb if nir is None else torch.cat([rgb, nir])


def _has_response(chain: Sequence[Step]) -> bool:
    return any(isinstance(step, Spectral) for step in chain)


def default_chains(rig: Rig) -> dict[str, tuple[Step, ...]]:
    """Each camera's spectral response, a little noise, sRGB encoding, 8 bits."""
    return {
        name: (_spectral(c.sensor), Noise(8000, 3), Clip(), EncodeSRGB(), Quantise(8))
        for name, c in rig.cameras.items()
    }


def _spectral(sensor: Sensor) -> Spectral:
    if isinstance(sensor.response, Band | Curve):
        return Spectral(sensor.response)
    names: dict[Any, Literal["luminance", "nir"]] = {"mono": "luminance", "nir": "nir"}
    return Spectral(names.get(sensor.response, "rgb"))


_CLASSES: tuple[type[Step], ...] = (
    *(DecodeSRGB, EncodeSRGB, Spectral, Exposure, BoxBlur, GaussianBlur, MotionBlur),
    *(Resample, Mosaic, Noise, Clip, Quantise, Jitter),
)
STEPS: dict[str, type[Step]] = {re.sub(r"(?<=[a-z])(?=[A-Z])", "-", c.__name__).lower(): c for c in _CLASSES}
"""Every step by its name in files."""


def read_chain(value: Any, where: str = "chain") -> tuple[Step, ...]:
    """The steps of a list as YAML has it. Raises ValueError naming the entry (`where`), the nearest name.

    >>> read_chain(["decode-srgb", {"noise": {"full_well": 8000, "read": 3}}, {"quantise": 12}])
    (DecodeSRGB(), Noise(full_well=8000.0, read=3.0), Quantise(bits=12))
    """
    if not isinstance(value, list):
        raise ValueError(f"{where}: wanted a list of steps, as [decode-srgb, {{noise: {{full_well: 8000}}}}]")
    return tuple(_step(entry, f"{where}[{i}]") for i, entry in enumerate(value))


def read_chains(value: Any, where: str = "sensors") -> dict[str, tuple[Step, ...]]:
    """One chain for each camera, from a mapping of names to lists."""
    if not isinstance(value, Mapping):
        raise ValueError(f"{where}: wanted a mapping of cameras to lists of steps")
    return {str(name): read_chain(steps, f"{where}.{name}") for name, steps in value.items()}


def _step(entry: Any, where: str) -> Step:
    """One step of a chain. Raises ValueError naming the entry."""
    single = isinstance(entry, Mapping) and len(entry) == 1
    name, options = next(iter(entry.items())) if single else (entry, {})
    if not isinstance(name, str):
        raise ValueError(f"{where}: is {entry!r}; wanted a step's name, or one name with its options")
    if name not in STEPS:
        raise ValueError(f"{where}: no step is called '{name}'{near(name, STEPS)}")
    kind = STEPS[name]
    is_band = kind is Spectral and isinstance(options, Mapping) and options and "response" not in options
    if isinstance(options, Mapping) and not is_band:
        return from_document(kind, dict(options), f"{where}.{name}")
    first = next((f.name for f in fields(kind)), None)  # type: ignore[arg-type]
    if first is None:
        raise ValueError(f"{where}.{name}: takes no options, got {options!r}")
    return from_document(kind, {first: options}, f"{where}.{name}")
