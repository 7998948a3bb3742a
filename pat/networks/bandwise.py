"""BandwisePAT: any number of bands, each treated alike, so that the order of the betas cannot matter.

GuidedPAT mixes its bands in the order in which they come. Here the bands of a beta are looked for and judged
together, by the combination of them that is most like alpha (`pat.networks.spectral_mix`); then one GuidedPAT of a single band
finishes each with the same weights. Permuting bands or betas permutes the output's bands and does nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from arraygeom import Segments

from .guided import Encoded, GuidedPAT, GuidedPATConfig, Seen, fused_from, hw_of, segments_of
from .protocol import FusionOutput, Look, Looks
from .semi_global import FINE, Normalisations, SemiGlobalMatches, semi_global_matching
from .spectral_mix import SpectralMix, coarse_mix, semi_global_matching_of_bands

COARSELY = 400_000
"""Pixels of alpha at most on which the bands' combination is found."""


@dataclass(frozen=True)
class BandwisePATConfig(GuidedPATConfig):
    """GuidedPAT's, for one band, which need not have alpha's luminance."""

    bands: int = 1
    keep_luminance: bool = False

    def __post_init__(self) -> None:
        if self.bands != 1 or self.keep_luminance:
            raise ValueError("BandwisePAT fuses one band at a time: leave bands at 1 and keep_luminance at false")


class BandwisePAT(nn.Module):
    """A mono alpha and any number of betas of any number of bands; the image has all bands, in order."""

    multiple = GuidedPAT.multiple
    equal_pitch = GuidedPAT.equal_pitch
    joins_bands: Literal["no", "neighbours", "all"] = "all"
    halo = GuidedPAT.halo
    beta_halo = GuidedPAT.beta_halo
    bytes_per_pixel = GuidedPAT.bytes_per_pixel

    def __init__(self, config: BandwisePATConfig = BandwisePATConfig()) -> None:
        super().__init__()
        self.config = config
        self.single = GuidedPAT(GuidedPATConfig(**asdict(config)))
        if config.head_dim and self.single.head.last.bias is not None:
            nn.init.zeros_(self.single.head.last.bias)

    def normalisation(self, alpha: Float[Tensor, "b 1 h w"], beta: Float[Tensor, "b _ hb wb"], look: Look) -> Look:
        """The look with how the bands of the whole images are combined, levelled and made equally sharp."""
        factor = 2
        while factor < self.multiple // 2 and alpha.shape[-2] * alpha.shape[-1] > COARSELY * factor**2:
            factor *= 2
        mix = coarse_mix(alpha, beta, *_segments(alpha, look, factor), factor)
        return replace(look, mix=mix, normalisations=Normalisations.of(alpha, mix.of(beta)))

    def _told(self, alpha: Tensor, beta: Tensor, look: Look) -> tuple[SpectralMix, Normalisations]:
        """What `balance` says, of these images if not known of the whole ones."""
        if look.mix is None or look.normalisations is None:
            look = self.normalisation(alpha, beta, look)
        assert look.mix is not None
        assert look.normalisations is not None
        return look.mix, look.normalisations

    def survey(
        self, alpha: Float[Tensor, "b 1 h w"], beta: Float[Tensor, "b _ hb wb"], look: Look
    ) -> SemiGlobalMatches:
        """What can be known before attention looks, once for all bands of a beta."""
        mix, normalisations = self._told(alpha, beta, look)
        whole, blocks = _segments(alpha, look, 1)
        if beta.shape[1] == 1:
            return semi_global_matching(alpha, beta, beta, whole, blocks, normalisations)
        return semi_global_matching_of_bands(alpha, beta, whole, blocks, mix, normalisations)

    def forward(
        self, alpha: Float[Tensor, "b 1 h w"], betas: Sequence[Float[Tensor, "b _ _ _"]], looks: Looks
    ) -> FusionOutput:
        """Fuse alpha with each band of each beta. Position, spread and confidence are one for each beta."""
        return self.explain(alpha, betas, looks)[0]

    def explain(
        self, alpha: Float[Tensor, "b 1 h w"], betas: Sequence[Float[Tensor, "b _ _ _"]], looks: Looks
    ) -> tuple[FusionOutput, list[Seen]]:
        """The same, with what each beta told, which training supervises."""
        own = self.single.encoder(alpha)
        parts = [self._of_beta(own, alpha, beta, look) for beta, look in zip(betas, looks)]
        seen = [told for _, told in parts]
        return fused_from(torch.cat([image for image, _ in parts], 1), seen), seen

    def _of_beta(self, own: Encoded, alpha: Tensor, beta: Tensor, look: Look) -> tuple[Tensor, Seen]:
        """One beta's bands at alpha's view.

        What the network makes of each is counted from its local regression on alpha: where a band is unlike alpha,
        its difference from alpha is not alike in places that look alike.
        """
        mix, normalisations = self._told(alpha, beta, look)
        look = replace(look, mix=mix, normalisations=normalisations)
        known = look.known if look.known is not None else self.survey(alpha, beta, look)
        seen = self.single.seen(own, alpha, beta, replace(look, known=known), guide=mix.of)
        base = known.colour[:, 0]
        bands = [
            regressed + self.single.blended(own, regressed, [seen.beyond(base, i)])
            for i, regressed in enumerate((alpha + base).split(1, 1))
        ]
        return mix.reconciled(torch.cat(bands, 1), alpha), seen


def _segments(alpha: Tensor, look: Look, side: int) -> tuple[Segments, Segments]:
    """Those of alpha's blocks of `side` pixels, and of blocks `FINE` times as large."""
    hw, like = hw_of(alpha), alpha.double()
    return segments_of(look, hw, side, like), segments_of(look, hw, FINE * side, like)
