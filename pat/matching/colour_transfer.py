"""Beta's bands at alpha's view, by the matches: as bright as alpha, with its detail, and diffused to where they are not
seen."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d

from arraygeom import Segments
from arraygeom.fields.protocol import compilable
from arraygeom.sampling import on_image, sample
from arraygeom.threads import in_parallel

from ..media.colour import to_bytes
from . import semi_global_numba as kernels
from .semi_global import CONSISTENT, Extent, Normalisation, enlarged, matches, numpy_of, smoothed

LIKENESS = 0.08
"""Difference of brightness at which the weight of a match falls to 1 / e."""
INCONSISTENT = 0.25
"""Weight of a match that is not consistent, before the likeness."""
COLOUR_FILL = (300.0, 3.0)
"""Strength, and 8-bit difference that counts as an edge, of the smoothing that diffuses colour (Min et al. 2014)."""
FLOOR = 1e-3
"""Regulariser (variance of brightness) of the regression of colour on brightness where colour is diffused."""
FILLS = 2
"""Ways in which colour is diffused: along its regression on brightness, and as it is."""
SURROUNDINGS, SATURATION = 24, 0.6
"""Within how many pixels the brightness of both views is compared, and the power of its ratio by which colour grows."""
MOST_BRIGHTER = 2.0
"""Matched surroundings whose brightness differs by a larger factor are of different things."""
DETAIL_RADIUS, DETAIL_FLOOR = 2, 1e-4
"""Window and regulariser of the regression that gives matched colour the detail that beta lost."""
RADIUS_OF_BLUR = 1.5
"""The window's radius for each pixel of standard deviation by which beta is less sharp than alpha: within a smaller
window beta shows one value. Chosen on Middlebury's pairs of the tune half, reduced 4 and 8 times."""
SATURATED = 0.15
"""Where brightness explains no colour, colour differences grow with brightness by this part of their ratio to it."""
NOISE_SHARE, TEXTURE_SHARE, LOWEST = 20.0, 0.6, 0.1
"""Variance of colour's noise, of all bands, over that of what the views' brightness differs by beyond this share of
texture, where there is least of either: at this quantile. Chosen on SYNTIM and Middlebury pairs of the tune half."""
LEAST_NOISE = 2e-5
"""Less variance than this, two thirds of a level of 8 bits in each band, is left: taking it out takes time."""
MOST_DETAIL = 0.2
"""Differences of brightness beyond this are no detail that beta lost."""


def matched_colours(
    alpha: Float[Tensor, "b 1 h w"],
    guide: Float[Tensor, "b 1 hb wb"],
    beta: Float[Tensor, "b c hb wb"],
    segments: Segments,
    disparity: Float[Tensor, "b 1 h w"],
    facts: Float[Tensor, "b 3 h2 w2"],
    normalisation: Normalisation,
) -> tuple[Float[Tensor, "b c h w"], Float[Tensor, "b 1 h w"]]:
    """Beta's bands minus alpha at the matches, colour as in alpha's light, with the detail that alpha has and beta has
    not; their weight, 0 to 1."""
    bands = beta.shape[1]
    seen, valid = at_matches(torch.cat([beta, guide, normalisation.normalised(guide)], 1), segments, disparity)
    values, own, brightness = seen.split([bands, 1, 1], 1)
    consistent = is_consistent(facts)
    brightness = normalised_at_matches(brightness, alpha, valid * consistent)
    soft = normalisation.softened(alpha)
    weight = match_weight(brightness - soft, consistent, valid)
    if bands > 1:
        colour, bright = _scaled_to_alpha(values - own, own, alpha, weight)
        noise = colour_noise(brightness - soft, soft, weight * consistent)
        colour = _without_noise(colour, bright, noise) if float(noise.amax()) > LEAST_NOISE else colour
        radii = [max(DETAIL_RADIUS, round(RADIUS_OF_BLUR * blur)) for blur in normalisation.blurs[0]]
        detailed = _each_detailed(colour, bright, alpha, radii)
        matched = torch.lerp(colour, detailed, explained_share(own, soft, valid * consistent)) + own - alpha
    else:
        matched = _detailed(values, soft, alpha) - alpha
    return matched, weight


def _scaled_to_alpha(colour: Tensor, brightness: Tensor, alpha: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Colour differences (B, C, H, W) and brightness of beta, larger where alpha is brighter around a pixel.

    What a lens or the light makes brighter keeps its saturation, a reflection does not: the power is in between.
    """
    least = 1e-3
    own, other = (box_mean(image * weight, SURROUNDINGS) + least for image in (alpha, brightness))
    ratio = (own / other.clamp(min=least)).clamp(1 / MOST_BRIGHTER, MOST_BRIGHTER)
    return colour * ratio**SATURATION, brightness * ratio


def at_matches(
    beta: Float[Tensor, "b c hb wb"],
    segments: Segments,
    disparity: Float[Tensor, "b 1 _ _"],
    extent: Extent | None = None,
) -> tuple[Float[Tensor, "b c h w"], Bool[Tensor, "b 1 h w"]]:
    """What beta shows at the matches, at its edge where these are beyond it, and where they are not."""
    hw, middle = (beta.shape[-2], beta.shape[-1]), matches(segments, disparity, extent=extent).to(beta)
    position = middle.reshape(len(beta), -1, 2)
    inside = position.clamp(min=0).minimum(position.new_tensor([hw[1] - 1, hw[0] - 1]))
    values = sample(beta, inside, interpolation="bicubic").values
    return values.reshape(*beta.shape[:2], *middle.shape[1:3]), on_image(middle, hw)[:, None]


def is_consistent(facts: Float[Tensor, "b 3 h2 w2"]) -> Float[Tensor, "b 1 h w"]:
    """1 where the match is consistent."""
    return enlarged((facts[:, :1] < CONSISTENT).to(facts))


def match_weight(unlike: Float[Tensor, "b 1 h w"], consistent: Tensor, valid: Tensor) -> Float[Tensor, "b 1 h w"]:
    """The weight of a match whose brightness differs from alpha's by `unlike`; always more than 0."""
    return (INCONSISTENT + (1 - INCONSISTENT) * consistent) * valid * likeness(unlike, LIKENESS) + 1e-4


def likeness(unlike: Float[Tensor, "b 1 h w"], scale: float) -> Float[Tensor, "b 1 h w"]:
    """1 where two images have the same brightness around a pixel, 1 / e where they differ by `scale` there."""
    unlike = avg_pool2d(unlike.abs(), 3, 1, 1, count_include_pad=False)
    return torch.exp(-(unlike / scale).square())


def diffused_from(
    matched: Float[Tensor, "b c h w"], alpha: Float[Tensor, "b 1 h w"], weight: Float[Tensor, "b 1 h w"]
) -> Float[Tensor, "b fills c h w"]:
    """Bands diffused by weight over what is connected in alpha, in each of the `FILLS` ways."""
    planes = zip(numpy_of(matched), numpy_of(alpha[:, 0]), numpy_of(weight[:, 0]), to_bytes(alpha[:, 0]))
    return torch.from_numpy(np.stack([_diffused(*one) for one in planes])).to(alpha)


def normalised_at_matches(
    image: Float[Tensor, "b 1 h w"], like: Float[Tensor, "b 1 h w"], weight: Float[Tensor, "b 1 h w"]
) -> Float[Tensor, "b 1 h w"]:
    """The image with another's mean and standard deviation, where the weight is; both show the same point at a pixel.

    Statistics of whole images mean little where these show different parts of a scene.
    """
    weight = (weight + 1e-6) / (weight + 1e-6).sum((2, 3), keepdim=True)
    means = [(weight * p).sum((2, 3), keepdim=True) for p in (image, like)]
    deviation, wanted = (
        (weight * (p - m).square()).sum((2, 3), keepdim=True).sqrt() for p, m in zip((image, like), means)
    )
    return (image - means[0]) * (wanted / deviation.clamp(min=1e-3)).clamp(max=4) + means[1]


@torch.no_grad()
def colour_noise(
    unlike: Float[Tensor, "b 1 h w"], texture: Float[Tensor, "b 1 h w"], weight: Float[Tensor, "b 1 h w"]
) -> Float[Tensor, "b 1 1 1"]:
    """The variance of noise in colour at the matches, of all bands, from the difference of brightness (`unlike`): what
    of it is fine, beyond what sampling changes of fine texture."""
    parts = torch.cat([unlike, texture], 1)
    fine = box_mean((parts - box_mean(parts, DETAIL_RADIUS)).square(), DETAIL_RADIUS)
    fine = torch.where(weight > 0.5, fine, torch.nan)[..., ::4, ::4].flatten(2)
    least, of_texture = fine.nanquantile(LOWEST, 2).nan_to_num(0.0).split(1, 1)
    return (NOISE_SHARE * (least - TEXTURE_SHARE * of_texture)).clamp(min=0)[..., None, None]


def _without_noise(colour: Tensor, brightness: Tensor, noise: Tensor) -> Tensor:
    """Colour (B, C, H, W) nearer to its local regression on brightness, the more of what is beside it is noise (Lee
    1980)."""
    mean = partial(box_mean, radius=DETAIL_RADIUS)
    middle, centre = mean(brightness), mean(colour)
    common = mean(colour * brightness) - centre * middle
    slope = common / ((mean(brightness.square()) - middle.square()).clamp(min=0) + DETAIL_FLOOR)
    fitted = centre + slope * (brightness - middle)
    rest = (mean(colour.square()) - centre.square() - slope * common).sum(1, keepdim=True).clamp(min=0)
    return torch.lerp(fitted, colour, (rest - noise).clamp(min=0) / (rest + 1e-9))


def _each_detailed(colour: Tensor, brightness: Tensor, alpha: Tensor, radii: Sequence[int]) -> Tensor:
    """`_detailed`, each of the batch with its own radius, and colour that brightness does not explain as saturated."""
    radii = [radii[0]] if len(set(radii)) == 1 else radii
    parts = zip(*(x.tensor_split(len(radii)) for x in (colour, brightness, alpha)), radii)
    return torch.cat([_detailed(c, b, a, SATURATED, radius) for c, b, a, radius in parts])


def _detailed(
    colour: Tensor, brightness: Tensor, alpha: Tensor, saturated: float = 0.0, radius: int = DETAIL_RADIUS
) -> Tensor:
    """Colour (B, C, H, W) moved along its local regression on brightness by what alpha's brightness has beyond it."""
    detail = (alpha - brightness).clamp(-MOST_DETAIL, MOST_DETAIL)
    return colour + local_slope(colour, brightness, saturated, radius) * detail


def local_slope(
    colour: Float[Tensor, "b c h w"],
    brightness: Float[Tensor, "b 1 h w"],
    saturated: float = 0.0,
    radius: int = DETAIL_RADIUS,
) -> Float[Tensor, "b c h w"]:
    """The slope of the regression of colour on brightness around each pixel.

    The guided filter's linear model (He et al. 2013): it gives back the detail that beta lost by its resolution. The
    less of colour's variance the regression explains, the nearer is the slope to that of `saturated` times the
    saturation: few of a window's pixels are independent, so that even noise seems to be explained in part.
    """
    mean = partial(box_mean, radius=radius)
    middle, centre = mean(brightness), mean(colour)
    variance = (mean(brightness.square()) - middle.square()).clamp(min=0)
    variation = (mean(colour.square()) - centre.square()).clamp(min=0)
    common = mean(colour * brightness) - centre * middle
    explained = (common.square() / ((variance + 1e-6) * (variation + 1e-6))).clamp(max=1) ** 3
    otherwise = saturated * centre / middle.clamp(min=0.05)
    return torch.lerp(otherwise, common / (variance + DETAIL_FLOOR), explained)


def _diffused(
    colour: NDArray,
    brightness: NDArray,
    weight: NDArray,
    guide: NDArray[np.uint8],
    how: tuple[float, float] = COLOUR_FILL,
) -> NDArray[np.float32]:
    """Colour (c, h, w) over what is connected in the guide, (fills, c, h, w): by its weighted regression on brightness
    (h, w), and as it is.

    The moments of the guided filter (He et al. 2013), diffused instead of averaged over a window: what no beta sees
    has colour that varies with brightness as it does nearby.
    """
    totals = smoothed([weight * p for p in (1, brightness, brightness**2, *colour)], guide, how)
    products = smoothed([weight * brightness * p for p in colour], guide, how)
    out = np.empty((FILLS, *colour.shape), np.float32)
    planes = zip(totals[3:], products, *out)
    in_parallel([partial(kernels.regression, brightness, *totals[:3], c, p, FLOOR, *o) for c, p, *o in planes])
    return out


def explained_share(
    image: Float[Tensor, "b 1 h w"], of: Float[Tensor, "b 1 h w"], weight: Float[Tensor, "b 1 h w"]
) -> Float[Tensor, "b 1 1 1"]:
    """The share of one image's variance that another explains where the weight is, 0 if one is the other's negative.

    Small for an alpha in the near infrared: its detail says little of visible colours.
    """
    share = (weight + 1e-6) / (weight + 1e-6).sum((2, 3), keepdim=True)
    a, b = (p - (share * p).sum((2, 3), keepdim=True) for p in (image, of))
    common, one, other = ((share * p).sum((2, 3), keepdim=True) for p in (a * b, a * a, b * b))
    return common.clamp(min=0).square() / (one * other + 1e-9)


def box_mean(x: Tensor, radius: int) -> Tensor:
    """Over squares around each pixel, as far as these are on the image."""
    side = 2 * radius + 1
    if compilable(x) and not x.requires_grad:
        return _box_mean_of_numbers(x, radius)
    rows = avg_pool2d(x, (side, 1), 1, (radius, 0), count_include_pad=False)
    return avg_pool2d(rows, (1, side), 1, (0, radius), count_include_pad=False)


def _box_mean_of_numbers(x: Tensor, radius: int) -> Tensor:
    """The same by OpenCV's running sums: a third of the time."""
    planes = x.detach().contiguous().flatten(0, -3).numpy()
    counts = [np.minimum(np.arange(n), radius) + np.minimum(np.arange(n)[::-1], radius) + 1 for n in planes.shape[1:]]
    share = (1 / (counts[0][:, None] * counts[1])).astype(planes.dtype)
    out = np.empty_like(planes)
    for plane, target in zip(planes, out):
        sums = cv2.boxFilter(plane, -1, (2 * radius + 1,) * 2, normalize=False, borderType=cv2.BORDER_CONSTANT)
        np.multiply(sums, share, out=target)
    return torch.from_numpy(out).view(x.shape)
