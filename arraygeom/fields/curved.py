"""Fields through lenses: explicit positions along the distorted image of each ray."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Real
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd import forward_ad

from ..camera import Camera, LensView, View
from ..checks import check_above, check_bounds, check_field
from ..distortion import Distortion
from ..epipolar import FRONT, Clipped, Track, beside, clipped
from ..lenses.common import cosine_and_sinc
from ..pair import Pair
from ..pixels import HW, floating, map_homogeneous, product, within
from ..runtime.chunks import spans
from ..runtime.threads import in_parallel
from ..runtime.tracing import needs_numbers, traced
from ..segments import Positions, Segments, fractions_on_image, sample_fractions
from ..undistortion import pinhole_view
from .protocol import PIECE, ReceptiveField, answered, compilable
from .straight import Epipolar


@dataclass(frozen=True)
class Curved:
    """Field of depth samples through lens models: positions near to far, evenly spaced in beta's pixels.

    Needs a calibrated pair, of which a link does not count; without lenses `Epipolar` sampled. The part of
    each ray that can be on beta's image is clipped in closed form, followed at nodes (even in undistorted
    pixels, or in angle where beta sees more than 75 degrees off axis), and its part on the image is divided
    evenly. In a beta that is not central the nodes are first moved to where its image is. Positions are exact
    for their depths; with a lens the spacing, and where an edge of the image cuts the curve, are to the
    accuracy of straight pieces between nodes. A point that alpha sees at 90 degrees or more off axis has no
    depth along the axis and no samples, unless the bounds are of the `distance` along the ray.

    Attributes:
        samples: number of positions per pixel of alpha.
        near: near bound in the rig's unit (metres); None for the pair's own.
        far: far bound in the rig's unit, possibly infinite; None for the pair's own.
        nodes: number of points at which a curve is followed, at least 2.
        bounds: quantity that near and far (the pair's too) bound: "depth" along alpha's axis or "distance"
            along the ray.

    Raises:
        ValueError: for other `bounds`, under 1 sample or 2 nodes, and depths unless 0 < near <= far.
        TypeError: for values that are no numbers, or no whole ones.
    """

    samples: int = 96
    near: float | None = None
    far: float | None = None
    nodes: int = 64
    bounds: Literal["depth", "distance"] = "depth"

    def __post_init__(self) -> None:
        _check_word(self.bounds)
        check_above(1, whole=True, samples=self.samples)
        check_above(2, whole=True, nodes=self.nodes)
        check_bounds(self.near, self.far)

    def __call__(self, pair: Pair, x: Real[Tensor, "*n 2"]) -> Positions:
        """Compute the positions in beta of alpha's pixels.

        Returns:
            Positions (*n, samples, 2) in beta's pixels, near to far, differentiable in all numbers of the
            rig, lenses included; masked ones are 0.

        Raises:
            ValueError: for a pair without the bounds that the field leaves open, a near bound infinite or
                beyond the far one, and as `Pair.beta_from_alpha`.
        """
        pair.cameras  # noqa: B018  (raises for an uncalibrated pair, before the depth range is asked for)
        near, far = Epipolar(self.near, self.far).bounds(pair)
        x = floating(x)
        curve = RayCurve.from_pixels(pair, near, far, x, self.bounds)
        if curve.compilable and curve.valid.numel() > FEW:
            return curve.positions(self.nodes, self.samples)
        return curve.formulas(self.nodes, self.samples)


def _check_word(bounds: str) -> None:
    if bounds not in ("depth", "distance"):
        raise ValueError(f"bounds is {bounds!r}: wanted 'depth' or 'distance'")


FEW = 16
"""Number of pixels up to which the formulas serve: compiling the loop, once on a machine, takes half a
minute."""


@dataclass(frozen=True)
class ThroughLenses:
    """Field that applies a field of pinhole pairs through lenses: for pairs known by F, and fields other than
    `Epipolar`, which `Curved` replaces.

    The field is evaluated for the pair without its lenses (`pinhole_view`) and the result is distorted by
    beta's lens. Rays of cameras that are not central are taken to meet in a point.

    Attributes:
        field: field of the pair without lenses.
        samples: number of positions per segment, evenly spaced before distortion; a field of explicit
            positions keeps its own.

    Raises:
        ValueError: for under 1 sample.
        TypeError: for an object that is no field, or `samples` that is no whole number.
    """

    field: ReceptiveField
    samples: int = 96

    def __post_init__(self) -> None:
        check_field(self.field)
        check_above(1, whole=True, samples=self.samples)

    def __call__(self, pair: Pair, x: Real[Tensor, "*n 2"]) -> Positions:
        """Compute the positions in beta of alpha's pixels.

        Returns:
            Positions (*n, samples or the field's own number, 2) in beta's pixels; masked ones are 0.

        Raises:
            ValueError: for a batch of rigs with lenses, an image without a pixel within its lens's range, an
                invalid result of the field, or whatever the field raises for the pair without lenses.
            NotImplementedError: within `torch.func.vmap`.
        """
        alpha, beta = (_Straight.from_view(view) for view in (pair.alpha, pair.beta))
        link = None if pair.link is None else pair.link.transformed(alpha.A, beta.A)
        straight = dataclasses.replace(pair, alpha=alpha.pinhole, beta=beta.pinhole, link=link)
        undistorted, valid = alpha.undistort(floating(x))
        locations = answered(self.field, straight, undistorted)
        locations = locations.positions(self.samples) if isinstance(locations, Segments) else locations
        xy, shown = beta.distort(locations.xy)
        xy, inside = _onto_edge(xy, pair.beta.hw, ROUNDED)
        mask = locations.mask & valid[..., None] & shown & inside
        return Positions(torch.where(mask[..., None], xy, 0.0), mask)


class _Straight(NamedTuple):
    """A view, the same without its lens, and A from the undistorted pixels of the one to the other's."""

    view: View
    pinhole: View
    A: Tensor

    @classmethod
    def from_view(cls, view: View) -> _Straight:
        """Build it from a view; a view without a lens is its own equivalent."""
        if not isinstance(view, LensView) or view.distortion is None:
            return cls(view, view, torch.eye(3, dtype=torch.float64))
        pinhole = pinhole_view(view)
        return cls(view, pinhole, product(pinhole.K, torch.linalg.inv(view.K)))

    def undistort(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return the pinhole's pixels of pixels (*n, 2) of the view, True where the lens model has them."""
        straight, valid = self.view.to(x.dtype).undistort(x)
        return map_homogeneous(self.A[:2].to(x.device), straight), valid

    def distort(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return the view's pixels of pixels (*n, 2) of the pinhole, True where the lens model has them."""
        return self.view.to(x.dtype).distort(map_homogeneous(torch.linalg.inv(self.A)[:2].to(x.device), x))


EDGE, ROUNDED = 0.25, 1e-3
"""Pixels outside the image within which a sample is moved onto its edge: by the spacing of nodes, and by
rounding alone."""


def _onto_edge(xy: Tensor, hw: HW, margin: float) -> tuple[Tensor, Tensor]:
    """Move points onto the image, and return which were less than `margin` pixels outside it."""
    limits = xy.new_tensor([hw[1] - 0.5, hw[0] - 0.5])
    inside = ((xy > -0.5 - margin) & (xy < limits + margin)).all(-1)
    return torch.minimum(xy.clamp(min=-0.5), limits), inside


WIDE = math.tan(math.radians(75))
"""Tangent of the angle off axis beyond which a lens is followed by angle."""


class RayCurve(NamedTuple):
    """Curves in beta on which the rays of alpha's pixels are seen, as straight pieces of beta's space.

    Points are divided by their depth (or distance) in alpha, so that a point at infinity is finite too.
    Fractions of the way are even in undistorted pixels, in angle if `wide`, or in metres where beta's rays
    are parallel.

    Attributes:
        first: end towards near, in beta's frame.
        last: end towards far, in beta's frame.
        valid: mask of the pixels whose ray beta may see; the ends of others mean nothing.
        beta: the camera whose image holds the curve.
        wide: True if fractions are even in angle, as in cameras that are not central, parallel rays apart.
        inverse: inverse depths (or distances) in alpha (*n) of `first` and of `last`, 1 / metres.
    """

    first: Float[Tensor, "*n 3"]
    last: Float[Tensor, "*n 3"]
    valid: Bool[Tensor, "*n"]
    beta: Camera
    wide: Tensor | bool
    inverse: tuple[Tensor, Tensor]

    @classmethod
    def from_pixels(cls, pair: Pair, near: Tensor, far: Tensor, x: Tensor, bounds: str = "depth") -> RayCurve:
        """Build the curves of alpha's pixels x (*n, 2), near to far, as far as beta's image may show them.

        Args:
            pair: calibrated pair.
            near: near bound (*b), in the rig's unit (metres), above 0; not checked.
            far: far bound (*b), possibly infinite.
            bounds: "depth" along alpha's axis, or "distance" along the ray.

        Returns:
            The curves, in the precision of x; valid ones may yet be off the image where beta has a lens.

        Raises:
            ValueError: for other `bounds`, and as `Pair.beta_from_alpha`.
        """
        _check_word(bounds)
        pose = pair.beta_from_alpha.to(x.dtype)
        alpha, beta = (c.to(x.dtype) for c in pair.cameras)
        start, rays, ahead = _lines(alpha, x, bounds)
        offset = beside(pose.t, x.ndim, trailing=1)
        points = Track(_each(pose.R, rays), offset if start is None else offset + _each(pose.R, start))
        wide: Tensor | bool = False
        if beta.distortion is None:
            h, w = beta.hw
            pixels = Track(_each(beta.K, points.a), _each(beta.K, points.b))
            visible = clipped(pixels, near, far, (-0.5, -0.5, w - 0.5, h - 0.5))
        else:
            ahead_only = not beta.distortion.sees_behind

            def everywhere() -> Clipped:
                return clipped(points, near, far, None, in_front=ahead_only)

            if beta.central:
                narrow, limits = undistorted_limits(beta)
                around = [beside(v, x.ndim - 1) for v in limits]
                wide = ~narrow
                bounded = _either(wide, everywhere, lambda: clipped(points, near, far, around))
                visible = Clipped(*bounded)
            else:
                visible, wide = everywhere(), not beta.parallel
        w_far, w_near = (beside(1 / d.to(x.dtype), x.ndim - 1) for d in (far, near))
        ends = (
            w_far + torch.where(visible.valid, s, 0.0) * (w_near - w_far) for s in (visible.high, visible.low)
        )
        near_end, far_end = (torch.where(visible.valid, v, 1.0) for v in ends)
        valid = ahead & visible.valid
        if beta.central:
            return cls.between(points, near_end, far_end, valid, beta, wide)
        if torch.compiler.is_compiling():  # loops within loops, which it would write out
            needs_numbers("the part of a ray that a camera shows whose rays do not meet in a point", x)
        remote = REMOTE / beside(pose.t.norm(dim=-1) + near.to(x.dtype), x.ndim - 1)
        near_end, far_end = (torch.maximum(v, remote) for v in (near_end, far_end))
        whole = cls.between(points, near_end, far_end, valid, beta, wide)
        return cls.between(points, *whole._ends_on_image(), valid, beta, wide)

    @classmethod
    def between(
        cls,
        points: Track,
        near_end: Tensor,
        far_end: Tensor,
        valid: Tensor,
        beta: Camera,
        wide: Tensor | bool,
    ) -> RayCurve:
        """Make the curves of points in beta's frame between two inverse depths.

        Args:
            points: points (*n, 3) by inverse depth (or distance) in alpha, divided by that depth.
            near_end: inverse depths (*n) of the curves' first ends, 1 / metres.
            far_end: inverse depths (*n) of their last ends.
            valid: mask (*n), kept as it is, and so are `beta` and `wide`.
        """
        first, last = (points.a + v[..., None] * points.b for v in (near_end, far_end))
        return cls(first, last, valid, beta, wide, (near_end, far_end))

    @property
    def turn(self) -> Float[Tensor, "*n 2"] | None:
        """Pixels of beta after which its image plane repeats itself; None if it does not."""
        lens = self.beta.distortion
        if lens is None or not lens.period:
            return None
        return beside(lens.period * self.beta.K[..., :2, 0].detach(), self.first.ndim + 1, trailing=1)

    @property
    def compilable(self) -> bool:
        """True if compiled loops can follow the curves, and their gradients: on the CPU, in one beta with no
        lens or one of `COMPILED_LENSES` without a tilted sensor, outside torch's transformations."""
        lens = self.beta.distortion
        lens_compiled = lens is None or (
            isinstance(lens, Distortion)
            and lens.model in COMPILED_LENSES
            and lens.coefficients.shape[-1] < 14
        )
        plain = lens_compiled and not self.beta.batch_shape and compilable(self.first)
        return plain and all(forward_ad.unpack_dual(t).tangent is None for t in self.numbers)

    def positions(self, nodes: int, samples: int) -> Positions:
        """Compute the positions of `Curved` by compiled loops in float64; the curve must be `compilable`.

        Args:
            nodes: number of points at which each curve is followed, at least 2; not checked.
            samples: number of positions per pixel.

        Returns:
            Positions (*n, samples, 2) in beta's pixels, in the precision of `first`, differentiable twice;
            masked ones are 0.

        Raises:
            ValueError: for fewer than 1 sample.
        """
        return Positions(*_Followed.apply(*self.numbers, self, nodes, samples))

    def formulas(self, nodes: int, samples: int) -> Positions:
        """Compute the positions of `Curved` by torch, as `positions` does by compiled loops."""
        fractions = self.nodes(nodes)
        xy, visible = self.at(fractions)
        pieces = visible_pieces(xy, visible & self.valid[..., None], self.beta.hw, self.turn)
        xy, visible = self.at(along_pieces(pieces, sample_fractions(samples, like=xy), fractions))
        xy, inside = _onto_edge(xy, self.beta.hw, EDGE)
        mask = inside & visible & (pieces.length.sum(-1, keepdim=True) > 0)
        return Positions(torch.where(mask[..., None], xy, 0.0), mask)

    @property
    def numbers(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Both ends, beta's intrinsics, and its lens's coefficients, none without a lens."""
        lens = self.beta.distortion
        return self.first, self.last, self.beta.K, self.beta.K[0, :0] if lens is None else lens.coefficients

    def with_numbers(self, first: Tensor, last: Tensor, K: Tensor, coefficients: Tensor) -> RayCurve:
        """Return the same curve with other `numbers`."""
        lens = self.beta.distortion
        lens = lens.with_coefficients(coefficients) if isinstance(lens, Distortion) else lens
        return self._replace(first=first, last=last, beta=self.beta.replace(K=K, distortion=lens))

    def nodes(self, count: int) -> Float[Tensor, "*n k"]:
        """Compute the fractions of the way from `first` to `last`, 0..1, at which to follow the curve.

        They are even in the curve's own measure. In a beta that is not central, or whose image repeats
        itself (near its pole columns lie far apart), two passes move them towards even in pixels.

        Args:
            count: number of fractions, at least 2.

        Returns:
            Fractions (*n, count), rising from 0 to 1, or within where they were moved to the image.
        """
        even = self._even(count)
        fractions = self._fractions(even)
        for _ in range(0 if self.beta.central and self.turn is None else PASSES):
            pieces = self._pieces(fractions, NARROW)
            visible = pieces.length.sum(-1, keepdim=True) > 0
            fractions = torch.where(visible, along_pieces(pieces, even, fractions), even)
        return fractions

    def _fractions(self, even: Tensor) -> Tensor:
        """Return even fractions for each pixel; if not central, others too, closer and closer to the ends."""
        if not self.beta.central:
            close = 10 ** (CLOSEST * (1 - self._even(len(even) // 2 + 1)[:-1]))
            even = torch.cat([even, close, 1 - close]).sort().values
        return even.expand(*self.valid.shape, -1)

    def _even(self, count: int) -> Tensor:
        return torch.linspace(0, 1, count, dtype=self.first.dtype, device=self.first.device)

    def _ends_on_image(self) -> tuple[Tensor, Tensor]:
        """Find the inverse depths between which an image larger by `MARGIN` shows the curve, if not central.

        They are constants, but for an end that the image shows.
        """
        with torch.no_grad():
            fractions = self._fractions(self._even(NODES))
            covered = self._covered(fractions)
            low, high = covered[..., :1], covered[..., 1:]
            fractions = torch.lerp(low, high, fractions)
            pieces = self._pieces(fractions, MARGIN)
            visible = pieces.length.sum(-1, keepdim=True) > 0
            ends = torch.where(
                visible, along_pieces(pieces, covered.new_tensor([0.0, 1.0]), fractions), covered
            )
            near_end, far_end = self.inverse_depth(ends).unbind(-1)
            xy, visible = self.at(torch.zeros_like(ends) + ends.new_tensor([0.0, 1.0]))
            near_shown, far_shown = (visible & within(xy, self.beta.hw)).unbind(-1)
        first, last = self.inverse
        return torch.where(near_shown, first, near_end), torch.where(far_shown, last, far_end)

    def _pieces(self, fractions: Tensor, share: float) -> Pieces:
        """Find the pieces on an image that is larger by a share of its height plus width on each side."""
        xy, visible = self.at(fractions)
        margin = math.ceil(share * sum(self.beta.hw))
        h, w = self.beta.hw
        return visible_pieces(xy + margin, visible, (h + 2 * margin, w + 2 * margin), self.turn)

    def _covered(self, fractions: Tensor) -> Tensor:
        """Find the first and last fractions (*n, 2) of the curve that the model covers, by bisection."""
        visible, last = self.at(fractions)[1], fractions.shape[-1] - 1
        ends = torch.stack([visible.int().argmax(-1), last - visible.int().flip(-1).argmax(-1)], -1)
        inner = fractions.gather(-1, ends)
        outer = fractions.gather(-1, (ends + ends.new_tensor([-1, 1])).clamp(0, last))
        for _ in range(HALVINGS):
            middle = (inner + outer) / 2
            covered = self.at(middle)[1]
            inner, outer = torch.where(covered, middle, inner), torch.where(covered, outer, middle)
        return torch.where(visible.any(-1, keepdim=True), inner, fractions[..., [0, -1]])

    def at(self, fraction: Tensor) -> tuple[Tensor, Tensor]:
        """Compute beta's pixels at fractions (*n, l) of the way from `first` to `last`.

        Returns:
            Pixels (*n, l, 2), and True (*n, l) where the lens model sees the point and it is not at beta's
            centre; whether it is on the image, or the curve valid, is not checked.
        """
        weights = self._weights(fraction)
        s = (weights[1] / (weights[0] + weights[1]))[..., None]
        X = torch.lerp(self.first[..., None, :], self.last[..., None, :], s)
        far_enough = X.square().sum(-1) > FRONT**2
        if not self.beta.central:
            X = X / self._inverse_at(s[..., 0])[..., None]
        projected = self.beta.project_local(X)
        return projected.x, projected.valid & far_enough

    def inverse_depth(self, fraction: Tensor) -> Tensor:
        """Compute the inverse depth (or distance) in alpha of the points at fractions (*n, l)."""
        weights = self._weights(fraction)
        return self._inverse_at(weights[1] / (weights[0] + weights[1]))

    def _inverse_at(self, s: Tensor) -> Tensor:
        first, last = (v[..., None] for v in self.inverse)
        return torch.lerp(first, last, s)

    def _weights(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Return shares of first and last in the point at fraction u, in the curve's own measure."""
        if self.wide is False:
            return self._weights_in_pixels(u)
        first, last = _either(
            self.wide, lambda: self._weights_in_angle(u), lambda: self._weights_in_pixels(u)
        )
        return first, last

    def _weights_in_pixels(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Return shares of first and last in the point whose pixel, without the lens, is at fraction u."""
        ends = self.inverse if self.beta.parallel else (self.first[..., 2], self.last[..., 2])
        z0, z1 = (torch.where(self.valid, z, 1.0)[..., None] for z in ends)
        return (1 - u) * z1, u * z0

    def _weights_in_angle(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Return shares of first and last in the direction at fraction u of the angle between them."""
        squared = torch.linalg.cross(self.first, self.last).square().sum(-1)
        opens = squared > TINY
        sine = torch.where(opens, torch.where(opens, squared, 1.0).sqrt(), 0.0)
        angle = torch.atan2(sine, torch.where(opens, (self.first * self.last).sum(-1), 1.0))[..., None]
        r0, r1 = (
            X.square().sum(-1, keepdim=True).clamp(min=FRONT**2).sqrt() for X in (self.first, self.last)
        )
        # Not by torch.sinc, which has no second derivative at 0.
        of_first, of_last = (
            v * cosine_and_sinc((v * angle).square())[1] * r for v, r in ((1 - u, r1), (u, r0))
        )
        return of_first, of_last


class _Followed(torch.autograd.Function):
    """Positions and mask by compiled loops; gradients by a loop too, second derivatives by the formulas."""

    @staticmethod
    def forward(ctx, first, last, K, coefficients, curve, nodes, samples):
        from .curve_kernels import curved_positions

        xy = np.empty((*curve.valid.shape, samples, 2), f"f{first.dtype.itemsize}")
        mask = np.empty(xy.shape[:-1], bool)
        flat = xy.reshape(-1, samples, 2), mask.reshape(-1, samples)
        _loop(curved_positions, curve, nodes, samples, *flat)
        ctx.save_for_backward(first, last, K, coefficients)
        ctx.rest = curve, nodes, samples
        found = torch.from_numpy(xy), torch.from_numpy(mask)
        ctx.mark_non_differentiable(found[1])
        return found

    @staticmethod
    def backward(ctx, by_xy, _):
        numbers, wanted, (curve, nodes, samples) = ctx.saved_tensors, ctx.needs_input_grad[:4], ctx.rest
        if torch.is_grad_enabled() or not compilable(by_xy):
            again = torch.is_grad_enabled()
            with torch.enable_grad():
                copies = [t.view_as(t) for t in numbers]  # the ends may depend on K: each has its own part
                xy = curve.with_numbers(*copies).formulas(nodes, samples).xy
            asked = [t for t, want in zip(copies, wanted) if want]
            of_asked = iter(torch.autograd.grad(xy, asked, by_xy, create_graph=again, allow_unused=True))
            return *(next(of_asked) if want else None for want in wanted), None, None, None
        from .curve_kernels import curved_gradients

        ends = np.zeros((2, curve.valid.numel(), 3))
        flat = by_xy.reshape(-1, samples, 2).contiguous().numpy()
        sums = zip(*_loop(curved_gradients, curve, nodes, samples, flat, *ends))
        by_K, by_lens = (np.sum(parts, 0) for parts in sums)
        found = zip((*ends, by_K, by_lens[: numbers[3].numel()]), numbers, wanted)
        of_each = [torch.from_numpy(g).reshape(t.shape).to(t.dtype) if want else None for g, t, want in found]
        return *of_each, None, None, None


def _loop(loop: Callable[..., Any], curve: RayCurve, nodes: int, samples: int, *arrays: Any) -> list[Any]:
    """Run a compiled loop over the pixels of a curve; return what it returns for each thread's piece."""
    n, double = curve.valid.numel(), torch.empty(0, dtype=torch.float64)
    ends = (t.detach().double().reshape(n, 3).contiguous().numpy() for t in (curve.first, curve.last))
    lens = LensNumbers.from_camera(curve.beta, wide=bool(curve.wide))
    fractions = torch.linspace(0, 1, nodes, dtype=torch.float64), sample_fractions(samples, like=double)
    given = *ends, curve.valid.reshape(n).contiguous().numpy(), lens, *(t.numpy() for t in fractions)
    parts = [partial(loop, *span, *given, curve.beta.hw, *arrays) for span in spans(n, PIECE)]
    return in_parallel(parts)


NODES, PASSES = 64, 2
"""Points at which a curve is searched for the image of a camera that is not central, and how often its nodes
are divided anew."""
MARGIN, NARROW = 1 / 4, 1 / 32
"""Margins around beta's image in which to search and to divide, in shares of its height plus width."""
HALVINGS = 20
"""Steps of the bisection for where a model's range ends."""
CLOSEST = -6.0
"""Log10 of the share of a curve from its ends to which first nodes go: most of beta's image may be there,
by the plane of beta, and far away where one direction of its rays is parallel."""
REMOTE = 1e-5
"""Inverse depth taken for infinity, in units of baseline plus near bound, for a beta whose rays do not meet:
there a point is not only a direction."""


def _lines(alpha: Camera, x: Tensor, bounds: str) -> tuple[Tensor | None, Tensor, Tensor]:
    """Return starts of pixels' rays (in the plane of depth 0; None for the origin), directions at a depth (or
    distance) of 1, and a mask of those that exist."""
    rays, valid = alpha.rays(x)
    start = None if alpha.central else alpha.ray_origins(x)
    if bounds == "distance":
        return start, rays / rays.square().sum(-1, keepdim=True).clamp(min=TINY).sqrt(), valid
    ahead = valid & (rays[..., 2] > FRONT)
    rays = rays / torch.where(ahead, rays[..., 2], 1.0)[..., None]
    return None if start is None else start - start[..., 2:] * rays, rays, ahead


COMPILED_LENSES = {"brown-conrady": 1, "kannala-brandt": 2}
"""Numbers of the lens models that the compiled loop supports (except with a tilted sensor)."""


class LensNumbers(NamedTuple):
    """A camera's numbers for the compiled loop, in float64.

    Attributes:
        model: number of `COMPILED_LENSES`; a pinhole is the first with coefficients of zero.
        c: coefficients (14), padded with zeros.
        limit: squared limit of the lens model's domain (`Distortion.squared_limit`); infinite for a pinhole.
        K: intrinsics (3, 3).
        wide: True if fractions of a curve (`RayCurve`) are even in angle.
    """

    model: int
    c: NDArray[np.float64]
    limit: float
    K: NDArray[np.float64]
    wide: bool

    @classmethod
    def from_camera(cls, camera: Camera, *, wide: bool) -> LensNumbers:
        """Read the numbers of one camera on the CPU, with a lens of `COMPILED_LENSES` or none; not a batch.

        Args:
            wide: True if fractions of a curve are even in angle.

        Returns:
            The numbers, without gradient.

        Raises:
            KeyError: for a `Distortion` of another model; AssertionError or ValueError: for another lens.
        """
        K, lens = camera.K.detach().double().numpy(), camera.distortion
        if lens is None:
            return cls(1, np.zeros(14), math.inf, np.ascontiguousarray(K), wide)
        c = lens.coefficients.detach().double()
        padded = np.zeros(14)
        padded[: len(c)] = c.numpy()
        assert isinstance(lens, Distortion)
        return cls(COMPILED_LENSES[lens.model], padded, lens.squared_limit, np.ascontiguousarray(K), wide)


TINY = 1e-24
"""Squared sine of two rays, times their squared lengths, below which they have one direction."""


def undistorted_limits(camera: Camera) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Compute the bounds of a camera's image in normalised undistorted points, 2 % wider, by its border.

    Returns:
        One bool tensor for all of a batch, True if they bound the image, False (bounds mean nothing) if it
        reaches 75 degrees off axis or over the domain of its lens model; and x low, y low, x high, y high,
        (*b) each.
    """
    h, w = camera.hw
    along = torch.linspace(0, 1, 17).to(camera.K)
    zero, one = torch.zeros_like(along), torch.ones_like(along)
    edges = torch.cat(
        [torch.stack(e, -1) for e in ((along, zero), (along, one), (zero, along), (one, along))]
    )
    edges = (edges * edges.new_tensor([w, h]) - 0.5).reshape(*[1] * len(camera.batch_shape), -1, 2)
    rays, valid = camera.rays(edges)
    ahead = valid & (rays[..., 2] > 1e-3)
    xy = rays[..., :2] / torch.where(ahead, rays[..., 2], 1.0)[..., None]
    low, high = xy.amin(-2), xy.amax(-2)
    margin = 0.02 * (high - low)
    limits = (*(low - margin).unbind(-1), *(high + margin).unbind(-1))
    return (ahead & (xy.square().sum(-1) < WIDE**2)).all(), limits


def _either(condition: Tensor | bool, yes: Callable[[], Tensors], no: Callable[[], Tensors]) -> Tensors:
    """Return one of two tuples of tensors; while torch traces, both are computed."""
    if not traced():
        return yes() if condition else no()
    return tuple(torch.where(torch.as_tensor(condition), a, b) for a, b in zip(yes(), no()))


Tensors = tuple[Tensor, ...]


def _each(M: Tensor, v: Tensor) -> Tensor:
    """Multiply matrices (*b, 3, 3) with vectors (*b, ..., 3)."""
    axes = v.ndim - M.ndim + 1
    M = M.reshape(*M.shape[:-2], *[1] * axes, 3, 3)
    return (M * v[..., None, :]).sum(-1)


class Pieces(NamedTuple):
    """Visible part of each of a polyline's m pieces; a piece joins two neighbouring nodes.

    Attributes:
        first: fraction of the piece at which the visible part begins, 0..1.
        last: fraction at which it ends, 0..1.
        length: length of the visible part, pixels; 0 for invisible pieces.
    """

    first: Float[Tensor, "*n m"]
    last: Float[Tensor, "*n m"]
    length: Float[Tensor, "*n m"]


def visible_pieces(
    nodes: Float[Tensor, "*n k 2"], visible: Tensor, hw: HW, turn: Tensor | None = None
) -> Pieces:
    """Compute the parts of polylines that lie on the image, of pieces with a node that is `visible`.

    A visible piece of no length counts as 1e-3 pixels, so that a curve that is a point has a position.

    Args:
        nodes: pixels of the k nodes of each polyline.
        visible: mask (*n, k) of the nodes.
        hw: height and width of the image.
        turn: pixels (2) after which the image repeats itself, or of each rig (*b, 1.., 2); None if it does
            not.

    Returns:
        The k - 1 pieces in order; with `turn` two for each, as it leaves across the seam and as it returns.
    """
    start, end = nodes[..., :-1, :], nodes[..., 1:, :]
    visible = visible[..., :-1] | visible[..., 1:]
    if turn is not None:
        turns = (((end - start).detach() * turn).sum(-1) / turn.square().sum(-1)).round()
        over = turns[..., None] * turn
        start, end = (torch.stack(v, -2).flatten(-3, -2) for v in ((start, start + over), (end - over, end)))
        visible = torch.stack([visible, visible & (turns != 0)], -1).flatten(-2)
    first, last = fractions_on_image(start, end, hw)
    visible = visible & (first <= last)
    first, last = torch.where(visible, first, 0.0), torch.where(visible, last, 1.0)
    step = torch.where(visible[..., None], end - start, 0.0)
    length = (step.square().sum(-1) + 1e-6).sqrt() * (last - first)
    return Pieces(first, last, torch.where(visible, length, 0.0))


def along_pieces(
    pieces: Pieces, u: Float[Tensor, " l"], nodes: Float[Tensor, "*n k"]
) -> Float[Tensor, "*n l"]:
    """Interpolate numbers given at a polyline's nodes at fractions of its visible length.

    Args:
        pieces: visible parts of the polyline (`visible_pieces`), one or two for each piece.
        u: fractions of the visible length, 0..1, rising.
        nodes: number at each of the k nodes, such as its fraction of a curve.

    Returns:
        Numbers (*n, l), without meaning for an invisible polyline.
    """
    first, last, length = pieces
    ends = length.cumsum(-1)
    wanted = u * ends[..., -1:]
    with torch.no_grad():
        final = torch.searchsorted(ends, ends[..., -1:].contiguous())
        index = torch.searchsorted(ends, wanted.contiguous(), right=True)
        index = torch.minimum(index, final).clamp(max=length.shape[-1] - 1)
    first, last, length, end = (v.gather(-1, index) for v in (first, last, length, ends))
    within = 1 - (end - wanted) / torch.where(length > 0, length, 1.0)
    within = torch.where(length > 0, within, 0.0).clamp(0, 1)
    index = index // (pieces.length.shape[-1] // (nodes.shape[-1] - 1))
    before, after = (nodes.gather(-1, index + step) for step in (0, 1))
    return torch.lerp(before, after, torch.lerp(first, last, within))
