"""The compiled CPU backend: the reference's values and gradients, to the bit for any thread count."""

import hashlib
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

from arraygeom.runtime.threads import limited_to
from arraygeom.segments import Positions, Segments
from pat.attention import attend, attend_with_statistics, kernels
from tests.pat.attention.cases import call, differences, gradients, of_16_bits, random_case


@pytest.mark.parametrize(("dtype", "most"), [(torch.float64, 1e-10), (torch.float32, 1e-5)])
@pytest.mark.parametrize("seeds", [range(60), pytest.param(range(60, 500), marks=pytest.mark.slow)])
def test_random_cases(seeds, dtype, most):
    for seed in seeds:
        worst = differences(*random_case(seed, dtype=dtype), "cpu", seed=seed)
        assert max(worst.values()) < most, (seed, worst)


@pytest.mark.parametrize("interpolation", ["nearest", "bilinear"])
@pytest.mark.parametrize(("d", "dv"), [(64, 130), (107, 64)])
def test_more_samples_and_channels_than_are_processed_at_once(interpolation, d, dv):
    torch.manual_seed(d)
    tensors = {
        name: torch.randn(1, *shape, dtype=torch.float64)
        for name, shape in (("query", (d, 3, 37)), ("key", (d, 30, 40)), ("value", (dv, 30, 40)))
    }
    tensors["query"] /= d**0.5
    tensors |= {name: torch.rand(3, 37, 2, dtype=torch.float64) * 42 - 1.5 for name in ("start", "end")}
    tensors = {name: t.requires_grad_() for name, t in tensors.items()}
    options = {"samples": 120, "mask": torch.rand(3, 37) > 0.1, "interpolation": interpolation}
    assert max(differences(tensors, options, "cpu", seed=1).values()) < 1e-10


@pytest.mark.parametrize("dtype", [torch.bfloat16, pytest.param(torch.float16, marks=pytest.mark.slow)])
def test_16_bit_inputs_are_accumulated_in_float32(dtype):
    off = of_16_bits(*random_case(3, dtype=torch.float32), dtype, "cpu")
    assert off["value"] <= torch.finfo(dtype).eps / 2 * 1.01
    assert off["position"] < 1e-5


def test_the_cache_of_compiled_code_watches_every_file_of_the_kernels():
    sources = b"".join(path.read_bytes() for path in sorted(Path(kernels.__file__).parent.glob("*.py")))
    for entry in (kernels.forward, kernels.backward, kernels.scatter):
        assert entry._cache._cache_file._source_stamp == hashlib.sha256(sources).hexdigest()


def big_case(dtype=torch.float32):
    torch.manual_seed(0)
    q, key, value = (torch.randn(2, d, 60, 70).to(dtype).requires_grad_() for d in (40, 40, 24))
    start = (torch.rand(2, 60, 70, 2) * 70).requires_grad_()
    end = (torch.rand(2, 60, 70, 2) * 70).requires_grad_()
    return q, key, value, start, end


@pytest.mark.parametrize("interpolation", ["nearest", "bilinear"])
def test_any_number_of_threads_gives_the_same_bits(interpolation):
    inputs = big_case()
    valid = torch.rand(2, 60, 70) > 0.1
    results = []
    for threads in (1, 2, 5, 2):
        with limited_to(threads):
            segments, how = Segments(*inputs[3:], valid), {"interpolation": interpolation, "backend": "cpu"}
            out = attend(*inputs[:3], segments, samples=50, **how)
            wanted = inputs[: 3 if interpolation == "nearest" else 5]
            results.append((out, *torch.autograd.grad(out.square().sum(), wanted)))
    for result in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(result, results[0]))


@pytest.mark.parametrize("seed", range(8))
def test_without_statistics_the_values_and_their_gradients_are_the_same(seed):
    tensors, options = random_case(seed, dtype=torch.float32)
    alone = call(attend, tensors, options, backend="cpu")
    measured = call(attend_with_statistics, tensors, options, backend="cpu").value
    assert torch.equal(alone, measured)
    here, there = gradients([alone], tensors, seed=seed), gradients([measured], tensors, seed=seed)
    assert all(torch.equal(here[name], there[name]) for name in tensors)


def test_gradcheck_also_twice():
    tensors, options = random_case(21)
    options["interpolation"] = "bilinear"
    small = {
        n: t.detach()[:, :2].requires_grad_() if n in ("query", "key", "value") else t
        for n, t in tensors.items()
    }

    def run(*values, backend="auto"):
        return tuple(call(attend_with_statistics, dict(zip(small, values)), options, backend=backend))

    def alone(*values):
        return call(attend, dict(zip(small, values)), options)

    given = tuple(small.values())
    assert gradcheck(run, given, fast_mode=True)
    assert all(gradgradcheck(function, given, fast_mode=True) for function in (run, alone))
    with pytest.raises(RuntimeError, match="second-order"):
        gradgradcheck(partial(run, backend="cpu"), given, fast_mode=True)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
@pytest.mark.parametrize("interpolation", ["nearest", "bilinear"])
def test_pixels_without_samples_give_and_pass_zeros(backend, interpolation):
    q, key, value = (torch.randn(1, 4, 3, 3, dtype=torch.float64, requires_grad=True) for _ in range(3))
    xy = torch.full((3, 3, 2, 2), -5.0, dtype=torch.float64)
    xy[0, 0] = torch.nan
    xy[1, 1] = 1.2
    xy.requires_grad_()
    mask = torch.ones(3, 3, 2, dtype=torch.bool)
    mask[1, 1] = False
    mask[2, 2] = True
    how = {"interpolation": interpolation, "backend": backend}
    out = attend_with_statistics(q, key, value, Positions(xy, mask), **how)
    assert all(t.abs().max() == 0 for t in out)
    outputs = [t for t in out if t.requires_grad]
    ones = [torch.ones_like(t) for t in outputs]
    grads = torch.autograd.grad(outputs, (q, key, value, xy), ones, materialize_grads=True)
    assert all(g.abs().max() == 0 for g in grads)


def test_not_a_number_stays_one():
    q, key, value = (torch.randn(1, 16, 3, 3) for _ in range(3))
    q[0, 2, 1, 1] = torch.nan
    xy = torch.rand(3, 3, 5, 2) * 2
    out = attend(q, key, value, Positions(xy, torch.ones(3, 3, 5, dtype=torch.bool)), backend="cpu")
    assert out.isnan().any(1).nonzero().tolist() == [[0, 1, 1]]


COMPILED = """
import torch
from arraygeom.segments import Segments
from pat.attention import attend
torch.manual_seed(0)
x = [torch.randn(1, 8, 6, 7, requires_grad=True) for _ in range(3)]
ends = [(torch.rand(6, 7, 2) * 5).requires_grad_() for _ in range(2)]
def run(q, k, v, s, e):
    return attend(q, k, v, Segments(s, e, s[..., 0] > 1), samples=5)
a, b = run(*x, *ends), torch.compile(run, backend="aot_eager", fullgraph=True)(*x, *ends)
assert torch.equal(a, b)
for p, q in zip(torch.autograd.grad(a.sum(), x + ends), torch.autograd.grad(b.sum(), x + ends)):
    assert torch.allclose(p, q)
with torch.autocast("cpu", torch.bfloat16):
    low = torch.compile(run, backend="aot_eager", fullgraph=True)(*x, *ends)
assert low.dtype == torch.bfloat16 and (low - a).abs().max() < 0.1
"""


def test_whole_graph_compilation_and_autocast():
    """In a fresh process, because the checks of shapes while testing would break the graph."""
    subprocess.run([sys.executable, "-c", COMPILED], check=True)


@pytest.mark.parametrize("measured", [True, False])
def test_the_operator_passes_torchs_own_checks(measured):
    q, key, value = (torch.randn(2, 8, h, 5, requires_grad=True) for h in (3, 4, 4))
    points = (torch.rand(2, 3, 5, 2, 2) * 4).requires_grad_()
    mask = torch.rand(2, 3, 5, 1) > 0.3
    torch.library.opcheck(
        torch.ops.pat.attend.default,
        (q, key, value, points, mask, None, 4, True, False, measured, "cpu", False),
    )
