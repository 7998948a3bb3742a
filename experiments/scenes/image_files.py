"""Rendered light as ordinary images: PNG, JPEG and EXR; black and white, colour, colour with coverage."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from pat.media.colour import REC709, luminance, srgb_image
from pat.media.images import write_image
from pat.media.video import write_video
from pat.synthesis.rendered import Rendered, RenderedFrame

Channels = Literal["bw", "rgb", "rgba", "nir"]
Kind = Literal["png8", "png16", "jpeg", "exr"]

_SUFFIX = {"png8": ".png", "png16": ".png", "jpeg": ".jpg", "exr": ".exr"}


def export(rendered: Rendered, out: str | Path, *, kind: Kind = "png8", channels: Channels = "rgb") -> list[Path]:
    """Write all frames of a rendered folder as images named like its arrays; returns the paths.

    PNG and JPEG are sRGB and clipped at white; EXR (32-bit float) stays linear. Raises ValueError for "rgba" without
    the pass "alpha", "nir" without the pass "nir", and "rgba" as JPEG.
    """
    written = []
    for name in rendered.rig.names:
        for number, entry in enumerate(rendered.about["frames"][name]):
            path = (Path(out) / entry["file"]).with_suffix(_SUFFIX[kind])
            write_light(path, light(rendered.frame(name, number), channels), bits=16 if kind == "png16" else 8)
            written.append(path)
    return written


def export_video(rendered: Rendered, camera: str, path: Path) -> None:
    """The frames of a camera as a video (.mp4, .mkv), at its frame rate. Raises ValueError if there is only one."""
    count = rendered.frames(camera)
    if count < 2:
        raise ValueError(f"camera '{camera}' has one frame: render with a duration")
    frames = (srgb_image(rendered.frame(camera, k).rgb) for k in range(count))
    write_video(path, frames, rate=rendered.rig[camera].sensor.frame_rate or 30.0)


def light(frame: RenderedFrame, channels: Channels) -> Float[Tensor, "c h w"]:
    """The linear channels of a frame, colour multiplied by coverage in "rgba". Raises ValueError for missing passes."""
    if channels == "rgb":
        return frame.rgb
    if channels == "bw":
        return luminance(frame.rgb, REC709)
    extra = frame.nir if channels == "nir" else frame.alpha
    if extra is None:
        needed = "nir" if channels == "nir" else "alpha"
        raise ValueError(f"channels '{channels}' need the pass '{needed}': render with passes ('{needed}',)")
    return extra if channels == "nir" else torch.cat([frame.rgb, extra])


def write_light(path: Path, image: Float[Tensor, "c h w"], *, bits: int = 8) -> None:
    """Write linear light, with its coverage if it has four channels, in the format its name ends in.

    .exr stays linear and multiplied by coverage; .png and .jpg are sRGB-encoded, and .png holds colours that are not
    multiplied by coverage.
    """
    coverage = image[3:] if len(image) == 4 else None
    if path.suffix == ".exr":
        return write_image(path, image[:3], bits=32, coverage=coverage)
    colours = image if coverage is None else image[:3] / coverage.clamp(min=1e-6)
    write_image(path, srgb_image(colours), bits=bits, coverage=coverage)
