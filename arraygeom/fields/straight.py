"""Fields that are straight in beta's image: one segment for each alpha pixel."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, get_args

import torch
from jaxtyping import Float, Real
from torch import Tensor

from ..batching import tensors_of
from ..camera import Camera
from ..checks import check_above, check_bounds
from ..epipolar import Track, epipolar_lines, segments_between, track
from ..homography import apply_homography, fit_homography
from ..pair import Depths, Link, Pair, depth_range
from ..pixels import HW, coarse_grid, floating, safe_sqrt
from ..runtime.chunks import chunked
from ..runtime.tracing import followed, needs_numbers
from ..segments import Segments, clip_to_image
from .protocol import CHUNK, all_pixels, segments_by_rows


@dataclass(frozen=True)
class Epipolar:
    """Field of the segment of the epipolar line between depth bounds; by calibration, whatever the link.

    A segment of which nothing is in beta's image and in front of beta is invalid. Without a baseline, with
    near = far, and for identical cameras it is a point. An alpha pixel on the epipole sees one point of beta,
    whatever the depth: a point too. Where the epipole is inside beta's image, segments end short of it:
    points of the line between the cameras would be behind one of them.

    Attributes:
        near: near bound in the rig's unit (metres); None for the pair's own.
        far: far bound, possibly infinite; None for the pair's own.

    Raises:
        ValueError: unless 0 < near <= far.
        TypeError: for a bound that is no number.
    """

    near: float | None = None
    far: float | None = None

    def __post_init__(self) -> None:
        check_bounds(self.near, self.far)

    def __call__(self, pair: Pair, x: Real[Tensor, "*n 2"]) -> Segments:
        """Compute the segments of alpha's pixels from near to far, inside beta's image and in front of it.

        Returns:
            Segments in beta's pixels, differentiable in the pair's numbers.

        Raises:
            ValueError: for a pair with lenses, and as `bounds` and `Pair.beta_from_alpha`.
        """
        require_pinholes(pair)
        return _between(pair, *self.bounds(pair), x)

    def bounds(self, pair: Pair) -> Depths:
        """Return near and far: this field's own where given, else the pair's.

        Returns:
            Near and far, in the rig's unit: tensors, (*b) for the pair's, float64 for this field's.

        Raises:
            ValueError: if neither states one, or near is infinite or beyond far.
        """
        if self.near is not None and self.far is not None:
            return depth_range(self.near, self.far)
        near, far = pair.depth_range
        return depth_range(near if self.near is None else self.near, far if self.far is None else self.far)


@dataclass(frozen=True)
class EpipolarLine:
    """Field of the whole epipolar line inside beta; from F or calibration.

    For a calibrated pair without a link, the part in front of both cameras, from depth zero to infinity (a
    point without a baseline); else all of it, from either end. From F, an alpha pixel on the epipole has no
    line, and the segment is invalid.
    """

    def __call__(self, pair: Pair, x: Real[Tensor, "*n 2"]) -> Segments:
        """Compute the segments of alpha's pixels across beta's image.

        Returns:
            Segments in beta's pixels, from near to far for a calibrated pair without a link; invalid where
            the line misses the image.

        Raises:
            ValueError: for a pair with lenses, or with neither calibration nor F.
        """
        if pair.link is None and pair.calibrated:
            baseline = pair.beta_from_alpha.t.detach().norm(dim=-1)
            infinite = torch.full_like(baseline, torch.inf)
            return _between(pair, torch.where(baseline > 0, NEAREST * baseline, infinite), infinite, x)
        require_straight(pair)
        F, (h, w) = pair.fundamental, pair.beta.hw

        def across(x: Tensor) -> Segments:
            middle = x.new_tensor([(w - 1) / 2, (h - 1) / 2])
            line = epipolar_lines(F, x)
            piece = line_piece(line, middle, x.new_tensor(float(h + w)), (h, w))
            return Segments(piece.start, piece.end, piece.valid & (line[..., :2] != 0).any(-1))

        return segments_by_rows(across, pair, floating(x))


NEAREST = 1e-3
"""Depth, as a share of the baseline, at which a line without a near bound begins."""


@dataclass(frozen=True)
class HomographyDisplacement:
    """Field of the part of the epipolar line up to `displacement` pixels either way from its point nearest to
    H x; from F and H, or from calibration.

    The paper's homography-based field, with H as in `Pair.homography` (`approximated` fits a better one). For
    a calibrated pair without a link a segment starts towards near and ends towards far. Where there is no
    line (at the epipole, and without a baseline) the segment is the point H x.

    Attributes:
        displacement: pixels of beta, at least 0; None for the smallest that covers near to far at every pixel
            of alpha's image, which needs calibration and a depth range.

    Raises:
        ValueError: for a displacement that is negative, infinite or NaN.
        TypeError: for one that is no number.
    """

    displacement: float | None = None

    def __post_init__(self) -> None:
        check_above(0, displacement=self.displacement)

    def __call__(self, pair: Pair, x: Real[Tensor, "*n 2"]) -> Segments:
        """Compute segments centred on the point of the line nearest to H x, then clipped to beta's image.

        Returns:
            Segments in beta's pixels.

        Raises:
            ValueError: for a pair with lenses, with neither F nor calibration, or uncalibrated or without a
                depth range if `displacement` is None.
        """
        require_straight(pair)
        F, H, hw = pair.fundamental, pair.homography, pair.beta.hw
        x, displacement = floating(x), self.displacement
        reach = (covering_displacement(pair) if displacement is None else torch.as_tensor(displacement)).to(x)
        reach = reach[(..., *[None] * (x.ndim - 1 - reach.ndim))] if reach.ndim else reach

        def around(x: Tensor) -> Segments:
            centre, placed = apply_homography(H, x)
            piece = line_piece(epipolar_lines(F, x), centre, reach, hw)
            return Segments(piece.start, piece.end, piece.valid & placed)

        return segments_by_rows(around, pair, x)


@dataclass(frozen=True)
class AroundHomography:
    """Field of the row within +-`reach` pixels of H x (`Pair.homography`), for cameras at one place.

    Attributes:
        reach: pixels of beta, at least 0, which is not checked.
    """

    reach: float

    def __call__(self, pair: Pair, x: Real[Tensor, "*n 2"]) -> Segments:
        """Compute segments centred on H x, from right to left, then clipped to beta's image.

        Returns:
            Segments in beta's pixels.

        Raises:
            ValueError: for a pair with lenses.
        """
        require_straight(pair)
        H, step = pair.homography, torch.tensor([self.reach, 0.0])

        def around(x: Tensor) -> Segments:
            centre, placed = apply_homography(H, x)
            piece = clip_to_image(centre + step.to(centre), centre - step.to(centre), pair.beta.hw)
            return Segments(piece.start, piece.end, piece.valid & placed)

        return segments_by_rows(around, pair, floating(x))


def covering_displacement(pair: Pair, x: Real[Tensor, "*n 2"] | None = None) -> Float[Tensor, "*b"]:
    """Compute the displacement that reaches near and far for every pixel x, along the epipolar line from its
    point nearest to H x.

    Depth-bounded segments count as beta's image clips them.

    Args:
        x: pixels of alpha; None for all.

    Returns:
        Pixels of beta (*b), differentiable in the pair's numbers; 0 if no pixel has a segment.

    Raises:
        ValueError: for a pair with lenses or without a depth range, and as `Pair.beta_from_alpha`.
    """
    squared = _squared_reach(pair, _widest(pair) if x is None else floating(x))
    squared = squared[..., None].flatten(len(pair.batch_shape))
    return safe_sqrt(torch.nn.functional.pad(squared, (0, 1)).amax(-1))  # of no pixels 0


def _squared_reach(pair: Pair, x: Tensor) -> Tensor:
    """Return the squared distance from the foot of H x to the segment's farther end; 0 without a segment."""
    exact = Epipolar()(pair, x)
    centre, placed = apply_homography(pair.homography, x)
    foot = foot_on_line(epipolar_lines(pair.fundamental, x), centre)
    squared = [(end - foot).square().sum(-1) for end in (exact.start, exact.end)]
    return torch.where(exact.valid & placed, torch.maximum(*squared), 0.0)


def _widest(pair: Pair) -> Tensor:
    """Return the alpha pixel (*b, 1, 2) of the largest displacement, searched again when the pair changes."""
    # Nothing is kept of a trace, nor as a tensor of inference mode, which no gradient could use later.
    if followed():
        return _searched_widest(pair)
    versions = tuple(None if t.is_inference() else t._version for t, _ in tensors_of(pair))
    if pair.memo.get("versions") != versions:
        with torch.inference_mode(mode=False):
            pair.memo.update(versions=versions, widest=_searched_widest(pair).clone())
    return pair.memo["widest"]


def _searched_widest(pair: Pair) -> Tensor:
    grid = all_pixels(pair)
    with torch.no_grad():
        rows = CHUNK // grid.shape[-2] + 1
        squared_reach = chunked(partial(_squared_reach, pair), grid, rows=rows, axis=len(pair.batch_shape))
    index = squared_reach.flatten(-2).argmax(-1)
    chosen = grid.reshape(-1, 2).index_select(0, index.reshape(-1)).reshape(*index.shape, 1, 2)
    return chosen.to(pair.cameras[0].K)


SIDES = Literal["left", "right", "either"]
"""The camera of a rectified pair that alpha is."""


@dataclass(frozen=True)
class Rectified:
    """Field of the horizontal segment in beta of a rectified pair, from the two sizes alone (the PAM case).

    Attributes:
        max_disparity: largest disparity, pixels of beta, at least 0; None for the whole row.
        alpha_is: "left" or "right", the camera of the rectified pair that alpha is: the segment goes to the
            left or right in beta from the pixel of the same place, for "either" both ways; a whole row goes
            from right to left for "right", else from left to right.

    Raises:
        ValueError: for a disparity that is negative, infinite or NaN, or another side.
        TypeError: for a disparity that is no number.
    """

    max_disparity: float | None = None
    alpha_is: SIDES = "left"

    def __post_init__(self) -> None:
        check_above(0, max_disparity=self.max_disparity)
        if self.alpha_is not in get_args(SIDES):
            raise ValueError(f"alpha_is must be one of {', '.join(get_args(SIDES))}, got {self.alpha_is!r}")

    def __call__(self, pair: Pair, x: Real[Tensor, "*n 2"]) -> Segments:
        """Compute segments from the largest disparity (near) to none (far), for "either" from left to right.

        Images of different sizes are taken to show the same view.

        Returns:
            Segments in beta's pixels, on its image; not differentiable in a rig, of which nothing but sizes
            is used.
        """
        (ha, wa), (hb, wb) = pair.alpha.hw, pair.beta.hw
        x = floating(x)
        column = (x[..., 0] + 0.5) * (wb / wa) - 0.5
        row = (x[..., 1] + 0.5) * (hb / ha) - 0.5
        near, far = self._run(column, wb)
        low, high = -0.5 if self.max_disparity is not None else 0.0, wb - 0.5
        overlaps = (torch.minimum(near, far) <= high) & (torch.maximum(near, far) >= low)
        start, end = (torch.stack([c.clamp(low, high), row], -1) for c in (near, far))
        return Segments(start, end, overlaps & (row >= -0.5) & (row <= hb - 0.5))

    def _run(self, column: Tensor, width: int) -> tuple[Tensor, Tensor]:
        if self.max_disparity is None:
            first, last = torch.zeros_like(column), torch.full_like(column, width - 1)
            return (last, first) if self.alpha_is == "right" else (first, last)
        left, right = column - self.max_disparity, column + self.max_disparity
        return {"left": (left, column), "right": (right, column), "either": (left, right)}[self.alpha_is]


def pinhole_track(pair: Pair, x: Real[Tensor, "*n 2"]) -> Track:
    """Return the track in beta of alpha's pixels, by inverse depth.

    Raises:
        ValueError: unless both cameras are calibrated and without lenses.
    """
    alpha, beta = require_pinholes(pair)
    return track(alpha.K, beta.K, pair.beta_from_alpha, x)


def require_pinholes(pair: Pair) -> tuple[Camera, Camera]:
    """Return both cameras of a pair.

    Raises:
        ValueError: unless they are calibrated and without lenses.
    """
    alpha, beta = pair.cameras
    require_straight(pair)
    return alpha, beta


def approximated(pair: Pair) -> Pair:
    """Fit H to the middles of a calibrated pair's depth-bounded segments: the paper's homography.

    Least squares in pixels of beta, over the segments that beta's image holds of every 16th alpha pixel.
    `HomographyDisplacement()` on the result takes the displacement that covers near to far.

    Returns:
        The pair with a link of its F (exact, or that of a link it had) and this H, differentiable.

    Raises:
        ValueError: for uncalibrated or batched pairs, lenses, no depth range, fewer than 4 of these pixels
            that beta sees between the bounds, and as `fit_homography`.
        NotImplementedError: within `torch.func.vmap`.
    """
    alpha, _ = pair.cameras
    if pair.batch_shape:
        raise ValueError("fitting works on one pair at a time: take one of the batch")
    x = coarse_grid(pair.alpha.hw).to(alpha.K)
    segments = Epipolar()(pair, x)
    valid = segments.valid
    needs_numbers("which pixels an approximation is fitted to", segments.start)
    if int(valid.sum()) < 4:
        raise ValueError(
            "beta sees next to nothing of alpha's image between near and far: nothing to fit a map to"
        )
    H = fit_homography(x[valid], (0.5 * (segments.start + segments.end))[valid])
    return replace(pair, link=Link(pair.fundamental, H))


def require_straight(pair: Pair) -> None:
    """Raise ValueError if a view has a lens."""
    if pair.has_lens:
        raise ValueError(
            "a straight field needs pinhole cameras: "
            "use Curved or ThroughLenses, or undistort the images first"
        )


def foot_on_line(line: Float[Tensor, "*#n 3"], point: Float[Tensor, "*#n 2"]) -> Float[Tensor, "*n 2"]:
    """Return the point of a line (scaled by `epipolar_lines`) nearest to a point; the point without one."""
    l0, l1, l2 = line.unbind(-1)
    u, v = point.unbind(-1)
    off = l2 + l0 * u + l1 * v
    return torch.stack([u - off * l0, v - off * l1], -1)


def line_piece(
    line: Float[Tensor, "*#n 3"], point: Float[Tensor, "*#n 2"], reach: Float[Tensor, "*#d"], hw: HW
) -> Segments:
    """Compute the piece of each line within `reach` pixels of its point nearest to `point`.

    Args:
        line: lines (l0, l1, l2), scaled as `epipolar_lines` does; zeros where there is none.
        point: pixels.
        reach: pixels to either side.
        hw: height and width of the image.

    Returns:
        Segments along (l1, -l0), which for a calibrated F is from near to far, clipped to the image, invalid
        where nothing is left; `point` itself where there is no line.
    """
    foot = foot_on_line(line, point)
    along = reach[..., None] * torch.stack([-line[..., 1], line[..., 0]], -1)
    return clip_to_image(foot + along, foot - along, hw)


def _between(pair: Pair, near: Tensor, far: Tensor, x: Tensor) -> Segments:
    def between(x: Tensor) -> Segments:
        return segments_between(pinhole_track(pair, x), near, far, pair.beta.hw)

    return segments_by_rows(between, pair, floating(x))
