"""Colour by example: C3 attention of alpha to itself, over a wide window.

A region that no beta sees often has the texture of one that a beta sees. A pixel's query, and another's key,
is alpha around it at three sizes. The score falls with the squared distance of the two and with the distance
of the pixels, and rises with the confidence of the example. Nothing is trained. It is the non-local mean
(Buades et al. 2005) of colour, by the compiled attention: no patches are gathered. The result is smoothed
within regions that are similar in alpha, by attention to ever wider neighbourhoods.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad, pixel_unshuffle

from arraygeom import Local
from arraygeom.pixels import pixel_grid

from ..attention import attend
from ..media.filters import box_mean
from ..support.blocks import enlarge
from ..support.settings import size, tuned


@dataclass(frozen=True)
class RecallSettings:
    """Settings of filling in colour by example; pixels are of the half-size image, except for `last`.

    The functions read those in `SETTINGS`. `pat lab settings` prints the value of each with its meaning and
    reason.
    """

    scales: int = tuned(3, "Middlebury, tune half: sizes of what is around a pixel, radii 2, 4, 8")
    alike: float = tuned(
        0.04,
        "Middlebury, tune half: standard deviation of what is alike of means around in alpha, half of it "
        "of a pixel; and where smoothing's weight is 1 / e",
    )
    slope: float = tuned(0.1, "Middlebury, tune half: the same of slopes there")
    distance: float = tuned(10.0, "Middlebury, tune half: pixels at which the weight falls to 1 / e")
    certainty: int = tuned(3, "Middlebury, tune half: power of confidence, squared, that pixels count by")
    least_weight: float = size(1e-3, "The least weight of a pixel")
    side: int = size(17, "A pixel looks at so many in each row and column")
    spacing: int = size(6, "The distance of these, twice as much in a window of twice the size around that")
    rounds: tuple[int, ...] = size((1, 2, 4), "Spacings of smoothing what is filled in, at half the size")
    last: tuple[int, ...] = size((2, 1), "Spacings of smoothing what is doubtful in the end, at full size")


SETTINGS = RecallSettings()
FIELD = Local(2 * SETTINGS.side - 1, spacing=SETTINGS.spacing)


def by_example(
    alpha: Float[Tensor, "b 1 h w"], colour: Float[Tensor, "b c h w"], confidence: Float[Tensor, "b c h w"]
) -> Float[Tensor, "b c h w"]:
    """Fill in colour from pixels of known colour that look similar in alpha.

    Filled and known colour are smoothed together, guided by alpha: known colour is not kept as it is.

    Args:
        alpha: alpha's image; both sides even.
        colour: colour of each pixel, such as bands minus alpha; finite everywhere.
        confidence: confidence of each band, 0 to 1; examples count by their least band, at 0 not at all.

    Returns:
        Colour at all pixels, of the same shape; about 0 without examples in the window.

    Raises:
        RuntimeError: by torch, for odd sides.
    """
    return fitted(recalled(alpha, colour, confidence), alpha, colour, confidence)


def with_less_noise(
    alpha: Float[Tensor, "b 1 h w"], colour: Float[Tensor, "b c h w"], confidence: Float[Tensor, "b c h w"]
) -> Float[Tensor, "b c h w"]:
    """Smooth colour where it is uncertain: blend it with its mean over nearby pixels similar in alpha.

    Args:
        alpha: alpha's image.
        colour: colour of each pixel, such as bands minus alpha.
        confidence: confidence of each band's colour: 1 keeps it, 0 takes the mean, in which a pixel counts by
            the least of its bands.

    Returns:
        Colour of the same shape.
    """
    smooth = smoothed_within(alpha, colour, SETTINGS.last, confidence)
    return torch.lerp(smooth, colour, confidence)


def recalled(
    alpha: Float[Tensor, "b 1 h w"],
    colour: Float[Tensor, "b c h w"],
    confidence: Float[Tensor, "b c h w"],
) -> Float[Tensor, "b c h/2 w/2"]:
    """Average the colour of pixels of known colour that look similar in alpha, by attention over a window.

    Args:
        alpha: alpha's image; both sides even.
        colour: colour of each pixel, such as bands minus alpha.
        confidence: confidence of each band's colour, 0 to 1; a pixel counts by the least of its bands.

    Returns:
        Colour (B, C, H/2, W/2).
    """
    certain = confidence.amin(1, keepdim=True)
    weight, keys = avg_pool2d(certain, 2), surroundings(alpha)
    value = avg_pool2d(colour * certain, 2) / (weight + SETTINGS.least_weight)
    counts = (weight.square() + SETTINGS.least_weight).log() * SETTINGS.certainty
    scores = counts - keys.square().sum(1, keepdim=True) / 2
    query, key = torch.cat([keys, torch.ones_like(weight)], 1), torch.cat([keys, scores], 1)
    del keys
    return attend(query, key, value, FIELD, interpolation="nearest", bias=nearness().to(alpha))


def fitted(
    filled: Tensor,
    alpha: Float[Tensor, "b 1 h w"],
    colour: Float[Tensor, "b c h w"],
    confidence: Tensor,
) -> Float[Tensor, "b c h w"]:
    """Smooth filled colour together with confident colour, guided by alpha, and enlarge it.

    Args:
        filled: colour (B, C, H/2, W/2) to use where confidence is low.
        alpha: alpha's image; both sides even.
        colour: colour (B, C, H, W) to use where confidence is high.
        confidence: confidence of `colour`, (B, C or 1, H, W), 0 to 1.

    Returns:
        Colour (B, C, H, W).
    """
    certain = avg_pool2d(confidence, 2)
    together = filled * (1 - certain) + avg_pool2d(colour * confidence, 2)
    return enlarge(smoothed_within(alpha, together, SETTINGS.rounds))


def smoothed_within(
    alpha: Float[Tensor, "b 1 h w"], colour: Tensor, spacings: Sequence[int], confidence: Tensor | None = None
) -> Tensor:
    """Smooth colour by means over 5 x 5 samples, whose spacing is each of `spacings` in turn.

    A pixel counts the more, the more similar it is in alpha (Tomasi and Manduchi 1998) and the more certain.

    Args:
        alpha: alpha's image (B, 1, H, W).
        colour: colour (B, C, H, W), or at half the size.
        spacings: pixels of `colour` between a window's samples, for each pass.
        confidence: confidence at the size of `colour`, 0 to 1, of which the least channel counts; None counts
            all alike.

    Returns:
        Colour of the same shape.
    """
    scaled = alpha * (2**0.5 / SETTINGS.alike)
    pixels = pixel_unshuffle(scaled, alpha.shape[-1] // colour.shape[-1])
    scores = pixels.square().sum(1, keepdim=True) / -2
    if confidence is not None:
        scores = scores + (confidence.amin(1, keepdim=True) + SETTINGS.least_weight).log()
    query, key = torch.cat([pixels, torch.ones_like(scores)], 1), torch.cat([pixels, scores], 1)
    for spacing in spacings:
        colour = attend(query, key, colour, Local(5, spacing=spacing), interpolation="nearest")
    return colour


def nearness() -> Float[Tensor, " n"]:
    """Compute the score added to each pixel of the field: less the farther away it is, -inf for unused
    pixels."""
    steps = pixel_grid((FIELD.size,) * 2).flatten(0, 1) - FIELD.size // 2
    looked_at = (steps.abs().amax(-1) <= SETTINGS.side // 2) | (steps % 2 == 0).all(-1)
    return torch.where(looked_at, steps.norm(dim=-1) * (-SETTINGS.spacing / SETTINGS.distance), -torch.inf)


def surroundings(alpha: Float[Tensor, "b 1 h w"]) -> Float[Tensor, "b d h/2 w/2"]:
    """Compute keys that are near each other where alpha looks similar, at half the size.

    They hold alpha, its brightness around each pixel and the change of that to the right and downwards, at
    each radius (a local jet, Koenderink and van Doorn 1987).

    Returns:
        Keys (B, 1 + 3 `scales`, H/2, W/2), in units of the settings' deviations.
    """
    half = avg_pool2d(alpha - 0.5, 2)  # for small numbers, of which float32 has more digits
    parts, (h, w) = [half / (SETTINGS.alike / 2)], half.shape[-2:]
    for r in (2 << i for i in range(SETTINGS.scales)):
        square = box_mean(half, r)
        beside = pad(square, (r,) * 4, mode="replicate")
        across = beside[..., r : r + h, 2 * r :] - beside[..., r : r + h, :w]
        down = beside[..., 2 * r :, r : r + w] - beside[..., :h, r : r + w]
        parts += [box_mean(square, r) / SETTINGS.alike, across / SETTINGS.slope, down / SETTINGS.slope]
    return torch.cat(parts, 1)
