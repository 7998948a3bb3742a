"""The compiled backends as one operator of torch, `pat::attend`, with its gradient, `pat::attend_backward`.

Both are registered with shapes and derivatives, so that torch.compile and autograd see through them. Saved
for backward are the inputs, one log of a sum of exponentials per alpha pixel, and four statistics if asked.
The gradient of the gradient is the reference's.
"""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter

from arraygeom.fields import Local
from arraygeom.runtime.tracing import followed
from pat.attention import reference
from pat.attention.reference import Attended, AttentionInputs, SamplePositions

INPUTS = "Tensor query, Tensor key, Tensor value, Tensor points, Tensor mask, Tensor? bias"
SAVED = (
    "Tensor statistics, Tensor logsum, Tensor best, Tensor? out, "
    "Tensor value_cotangent, Tensor statistics_cotangent"
)
OPTIONS = "int samples, bool straight, bool nearest, bool measured, str backend, bool strict"


def attend(inputs: AttentionInputs, *, measured: bool, backend: str, strict: bool) -> Attended:
    """Compute attention by the `cpu` or the `triton` backend, with gradients.

    Args:
        backend: "cpu" or "triton".
        measured: False leaves out the statistics, whose fields then hold an empty tensor.
        strict: True refuses gradients of gradients instead of using the reference.

    Returns:
        Values and statistics, as the reference's; in backward NotImplementedError is raised if `strict`
        refuses.
    """
    query, key, value, positions, bias, nearest = inputs
    if is_plain(query, key, value, positions.points, bias):
        out, statistics, *_ = compiled(backend).forward(inputs, measured)
    else:
        out, statistics, *_ = _attend(
            *(query, key, value, positions.points, positions.mask, bias),
            *(positions.samples, positions.straight, nearest, measured, backend, strict),
        )
    if not measured:
        return Attended(out, statistics, statistics, statistics)
    return Attended(out, statistics[..., :2].permute(0, 3, 1, 2), statistics[..., 2], statistics[..., 3])


def is_plain(*operands: Tensor | None) -> bool:
    """Return True if no gradient or transformation is in progress, so that kernels can bypass torch's
    dispatcher.

    An operator's first call imports torch's compiler, which takes a second.
    """
    return not wants_gradient(*operands) and is_seen_by_autograd_alone(*operands)


def wants_gradient(*operands: Tensor | None) -> bool:
    """Return True if autograd records operations on some of the operands."""
    return torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in operands)


def is_seen_by_autograd_alone(*operands: Tensor | None) -> bool:
    """Return True if the operands are plain tensors and no mode but autograd has to see each operation."""
    return not followed() and all(type(t) in (Tensor, Parameter) for t in operands if t is not None)


def attend_local(
    query: Tensor,
    key: Tensor,
    value: Tensor,
    field: Local,
    bias: Tensor | None,
    again: Callable[[Tensor, Tensor, Tensor], Tensor],
) -> Tensor:
    """Compute `cpu.forward_local` with gradients by query, key and value; arguments as there.

    Args:
        bias: score (size²) added to each sample, without gradient; None for none.
        again: function of query, key and value that computes the values by the general operator, for
            gradients of gradients.

    Returns:
        Values (b, dv, h, w), channels first; 0 where no sample counts.
    """
    if not wants_gradient(query, key, value):
        return compiled("cpu").forward_local(query, key, value, field, bias)[0]
    return _AttendLocal.apply(query, key, value, field, bias, again)


class _AttendLocal(torch.autograd.Function):
    @staticmethod
    def forward(ctx, query, key, value, field, bias, again):
        out, logsum = compiled("cpu").forward_local(query, key, value, field, bias)
        ctx.save_for_backward(query, key, value, bias, out, logsum)
        ctx.field, ctx.again = field, again
        return out

    @staticmethod
    def backward(ctx, upstream):
        *inputs, bias, out, logsum = ctx.saved_tensors
        wanted = ctx.needs_input_grad[:3]
        if torch.is_grad_enabled():
            inputs = [t.view_as(t) for t in inputs]  # one may depend on another
            asked = [t for t, want in zip(inputs, wanted) if want]
            of_asked = iter(torch.autograd.grad(ctx.again(*inputs), asked, upstream, create_graph=True))
            found = [next(of_asked) if want else None for want in wanted]
        else:
            found = compiled("cpu").backward_local(inputs, ctx.field, bias, (out, logsum), upstream, wanted)
        return *(g if want else None for g, want in zip(found, wanted)), None, None, None


def compiled(backend: str) -> ModuleType:
    """Import the module of a backend when first needed: compilers take time to load."""
    if backend == "cpu":
        from pat.attention import cpu

        return cpu
    from pat.attention import gpu

    return gpu


@torch.library.custom_op(
    "pat::attend", mutates_args=(), schema=f"({INPUTS}, {OPTIONS}) -> (Tensor, Tensor, Tensor, Tensor)"
)
def _attend(*given: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    tensors, (*form, measured, backend, _) = given[:6], given[6:]
    return compiled(backend).forward(_inputs(tensors, form), measured)


def _inputs(tensors: Any, form: Any) -> AttentionInputs:
    """Attention inputs from `INPUTS` and the first three of `OPTIONS`."""
    (query, key, value, points, mask, bias), (samples, straight, nearest) = tensors, form
    return AttentionInputs(query, key, value, SamplePositions(points, mask, samples, straight), bias, nearest)


@_attend.register_fake
def _(query, key, value, points, mask, bias, samples, straight, nearest, measured, backend, strict):
    b, _, ha, wa = query.shape
    out = query.new_empty(b, ha, wa, value.shape[1]).permute(0, 3, 1, 2)
    best = points.new_empty((b, ha, wa) if backend == "triton" else 0, dtype=torch.int32)
    return out, points.new_empty((b, ha, wa, 4) if measured else 0), points.new_empty(b, ha, wa), best


@_attend.register_vmap
def _(info, in_dims, *inputs):
    """One call for each element of the axis: the kernels have a batch axis, but of images of one rig."""
    axes = zip(inputs, in_dims)
    given = [[t if axis is None else t.select(axis, i) for i in range(info.batch_size)] for t, axis in axes]
    outputs = [torch.stack(parts) for parts in zip(*(_attend(*one) for one in zip(*given)))]
    return tuple(outputs), (0,) * len(outputs)


@torch.library.custom_op(
    "pat::attend_backward",
    mutates_args=(),
    schema=f"({INPUTS}, {SAVED}, {OPTIONS}, bool[] wanted) -> (Tensor, Tensor, Tensor, Tensor, Tensor)",
)
def _attend_backward(*given: Any) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    tensors, saved, cotangents = given[:6], given[6:10], given[10:12]
    *form, _, backend, _, wanted = given[12:]
    return compiled(backend).backward(_inputs(tensors, form), saved, cotangents, wanted)


@_attend_backward.register_fake
def _(query, key, value, points, mask, bias, statistics, logsum, *rest):
    wanted = rest[-1]
    images = (
        t.new_empty(len(t), *t.shape[2:], t.shape[1]).permute(0, 3, 1, 2) if want else t.new_empty(0)
        for t, want in zip((query, key, value), wanted)
    )
    weights = (*logsum.shape, rest[2])
    return (
        *images,
        torch.empty_like(points, memory_format=torch.contiguous_format) if wanted[3] else points.new_empty(0),
        points.new_empty(weights if wanted[4] else 0),
    )


def _keep(ctx, inputs, output) -> None:
    query, key, value, points, mask, bias, *ctx.options = inputs
    out = output[0] if ctx.options[-2] == "triton" else None
    ctx.save_for_backward(query, key, value, points, mask, bias, *output[1:], out)


def _differentiate(ctx, value_cotangent, statistics_cotangent, *_):
    saved, needed = ctx.saved_tensors, ctx.needs_input_grad
    wanted = [*needed[:4], needed[5]]
    gradients = _attend_backward(*saved, value_cotangent, statistics_cotangent, *ctx.options, wanted)
    *by_inputs, by_bias = (g if want else None for g, want in zip(gradients, wanted))
    by_bias = by_bias if by_bias is None else by_bias.to(saved[5].dtype)
    return *by_inputs, None, by_bias, *[None] * len(ctx.options)


_attend.register_autograd(_differentiate, setup_context=_keep)


def _keep_again(ctx, inputs, output) -> None:
    ctx.save_for_backward(*inputs[:12])
    ctx.options = inputs[12:]


def _differentiate_again(ctx, *cotangents):
    """The gradient of the gradient: the reference is run again, and its gradient differentiated."""
    *form, measured, backend, strict, wanted = ctx.options
    if strict:
        raise NotImplementedError(f"'{backend}' has no second-order gradients: ask for backend=\"reference\"")
    saved = [_input_again(t) for t in ctx.saved_tensors]
    query, key, value, points, _, bias, *_ = saved
    upstream = saved[10:]
    inputs = [t for t, want in zip((query, key, value, points, bias), wanted) if want]
    cotangents = [c for c, want in zip(cotangents, wanted) if want]
    higher = torch.is_grad_enabled()
    with torch.enable_grad():
        out = reference.attend(_inputs(saved[:6], form))
        outputs = [out.value, _side_by_side(out)] if measured else [out.value]
        given = upstream[: len(outputs)]
        first = torch.autograd.grad(outputs, inputs, given, create_graph=True, materialize_grads=True)
        leaves = [t for t in (query, key, value, points, bias, *upstream) if t is not None]
        first, cotangents = zip(*[(f, c) for f, c in zip(first, cotangents) if f.requires_grad])
        second = iter(torch.autograd.grad(first, leaves, cotangents, allow_unused=True, create_graph=higher))
    q, k, v, p = (next(second) for _ in range(4))
    b = None if bias is None else next(second)
    return q, k, v, p, None, b, None, None, None, None, *second, *[None] * len(ctx.options)


def _input_again(t: Tensor | None) -> Tensor | None:
    """The reference's input, with its own graph; behind it the tensor's if a third order needs it."""
    if t is None or not t.is_floating_point():
        return t
    return t.view_as(t) if torch.is_grad_enabled() and t.requires_grad else t.detach().requires_grad_()


def _side_by_side(out: Attended) -> Tensor:
    """Position, spread and peak as the operator gives them: (b, ha, wa, 4)."""
    return torch.cat([out.position.permute(0, 2, 3, 1), out.deviation[..., None], out.peak[..., None]], -1)


_attend_backward.register_autograd(_differentiate_again, setup_context=_keep_again)
