"""Most probable parameters by residuals and a normal prior: damped Gauss-Newton, reweighted to Cauchy's loss.

Parameters are in units of their prior standard deviations, so that the prior's covariance is 1. The first
ones are free; the rest are considered: uncertain, so that they explain their share, but they never change the
rig.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from arraygeom.robust import LocalModel, cauchy, levenberg_marquardt, normal_deviation, normal_equations
from arraygeom.runtime.progress import log_step

from .residuals import PARTS

LOG = logging.getLogger(__name__)

LARGEST_POSTERIOR = 0.9
"""Largest posterior deviation of a free parameter, as a share of the prior's; beyond it the parameter is
fixed."""
STEPS = 40
FURTHER_STEPS = 6
"""Number of steps assumed to follow, for the progress shown: most fits end before `STEPS`."""
CONVERGED = 5e-3
"""Largest step, in prior deviations, at which the iteration ends."""
DAMPING = 1e-3
"""Damping of the first step."""
LEAST_NOISE = 0.03
"""Lower bound of the noise of matched points, pixels."""

Residuals = Callable[[Tensor], Sequence[Tensor]]
"""Function from parameters to residuals in parts, such as pairs of cameras: derivatives by what a part does
not depend on are not computed."""


class Evaluated(NamedTuple):
    """Residuals evaluated at given parameters, with the graph to differentiate them.

    Attributes:
        z: parameters, requiring gradients.
        parts: residuals, computed from z, in one tensor or several.
    """

    z: Float[Tensor, " k"]
    parts: Sequence[Tensor]

    @classmethod
    def at(cls, z: Float[Tensor, " k"], residuals: Residuals) -> Evaluated:
        """Evaluate the residuals at z."""
        z = z.detach().requires_grad_()
        return cls(z, residuals(z))

    @property
    def values(self) -> Float[Tensor, " m"]:
        """All residuals in one tensor, detached."""
        return torch.cat([residuals.detach() for residuals in self.parts])


class Solution(NamedTuple):
    """The free parameters of a fit, with their covariance, in prior deviations.

    Attributes:
        z: the free parameters.
        active: mask of the observable ones; the others are fixed at 0.
        covariance: posterior covariance of the free parameters; for fixed ones the prior's, 1.
        full: free and considered parameters that are most probable by the residuals alone, also where `z` has
            been changed to keep depth.
        depth: relative change of depth that the points' lines suggest; None where depth does not count, as
            from `solve`.
    """

    z: Float[Tensor, " n"]
    active: Bool[Tensor, " n"]
    covariance: Float[Tensor, "n n"]
    full: Float[Tensor, " k"]
    depth: float | None = None


def solve(residuals: Residuals, count: int, considered: int = 0) -> Solution:
    """Compute the most probable parameters under a normal prior of variance 1, with unobservable ones fixed.

    Free parameters whose deviation stays above `LARGEST_POSTERIOR` are reset to 0 and the others solved for
    again.

    Args:
        residuals: function of all parameters, the free ones first, that returns residuals in parts.
        count: number of free parameters.
        considered: number of further parameters that are uncertain, but not changed.

    Returns:
        The solution, detached, float64.

    Raises:
        RuntimeError: as `jacobian`.
    """
    total = count + considered
    active = torch.ones(total, dtype=torch.bool)
    z, eye = torch.zeros(total, dtype=torch.float64), torch.eye(total, dtype=torch.float64)
    while True:
        z = most_probable(residuals, z * active, eye[:, active])
        information, _ = _normal_equations(*jacobian(residuals, z), z)
        kept = active[:, None] & active
        covariance = torch.linalg.inv(torch.where(kept, information, eye))
        observable = covariance.diagonal().sqrt() <= LARGEST_POSTERIOR
        observable[count:] = True
        if bool((observable == active).all()):
            return Solution(z[:count], active[:count], covariance[:count, :count], z)
        active = active & observable


def shifts_left_out(
    residuals: Residuals,
    z: Float[Tensor, " k"],
    parts: Int[Tensor, " m"],
) -> Float[Tensor, "g k"]:
    """Compute changes of parameters when one of the `PARTS` x `PARTS` parts of the image is left out.

    To first order, from the most probable z on.

    Args:
        residuals: function of the parameters.
        z: most probable parameters, in prior deviations.
        parts: number of the part in which each residual is, as `parts_of` counts them.

    Returns:
        One row per part, in prior deviations; 0 for a part without residuals.
    """
    r, J = jacobian(residuals, z)
    weight = _weight(r)
    information = normal_equations(J.T, r, weight)[0] + torch.eye(J.shape[1], dtype=J.dtype)
    changes = []
    for number in range(PARTS**2):
        mine = parts == number
        withheld, slope = normal_equations(J[mine].T, r[mine], weight[mine])
        changes.append(torch.linalg.solve(information - withheld, slope))
    return torch.stack(changes)


def posterior_covariance(residuals: Residuals, z: Float[Tensor, " k"]) -> Float[Tensor, "k k"]:
    """Compute the covariance of all parameters at the most probable z, in prior deviations."""
    return torch.linalg.inv(_normal_equations(*jacobian(residuals, z), z)[0])


def most_probable(
    residuals: Residuals, z: Float[Tensor, " k"], basis: Float[Tensor, "k m"], *, steps: int = STEPS
) -> Float[Tensor, " k"]:
    """Compute the most probable parameters z + basis y, from z on, by damped steps.

    Undamped steps shortened until the cost falls would stop short where some parameters are hardly
    observable, as poses by a flat scene are.

    Args:
        residuals: function of the parameters.
        z: parameters to start from, in prior deviations.
        basis: columns of which the change is a combination.
        steps: largest number of steps; no error if they do not suffice.

    Returns:
        The parameters, detached, in prior deviations.

    Raises:
        RuntimeError: as `jacobian`.
    """
    numbers = itertools.count(1)

    def model(evaluated: Evaluated) -> LocalModel[Evaluated]:
        number = next(numbers)
        log_step(LOG, 1 - FURTHER_STEPS / (number - 1 + FURTHER_STEPS), "step %d of the fit", number)
        (r, J), z = _differentiated(evaluated), evaluated.z.detach()
        information, slope = _normal_equations(r, J, z)
        information, slope = basis.T @ information @ basis, basis.T @ slope
        scale, diagonal = noise_scale(r), information.diagonal().diag()

        def step(damping: float) -> Evaluated:
            return Evaluated.at(
                z + basis @ torch.linalg.solve(information + damping * diagonal, slope), residuals
            )

        return LocalModel(cost(r, z, scale), lambda other: cost(other.values, other.z.detach(), scale), step)

    def is_converged(before: Evaluated, after: Evaluated, *_: float) -> bool:
        return float((after.z - before.z).detach().abs().max()) < CONVERGED

    start = Evaluated.at(z, residuals)
    return levenberg_marquardt(start, model, is_converged, steps=steps, damping=DAMPING)[0].z.detach()


def cost(r: Float[Tensor, " m"], z: Float[Tensor, " k"], scale: float) -> float:
    """Compute minus twice the log probability of z and of residuals of this scale, by Cauchy's loss."""
    return float((r / scale).square().log1p().sum() + z.square().sum())


def noise_scale(r: Tensor) -> float:
    """Compute the scale of the residuals: the deviation of normal ones of their median size, at least
    `LEAST_NOISE`."""
    return normal_deviation(r, LEAST_NOISE)


def _weight(r: Tensor) -> Tensor:
    """Return the weight of each squared residual: Cauchy's weights over the noise's variance."""
    scale = noise_scale(r)
    return cauchy(r, scale) / scale**2


def _normal_equations(r: Tensor, J: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
    """Return J^T W J + I and -(J^T W r + z), reweighted for Cauchy's loss."""
    information, slope = normal_equations(J.T, r, _weight(r))
    return information + torch.eye(len(z), dtype=z.dtype), -(slope + z)


def jacobian(
    residuals: Residuals, z: Float[Tensor, " n"]
) -> tuple[Float[Tensor, " m"], Float[Tensor, "m n"]]:
    """Compute residuals and their derivatives, for many values of few parameters.

    The gradient of u . f in z is linear in u; its derivatives in u are the columns of the Jacobian. An entry
    of the gradient that is exactly 0 is of a parameter on which no value depends.

    Returns:
        The residuals (m) and their Jacobian (m, n), detached.

    Raises:
        RuntimeError: by torch, for a part of the residuals that is not computed from z at all.
    """
    return _differentiated(Evaluated.at(z, residuals))


def _differentiated(evaluated: Evaluated) -> tuple[Tensor, Tensor]:
    """Compute the residuals and their derivatives, as `jacobian`."""
    rows = []
    for residuals in evaluated.parts:
        u = torch.linspace(1, 2, len(residuals), dtype=residuals.dtype, requires_grad=True)
        (slope,) = torch.autograd.grad(residuals, evaluated.z, u, create_graph=True)
        depends = slope.detach() != 0
        columns = torch.zeros(len(evaluated.z), len(residuals), dtype=residuals.dtype)
        if bool(depends.any()):
            basis = torch.eye(len(evaluated.z)).to(slope)[depends]
            (columns[depends],) = torch.autograd.grad(
                slope, u, basis, is_grads_batched=True, retain_graph=True
            )
        rows.append(columns.T)
    return evaluated.values, torch.cat(rows)
