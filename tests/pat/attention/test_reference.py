"""The formula against a loop written by hand, textbook row attention, and finite differences."""

import importlib
import math

import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

from arraygeom.segments import Positions, Segments
from pat.attention import attend, attend_with_statistics, reference
from tests.pat.attention.cases import call, random_case


def by_hand(q, key, value, xy, counts):
    """One alpha pixel, bilinear, in plain Python: output, position, spread, peak."""
    h, w = key.shape[1:]

    def at(image, x, y):
        x, y = min(max(x, 0.0), w - 1.0), min(max(y, 0.0), h - 1.0)
        x0, y0 = math.floor(x), math.floor(y)
        x1, y1 = min(x0 + 1, w - 1), min(y0 + 1, h - 1)
        u, v = x - x0, y - y0
        upper = (1 - u) * image[:, y0, x0] + u * image[:, y0, x1]
        return (1 - v) * upper + v * ((1 - u) * image[:, y1, x0] + u * image[:, y1, x1])

    seen = [
        (x, y)
        for (x, y), c in zip(xy.tolist(), counts)
        if c and -0.5 <= x <= w - 0.5 and -0.5 <= y <= h - 0.5
    ]
    if not seen:
        return torch.zeros(value.shape[0], dtype=value.dtype), (0.0, 0.0), 0.0, 0.0
    mass = [math.exp(float(q @ at(key, x, y))) for x, y in seen]
    weights = [m / sum(mass) for m in mass]
    out = sum(a * at(value, x, y) for a, (x, y) in zip(weights, seen))
    px, py = (sum(a * p[i] for a, p in zip(weights, seen)) for i in (0, 1))
    spread = math.sqrt(sum(a * ((x - px) ** 2 + (y - py) ** 2) for a, (x, y) in zip(weights, seen)))
    return out, (px, py), spread, max(weights)


def test_equals_a_loop_by_hand():
    torch.manual_seed(0)
    q, key, value = (
        torch.randn(1, d, h, w, dtype=torch.float64) for d, h, w in ((3, 4, 5), (3, 6, 7), (2, 6, 7))
    )
    xy = torch.rand(4, 5, 6, 2, dtype=torch.float64) * 9 - 1
    mask = torch.rand(4, 5, 6) > 0.3
    mask[0, 0] = False
    out = attend_with_statistics(q, key, value, Positions(xy, mask), backend="reference")
    for y in range(4):
        for x in range(5):
            seen, position, spread, peak = by_hand(
                q[0, :, y, x], key[0], value[0], xy[y, x], mask[y, x].tolist()
            )
            torch.testing.assert_close(out.value[0, :, y, x], seen)
            torch.testing.assert_close(out.position[0, :, y, x], torch.tensor(position, dtype=torch.float64))
            assert out.deviation[0, y, x].item() == pytest.approx(spread)
            assert out.peak[0, y, x].item() == pytest.approx(peak)


def test_border_pixels_reach_half_a_pixel_out():
    query, key = torch.ones(1, 1, 1, 4), torch.arange(3.0).view(1, 1, 1, 3) + 1
    x = torch.tensor([-0.502, -0.4995, 2.4995, 2.502])
    field = Positions(torch.stack([x, 0 * x], -1)[None, :, None], torch.ones(1, 4, 1, dtype=torch.bool))
    for interpolation in ("bilinear", "nearest"):
        out = attend(query, key, key, field, interpolation=interpolation, backend="reference")
        assert out.flatten().tolist() == [0, 1, 3, 0]


@pytest.mark.parametrize("seed", range(4))
def test_first_and_second_derivatives(seed):
    tensors, options = random_case(seed * 7 + 1)
    small = {
        name: t.detach()[:1, :3].requires_grad_() if t.dim() == 4 and name in ("query", "key", "value") else t
        for name, t in tensors.items()
    }
    if options["mask"].dim() == (3 if "start" in small else 4):
        options["mask"] = options["mask"][:1]
        small |= {n: small[n].detach()[:1].requires_grad_() for n in ("start", "end", "xy") if n in small}

    def run(*values):
        out = call(attend_with_statistics, dict(zip(small, values)), options, backend="reference")
        return tuple(t for t in out if t.requires_grad)

    assert gradcheck(run, tuple(small.values()), fast_mode=True)
    assert gradgradcheck(run, tuple(small.values()), fast_mode=True)


def test_bands_change_nothing(monkeypatch):
    tensors, options = random_case(5)
    whole = call(attend_with_statistics, tensors, options, backend="reference")
    monkeypatch.setattr(reference, "BAND_BYTES", 1)
    for a, b in zip(whole, call(attend_with_statistics, tensors, options, backend="reference")):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
@pytest.mark.parametrize("explicit", [True, False])
def test_a_function_asked_in_chunks_equals_the_whole(monkeypatch, backend, explicit):
    """Gradients must also reach what the function closes over: a rig's parameters."""
    torch.manual_seed(2)
    q, key, value = (torch.randn(2, 4, h, 7, dtype=torch.float64).requires_grad_() for h in (6, 5, 5))
    scale = torch.tensor(0.8, dtype=torch.float64, requires_grad=True)
    bias = torch.randn(6, 1, 4, dtype=torch.float64)

    def field(x_alpha):
        segments = Segments(x_alpha * scale, x_alpha * scale + 1.7, x_alpha[:, 0] > 0)
        return segments.positions(4) if explicit else segments

    y, x = torch.meshgrid(torch.arange(6.0).double(), torch.arange(7.0).double(), indexing="ij")
    at_once = Segments(torch.stack([x, y], -1) * scale, torch.stack([x, y], -1) * scale + 1.7, x > 0)
    expected = attend(q, key, value, at_once, samples=4, bias=bias, backend="reference")
    monkeypatch.setattr(importlib.import_module("pat.attention.attend"), "CHUNK_SAMPLES", 60)
    monkeypatch.setattr(importlib.import_module("pat.attention.attend"), "CHUNK_PIXELS", 20)
    out = attend(q, key, value, field, samples=4, bias=bias, backend=backend)
    torch.testing.assert_close(out, expected)
    inputs = (q, key, value, scale)
    ours, theirs = (torch.autograd.grad(one.square().sum(), inputs) for one in (out, expected))
    torch.testing.assert_close(ours, theirs)
