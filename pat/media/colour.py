"""Luminance, chroma and the sRGB transfer function: the one place for each."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

REC601 = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in luminance, on coded values (ITU-R BT.601)."""


def luminance(rgb: Float[Tensor, "*b 3 h w"]) -> Float[Tensor, "*b 1 h w"]:
    """Rec. 601 luma of coded values, 0.299 R + 0.587 G + 0.114 B: MATLAB's rgb2gray, and OpenCV's."""
    weights = rgb.new_tensor(REC601)
    return (rgb * weights[:, None, None]).sum(-3, keepdim=True)


def to_luma_chroma(
    rgb: Float[Tensor, "*b 3 h w"],
) -> tuple[Float[Tensor, "*b 1 h w"], Float[Tensor, "*b 2 h w"]]:
    """Luminance Y and the colour differences (R - Y, B - Y), which are zero for grey."""
    luma = luminance(rgb)
    return luma, torch.cat([rgb[..., 0:1, :, :], rgb[..., 2:3, :, :]], -3) - luma


def from_luma_chroma(luma: Float[Tensor, "*b 1 h w"], chroma: Float[Tensor, "*b 2 h w"]) -> Float[Tensor, "*b 3 h w"]:
    """The inverse of `to_luma_chroma`; not cut to 0..1. Its luminance is `luma`, whatever the chroma."""
    red_weight, green_weight, blue_weight = REC601
    red, blue = chroma[..., 0:1, :, :], chroma[..., 1:2, :, :]
    green = -(red_weight * red + blue_weight * blue) / green_weight
    return torch.cat([red, green, blue], -3) + luma


def luminance_of(image: Float[Tensor, "_ h w"]) -> Float[Tensor, "_ h w"]:
    """The luminance of an RGB image; any other image itself."""
    return luminance(image) if image.shape[0] == 3 else image


def linear_from_srgb(values: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Linear light of sRGB-encoded values (IEC 61966-2-1); the straight part of the curve continues below zero."""
    toe = values <= 0.04045
    return torch.where(toe, values / 12.92, ((torch.where(toe, 0.5, values) + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(light: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """The sRGB encoding of linear light: the inverse of `linear_from_srgb`."""
    toe = light <= 0.04045 / 12.92
    return torch.where(toe, 12.92 * light, 1.055 * torch.where(toe, 0.5, light) ** (1 / 2.4) - 0.055)


def to_bytes(values: Float[Tensor, "*b"]) -> NDArray[np.uint8]:
    """Values 0..1, clipped, as 8-bit counts, rounded to nearest even."""
    return np.rint(np.clip(np.asarray(values.detach().cpu().numpy(), np.float32), 0, 1) * 255).astype(np.uint8)
