"""State of torch around a call: transformations in which values are not available for decisions."""

from __future__ import annotations

import torch
from torch import Tensor


def traced() -> bool:
    """Return True inside `torch.compile` or `torch.func.vmap`: all branches are then computed, loops to their
    end."""
    return torch.compiler.is_compiling() or "Vmap" in transformations()


def followed() -> bool:
    """Return True if torch has to see each operation: it compiles, traces, transforms, or runs a dispatch
    mode."""
    compiled_or_traced = torch.compiler.is_compiling() or torch.jit.is_tracing()
    return bool(compiled_or_traced or torch._C._len_torch_dispatch_stack() or transformations())


def needs_numbers(what: str, *tensors: Tensor) -> None:
    """Declare that a result depends on tensors' values: `torch.compile`'s graph breaks here.

    Does nothing outside compilation and vmap.

    Args:
        what: the result that depends on them, for messages.
        tensors: tensors whose values are needed.

    Raises:
        NotImplementedError: for tensors that `torch.func.vmap` has batched.
        torch._dynamo.exc.Unsupported: while compiling with `fullgraph=True`.
    """
    if torch.compiler.is_compiling():
        torch._dynamo.graph_break(msg=f"{what} depends on numbers: compute it before compiling")
    elif any(_is_batched(t) for t in tensors):
        raise NotImplementedError(f"{what} depends on numbers, which vmap does not know: use a loop")


def transformations() -> tuple[str, ...]:
    """Return the active transformations of `torch.func`, outermost first, such as ("Vmap", "Grad").

    Empty while torch compiles.
    """
    if torch.compiler.is_compiling():
        return ()
    stack = torch._C._functorch.get_interpreter_stack()
    return tuple(level.key().name for level in stack or ())


def _is_batched(t: Tensor) -> bool:
    functorch = torch._C._functorch
    while functorch.is_functorch_wrapped_tensor(t):
        if functorch.is_batchedtensor(t):
            return True
        t = functorch.get_unwrapped(t)
    return False
