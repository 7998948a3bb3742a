"""Training loop: steps, validations and checkpoints, on one process or several."""

from __future__ import annotations

import json
import math
import time
from contextlib import closing, nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import cast

import torch
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel
from torch.nn.utils import clip_grad_norm_
from torch.optim import Adam
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from arraygeom.runtime.together import sweep
from pat.networks.paper import PAT
from pat.networks.weights import new_network, save_weights, set_precision
from pat.support.folders import check_apart
from pat.support.locks import folder_lock
from pat.support.tensor_files import write_tensors

from .checkpoints import Checkpoint, collect, newest_checkpoint, restore, write_checkpoint
from .config import TrainConfig, config_text, difference, parse_config, save_config
from .losses import Objective, validation
from .processes import Process, process
from .samples import Sample, alone, made_ahead, scenes
from .watch import Watch

BEST, CHECKPOINTS = "best.safetensors", "checkpoints"
EARLY = 16
"""First step at which images are written; then at each doubling, until the first validation."""


def train(config: TrainConfig) -> Path:
    """Train a network by a recipe, or continue the interrupted run in `config.out`.

    Writes best.safetensors, config.yaml, log.jsonl (a line for each validation), steps.csv (a line for each
    step), images/ and checkpoints/. A finished run is left as it is. With `steps` a continued run gives
    bit-identical weights on a CPU; with `minutes` the time spent before counts.

    Returns:
        File of the best weights.

    Raises:
        FloatingPointError: for a loss or gradient that is not finite, naming the samples; their batch is
            saved.
        FileNotFoundError: for a missing folder of scenes or pairs, or file of weights.
        OSError: if a file cannot be read or written.
        ValueError: for a folder with another run, in use or among the photographs, no such device, and data,
            a field or a number of groups that cannot be used.
    """
    check_apart(config.out, config.photos)
    former = former_run(config)
    if former and former.facts["done"]:
        return config.out / BEST
    with process(config.device) as here, folder_lock(config.out) if here.first else nullcontext():
        if here.first:
            for folder in (config.out, config.out / CHECKPOINTS, config.out / "images"):
                sweep(folder)
        run = Run(config, here, former)
        with closing(run.watch) if run.watch else nullcontext():
            run.work()
        here.wait()
    return config.out / BEST


def former_run(config: TrainConfig) -> Checkpoint | None:
    """Read the newest readable checkpoint of the same run.

    Returns:
        The checkpoint; None if there is none.

    Raises:
        ValueError: if the folder holds another recipe's run, or checkpoints of which none, or whose recipe,
            cannot be read.
    """
    checkpoint = newest_checkpoint(config.out / CHECKPOINTS)
    if checkpoint is None:
        return None
    other = difference(config, parse_config(checkpoint.facts["recipe"], f"{config.out}: checkpoint"))
    if other:
        raise ValueError(f"{config.out} holds a run of another recipe ({other} there): give another --out")
    return checkpoint


def rate_at(config: TrainConfig, step: int, share: float) -> float:
    """Compute the learning rate of a step.

    >>> rate_at(TrainConfig(rate=1e-3, schedule="halving", warmup=0), 1, 0.5)
    0.0005

    Args:
        config: recipe, for `rate`, `schedule` and `warmup`.
        step: number of the step, from 1.
        share: share of the run that is done, 1 at the end; more counts as 1.
    """
    if config.schedule == "halving":
        fall = 0.5 ** int(min(share, 1) * 80 / 30)
    else:
        fall = 0.5 + 0.5 * math.cos(math.pi * min(share, 1))
    return config.rate * (min(step / config.warmup, fall) if config.warmup else fall)


class Run:
    """State of a run: network, objective, averaged weights, and sources of samples.

    Making one seeds torch, and in the first process writes config.yaml and opens the logs in `config.out`.

    Args:
        config: recipe.
        here: this process.
        former: checkpoint to continue from; None starts a run.

    Attributes:
        network: network in training.
        average: its averaged weights.
        together: objective whose gradients all processes share.
        groups: numbers of this process's groups of each step.
        examined: validation samples; empty except in the first process.
        watch: progress reports; None except in the first process.
        step: steps done.
        best: best validation PSNR so far, dB; -infinity before the first.

    Raises:
        ValueError: for data or processes that do not suit the recipe, or a checkpoint of another network.
        OSError: as `train`.
    """

    def __init__(self, config: TrainConfig, here: Process, former: Checkpoint | None) -> None:
        self.config, self.here, self.groups = config, here, here.share(config.groups)
        torch.manual_seed(config.seed)
        self.network = cast(PAT, new_network(config.network, config.start)).to(here.device)
        self.average = AveragedModel(self.network, multi_avg_fn=get_ema_multi_avg_fn(1 - 1 / config.average))
        set_precision(self.network, config.precision, compiled=config.compile)  # not the average's
        self.objective = Objective(self.network, config.loss, attention=config.attention)
        self.together = here.together(self.objective)
        self.adam = Adam(self.network.parameters(), betas=config.momenta)
        with here.before_others():  # a cache of photographs is there for the others
            self.samples, examine = scenes(config, device=str(here.device))
        self.examined = list(examine(8)) if here.first else []
        self.step, self.best, self.loss, minutes = 0, -math.inf, math.nan, 0.0
        if former:
            restore(former, self.network, self.adam, self.average)
            self.step, self.best, minutes = (former.facts[k] for k in ("step", "best", "minutes"))
        self.watch = None
        if here.first:
            save_config(config, config.out / "config.yaml")
            batch = config.batch * config.groups
            self.watch = Watch(config.out, self.step, batch, tensorboard=config.tensorboard)
        self.began = time.monotonic() - 60 * minutes

    @property
    def averaged(self) -> PAT:
        """Network with averaged weights."""
        return cast(PAT, self.average.module)

    @property
    def minutes(self) -> float:
        """Minutes spent, those before a continuation included."""
        return (time.monotonic() - self.began) / 60

    def work(self) -> None:
        """Run steps, validations and checkpoints until the run is done.

        Raises:
            FloatingPointError: for a loss or gradient that is not finite.
            OSError: if a file cannot be written.
            ValueError: for images that cannot be read, and as field, network or loss refuse a sample.
        """
        groups_by_step = self.samples.steps(self.groups, start=self.step)
        recipe = self.config
        for samples in made_ahead(groups_by_step):
            self.step += 1
            share = self.here.agreed(max(self.step / recipe.steps, self.minutes / recipe.minutes))
            self._advance(samples, share)
            if self.step % recipe.validate == 0 or share >= 1:
                self._validate()
            elif self.watch and EARLY <= self.step < recipe.validate and self.step & (self.step - 1) == 0:
                self.watch.show(self.averaged, self.examined, self.step)
            if self.step % recipe.save == 0 or share >= 1:
                self._save(done=share >= 1)
            if share >= 1:
                return

    def _advance(self, samples: list[Sample], share: float) -> None:
        """Do one step of the optimiser. Raises FloatingPointError if loss or gradients are not finite."""
        self.adam.zero_grad()
        losses = [self._backward(sample, len(samples), last=sample is samples[-1]) for sample in samples]
        norm = clip_grad_norm_(self.network.parameters(), self.config.clip)
        loss = self.here.mean(torch.stack(losses).mean())
        if not (torch.isfinite(norm) and torch.isfinite(loss)):
            raise FloatingPointError(self._offence(samples))
        rate = rate_at(self.config, self.step, share)
        for parameters in self.adam.param_groups:
            parameters["lr"] = rate
        self.adam.step()
        self.average.update_parameters(self.network)
        self.loss = float(loss)
        if self.watch:
            self.watch.step(self.step, self.loss, float(norm), rate, done=share)

    def _backward(self, sample: Sample, groups: int, *, last: bool) -> Tensor:
        """Add the gradients of one group; processes exchange them with the last group."""
        wait = isinstance(self.together, DistributedDataParallel) and not last
        with self.together.no_sync() if wait else nullcontext():  # type: ignore[operator]
            loss = self.together(sample)
            (loss / groups).backward()
        return loss.detach()

    def _validate(self) -> None:
        """Measure, show, and save the weights if they are the best so far."""
        if self.watch is None:
            return
        facts = validation(self.averaged, self.examined)
        facts |= {"step": self.step, "loss": self.loss, "minutes": self.minutes}
        self.watch.validated(facts)
        self.watch.show(self.averaged, self.examined, self.step)
        if facts["psnr"] > self.best:
            self.best = facts["psnr"]
            recipe = {"recipe": json.dumps(asdict(self.config), default=str), "validation": json.dumps(facts)}
            save_weights(self.averaged, self.config.out / BEST, facts=recipe)

    def _save(self, *, done: bool) -> None:
        if self.watch:
            self.watch.steps.flush()
            facts = {"step": self.step, "best": self.best, "minutes": self.minutes, "done": done}
            recipe = {"recipe": config_text(self.config)}
            state = collect(self.network, self.adam, self.average, facts | recipe)
            write_checkpoint(self.config.out / CHECKPOINTS, state)

    def _offence(self, samples: list[Sample]) -> str:
        """Save the groups of a failed step. Returns the error message, which names the samples."""
        offences = []
        for group, sample in zip(self.groups, samples):
            bad = [i for i in range(len(sample.alpha)) if not self._is_finite(alone(sample, i))]
            offences += [f"sample {i} of group {group}" for i in bad]
            if bad or len(samples) == 1:
                path = self.config.out / f"offending-step-{self.step}-group-{group}.safetensors"
                save_sample(sample, path, facts={"step": str(self.step), "samples": str(bad)})
        who = ", ".join(offences) or "no single sample of this process"
        return (
            f"step {self.step}: the loss or its gradient is not finite, by {who}; the batch is in "
            f"{self.config.out}/offending-step-{self.step}-*.safetensors: inspect it, or lower `rate` "
            f"(now {self.config.rate:g}); the last checkpoint and the best weights are as they were"
        )

    def _is_finite(self, sample: Sample) -> bool:
        """True if the loss of a sample and its gradients are finite."""
        self.objective.zero_grad()
        loss = self.objective(sample)
        loss.backward()
        gradients = [p.grad for p in self.objective.parameters() if p.grad is not None]
        return bool(loss.isfinite()) and all(bool(g.isfinite().all()) for g in gradients)


def save_sample(sample: Sample, path: Path, *, facts: dict[str, str]) -> None:
    """Write the tensors of a group of samples to a safetensors file: `alpha`, `ground_truth`, and `betas/0`,
    `position/0`, `visible/0` and so on, without the fields.

    Args:
        facts: metadata of the file, text by name.

    Raises:
        OSError: if writing fails.
    """
    tensors = {"alpha": sample.alpha, "ground_truth": sample.ground_truth}
    for name in ("betas", "position", "visible"):
        tensors |= {f"{name}/{i}": t for i, t in enumerate(getattr(sample, name))}
    write_tensors(path, tensors, facts)
