"""The images of a rig's cameras, each read and developed once, with the rig that describes them."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from arraygeom import (
    Curved,
    Dense,
    Epipolar,
    Moved,
    Pair,
    ReceptiveField,
    Rig,
    Sensor,
    ThroughLenses,
    Widened,
)
from arraygeom.batching import tensors_of
from arraygeom.pixels import HW
from arraygeom.runtime.warned import warn

from ..media.colour import luminance_of as grey
from ..media.images import Images, read_image, recorded_bands
from ..media.raw import develop, developed_rig
from ..support.memory import check_limit

T = TypeVar("T")
Fields = Mapping[str, ReceptiveField | None]
"""Field of each beta; None, or a beta that is missing, stands for the default."""


@dataclass(frozen=True)
class Views:
    """Images to fuse, with the rig and the fields that hold for them; steps change all three together.

    Attributes:
        rig: rig of the images as they are now.
        images: images (C, H, W), values 0..1, beyond for noise and exposure, by camera; alpha's is grey.
        alpha: name of alpha.
        fields: receptive fields of betas; None, or no entry, for the pair's default field.
        alpha_in_colour: True if alpha's image was recorded in colour.
        joined: names of the cameras in each beta, by its name, once betas were joined; empty before.
    """

    rig: Rig
    images: Mapping[str, Tensor]
    alpha: str
    fields: Fields = dataclasses.field(default_factory=dict)
    alpha_in_colour: bool = False
    joined: Mapping[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)

    @classmethod
    def of(
        cls,
        rig: Rig,
        images: Images,
        *,
        alpha: str,
        depth: tuple[float, float] | None = None,
        field: ReceptiveField | Mapping[str, ReceptiveField | None] | None = None,
    ) -> Views:
        """Make views of a rig and images, after checking names, sizes and values; alpha is made grey.

        Args:
            rig: the cameras. Those without an image are left out.
            images: images (C, H, W) by camera; each is asked for once.
            alpha: name of alpha.
            depth: (near, far) in place of the rig's depth range; None for the rig's.
            field: field of all betas, or of each; None for the default.

        Raises:
            ValueError: for a camera that the rig lacks, no image of alpha or of any beta, an alpha of other
                bands than one and three, a depth range that `Rig` refuses, and as `range_of` and
                `check_exposures`. Images that are read when asked for raise as their mapping does.
            TypeError: for images that are no tensors, or have no names, and a depth range that is no pair.
        """
        if not isinstance(images, Mapping):
            raise TypeError(f"the images are a {type(images).__name__}: give {{NAME: image}}, by camera")
        for name in (alpha, *images, *(field if isinstance(field, Mapping) else ())):
            rig.require(name)
        if alpha not in images:
            raise ValueError(f"no image of alpha, '{alpha}'")
        names = [name for name in rig.betas(alpha) if name in images]
        if not names:
            raise ValueError(
                f"the only image is of alpha, '{alpha}': give one of another camera, too "
                f"({', '.join(rig.betas(alpha))})"
            )
        checked = {name: checked_image(rig, images, name) for name in (alpha, *names)}
        check_exposures(rig, checked, alpha)
        fields = field if isinstance(field, Mapping) else dict.fromkeys(names, field)
        rig = rig if depth is None else rig.replace(depth=depth)
        images = {**checked, alpha: grey_alpha(alpha, checked[alpha])}
        return cls(rig, images, alpha, fields, is_in_colour(checked[alpha]))

    @property
    def own(self) -> Float[Tensor, "1 h w"]:
        """Image of alpha."""
        return self.images[self.alpha]

    @property
    def betas(self) -> list[str]:
        """Betas that have images, in the rig's order."""
        return [name for name in self.rig.betas(self.alpha) if name in self.images]

    def pair(self, beta: str) -> Pair:
        """Return alpha and a beta, with the depth range that is searched: a field may have its own."""
        pair, field = self.rig.pair(self.alpha, beta), innermost(self.fields.get(beta))
        field = innermost(field.field) if isinstance(field, ThroughLenses) else field
        if not (pair.calibrated and isinstance(field, Curved | Epipolar)):
            return pair
        return dataclasses.replace(pair, depth=Epipolar(field.near, field.far).bounds(pair))

    def replace(self, images: Mapping[str, Tensor], *, rig: Rig | None = None) -> Views:
        """Return the views with other images of some cameras, and another rig."""
        return dataclasses.replace(self, rig=rig or self.rig, images={**self.images, **images})


def innermost(field: ReceptiveField | None) -> ReceptiveField | None:
    """Return the field within `Widened` and `Moved`, or the field itself; None for None."""
    while isinstance(field, Widened | Moved):
        field = field.field
    return field


def states_distance(field: ReceptiveField | None) -> bool:
    """Return True for a field, as `innermost`, whose attribute `bounds` is "distance"."""
    return bool(getattr(field, "bounds", None) == "distance")


def dense_bytes(alpha: HW, beta: HW, stride: int = 1) -> float:
    """Return the bytes of the positions that the dense field has for every 2 x 2 pixels of alpha."""
    return math.prod(alpha) / 4 * math.prod(beta) / stride**2 * 8


def check_dense(views: Views, limit: float | None) -> None:
    """Check that dense fields fit into memory: this machine's (not on Windows), and a limit.

    Args:
        limit: memory limit, bytes; None for no limit.

    Raises:
        ValueError: for a `Dense` field of a beta whose positions take more.
    """
    has = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") if os.name == "posix" else math.inf
    most, (h, w) = min(limit or math.inf, has), views.rig[views.alpha].hw
    for name in views.betas:
        field, beta = innermost(views.fields.get(name)), views.rig[name].hw
        if isinstance(field, Dense) and (needed := dense_bytes((h, w), beta, field.stride)) > most:
            raise ValueError(
                f"the dense field of {w}x{h} pixels in {beta[1]}x{beta[0]} of '{name}' takes "
                f"{needed / 2**30:.1f} GiB, and there are {most / 2**30:.1f}: reduce the images, or take "
                "another field"
            )


BRIGHTER = 200.0
"""Ratio of two images' light above which their stated exposures must be wrong."""


def check_exposures(rig: Rig, images: Mapping[str, Tensor], alpha: str) -> None:
    """Check the exposures that the rig states by the brightness of the developed images.

    Each image is compared with alpha's; pairs without two stated exposures are not checked.

    Raises:
        ValueError: for images that differ more than `BRIGHTER` times in light: exposures must be wrong.
    """
    light = {n: float(i[:, ::4, ::4].detach().clamp(min=0).pow(2.2).mean()) for n, i in images.items()}
    for name, one in light.items():
        exposures = rig[alpha].sensor.exposure, rig[name].sensor.exposure
        ratio = max(one, 1e-9) / max(light[alpha], 1e-9)
        if None not in exposures and max(ratio, 1 / ratio) > BRIGHTER:
            raise ValueError(
                f"the images of '{alpha}' and '{name}' differ {max(ratio, 1 / ratio):.0f} times in light by "
                f"the rig's exposures, {exposures[0]:g} and {exposures[1]:g} seconds: correct 'exposure'"
            )


LARGEST_VALUE = 32.0
"""Largest value of an image in 0..1: highlights exceed 1, and most of a short exposure may; 8 bits have
values to 255."""
SMALLEST_VALUE = -0.25
"""Least value of an image in 0..1: noise goes below 0, and images as many networks take them, of mean 0, far
below."""


def is_in_colour(image: Float[Tensor, "c h w"]) -> bool:
    """Return True if an image has three bands that are not all equal."""
    return len(image) == 3 and not all(torch.equal(image[0], band) for band in image[1:])


def grey_alpha(name: str, image: Float[Tensor, "c h w"]) -> Float[Tensor, "1 h w"]:
    """Return alpha's image in grey.

    Raises:
        ValueError: for other numbers of bands than one and three.
    """
    if len(image) not in (1, 3):
        raise ValueError(f"the image of alpha, '{name}', has {len(image)} bands: give one in grey or colour")
    return grey(image)


def check_precision(views: Views, network: Any) -> None:
    """Check that images have the precision of a network's weights, and that all is on alpha's device.

    Raises:
        ValueError: for an image of another precision, and an image, a rig or weights on another device; the
            text says what to do.
    """
    weights = next(network.parameters(), None) if isinstance(network, nn.Module) else None
    own = views.images[views.alpha].device
    others = {f"the image of '{name}'": image.device for name, image in views.images.items()}
    others["the rig"] = next((tensor.device for tensor, _ in tensors_of(views.rig)), own)
    others["the network"] = own if weights is None else weights.device
    for what, device in others.items():
        if device != own:
            raise ValueError(
                f"the image of '{views.alpha}' is on {own}, {what} on {device}: give all on one device"
            )
    for name, image in views.images.items():
        if weights is not None and image.dtype != weights.dtype:
            of_images, of_weights = (str(t.dtype).removeprefix("torch.") for t in (image, weights))
            raise ValueError(
                f"the image of '{name}' is {of_images}, the network's weights are {of_weights}: "
                f"give images of {of_weights}, or call network.to(torch.{of_images})"
            )


def check_bands(views: Views, wanted: int | None) -> None:
    """Refuse betas of which neither one nor all together have a network's bands; warn of three equal bands.

    Args:
        wanted: number of bands of the network's image; None for any.

    Raises:
        ValueError: if they do not fit; the text says which weights to take.
    """
    bands = {name: len(views.images[name]) for name in views.betas}
    total = sum(bands.values())
    if wanted is not None and total != wanted and wanted not in bands.values():
        listed = ", ".join(f"'{name}' {count}" for name, count in bands.items())
        advice = ""
        if wanted == 3 and total == 1:
            sensor = views.rig[next(iter(bands))].sensor
            said = ", and the rig says that it is in colour" if sensor.response == "rgb" else ""
            advice = f"its image is grey{said}: give one in colour, or "
        raise ValueError(
            f"the betas have {total} band{'s' if total > 1 else ''} in all ({listed}), these weights make "
            f"{wanted}: {advice}take the weights mono-spectral, which fuse any number of bands"
        )
    for name in views.betas:
        image = views.images[name]
        if len(image) == 3 and not is_in_colour(image):
            warn(f"the image of '{name}' has three equal bands: it is grey, and gives no colour")


def checked_image(rig: Rig, images: Images, name: str) -> Tensor:
    """Look up a camera's image and check it; warns if all its values are equal.

    Returns:
        The image (C, H, W).

    Raises:
        TypeError: unless it is a tensor.
        ValueError: as `range_of`, for the size that the rig states. The look-up raises as `images` does.
    """
    image = images[name]
    exposed = rig[name].sensor.exposure is not None
    smallest, largest = range_of(name, image, rig[name].hw, exposed=exposed)
    if smallest == largest:
        warn(f"the image of '{name}' is of one colour, with nothing to match: give another image")
    return image


def range_of(name: str, image: Any, hw: HW | None = None, *, exposed: bool = False) -> tuple[float, float]:
    """Check an image, and return its least and its greatest value.

    Args:
        name: name of the camera, for messages.
        image: image (C, H, W), float32 or float64.
        hw: height and width that it must have; None for any.
        exposed: True if the rig states an exposure: most values may then exceed 1.

    Returns:
        Least and greatest value.

    Raises:
        TypeError: unless it is a tensor.
        ValueError: unless it is a dense float image (C, H, W) of this size (without `hw`, wider than 3), with
            finite values from `SMALLEST_VALUE` to `LARGEST_VALUE`, at most half above 1 if not `exposed`.
    """
    if not isinstance(image, Tensor):
        raise TypeError(
            f"the image of '{name}' is a {type(image).__name__}: give a tensor, as `read_image` does"
        )
    if image.is_meta or image.layout != torch.strided:
        raise ValueError(
            f"the image of '{name}' is {image.layout} on {image.device}: give a dense tensor with values"
        )
    first, last = tuple(image.shape[:2]), tuple(image.shape[1:])
    as_stored = image.shape[-1:] <= (3,) if hw is None else first == hw != last
    if image.ndim != 3 or not image.numel() or as_stored or image.dtype not in (torch.float32, torch.float64):
        got = f"{str(image.dtype).removeprefix('torch.')} of shape {tuple(image.shape)}"
        raise ValueError(f"the image of '{name}' is {got}: wanted float32 (C, H, W) in 0..1")
    if hw is not None and last != hw:
        got, (h, w) = f"{image.shape[2]}x{image.shape[1]}", hw
        raise ValueError(
            f"the image of '{name}' is {got}, the rig says {w}x{h}: resize the rig, or give the right image"
        )
    smallest, largest = (float(v) for v in image.detach().aminmax())
    if not math.isfinite(largest - smallest):
        raise ValueError(f"the image of '{name}' has NaN or infinite values")
    if smallest < SMALLEST_VALUE:
        raise ValueError(
            f"the image of '{name}' has values down to {smallest:g}: images are in 0..1, without a mean "
            "subtracted"
        )
    brighter = 0.0 if exposed or largest <= 1 else float((image > 1).double().mean())
    if largest > LARGEST_VALUE or brighter > 0.5:
        raise ValueError(
            f"the image of '{name}' has values up to {largest:g}: divide them, images are in 0..1"
        )
    return smallest, largest


KEPT = 4_000_000
"""Largest number of values of an image that is kept: reading it again takes longer than the
memory is worth."""


class FilesOfCameras(Mapping[str, T]):
    """Base class of a mapping of cameras to the content of an image file of each, read when asked for.

    Subclasses define `__getitem__`.

    Args:
        rig: the cameras.
        files: image file of each camera.
    """

    def __init__(self, rig: Rig, files: Mapping[str, str | Path]) -> None:
        self.rig, self.files = rig, files

    def __iter__(self) -> Iterator[str]:
        return iter(self.files)

    def __len__(self) -> int:
        return len(self.files)

    def __contains__(self, name: object) -> bool:
        return name in self.files


class ViewFiles(FilesOfCameras[Tensor]):
    """Images by camera, read from files and developed when asked for; small ones (`KEPT`) stay in memory.

    These must not be changed in place. Looking up a camera raises as `read_view`, KeyError without a file.

    Args:
        rig: the cameras.
        files: image file of each camera.
        alpha: camera to whose scale of light the images are brought.

    Raises:
        ValueError: for an alpha that the rig lacks, or too large for the memory limit (`check_limit`).
    """

    def __init__(self, rig: Rig, files: Mapping[str, str | Path], *, alpha: str) -> None:
        super().__init__(rig, files)
        check_limit(math.prod(rig[alpha].hw))
        self.alpha, self.like = alpha, rig[alpha].sensor
        self._kept: dict[str, Tensor] = {}

    def __getitem__(self, name: str) -> Tensor:
        if name in self._kept:
            return self._kept[name]
        image = read_view(self.rig, name, self.files[name], like=self.like)
        if image.numel() <= KEPT:
            self._kept[name] = image
        return image

    @property
    def developed(self) -> Rig:
        """Rig that describes the images after development."""
        return developed_rig(self.rig, self.files)


def read_view(
    rig: Rig, name: str, path: str | Path, *, like: Sensor | None = None, sized: bool = True
) -> Float[Tensor, "c h w"]:
    """Read and develop the image of one camera.

    Warns of many clipped pixels, and of colour where the rig states one band.

    Args:
        rig: the cameras.
        name: name of the camera.
        path: image file.
        like: sensor to whose scale of light the image is brought; None for its own.
        sized: True to require the size that the rig states.

    Returns:
        The image (C, H, W) of one band or three, sRGB values in 0..1, or above where light exceeds white; one
        band where the rig states one and the file has three equal ones.

    Raises:
        FileNotFoundError: for a missing file, with camera and file.
        ValueError: for a file that cannot be read, contradicts the `bits` or (if `sized`) the size that the
            rig states, or is in colour where it states raw, with camera and file; for an unknown camera.
    """
    view = rig[name]
    hw = view.hw if sized else None
    raw = view.sensor.bayer is not None
    turned: Literal["apply", "ignore"] = "ignore" if raw else "apply"
    image = read_image(path, name=name, bits=view.sensor.bits, hw=hw, orientation=turned)
    image = recorded_bands(image, view.sensor)
    _warn_of_contradictions(image, view.sensor, f"{name}: {path}")
    if view.sensor.bayer and image.shape[0] != 1:
        raise ValueError(
            f"{name}: {path}: is in colour, and the rig says raw {view.sensor.bayer}: drop 'bayer'"
        )
    return develop(image, view.sensor, like=like)


SATURATED = 0.1
"""Share of an image's pixels at the largest value, clipped, from which a warning is given."""


def _warn_of_contradictions(image: Float[Tensor, "c h w"], sensor: Sensor, label: str) -> None:
    """Warn of an image that is clipped, or in colour where the rig states one band."""
    share = float((image >= 1).any(0).float().mean())
    if share > SATURATED:
        warn(
            f"{label}: {share:.0%} of its pixels are clipped: little to match, and colours are guessed there"
        )
    stated = sensor.response
    if len(image) == 3 and stated not in (None, "rgb") and is_in_colour(image):
        warn(f"{label}: is in colour, and the rig says response {stated}: give that band, or state rgb")
