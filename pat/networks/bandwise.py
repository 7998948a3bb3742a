"""BandwisePAT: any number of bands, each treated alike, so that the order of the betas cannot matter.

GuidedPAT mixes its bands in the order in which they come. Here the bands of a beta are matched and judged
together, by the combination of them that is most like alpha (`pat.matching.spectral_mix`); then one GuidedPAT
of a single band finishes each with the same weights. Permuting bands or betas permutes the output's bands and
does nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict

import torch
from torch import Tensor, nn

from ..matching.inputs import Inputs
from ..matching.matches import BetaMatches, Matches
from .configs import BandwisePATConfig, GuidedPATConfig
from .guided import BetaEstimate, Encoded, GuidedPAT, output_of
from .protocol import FusionOutput, JoinsBands, required


class BandwisePAT(nn.Module):
    """A mono alpha and any number of betas of any number of bands; the image has all bands, in order."""

    multiple = GuidedPAT.multiple
    equal_resolution = GuidedPAT.equal_resolution
    joins_bands: JoinsBands = "all"
    bands: int | None = None
    uses_matches, keeps_luminance = True, False
    halo = GuidedPAT.halo
    beta_halo = GuidedPAT.beta_halo

    def __init__(self, config: BandwisePATConfig = BandwisePATConfig()) -> None:
        super().__init__()
        self.config = config
        self.single = GuidedPAT(GuidedPATConfig(**asdict(config)))

    def working_bytes(self, alpha: int, betas: Sequence[int]) -> float:
        """As of the network inside."""
        return self.single.working_bytes(alpha, betas)

    def forward(self, inputs: Inputs, matches: Matches | None = None) -> FusionOutput:
        """Fuse alpha with each band of each beta. Position, deviation and confidence are one for each beta.

        Raises ValueError without matches.
        """
        return self.explain(inputs, required(matches, inputs))[0]

    def explain(self, inputs: Inputs, matches: Matches) -> tuple[FusionOutput, list[BetaEstimate]]:
        """The same, with the estimate of each beta, which training supervises."""
        alpha, encoded = inputs.alpha, self.single.encoder(inputs.alpha)
        estimates = [self.single.estimate(encoded, alpha, *one) for one in zip(inputs.betas, matches.betas)]
        parts = [self._of_beta(encoded, alpha, *one) for one in zip(estimates, matches.betas)]
        return output_of(torch.cat(parts, 1), estimates), estimates

    def _of_beta(
        self, encoded: Encoded, alpha: Tensor, estimate: BetaEstimate, matches: BetaMatches
    ) -> Tensor:
        """One beta's bands at alpha's view.

        The network's result for each is counted from its local regression on alpha: where a band is unlike
        alpha, its difference from alpha differs even between similar pixels.
        """
        base, mix = matches.colours[1][:, 0].to(alpha), matches.comparison.mix
        bands = [
            regressed + self.single.blended(encoded, regressed, [estimate.beyond(base, i)])
            for i, regressed in enumerate((alpha + base).split(1, 1))
        ]
        image = torch.cat(bands, 1)
        return image if mix is None else mix.reconciled(image, alpha)
