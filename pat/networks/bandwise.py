"""BandwisePAT: any number of bands, each treated alike, so that the order of the betas cannot matter.

GuidedPAT mixes its bands in the order in which they come. Here the bands of a beta are matched and judged
together, by the combination of them that is most like alpha (`pat.networks.spectral_mix`); then one GuidedPAT of a
single band finishes each with the same weights. Permuting bands or betas permutes the output's bands and does
nothing else.
"""

from __future__ import annotations

from dataclasses import asdict

import torch
from torch import Tensor, nn

from .configs import BandwisePATConfig, GuidedPATConfig
from .guided import BetaEstimate, Encoded, GuidedPAT, output_of
from .matching import semi_global_matching
from .pieces import Prepared, prepared
from .protocol import Beta, FusionOutput, Inputs, JoinsBands
from .semi_global import FINE, HalfSizeMatches, Normalisations, SemiGlobalMatches
from .spectral_mix import SpectralMix, coarse_mix, semi_global_matching_of_bands

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
        """For each beta how its bands are combined and normalised, and by that its semi-global matches."""
        return prepared(inputs, self._combination, lambda found: (found[0].of, found[1]), _matches)

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
        own = self.single.encoder(inputs.alpha)
        parts = [
            self._of_beta(own, inputs.alpha, beta, found, mix)
            for beta, found, (mix, _) in zip(inputs.betas, state.matches, state.common)
        ]
        estimates = [estimate for _, estimate in parts]
        return output_of(torch.cat([image for image, _ in parts], 1), estimates), estimates

    def matched(self, inputs: Inputs) -> FusionOutput:
        """Positions and their confidences alone: the image is alpha."""
        state = self.prepare(inputs)
        own, parts = self.single.encoder(inputs.alpha), zip(inputs.betas, state.matches, state.common)
        estimates = [self.single.estimate(own, inputs.alpha, b, found, guide=mix.of) for b, found, (mix, _) in parts]
        return output_of(inputs.alpha, estimates)

    def _of_beta(
        self, own: Encoded, alpha: Tensor, beta: Beta, found: SemiGlobalMatches, mix: SpectralMix
    ) -> tuple[Tensor, BetaEstimate]:
        """One beta's bands at alpha's view.

        The network's result for each is counted from its local regression on alpha: where a band is unlike alpha,
        its difference from alpha differs even between similar pixels.
        """
        estimate = self.single.estimate(own, alpha, beta, found, guide=mix.of)
        base = found.colour[:, 0].to(alpha)
        bands = [
            regressed + self.single.blended(own, regressed, [estimate.beyond(base, i)])
            for i, regressed in enumerate((alpha + base).split(1, 1))
        ]
        return mix.reconciled(torch.cat(bands, 1), alpha), estimate


def _matches(
    inputs: Inputs, combined: tuple[SpectralMix, Normalisations], half: HalfSizeMatches | None
) -> SemiGlobalMatches:
    """The matches of the one beta, once for all its bands."""
    alpha, (beta,), (mix, normalisations) = inputs.alpha, inputs.betas, combined
    segments, blocks = beta.field.straight, None if half else beta.field.of_blocks(FINE)
    if beta.image.shape[1] == 1:
        return semi_global_matching(alpha, beta.image, beta.image, segments, blocks, normalisations, half)
    return semi_global_matching_of_bands(alpha, beta.image, segments, blocks, mix, normalisations, half)
