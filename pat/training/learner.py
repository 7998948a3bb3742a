"""What a run learns with: a network, the average of its weights, the loss and the optimiser."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from torch.nn.utils import clip_grad_norm_
from torch.optim import Adam
from torch.optim.swa_utils import AveragedModel

from pat.networks.weights import Network

from .losses import Objective
from .processes import Process
from .samples import Sample, alone


@dataclass
class Learner:
    """A network and its objective; `together` is the objective whose gradients all processes share.

    `clip` is the largest norm of the gradients.
    """

    network: Network
    average: AveragedModel
    objective: Objective
    together: nn.Module
    adam: Adam
    clip: float
    here: Process

    @property
    def averaged(self) -> Network:
        """The network with averaged weights."""
        return cast(Network, self.average.module)

    def gradients(self, given: list[Sample]) -> tuple[Tensor, Tensor]:
        """The mean loss of all processes' groups, and the norm of its gradients, which are then clipped."""
        self.adam.zero_grad()
        losses = [self._backward(part, len(given), last=part is given[-1]) for part in given]
        norm = clip_grad_norm_(self.network.parameters(), self.clip)
        return self.here.mean(torch.stack(losses).mean()), norm

    def _backward(self, given: Sample, groups: int, *, last: bool) -> Tensor:
        """Add the gradients of one group to the others'; processes exchange them with the last."""
        wait = isinstance(self.together, DistributedDataParallel) and not last
        with self.together.no_sync() if wait else nullcontext():  # type: ignore[operator]
            loss = self.together(given)
            (loss / groups).backward()
        return loss.detach()

    def update(self, rate: float) -> None:
        """One step of the optimiser, and of the average."""
        for group in self.adam.param_groups:
            group["lr"] = rate
        self.adam.step()
        self.average.update_parameters(self.network)

    def offenders(self, given: Sample) -> list[int]:
        """The samples of a group whose loss or gradients are not finite."""
        return [i for i in range(len(given.alpha)) if not self._is_finite(alone(given, i))]

    def _is_finite(self, given: Sample) -> bool:
        self.objective.zero_grad()
        loss = self.objective(given)
        loss.backward()
        gradients = [p.grad for p in self.objective.parameters() if p.grad is not None]
        return bool(loss.isfinite()) and all(bool(g.isfinite().all()) for g in gradients)
