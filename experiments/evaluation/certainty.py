"""Check of stated certainty, and its fit: `python -m experiments certainty --middlebury DIR`.

Pairs with true disparity are fused under many conditions: how often are matches right that are stated to be
so with some probability, and how many true positions lie in the interval of 9 of 10? With `--fit FILE` a
network is fitted to these pairs and written; the tables are then of three fits, each judged by the third of
the pairs that it did not see.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Generator, Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from pat.fusion.fuse import FuseSettings
from pat.lab.data.pairs import PAPER_DISPARITY, StereoPair
from pat.lab.evaluation.protocols import hw_of, rectified_fusion
from pat.lab.evaluation.tables import grouped, markdown_table
from pat.matching.choice import SETTINGS, CertaintyNetwork, Choice, measured, typical_facts
from pat.matching.inputs import FINE, BetaMatches, Inputs, Matches
from pat.matching.match import match
from pat.networks.protocol import FusionNetwork
from pat.support.tensor_files import read_tensors, with_weights

from .conditions import CONDITIONS, save_curves

PIXELS = 6000
"""Number of pixels of a pair under a condition that take part, drawn evenly: every pair counts the same."""
BINS = 15
"""Bins of probability by which the calibration error is measured, as is usual (Guo et al. 2017)."""
FITTED_ON = (
    "ideal", "x1", "x4", "x8", "alpha = .6/.3/.1", "alpha random", "beta x .6",
    "1000 electrons", "200 electrons", "50 electrons",
)  # fmt: skip
STEPS, BATCH, RATE, DECAY = 2000, 4096, 1e-2, 5e-2


class Judged(NamedTuple):
    """Some pixels (n) of a pair under a condition: what certainty is read off, whether the match is right,
    and the error of depth in pixels."""

    pair: str
    condition: str
    numbers: Float[Tensor, "n k"]
    right: Bool[Tensor, " n"]
    error: Float[Tensor, " n"]


class Stated(NamedTuple):
    """Statement on pixels (n).

    Attributes:
        probability: probability that the match is right.
        half_width: half-width of the interval, pixels.
    """

    probability: Float[Tensor, " n"]
    half_width: Float[Tensor, " n"]

    @classmethod
    def by(cls, network: CertaintyNetwork, numbers: Float[Tensor, "n k"]) -> Stated:
        """Compute the statement of a network."""
        with torch.no_grad():
            logit, width = network(numbers).unbind(-1)
        return cls(logit.sigmoid(), width.exp())


class Reliability(NamedTuple):
    """Reliability by bins of stated probability.

    Attributes:
        stated: mean stated probability of each bin.
        right: share of right matches of each bin.
        share: share of all matches in each bin.
    """

    stated: Float[Tensor, " bins"]
    right: Float[Tensor, " bins"]
    share: Float[Tensor, " bins"]

    @classmethod
    def from_samples(
        cls, probability: Float[Tensor, " n"], right: Bool[Tensor, " n"], bins: int = BINS
    ) -> Reliability:
        """Compute the share of right matches by stated probability."""
        which = (probability * bins).long().clamp(0, bins - 1)
        count = torch.bincount(which, minlength=bins).double()
        stated, fulfilled = (torch.bincount(which, x.double(), minlength=bins) for x in (probability, right))
        some = count.clamp(min=1)
        return cls(stated / some, fulfilled / some, count / count.sum())

    @property
    def error(self) -> float:
        """The expected calibration error: the mean difference of what is stated and what is right."""
        return float(((self.stated - self.right).abs() * self.share).sum())


def judged(
    network: FusionNetwork, pairs: Iterable[StereoPair], conditions: Sequence[str], choices: Sequence[Path]
) -> Iterator[Judged]:
    """Every pair with true disparity under every condition, fused as `fuse` does.

    With `choices`, files of those trained without some pairs, each pair's is one that has not seen it. Raises
    ValueError for a pair that all have seen.
    """
    for pair in pairs:
        if pair.disparity is not None:
            choice = unseeing(choices, pair.name) if choices else None
            yield from (judged_pair(network, pair, name, choice) for name in conditions)


def unseeing(choices: Sequence[Path], pair: str) -> Choice:
    """The first that was trained without the pair. Raises ValueError if none was, or for another file."""
    for path in choices:
        choice = with_weights(Choice(), path)
        recipe = json.loads(read_tensors(path)[1].get("recipe", "{}"))
        if any(fragment in pair for fragment in recipe.get("without", ())):
            return choice
    raise ValueError(f"no choice was trained without {pair}: train one (--without) and give its file")


def judged_pair(network: FusionNetwork, pair: StereoPair, condition: str, choice: Choice | None) -> Judged:
    """One of them. A match is right if beta sees the point and it is within a pixel."""
    task, noise = CONDITIONS[condition].recorded(pair), CONDITIONS[condition].noise
    assert task.disparity is not None
    stated = None if noise is None else {"alpha": noise, "beta": noise}
    kept: list[BetaMatches] = []

    def matcher(inputs: Inputs) -> Matches:
        matches = match(inputs, choice)
        kept.extend(matches.betas)
        return matches

    fused = rectified_fusion(network, settings=FuseSettings(noise=stated), matcher=matcher)(
        task.alpha, task.beta, PAPER_DISPARITY
    )
    assert fused.disparity is not None
    (value, valid), (h, w) = task.disparity, hw_of(task.alpha)
    places = valid.nonzero()
    y, x = places[torch.randperm(len(places), generator=Generator().manual_seed(0))[:PIXELS]].unbind(-1)
    (matches,) = kept
    numbers = measured(matches, typical_facts(matches))[0, :, y // FINE, x // FINE].T
    right = task.disparity.regions().seen & ((matches.surface[0, 0, :h, :w] - value).abs() <= 1)
    error = (fused.disparity - value).abs().nan_to_num(float(w))
    return Judged(pair.name, condition, numbers, right[y, x], error[y, x])


def fitted(pixels: Sequence[Judged], *, steps: int = STEPS) -> CertaintyNetwork:
    """The network that states of all of these together what they ask for."""
    numbers, right, error = (
        torch.cat([getattr(j, name) for j in pixels]) for name in ("numbers", "right", "error")
    )
    middle, spread = numbers.mean(0), numbers.std(0) + 1e-6
    farness = error.clamp(min=0.02).log()
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = CertaintyNetwork()
        optimizer = torch.optim.AdamW(network.parameters(), RATE, weight_decay=DECAY)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, steps)
        for _ in range(steps):
            some = torch.randint(len(numbers), (BATCH,))
            logit, width = network((numbers[some] - middle) / spread).unbind(-1)
            beyond = farness[some] - width
            interval = torch.maximum(SETTINGS.covered * beyond, (SETTINGS.covered - 1) * beyond).mean()
            loss = binary_cross_entropy_with_logits(logit, right[some].float()) + interval
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    weight, bias = network[0].parameters()
    with torch.no_grad():  # of numbers as they are
        weight /= spread
        bias -= weight @ middle
    return network.eval().requires_grad_(False)


def by_thirds(pixels: Sequence[Judged], *, steps: int = STEPS) -> Callable[[Judged], Stated]:
    """Fit to two thirds of the pairs each, and return the function that states the certainty of
    the others."""
    pairs = list(grouped(pixels, "pair"))
    networks = [fitted([j for j in pixels if j.pair not in pairs[k::3]], steps=steps) for k in range(3)]
    return lambda one: Stated.by(networks[pairs.index(one.pair) % 3], one.numbers)


def widened(pixels: Sequence[Judged], *, steps: int = STEPS) -> CertaintyNetwork:
    """The fit to all, its intervals as much wider as makes those of `by_thirds` cover what they are to
    (conformal prediction, Romano et al. 2019): other pairs are always a little farther off than those that
    were fitted to."""
    stating, network = by_thirds(pixels, steps=steps), fitted(pixels, steps=steps)
    share = torch.cat([one.error / stating(one).half_width for one in pixels]).quantile(SETTINGS.covered)
    _, bias = network[-1].parameters()
    bias[1] += share.log()
    return network


class Held(NamedTuple):
    """Result in a condition: the stated probability's reliability, and the share of true positions in
    intervals."""

    stated: Reliability
    covered: float


def held(pixels: Sequence[Judged], stating: Callable[[Judged], Stated]) -> dict[str, Held]:
    """Compute the result by condition, and over "all"."""
    stated = [stating(j) for j in pixels]

    def of(some: Sequence[int]) -> Held:
        right, error = (torch.cat([getattr(pixels[i], name) for i in some]) for name in ("right", "error"))
        probability, width = (torch.cat(planes) for planes in zip(*(stated[i] for i in some)))
        return Held(Reliability.from_samples(probability, right), float((error <= width).float().mean()))

    names = grouped(pixels, "condition")
    return {n: of([i for i, j in enumerate(pixels) if n in (j.condition, "all")]) for n in [*names, "all"]}


def held_markdown(held: dict[str, Held]) -> str:
    """Calibration errors and coverage by condition, and the reliability over all."""
    columns = ["condition", "right", "stated", "calibration error", "true position in the 90 % interval"]
    lines = []
    for name, one in held.items():
        stated, right = (float((values * one.stated.share).sum()) for values in one.stated[:2])
        lines.append([name, f"{right:.1%}", f"{stated:.1%}", f"{one.stated.error:.3f}", f"{one.covered:.1%}"])
    bins = [
        [f"{float(stated):.2f}", f"{float(right):.2f}", f"{float(share):.1%}"]
        for stated, right, share in zip(*held["all"].stated)
        if share > 0
    ]
    reliable = markdown_table(["probability stated", "share that is right", "of the pixels"], bins)
    return markdown_table(columns, lines) + "\n" + reliable


def save_reliability(held: dict[str, Held], path: Path) -> None:
    """The reliability diagram: a curve for each condition, and the diagonal."""
    curves = {"as stated": [(0.0, 0.0), (1.0, 1.0)]}
    for name, one in held.items():
        points = torch.stack(one.stated[:2], 1)[(one.stated.share > 1 / 200)].tolist()
        curves[name] = [(float(x), float(y)) for x, y in points]
    save_curves({"probability stated": curves}, path, ylabel="share of matches that are right")
