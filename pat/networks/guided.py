"""GuidedPAT: colour carried to alpha's view by matches, filled where no beta sees, guided by alpha.

Matching (`pat.matching`) gives the bands of each beta at its matches, the weight of each match, and fills for
the rest. This network joins several betas, adds a fill by attention of alpha to itself
(`pat.networks.recall`), and smooths doubtful pixels. Nothing of it is trained; the confidence and the depth
that come with an image are (`pat.matching.choice`).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from arraygeom.sampling import on_image

from ..matching.colour_transfer import LEAST
from ..matching.inputs import BetaMatches, Colours, Extent, Inputs, Matches, at_matches, match_positions
from ..media.colour import luminance
from ..support.blocks import enlarge
from .configs import GuidedPATConfig
from .protocol import FusionOutput, JoinsBands, required
from .recall import by_example, with_less_noise


class GuidedPAT(nn.Module):
    """Fusion network, without weights, that gives a mono alpha the bands of its betas, found by matching.

    With `config.bands` the image has that many bands: three filtered cameras give one each, or any number of
    RGB cameras all three; other betas help to find depth only. With `config.bands` None the image has all
    bands of all betas, in order, whatever their spectra; permuting betas permutes its bands.

    Raises:
        ValueError: for `keep_luminance` with another number of bands than three.
    """

    multiple = 16
    equal_resolution = True
    uses_matches = True
    halo = 288
    """Pixels: attention reaches 192, its keys 48 to either side, smoothing 34; a multiple of 16."""
    beta_halo = 16

    def __init__(self, config: GuidedPATConfig = GuidedPATConfig()) -> None:
        super().__init__()
        self.config = config
        self.bands, self.learned = config.bands, config.learned
        self.keeps_luminance = config.bands is not None and config.keep_luminance
        if self.keeps_luminance and self.bands != 3:
            raise ValueError(f"keep_luminance: {self.bands} bands have no Rec. 601 luminance: wanted bands 3")
        self.joins_bands: JoinsBands = "all" if config.bands is None else "neighbours"

    def working_bytes(self, alpha: int, betas: Sequence[int]) -> float:
        """Return the bytes of memory to fuse so many pixels of alpha, beside the inputs."""
        return alpha * (220.0 + 170.0 * max(len(betas) - 1, 0))

    def forward(self, inputs: Inputs, matches: Matches | None = None) -> FusionOutput:
        """Fuse alpha (B, 1, H, W), sides multiples of 16, with the betas, by their matches.

        Args:
            matches: result of `match(inputs)`; None raises.

        Returns:
            The image (B, C, H, W) in the betas' bands, not clipped. For each beta the position of the surface
            that alpha sees, its confidence (0 off the beta), and a deviation of 1 everywhere. `overall` is
            the largest confidence of the betas that have all `config.bands` bands, where there are several
            betas and such ones; else None.

        Raises:
            ValueError: as `required`; for matches without colours, fields that are not straight, and betas
                whose bands do not add up to the configured number, unless one of several has them all.
        """
        matches = required(matches, inputs)
        carried = [_as_alpha(m.carried, inputs.alpha) for m in matches.betas]
        overall = False
        if self.bands is None:
            parts = [self._any_bands(inputs.alpha, *one) for one in zip(carried, matches.betas)]
            image = torch.cat(parts, 1)
        else:
            image, overall = self._known_bands(inputs, carried, matches)
        del carried  # as much memory as what follows takes
        return _output_of(image, inputs, matches, overall=overall)

    def _known_bands(
        self, inputs: Inputs, carried: Sequence[Colours], matches: Matches
    ) -> tuple[Float[Tensor, "b c h w"], bool]:
        """Compute the image, with True if it is of betas, one of several or more, that have all bands."""
        alpha, wanted = inputs.alpha, self.bands
        bands = [one.bands.shape[1] for one in carried]
        parts = len(bands) == 1 or wanted not in bands
        if parts and sum(bands) != wanted:
            raise ValueError(f"the betas have {sum(bands)} bands in all, this network makes {wanted}")
        used = carried if parts else [combined([one for one, n in zip(carried, bands) if n == wanted])]
        residual = completed(alpha, used)
        if not inputs.sees_luma:
            residual = where_certain(residual, inputs, matches)
        if self.keeps_luminance:
            residual = residual - inputs.luminance * luminance(residual)
        return alpha + residual, not parts

    def _any_bands(
        self, alpha: Float[Tensor, "b 1 h w"], carried: Colours, matches: BetaMatches
    ) -> Float[Tensor, "b c h w"]:
        """Compute one beta's bands at alpha's view.

        Fills are of each band minus its local regression on alpha: where a band differs from alpha, its
        difference from alpha varies even between similar pixels.
        """
        base, mix = carried.fills[:, 0].to(alpha), matches.comparison.mix
        above = carried._replace(bands=carried.bands - base, fills=carried.fills.to(alpha) - base[:, None])
        image = alpha + base + completed(alpha, [above])
        return image if mix is None else mix.reconciled(image, alpha)


def completed(alpha: Float[Tensor, "b 1 h w"], carried: Sequence[Colours]) -> Float[Tensor, "b c h w"]:
    """Compute bands minus alpha at all pixels, from betas with different bands.

    Values from matches count by their weight. The rest is the mean of two fills from pixels of known colour:
    the nearest examples, and those similar in alpha by attention. The result is smoothed where weights are
    low.

    Args:
        alpha: alpha's image; both sides even.
        carried: bands minus alpha from the matches of each beta; one at least.

    Returns:
        Bands minus alpha, of all betas in order.
    """
    colour = _joined([one.bands for one in carried])
    weight = _joined([one.weight.expand_as(one.bands) for one in carried])
    nearest = _joined([one.fills[:, -1].to(colour) for one in carried])
    filled = (by_example(alpha, colour, weight) + nearest) / 2
    return with_less_noise(alpha, torch.lerp(filled, colour, weight), weight)


def _as_alpha(carried: Colours, alpha: Tensor) -> Colours:
    """Return colours in the type of alpha; a large frame's are kept in half precision."""
    bands, weight, likeness = (plane.to(alpha) for plane in carried[:3])
    return Colours(bands, weight, likeness, carried.fills)


def _joined(bands: Sequence[Tensor]) -> Tensor:
    return torch.cat(list(bands), 1) if len(bands) > 1 else bands[0]


def combined(carried: Sequence[Colours]) -> Colours:
    """Combine the colours of several betas of the same bands to colours of one.

    Returns:
        Means of bands, likeness and fills (the same fills if all share one tensor), weighted by the odds of
        each beta's weight; the largest weight. For a single beta its own.
    """
    if len(carried) == 1:
        return carried[0]
    odds = [c.weight.clamp(LEAST, 1 - LEAST).logit() for c in carried]
    shares = torch.stack(odds).softmax(0)

    def mean(parts: Sequence[Tensor]) -> Tensor:
        return (shares * torch.stack(list(parts))).sum(0)

    first = carried[0]
    shared = all(one.fills is first.fills for one in carried)
    fills = first.fills if shared else (shares[:, :, None] * torch.stack([c.fills for c in carried])).sum(0)
    weight = torch.stack([c.weight for c in carried]).amax(0)
    return Colours(mean([c.bands for c in carried]), weight, mean([c.likeness for c in carried]), fills)


def where_certain(
    residual: Float[Tensor, "b c h w"], inputs: Inputs, matches: Matches
) -> Float[Tensor, "b c h w"]:
    """Replace bands minus alpha by beta's at the position chosen among candidates, as far as it is certain.

    A chosen position counts fully where it is a pixel or more from the match, less where it is nearer:
    matches are often wrong if alpha sees another part of the spectrum.

    Args:
        residual: bands minus alpha.
        inputs: inputs of the fusion, with straight fields.
        matches: matches of all of their betas.

    Returns:
        Bands minus alpha; `residual` itself if no beta has all of the bands and a trained certainty.

    Raises:
        ValueError: for a field that is not straight, and another number of matches than betas.
    """
    weights, shown = [], []
    for beta, matched in zip(inputs.betas, matches.betas, strict=True):
        if beta.image.shape[1] == residual.shape[1] and matched.certainty is not None:
            values, valid = at_matches(beta.image, beta.field.straight, matched.surface)
            apart = (matched.surface - matched.disparity).abs().clamp(max=1)
            weights.append(enlarge(matched.certainty[:, :1]).to(residual) * valid * apart)
            shown.append(values - inputs.alpha)
    if not shown:
        return residual
    weight = torch.stack(weights)
    mean = (weight * torch.stack(shown)).sum(0) / (weight.sum(0) + LEAST)
    return torch.lerp(residual, mean, weight.amax(0))


def _output_of(
    image: Float[Tensor, "b c h w"], inputs: Inputs, matches: Matches, *, overall: bool
) -> FusionOutput:
    """Return the image with the position in each beta, its deviation, and its confidence."""
    position, deviation, confidence = [], [], []
    for beta, matched in zip(inputs.betas, matches.betas):
        segments = beta.field.straight
        extent = Extent.from_segments(segments)
        there = match_positions(segments, matched.surface, beyond_edge=True, extent=extent)
        position.append(there.movedim(-1, 1))
        within = match_positions(segments, matched.surface, extent=extent)
        seen = segments.valid & on_image(within, (beta.image.shape[-2], beta.image.shape[-1]))
        confidence.append(matched.confidence[:, 0].to(image) * seen)
        deviation.append(torch.ones_like(confidence[-1]))
    output = FusionOutput(image, position, deviation, confidence)
    return output.with_overall(inputs.betas) if overall else output
