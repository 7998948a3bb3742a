"""Least squares: linear with or without a prior, robust, and nonlinear.

Outliers are down-weighted by iteratively reweighted least squares (Holland and Welsch 1977). `terms` (k, n)
are the factors of k coefficients in each of n values.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from .checks import check_above

NORMAL_DEVIATION = 1.4826
"""Physics: standard deviation of normal values divided by the median of their absolute values."""
STEPS = 8
"""Size: number of reweightings."""

LEAST_DAMPING, MOST_DAMPING = 1e-9, 1e9
"""Size: bounds of the damping, as shares of the information's diagonal. Less would not hold, in float64, what
images leave free, such as scale."""

State = TypeVar("State")
Weigh = Callable[[Tensor], Float[Tensor, " n"]]
Precision = Float[Tensor, "k k"] | Callable[[Tensor], Float[Tensor, "k k"]]


class RobustFit(NamedTuple):
    """Result of a robust fit.

    Attributes:
        coefficients: fitted coefficients (k, *m).
        rest: residuals (n, *m): values minus coefficients times terms.
        weight: weights (n) of the values in the last step, from the residuals before it.
    """

    coefficients: Float[Tensor, " k *m"]
    rest: Float[Tensor, " n *m"]
    weight: Float[Tensor, " n"]


def normal_deviation(rest: Float[Tensor, " n"], least: float) -> float:
    """Estimate the standard deviation of residuals from their median absolute value; at least `least`."""
    return max(NORMAL_DEVIATION * float(rest.abs().median()), least)


def cauchy(rest: Float[Tensor, " n"], scale: float) -> Float[Tensor, " n"]:
    """Compute the weights of Cauchy's loss: 1/2 at `scale`, falling with the square of large residuals."""
    return 1 / (1 + (rest / scale).square())


def gaussian(rest: Float[Tensor, " n"], scale: float) -> Float[Tensor, " n"]:
    """Compute the weights of Welsch's loss: 1 / e at `scale`; large residuals do not count at all."""
    return torch.exp(-(rest / scale).square())


def normal_equations(
    terms: Float[Tensor, "k n"], values: Float[Tensor, " n *m"], weight: Float[Tensor, " n"]
) -> tuple[Float[Tensor, "k k"], Float[Tensor, " k *m"]]:
    """Return the matrix (k, k) and right-hand side (k, *m) of weighted least squares."""
    weighted = terms * weight
    return weighted @ terms.T, weighted @ values


def least_squares(
    terms: Float[Tensor, "k n"],
    values: Float[Tensor, " n *m"],
    weight: Float[Tensor, " n"],
    precision: Float[Tensor, "k k"] | None = None,
) -> Float[Tensor, " k *m"]:
    """Minimise the weighted sum of squares of values - c terms, plus c precision c.

    Args:
        terms: k explaining terms of each of n values.
        values: values to explain; axes *m are solved at once.
        weight: weight of each value, at least 0.
        precision: inverse covariance (k, k) of a prior of zero mean; None for no prior: terms may then be
            dependent.

    Returns:
        Coefficients c (k, *m); without a prior the shortest of all solutions.

    Raises:
        ValueError: without a prior, for NaN, infinity and a weight below 0.
        RuntimeError: for equations that a prior leaves singular.
    """
    columns = values[..., None].flatten(1)
    if precision is not None:
        information, slope = normal_equations(terms, columns, weight)
        solution = torch.linalg.solve(information + precision, slope)
    else:
        rows = (weight.sqrt()[:, None] * torch.cat([terms.T, columns], 1)).cpu()
        if not bool(rows.isfinite().all()):
            raise ValueError("terms, values or weights hold NaN or infinity, or a weight is below 0")
        A, b = rows.tensor_split([len(terms)], 1)
        solution = torch.linalg.lstsq(A, b, driver="gelsd").solution.to(values)
    return solution.reshape(len(terms), *values.shape[1:])


def robust_least_squares(
    terms: Float[Tensor, "k n"],
    values: Float[Tensor, " n *m"],
    start: Float[Tensor, " k *m"],
    weigh: Weigh,
    *,
    precision: Precision | None = None,
    steps: int = STEPS,
) -> RobustFit:
    """Solve `least_squares` in steps with weights from the residuals.

    Args:
        terms: value of each of k terms at n points.
        values: values (n) or (n, m) that the sum of terms times coefficients is to match.
        start: coefficients whose residuals give the first weights.
        weigh: function from residuals (n, *m) to weights (n).
        precision: inverse covariance of a prior of zero mean, or a function of the coefficients that returns
            it; None for no prior.
        steps: number of steps, at least 1: each makes weights, and a fit with them.

    Returns:
        The fit after the last step.

    Raises:
        ValueError: for fewer steps, and as `least_squares`, which raises RuntimeError too.
    """
    check_above(1, whole=True, steps=steps)
    coefficients = start
    for _ in range(steps):
        weight = weigh(values - terms.T @ coefficients)
        prior = precision(coefficients) if callable(precision) else precision
        coefficients = least_squares(terms, values, weight, prior)
    return RobustFit(coefficients, values - terms.T @ coefficients, weight)


class LocalModel(NamedTuple, Generic[State]):
    """Model of a cost near a state.

    Attributes:
        cost: cost of the state.
        cost_of: function that returns the cost of any state.
        step: function from a damping to the state after a Gauss-Newton step with it, usually with the
            information matrix's diagonal times 1 + damping.
    """

    cost: float
    cost_of: Callable[[State], float]
    step: Callable[[float], State]


def levenberg_marquardt(
    state: State,
    model: Callable[[State], LocalModel[State]],
    is_converged: Callable[[State, State, float, float], bool],
    *,
    steps: int,
    damping: float,
) -> tuple[State, bool]:
    """Minimise a cost by Levenberg-Marquardt steps (Marquardt 1963).

    The damping rises tenfold until a step does not raise the cost, and falls tenfold after it.

    Args:
        state: state to start from, of any type.
        model: function that returns the local model of a state.
        is_converged: function of the states before and after a step, and their costs; True ends with the
            state after it.
        steps: largest number of steps; 0 returns `state`.
        damping: damping of the first step.

    Returns:
        The state, and True if it converged, or no step up to `MOST_DAMPING` keeps the cost from rising.
    """
    for _ in range(steps):
        before = model(state)
        while not math.isfinite(cost := before.cost_of(moved := before.step(damping))) or cost > before.cost:
            damping *= 10
            if damping >= MOST_DAMPING:
                return state, True
        if is_converged(state, moved, before.cost, cost):
            return moved, True
        state, damping = moved, max(damping / 10, LEAST_DAMPING)
    return state, False
