"""Means over pixels with similar surroundings: non-local means (Buades et al. 2005) of two images' colours.

A network's image of noisy views still has some of their noise. Pixels that are similar in it are averaged:
its own colours there, and those that betas recorded.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom.runtime.chunks import spans
from arraygeom.runtime.compiled import compiled
from arraygeom.runtime.threads import in_parallel

from ..media.colour import from_luma_chroma, luminance
from ..support.settings import size, tuned


@dataclass(frozen=True)
class NonLocalMeansSettings:
    """Settings of means over similar pixels.

    `pat lab settings` prints the value of each with its meaning and reason.
    """

    scale: float = tuned(
        0.18, "Middlebury, tune half: scale of unlikeness over the root of the noise's deviation"
    )
    radius: int = size(8, "How far away pixels are, rows and columns")
    rows: int = size(16, "Rows that a thread works on at once: what it sums stays in its cache")


SETTINGS = NonLocalMeansSettings()


def averaged_with_alike(
    image: Float[Tensor, "3 h w"],
    beta: Float[Tensor, "3 h w"],
    confidence: Float[Tensor, "1 h w"],
    deviation: float,
) -> Float[Tensor, "3 h w"]:
    """Replace an image's chroma by the mean over similar pixels nearby, of its own and of beta's chroma.

    Luma stays. Similarity is that of the image's 3 x 3 patches.

    Args:
        image: RGB image, values 0..1.
        confidence: confidence of beta's values, 0 to 1.
        beta: beta's values at alpha's pixels, which count as much as the image's own where `confidence` is 1.
        deviation: mean standard deviation of beta's noise, above 0.

    Returns:
        The image with this chroma, not clipped; the chroma is detached.
    """
    luma, counts = luminance(image), confidence.square()
    image_chroma, beta_chroma = ((colours - luminance(colours))[[0, 2]] for colours in (image, beta))
    values = torch.cat([image_chroma + counts * beta_chroma, 1 + counts])
    sums = sums_of_alike(image, values, SETTINGS.scale * deviation**0.5, SETTINGS.radius)
    return from_luma_chroma(luma, sums[:2] / sums[2:])


def sums_of_alike(
    guide: Float[Tensor, "c h w"], values: Float[Tensor, "k h w"], scale: float, radius: int
) -> Float[Tensor, "k h w"]:
    """Compute for each pixel the weighted sums of the values at pixels up to `radius` rows and columns away.

    The weight is about exp(-d / scale^2), with a scale above 0, where d is the mean square difference of the
    guide's 3 x 3 patches around both; that of the pixel itself is 1. Beyond the edges images are mirrored.
    Computed in float32 on the CPU, on as many threads as torch may use.

    Returns:
        Sums in the values' type and on their device, detached.
    """
    h, w = guide.shape[-2:]
    around = radius + 1
    mirrored = [(0, 0), (around, around), (around, around)]
    planes = [np.pad(x.detach().float().cpu().numpy(), mirrored, mode="reflect") for x in (guide, values)]
    out = np.zeros((len(values), h, w), np.float32)
    sharpness = np.float32(1 / (8 * 9 * len(guide) * scale**2))

    def rows(top: int, bottom: int) -> None:
        add_alike(*planes, radius, sharpness, top, out[:, top:bottom])

    in_parallel([partial(rows, *span) for span in spans(h, SETTINGS.rows)])
    return torch.from_numpy(out).to(values)


@compiled(nogil=True, cache=True, fastmath=True)
def add_alike(guide, values, radius, sharpness, top, out):
    """Add the weighted values of the pixels around each pixel, for some rows (see `sums_of_alike`).

    The weight is (1 - d / 8)^8, or 0 where d is over 8, in place of the exponential exp(-d).

    Args:
        guide: image (c, h + 2 p, w + 2 p), padded by p = radius + 1, whose 3 x 3 patches are compared.
        values: values (k, h + 2 p, w + 2 p), padded alike.
        radius: rows and columns to either side.
        sharpness: factor from a sum of squared differences of two patches to d / 8.
        top: first row.
        out: sums (k, rows, w) to add to.
    """
    around = radius + 1
    bands, rows, width = out.shape
    difference = np.zeros((3, width + 2), np.float32)
    weight = np.zeros(width, np.float32)
    for dy in range(-radius, radius + 1):
        for dx in range(-radius, radius + 1):
            for y in range(-1, rows + 1):
                row = difference[y % 3]
                row[:] = 0
                for c in range(len(guide)):
                    guide_row = guide[c, around + top + y, radius : radius + width + 2]
                    shifted_row = guide[c, around + top + y + dy, radius + dx : radius + dx + width + 2]
                    for x in range(width + 2):
                        row[x] += (shifted_row[x] - guide_row[x]) ** 2
                if y < 1:
                    continue
                a, b, c0 = difference[0], difference[1], difference[2]
                for x in range(width):
                    d = (
                        a[x]
                        + a[x + 1]
                        + a[x + 2]
                        + b[x]
                        + b[x + 1]
                        + b[x + 2]
                        + c0[x]
                        + c0[x + 1]
                        + c0[x + 2]
                    )
                    t = max(np.float32(1) - d * sharpness, np.float32(0))
                    t *= t
                    t *= t
                    weight[x] = t * t
                for k in range(bands):
                    values_row = values[k, around + top + y - 1 + dy, around + dx : around + dx + width]
                    for x in range(width):
                        out[k, y - 1, x] += weight[x] * values_row[x]
