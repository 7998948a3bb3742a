"""The loop: steps, validations and checkpoints, on one process or several."""

from __future__ import annotations

import json
import math
import time
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import cast

import torch
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from arraygeom.atomic import sweep
from pat.networks.blocks import in_bfloat16
from pat.networks.weights import NETWORKS, Network, convolutions, load_weights, save_weights
from pat.support.locks import folder_lock
from pat.support.tensor_files import write_tensors

from .checkpoints import Checkpoint, collect, newest_checkpoint, restore, write_checkpoint
from .config import TrainConfig, config_text, difference, parse_config, save_config
from .losses import Objective, validation
from .processes import Process, process
from .samples import Sample, SampleSource, alone, made_ahead, scenes
from .watch import Watch

BEST, CHECKPOINTS = "best.safetensors", "checkpoints"
EARLY = 16
"""From this step on, at each doubling until the first validation, images are written."""


def train(config: TrainConfig) -> Path:
    """Train with the receptive field that the configuration names; returns the file of the best weights.

    In `config.out`: best.safetensors, config.yaml, log.jsonl (a line for each validation), steps.csv (a line
    for each step), images/ and checkpoints/. If that folder holds the same run, interrupted, it continues:
    with `steps` the result is that of an uninterrupted run, bit for bit; with `minutes` the time spent
    counts.

    Raises FloatingPointError if a loss or a gradient is not finite, naming the sample, the batch saved beside
    the weights; OSError if a checkpoint cannot be written; ValueError for a folder with another run, or one
    that another command is writing to.
    """
    former = former_run(config)
    if former and former.facts["done"]:
        return config.out / BEST
    with process(config.device) as here, folder_lock(config.out) if here.first else nullcontext():
        if here.first:
            for folder in (config.out, config.out / CHECKPOINTS, config.out / "images"):
                sweep(folder)
        run = Run(config, here, former)
        try:
            run.work()
        finally:
            if run.watch:
                run.watch.close()
        here.wait()
    return config.out / BEST


class Run:
    """The state of a training run."""

    def __init__(self, config: TrainConfig, here: Process, checkpoint: Checkpoint | None) -> None:
        self.config, self.here = config, here
        self.groups = here.share(config.groups)
        torch.manual_seed(config.seed)
        self.network = new_network(config).to(here.device)
        self.average = AveragedModel(self.network, multi_avg_fn=get_ema_multi_avg_fn(1 - 1 / config.average))
        self.adam = torch.optim.Adam(self.network.parameters(), lr=config.rate, betas=config.momenta)
        self.step, self.best, minutes = 0, -math.inf, 0.0
        self.learn, validate = self._scenes()
        self.validation = [] if not here.first else list(validate(8))
        if checkpoint:
            restore(checkpoint, self.network, self.adam, self.average)
            self.step, self.best, minutes = (checkpoint.facts[k] for k in ("step", "best", "minutes"))
        self.began = time.monotonic() - 60 * minutes
        if here.first:
            save_config(config, config.out / "config.yaml")
        self.watch = Watch(config, step=self.step) if here.first else None
        for part in convolutions(self.network):
            if config.precision == "bfloat16":
                in_bfloat16(part)
            if config.compile:
                part.compile()
        self.objective = here.together(Objective(self.network, config.loss, attention=config.attention))
        self.loss, self.ticked = math.nan, time.monotonic()

    @property
    def averaged(self) -> Network:
        """The network with averaged weights."""
        return cast(Network, self.average.module)

    @property
    def done(self) -> float:
        """How much of the run is done, 1 at the end."""
        return max(self.step / self.config.steps, (time.monotonic() - self.began) / 60 / self.config.minutes)

    def work(self) -> None:
        """Step until done."""
        for given in made_ahead(self.learn.steps(self.groups, start=self.step), self.network):
            self.step += 1
            done = self.here.agreed(self.done)
            self._advance(given, done)
            if self.step % self.config.validate == 0 or done >= 1:
                self._validate()
            elif (
                self.watch and EARLY <= self.step < self.config.validate and self.step & (self.step - 1) == 0
            ):
                self.watch.show(self.averaged, self.validation, self.step)
            if self.step % self.config.save == 0 or done >= 1:
                self._save(done=done >= 1)
            if done >= 1:
                return

    def _advance(self, given: list[Sample], done: float) -> None:
        """One step of the optimiser."""
        config, here = self.config, self.here
        rate = config.rate * shape(config, self.step, done)
        for group in self.adam.param_groups:
            group["lr"] = rate
        self.adam.zero_grad()
        losses = [self._backward(part, last=part is given[-1]) for part in given]
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), config.clip)
        loss = here.mean(torch.stack(losses).mean())
        if not (torch.isfinite(norm) and torch.isfinite(loss)):
            raise FloatingPointError(self._offence(given))
        self.adam.step()
        self.average.update_parameters(self.network)
        self.loss = float(loss)
        now = time.monotonic()
        speed, self.ticked = config.batch * config.groups / (now - self.ticked), now
        if self.watch:
            self.watch.step(self.step, self.loss, float(norm), rate, done=done, speed=speed)

    def _backward(self, given: Sample, *, last: bool) -> Tensor:
        """Add the gradients of one group to the others'; processes exchange them with the last."""
        wait = isinstance(self.objective, DistributedDataParallel) and not last
        with self.objective.no_sync() if wait else nullcontext():  # type: ignore[operator]
            loss = self.objective(given)
            (loss / len(self.groups)).backward()
        return loss.detach()

    def _validate(self) -> None:
        """Measure, show, and keep the weights if they are the best so far."""
        if self.watch is None:
            return
        facts = validation(self.averaged, self.validation)
        facts |= {"step": self.step, "loss": self.loss, "minutes": self._minutes()}
        self.watch.validated(facts)
        self.watch.show(self.averaged, self.validation, self.step)
        if facts["psnr"] > self.best:
            self.best = facts["psnr"]
            recipe = {"recipe": json.dumps(asdict(self.config), default=str), "validation": json.dumps(facts)}
            save_weights(self.averaged, self.config.out / BEST, facts=recipe)

    def _save(self, *, done: bool) -> None:
        if self.watch:
            self.watch.flush()
            facts = {"step": self.step, "best": self.best, "minutes": self._minutes(), "done": done}
            state = collect(
                self.network, self.adam, self.average, facts | {"recipe": config_text(self.config)}
            )
            write_checkpoint(self.config.out / CHECKPOINTS, state)

    def _minutes(self) -> float:
        return (time.monotonic() - self.began) / 60

    def _scenes(self) -> tuple[SampleSource, SampleSource]:
        """Photographs are read by the first process first, which may leave a cache to the others."""
        if not self.here.first:
            self.here.wait()
        sources = scenes(self.config, device=str(self.here.device))
        if self.here.first:
            self.here.wait()
        return sources

    def _offence(self, given: list[Sample]) -> str:
        """Save the groups of a failed step; the error message names the samples."""
        objective = Objective(self.network, self.config.loss, attention=self.config.attention)
        found = []
        for group, part in zip(self.groups, given):
            bad = [i for i in range(len(part.alpha)) if not finite(objective, alone(part, i))]
            found += [f"sample {i} of group {group}" for i in bad]
            if bad or len(given) == 1:
                path = self.config.out / f"offending-step-{self.step}-group-{group}.safetensors"
                save_sample(part, path, facts={"step": str(self.step), "samples": str(bad)})
        who = ", ".join(found) or "no single sample of this process"
        return (
            f"step {self.step}: the loss or its gradient is not finite, by {who}; the batch is in "
            f"{self.config.out}/offending-step-{self.step}-*.safetensors: inspect it, or lower `rate` "
            f"(now {self.config.rate:g}); the last checkpoint and the best weights are as they were"
        )


def shape(config: TrainConfig, step: int, done: float) -> float:
    """The share of `rate` that a step has.

    >>> shape(TrainConfig(schedule="halving", warmup=0), 1, 0.5)
    0.5
    """
    if config.schedule == "halving":
        fall = 0.5 ** int(min(done, 1) * 80 / 30)
    else:
        fall = 0.5 + 0.5 * math.cos(math.pi * min(done, 1))
    return min(step / config.warmup, fall) if config.warmup else fall


def new_network(config: TrainConfig) -> Network:
    """A recipe's network, with the weights it starts from. Raises ValueError if those are another's."""
    network = next(made for made, of in NETWORKS.values() if type(config.network) is of)(config.network)
    if config.start is not None:
        weights = load_weights(config.start)
        if type(weights) is not type(network) or weights.config != config.network:
            raise ValueError(
                f"start: {config.start} holds a {type(weights).__name__} of {weights.config}, "
                f"the recipe is for a {type(network).__name__} of {config.network}: give its own recipe, "
                "or leave `start` out"
            )
        network.load_state_dict(weights.state_dict())
    return network


def finite(objective: Objective, given: Sample) -> bool:
    """Whether the loss of a sample and its gradients are."""
    objective.zero_grad()
    loss = objective(given)
    loss.backward()
    gradients = [p.grad for p in objective.parameters() if p.grad is not None]
    return bool(loss.isfinite()) and all(bool(g.isfinite().all()) for g in gradients)


def save_sample(given: Sample, path: Path, *, facts: dict[str, str]) -> None:
    """A group's sample tensors: alpha, ground truth, and beta, position, visible of each beta by number."""
    tensors = {"alpha": given.alpha, "ground_truth": given.ground_truth}
    for name in ("betas", "position", "visible"):
        tensors |= {f"{name}/{i}": t for i, t in enumerate(getattr(given, name))}
    write_tensors(path, tensors, facts)


def former_run(config: TrainConfig) -> Checkpoint | None:
    """The same run's last checkpoint, if there is one. Raises ValueError if the folder holds another run."""
    checkpoint = newest_checkpoint(config.out / CHECKPOINTS)
    if checkpoint is None:
        return None
    other = difference(config, parse_config(checkpoint.facts["recipe"], f"{config.out}: checkpoint"))
    if other:
        raise ValueError(f"{config.out} holds a run of another recipe ({other} there): give another --out")
    return checkpoint
