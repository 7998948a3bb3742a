"""Colour put right by what betas recorded: iterative back-projection (Irani and Peleg 1991), one step.

A beta of fewer pixels records means over several of alpha's. Of the fused image it would have recorded,
too: what its image has more, within small neighbourhoods, is detail that the image lacks; and beta's noise,
the more likely the less detail alpha shows there.
"""

from __future__ import annotations

import math
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from arraygeom import pixel_grid, sample

from ..matching.inputs import Beta, Inputs
from ..matching.matches import Matches
from ..matching.positions import matches
from ..media.colour import luminance
from ..networks.protocol import FusionOutput

RADIUS = 1
"""Size: beta's own pixels around each whose mean is left as it is: views differ in colour."""


def back_projected(
    output: FusionOutput, matched: Matches, inputs: Inputs, *, keeps_luminance: bool
) -> FusionOutput:
    """The output with the colour that betas of fewer pixels recorded.

    What alpha sees stays as it was: luminance, or the combination of a beta's bands that matching found.
    The image is compared where its colour is from: at the matches, not what was chosen for depth. Of betas
    with all bands of the image, or each the next ones of it. All of what is missing is added where alpha has
    many more pixels, nothing where it has as many.
    """
    bands, image = [beta.image.shape[1] for beta in inputs.betas], output.image
    in_turn = sum(bands) == image.shape[1]
    change, weight, first = torch.zeros_like(image), torch.zeros_like(image), 0
    for beta, of_beta, count, confidence in zip(inputs.betas, matched.betas, bands, output.confidence):
        shown = slice(first, first + count) if in_turn else slice(None)
        first += count
        if min(beta.enlargement) > 1 and (in_turn or count == image.shape[1]):
            position = matches(beta.field.straight, of_beta.disparity).movedim(-1, 1)
            lacks = missing(image[:, shown], inputs.alpha, position.to(image), confidence[:, None], beta)
            lacks = (1 - 1 / math.sqrt(math.prod(beta.enlargement))) * lacks
            if of_beta.comparison.mix is not None and not keeps_luminance:
                alpha = of_beta.comparison.mix.of(image[:, shown])
                lacks = of_beta.comparison.mix.reconciled(image[:, shown] + lacks, alpha) - image[:, shown]
            change[:, shown] = change[:, shown] + lacks
            weight[:, shown] = weight[:, shown] + confidence[:, None]
    change = change / weight.clamp(min=1)
    return output._replace(image=image + (change - luminance(change) if keeps_luminance else change))


def missing(
    image: Float[Tensor, "b c h w"],
    alpha: Float[Tensor, "b 1 h w"],
    position: Float[Tensor, "b 2 h w"],
    confidence: Float[Tensor, "b 1 h w"],
    beta: Beta,
) -> Float[Tensor, "b c h w"]:
    """What `beta` shows more than it would record of an image, where its pixels are matched, by confidence,
    and by the share of alpha's variance there in both.

    `position` is in pixels of the beta's image, which is enlarged from fewer.
    """
    scale = position.new_tensor(beta.enlargement[::-1])
    hw = beta.image.shape[-2:]
    # The first pixel of the image within the first of those that it is enlarged from, all counted from there.
    first = (position.new_tensor(beta.offset) / scale).floor()
    begin = position.new_tensor(beta.offset) - first * scale
    width, height = ((begin + position.new_tensor(hw[::-1])) / scale).ceil().int().tolist()
    corner = (position + begin[:, None, None]).movedim(1, -1)
    recorded, share = _recorded(torch.cat([image, alpha], 1), corner, confidence, scale, (height, width))
    recorded, grey = recorded[:, :-1], recorded[:, -1:]
    shown = _before_enlargement(beta.image, begin, scale, (height, width))
    covered = (share / scale.prod()).clamp(max=1)
    rest = (shown - recorded) * (share > 0)
    around = partial(_around, weight=covered)
    rest, detail = rest - around(rest), grey - around(grey)
    power, own = around(rest.square()), around(detail.square())
    rest = rest * own / (own + power).clamp(min=1e-12) * covered
    return _at(rest, (corner + 0.5) / scale - 0.5) * confidence


def _around(x: Float[Tensor, "b c h w"], weight: Float[Tensor, "b 1 h w"]) -> Float[Tensor, "b c h w"]:
    """The mean of the neighbourhood of each pixel."""
    side = 2 * RADIUS + 1
    mean = avg_pool2d(torch.cat([x * weight, weight], 1), side, 1, RADIUS)
    return mean[:, :-1] / mean[:, -1:].clamp(min=1e-6)


def _recorded(
    image: Float[Tensor, "b c h w"],
    corner: Float[Tensor, "b h w 2"],
    weight: Float[Tensor, "b 1 h w"],
    scale: Float[Tensor, "2"],
    hw: tuple[int, int],
) -> tuple[Float[Tensor, "b c hb wb"], Float[Tensor, "b 1 hb wb"]]:
    """Means of the image over pixels of `scale` by `scale`, of its own ones with corners there; weights."""
    planes = torch.cat([image * weight, weight], 1).flatten(2)
    cell = (corner / scale).floor()
    beyond = (corner + 1 - (cell + 1) * scale).clamp(min=0)
    total = planes.new_zeros(len(planes), planes.shape[1], (hw[0] + 2) * (hw[1] + 2))
    limits = cell.new_tensor([hw[1], hw[0]])
    for right in (0, 1):
        for below in (0, 1):
            step = cell.new_tensor([right, below])
            share = (beyond if right else 1 - beyond)[..., 0] * (beyond if below else 1 - beyond)[..., 1]
            x, y = ((cell + step).clamp(min=-1).minimum(limits) + 1).long().unbind(-1)
            index = (y * (hw[1] + 2) + x).flatten(1)[:, None].expand_as(planes)
            total = total.scatter_add(2, index, planes * share.flatten(1)[:, None])
    total = total.unflatten(2, (hw[0] + 2, hw[1] + 2))[..., 1:-1, 1:-1]
    return total[:, :-1] / total[:, -1:].clamp(min=1e-6), total[:, -1:]


def _before_enlargement(
    image: Float[Tensor, "b c h w"], begin: Float[Tensor, "2"], scale: Float[Tensor, "2"], hw: tuple[int, int]
) -> Float[Tensor, "b c hb wb"]:
    """The pixels from which an image was enlarged by cubic interpolation, to second order."""
    h, w = image.shape[-2:]
    pixels = pixel_grid(hw, dtype=image.dtype, device=image.device)[None]
    centres = (pixels + 0.5) * scale - 0.5 - begin
    rough = _at(image, centres)
    again = _at(
        _at(
            rough,
            (pixel_grid((h, w), dtype=image.dtype, device=image.device)[None] + begin + 0.5) / scale - 0.5,
        ),
        centres,
    )
    return 2 * rough - again


def _at(image: Float[Tensor, "b c h w"], x: Float[Tensor, "_ m n 2"]) -> Float[Tensor, "b c m n"]:
    """The image at positions (x, y), by cubic interpolation, the nearest values outside it."""
    x = x.clamp(min=-0.5).minimum(x.new_tensor([image.shape[-1] - 0.5, image.shape[-2] - 0.5]))
    return sample(image, x, interpolation="bicubic").values
