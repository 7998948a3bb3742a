"""BandwisePAT: any number of bands, each treated alike, so that the order of the betas cannot matter.

GuidedPAT mixes its bands in the order in which they come. Here one GuidedPAT of a single band fuses alpha with each
band of each beta on its own, with the same weights: permuting the betas permutes the output's bands and does
nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from .consensus import Balances, Consensus
from .guided import GuidedPAT, GuidedPATConfig, Seen
from .model import Fused, Look, Looks


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
    halo = GuidedPAT.halo
    beta_halo = GuidedPAT.beta_halo
    bytes_per_pixel = GuidedPAT.bytes_per_pixel

    def __init__(self, config: BandwisePATConfig = BandwisePATConfig()) -> None:
        super().__init__()
        self.config = config
        self.single = GuidedPAT(GuidedPATConfig(**asdict(config)))

    def balance(self, alpha: Float[Tensor, "b 1 h w"], beta: Float[Tensor, "b _ hb wb"]) -> Balances:
        """How the whole pictures are levelled and made equally sharp, for surveys of pieces of them."""
        return self.single.balance(alpha, beta)

    def survey(self, alpha: Float[Tensor, "b 1 h w"], beta: Float[Tensor, "b _ hb wb"], look: Look) -> Consensus | None:
        """What can be known before attention looks, once for all bands of a beta."""
        return self.single.survey(alpha, beta, look)

    def forward(
        self, alpha: Float[Tensor, "b 1 h w"], betas: Sequence[Float[Tensor, "b _ _ _"]], looks: Looks
    ) -> Fused:
        """Fuse alpha with each band of each beta. Position, spread and confidence are one for each band."""
        return self.explain(alpha, betas, looks)[0]

    def explain(
        self, alpha: Float[Tensor, "b 1 h w"], betas: Sequence[Float[Tensor, "b _ _ _"]], looks: Looks
    ) -> tuple[Fused, list[Seen]]:
        """The same, with what each band told, which training supervises."""
        bands = [
            (band, look if look.known is None else replace(look, known=look.known.band(i)))
            for beta, look in zip(betas, looks)
            for i, band in enumerate(beta.split(1, 1))
        ]
        answers = [self.single.explain(alpha, [band], [look]) for band, look in bands]
        fused, seen = zip(*answers)
        lists = ([part[0] for part in parts] for parts in list(zip(*fused))[1:])
        return Fused(torch.cat([f.image for f in fused], 1), *lists), [told for each in seen for told in each]
