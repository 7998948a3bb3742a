"""Frame: a fused image with its depth and confidence."""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from typing import NamedTuple

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor
from torch.nn.functional import interpolate

from ..media.figures import colour_depth

SHOWN = 480
"""Longer side in pixels of a notebook's picture of a frame: three of them are as wide as a page."""


class Frame(NamedTuple):
    """A fused frame at alpha's view.

    Attributes:
        image: (C, H, W), in alpha's coding, not clipped to 0..1.
        depth: (H, W), along alpha's axis, or its rays (`measured_along`), in the rig's unit; NaN where no
            calibrated beta sees the point.
        confidence: (H, W), the probability that every band's beta (one, of several that show all bands) sees
            the point and its position is right to a pixel; a network without matches has its own measure.
        half_width: (H, W), one over that unit: in 9 of 10 pixels the true inverse depth is within it of 1 /
            depth; NaN where depth is.
        by_band: (C, H, W), float16, the confidence of each band, where they are several cameras'; else None.
    """

    image: Float[Tensor, "c h w"]
    depth: Float[Tensor, "h w"]
    confidence: Float[Tensor, "h w"]
    half_width: Float[Tensor, "h w"]
    by_band: Float[Tensor, "c h w"] | None = None

    @property
    def depth_interval(self) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
        """Nearest and farthest depth (rig's unit; may be infinite) around the true one in 9 of 10 pixels; NaN
        where unknown."""
        inverse = 1 / self.depth
        farthest = inverse - self.half_width
        beyond = farthest <= 0
        farthest = torch.where(beyond, torch.inf, 1 / torch.where(beyond, 1.0, farthest))
        return 1 / (inverse + self.half_width), farthest

    def mapped(self, change: Callable[[Tensor], Tensor]) -> Frame:
        """Return the frame with a function applied to each tensor, as one that moves it to another device."""
        return Frame(*(tensor if tensor is None else change(tensor) for tensor in self))  # type: ignore[arg-type]

    def __repr__(self) -> str:
        """Return sizes, the range of depth and the mean confidence, in a line."""
        bands, h, w = self.image.shape
        finite = self.depth[self.depth.isfinite()]
        depth = f"depth {finite.min():.3g} to {finite.max():.3g}" if len(finite) else "depth unknown"
        return f"Frame({w}x{h}, {bands} bands, {depth}, mean confidence {self.confidence.mean():.2f})"

    def _repr_png_(self) -> bytes:
        """Return the image, depth (red is near) and confidence side by side, as a PNG file for notebooks."""
        confidence = self.confidence[None].expand(3, -1, -1)
        parts = picture_of(self.image).expand(3, -1, -1), colour_depth(self.depth), confidence
        factor = min(SHOWN / max(self.image.shape[-2:]), 1.0)
        hw = [max(round(n * factor), 1) for n in self.image.shape[-2:]]
        shown = [interpolate(image.detach().cpu().float()[None], size=hw, mode="area")[0] for image in parts]
        values = (torch.cat(shown, -1).clamp(0, 1) * 255).round().to(torch.uint8)
        file = BytesIO()
        Image.fromarray(values.permute(1, 2, 0).numpy()).save(file, format="PNG")
        return file.getvalue()


def picture_of(image: Float[Tensor, "c h w"]) -> Float[Tensor, "d h w"]:
    """Return an image of one channel or three: the mean of any other number of bands."""
    return image if len(image) in (1, 3) else image.mean(0, keepdim=True)
