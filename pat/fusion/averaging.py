"""Means over pixels with alike surroundings: non-local means (Buades et al. 2005) guided by another image.

What a network makes of noisy views still has some of their noise. Pixels that are alike in its image are
averaged in it, and then what betas recorded there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom.chunks import spans
from arraygeom.threads import in_parallel

from ..attention.kernels import compiled, separate_cache
from ..media.colour import from_luma_chroma, luminance
from ..support.settings import size, tuned


@dataclass(frozen=True)
class AveragingSettings:
    """Of means over pixels that are alike."""

    own: tuple[float, int, float] = tuned(
        (0.22, 6, 2.0),
        "Middlebury, tune half: colour is averaged by itself first: the scale of unlikeness over the root "
        "of the noise's standard deviation, how far away pixels are, "
        "and how much more luma counts than a colour difference",
    )
    recorded: tuple[float, int, float, float] = tuned(
        (0.11, 16, 1.25, 0.75),
        "Middlebury, tune half: colour is averaged as beta recorded it then: the same, "
        "and how much of it is taken where enough is alike",
    )
    rows: int = size(16, "Rows that a thread works on at once: what it sums stays in its cache")


SETTINGS = AveragingSettings()
OWN, RECORDED, ROWS = SETTINGS.own, SETTINGS.recorded, SETTINGS.rows


def averaged_with_alike(
    image: Float[Tensor, "3 h w"],
    beta: Float[Tensor, "3 h w"],
    confidence: Float[Tensor, "1 h w"],
    deviation: float,
) -> Float[Tensor, "3 h w"]:
    """An image with the mean colour of what is alike near each pixel: of its own, and of beta's recorded.

    Luma stays. `beta` are its values at alpha's pixels, to be used as far as `confidence` says, with noise of
    this standard deviation in the mean.
    """
    luma, counts, root = luminance(image), confidence.square(), deviation**0.5
    colour = (image - luma)[[0, 2]]
    scale, radius, detail = OWN
    sums, weight = sums_of_alike(torch.cat([colour, detail * luma]), colour, scale * root, radius)
    colour = sums / weight
    scale, radius, detail, share = RECORDED
    recorded = (beta - luminance(beta))[[0, 2]]
    values = torch.cat([recorded * counts, counts])
    sums, _ = sums_of_alike(torch.cat([colour, detail * luma]), values, scale * root, radius, step=2)
    enough = share * sums[2:] / (sums[2:] + 1)
    return from_luma_chroma(luma, torch.lerp(colour, sums[:2] / (sums[2:] + 1e-6), enough))


def sums_of_alike(
    guide: Float[Tensor, "c h w"], values: Float[Tensor, "k h w"], scale: float, radius: int, step: int = 1
) -> tuple[Float[Tensor, "k h w"], Float[Tensor, "1 h w"]]:
    """For each pixel the weighted sums of the values at pixels around it, and of the weights.

    The weight is about exp(-d / scale^2), where d is the mean square difference of the guide's 3 x 3 patches
    around both. The pixels are those at most `radius` rows and columns away, every `step`-th of them; beyond
    the edges images are mirrored. All in float32 on the CPU, on as many threads as torch may use; back on the
    values' device.
    """
    h, w = guide.shape[-2:]
    around = radius + 1
    mirrored = [(0, 0), (around, around), (around, around)]
    planes = [
        np.pad(image.detach().float().cpu().numpy(), mirrored, mode="reflect") for image in (guide, values)
    ]
    out = np.zeros((len(values) + 1, h, w), np.float32)
    sharpness = np.float32(1 / (8 * 9 * len(guide) * scale**2))

    def rows(top: int, bottom: int) -> None:
        add_alike(*planes, around, radius, step, sharpness, top, out[:, top:bottom])

    in_parallel([partial(rows, *span) for span in spans(h, ROWS)])
    sums = torch.from_numpy(out).to(values)
    return sums[:-1], sums[-1:]


@compiled(nogil=True, cache=True, fastmath=True)
def add_alike(guide, values, around, radius, step, sharpness, top, out):
    """Add to `out` (k + 1, rows, w), from row `top`: the weighted values, and the weights.

    The weight is (1 - d / 8)^8, or 0 where d is over 8, in place of the exponential.
    """
    channels, bands = len(guide), len(values)
    rows, width = out.shape[1:]
    difference = np.zeros((3, width + 2), np.float32)
    weight = np.zeros(width, np.float32)
    first = around - 1
    for dy in range(-radius, radius + 1, step):
        for dx in range(-radius, radius + 1, step):
            for y in range(-1, rows + 1):
                row = difference[y % 3]
                row[:] = 0
                for c in range(channels):
                    own = guide[c, around + top + y, first : first + width + 2]
                    other = guide[c, around + top + y + dy, first + dx : first + dx + width + 2]
                    for x in range(width + 2):
                        row[x] += (other[x] - own[x]) ** 2
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
                    seen = values[k, around + top + y - 1 + dy, around + dx : around + dx + width]
                    for x in range(width):
                        out[k, y - 1, x] += weight[x] * seen[x]
                for x in range(width):
                    out[bands, y - 1, x] += weight[x]


separate_cache(add_alike)
