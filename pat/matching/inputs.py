"""Inputs of matching and fusion: alpha's image, and each beta's image and field of alpha's pixels in it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from arraygeom import Positions, Segments
from arraygeom.epipolar import Track
from arraygeom.fields.grid import FieldOnGrid
from arraygeom.pixels import HW
from arraygeom.runtime.chunks import Box, Tile, assembled, sides_by_work, tiles_of, whole

from ..support.settings import size


@dataclass(frozen=True)
class InputsSettings:
    """Settings of the tiles in which large frames are matched at full size, the same for any memory limit.

    `pat lab settings` prints the value of each with its meaning and reason.
    """

    halo: int = size(128, "Their halo, pixels")
    at_once: int = size(1_200_000, "Pixels of alpha matched at once")


SETTINGS = InputsSettings()


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
        pieces = self.pieces
        if len(pieces) == 1:
            return make(self, *more)
        made = (make(*(one.cut(piece.outer) for one in (self, *more))) for piece in pieces)
        return assembled(self.hw, zip(pieces, made))

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
