"""The Triton backend: on a GPU if there is one, else through Triton's interpreter, on very small images."""

import os

import pytest
import torch

if not torch.cuda.is_available():
    os.environ.setdefault("TRITON_INTERPRET", "1")
pytest.importorskip("triton", reason="the Triton backend is tested where triton is installed")

from tests.pat.attention.cases import differences, of_16_bits, random_case

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
SEEDS = range(200) if DEVICE == "cuda" else (3, 8, 21, 22)


def moved(tensors: dict, options: dict) -> tuple[dict, dict]:
    tensors = {n: t.detach().to(DEVICE).requires_grad_() for n, t in tensors.items()}
    return tensors, options | {"mask": options["mask"].to(DEVICE)}


@pytest.mark.parametrize("seed", SEEDS)
def test_equals_the_reference(seed):
    off = differences(*moved(*random_case(seed)), "triton", seed=seed)
    assert all(value < 1e-10 for value in off.values()), off


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_16_bit_inputs_are_accumulated_in_float32(dtype):
    off = of_16_bits(*moved(*random_case(3, dtype=torch.float32)), dtype, "triton")
    assert off["value"] <= torch.finfo(dtype).eps
