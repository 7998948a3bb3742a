"""Processes of training: a single one, or several started by torchrun."""

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
    """This process among those of the run.

    Attributes:
        rank: number of this process, from 0.
        count: number of processes.
        device: device that it computes on.
    """

    rank: int = 0
    count: int = 1
    device: torch.device = CPU

    @property
    def first(self) -> bool:
        """True for the process that writes and validates."""
        return self.rank == 0

    def share(self, groups: int) -> list[int]:
        """List this process's groups of a step.

        Args:
            groups: number of groups of a step in all processes.

        Returns:
            Numbers of the groups, from 0.

        Raises:
            ValueError: if the groups cannot be distributed evenly.
        """
        if groups % self.count:
            raise ValueError(f"{groups} groups for {self.count} processes: give --groups a multiple")
        return list(range(self.rank, groups, self.count))

    def together(self, objective: nn.Module) -> nn.Module:
        """Return the module with gradients averaged over all processes; the module itself in a single
        process."""
        return objective if self.count == 1 else DistributedDataParallel(objective)

    def mean(self, number: Tensor) -> Tensor:
        """Average a number, a scalar tensor, over all processes.

        Returns:
            The mean, a scalar tensor; with several processes `number` is overwritten by their sum.
        """
        if self.count > 1:
            distributed.all_reduce(number)
        return number / self.count

    def agreed(self, number: float) -> float:
        """Return the first process's number in all processes."""
        if self.count == 1:
            return number
        shared = torch.tensor([number], dtype=torch.float64, device=self.device)
        distributed.broadcast(shared, 0)
        return float(shared)

    def wait(self) -> None:
        """Wait until all processes arrive here."""
        if self.count > 1:
            distributed.barrier()

    @contextmanager
    def before_others(self) -> Iterator[None]:
        """Context manager: the first process runs the block before the others, and may leave a
        file for them."""
        if not self.first:
            self.wait()
        yield
        if self.first:
            self.wait()


@contextmanager
def process(device: str = "auto") -> Iterator[Process]:
    """Context manager that connects this process with the others of torchrun (gloo on CPUs, NCCL on GPUs).

    Args:
        device: torch device; "auto" takes a GPU if there is one.

    Yields:
        This process.

    Raises:
        ValueError: for a device that torch does not know, and CUDA where it has no GPU.
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
        raise ValueError(f"device '{name}': torch does not know it: give auto, cpu, cuda or cuda:N") from None
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ValueError(f"device '{name}': there is no GPU that torch can use; give --device cpu")
    if device.type == "cuda" and device.index is None:
        device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
        torch.cuda.set_device(device)
    return device
