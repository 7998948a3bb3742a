"""Training of any network by any loss: the parts of `pat.training` in a loop for one process."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from pat.training.checkpoints import collect, newest_checkpoint, restore, write_checkpoint
from pat.training.learner import Learner
from pat.training.loop import CHECKPOINTS, Schedule
from pat.training.processes import Process
from pat.training.watch import Watch


def fit(
    network: nn.Module,
    loss: Callable[[Any], Tensor],
    samples: Callable[[int], Iterator[Any]],
    schedule: Schedule,
    out: Path,
    recipe: str,
    *,
    batch: int,
    average: int = 300,
    examine: Callable[[Any], dict[str, float]] = lambda network: {},
    keep: Callable[[Any, int], None] = lambda network, step: None,
) -> nn.Module:
    """Train a network, or continue the same run in the folder `out`; returns it with averaged weights.

    `samples` are those of each step from a given one on, `average` a time constant in steps. The averaged
    network is validated by `examine`, at step 0 too, and given to `keep` with each checkpoint. Raises
    FloatingPointError if the loss or a gradient is not finite, ValueError for a folder with another run.
    """
    averaged = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(1 - 1 / average))
    adam = torch.optim.Adam(network.parameters(), betas=(0.9, 0.99))
    objective: Any = loss
    learner = Learner(network, averaged, objective, objective, adam, 1.0, Process())
    former, step = newest_checkpoint(out / CHECKPOINTS), 0
    if former:
        if former.facts["recipe"] != recipe:
            raise ValueError(
                f"{out} holds a run of another recipe ({former.facts['recipe']}): give another --out"
            )
        restore(former, network, adam, averaged)
        step = former.facts["step"]
    given = samples(step)
    with closing(Watch(out, step, batch, tensorboard=False)) as watch:
        if step == 0 and (facts := examine(averaged.module)):
            watch.validated({"step": 0} | facts)
        while step < schedule.steps:
            rate = schedule.rate_at(step + 1, step / schedule.steps)
            value, norm = learner.gradients([next(given)])
            if not (value.isfinite() and norm.isfinite()):
                raise FloatingPointError(
                    f"step {step + 1}: the loss or its gradient is not finite: lower `rate`"
                )
            learner.update(rate)
            step += 1
            done = step == schedule.steps
            watch.step(step, float(value), float(norm), rate, done=step / schedule.steps)
            if step % schedule.validate == 0 or done:
                watch.validated({"step": step, "loss": float(value)} | examine(averaged.module))
            if step % schedule.save == 0 or done:
                keep(averaged.module, step)
                state = {"step": step, "best": 0.0, "minutes": 0.0, "done": done, "recipe": recipe}
                write_checkpoint(out / CHECKPOINTS, collect(network, adam, averaged, state))
    return averaged.module


def recipe_text(config: Any, *unseen: str) -> str:
    """A recipe without the entries that may differ between a run and its continuation."""
    left_out = {"out", "cache", "save", "validate", *unseen}
    return json.dumps({k: v for k, v in asdict(config).items() if k not in left_out}, default=str)
