"""A receptive field evaluated once for every pixel of alpha, which can be cut like an image."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..pair import Pair
from ..pixels import HW, pixel_coordinates, pixel_grid
from ..runtime.chunks import Box, chunked
from ..segments import Positions, Segments, clip_to_image
from .protocol import ReceptiveField, SamplingLocations, device_of, lazily

At = Callable[[Tensor], SamplingLocations]
"""Function from alpha's pixels (n, 2) to a field's sampling locations."""

BLOCK = 2
"""Side of the blocks of alpha's pixels whose centres `FieldOnGrid.blocks` has."""
LARGE = 1 << 22
"""Number of pixels of a grid from which its segments are stored as float32."""
_CHUNK = 1 << 18
"""Number of pixels evaluated at once."""


@dataclass(frozen=True)
class FieldOnGrid:
    """Receptive field of a pair, evaluated on every pixel of alpha.

    Fields are asked in float64: the rounding of float32 is enough to change which of two equally good
    matches is taken. A large grid's segments are stored as float32 nevertheless, and converted to float64
    when they are cut: the rounding is the same whatever the parts.

    Attributes:
        at: function from any pixels of alpha (n, 2) to segments or positions, (n) or for a batch of rigs
            (B, n).
        samples: number of positions to sample from a segment, or number of explicit positions.
        pixels: segments (B or 1, H, W) in beta's pixels; None for explicit positions, which only `at` gives.
        blocks: segments (B or 1, H / 2, W / 2) of the centres of blocks of 2 x 2 pixels; None for explicit
            positions, and by `from_field` for a large grid and if not requested.
    """

    at: At
    samples: int
    pixels: Segments | None
    blocks: Segments | None = None

    @classmethod
    def from_field(
        cls, field: ReceptiveField, pair: Pair, *, hw: HW | None = None, blocks: bool = True
    ) -> FieldOnGrid:
        """Evaluate a pair's field on alpha's pixels, with about one sample a pixel of the longest segment.

        Args:
            hw: size of the grid; None for alpha's. Larger for images that are padded at the bottom and the
                right.
            blocks: True to evaluate blocks of 2 x 2 pixels too, unless the grid is large.

        Returns:
            The field; segments that are NaN or infinite are not valid, and all are clipped to beta's image if
            one (of every fourth row and column) is longer than its diagonal. Explicit positions are not
            evaluated: a whole frame's may not fit into memory.

        Raises:
            ValueError: for an invalid result of the field, or whatever the field raises for this pair.
            TypeError: for an object that is no field.
        """
        evaluate, hw = lazily(field, pair), hw or pair.alpha.hw
        device = device_of(pair)
        # Explicit positions of a whole frame may not fit into memory: one point shows which kind the field
        # gives.
        kind = evaluate(torch.full((1, 2), 0.25, dtype=torch.float64))
        if isinstance(kind, Positions):
            return cls(lambda x: _finite(evaluate(x)), kind.xy.shape[-2], None)
        pixels = _on_grid(evaluate, hw, device=device)
        h, w = pair.alpha.hw
        sparse = (..., slice(0, h, 4), slice(0, w, 4))
        longest = torch.where(pixels.valid[sparse], pixels.length[sparse].detach().float(), 0.0).max()
        if longest > math.hypot(*pair.beta.hw) + 1:  # of one's own, and what is off the image does not count
            return cls.from_field(_clipped(field), pair, hw=hw, blocks=blocks)
        on_grid = cls(evaluate, int(torch.ceil(longest)) + 1, pixels)
        return replace(on_grid, blocks=on_grid.of_blocks(BLOCK)) if blocks and not on_grid.large else on_grid

    @classmethod
    def evaluated(cls, evaluate: Callable[[Tensor], Segments], hw: HW, samples: int) -> FieldOnGrid:
        """Evaluate a straight field, given as a function of alpha's pixels, on a grid of even sides.

        Args:
            samples: number of positions to sample from a segment.
        """
        on_grid = cls(evaluate, samples, _on_grid(evaluate, hw))
        return replace(on_grid, blocks=on_grid.of_blocks(BLOCK))

    def of_blocks(self, side: int) -> Segments:
        """Evaluate the segments at the centres of blocks of `side` x `side` pixels.

        Returns:
            Segments (B or 1, H / side, W / side) in beta's pixels, rounded down where `side` is no divisor;
            for side 2 `blocks` itself, if there is one.

        Raises:
            ValueError: for a field of explicit positions.
        """
        if self.blocks is not None and side == BLOCK:
            return self.blocks
        h, w = self.straight.valid.shape[-2:]
        return _on_grid(self.at, (h // side, w // side), side, self.straight.start.device)

    def displaced(self, step: Callable[[Segments, Tensor], Tensor]) -> FieldOnGrid:
        """Move the segments of a straight field.

        Args:
            step: function from segments, (n) or (B, n), and alpha's pixels (n, 2) to steps in beta's pixels,
                which broadcast to the segments' ends.

        Returns:
            A new field; both ends of each segment are moved by the step, and not clipped to beta's image.

        Raises:
            ValueError: for a field of explicit positions.
        """

        def moved(locations: SamplingLocations, x: Tensor) -> Segments:
            assert isinstance(locations, Segments)
            return _shifted(locations, -step(locations, x))

        def grid(stored: Segments, side: int) -> Segments:
            def at(x: Tensor) -> Segments:
                top, bottom = (round(float((x[i, 1] + 0.5) / side - 0.5)) for i in (0, -1))
                rows = (t[:, top : bottom + 1].flatten(1, 2) for t in _parts(stored))
                return moved(_exact(Segments(*rows)), x)

            h, w = stored.valid.shape[-2:]
            return _on_grid(at, (h, w), side, stored.start.device)

        blocks = self.blocks and grid(self.blocks, BLOCK)
        return replace(self, at=lambda x: moved(self.at(x), x), pixels=grid(self.straight, 1), blocks=blocks)

    def any_valid(self, hw: HW) -> bool:
        """Return True if any of alpha's h x w pixels, in every eighth row and column, may see into beta."""
        h, w = hw
        if self.pixels is not None:
            return bool(self.pixels.valid[..., :h:8, :w:8].any())
        locations = self.at(pixel_grid(hw)[::8, ::8].reshape(-1, 2))
        assert isinstance(locations, Positions)
        return bool(locations.mask.any())

    @property
    def large(self) -> bool:
        """True if segments are stored as float32."""
        return self.pixels is not None and self.pixels.valid[0].numel() >= LARGE

    @property
    def straight(self) -> Segments:
        """Segments (B or 1, H, W) of every pixel of alpha, in beta's pixels; float32 if `large`.

        Raises:
            ValueError: for a field of explicit positions.
        """
        if self.pixels is None:
            raise ValueError(
                "this network samples straight segments: choose a straight field, or undistort the images"
            )
        return self.pixels

    @property
    def nbytes(self) -> int:
        """Memory held by the segments, bytes."""
        parts = [p for p in (self.pixels, self.blocks) if p is not None]
        return sum(t.nbytes for segments in parts for t in (segments.start, segments.end, segments.valid))

    def cut(self, box: Box, shift: tuple[int, int] = (0, 0)) -> FieldOnGrid:
        """Return the field of a window of alpha, for a beta cut at `shift`.

        Args:
            box: window of alpha: top, bottom, left, right, with bottom and right exclusive; all even, which
                is not checked.
            shift: pixel (x, y) of beta that becomes (0, 0).

        Returns:
            The field on the window's pixels (`at` counts from its corner too), in pixels of the cut beta, to
            which segments are not clipped; segments in float64.
        """
        top, _, left, _ = box

        def at(x: Tensor) -> SamplingLocations:
            locations = self.at(x + x.new_tensor([left, top]))
            if isinstance(locations, Positions):
                return Positions(locations.xy - locations.xy.new_tensor(shift), locations.mask)
            return _shifted(locations, shift)

        pixels = self.pixels and _window(self.pixels, box)
        pixels = pixels and _shifted(_exact(pixels) if self.large else pixels, shift)
        blocks = self.blocks and _shifted(_window(self.blocks, tuple(n // BLOCK for n in box)), shift)
        return FieldOnGrid(at, self.samples, pixels, blocks)

    def of_one(self, i: int) -> FieldOnGrid:
        """Return the field of the i-th rig of a batch, still with a batch axis, of length 1."""

        def one(locations: SamplingLocations) -> SamplingLocations:
            parts = [t if len(t) == 1 else t[i : i + 1] for t in vars(locations).values()]
            return type(locations)(*parts)

        pixels, blocks = (segments and one(segments) for segments in (self.pixels, self.blocks))
        return FieldOnGrid(lambda x: one(self.at(x)), self.samples, pixels, blocks)  # type: ignore[arg-type]


def _on_grid(evaluate: At, hw: HW, side: int = 1, device: torch.device | None = None) -> Segments:
    """Evaluate a straight field at the centres of h x w blocks of so many pixels as (B or 1, h, w)."""
    h, w = hw

    def segments(x: Tensor, y: Tensor) -> tuple[Tensor, ...]:
        locations = evaluate((torch.stack([x, y], -1).reshape(-1, 2) + 0.5) * side - 0.5)
        assert isinstance(locations, Segments)
        # Own fields may divide by zero where nothing is valid; compiled loops look up whatever is there.
        total, shape = locations.start + locations.end, (-1, *y.shape[1:])
        valid = locations.valid & (total[..., 0] + total[..., 1]).isfinite()
        ends = (end.nan_to_num(0.0, 0.0, 0.0).reshape(*shape, 2) for end in (locations.start, locations.end))
        return *(end.float() if h * w >= LARGE else end for end in ends), valid.reshape(shape)

    x, y = pixel_coordinates(hw, dtype=torch.float64, device=device)
    return Segments(*chunked(segments, x[None], y[None], rows=max(_CHUNK // max(w, 1), 1), axis=1))


def _clipped(field: ReceptiveField) -> ReceptiveField:
    """Return a field with the part on beta's image of each of a field's segments."""

    def on_image(pair: Pair, x: Tensor) -> Segments:
        segments = field(pair, x)
        assert isinstance(segments, Segments)
        part = clip_to_image(segments.start.double(), segments.end.double(), pair.beta.hw)
        return replace(part, valid=part.valid & segments.valid)

    return on_image


def _finite(locations: SamplingLocations) -> Positions:
    """Mask positions that are NaN or infinite: users' fields may divide by zero."""
    assert isinstance(locations, Positions)
    finite = locations.xy.isfinite().all(-1)
    return Positions(torch.where(finite[..., None], locations.xy, 0.0), locations.mask & finite)


def _exact(segments: Segments) -> Segments:
    return Segments(segments.start.double(), segments.end.double(), segments.valid)


def _parts(segments: Segments) -> tuple[Tensor, Tensor, Tensor]:
    return segments.start, segments.end, segments.valid


def _window(segments: Segments, box: Box) -> Segments:
    rows, columns = slice(box[0], box[1]), slice(box[2], box[3])
    return Segments(*(t[:, rows, columns] for t in _parts(segments)))


def _shifted(segments: Segments, shift: tuple[int, int] | Tensor) -> Segments:
    if shift == (0, 0):
        return segments
    step = shift if isinstance(shift, Tensor) else segments.start.new_tensor(shift)
    return Segments(segments.start - step, segments.end - step, segments.valid)
