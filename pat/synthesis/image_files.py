"""Rendered light as ordinary images: PNG, JPEG and EXR; black and white, colour, colour with coverage."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom.atomic import write_atomically

from ..media.images import write_image
from .rendered import Rendered, RenderedFrame

Channels = Literal["bw", "rgb", "rgba", "nir"]
Kind = Literal["png8", "png16", "jpeg", "exr"]

REC709 = (0.2126, 0.7152, 0.0722)
"""Weights of linear red, green and blue in luminance."""

_SUFFIX = {"png8": ".png", "png16": ".png", "jpeg": ".jpg", "exr": ".exr"}


def export(rendered: Rendered, out: str | Path, *, kind: Kind = "png8", channels: Channels = "rgb") -> list[Path]:
    """Write all frames of a rendered folder as images named like its arrays; the paths written.

    PNG and JPEG are sRGB and cut at white; EXR (32-bit float) stays linear. Raises ValueError for "rgba" without the
    pass "alpha", "nir" without the pass "nir", and "rgba" as JPEG.
    """
    written = []
    for name in rendered.rig.names:
        for number, entry in enumerate(rendered.about["frames"][name]):
            path = (Path(out) / entry["file"]).with_suffix(_SUFFIX[kind])
            write_light(path, light(rendered.frame(name, number), channels), bits=16 if kind == "png16" else 8)
            written.append(path)
    return written


def light(frame: RenderedFrame, channels: Channels) -> Float[Tensor, "c h w"]:
    """The linear channels of a frame, colour multiplied by coverage in "rgba". Raises ValueError for missing passes."""
    if channels == "rgb":
        return frame.rgb
    if channels == "bw":
        return (frame.rgb * frame.rgb.new_tensor(REC709)[:, None, None]).sum(0, keepdim=True)
    extra = frame.nir if channels == "nir" else frame.alpha
    if extra is None:
        needed = "nir" if channels == "nir" else "alpha"
        raise ValueError(f"channels '{channels}' need the pass '{needed}': render with passes ('{needed}',)")
    return extra if channels == "nir" else torch.cat([frame.rgb, extra])


def write_light(path: Path, image: Float[Tensor, "c h w"], *, bits: int = 8) -> None:
    """Write linear light to a file, whole or not at all, in the format its name ends in (.png, .jpg, .exr)."""
    if path.suffix == ".exr":
        _write_exr(path, image)
    elif len(image) == 4:
        _write_rgba(path, image, bits)
    else:
        write_image(path, coded(image), bits=bits)


def coded(light: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Linear light as sRGB, cut to 0..1."""
    light = light.clamp(0, 1)
    return torch.where(light <= 0.0031308, 12.92 * light, 1.055 * light.clamp(min=1e-9) ** (1 / 2.4) - 0.055)


def _write_rgba(path: Path, image: Float[Tensor, "4 h w"], bits: int) -> None:
    """PNG holds colours that are not multiplied by coverage."""
    if path.suffix != ".png":
        raise ValueError(f"{path}: only PNG and EXR hold coverage (rgba)")
    colours = coded(image[:3] / image[3:].clamp(min=1e-6))
    full = 2**bits - 1
    planes = torch.cat([colours.flip(0), image[3:].clamp(0, 1)]).movedim(0, -1).mul(full).round().numpy()
    with write_atomically(path) as temporary:
        cv2.imwrite(str(temporary), planes.astype(np.uint8 if bits == 8 else np.uint16))


def _write_exr(path: Path, image: Float[Tensor, "c h w"]) -> None:
    import OpenEXR

    name = {1: "Y", 3: "RGB", 4: "RGBA"}[len(image)]
    planes = np.ascontiguousarray(image.float().movedim(0, -1).numpy())
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with write_atomically(path) as temporary:
        OpenEXR.File(header, {name: planes[..., 0].copy() if name == "Y" else planes}).write(str(temporary))
