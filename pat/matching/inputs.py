"""What is matched and fused: alpha's image, and each beta's image and field of alpha's pixels in it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import Positions, Segments
from arraygeom.epipolar import Track
from arraygeom.fields.grid import FieldOnGrid
from arraygeom.pixels import HW
from arraygeom.runtime.chunks import Box, Tile, assembled, sides_by_work, tiles_of, whole

from ..support.settings import size


@dataclass(frozen=True)
class InputsSettings:
    """Of the pieces in which large frames are matched at full size, the same whatever memory is allowed."""

    halo: int = size(128, "Their halo, pixels")
    at_once: int = size(1_200_000, "Pixels of alpha matched at once")


SETTINGS = InputsSettings()


@dataclass(frozen=True)
class Beta:
    """One beta's image (B, C, H, W) and the field of alpha's pixels in it.

    `offset` is the (x, y) of its first pixel in the whole image, other than (0, 0) for a part of an image.
    `cameras` are the names of those whose bands it shows, one after another.
    `track` gives the tracks of alpha's pixels (*n, 2) in the image of a calibrated beta. With `around` each
    segment is around what is known of its own pixel: positions along the segments of two pixels are not to be
    compared.
    """

    image: Float[Tensor, "b c h w"]
    field: FieldOnGrid
    offset: tuple[int, int] = (0, 0)
    track: Callable[[Tensor], Track] | None = None
    around: bool = False
    cameras: tuple[str, ...] = ()


@dataclass(frozen=True)
class Inputs:
    """Alpha's image (B, C, H, W) and the betas, which may be of any sizes.

    Parts of betas are cut at whole multiples of `multiple` pixels, `beta_halo` pixels around the segments.
    `luminance` is alpha's share of the result's, for networks that keep it; the rest is beta's. `bands` are
    those of the result: so many, whose luminance (the mean, if they are not three) is what alpha sees, or
    None: those of all betas, of which alpha may see any combination. `sees_luma` is whether RGB betas' luma
    is about what alpha sees, as far as is known: not in the near infrared.
    `learned`: the networks of choice and certainty take part in matching.
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
    def of(cls, alpha: Tensor, images: Sequence[Tensor], fields: Sequence[FieldOnGrid]) -> Inputs:
        """Alpha with each beta's image and field, in order."""
        return cls(alpha, tuple(Beta(image, field) for image, field in zip(images, fields, strict=True)))

    @property
    def hw(self) -> HW:
        """Height and width of alpha's image."""
        return self.alpha.shape[-2], self.alpha.shape[-1]

    @property
    def cameras(self) -> list[tuple[str, ...]]:
        """The names of each beta's cameras; of betas without any, their numbers from 1."""
        return [beta.cameras or (str(number),) for number, beta in enumerate(self.betas, 1)]

    @property
    def nbytes(self) -> int:
        """Memory of images and fields."""
        return self.alpha.nbytes + sum(beta.image.nbytes + beta.field.nbytes for beta in self.betas)

    @property
    def pieces(self) -> list[Tile]:
        """The pieces in which a frame is matched: one, or those with the least work of a size that fits into
        memory (`InputsSettings`)."""
        if math.prod(self.hw) <= SETTINGS.at_once:
            return [whole(self.hw)]
        sides = sides_by_work(self.hw, SETTINGS.halo, self.multiple, SETTINGS.at_once)
        return list(tiles_of(self.hw, sides[0], SETTINGS.halo))

    def in_pieces(self, make: Callable[..., Any], *more: Any) -> Any:
        """Planes (..., h, w), or several, put together from what is made of each piece of these inputs, and
        of what is given besides, cut alike."""
        pieces = self.pieces
        if len(pieces) == 1:
            return make(self, *more)
        made = (make(*(one.cut(piece.outer) for one in (self, *more))) for piece in pieces)
        return assembled(self.hw, zip(pieces, made))

    @property
    def can_agree(self) -> bool:
        """Whether all betas, of which there are several or one `around` what is known, are calibrated and
        have straight fields, of one frame."""
        fields = [beta.field.pixels for beta in self.betas]
        one = len(self.alpha) == 1 and all(field is not None and len(field.valid) == 1 for field in fields)
        several = len(fields) > 1 or any(beta.around for beta in self.betas)
        return several and one and all(beta.track is not None for beta in self.betas)

    def shows_all_bands(self, beta: Beta) -> bool:
        """Whether the beta is one of several of which some show all bands of the result, and shows them."""
        return len(self.betas) > 1 and beta.image.shape[1] == self.bands

    @property
    def by_beta(self) -> list[Inputs]:
        """The same with each beta alone."""
        return [replace(self, betas=(beta,)) for beta in self.betas]

    def cut(self, box: Box) -> Inputs:
        """A part of alpha, (top, bottom, left, right), with the part of each beta that its segments touch."""
        top, bottom, left, right = box
        return replace(
            self,
            alpha=self.alpha[..., top:bottom, left:right],
            betas=tuple(self._cut(b, box) for b in self.betas),
        )

    def touched(self, beta: Beta, box: Box, step: int = 2) -> Box:
        """The part of a beta the segments of every `step`-th pixel of a box of alpha touch, with the halo."""
        hw = beta.image.shape[-2], beta.image.shape[-1]
        return box_around(_ends_in(beta.field, box, step), hw, self.beta_halo, self.multiple)

    def _cut(self, beta: Beta, box: Box) -> Beta:
        y0, y1, x0, x1 = self.touched(beta, box)
        offset = (beta.offset[0] + x0, beta.offset[1] + y0)
        top, _, left, _ = box
        track = beta.track and track_in(beta.track, lambda x: x + x.new_tensor((left, top)), 1.0, (-x0, -y0))
        image = beta.image[..., y0:y1, x0:x1]
        return replace(beta, image=image, field=beta.field.cut(box, (x0, y0)), offset=offset, track=track)


def track_in(
    track: Callable[[Tensor], Track],
    whole: Callable[[Tensor], Tensor],
    scale: float,
    offset: tuple[float, float],
) -> Callable[[Tensor], Track]:
    """Tracks of pixels that are those of `whole(x)` in alpha, in pixels of beta times a scale plus offset."""

    def changed(v: Tensor) -> Tensor:
        return torch.cat([scale * v[..., :2] + v.new_tensor(offset) * v[..., 2:], v[..., 2:]], -1)

    return lambda x: Track(*map(changed, track(whole(x))))


def ends_of(locations: Segments | Positions) -> Float[Tensor, "n 2"]:
    """The ends of valid segments, or the positions that count."""
    if isinstance(locations, Positions):
        return locations.xy[locations.mask]
    return torch.cat([locations.start[locations.valid], locations.end[locations.valid]])


def box_around(points: Float[Tensor, "n 2"], hw: HW, halo: int, multiple: int) -> Box:
    """The part of an image around points (x, y), or what is nearest to them, with a halo, corners at whole
    multiples or the end."""
    if not len(points):
        return 0, multiple, 0, multiple
    points = points.clamp(min=0).minimum(
        points.new_tensor([hw[1] - 1, hw[0] - 1])
    )  # own fields may be off it
    corners = torch.stack([points.amin(0) - halo, points.amax(0) + halo + multiple])
    (x0, y0), (x1, y1) = torch.div(corners, multiple, rounding_mode="floor").long() * multiple
    return max(int(y0), 0), min(int(y1), hw[0]), max(int(x0), 0), min(int(x1), hw[1])


def _ends_in(field: FieldOnGrid, box: Box, step: int) -> Float[Tensor, "n 2"]:
    """The ends of the segments of every `step`-th pixel of a box; of positions, the corners of what each row
    touches, asked for row by row."""
    top, bottom, left, right = box
    rows, columns = torch.arange(top, bottom, step), torch.arange(left, right, step)
    if field.pixels is None:
        asked = (torch.stack([columns, y.expand_as(columns)], -1).float() for y in rows)
        touched = [points for points in (ends_of(field.at(x)) for x in asked) if len(points)]
        return torch.cat([torch.stack([p.amin(0), p.amax(0)]) for p in touched] or [torch.zeros(0, 2)])
    some = (slice(None), rows[:, None], columns)
    return ends_of(field.pixels[some])
