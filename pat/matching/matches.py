"""What matching has found: of each beta where alpha's pixels are in it, and its bands there."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from jaxtyping import Bool, Float
from torch import Tensor

from arraygeom import Segments
from arraygeom.pixels import HW
from arraygeom.runtime.chunks import Box, slices
from arraygeom.sampling import on_image

from .inputs import Inputs
from .normalisation import Comparison
from .positions import FINE, enlarged, matches
from .semi_global import CONSISTENT


def is_consistent(facts: Float[Tensor, "b 3 h2 w2"]) -> Float[Tensor, "b 1 h w"]:
    """1 where the match is consistent."""
    return enlarged((facts[:, :1] < CONSISTENT).to(facts))


FILLS = 2
"""Size: ways in which colour is diffused, along its regression on brightness, and as it is."""
CHANNELS = {"disparity": 1, "chosen": 1, "facts": 3, "stated": 2, "certainty": 2, "bands": 0, "diffused": 0}
"""Of each plane of `BetaMatches`; 0: as many as beta has bands."""
AT_HALF_SIZE = ("facts", "stated", "certainty")


@dataclass(frozen=True)
class BetaMatches:
    """The matches of alpha's H x W pixels in one beta.

    disparity: (B, 1, H, W), how far along its segment, from the end, the match is, pixels of beta; where no
        match is consistent, diffused from where one is.
    facts: (B, 3, H / 2, W / 2), how far matching back from beta disagrees, by how much the match is better
        than others, and its cost; each 0 to 1.
    comparison: what of beta was compared with alpha.
    bands: (B, C, H, W), beta's bands minus alpha at the match, with the detail that alpha has and beta has
        not; None before they are transferred.
    diffused: (B, fills, C, H, W), the same diffused from pixels of high weight to the others.
    chosen: (B, 1, H, W), of the disparities found there and around that of what alpha sees, which may be
        hidden in beta or fill in for what is; of several betas, what they agree on of those; None before one
        is chosen.
    stated: (B, 2, H / 2, W / 2), what the choice says of it: the logit of that it is right, and the logarithm
        of how far it may be off, pixels; None before one is chosen.
    certainty: (B, 2, H / 2, W / 2), the probability that beta sees the point and the match is within a pixel
        of it, and the half-width, in pixels of beta, of the interval around the match in which the true
        position is in 9 of 10 cases; None where it is not known.
    """

    disparity: Tensor
    facts: Tensor
    comparison: Comparison
    bands: Tensor | None = None
    diffused: Tensor | None = None
    chosen: Tensor | None = None
    stated: Tensor | None = None
    certainty: Tensor | None = None

    @property
    def hw(self) -> HW:
        """Size of the alpha that they are of."""
        return self.disparity.shape[-2], self.disparity.shape[-1]

    @property
    def surface(self) -> Float[Tensor, "b 1 h w"]:
        """The disparity of what alpha sees, as far as it is known: the one that was chosen."""
        return self.disparity if self.chosen is None else self.chosen

    @property
    def colours(self) -> tuple[Tensor, Tensor]:
        """`bands` and `diffused`. Raises ValueError before they are transferred."""
        if self.bands is None or self.diffused is None:
            raise ValueError(
                "these matches have no colours: give them those of their images by `transferred`"
            )
        return self.bands, self.diffused

    def positions(self, segments: Segments, hw: HW) -> tuple[Float[Tensor, "b h w 2"], Bool[Tensor, "b h w"]]:
        """Matches in a beta of this size (x, y), by segments of alpha's pixels; whether they are on it."""
        where = matches(segments, self.surface, beyond_edge=True)
        return where, segments.valid & on_image(where, hw)

    def check(self, inputs: Inputs) -> None:
        """Raises ValueError unless its planes are tensors of finite floats, as of inputs of one beta."""
        (batch, _, *hw), bands = inputs.alpha.shape, inputs.betas[0].image.shape[1]
        for name, channels in CHANNELS.items():
            plane = getattr(self, name)
            if plane is None and name not in ("disparity", "facts"):
                continue
            fills = (FILLS,) if name == "diffused" else ()
            sides = (n // FINE for n in hw) if name in AT_HALF_SIZE else hw
            shape = (batch, *fills, channels or bands, *sides)
            if not isinstance(plane, Tensor) or not plane.is_floating_point() or plane.shape != shape:
                tensor = isinstance(plane, Tensor)
                got = f"{plane.dtype} {tuple(plane.shape)}" if tensor else type(plane).__name__
                got = got.removeprefix("torch.")
                raise ValueError(f"these matches' {name} is {got}: wanted a tensor of floats {shape}")
            if not bool(plane.isfinite().all()):
                raise ValueError(f"these matches' {name} is NaN or infinite: give any, with little certainty")
        if self.certainty is not None and not bool((self.certainty[:, 0] - 0.5).abs().max() <= 0.5):
            raise ValueError("these matches' certainty is not within 0 to 1: give probabilities")
        if self.disparity.dtype != self.facts.dtype:
            both = " and ".join(f"{t.dtype}".removeprefix("torch.") for t in (self.disparity, self.facts))
            raise ValueError(
                f"these matches' disparity and facts are {both}: give one type, that of the images"
            )

    def cut(self, box: Box) -> BetaMatches:
        """The part at alpha's (top, bottom, left, right), all even."""
        whole, half = slices(box), slices([n // FINE for n in box])
        planes = {name: plane for name, plane in vars(self).items() if isinstance(plane, Tensor)}
        sizes = {name: whole if plane.shape[-1] == self.hw[1] else half for name, plane in planes.items()}
        cut: dict[str, Any] = {name: plane[(..., *sizes[name])] for name, plane in planes.items()}
        return replace(self, **cut)


@dataclass(frozen=True)
class Matches:
    """Those of each beta, in order."""

    betas: tuple[BetaMatches, ...]

    @property
    def hw(self) -> HW:
        """Size of the alpha that they are of."""
        return self.betas[0].hw

    @property
    def nbytes(self) -> int:
        """Memory held, of a large frame: colours as float16, those that betas share counted once."""
        colours = {id(colour): colour.numel() for beta in self.betas for colour in beta.colours}
        planes = [2 * beta.disparity.nbytes + beta.facts.nbytes * 7 // 3 for beta in self.betas]
        return 2 * sum(colours.values()) + sum(planes)

    def cut(self, box: Box) -> Matches:
        """Of a part of alpha. Colour that several betas share, they share there too."""
        shared: dict[int, Tensor | None] = {}
        parts = [(id(beta.diffused), beta.cut(box)) for beta in self.betas]
        for key, cropped in parts:
            shared.setdefault(key, cropped.diffused)
        return Matches(tuple(replace(cropped, diffused=shared[key]) for key, cropped in parts))

    def check(self, inputs: Inputs) -> None:
        """Raises ValueError unless they are of so many betas, and `BetaMatches.check` has no objection."""
        size, betas = self.hw if self.betas else (0, 0), len(inputs.betas)
        if size != inputs.hw or len(self.betas) != betas:
            (h, w), (height, width) = size, inputs.hw
            raise ValueError(
                f"these matches are of {w}x{h} pixels in {len(self.betas)} betas, "
                f"the images are {width}x{height} with {betas}: match these images"
            )
        for beta, one in zip(self.betas, inputs.by_beta):
            beta.check(one)
