"""Results of matching: positions of alpha's pixels in each beta, and the bands of the beta there."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import interpolate

from arraygeom import Segments
from arraygeom.pixels import HW
from arraygeom.runtime.chunks import Box, slices
from arraygeom.sampling import on_image

from .inputs import Inputs
from .normalisation import Comparison
from .positions import FINE, enlarged, match_positions
from .semi_global import CONSISTENT


def is_consistent(facts: Float[Tensor, "b 3 h2 w2"]) -> Float[Tensor, "b 1 h w"]:
    """Return 1 where the match is consistent, at full size."""
    return enlarged((facts[:, :1] < CONSISTENT).to(facts))


CHANNELS = {"disparity": 1, "chosen": 1, "facts": 3, "stated": 2, "certainty": 2}
"""Number of channels of each plane of `BetaMatches`."""
AT_HALF_SIZE = ("facts", "stated", "certainty")


class Colours(NamedTuple):
    """Bands of one beta carried to alpha's view, each minus alpha.

    Attributes:
        bands: (B, C, H, W), bands minus alpha at the match, with the detail that alpha has and beta lacks;
            the frame's mean where the match is off beta.
        weight: (B, 1, H, W), weight of `bands` against the fills, 0 to 1; 0 off beta.
        likeness: (B, 1, H, W), photometric similarity of alpha and beta at the match, 0 to 1; 1 where luma is
            compared and alpha does not see it, and nearer 1 for a single band the less alpha explains it.
        fills: (B, F, C, H, W), further bands minus alpha, at all pixels, without gradients: those of nearest
            examples where beta does not see the pixel; before these, where the bands' spectra are not known,
            their local regression on brightness. Several betas may share one tensor.
    """

    bands: Tensor
    weight: Tensor
    likeness: Tensor
    fills: Tensor

    def cut(self, box: Box, shared: dict[int, Tensor]) -> Colours:
        """Return the part at alpha's (top, bottom, left, right), as views of these tensors.

        Args:
            shared: fills that were cut before, by the id of the whole, to which these are added: fills that
                several betas share stay shared.
        """
        index = (..., *slices(box))
        fills = shared.setdefault(id(self.fills), self.fills[index])
        return Colours(self.bands[index], self.weight[index], self.likeness[index], fills)


@dataclass(frozen=True)
class BetaMatches:
    """Matches of alpha's H x W pixels in one beta.

    Attributes:
        disparity: (B, 1, H, W), the distance of the match from the end of its segment, pixels of beta; where
            no match passes the left-right check, diffused from where one does.
        facts: (B, 3, H / 2, W / 2), statistics of the match: left-right error (1 for 8 pixels and more; for
            agreed matches the distance from the foremost point there, 1 for 16), margin of its cost to the
            next best, and its cost; each 0 to 1.
        comparison: combination of beta's bands that was compared, and its normalisation to alpha.
        chosen: (B, 1, H, W), the disparity of the surface that alpha sees, which may be occluded in beta; of
            betas that were made to agree, theirs; None if none was chosen.
        stated: (B, 2, H / 2, W / 2), the choice network's logit that its disparity is right, and the
            natural logarithm of an error, pixels, that 9 of 10 do not exceed; None before it has run.
        certainty: (B, 2, H / 2, W / 2), the probability that beta sees the point and the match is within a
            pixel of it, and the half-width, in pixels of beta, of the interval around the match that holds
            the true position in 9 of 10 cases; None where it is not known.
        colours: beta's bands at the matches; None before they are carried over.
    """

    disparity: Tensor
    facts: Tensor
    comparison: Comparison
    chosen: Tensor | None = None
    stated: Tensor | None = None
    certainty: Tensor | None = None
    colours: Colours | None = None

    @property
    def hw(self) -> HW:
        """Height and width of alpha, pixels."""
        return self.disparity.shape[-2], self.disparity.shape[-1]

    @property
    def surface(self) -> Float[Tensor, "b 1 h w"]:
        """Disparity of the surface that alpha sees: the chosen one, or the match's before one is chosen."""
        return self.disparity if self.chosen is None else self.chosen

    @property
    def confidence(self) -> Float[Tensor, "b 1 h w"]:
        """Probability that beta sees the point and the match is right, 0 to 1, from `certainty`.

        Without certainty 1 where the match passes the left-right check, else 0.
        """
        if self.certainty is None:
            return is_consistent(self.facts)
        return interpolate(self.certainty[:, :1].float(), scale_factor=FINE, mode="bilinear").to(self.facts)

    @property
    def carried(self) -> Colours:
        """The colours.

        Raises:
            ValueError: before they are carried over.
        """
        if self.colours is None:
            raise ValueError("these matches have no colours: give them their images' by `transferred`")
        return self.colours

    def positions(self, segments: Segments, hw: HW) -> tuple[Float[Tensor, "b h w 2"], Bool[Tensor, "b h w"]]:
        """Compute the positions (x, y) in beta of the surface that alpha sees (`surface`).

        Args:
            segments: segments of alpha's pixels.
            hw: height and width of the beta.

        Returns:
            Positions (B, H, W, 2) in beta's pixels, also beyond segments' starts; and a mask (B, H, W) of
            those on its image whose segment is valid.
        """
        where = match_positions(segments, self.surface, beyond_edge=True)
        return where, segments.valid & on_image(where, hw)

    def check(self, inputs: Inputs) -> None:
        """Check the planes, but not that they are of these very images.

        Args:
            inputs: inputs of this beta alone.

        Raises:
            ValueError: for planes of other shapes than these inputs need, no floats, NaN or infinite; for a
                probability in `certainty` beyond 0 to 1; for `disparity` and `facts` of two types.
        """
        (batch, _, *hw), bands = inputs.alpha.shape, inputs.betas[0].image.shape[1]
        planes = {name: getattr(self, name) for name in CHANNELS}
        shapes = {
            name: (batch, channels, *(n // FINE if name in AT_HALF_SIZE else n for n in hw))
            for name, channels in CHANNELS.items()
        }
        if self.colours is not None:
            planes |= self.colours._asdict()
            shapes |= {"bands": (batch, bands, *hw), "weight": (batch, 1, *hw), "likeness": (batch, 1, *hw)}
            count = self.colours.fills.shape[1] if self.colours.fills.ndim > 1 else 1
            shapes |= {"fills": (batch, count, bands, *hw)}
        for name, plane in planes.items():
            if plane is None and name not in ("disparity", "facts"):
                continue
            if not isinstance(plane, Tensor) or not plane.is_floating_point() or plane.shape != shapes[name]:
                tensor = isinstance(plane, Tensor)
                got = f"{plane.dtype} {tuple(plane.shape)}" if tensor else type(plane).__name__
                got = got.removeprefix("torch.")
                raise ValueError(f"these matches' {name} is {got}: wanted a tensor of floats {shapes[name]}")
            if not bool(plane.isfinite().all()):
                raise ValueError(f"these matches' {name} is NaN or infinite: give any, with little certainty")
        if self.certainty is not None and not bool((self.certainty[:, 0] - 0.5).abs().max() <= 0.5):
            raise ValueError("these matches' certainty is not within 0 to 1: give probabilities")
        if self.disparity.dtype != self.facts.dtype:
            both = " and ".join(f"{t.dtype}".removeprefix("torch.") for t in (self.disparity, self.facts))
            raise ValueError(
                f"these matches' disparity and facts are {both}: give one type, that of the images"
            )

    def cut(self, box: Box, shared: dict[int, Tensor] | None = None) -> BetaMatches:
        """Return the part at alpha's (top, bottom, left, right), all even."""
        whole, half = slices(box), slices([n // FINE for n in box])
        planes = {name: getattr(self, name) for name in CHANNELS if getattr(self, name) is not None}
        cut: dict[str, Any] = {
            name: plane[(..., *(half if name in AT_HALF_SIZE else whole))] for name, plane in planes.items()
        }
        colours = self.colours and self.colours.cut(box, {} if shared is None else shared)
        return replace(self, **cut, colours=colours)


@dataclass(frozen=True)
class Matches:
    """Matches of each beta, in order.

    Attributes:
        betas: matches in each beta.
    """

    betas: tuple[BetaMatches, ...]

    @property
    def hw(self) -> HW:
        """Size of the alpha to which they belong."""
        return self.betas[0].hw

    @property
    def nbytes(self) -> int:
        """Memory held for a large frame, bytes: colours as float16, fills that betas share counted once."""
        colours = [beta.colours for beta in self.betas if beta.colours is not None]
        fills = {id(one.fills): one.fills.numel() for one in colours}
        own = sum(plane.numel() for one in colours for plane in one[:3])
        planes = [2 * beta.disparity.nbytes + beta.facts.nbytes * 7 // 3 for beta in self.betas]
        return 2 * (own + sum(fills.values())) + sum(planes)

    def cut(self, box: Box) -> Matches:
        """Return the part at alpha's (top, bottom, left, right), all even.

        Fills that several betas share stay shared.
        """
        shared: dict[int, Tensor] = {}
        return Matches(tuple(beta.cut(box, shared) for beta in self.betas))

    def check(self, inputs: Inputs) -> None:
        """Check sizes and planes, but not that the matches are of these very images.

        Raises:
            ValueError: for another size of alpha or number of betas, and as `BetaMatches.check`.
        """
        size, betas = self.hw if self.betas else (0, 0), len(inputs.betas)
        if size != inputs.hw or len(self.betas) != betas:
            (h, w), (height, width) = size, inputs.hw
            raise ValueError(
                f"these matches are of {w}x{h} pixels in {len(self.betas)} betas, "
                f"the images are {width}x{height} with {betas}: match these images"
            )
        for beta, one in zip(self.betas, inputs.by_beta):
            beta.check(one)
