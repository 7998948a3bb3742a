"""GuidedPAT: C3 attention from coarse to fine, colour guided by alpha.

Our own network, for one alpha whose detail is to be preserved and betas that have colour. Matching
(`pat.matching`) has found each pixel's position along its segment; attention samples a short window around it
at full size. The network estimates the confidence that the match is the point that alpha sees, propagates
colour from pixels of high confidence to the others, by likeness and by example (`recall`), and adds it to
alpha.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, pad, pixel_shuffle, pixel_unshuffle

from arraygeom import Local, Segments

from ..attention import attend, attend_with_statistics
from ..matching.colour_transfer import FILLS
from ..matching.inputs import Beta, Inputs
from ..matching.likeness import likeness
from ..matching.matches import BetaMatches, Matches
from ..matching.positions import FINE, Extent, at_matches, matches
from ..media.colour import luminance
from ..support.blocks import ResidualBlock, UNet, channels_last, conv, enlarge, stacked
from ..support.settings import size, tuned
from .completion import Completion
from .configs import GuidedPATConfig
from .protocol import FusionOutput, JoinsBands, required
from .recall import by_example, fitted, with_examples, with_less_noise


@dataclass(frozen=True)
class GuidedSettings:
    """Of what is done with the network's answers."""

    coarse: int = size(4, "Context is computed at this part of the size")
    least_weight: float = size(1e-3, "The least weight of a pixel in propagation")
    alike: float = tuned(
        2.0,
        "Middlebury, tune half: added to confidence's logit where beta is as bright, when colour is blended; "
        "and the power of likeness by which each of several betas counts",
    )
    nowhere: float = size(-30.0, "The logit of the confidence where there is no valid segment")


SETTINGS = GuidedSettings()


class BetaEstimate(NamedTuple):
    """The colour of alpha's view according to one beta.

    attended: (B, 2, H, W), position, deviation: (B, H, W), and peak: (B, H, W), as of `Attended`.
    colour: (B, C, H, W), its bands minus alpha, attended and matched, mixed.
    diffused: (B, fills, C, H, W), the same diffused within alpha from pixels of high weight.
    logit: (B, 1, H, W), of the confidence that `colour` is of the point that alpha sees.
    choice: (B, 1 + fills, H, W), logits of the alternatives where it is not: propagated, or each of
        `diffused`.
    position: (B, 2, H, W), the semi-global match in beta, pixels; beyond beta's edge where the segment is cut
        there.
    likeness: (B, 1, H, W), of alpha's brightness and that attended in beta, 0 to 1; 1 if alpha sees something
        else.
    """

    attended: Tensor
    deviation: Tensor
    peak: Tensor
    colour: Tensor
    diffused: Tensor
    logit: Tensor
    choice: Tensor
    position: Tensor
    likeness: Tensor

    @property
    def confidence(self) -> Float[Tensor, "b h w"]:
        """That `colour` is of the point that alpha sees, 0 to 1. Over [1 2 1] pixels: the four pixels that
        are made of one at half the size differ by some .02."""
        confidence = pad(self.logit.sigmoid(), (1, 1, 1, 1), mode="replicate")
        return avg_pool2d(avg_pool2d(confidence, 2, 1), 2, 1)[:, 0] * (self.peak > 0)

    @property
    def odds(self) -> Float[Tensor, "b 1 h w"]:
        """The logit by which `colour` counts against what is filled in, and against other betas' colours."""
        return self.logit + SETTINGS.alike * self.likeness

    @property
    def blending(self) -> Float[Tensor, "b 1 h w"]:
        """The weight of `colour` in the image, 0 to 1."""
        return self.odds.sigmoid()

    def beyond(self, base: Float[Tensor, "b c h w"], band: int) -> BetaEstimate:
        """One band, counted from a base instead of from alpha; `base` (B, C, H, W) is bands minus alpha."""
        of = slice(band, band + 1)
        colour, diffused = (self.colour - base)[:, of], (self.diffused - base[:, None])[:, :, of]
        return self._replace(colour=colour, diffused=diffused)


class Encoded(NamedTuple):
    """Features at 1/2 of the size, and at 1/4 with context."""

    half: Tensor
    quarter: Tensor


class GuidedPAT(nn.Module):
    """Betas whose bands, in order, are the output's: three filtered cameras, or any number in RGB.

    Other betas beside those with all bands help to find depth.

    Betas are to be of about alpha's angular resolution (enlarge or reduce them with the rig), and all sizes
    multiples of 16.
    """

    multiple = 16
    equal_resolution = True
    joins_bands: JoinsBands = "neighbours"
    uses_matches = True
    halo = 528
    """Encoder 85, judge 176, confidence 8, what is recalled 224 (propagated 148), smoothing 34: the sum,
    rounded up. The completion reaches 156 further, by so little that 528 do."""
    beta_halo = 96

    def __init__(self, config: GuidedPATConfig = GuidedPATConfig()) -> None:
        super().__init__()
        self.config = c = config
        self.bands: int | None = c.bands
        self.keeps_luminance = c.keep_luminance
        w2, w4, _, _ = c.widths
        self.encoder = Encoder(c.widths)
        self.fine_key = nn.Conv2d(w2, 4 * c.fine_dim, 1)
        self.judge = UNet(w4 + 9, c.widths[1:], c.judge_dim)
        # The logits of confidence, choices and the better match at full size, computed at half of it.
        width = c.confidence_dim
        logits = nn.Conv2d(width, 4 * (3 + FILLS), 3, padding=1), nn.PixelShuffle(2)
        self.confidence = nn.Sequential(conv(c.judge_dim + w2 + 4 + 12, width), ResidualBlock(width), *logits)
        rounds = (Propagation(w4, c.propagation_dim, spacing) for spacing in c.propagation_steps)
        self.propagation = nn.ModuleList(rounds)
        self.completion = Completion(c.completion) if c.completion else None

    def working_bytes(self, alpha: int, betas: Sequence[int]) -> float:
        """In what is recalled or completed; or around attention, one beta after the other, and the estimates
        of others."""
        most, last = max(betas, default=0), 350.0 if self.completion is None else 580.0
        return max(last * alpha, 145.0 * alpha + 100.0 * most) + 130.0 * alpha * max(len(betas) - 1, 0)

    def forward(self, inputs: Inputs, matches: Matches | None = None) -> FusionOutput:
        """Fuse alpha (B, 1, H, W) with the betas. The image has the betas' bands.

        Raises ValueError if those do not add up to the configured number, and without matches.
        """
        return self.explain(inputs, required(matches, inputs))[0]

    def explain(self, inputs: Inputs, matches: Matches) -> tuple[FusionOutput, list[BetaEstimate]]:
        """The same, with the estimate of each beta, which training supervises."""
        wanted, bands = self.config.bands, [beta.image.shape[1] for beta in inputs.betas]
        # Each beta has some bands, in order; else those with all of them show the same colours.
        parts = len(bands) == 1 or wanted not in bands
        if parts and sum(bands) != wanted:
            raise ValueError(f"the betas have {sum(bands)} bands in all, this network makes {wanted}")
        alpha, encoded = inputs.alpha, self.encoder(inputs.alpha)
        estimates = [self.estimate(encoded, alpha, *one) for one in zip(inputs.betas, matches.betas)]
        if not inputs.sees_luma:  # then brightness says nothing of a match
            estimates = [e._replace(likeness=torch.ones_like(e.likeness)) for e in estimates]
        used = estimates if parts else [combined([e for e, n in zip(estimates, bands) if n == wanted])]
        residual = self.blended(encoded, alpha, used, complete=inputs.sees_luma)
        if not inputs.sees_luma:
            residual = where_certain(residual, inputs, matches)
        if self.config.keep_luminance:
            residual = residual - inputs.luminance * luminance(residual)
        output = output_of(alpha + residual, estimates)
        return (output if parts else output._replace(overall=used[0].confidence)), estimates

    def blended(
        self,
        encoded: Encoded,
        alpha: Float[Tensor, "b 1 h w"],
        estimates: Sequence[BetaEstimate],
        *,
        complete: bool = False,
    ) -> Float[Tensor, "b c h w"]:
        """What all bands have more than alpha: where the betas see it, and where not.

        The completion, if there is one, has seen bands of one certainty alone, and alphas that see luma.
        """
        confidence = _joined([s.blending.expand_as(s.colour) for s in estimates])
        colour = _joined([s.colour for s in estimates])
        unseen, *fills = map(_joined, zip(*(self._fills(encoded, alpha, s) for s in estimates)))
        recalled = by_example(alpha, colour, confidence)
        unseen = with_examples(unseen, recalled, confidence)
        mixed = with_less_noise(alpha, torch.lerp(unseen, colour, confidence), confidence)
        if self.completion is None or len(estimates) > 1 or not complete:
            return mixed
        return self.completion(alpha, confidence[:, :1], mixed, (colour, *fills, recalled))

    def _fills(self, encoded: Encoded, alpha: Tensor, estimate: BetaEstimate) -> tuple[Tensor, ...]:
        """Colour for where beta does not see the point: the choice; and what it is of, propagated at 1/4 of
        the size to pixels that are similar in alpha, or diffused."""
        confidence = estimate.logit.sigmoid()
        weight = avg_pool2d(confidence, SETTINGS.coarse)
        colour = avg_pool2d(estimate.colour * confidence, SETTINGS.coarse) / (weight + SETTINGS.least_weight)
        for step in self.propagation:
            colour, weight = step(encoded.quarter, colour, weight)
        propagated = fitted(enlarge(colour), alpha, estimate.colour, confidence)
        choices = propagated, *estimate.diffused.to(colour).unbind(1)
        weights = estimate.choice.softmax(1).split(1, 1)
        return reduce(torch.add, (w * c for w, c in zip(weights, choices))), *choices

    def estimate(self, encoded: Encoded, alpha: Tensor, beta: Beta, matched: BetaMatches) -> BetaEstimate:
        """The estimate of one beta of any bands."""
        of, exactly = matched.comparison.combined, alpha.dtype if self.training else torch.float64
        bands, diffused = matched.colours
        segments = beta.field.straight.to(alpha.device, exactly)
        extent = Extent.of(segments)
        position = matches(segments, matched.surface, beyond_edge=True, extent=extent).movedim(-1, 1)
        window = window_around(matched.disparity, segments, self.config.window, extent)
        del extent
        other = self.encoder(of(beta.image))
        value, attended, deviation, peak = attend_with_statistics(
            self._key(encoded), self._key(other), beta.image, window, samples=self.config.taps
        )
        del other, window
        facts = [of(value) - alpha, peak[:, None], deviation[:, None]]
        judged = self._judged(encoded, matched, torch.cat(facts, 1), segments.valid[:, None])
        logit, choice, exact = judged.split([1, 1 + FILLS, 1], 1)
        logit = torch.where(peak[:, None] > 0, logit, SETTINGS.nowhere)
        colour = torch.lerp(value - alpha, bands.to(value), exact.sigmoid())
        alike = likeness(facts[0])
        return BetaEstimate(attended, deviation, peak, colour, diffused, logit, choice, position, alike)

    def _judged(self, encoded: Encoded, of_beta: BetaMatches, facts: Tensor, valid: Tensor) -> Tensor:
        """Logits (B, 3 + fills, H, W): of the confidence, of the choices, of taking the semi-global match."""
        matched = torch.cat([avg_pool2d(of_beta.disparity, FINE) / 64, of_beta.facts], 1)
        samples = torch.cat([facts, facts[:, :1].abs(), valid.expand(len(facts), -1, -1, -1).to(facts)], 1)
        rough = torch.cat([avg_pool2d(matched, 2), avg_pool2d(samples, SETTINGS.coarse)], 1)
        context = self.judge(stacked(encoded.quarter, rough))
        return self.confidence(stacked(enlarge(context), encoded.half, matched, facts))

    def _key(self, features: Encoded) -> Tensor:
        """What queries and keys are at full size."""
        return pixel_shuffle(self.fine_key(features.half), 2)


def where_certain(
    residual: Float[Tensor, "b c h w"], inputs: Inputs, matches: Matches
) -> Float[Tensor, "b c h w"]:
    """Bands minus alpha; those that betas with all of them show at the positions chosen, as far as these are
    certain and, up to a pixel, off the matches: those are often wrong if alpha sees something else."""
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
    mean = (weight * torch.stack(shown)).sum(0) / (weight.sum(0) + SETTINGS.least_weight)
    return torch.lerp(residual, mean, weight.amax(0))


def _joined(bands: Sequence[Tensor]) -> Tensor:
    return torch.cat(list(bands), 1) if len(bands) > 1 else bands[0]


def output_of(image: Float[Tensor, "b c h w"], estimates: Sequence[BetaEstimate]) -> FusionOutput:
    """The image with the position in each beta, its deviation, and its confidence."""
    matched = zip(*((s.position, s.deviation, s.confidence) for s in estimates))
    position, deviation, confidence = map(list, matched)
    return FusionOutput(image, position, deviation, confidence)


def combined(estimates: Sequence[BetaEstimate]) -> BetaEstimate:
    """The estimate of several betas of the same bands: what each shows, weighted by its odds of being right,
    and by how probable the brightness is that it shows.

    Beside depth's edges one beta may show another surface and be as confident as the others: its brightness
    tells.
    """
    if len(estimates) == 1:
        return estimates[0]
    logits = torch.stack([e.logit for e in estimates])
    probable = [SETTINGS.alike * (e.likeness + SETTINGS.least_weight).log() for e in estimates]
    weights = torch.stack([e.odds + p for e, p in zip(estimates, probable)]).softmax(0)

    def mean(parts: Sequence[Tensor]) -> Tensor:
        return sum(w * p for w, p in zip(weights, parts)) + torch.zeros_like(parts[0])

    first = estimates[0]
    shared = all(e.diffused is first.diffused for e in estimates)
    return BetaEstimate(
        first.attended,
        first.deviation,
        torch.stack([e.peak for e in estimates]).amax(0),
        mean([e.colour for e in estimates]),
        first.diffused if shared else mean([e.diffused.transpose(0, 1) for e in estimates]).transpose(0, 1),
        logits.amax(0),
        mean([e.choice for e in estimates]),
        first.position,
        mean([e.likeness for e in estimates]),
    )


class Propagation(nn.Module):
    """C3 attention of alpha to itself: each pixel takes colour from similar ones of high weight in 7 x 7.

    The logarithm of the weight is added to the scores as one more channel of the keys. Without training all
    pixels are equally similar, and this is a normalised convolution.
    """

    def __init__(self, width: int, dim: int, step: int) -> None:
        super().__init__()
        self.field = Local(7, spacing=step)
        self.query, self.key = nn.Conv2d(width, dim, 1), nn.Conv2d(width, dim, 1)
        nn.init.zeros_(self.query.weight)

    def forward(
        self,
        features: Float[Tensor, "b d h w"],
        colour: Float[Tensor, "b c h w"],
        weight: Float[Tensor, "b 1 h w"],
    ) -> tuple[Float[Tensor, "b c h w"], Float[Tensor, "b 1 h w"]]:
        """Colour and weight after one round."""
        query = torch.cat([self.query(features), torch.ones_like(weight)], 1)
        key = torch.cat([self.key(features), (weight + SETTINGS.least_weight).log()], 1)
        value = torch.cat([colour, weight], 1)
        attended = attend(query, key, value, self.field, interpolation="nearest")
        return attended[:, :-1], attended[:, -1:]


def window_around(
    disparity: Float[Tensor, "b 1 h w"], segments: Segments, window: float, extent: Extent | None = None
) -> Segments:
    """Parts of segments (B or 1, 2 h, 2 w) up to `window` pixels from a match `disparity` from the end."""
    extent = extent or Extent.of(segments)
    middle, step = matches(segments, disparity, extent=extent), window * extent.towards
    return Segments(middle + step, middle - step, segments.valid.expand(middle.shape[:-1]))


class Encoder(nn.Module):
    """Features of one grey image, the same weights for every view."""

    def __init__(self, widths: tuple[int, int, int, int]) -> None:
        super().__init__()
        w2, w4, w8, _ = widths
        self.at_half = nn.Sequential(conv(4, w2), ResidualBlock(w2))
        self.at_quarter = nn.Sequential(conv(w2, w4, stride=2), ResidualBlock(w4))
        eighth = conv(w4, w8, stride=2), ResidualBlock(w8), ResidualBlock(w8, dilation=3)
        self.at_eighth = nn.Sequential(*eighth)
        self.up = nn.Conv2d(w8, w4, 1)
        self.merge = ResidualBlock(w4)

    def forward(self, image: Float[Tensor, "b 1 h w"]) -> Encoded:
        """Features of an image whose sides are multiples of 8."""
        half = self.at_half(channels_last(pixel_unshuffle(image - 0.5, 2)))
        quarter = self.at_quarter(half)
        return Encoded(half, self.merge(quarter + enlarge(self.up(self.at_eighth(quarter)))))
