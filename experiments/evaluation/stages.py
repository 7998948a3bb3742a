"""The worth of each stage of matching and fusion, measured with it left out, also where it matters most."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor

from pat.fusion.fuse import FuseSettings
from pat.lab.data.pairs import StereoPair
from pat.lab.evaluation.protocols import MonoColourTask, rectified_fusion
from pat.lab.evaluation.stereo import disparity_errors
from pat.lab.evaluation.tables import markdown_table
from pat.networks import guided
from pat.networks.weights import load_weights
from pat.sensors import NoiseLevel
from pat.support.metrics import score

from .conditions import CONDITIONS, READ_NOISE, Condition


def _without_attention(alpha: Tensor, carried: Sequence[Any]) -> Tensor:
    (one,) = carried
    mixed = torch.lerp(one.fills[:, -1].to(one.bands), one.bands, one.weight)
    return guided.with_less_noise(alpha, mixed, one.weight)


def _without_examples(alpha: Tensor, carried: Sequence[Any]) -> Tensor:
    (one,) = carried
    mixed = torch.lerp(guided.by_example(alpha, one.bands, one.weight), one.bands, one.weight)
    return guided.with_less_noise(alpha, mixed, one.weight)


class Stage(NamedTuple):
    """Fusion without one stage.

    Attributes:
        functions: functions that take the place of the stage's, by their names.
        settings: settings of fusion, by name, in place of the default ones.
        network: name of the weights.
        conditions: names of the conditions in which the stage does something; empty for all.
    """

    functions: Mapping[str, Callable[..., Any]] = {}
    settings: Mapping[str, Any] = {}
    network: str = "mono-colour"
    conditions: tuple[str, ...] = ()


class StageCondition(NamedTuple):
    """Condition in which stages are measured.

    Attributes:
        condition: what the pairs are recorded with.
        noisy: cameras that have its noise, which the fusion is told; of none the noise is not stated.
    """

    condition: Condition
    noisy: tuple[str, ...] = ()

    def recorded(self, pair: StereoPair) -> MonoColourTask:
        """The pair in this condition."""
        task = self.condition.recorded(pair)
        quiet = replace(self.condition, noise=None) if self.noisy == ("alpha",) else self.condition
        return task._replace(beta=quiet.recorded(pair).beta)

    @property
    def noise(self) -> Mapping[str, NoiseLevel] | None:
        """The noise that the fusion is told."""
        level = self.condition.noise
        return None if level is None or not self.noisy else dict.fromkeys(self.noisy, level)


GRAIN = NoiseLevel.from_electrons(4000, READ_NOISE)
"""Noise that is too weak to be removed."""
STAGE_CONDITIONS: Mapping[str, StageCondition] = {
    "x2": StageCondition(CONDITIONS["ideal"]),
    "x4": StageCondition(CONDITIONS["x4"]),
    "alpha = .2/.4/.4": StageCondition(CONDITIONS["alpha = .2/.4/.4"]),
    "rows off 3 px": StageCondition(CONDITIONS["rows off 3 px"]),
    "4000 electrons, not stated": StageCondition(
        Condition(noise=NoiseLevel.from_electrons(4000, READ_NOISE))
    ),
    "200 electrons": StageCondition(CONDITIONS["200 electrons"], ("alpha", "beta")),
    "50 electrons, of alpha alone": StageCondition(CONDITIONS["50 electrons"], ("alpha",)),
}
_LOW_LIGHT = "200 electrons", "50 electrons, of alpha alone"

STAGES: Mapping[str, Stage] = {
    "nothing": Stage(),
    "response": Stage(settings={"response": "rec601"}),
    "alignment": Stage(settings={"align": False}),
    "sub-pixel step": Stage(
        {"pat.matching.subpixel._precise": lambda views, segments, disparity, *_: disparity}
    ),
    "planes": Stage({"pat.matching.subpixel._surfaces": lambda disparity, *_: disparity}),
    "choice and certainty": Stage(network="classical"),
    "regression on detail": Stage({"pat.matching.colour_transfer._each_detailed": lambda colour, *_: colour}),
    "noise in colour": Stage(
        {"pat.matching.colour_transfer._without_noise": lambda colour, *_: colour},
        conditions=("4000 electrons, not stated", *_LOW_LIGHT),
    ),
    "saturation by brightness": Stage(
        {"pat.matching.colour_transfer._scaled_to_alpha": lambda colour, bright, *_: (colour, bright)}
    ),
    "fill by attention": Stage({"pat.networks.guided.completed": _without_attention}),
    "fill by examples": Stage({"pat.networks.guided.completed": _without_examples}),
    "smoothing": Stage({"pat.networks.guided.with_less_noise": lambda alpha, colour, weight: colour}),
    "median depth": Stage({"pat.fusion.depth_filling.without_outliers": lambda depth: depth}),
    "depth filling": Stage({"pat.fusion.depth_filling.background_filled": lambda frame, *_: frame.depth}),
    "collaborative filter": Stage(
        {"pat.networks.bm3d._refined": lambda estimate, *_: estimate}, conditions=_LOW_LIGHT
    ),
    "brightness by betas": Stage(
        {"pat.fusion.low_light.other_camera_update": lambda estimate, *_: 0 * estimate}, conditions=_LOW_LIGHT
    ),
    "averaged colours": Stage(
        {"pat.fusion.low_light.colours_averaged": lambda image, *_: image}, conditions=_LOW_LIGHT
    ),
}
"""Fusion without a stage, by the stage."""


class StageScore(NamedTuple):
    """Scores of fusion with a stage left out: PSNR (dB), SSIM, the share of true disparities within a pixel
    (NaN without any), and core seconds, of one pair in one condition."""

    psnr: float
    ssim: float
    within: float
    seconds: float


Scores = Mapping[str, Mapping[str, Sequence[StageScore]]]
"""Scores by stage left out and condition, a list of pairs each."""


@contextmanager
def left_out(stage: str) -> Iterator[None]:
    """A block in which fusion is without a stage's functions."""
    with ExitStack() as stack:
        for name, function in STAGES[stage].functions.items():
            stack.enter_context(patch(name, function))
        yield


def score_stages(pairs: Sequence[StereoPair], conditions: Sequence[str]) -> Scores:
    """Scores of fusion with each stage left out, in the conditions in which it does something.

    Raises:
        KeyError: for a condition that is not of `STAGE_CONDITIONS`.
    """
    scores: dict[str, dict[str, list[StageScore]]] = {stage: {} for stage in STAGES}
    for name in conditions:
        recorded = [(pair, STAGE_CONDITIONS[name].recorded(pair)) for pair in pairs]
        for stage, without in STAGES.items():
            if name in (without.conditions or conditions):
                how = FuseSettings(**{"noise": STAGE_CONDITIONS[name].noise, **without.settings})
                method = rectified_fusion(load_weights(without.network), settings=how)
                with left_out(stage):
                    scored(method, *recorded[0])  # what is compiled, and read from files, is there afterwards
                    scores[stage][name] = [scored(method, *one) for one in recorded]
    return scores


def scored(method: Callable[..., Any], pair: StereoPair, task: MonoColourTask) -> StageScore:
    """Scores of one pair, recorded, by a method."""
    begin = time.process_time()
    result = method(task.alpha, task.beta, pair.max_disparity or 120.0)
    seconds = time.process_time() - begin
    within = disparity_errors(result.disparity, task.disparity)[1] if task.disparity else None
    found = score(result.image.clamp(0, 1), task.ground_truth)
    return StageScore(*found, np.nan if within is None else within, seconds)


def stages_markdown(scores: Scores) -> str:
    """A table: a line for each stage left out; for each condition PSNR, depth and time, as changes from the
    first line, nothing left out; the largest change of PSNR in parentheses."""
    whole = {name: np.array(values) for name, values in scores["nothing"].items()}
    lines = []
    for stage, by_condition in scores.items():
        cells = []
        for name, reference in whole.items():
            if name not in by_condition:
                cells.append("")
                continue
            values = np.array(by_condition[name])
            change = np.nanmean(values, 0) - (0 if stage == "nothing" else np.nanmean(reference, 0))
            if stage == "nothing":
                cells.append(f"{change[0]:.2f} dB / {change[2]:.1%} / {change[3]:.2f} s")
            else:
                worst = max(values[:, 0] - reference[:, 0], key=abs)
                cells.append(f"{change[0]:+.2f} ({worst:+.2f}) / {change[2]:+.1%} / {change[3]:+.2f} s")
        lines.append([stage, *cells])
    return markdown_table(["left out", *whole], lines)
