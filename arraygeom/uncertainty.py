"""Uncertainty of a calibration in pixels and points: that of a rig's parameters, to first order."""

from __future__ import annotations

from collections.abc import Callable
from statistics import NormalDist
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Real
from torch import Tensor

from .camera import Camera
from .pixels import floating, product
from .rig import Rig
from .triangulation import triangulate


@runtime_checkable
class Covariance(Protocol):
    """Covariance of some parameters of a rig, such as `calib.boards.uncertainty.RigCovariance`.

    It has `names` ("left.rotation.0"), and a `matrix` in their order, in the units of `Rig.parameters`.
    """

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters as in `Rig.parameters` with the index of a component: "left.rotation.0"."""
        ...

    @property
    def matrix(self) -> Any:
        """Covariance (c, c), a tensor or an array."""
        ...


def position_covariance(
    rig: Rig, covariance: Covariance, alpha: str, beta: str, x: Real[Tensor, "n 2"], depth: Tensor | float
) -> Float[Tensor, "n 2 2"]:
    """Compute the covariance of the positions in beta of alpha's pixels at a depth, by that of the rig.

    Args:
        x: pixels of alpha.
        depth: depth in alpha, in the rig's unit, one for all or one for each.

    Returns:
        Covariances in pixels² of beta, float64; NaN where `Camera.unproject` gives no point, the depth is
        infinite, or beta's lens does not see the point (its image's border does not count).

    Raises:
        ValueError: for a camera that is unknown or not calibrated, and a covariance of parameters that the
            rig has not, or whose matrix does not fit its names.
        RuntimeError: for another number of depths.
    """
    x = floating(x).double()
    depth = torch.as_tensor(depth, dtype=torch.float64).expand(len(x))
    a, b = _camera(rig, alpha), _camera(rig, beta)
    X = a.unproject(x, depth)
    seen = X.isfinite().all(-1) & b.project(X.nan_to_num(1.0)).valid

    def positions(rig: Rig) -> Tensor:
        return _camera(rig, beta).project(_camera(rig, alpha).unproject(x[seen], depth[seen])).x

    found = x.new_full((len(x), 2, 2), torch.nan)
    found[seen] = _propagated(rig, covariance, positions)
    return found


def triangulation_covariance(
    rig: Rig, covariance: Covariance, x: Real[Tensor, "v *n 2"], *, seen: Bool[Tensor, " v *n"] | None = None
) -> Float[Tensor, "*n 3 3"]:
    """Compute the covariance of `triangulate`'s points by that of the rig alone.

    Args:
        x: pixels of the points in each of the rig's cameras, in its order.
        seen: as of `triangulate`.

    Returns:
        Covariances, m², float64, zero where a point is not valid (with a deviation of 1); `triangulate` gives
        the pixels' part, to be added. All points move together: their errors are not independent.

    Raises:
        ValueError: as `triangulate`, for a camera that is not calibrated, and for a covariance as in
            `position_covariance`.
    """

    def points(rig: Rig) -> Tensor:
        return triangulate([_camera(rig, name) for name in rig.names], x.double(), seen=seen).X

    return _propagated(rig, covariance, points)


class BandWidths(NamedTuple):
    """Half-widths of the bands that hold alpha's points in beta.

    Attributes:
        across: at the near and the far bound, across the segment, pixels of beta; NaN where not seen.
        along: the same along the segment.
    """

    across: Float[Tensor, "n 2"]
    along: Float[Tensor, "n 2"]


FARTHEST = 1e4
"""Largest far bound, in near bounds; it stands for an infinite one."""


def bands(
    rig: Rig, covariance: Covariance, alpha: str, beta: str, x: Real[Tensor, "n 2"], confidence: float = 0.95
) -> BandWidths:
    """Compute the half-widths within which a calibration's error leaves a point that alpha's pixels see.

    Args:
        covariance: covariance of parameters of the rig.
        x: pixels of alpha.
        confidence: probability that the point is within them, in each direction by itself, for normal errors.

    Returns:
        Half-widths at the rig's near and far bounds (at most `FARTHEST` times near); in between they are to
        be interpolated. NaN at a bound where `position_covariance` is. Without direction, as for a segment
        with such a bound or shorter than `SHORTEST`, either has both directions' uncertainty.

    Raises:
        ValueError: for a rig without a depth range, a confidence that is not between 0 and 1, and as
            `position_covariance`.
    """
    if rig.depth is None:
        raise ValueError(
            "a band is between depth bounds, which this rig lacks: rig.replace(depth=(near, far))"
        )
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must be between 0 and 1, got {confidence}")
    near = float(rig.depth[0])
    depths, x = (near, min(float(rig.depth[1]), FARTHEST * near)), floating(x).double()
    a, b = _camera(rig, alpha), _camera(rig, beta)
    first, last = (b.project(a.unproject(x, x.new_full((len(x),), d)).nan_to_num(1.0)) for d in depths)
    step = torch.where((first.valid & last.valid)[:, None], last.x - first.x, 0.0)
    length = step.norm(dim=-1, keepdim=True)
    u = torch.where(length > SHORTEST, step / length.clamp(min=SHORTEST), step.new_tensor([1.0, 0.0]))
    axes = torch.stack([u, torch.stack([-u[:, 1], u[:, 0]], -1)], -2)
    factor = NormalDist().inv_cdf(0.5 + confidence / 2)
    widths = []
    for depth in depths:
        C = product(product(axes, position_covariance(rig, covariance, alpha, beta, x, depth)), axes.mT)
        of_axes = C.diagonal(dim1=-2, dim2=-1)
        worst = of_axes.sum(-1, keepdim=True).expand_as(of_axes)
        widths.append(factor * torch.where(length > SHORTEST, of_axes, worst).clamp(min=0).sqrt())
    along, across = torch.stack(widths, -1).unbind(-2)
    return BandWidths(across, along)


SHORTEST = 1e-3
"""Length of a segment, pixels, below which it has no direction: either width is then that of both."""


def _camera(rig: Rig, name: str) -> Camera:
    camera = rig[rig.require(name)]
    if not isinstance(camera, Camera):
        raise ValueError(f"camera '{name}' is not calibrated: uncertainty is of calibrated cameras")
    return camera


def _propagated(rig: Rig, covariance: Covariance, f: Callable[[Rig], Tensor]) -> Tensor:
    """Covariance (..., k, k) of a function (..., k) of the rig."""
    rig = rig.to(torch.float64)
    matrix = torch.as_tensor(covariance.matrix, dtype=torch.float64)
    names = [name.rpartition(".") for name in covariance.names]
    if matrix.shape != (len(names), len(names)):
        raise ValueError(
            f"a covariance of {len(names)} names needs as many rows and columns, got {matrix.shape}"
        )
    kinds = dict.fromkeys(name for name, _, _ in names)
    zeros = {k: z.detach() for k, z in rig.parameters(free=kinds).items()} if kinds else {}
    if unknown := kinds.keys() - zeros.keys():
        raise ValueError(
            f"the rig has no parameter {', '.join(sorted(unknown))}: is the covariance of this rig?"
        )
    places = torch.zeros(len(names), sum(z.numel() for z in zeros.values()), dtype=torch.float64)
    first = dict(zip(zeros, torch.tensor([0, *(z.numel() for z in zeros.values())]).cumsum(0).tolist()))
    for row, (kind, _, index) in enumerate(names):
        if not index.isdecimal() or int(index) >= zeros[kind].numel():
            raise ValueError(
                f"the rig's parameter {kind} has no part {index}: is the covariance of this rig?"
            )
        places[row, first[kind] + int(index)] = 1

    def moved(change: Tensor) -> Tensor:
        parts = change.split([z.numel() for z in zeros.values()])
        return f(rig.perturbed({k: part.reshape(z.shape) for (k, z), part in zip(zeros.items(), parts)}))

    J = torch.func.jacfwd(moved)(places.new_zeros(places.shape[1]))
    return product(product(J, places.mT @ matrix @ places), J.mT)
