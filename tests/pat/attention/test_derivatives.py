"""Derivatives beyond the gradient: those of the reference, or one clear error."""

import pytest
import torch
from torch.autograd import forward_ad
from torch.autograd.functional import hvp
from torch.func import jacfwd, jvp

from arraygeom.segments import Positions, Segments
from pat.attention import attend


def function_of_query(backend: str):
    torch.manual_seed(0)
    query, key, value = (torch.randn(1, 4, 3, 3, dtype=torch.float64) for _ in range(3))
    start, end = (torch.rand(3, 3, 2, dtype=torch.float64) * 2 for _ in range(2))
    segments = Segments(start, end, torch.ones(3, 3, dtype=torch.bool))

    def run(q):
        return attend(q, key, value, segments, samples=4, backend=backend)

    return run, query, torch.randn_like(query)


def tangent(backend: str):
    run, query, direction = function_of_query(backend)
    with forward_ad.dual_level():
        return forward_ad.unpack_dual(run(forward_ad.make_dual(query, direction))).tangent


def product_with_hessian(backend: str):
    run, query, direction = function_of_query(backend)
    return hvp(lambda q: run(q).pow(3).sum(), query, direction)[1]


def third_order(backend: str):
    run, query, direction = function_of_query(backend)
    query.requires_grad_()
    y = run(query).pow(3).sum()
    for _ in range(3):
        (gradient,) = torch.autograd.grad(y, query, create_graph=True)
        y = (gradient.pow(2) * direction).sum()
    return gradient.detach()


DERIVATIVES = {
    "jvp": lambda backend: jvp(
        function_of_query(backend)[0], *((t,) for t in function_of_query(backend)[1:])
    )[1],
    "jacfwd": lambda backend: jacfwd(function_of_query(backend)[0])(function_of_query(backend)[1]),
    "dual": tangent,
    "hvp": product_with_hessian,
    "third order": third_order,
}


@pytest.mark.parametrize("name", DERIVATIVES)
def test_auto_gives_those_of_the_reference(name):
    expected = DERIVATIVES[name]("reference")
    assert expected.abs().max() > 1e-2
    torch.testing.assert_close(DERIVATIVES[name]("auto"), expected, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("name", DERIVATIVES)
def test_an_explicit_compiled_backend_names_the_one_that_has_them(name):
    with pytest.raises(NotImplementedError, match='backend="reference"'):
        DERIVATIVES[name]("cpu")


def test_a_third_order_through_key_and_geometry_that_depend_on_the_query():
    """Partial derivatives stay partial, also where one input is made of another."""
    torch.manual_seed(1)
    x, value = (torch.randn(1, 4, 3, 3, dtype=torch.float64) for _ in range(2))
    ends = torch.rand(3, 3, 2, dtype=torch.float64) * 2
    x.requires_grad_()

    def third(backend):
        start = ends * 0.3 + x[0, :2].permute(1, 2, 0).sigmoid()
        segments = Segments(start, ends, torch.ones(3, 3, dtype=torch.bool))
        y = attend(x, x.tanh(), value * x, segments, samples=4, backend=backend).pow(3).sum()
        for _ in range(3):
            (gradient,) = torch.autograd.grad(y, x, create_graph=True)
            y = gradient.pow(2).sum()
        return gradient.detach()

    torch.testing.assert_close(third("auto"), third("reference"), rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("backend", ["auto", "cpu", "reference"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.uint8, torch.int64])
def test_a_mask_that_is_not_bool_is_refused(backend, dtype):
    q = torch.randn(1, 4, 3, 3)
    segments = Segments(torch.zeros(3, 3, 2), torch.ones(3, 3, 2), torch.ones(3, 3, dtype=torch.bool))
    positions = Positions(torch.ones(3, 3, 2, 2), torch.ones(3, 3, 2, dtype=torch.bool))
    object.__setattr__(segments, "valid", segments.valid.to(dtype))
    object.__setattr__(positions, "mask", positions.mask.to(dtype))
    for locations in (segments, positions):
        with pytest.raises(TypeError, match="bool"):
            attend(q, q, q, locations, samples=None, backend=backend)
