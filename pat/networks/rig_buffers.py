"""A rig as a part of a network."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils import _pytree as pytree

from arraygeom.batching import Batched
from arraygeom.pixels import floating


class RigBuffers(nn.Module):
    """Module that holds a rig, camera or pair as buffers: `.to` moves its numbers and `state_dict` has them.

    Called, it returns the rig (or camera, or pair) with these numbers. Buffers are the given tensors until
    they are moved: loading a `state_dict` writes into those. `.half()` and `.bfloat16()` make float32, as
    half precision holds no pixel position.

    Args:
        rig: rig, camera or pair to hold.
    """

    def __init__(self, rig: Batched) -> None:
        super().__init__()
        numbers, self._layout = pytree.tree_flatten_with_path(rig)
        self._names = [pytree.keystr(path).strip(".").replace(".", "/") for path, _ in numbers]
        for name, (_, number) in zip(self._names, numbers):
            self.register_buffer(name, number)

    def forward(self) -> Any:
        """Return the rig with the buffers' numbers."""
        return pytree.tree_unflatten([self.get_buffer(name) for name in self._names], self._layout)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> RigBuffers:
        def precise(number: Tensor) -> Tensor:
            there = fn(number)
            lowered = number.is_floating_point() and floating(there).dtype != there.dtype
            return number.to(there.device, torch.float32) if lowered else there

        return super()._apply(precise, recurse)
