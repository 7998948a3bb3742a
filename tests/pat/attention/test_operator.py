"""Inputs that the public functions accept and refuse."""

import importlib
import inspect

import pytest
import torch
from torch.nn.functional import pad

from arraygeom.segments import Positions, Segments

operator = importlib.import_module("pat.attention.attend")
"""The module; the package exports the function of that name."""
Q, K, V = torch.zeros(1, 4, 2, 3), torch.zeros(1, 4, 5, 6), torch.zeros(1, 2, 5, 6)


def segments(*lead):
    return Segments(torch.zeros(*lead, 2), torch.ones(*lead, 2) * 3, torch.ones(lead, dtype=torch.bool))


@pytest.mark.parametrize(
    ("change", "error", "text"),
    [
        ({"query": Q[0]}, ValueError, "must be"),
        ({"query": Q[:, :3]}, ValueError, "channels"),
        ({"value": V[:, :, :4]}, ValueError, "height"),
        ({"value": V[:, :0]}, ValueError, "empty"),
        ({"key": K.double()}, TypeError, "float64, torch.float32|float32, torch.float64"),
        ({"key": K.to("meta")}, ValueError, "meta"),
        ({"interpolation": "bicubic"}, ValueError, "bicubic"),
        ({"backend": "gpu"}, ValueError, "gpu"),
    ],
)
def test_refuses_what_does_not_fit(change, error, text):
    given = {"query": Q, "key": K, "value": V, "interpolation": "nearest", "backend": "auto"} | change
    with pytest.raises(error, match=text):
        operator._check(*given.values())


@pytest.mark.parametrize(
    ("look", "samples", "error", "text"),
    [
        (segments(3, 2), 4, ValueError, "leading"),
        (segments(2, 2, 3), 4, ValueError, "leading"),
        (segments(2, 3), 0, ValueError, r"\b1\b"),
        (segments(2, 3).positions(4), 5, ValueError, "omit"),
        ((0, 0), 4, TypeError, "Segments"),
    ],
)
def test_refuses_sampling_locations_that_do_not_fit(look, samples, error, text):
    with pytest.raises(error, match=text):
        operator.sample_positions(look, Q, samples)


def test_refuses_a_bias_that_does_not_broadcast():
    with pytest.raises(ValueError, match=r"\(7,\).*\(1, 2, 3, 4\)"):
        operator._bias(torch.zeros(7), Q, 4)


def test_refuses_a_function_that_returns_neither():
    with pytest.raises(TypeError, match="return Segments"):
        inspect.unwrap(operator.attend_with_statistics)(Q, K, V, lambda x: x)


def test_samples_left_out_are_one_a_pixel():
    start, end = torch.zeros(3, 2), torch.tensor([[3.2, 0.0], [40.0, 0.0], [torch.inf, 0.0]])
    assert operator.samples_for(Segments(start, end, torch.tensor([True, False, True]))) == 5


@pytest.mark.parametrize("backend", ["cpu", "triton"])
def test_an_explicit_backend_that_cannot_serve_raises(backend, monkeypatch):
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    device = "cuda" if backend == "cpu" else "cpu"
    with pytest.raises(RuntimeError, match=backend):
        operator.chosen_backend(backend, device)


def test_positions_in_another_precision_are_cast():
    look = Positions(torch.ones(2, 3, 4, 2, dtype=torch.float64), torch.ones(2, 3, 4, dtype=torch.bool))
    assert operator.sample_positions(look, Q, None).points.dtype == torch.float32


def test_betas_of_several_sizes_in_one_call_are_those_of_several_calls():
    """Padded by their last row and column, as the page on concepts says."""
    g = torch.Generator().manual_seed(0)
    query = torch.rand(1, 8, 6, 8, generator=g)
    betas = [torch.rand(1, 8, h, w, generator=g) for h, w in ((5, 9), (7, 4))]
    sizes = [torch.tensor([b.shape[3], b.shape[2]]) for b in betas]
    ends = [torch.rand(2, 6, 8, 2, generator=g) * size - 0.5 for size in sizes]
    padded = [pad(b, (0, 9 - b.shape[3], 0, 7 - b.shape[2]), mode="replicate") for b in betas]
    keys, (start, end) = torch.cat(padded), torch.stack(ends, 1)
    seen = torch.ones(2, 6, 8, dtype=torch.bool)
    together = operator.attend(query.expand(2, -1, -1, -1), keys, keys, Segments(start, end, seen), samples=9)
    for i, (beta, (first, last)) in enumerate(zip(betas, ends)):
        alone = operator.attend(query, beta, beta, Segments(first, last, seen[0]), samples=9)
        torch.testing.assert_close(together[i : i + 1], alone)


def test_a_soft_border_makes_the_output_continuous():
    """Where a segment leaves the image the output falls to 0; its gradient is the slope."""
    g = torch.Generator().manual_seed(0)
    query, key = (torch.rand(1, 4, *hw, generator=g).double() for hw in ((1, 1), (20, 20)))

    def at(x: torch.Tensor, **options: float) -> torch.Tensor:
        pixel = torch.stack([x, torch.full_like(x, 9.5)]).reshape(1, 1, 2)
        one = torch.ones(1, 1, dtype=torch.bool)
        return operator.attend(
            query, key, key, Segments(pixel, pixel + 1e-3, one), samples=2, **options
        ).sum()

    for x, soft in ((-0.49, 0.0), (0.0, 0.0), (10.0, float(at(torch.tensor(10.0).double())))):
        assert float(at(torch.tensor(x).double(), border=4.0)) == pytest.approx(soft, abs=1e-3)
    assert float(at(torch.tensor(-0.49).double())) > 0.5
    x = torch.tensor(1.7, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(at(x, border=4.0), x)
    with torch.no_grad():
        change = (at(x + 1e-5, border=4.0) - at(x - 1e-5, border=4.0)) / 2e-5
    assert float(slope) == pytest.approx(float(change), rel=1e-3)
    with pytest.raises(ValueError, match="border"):
        at(x, border=-1.0)


@pytest.mark.parametrize(
    "change",
    [{"query": [1.0]}, {"key": K.numpy()}, {"samples": 2.5}, {"border": "wide"}, {"border": float("nan")}],
)
def test_what_is_no_tensor_or_number_is_refused(change):
    given = {"query": Q, "key": K, "value": V, "locations": segments(2, 3)} | change
    with pytest.raises((TypeError, ValueError), match=next(iter(change))):
        operator.attend(**given)


def test_tensors_without_data_are_refused():
    with pytest.raises(ValueError, match="meta"):
        operator.attend(Q.to("meta"), K, V, segments(2, 3))
