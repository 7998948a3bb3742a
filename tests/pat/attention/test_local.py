"""The backend for windows: equal to the reference, chosen where it serves, and refused where it does not."""

from functools import partial

import pytest
import torch
from torch.autograd import forward_ad

from arraygeom import Local, Pair, View, lazily
from arraygeom.runtime.threads import limited_to
from pat.attention import attend, attend_with_statistics, cpu
from pat.attention.kernels import ROWS

BOTH = "local", "reference"
nearest = partial(attend, interpolation="nearest")


def features(hw=(20, 30), dtype=torch.float32, batch=2):
    g = torch.Generator().manual_seed(hw[0])
    return [torch.randn(batch, n, *hw, generator=g).to(dtype) for n in (9, 9, 4)]


@pytest.mark.parametrize("backend", ["reference", "cpu"])
@pytest.mark.parametrize("field", [Local(7), Local(7, 3), Local(7, 8), Local(3, 2.0), Local(1)], ids=str)
@pytest.mark.parametrize("hw", [(5, 9), (2 * ROWS + 3, 40)])
def test_it_gives_what_the_others_give(hw, field, backend):
    query, key, value = features(hw)
    wanted = nearest(query.double(), 5 * key.double(), value.double(), field, backend=backend)
    found = nearest(query, 5 * key, value, field, backend="local")
    torch.testing.assert_close(found.double(), wanted, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("field", [Local(7, 3), Local(3), Local(1)], ids=str)
def test_a_bias_counts_for_each_sample(field):
    given, bias = features(), 3 * torch.randn(field.size**2, generator=torch.Generator().manual_seed(1))
    local, reference = (nearest(*given, field, bias=bias, backend=backend) for backend in BOTH)
    torch.testing.assert_close(local, reference, rtol=1e-5, atol=1e-5)
    assert torch.allclose(local, nearest(*given, field), atol=1e-5) == (field.size == 1)


@pytest.mark.parametrize("left", [0, 1, 12])
def test_a_bias_may_leave_samples_out(left):
    given, bias = features(), torch.full((25,), -torch.inf)
    bias[torch.randperm(25, generator=torch.Generator().manual_seed(1))[:left]] = 0.5
    values = [nearest(*given, Local(5), bias=bias, backend=backend) for backend in BOTH]
    slopes = [windows_gradients(given, Local(5), backend, bias=bias) for backend in BOTH]
    for found, wanted in (values, slopes):
        torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("score", [torch.nan, torch.inf, -torch.inf])
def test_scores_without_a_number_do_what_they_do_in_the_reference(score):
    query, key, value = (t.abs() for t in features())
    key[:, :, :8, :8] = score
    local, reference = (nearest(query, key, value, Local(3), backend=backend) for backend in BOTH)
    torch.testing.assert_close(local, reference, equal_nan=True)
    assert local[..., 2:5, 2:5].isnan().all() == (score != -torch.inf)


def test_threads_change_no_bit():
    given, found = features((70, 50)), []
    for n in (1, 2, 5):
        with limited_to(n):
            values = nearest(*given, Local(7, 3), backend="local")
            found.append((values, *windows_gradients(given, Local(7, 3), "local")))
    assert all(torch.equal(one, first) for outputs in found for one, first in zip(outputs, found[0]))


def windows_gradients(given, field, backend, *, order=1, **options):
    """Gradients by query, key and value of a function of the values; or of these gradients' squares."""
    query, key, value = (t.clone().requires_grad_() for t in given)
    out = nearest(query, 2 * key, value, field, backend=backend, **options)
    found = out.sin().sum()
    for _ in range(order):
        gradients = torch.autograd.grad(found, (query, key, value), create_graph=order == 2)
        found = sum(g.square().sum() for g in gradients)
    return gradients


@pytest.mark.parametrize("backend", ["local", "auto"])
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("field", [Local(7), Local(7, 3), Local(7, 12), Local(1)], ids=str)
def test_its_gradients_are_the_references(field, order, backend):
    given = features((2 * ROWS + 3, 33))
    found = windows_gradients(given, field, backend, order=order)
    wanted = windows_gradients([t.double() for t in given], field, "reference", order=order)
    for one, other in zip(found, wanted):
        most = 5e-5 * (1 + other.abs().amax().item())
        torch.testing.assert_close(one.double(), other, rtol=1e-4, atol=most)


def test_a_key_that_depends_on_the_query_counts_once():
    """With a graph for second derivatives, or without one."""
    query, _, value = (t.requires_grad_() for t in features((2 * ROWS + 3, 33)))
    out = nearest(query, query.sin(), value, Local(7), backend="local").sum()
    wanted, found = (
        torch.autograd.grad(out, query, create_graph=again, retain_graph=True) for again in (False, True)
    )
    torch.testing.assert_close(found, wanted, rtol=1e-3, atol=1e-3)


def test_it_finds_the_gradients_that_are_wanted_only():
    query, key, value = features()
    for wanted in (query, key, value):
        wanted.requires_grad_()
        nearest(query, key, value, Local(3), backend="local").sum().backward()
        assert [t.grad is not None for t in (query, key, value)] == [t is wanted for t in (query, key, value)]
        wanted.requires_grad_(False)
        wanted.grad = None


UNSERVED = {
    "bilinear": (features(), Local(3), {"interpolation": "bilinear"}),
    "a bias for each pixel": (features(), Local(3), {"bias": torch.rand(20, 30, 9)}),
    "a bias in float64": (features(), Local(3), {"bias": torch.rand(9, dtype=torch.float64)}),
    "even size": (features(), Local(4), {}),
    "half a pixel": (features(), Local(3, 1.5), {}),
    "float64": (features(dtype=torch.float64), Local(3), {}),
    "16 bits": (features(dtype=torch.bfloat16), Local(3), {}),
    "a gradient by the bias": (features(), Local(3), {"bias": torch.rand(9, requires_grad=True)}),
    "two sizes": ((features()[0], *features((10, 15))[1:]), Local(3), {}),
    "any function": (features(), lazily(Local(3), Pair(View(hw=(20, 30)), View(hw=(20, 30)))), {}),
}


@pytest.mark.parametrize("asked", UNSERVED)
def test_what_it_cannot_serve_others_do(asked, monkeypatch):
    given, field, options = UNSERVED[asked]
    options = {"interpolation": "nearest"} | options
    with pytest.raises(RuntimeError, match="'local'"):
        attend(*given, field, backend="local", **options)
    monkeypatch.setattr(cpu, "forward_local", pytest.fail)
    found, wanted = (attend(*given, field, backend=backend, **options) for backend in ("auto", "reference"))
    torch.testing.assert_close(found, wanted, rtol=1e-2 if asked == "16 bits" else 1e-4, atol=1e-4)


def test_forward_mode_is_the_references():
    query, key, value = features()
    with forward_ad.dual_level():
        given = query, forward_ad.make_dual(key, torch.ones_like(key)), value
        with pytest.raises(RuntimeError, match="derivatives"):
            nearest(*given, Local(3), backend="local")
        assert forward_ad.unpack_dual(nearest(*given, Local(3))).tangent is not None


def test_statistics_are_by_the_others():
    given = features()
    found = attend_with_statistics(*given, Local(3), interpolation="nearest")
    wanted = attend_with_statistics(*given, Local(3), interpolation="nearest", backend="reference")
    for one, other in zip(found, wanted):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4)


def test_it_is_chosen_where_it_serves(monkeypatch):
    given, called = features(), []
    monkeypatch.setattr(cpu, "forward_local", lambda *inputs: called.append(inputs) or inputs[2:])
    nearest(*given, Local(3))
    nearest(*given, Local(3), backend="cpu")
    assert len(called) == 1
