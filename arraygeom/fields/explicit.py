"""Fields that are lists of positions: the paper's nearest pixels, windows, everything."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Real
from torch import Tensor

from ..checks import check_above
from ..epipolar import epipolar_lines
from ..homography import apply_homography
from ..pair import Pair
from ..pixels import HW, floating, pixel_grid, within
from ..runtime.chunks import chunked, spans
from ..runtime.threads import in_parallel
from ..runtime.tracing import traced
from ..segments import Positions
from .protocol import PIECE, compilable
from .straight import require_straight


@dataclass(frozen=True)
class NearestVoxels:
    """Field of the integer pixels of beta nearest the epipolar line, in a window about H x; from F, or from
    calibration.

    The paper's own construction, with H as in `Pair.homography`. Distances are perpendicular to the line;
    pixels equally far, to 1e-3 px, are taken by row, then column. Where fewer pixels of the image lie in the
    window the rest are masked, and where there is no line (the epipole, no baseline) all are.

    Attributes:
        count: number of pixels, at least 1.
        window: pixels from the pixel nearest to H x to the edge of the window, in x and y, at least 0.

    Raises:
        ValueError: for a smaller `count` or `window`.
        TypeError: for one that is no whole number.
    """

    count: int = 96
    window: int = 80

    def __post_init__(self) -> None:
        check_above(1, whole=True, count=self.count)
        check_above(0, whole=True, window=self.window)

    def __call__(self, pair: Pair, x: Real[Tensor, "*n 2"]) -> Positions:
        """Compute the positions in beta of alpha's pixels. Not differentiable: pixels are whole.

        Returns:
            Positions (*n, count, 2) in beta's pixels, the nearest first; masked ones are 0.

        Raises:
            ValueError: for a pair with lenses, or with neither F nor calibration.
        """
        require_straight(pair)
        x = floating(x)
        with torch.no_grad():
            line = epipolar_lines(pair.fundamental, x)
            centre, placed = apply_homography(pair.homography, x)
        usable = placed & (line != 0).any(-1) & within(centre, pair.beta.hw, self.window)
        axes = usable.shape
        line, centre = line.expand(*axes, 3), centre.round().expand(*axes, 2)
        line, centre = line.reshape(-1, 3), centre.reshape(-1, 2)
        if compilable(line):
            xy, mask = self._compiled(line, centre, usable.reshape(-1), pair.beta.hw)
            return Positions(xy.reshape(*axes, self.count, 2), mask.reshape(*axes, self.count))
        xy, mask = self._nearest(line, centre, pair)
        xy, mask = xy.reshape(*axes, self.count, 2), mask.reshape(*axes, self.count) & usable[..., None]
        return Positions(torch.where(mask[..., None], xy, 0.0), mask)

    def _nearest(self, line: Tensor, centre: Tensor, pair: Pair) -> tuple[Tensor, Tensor]:
        """Search beside the line first, and the whole window where that may not hold the nearest `count`."""
        if traced():
            return self._choose(self._window(centre), line, centre, pair)[:2]
        beside = 2 + self.count // (2 * self.window + 1)
        xy, mask, distance = self._choose(self._candidates(line, centre, beside), line, centre, pair)
        searched = (beside + 0.5) * line[:, :2].abs().amax(-1)
        unsure = (distance.amax(-1) > searched - TIE).nonzero()[:, 0]

        def in_window(line: Tensor, centre: Tensor) -> tuple[Tensor, Tensor]:
            return self._choose(self._window(centre), line, centre, pair)[:2]

        xy[unsure], mask[unsure] = chunked(in_window, line[unsure], centre[unsure], rows=64, axis=0)
        return xy, mask

    def _compiled(self, line: Tensor, centre: Tensor, usable: Tensor, hw: HW) -> tuple[Tensor, Tensor]:
        """Search by a compiled loop, which keeps no list of candidates of all pixels."""
        from .kernels import nearest_pixels

        n, size = len(line), line.dtype.itemsize
        xy = torch.from_numpy(np.empty((n, self.count, 2), f"f{size}"))
        mask = torch.from_numpy(np.empty((n, self.count), bool))
        numbers = [tensor.contiguous().numpy() for tensor in (line, centre, usable)]
        rest = (self.window, xy.numpy().dtype.type(TIE / (hw[0] * hw[1])), hw, xy.numpy(), mask.numpy())
        in_parallel([partial(nearest_pixels, *span, *numbers, *rest) for span in spans(n, PIECE)])
        return xy, mask

    def _choose(self, xy: Tensor, line: Tensor, centre: Tensor, pair: Pair) -> tuple[Tensor, Tensor, Tensor]:
        """Choose the nearest `count` of some candidates: pixels, a mask of those that count, distances."""
        h, w = pair.beta.hw
        inside = pair.beta.contains(xy) & ((xy - centre[:, None]).abs() <= self.window).all(-1)
        at_centre = (centre * line[:, :2]).sum(-1, keepdim=True) + line[:, 2:]
        distance = ((xy - centre[:, None]) * line[:, None, :2]).sum(-1) + at_centre
        order = (xy[..., 1] * w + xy[..., 0]) * (TIE / (h * w))
        key = torch.where(inside, distance.abs() + order, torch.inf)
        pad = self.count - key.shape[-1]
        if pad > 0:
            key = torch.nn.functional.pad(key, (0, pad), value=torch.inf)
            xy = torch.nn.functional.pad(xy, (0, 0, 0, pad))
        nearest = key.topk(self.count, largest=False)
        mask = nearest.values.isfinite()
        return xy.gather(-2, nearest.indices[..., None].expand(*mask.shape, 2)), mask, nearest.values

    def _candidates(self, line: Tensor, centre: Tensor, beside: int) -> Tensor:
        """List whole pixels (n, k, 2) nearest the line in every column of the window (or row, if steep)."""
        steps, across = (torch.arange(-n, n + 1).to(line) for n in (self.window, beside))
        steep = line[:, 0].abs() > line[:, 1].abs()
        u = torch.where(steep, centre[:, 1], centre[:, 0])[:, None] + steps
        along, other = (torch.where(steep, line[:, i], line[:, j])[:, None] for i, j in ((1, 0), (0, 1)))
        crossing = -(along * u + line[:, 2:]) / torch.where(other == 0, 1.0, other)
        v = crossing.round()[..., None] + across
        u = u[..., None].expand_as(v)
        return torch.where(
            steep[:, None, None, None], torch.stack([v, u], -1), torch.stack([u, v], -1)
        ).flatten(1, 2)

    def _window(self, centre: Tensor) -> Tensor:
        """List all pixels (n, k, 2) of the windows."""
        side = 2 * self.window + 1
        grid = pixel_grid((side, side), dtype=centre.dtype, device=centre.device) - self.window
        return centre[:, None] + grid.reshape(-1, 2)


TIE = 1e-3
"""Difference of distances, in pixels, below which they count as equal."""


@dataclass(frozen=True)
class Local:
    """Field of a square window around H x; from H only (the CNN-like case).

    H is as in `Pair.homography`: the link's if it has one; for calibrated cameras that of the plane at the
    middle inverse depth, or at infinity without a depth range; else that of the same field of view.

    Attributes:
        size: samples per side, at least 1.
        spacing: pixels of beta between samples, at least 0.

    Raises:
        ValueError: for a smaller `size` or `spacing`, infinity or NaN.
        TypeError: for a `size` that is no whole number, or a `spacing` that is no number.
    """

    size: int = 5
    spacing: float = 1.0

    def __post_init__(self) -> None:
        check_above(1, whole=True, size=self.size)
        check_above(0, spacing=self.spacing)

    def __call__(self, pair: Pair, x: Real[Tensor, "*n 2"]) -> Positions:
        """Compute the positions in beta of alpha's pixels.

        Returns:
            Positions (*n, size^2, 2) in beta's pixels, row by row, centred on H x; those outside the image,
            and all where there is no H x, are masked and 0.

        Raises:
            ValueError: for a pair with lenses.
        """
        require_straight(pair)
        x = floating(x)
        centre, placed = apply_homography(pair.homography, x)
        offsets = pixel_grid((self.size, self.size), dtype=x.dtype, device=x.device) - (self.size - 1) / 2
        xy = centre[..., None, :] + self.spacing * offsets.reshape(-1, 2)
        mask = pair.beta.contains(xy) & placed[..., None]
        return Positions(torch.where(mask[..., None], xy, 0.0), mask)


@dataclass(frozen=True)
class Dense:
    """Field of every `stride`-th pixel of beta, from sizes alone (small images, and the unphysical control).

    Attributes:
        stride: pixels between samples in x and y, at least 1.

    Raises:
        ValueError: for a smaller stride.
        TypeError: for one that is no whole number.
    """

    stride: int = 1

    def __post_init__(self) -> None:
        check_above(1, whole=True, stride=self.stride)

    def __call__(self, pair: Pair, x: Real[Tensor, "*n 2"]) -> Positions:
        """Return the same positions for every alpha pixel, row by row from beta's pixel (0, 0).

        Returns:
            Positions (*n, L, 2) in beta's pixels, L = ceil(H / stride) ceil(W / stride), none masked.
        """
        x = floating(x)
        grid = pixel_grid(pair.beta.hw, dtype=x.dtype, device=x.device)[:: self.stride, :: self.stride]
        xy = grid.reshape(-1, 2).expand(*x.shape[:-1], -1, 2)
        return Positions(xy, torch.ones_like(xy[..., 0], dtype=torch.bool))
