"""Weighted least squares: linear, with or without a prior, the same if values may be wrong, and nonlinear.

Wrong values are down-weighted by iteratively reweighted least squares (Holland and Welsch 1977).
`terms` (k, n) are what k coefficients are multiplied with in each of n values.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

NORMAL_DEVIATION = 1.4826
"""Physics: the standard deviation of normal values over the median of their sizes."""
STEPS = 8
"""Size: how often the values are weighted again."""

LEAST_DAMPING, MOST_DAMPING = 1e-9, 1e9
"""Size: shares of the information's diagonal that are added to it. Less would not hold, in float64, what
images leave free, such as scale."""

State = TypeVar("State")
Weigh = Callable[[Tensor], Float[Tensor, " n"]]
Precision = Float[Tensor, "k k"] | Callable[[Tensor], Float[Tensor, "k k"]]


class RobustFit(NamedTuple):
    """Coefficients, the values less what they explain, and the weights with which they were solved for."""

    coefficients: Float[Tensor, " k *m"]
    rest: Float[Tensor, " n *m"]
    weight: Float[Tensor, " n"]


def normal_deviation(rest: Float[Tensor, " n"], least: float) -> float:
    """The standard deviation of normal residuals by their median size (outliers hardly count), or `least`."""
    return max(NORMAL_DEVIATION * float(rest.abs().median()), least)


def cauchy(rest: Float[Tensor, " n"], scale: float) -> Float[Tensor, " n"]:
    """The weights of Cauchy's loss: 1/2 at the scale; large residuals' fall as their square."""
    return 1 / (1 + (rest / scale).square())


def gaussian(rest: Float[Tensor, " n"], scale: float) -> Float[Tensor, " n"]:
    """The weights of Welsch's loss: 1 / e at the scale; large residuals do not count at all."""
    return torch.exp(-(rest / scale).square())


def normal_equations(
    terms: Float[Tensor, "k n"], values: Float[Tensor, " n *m"], weight: Float[Tensor, " n"]
) -> tuple[Float[Tensor, "k k"], Float[Tensor, " k *m"]]:
    """The matrix and the right side whose solution is that of weighted least squares."""
    weighted = terms * weight
    return weighted @ terms.T, weighted @ values


def least_squares(
    terms: Float[Tensor, "k n"],
    values: Float[Tensor, " n *m"],
    weight: Float[Tensor, " n"],
    precision: Float[Tensor, "k k"] | None = None,
) -> Float[Tensor, " k *m"]:
    """The coefficients c of the least sum of weight (values - c terms)^2, plus c precision c.

    Without the precision of a prior the terms may depend on each other: of all solutions it is the shortest.
    """
    if precision is not None:
        information, slope = normal_equations(terms, values, weight)
        return torch.linalg.solve(information + precision, slope)
    root, columns = weight.sqrt()[:, None], values.reshape(len(values), -1)
    solution = torch.linalg.lstsq(root * terms.T, root * columns, driver="gelsd").solution
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
    """`least_squares` with weights by the residuals: `weigh` takes those (n, *m), at first of `start`.

    A precision that depends on the coefficients is a function of them.
    """
    coefficients = start
    for _ in range(steps):
        weight = weigh(values - terms.T @ coefficients)
        prior = precision(coefficients) if callable(precision) else precision
        coefficients = least_squares(terms, values, weight, prior)
    return RobustFit(coefficients, values - terms.T @ coefficients, weight)


class LocalModel(NamedTuple, Generic[State]):
    """A cost near a state: its value there, at any state, and the state after a step.

    step: of Gauss and Newton, with the diagonal of the information raised by a share of it, the damping.
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
    """A state of least cost, and whether it was reached in so many steps: Marquardt's (1963) damping of each.

    The damping rises tenfold until a step does not raise the cost, and falls tenfold after it. `is_converged`
    takes the states before and after a step, and their costs. A state from which no step leads is of least
    cost.
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
