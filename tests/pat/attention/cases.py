"""Random inputs of attention, and how two outputs compare."""

import torch
from torch import Tensor

from arraygeom.segments import Positions, Segments
from pat.attention import attend_with_statistics


def random_case(seed: int, *, dtype=torch.float64) -> tuple[dict, dict]:
    """Differentiable tensors and other arguments of a random call: sizes, masks, kinds of locations."""
    g = torch.Generator().manual_seed(seed)

    def pick(low: int, high: int) -> int:
        return int(torch.randint(low, high + 1, (), generator=g))

    b, ha, wa, hb, wb = pick(1, 3), pick(1, 6), pick(1, 7), pick(1, 7), pick(1, 9)
    d, dv, samples = pick(1, 40), pick(1, 40), pick(1, 12)
    straight, batched = pick(0, 1), pick(0, 1)
    lead = (b, ha, wa) if batched else (ha, wa)

    def points(*shape: int) -> Tensor:
        unit = torch.rand(*shape, 2, generator=g, dtype=torch.float64)
        return (unit * torch.tensor([wb + 2.0, hb + 2.0]) - 1.5).to(dtype).requires_grad_()

    def features(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64).to(dtype).requires_grad_()

    tensors = {
        "query": (features(b, d, ha, wa) / d**0.5).detach().requires_grad_(),
        "key": features(b, d, hb, wb),
        "value": features(b, dv, hb, wb),
    }
    if straight:
        tensors |= {"start": points(*lead), "end": points(*lead)}
        mask = torch.rand(lead, generator=g) > 0.2
    else:
        tensors["xy"] = points(*lead, samples)
        mask = torch.rand((*lead, samples), generator=g) > 0.2
    if pick(0, 2) == 0:
        tensors["bias"] = features(samples)
    options = {"samples": samples, "mask": mask, "interpolation": ("nearest", "bilinear")[pick(0, 1)]}
    return tensors, options


def call(function, tensors: dict, options: dict, **more):
    """Calls `attend` or `attend_with_statistics` on a case."""
    if "start" in tensors:
        look = Segments(tensors["start"], tensors["end"], options["mask"])
    else:
        look = Positions(tensors["xy"], options["mask"])
    return function(
        *(tensors[name] for name in ("query", "key", "value")),
        look,
        samples=options["samples"],
        interpolation=options["interpolation"],
        bias=tensors.get("bias"),
        **more,
    )


def gradients(out, tensors: dict, *, seed: int) -> dict:
    """Gradients of all tensors for one random cotangent of all outputs."""
    g = torch.Generator().manual_seed(seed)
    outputs = [t for t in out if t.requires_grad]
    cotangents = [torch.randn(t.shape, generator=g, dtype=torch.float64).to(t) for t in outputs]
    found = torch.autograd.grad(outputs, list(tensors.values()), cotangents, materialize_grads=True)
    return dict(zip(tensors, found))


def relative(a: Tensor, b: Tensor) -> float:
    """The largest difference, relative to the largest number (or to 1, if that is smaller)."""
    a, b = a.detach().double(), b.detach().double()
    return float((a - b).abs().max() / b.abs().max().clamp(min=1.0))


def differences(tensors: dict, options: dict, backend: str, *, seed: int) -> dict[str, float]:
    """Return the differences of a backend's outputs, and of the gradients by all tensors, from the
    reference's."""
    found, expected = (
        call(attend_with_statistics, tensors, options, backend=b) for b in (backend, "reference")
    )
    here, there = (gradients(out, tensors, seed=seed) for out in (found, expected))
    by_output = {name: relative(getattr(found, name), getattr(expected, name)) for name in found._fields}
    return by_output | {name: relative(here[name], there[name]) for name in tensors}


def of_16_bits(tensors: dict, options: dict, dtype: torch.dtype, backend: str) -> dict[str, float]:
    """Return the differences of outputs for features in 16 bits from the reference's of the same numbers.

    Types and gradients are checked too.
    """
    images = ("query", "key", "value")
    stored = {n: t.detach().to(dtype).requires_grad_() if n in images else t for n, t in tensors.items()}
    exact = {n: t.detach().float().requires_grad_() for n, t in stored.items()}
    found = call(attend_with_statistics, stored, options, backend=backend)
    expected = call(attend_with_statistics, exact, options, backend="reference")
    assert (found.value.dtype, found.position.dtype) == (dtype, torch.float32)
    here, there = gradients(found, stored, seed=0), gradients(expected, exact, seed=0)
    for name in tensors:
        assert here[name].dtype == stored[name].dtype
        assert relative(here[name], there[name]) < 4 * torch.finfo(dtype).eps, name
    return {name: relative(getattr(found, name), getattr(expected, name)) for name in found._fields}
