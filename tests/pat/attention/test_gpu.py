"""The Triton backend: on a GPU if there is one, else through Triton's interpreter, on very small images."""

import os

import pytest
import torch

if not torch.cuda.is_available():
    os.environ.setdefault("TRITON_INTERPRET", "1")
pytest.importorskip("triton", reason="the Triton backend is tested where triton is installed")

from pat.attention import attend_with_statistics
from tests.pat.attention.cases import call, gradients, random_case, relative

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
SEEDS = range(200) if DEVICE == "cuda" else (3, 8, 21, 22)


def moved(tensors: dict, options: dict) -> tuple[dict, dict]:
    tensors = {n: t.detach().to(DEVICE).requires_grad_() for n, t in tensors.items()}
    return tensors, options | {"mask": options["mask"].to(DEVICE)}


@pytest.mark.parametrize("deterministic", [False, True])
@pytest.mark.parametrize("seed", SEEDS)
def test_equals_the_reference(seed, deterministic):
    tensors, options = moved(*random_case(seed))
    torch.use_deterministic_algorithms(deterministic)
    try:
        found = call(attend_with_statistics, tensors, options, backend="triton")
        here = gradients(found, tensors, seed=seed)
    finally:
        torch.use_deterministic_algorithms(False)
    expected = call(attend_with_statistics, tensors, options, backend="reference")
    there = gradients(expected, tensors, seed=seed)
    for name in found._fields:
        assert relative(getattr(found, name), getattr(expected, name)) < 1e-10, name
    for name in tensors:
        assert relative(here[name], there[name]) < (1e-7 if deterministic else 1e-10), name


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_16_bit_inputs_are_accumulated_in_float32(dtype):
    tensors, options = moved(*random_case(3, dtype=torch.float32))
    stored = {
        n: t.detach().to(dtype).requires_grad_() if n in ("query", "key", "value") else t
        for n, t in tensors.items()
    }
    exact = {n: t.detach().float().requires_grad_() for n, t in stored.items()}
    found = call(attend_with_statistics, stored, options, backend="triton")
    expected = call(attend_with_statistics, exact, options, backend="reference")
    assert found.value.dtype == dtype
    rounding = torch.finfo(dtype).eps
    assert relative(found.value, expected.value) <= rounding
    here, there = gradients(found, stored, seed=0), gradients(expected, exact, seed=0)
    assert all(relative(here[name], there[name]) < 4 * rounding for name in tensors)
