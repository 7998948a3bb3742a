"""A step of training at the paper's size, beside the authors' way: `python -m tests.benchmarks.bench_step`.

D = 64, patches of 96x32, batch 32, 96 positions a pixel, forward, backward and Adam. The authors' way gathers
every key and value by lists of indices (index, matmul, softmax, matmul); all else is the same network. Both
take the batch in parts of 4, as 32 at once would gather 5 GB. Seconds of the process on one thread, the ways
in turn, medians and ranges.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median

import torch
from torch import Tensor

from arraygeom import Pair, Positions, Rectified, View
from arraygeom.fields.grid import FieldOnGrid
from docs.update_readme import write_block
from pat.app.cli.parser import script
from pat.lab.evaluation.tables import markdown_table
from pat.matching.inputs import Inputs
from pat.networks.configs import PATConfig
from pat.networks.paper import PAT
from tests.benchmarks.printed import REPORTS, spread

HW, BATCH, PART, POSITIONS = (32, 96), 32, 4, 96
PAPER = PATConfig(dim=64, block_bias=False, fusion_bias=True, values_after_block=True)


def gathered(network: PAT, alpha: Tensor, beta: Tensor, index: Tensor) -> Tensor:
    """The image by the authors' way; `index` (h w, positions) are pixels of beta, counted row by row."""
    own, other = network.features(alpha), network.features(beta)
    engine = network.engine
    after = engine.before(other)
    query = engine.query(engine.before(own)).flatten(2).movedim(1, 2)[:, :, None]  # b n 1 d
    key, value = (part(after).flatten(2)[:, :, index] for part in (engine.key[0], engine.value[0]))  # b d n l
    weight = (query @ key.permute(0, 2, 1, 3)).softmax(-1)
    attended = (weight @ value.permute(0, 2, 3, 1))[:, :, 0].movedim(1, 2).unflatten(2, HW)
    return network.post(torch.cat([own, attended], 1))


def step(
    network: PAT, adam: torch.optim.Adam, images: list[Tensor], fuse: Callable[[Tensor, Tensor], Tensor]
) -> float:
    """Seconds of one step."""
    began = time.process_time()
    adam.zero_grad()
    for alpha, beta, truth in zip(*(image.split(PART) for image in images)):
        loss = (fuse(alpha, beta) - truth).square().mean()
        (loss * PART / BATCH).backward()
    adam.step()
    return time.process_time() - began


def main(steps: int = 3, profile: bool = False, write: bool = False) -> None:
    """Print the table, and write it to docs/reports/paper.md; with `profile` the longest operators too."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    network = PAT(PAPER)
    adam = torch.optim.Adam(network.parameters(), lr=2e-4)
    images = [torch.rand(BATCH, 3, *HW) for _ in range(3)]
    y, x = torch.meshgrid(torch.arange(HW[0]), torch.arange(HW[1]), indexing="ij")
    index = (y.reshape(-1, 1) * HW[1] + torch.arange(POSITIONS)) + 0 * x.reshape(-1, 1)
    xy = torch.stack([index % HW[1], index // HW[1]], -1).float()
    lists = FieldOnGrid(lambda p: _listed(xy, p), POSITIONS, None)
    rows = FieldOnGrid.from_field(Rectified(), Pair(View(hw=HW), View(hw=HW)))

    def ours(field: FieldOnGrid) -> Callable[[Tensor, Tensor], Tensor]:
        return lambda alpha, beta: network(Inputs.from_images(alpha, [beta], [field])).image

    ways = {
        "gathered, as the authors": lambda alpha, beta: gathered(network, alpha, beta, index),
        "C3, the same lists": ours(lists),
        "C3, segments": ours(rows),
    }
    part = [image[:PART] for image in images]
    with torch.no_grad():
        first, *others = (way(part[0], part[1]) for way in ways.values())
        print("largest difference:", max(float((other - first).abs().max()) for other in others))
    for way in ways.values():
        step(network, adam, part, way)  # compiled, and in the caches
    times: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(steps):
        for name, way in ways.items():
            times[name].append(step(network, adam, images, way))
    base = median(times["gathered, as the authors"])
    made = markdown_table(
        ["way", "s a step", "samples a second", "times the authors'"],
        [
            [name, spread(found, 1), f"{BATCH / median(found):.2f}", f"{base / median(found):.2f}"]
            for name, found in times.items()
        ],
    )
    print(made, end="")
    if write:
        write_block(REPORTS / "paper.md", "step", made)
    if profile:
        from torch import profiler

        with profiler.profile(activities=[profiler.ProfilerActivity.CPU]) as seen:
            step(network, adam, part, ways["C3, segments"])
        print(seen.key_averages().table(sort_by="self_cpu_time_total", row_limit=8, max_name_column_width=40))


def _listed(xy: Tensor, pixels: Tensor) -> Positions:
    """The positions of alpha's pixels."""
    chosen = xy[(pixels[:, 1] * HW[1] + pixels[:, 0]).round().long()]
    return Positions(chosen, torch.ones(chosen.shape[:-1], dtype=torch.bool))


if __name__ == "__main__":
    script(main)
