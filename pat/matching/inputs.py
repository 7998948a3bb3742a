"""Inputs and results of matching: images and fields in, positions and colours at alpha's pixels out.

In go alpha's image, and each beta's image and field of alpha's pixels in it (`Inputs`). A match is a distance
along the pixel's search segment, from its far end. Out are those of each beta, how they were compared, and
the beta's bands there (`Matches`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from arraygeom import Positions, Segments
from arraygeom.epipolar import Track
from arraygeom.fields.grid import FieldOnGrid
from arraygeom.pixels import HW
from arraygeom.runtime.chunks import Box, Tile, assembled, sides_by_work, slices, tiles_of, whole
from arraygeom.sampling import on_image, sample

from ..media.colour import luminance
from ..support.settings import size, tuned
from .band_mix import SpectralMix
from .normalisation import ComparedViews, Normalisation


@dataclass(frozen=True)
class InputsSettings:
    """Settings of the tiles of large frames, the same for any memory limit, and of the left-right check.

    `pat lab settings` prints the value of each with its meaning and reason.
    """

    halo: int = size(128, "Halo of the tiles in which large frames are matched at full size, pixels")
    at_once: int = size(1_200_000, "Pixels of alpha matched at once")
    consistent: float = tuned(
        0.2,
        "Middlebury, tune half: matching back from beta ends less than this (times 8 pixels) from the match",
    )


SETTINGS = InputsSettings()
CONSISTENT = SETTINGS.consistent
FINE = 2
"""Factor by which images are reduced for matching."""


@dataclass(frozen=True)
class Beta:
    """One beta's image with the field of alpha's pixels in it.

    Attributes:
        image: image (B, C, H, W), values 0..1, beyond for noise and exposure.
        field: segments or positions of alpha's pixels, in pixels of `image`.
        offset: (x, y) of its first pixel in the whole image; other than (0, 0) for a part of an image.
        track: function from alpha's pixels (*n, 2) to their tracks in the image; None if not known, as for a
            beta that is uncalibrated, known by a link, or of a pair with lenses.
        around: True if each segment is around a known depth of its own pixel: positions along the segments of
            two pixels cannot be compared.
        cameras: names of the cameras whose bands are its channels, in order; empty if not known.
        clipped: mask (B, C, H, W), True where a band is at its largest value or beside such a pixel; None for
            none.
    """

    image: Float[Tensor, "b c h w"]
    field: FieldOnGrid
    offset: tuple[int, int] = (0, 0)
    track: Callable[[Tensor], Track] | None = None
    around: bool = False
    cameras: tuple[str, ...] = ()
    clipped: Bool[Tensor, "b c h w"] | None = None


@dataclass(frozen=True)
class Inputs:
    """Inputs of matching and of a network: alpha's image and the betas, which may be of any sizes.

    Attributes:
        alpha: image (B, C, H, W), values 0..1, beyond for noise and exposure; one channel and even sides for
            matching.
        betas: the betas.
        multiple: pixels at whose multiples parts of alpha and betas are cut.
        beta_halo: pixels around the segments that parts of betas include.
        luminance: alpha's share of the result's luminance, for networks that keep it; the rest is beta's.
        bands: number of the result's bands, whose luminance (the mean, if they are not three) alpha sees;
            None for the bands of all betas, of which alpha may see any combination.
        learned: True if the trained networks of choice and confidence take part in matching.
        sees_luma: True if alpha sees about RGB betas' luma, as far as is known: not in the near infrared.
    """

    alpha: Float[Tensor, "b c h w"]
    betas: tuple[Beta, ...]
    multiple: int = 1
    beta_halo: int = 0
    luminance: float = 1.0
    bands: int | None = None
    learned: bool = True
    sees_luma: bool = True

    @classmethod
    def from_images(cls, alpha: Tensor, images: Sequence[Tensor], fields: Sequence[FieldOnGrid]) -> Inputs:
        """Return inputs of alpha with each beta's image and field, in order."""
        return cls(alpha, tuple(Beta(image, field) for image, field in zip(images, fields, strict=True)))

    @property
    def hw(self) -> HW:
        """Height and width of alpha's image."""
        return self.alpha.shape[-2], self.alpha.shape[-1]

    @property
    def cameras(self) -> list[tuple[str, ...]]:
        """Names of each beta's cameras; of betas without any, their numbers from 1."""
        return [beta.cameras or (str(number),) for number, beta in enumerate(self.betas, 1)]

    @property
    def nbytes(self) -> int:
        """Memory of images, masks and fields, bytes."""
        masks = sum(beta.clipped.nbytes for beta in self.betas if beta.clipped is not None)
        return masks + self.alpha.nbytes + sum(beta.image.nbytes + beta.field.nbytes for beta in self.betas)

    @property
    def pieces(self) -> list[Tile]:
        """Pieces in which a frame is matched: one, or of a large frame those with the least work."""
        if math.prod(self.hw) <= SETTINGS.at_once:
            return [whole(self.hw)]
        sides = sides_by_work(self.hw, SETTINGS.halo, self.multiple, SETTINGS.at_once)
        return list(tiles_of(self.hw, sides[0], SETTINGS.halo))

    def in_pieces(self, make: Callable[..., Any], *more: Any) -> Any:
        """Apply a function to these inputs, or to tiles of large ones (`pieces`), and assemble the results.

        Args:
            make: function of `Inputs` (and of each of `more`) that returns one plane (..., h, w) or several,
                of the size of its `alpha` or smaller by a whole factor.
            more: values with a method `cut(box)`, which are cut to the same tiles.

        Returns:
            Planes of the whole frame: a tensor or a tuple; with a single tile the function's own result.
        """
        if len(self.pieces) == 1:
            return make(self, *more)
        return assembled(self.hw, zip(self.pieces, (make(*parts) for parts in self.cut_in_pieces(*more))))

    def cut_in_pieces(self, *more: Any) -> Iterator[list[Any]]:
        """Yield these inputs and other values with a method `cut(box)` in each of `pieces`, in turn."""
        return ([one.cut(piece.outer) for one in (self, *more)] for piece in self.pieces)

    @property
    def can_agree(self) -> bool:
        """True if all betas are calibrated and have straight fields, of one frame.

        There must be several, or one with segments `around` a known depth.
        """
        fields = [beta.field.pixels for beta in self.betas]
        one = len(self.alpha) == 1 and all(field is not None and len(field.valid) == 1 for field in fields)
        several = len(fields) > 1 or any(beta.around for beta in self.betas)
        return several and one and all(beta.track is not None for beta in self.betas)

    def shows_all_bands(self, beta: Beta) -> bool:
        """Return True if the beta is one of several and shows all bands of the result."""
        return len(self.betas) > 1 and beta.image.shape[1] == self.bands

    @property
    def by_beta(self) -> list[Inputs]:
        """The same with each beta alone."""
        return [replace(self, betas=(beta,)) for beta in self.betas]

    def cut(self, box: Box) -> Inputs:
        """Return a part of alpha, (top, bottom, left, right), with the part of each beta that it touches."""
        top, bottom, left, right = box
        return replace(
            self,
            alpha=self.alpha[..., top:bottom, left:right],
            betas=tuple(self._cut(b, box) for b in self.betas),
        )

    def touched(self, beta: Beta, box: Box, step: int = 2) -> Box:
        """Compute the part of a beta that the segments or positions of a part of alpha touch.

        Args:
            beta: one of `betas`.
            box: part of alpha: top, bottom, left, right.
            step: distance of the rows and columns of alpha that are looked at.

        Returns:
            Rows and columns of beta, `beta_halo` included: top, bottom, left, right, as of `box_around`.
        """
        hw = beta.image.shape[-2], beta.image.shape[-1]
        return box_around(_ends_in(beta.field, box, step), hw, self.beta_halo, self.multiple)

    def _cut(self, beta: Beta, box: Box) -> Beta:
        y0, y1, x0, x1 = self.touched(beta, box)
        offset = (beta.offset[0] + x0, beta.offset[1] + y0)
        top, _, left, _ = box
        track = beta.track and track_in(beta.track, lambda x: x + x.new_tensor((left, top)), 1.0, (-x0, -y0))
        part, field = (..., slice(y0, y1), slice(x0, x1)), beta.field.cut(box, (x0, y0))
        image, clipped = beta.image[part], beta.clipped if beta.clipped is None else beta.clipped[part]
        return replace(beta, image=image, field=field, offset=offset, track=track, clipped=clipped)


def track_in(
    track: Callable[[Tensor], Track],
    whole: Callable[[Tensor], Tensor],
    scale: float,
    offset: tuple[float, float],
) -> Callable[[Tensor], Track]:
    """Convert a function of tracks to a part of alpha, or a resized one, and a resized or cropped beta.

    Args:
        track: function from pixels of the whole alpha to tracks in the whole beta.
        whole: function from pixels of the part of alpha to those of the whole.
        scale: factor of beta's pixels.
        offset: (x, y) added after that, in new pixels.

    Returns:
        Function from pixels of the part to tracks in the new pixels of beta.
    """

    def changed(v: Tensor) -> Tensor:
        return torch.cat([scale * v[..., :2] + v.new_tensor(offset) * v[..., 2:], v[..., 2:]], -1)

    return lambda x: Track(*map(changed, track(whole(x))))


def ends_of(locations: Segments | Positions) -> Float[Tensor, "n 2"]:
    """Return the ends of valid segments, or the positions that count."""
    if isinstance(locations, Positions):
        return locations.xy[locations.mask]
    return torch.cat([locations.start[locations.valid], locations.end[locations.valid]])


def box_around(points: Float[Tensor, "n 2"], hw: HW, halo: int, multiple: int) -> Box:
    """Compute the part of an image around points.

    Points off the image count as the nearest pixel.

    Args:
        points: pixels (x, y), floats.
        hw: height and width of the image.
        halo: pixels to add on each side.
        multiple: number to whose multiples the part is widened, as far as the image goes.

    Returns:
        Rows and columns: top, bottom (after the last), left, right; without points the first `multiple` of
        each, whatever `hw`.

    Raises:
        ValueError: for NaN.
    """
    if not len(points):
        return 0, multiple, 0, multiple
    points = points.clamp(min=0).minimum(points.new_tensor([hw[1] - 1, hw[0] - 1]))  # some may be off it
    corners = torch.stack([points.amin(0) - halo, points.amax(0) + halo + multiple])
    if bool(corners.isnan().any()):
        raise ValueError("points hold NaN: leave those out that are not known")
    (x0, y0), (x1, y1) = torch.div(corners, multiple, rounding_mode="floor").long() * multiple
    return max(int(y0), 0), min(int(y1), hw[0]), max(int(x0), 0), min(int(x1), hw[1])


def _ends_in(field: FieldOnGrid, box: Box, step: int) -> Float[Tensor, "n 2"]:
    """Return the ends of the segments of every `step`-th pixel of a box.

    Of positions, the corners of the box that each row touches, asked for row by row.
    """
    top, bottom, left, right = box
    rows, columns = torch.arange(top, bottom, step), torch.arange(left, right, step)
    if field.pixels is None:
        asked = (torch.stack([columns, y.expand_as(columns)], -1).float() for y in rows)
        touched = [points for points in (ends_of(field.at(x)) for x in asked) if len(points)]
        return torch.cat([torch.stack([p.amin(0), p.amax(0)]) for p in touched] or [torch.zeros(0, 2)])
    some = (slice(None), rows[:, None], columns)
    return ends_of(field.pixels[some])


class Extent(NamedTuple):
    r"""Lengths and directions of segments.

    Attributes:
        length: lengths (*n), pixels.
        towards: unit vectors (x, y) from end to start (*n, 2); zero where a segment is a point.
    """

    length: Tensor
    towards: Tensor

    @classmethod
    def from_segments(cls, segments: Segments) -> Extent:
        """Compute the lengths and directions of segments."""
        length = segments.length
        return cls(length, (segments.start - segments.end) / torch.where(length > 0, length, 1.0)[..., None])


def reduced(segments: Segments, factor: int) -> Segments:
    """Return the same segments in pixels of a beta that is `factor` times smaller."""
    start, end = ((x + 0.5) / factor - 0.5 for x in (segments.start, segments.end))
    return Segments(start, end, segments.valid)


def match_positions(
    segments: Segments,
    disparity: Float[Tensor, "b 1 _ _"],
    *,
    beyond_edge: bool = False,
    extent: Extent | None = None,
) -> Float[Tensor, "b h w 2"]:
    """Compute the positions of matches in beta.

    Args:
        segments: segments (B or 1, H, W) of alpha's pixels.
        disparity: distance of the match from the segment's end, pixels of beta: (B, 1, H, W), or of half the
            size, and interpolated.
        beyond_edge: True to allow positions beyond the segments' starts; else they are moved onto the start.
        extent: extent of the segments; None to compute it.

    Returns:
        Positions (x, y) in beta's pixels, in the type of the segments, never beyond their ends; those of
        invalid segments mean nothing.
    """
    length, towards = extent or Extent.from_segments(segments)
    if disparity.shape[-2:] != length.shape[-2:]:
        disparity = interpolate(disparity, scale_factor=FINE, mode="bilinear")
    far = disparity[:, 0].to(length).clamp(min=0)
    return torch.addcmul(segments.end, (far if beyond_edge else far.minimum(length))[..., None], towards)


def at_matches(
    beta: Float[Tensor, "b c hb wb"],
    segments: Segments,
    disparity: Float[Tensor, "b 1 _ _"],
    extent: Extent | None = None,
) -> tuple[Float[Tensor, "b c h w"], Bool[Tensor, "b 1 h w"]]:
    """Sample beta bicubically at the matches, kept on their segments; beyond beta's edge, at the edge.

    Args:
        disparity: distance of the match from the segment's end, as for `match_positions`.
        extent: extent of the segments; None to compute it.

    Returns:
        Bands at alpha's pixels, and a mask of the matches that are on beta: False for invalid segments, whose
        bands mean nothing.
    """
    hw, middle = (
        (beta.shape[-2], beta.shape[-1]),
        match_positions(segments, disparity, extent=extent).to(beta),
    )
    position = middle.reshape(len(beta), -1, 2)
    inside = position.clamp(min=0).minimum(position.new_tensor([hw[1] - 1, hw[0] - 1]))
    values = sample(beta, inside, interpolation="bicubic").values
    return values.reshape(*beta.shape[:2], *middle.shape[1:3]), (segments.valid & on_image(middle, hw))[
        :, None
    ]


def enlarged(x: Tensor) -> Tensor:
    """Enlarge planes (*b, h, w) of half the size to full size: each value four times."""
    return x.repeat_interleave(FINE, -1).repeat_interleave(FINE, -2)


def is_consistent(facts: Float[Tensor, "b 3 h2 w2"]) -> Float[Tensor, "b 1 h w"]:
    """Return 1 where the match is consistent, at full size."""
    return enlarged((facts[:, :1] < CONSISTENT).to(facts))


CHANNELS = {"disparity": 1, "chosen": 1, "facts": 3, "stated": 2, "certainty": 2}
"""Number of channels of each plane of `BetaMatches`."""
AT_HALF_SIZE = ("facts", "stated", "certainty")


class Comparison(NamedTuple):
    """Combination of a beta's bands that is compared with alpha, and its normalisation to alpha.

    Attributes:
        mix: combination of bands that alpha sees; None for Rec. 601 luma of three bands, the mean of others.
        whole: normalisation of the combination.
        half: normalisation of the combination at half the size.
    """

    mix: SpectralMix | None
    whole: Normalisation
    half: Normalisation

    @classmethod
    def from_images(
        cls, alpha: Float[Tensor, "b 1 h w"], beta: Float[Tensor, "b c hb wb"], mix: SpectralMix | None = None
    ) -> Comparison:
        """Estimate the comparison of whole images of even sides, by this mix."""
        other = combined_bands(beta, mix)
        half = Normalisation.from_images(avg_pool2d(alpha, 2), avg_pool2d(other, 2))
        return cls(mix, Normalisation.from_images(alpha, other), half)

    def combined(self, beta: Float[Tensor, "b c hb wb"]) -> Float[Tensor, "b 1 hb wb"]:
        """Return the combination of beta's bands, or of a part of it."""
        return combined_bands(beta, self.mix)

    def views(self, alpha: Float[Tensor, "b 1 h w"], beta: Float[Tensor, "b c hb wb"]) -> ComparedViews:
        """Return alpha and the combination of beta's bands, or parts of them, as they are compared."""
        return self.whole.views(alpha, self.combined(beta))

    def half_views(self, alpha: Float[Tensor, "b 1 h w"], beta: Float[Tensor, "b c hb wb"]) -> ComparedViews:
        """Return the same at half the size."""
        return self.half.views(avg_pool2d(alpha, 2), avg_pool2d(self.combined(beta), 2))


def combined_bands(
    beta: Float[Tensor, "b c h w"], mix: SpectralMix | None = None
) -> Float[Tensor, "b 1 h w"]:
    """Combine the bands by a mix; without one return Rec. 601 luma of three bands, the mean of others."""
    if mix is not None:
        return mix.combined(beta)
    return luminance(beta) if beta.shape[1] == 3 else beta.mean(1, keepdim=True)


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
