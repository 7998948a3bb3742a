"""BandwisePAT: any number of bands, each treated alike, so that the order of the betas cannot matter.

GuidedPAT mixes its bands in the order in which they come. Here the bands of a beta are matched and judged
together, by the combination of them that is most like alpha (`pat.matching.radiometry`); then one GuidedPAT of a
single band finishes each with the same weights. Permuting bands or betas permutes the output's bands and does
nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict

import torch
from torch import Tensor, nn

from ..matching.colour_transfer import coarse_mix, colours_of_bands, matched_colours
from ..matching.inputs import Beta, Inputs
from ..matching.multiview import matched_together
from ..matching.pieces import Prepared
from ..matching.radiometry import SpectralMix
from ..matching.semi_global import FINE, Normalisations, SemiGlobalMatches
from .configs import BandwisePATConfig, GuidedPATConfig
from .guided import BetaEstimate, Encoded, GuidedPAT, output_of
from .protocol import FusionOutput, JoinsBands

COARSELY = 400_000
"""Pixels of alpha at most on which the bands' combination is found."""


class BandwisePAT(nn.Module):
    """A mono alpha and any number of betas of any number of bands; the image has all bands, in order."""

    multiple = GuidedPAT.multiple
    equal_resolution = GuidedPAT.equal_resolution
    joins_bands: JoinsBands = "all"
    halo = GuidedPAT.halo
    beta_halo = GuidedPAT.beta_halo

    def __init__(self, config: BandwisePATConfig = BandwisePATConfig()) -> None:
        super().__init__()
        self.config = config
        self.single = GuidedPAT(GuidedPATConfig(**asdict(config)))
        if config.head_dim and self.single.head.last.bias is not None:
            nn.init.zeros_(self.single.head.last.bias)

    def working_bytes(self, alpha: int, betas: Sequence[int]) -> float:
        """As of the network inside."""
        return self.single.working_bytes(alpha, betas)

    def prepare(self, inputs: Inputs) -> Prepared:
        """For each beta how its bands are combined and normalised, and by that its semi-global matches; the depth is
        that on which all agree."""
        return matched_together(inputs, self._combination, lambda found: (found[0].of, found[1]), _colours)

    def _combination(self, inputs: Inputs) -> tuple[SpectralMix, Normalisations]:
        """The combination of the one beta's bands that is most like alpha, and how that is normalised."""
        alpha, (beta,) = inputs.alpha, inputs.betas
        factor = 2
        while factor < self.multiple // 2 and alpha.shape[-2] * alpha.shape[-1] > COARSELY * factor**2:
            factor *= 2
        segments, blocks = (beta.field.of_blocks(side) for side in (factor, FINE * factor))
        mix = coarse_mix(alpha, beta.image, segments, blocks, factor)
        return mix, Normalisations.of(alpha, mix.of(beta.image))

    def forward(self, inputs: Inputs, state: Prepared | None = None) -> FusionOutput:
        """Fuse alpha with each band of each beta. Position, deviation and confidence are one for each beta."""
        return self.explain(inputs, state)[0]

    def explain(self, inputs: Inputs, state: Prepared | None = None) -> tuple[FusionOutput, list[BetaEstimate]]:
        """The same, with the estimate of each beta, which training supervises."""
        state = state or self.prepare(inputs).cut((0, inputs.hw[0], 0, inputs.hw[1]))
        own, estimates = self._estimates(inputs, state)
        parts = [
            self._of_beta(own, inputs.alpha, estimate, found, mix)
            for estimate, found, (mix, _) in zip(estimates, state.matches, state.common)
        ]
        return output_of(torch.cat(parts, 1), estimates), estimates

    def matched(self, inputs: Inputs) -> FusionOutput:
        """Positions and their confidences alone: the image is alpha."""
        return output_of(inputs.alpha, self._estimates(inputs, self.prepare(inputs))[1])

    def _estimates(self, inputs: Inputs, state: Prepared) -> tuple[Encoded, list[BetaEstimate]]:
        """Alpha's features, and the estimate of each beta."""
        own, parts = self.single.encoder(inputs.alpha), zip(inputs.betas, state.matches, state.common)
        estimates = [self.single.estimate(own, inputs.alpha, b, found, guide=mix.of) for b, found, (mix, _) in parts]
        return own, estimates

    def _of_beta(
        self, own: Encoded, alpha: Tensor, estimate: BetaEstimate, found: SemiGlobalMatches, mix: SpectralMix
    ) -> Tensor:
        """One beta's bands at alpha's view.

        The network's result for each is counted from its local regression on alpha: where a band is unlike alpha,
        its difference from alpha differs even between similar pixels.
        """
        base = found.colour[:, 0].to(alpha)
        bands = [
            regressed + self.single.blended(own, regressed, [estimate.beyond(base, i)])
            for i, regressed in enumerate((alpha + base).split(1, 1))
        ]
        return mix.reconciled(torch.cat(bands, 1), alpha)


def _colours(
    alpha: Tensor, beta: Beta, found: SemiGlobalMatches, common: tuple[SpectralMix, Normalisations]
) -> tuple[Tensor, Tensor]:
    """The bands minus alpha at a beta's matches, and their weight."""
    (mix, normalisations), where = common, (beta.field.straight, found.disparity, found.facts)
    if beta.image.shape[1] == 1:
        return matched_colours(alpha, beta.image, beta.image, *where, normalisations.whole)
    return colours_of_bands(alpha, beta.image, *where, mix, normalisations.whole)
