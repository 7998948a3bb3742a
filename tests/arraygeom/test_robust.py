"""Weighted and robust linear least squares."""

import numpy as np
import pytest
import torch

from arraygeom.robust import (
    LocalModel,
    Precision,
    cauchy,
    gaussian,
    least_squares,
    levenberg_marquardt,
    normal_deviation,
    robust_least_squares,
)

TRUE = torch.tensor([0.5, -1.0, 2.0]).double()


def measured(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Terms (3, 200), values and weights."""
    g = torch.Generator().manual_seed(seed)
    terms = torch.randn(3, 200, generator=g, dtype=torch.float64)
    noise = 0.01 * torch.randn(200, generator=g, dtype=torch.float64)
    return terms, terms.T @ TRUE + noise, torch.rand(200, generator=g, dtype=torch.float64) + 0.1


def test_least_squares_are_numpys_of_rows_times_the_root_of_their_weights():
    terms, values, weight = measured()
    root = weight.sqrt().numpy()
    expected = np.linalg.lstsq(root[:, None] * terms.T.numpy(), root * values.numpy(), rcond=None)[0]
    assert np.abs(least_squares(terms, values, weight).numpy() - expected).max() < 1e-12
    without = least_squares(terms, values, weight, torch.zeros(3, 3, dtype=torch.float64))
    assert np.abs(without.numpy() - expected).max() < 1e-12


def test_several_columns_are_solved_for_at_once():
    terms, values, weight = measured()
    both = least_squares(terms, torch.stack([values, -2 * values], 1), weight)
    torch.testing.assert_close(both[:, 0], least_squares(terms, values, weight))
    torch.testing.assert_close(both[:, 1], -2 * both[:, 0])
    columns = torch.stack([values, -2 * values, values, values], 1)
    for prior in (None, torch.eye(3).double()):
        found = least_squares(terms, columns.view(-1, 2, 2), weight, prior)
        torch.testing.assert_close(found, least_squares(terms, columns, weight, prior).view(3, 2, 2))
        assert not least_squares(terms[:, :0], columns[:0], weight[:0], prior).any()


def test_a_prior_is_as_many_further_values():
    """A coefficient of standard deviation d about 0 is a value 0 of that deviation, beside those of 1."""
    terms, values, weight = measured()
    rows = torch.cat([terms, torch.eye(3).double()], 1), torch.cat([values, torch.zeros(3)])
    expected = least_squares(*rows, torch.cat([weight, torch.tensor([4.0, 9.0, 16.0]).double()]))
    precision = torch.diag(torch.tensor([4.0, 9.0, 16.0]).double())
    torch.testing.assert_close(least_squares(terms, values, weight, precision), expected)


def test_of_terms_that_depend_on_each_other_the_shortest_solution_is_found():
    terms, values, weight = measured()
    twice = least_squares(torch.cat([terms, terms[:1]]), values, weight)
    torch.testing.assert_close(twice[0], twice[3])
    torch.testing.assert_close(twice[0] + twice[3], least_squares(terms, values, weight)[0])


@pytest.mark.parametrize("weights", [cauchy, gaussian])
def test_wrong_values_hardly_count(weights):
    terms, values, weight = measured()
    values[::5] += 3
    start = least_squares(terms, values, weight)
    found = robust_least_squares(
        terms, values, start, lambda r: weight * weights(r, 3 * normal_deviation(r, 1e-3))
    )
    assert (start - TRUE).abs().max() > 0.1
    assert (found.coefficients - TRUE).abs().max() < 0.006
    torch.testing.assert_close(found.rest, values - terms.T @ found.coefficients)
    assert found.weight[::5].max() < 0.02 * found.weight.mean()


def test_a_prior_may_depend_on_the_coefficients():
    """A hundredth of each coefficient, about 0: as of the coefficients found, wherever one starts."""
    terms, values, _ = measured()

    def prior(c: torch.Tensor) -> torch.Tensor:
        return 1e4 * torch.diag(c**-2)

    def found(start: torch.Tensor, precision: Precision) -> torch.Tensor:
        return robust_least_squares(
            terms, values, start, lambda r: 100 * cauchy(r, 1.0), precision=precision
        ).coefficients

    one = found(2 * TRUE, prior)
    assert (one - TRUE).abs().max() > 0.1
    torch.testing.assert_close(one, found(TRUE, prior(one)), atol=0.02, rtol=0)


def test_the_deviation_of_normal_values_by_their_median():
    noise = torch.randn(100_000, generator=torch.Generator().manual_seed(0))
    assert normal_deviation(0.3 * noise, 0.0) == pytest.approx(0.3, rel=0.01)
    assert normal_deviation(0 * noise, 0.05) == 0.05


def rosenbrock(x: torch.Tensor) -> torch.Tensor:
    """Its residuals, 0 at (1, 1)."""
    return torch.stack([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def descent(start: list[float], steps: int = 50, where_known: float = torch.inf) -> tuple[torch.Tensor, bool]:
    """Rosenbrock's function minimised; its cost is NaN from a distance of the origin on."""

    def cost(x: torch.Tensor) -> float:
        return float(rosenbrock(x).square().sum()) if float(x.norm()) < where_known else float("nan")

    def model(x: torch.Tensor) -> LocalModel[torch.Tensor]:
        J, r = torch.func.jacrev(rosenbrock)(x), rosenbrock(x)
        information = J.T @ J

        def step(damping: float) -> torch.Tensor:
            return x - torch.linalg.solve(information + damping * information.diagonal().diag(), J.T @ r)

        return LocalModel(cost(x), cost, step)

    first = torch.tensor(start, dtype=torch.float64)
    return levenberg_marquardt(first, model, lambda *states: states[3] < 1e-20, steps=steps, damping=1e-3)


def test_damped_steps_follow_a_curved_valley():
    found, converged = descent([-1.2, 1.0])
    assert converged
    torch.testing.assert_close(found, torch.ones(2).double())
    assert not descent([-1.2, 1.0], steps=3)[1]


def test_a_step_to_where_there_is_no_cost_is_not_made():
    """The undamped step from (-1.2, 1) goes to (1, -3.8)."""
    torch.testing.assert_close(descent([-1.2, 1.0], where_known=2.0)[0], torch.ones(2).double())
    found, converged = descent([-1.2, 1.0], where_known=1e-9)  # there is nowhere to go
    assert converged
    assert found.tolist() == [-1.2, 1.0]
