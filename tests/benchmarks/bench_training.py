"""Samples a second of a training step: ours against the official way, in one run; and where the time goes.

    python -m tests.benchmarks.bench_training

The official way reads for every sample the stored list of the positions where each pixel looks, and
materialises keys and values there (index, matmul, softmax, matmul). Ours makes the field while training and
never gathers. The network, the samples and the positions (96 nearest pixels, the paper's) are the same for
both. Times are seconds of the processor of this process, on one thread, so that other work on the machine
matters little: median (least to most) of the repeats.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from itertools import islice
from pathlib import Path
from statistics import median

import numpy as np
import torch
import tyro
from torch import Tensor, nn

from arraygeom import pixel_grid
from arraygeom.fields import FIELDS
from pat.attention import attend
from pat.attention.reference import Attended
from pat.evaluation.ablation import sample_photographs
from pat.networks.weights import Network, new_network, set_precision
from pat.training.config import TrainConfig, load_config
from pat.training.losses import Objective
from pat.training.samples import Sample, SampleSource, source_of
from tests.benchmarks.printed import spread, timed


class Materialised(nn.Module):
    """The paper network's attention engine the official way: positions from files, everything gathered."""

    def __init__(self, engine: nn.Module, files: list[Path]) -> None:
        super().__init__()
        self.engine, self.files = engine, files

    def forward(self, own: Tensor, others: list[Tensor], looks: object) -> list[Attended]:
        e, index = self.engine, torch.from_numpy(np.stack([np.load(f) for f in self.files]))
        query = e.query(e.before(own))
        return [
            materialised(query, key(e.before(f)), value(f), index)
            for f, key, value in zip(others, e.key, e.value)
        ]


def materialised(query: Tensor, key: Tensor, value: Tensor, index: Tensor) -> Attended:
    """Index, matmul, softmax, matmul; index (B, H W, L) counts pixels of beta, negative ones do not count."""
    b, d, h, w = query.shape
    flat = index.clamp(min=0).reshape(b, 1, -1)
    keys, values = (
        x.flatten(2).gather(2, flat.expand(-1, d, -1)).view(b, d, h * w, -1) for x in (key, value)
    )
    scores = torch.einsum("bdn,bdnl->bnl", query.flatten(2), keys).masked_fill(index < 0, -torch.inf)
    weights = scores.softmax(-1).nan_to_num(0.0)
    out = torch.einsum("bnl,bdnl->bdn", weights, values).view(b, d, h, w)
    nothing = out.new_zeros(b, h, w)
    return Attended(out, out.new_zeros(b, 2, h, w), nothing, weights.amax(-1).view(b, h, w))


def stored(given: Sample, folder: Path) -> list[Path]:
    """Index lists of a batch, one file a sample, as the official code keeps them."""
    h, w = given.alpha.shape[-2:]
    found = given.fields[0].at(pixel_grid((h, w)).reshape(-1, 2))
    index = torch.where(found.mask, found.xy[..., 1] * w + found.xy[..., 0], -1.0).long()
    files = [folder / f"{i}.npy" for i in range(len(index))]
    for file, positions in zip(files, index):
        np.save(file, positions.numpy())
    return files


def source(config: TrainConfig) -> SampleSource:
    return source_of(config, sample_photographs(), 0, FIELDS[config.field]())


def stepped(objective: Objective, given: Sample, repeats: int) -> list[float]:
    """Seconds of steps."""
    optimiser = torch.optim.Adam(objective.parameters(), lr=0.0)

    def step() -> None:
        optimiser.zero_grad()
        objective(given).backward()
        optimiser.step()

    return timed(step, repeats=repeats)[0]


def report(name: str, seconds: list[float], samples: int = 0) -> None:
    rate = f"  {samples / median(seconds):6.2f} samples/s" if samples else ""
    print(f"{name:42s} {spread(seconds, 3)}{rate}", flush=True)


def papers_network(batch: int, repeats: int) -> None:
    config = replace(load_config("paper-2"), batch=batch, reuse=1.0)
    made = source(config)
    given = next(made(1))
    torch.manual_seed(0)
    ours = Objective(new_network(config.network), "mse")
    official = Objective(new_network(config.network), "mse")
    official.network.load_state_dict(ours.network.state_dict())
    along = Objective(new_network(config.network), "mse")
    straight = next(source(replace(config, field="epipolar"))(1))
    with tempfile.TemporaryDirectory() as folder:
        official.network.engine = Materialised(official.network.engine, stored(given, Path(folder)))
        agree = (official(given) - ours(given)).abs().item()
        ways = {
            "official: stored lists, materialised": (official, given),
            "ours: the same positions made on the fly": (ours, given),
            "ours: epipolar segments made on the fly": (along, straight),
        }
        rows = {name: stepped(*way, repeats) for name, way in ways.items()}
    (scenes,) = timed(
        lambda: list(islice(made.steps([0], start=int(time.time_ns() % 1000)), 1)), repeats=repeats
    )
    print(
        f"\nThe paper's network, {batch} samples of {config.hw[1]} x {config.hw[0]}; the losses differ by "
        f"{agree:.1e}\n"
    )
    for name, seconds in rows.items():
        report(name, seconds, batch)
    report("making new scenes, fields included", scenes)
    attention(ours, given, straight, repeats)


def attention(objective: Objective, given: Sample, straight: Sample, repeats: int) -> None:
    """What attention alone costs, forward and backward."""
    b, _, h, w = given.alpha.shape
    q, k, v = (torch.randn(b, 64, h, w, requires_grad=True) for _ in range(3))
    x = pixel_grid((h, w)).reshape(-1, 2)
    found = given.fields[0].at(x)
    index = torch.where(found.mask, found.xy[..., 1] * w + found.xy[..., 0], -1.0).long()

    def ours(one: Sample) -> None:
        attend(q, k, v, one.fields[0].at, samples=None, interpolation="nearest").square().sum().backward()

    ways = {
        "  official": lambda: materialised(q, k, v, index).value.square().sum().backward(),
        "  ours, nearest": lambda: ours(given),
        "  ours, along": lambda: ours(straight),
        "  field of nearest pixels alone": lambda: given.fields[0].at(x),
        "  field of segments alone": lambda: straight.fields[0].at(x),
    }
    print("\nof which attention and where to look, forward and backward:")
    for name, seconds in zip(ways, timed(*ways.values(), repeats=repeats)):
        report(name, seconds)


HOW = {"float32": (False, False), "bfloat16": (True, False), "compiled": (False, True)}
"""Convolutions: in bfloat16 or not, compiled or not."""


def our_networks(repeats: int, names: tuple[str, ...]) -> None:
    for name in names:
        config = replace(load_config(name), reuse=1.0, filtered=0.0)
        given = next(source(config)(1))
        print(f"\n{name}, {config.batch} samples of {config.hw[1]} x {config.hw[0]}, one step:\n")
        for how, (half, compiled) in HOW.items():
            objective = Objective(prepared(config, half=half, compiled=compiled), config.loss)
            report(how, stepped(objective, given, repeats), config.batch)


def prepared(config: TrainConfig, *, half: bool, compiled: bool) -> Network:
    """A new network whose convolutions compute as `precision` and `compile` have them."""
    torch.manual_seed(0)
    network = new_network(config.network)
    set_precision(network, "bfloat16" if half else "float32", compiled=compiled)
    return network


def main(
    batch: int = 2,
    repeats: int = 3,
    paper: bool = True,
    names: tuple[str, ...] = ("mono-colour", "mono-colour-small"),
) -> None:
    """Measure and print: the paper's network if `paper`, and those of ours that are named."""
    torch.set_num_threads(1)
    if paper:
        papers_network(batch, repeats)
    our_networks(repeats, names)


if __name__ == "__main__":
    tyro.cli(main)
