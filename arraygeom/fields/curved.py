"""Fields through lenses: explicit positions along the distorted image of each ray."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Real
from torch import Tensor

from ..camera import Camera, LensView, View
from ..epipolar import FRONT
from ..pixels import HW, floating, map_homogeneous, product
from ..rig import Pair
from ..segments import Positions, Segments, sample_fractions
from ..undistortion import pinhole_view
from .protocol import ReceptiveField
from .straight import Epipolar


@dataclass(frozen=True)
class Curved:
    """Depth samples through the lens models: `samples` positions from near to far, evenly spaced in beta's pixels.

    Needs a calibrated pair; without lenses it is `Epipolar` sampled. The curve is followed at `nodes` depths
    between the bounds (metres; the pair's own unless given), even in inverse depth, and the part of it on
    beta's image is divided evenly. Positions are exact for their depths; the spacing, and where an edge of
    the image cuts the curve, are to the accuracy of straight pieces between nodes. What a fisheye alpha sees
    at 90 degrees or more off axis has no depth along the axis and no samples.
    """

    samples: int = 96
    near: float | None = None
    far: float | None = None
    nodes: int = 64

    def __call__(self, pair: Pair, x: Real[Tensor, "*n 2"]) -> Positions:
        """Positions (*n, samples, 2), differentiable in all numbers of the rig, lenses included."""
        pair.cameras  # noqa: B018  (raises for an uncalibrated pair, before the depth range is asked for)
        near, far = Epipolar(self.near, self.far).bounds(pair)
        x = floating(x)
        curve = _Curve.of(pair, near, far, x)
        even = torch.linspace(0, 1, self.nodes, dtype=x.dtype, device=x.device).expand(*x.shape[:-1], -1)
        nodes, seen = curve.at(even)
        pieces = visible_pieces(nodes, seen & curve.ahead[..., None], pair.beta.hw)
        xy, seen = curve.at(along_pieces(pieces, sample_fractions(self.samples, like=x)))
        limits = xy.new_tensor([pair.beta.hw[1] - 0.5, pair.beta.hw[0] - 0.5])
        inside = ((xy > -0.5 - EDGE) & (xy < limits + EDGE)).all(-1)
        mask = inside & seen & (pieces.length.sum(-1, keepdim=True) > 0)
        xy = torch.minimum(xy.clamp(min=-0.5), limits)
        return Positions(torch.where(mask[..., None], xy, 0.0), mask)


@dataclass(frozen=True)
class ThroughLenses:
    """A straight field seen through lenses: for pairs known by F, or any field other than `Epipolar`.

    The field is evaluated for the pair without its lenses (`pinhole_view`) and the result is distorted by beta's lens.
    Segments are sampled at `samples` positions, evenly spaced before distortion.
    """

    field: ReceptiveField
    samples: int = 96

    def __call__(self, pair: Pair, x: Real[Tensor, "*n 2"]) -> Positions:
        """Positions (*n, samples, 2) in beta's own pixels. Raises ValueError for a batch of rigs with lenses."""
        alpha, beta = (_Straight.of(view) for view in (pair.alpha, pair.beta))
        link = None if pair.link is None else pair.link.transformed(alpha.A, beta.A)
        straight = dataclasses.replace(pair, alpha=alpha.pinhole, beta=beta.pinhole, link=link)
        there, seen = alpha.undistort(floating(x))
        found = self.field(straight, there)
        found = found.positions(self.samples) if isinstance(found, Segments) else found
        xy, shown = beta.distort(found.xy)
        mask = found.mask & seen[..., None] & shown & pair.beta.contains(xy)
        return Positions(torch.where(mask[..., None], xy, 0.0), mask)


class _Straight(NamedTuple):
    """A view, the same without its lens, and A which takes the undistorted pixels of the one to those of the other."""

    view: View
    pinhole: View
    A: Tensor

    @classmethod
    def of(cls, view: View) -> _Straight:
        if not isinstance(view, LensView) or view.distortion is None:
            return cls(view, view, torch.eye(3, dtype=torch.float64))
        pinhole = pinhole_view(view)
        return cls(view, pinhole, product(pinhole.K, torch.linalg.inv(view.K)))

    def undistort(self, x: Tensor) -> tuple[Tensor, Tensor]:
        straight, valid = self.view.to(x.dtype).undistort(x)
        return map_homogeneous(self.A[:2], straight), valid

    def distort(self, x: Tensor) -> tuple[Tensor, Tensor]:
        return self.view.to(x.dtype).distort(map_homogeneous(torch.linalg.inv(self.A)[:2], x))


EDGE = 0.25
"""How far outside the image a sample that should be on its edge may fall, pixels; it is moved onto the edge."""


class _Curve(NamedTuple):
    """The points a + w t in beta's frame, in units of their depth in alpha, with 1/w from near to far."""

    a: Tensor
    t: Tensor
    w_near: Tensor
    w_far: Tensor
    ahead: Tensor
    beta: Camera

    @classmethod
    def of(cls, pair: Pair, near: Tensor, far: Tensor, x: Tensor) -> _Curve:
        pose = pair.beta_from_alpha.to(x.dtype)
        alpha, beta = (c.to(x.dtype) for c in pair.cameras)
        rays, seen = alpha.rays(x)
        ahead = seen & (rays[..., 2] > FRONT)
        rays = rays / torch.where(ahead, rays[..., 2], 1.0)[..., None]
        beside = (..., *[None] * (x.ndim - pose.t.ndim))
        R, t = (v.movedim((-2, -1), (0, 1))[beside].movedim((0, 1), (-2, -1)) for v in (pose.R, pose.t[..., None]))
        w_near, w_far = ((1 / d.to(x.dtype)) for d in (near, far))
        w_near, w_far = (w[(..., *[None] * (x.ndim - w.ndim))] if w.ndim else w for w in (w_near, w_far))
        return cls((R * rays[..., None, :]).sum(-1), t[..., 0], w_near, w_far, ahead, beta)

    def at(self, fraction: Tensor) -> tuple[Tensor, Tensor]:
        """Beta's pixels (*n, l, 2) at fractions (*n, l) of the way from near to far, and which it can see."""
        w = self.w_near + fraction * (self.w_far - self.w_near)
        X = self.a[..., None, :] + w[..., None] * self.t[..., None, :]
        projected = self.beta.project_local(X)
        return projected.x, projected.valid & (X.square().sum(-1) > FRONT**2)


class Pieces(NamedTuple):
    """The visible part of each piece of a polyline of m + 1 nodes: from `first` to `last` (0..1), `length` pixels."""

    first: Float[Tensor, "*n m"]
    last: Float[Tensor, "*n m"]
    length: Float[Tensor, "*n m"]


def visible_pieces(nodes: Float[Tensor, "*n k 2"], seen: Tensor, hw: HW) -> Pieces:
    """The parts of a polyline that lie on the image, between nodes that are both `seen` (*n, k).

    A visible piece of no length counts as 1e-3 pixels, so that a curve that is a point is somewhere.
    """
    limits = nodes.new_tensor([hw[1] - 0.5, hw[0] - 0.5])
    room = torch.minimum(nodes + 0.5, limits - nodes).amin(-1)
    here, there = room[..., :-1], room[..., 1:]
    seen = seen[..., :-1] & seen[..., 1:] & ((here >= 0) | (there >= 0))
    crosses = seen & ((here < 0) | (there < 0))
    crossing = here / torch.where(crosses, here - there, 1.0)
    first = torch.where(seen & (here < 0), crossing, 0.0)
    last = torch.where(seen & (there < 0), crossing, 1.0)
    step = torch.where(seen[..., None], nodes.diff(dim=-2), 0.0)
    length = (step.square().sum(-1) + 1e-6).sqrt() * (last - first)
    return Pieces(first, last, torch.where(seen, length, 0.0))


def along_pieces(pieces: Pieces, u: Float[Tensor, "l"]) -> Float[Tensor, "*n l"]:
    """Where on the whole polyline (0 at the first node, 1 at the last) fractions u of the visible length are."""
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
    return (index + torch.lerp(first, last, within)) / pieces.length.shape[-1]
