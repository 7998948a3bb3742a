"""One process of training, or one of several that torchrun started."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor, distributed, nn
from torch.nn.parallel import DistributedDataParallel

CPU = torch.device("cpu")


@dataclass(frozen=True)
class Process:
    """Rank of this process, their number, and its device."""

    rank: int = 0
    count: int = 1
    device: torch.device = CPU

    @property
    def first(self) -> bool:
        """Whether this process writes and validates."""
        return self.rank == 0

    def share(self, groups: int) -> list[int]:
        """This process's groups of a step. Raises ValueError where they cannot be distributed evenly."""
        if groups % self.count:
            raise ValueError(
                f"{groups} groups cannot be shared by {self.count} processes: give --groups a multiple"
            )
        return list(range(self.rank, groups, self.count))

    def together(self, objective: nn.Module) -> nn.Module:
        """The module, with its gradients averaged over all processes."""
        return objective if self.count == 1 else DistributedDataParallel(objective)

    def mean(self, number: Tensor) -> Tensor:
        """The mean over all processes."""
        if self.count > 1:
            distributed.all_reduce(number)
        return number / self.count

    def agreed(self, number: float) -> float:
        """The first process's number, in all of them."""
        if self.count == 1:
            return number
        shared = torch.tensor([number], dtype=torch.float64, device=self.device)
        distributed.broadcast(shared, 0)
        return float(shared)

    def wait(self) -> None:
        """Barrier: wait for all processes."""
        if self.count > 1:
            distributed.barrier()

    @contextmanager
    def before_others(self) -> Iterator[None]:
        """A block that the first process goes through before the others, for which it may leave a file."""
        if not self.first:
            self.wait()
        yield
        if self.first:
            self.wait()


@contextmanager
def process(device: str = "auto") -> Iterator[Process]:
    """This process, connected with the others if torchrun started several (gloo on CPUs, NCCL on GPUs).

    Raises ValueError for a device that does not exist.
    """
    count = int(os.environ.get("WORLD_SIZE", "1"))
    chosen = _device(device)
    if count == 1:
        yield Process(device=chosen)
        return
    distributed.init_process_group("nccl" if chosen.type == "cuda" else "gloo")
    try:
        yield Process(distributed.get_rank(), count, chosen)
    finally:
        distributed.destroy_process_group()


def _device(name: str) -> torch.device:
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
    except RuntimeError:
        raise ValueError(
            f"device '{name}' is not one that torch knows: give auto, cpu, cuda or cuda:N"
        ) from None
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ValueError(f"device '{name}': there is no GPU that torch can use; give --device cpu")
    if device.type == "cuda" and device.index is None:
        device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
        torch.cuda.set_device(device)
    return device
