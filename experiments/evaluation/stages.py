"""The worth of each stage of matching and fusion: everything measured with that stage left out."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor

from pat.fusion.fuse import FuseSettings
from pat.lab.data.pairs import StereoPair
from pat.lab.evaluation.protocols import mono_colour_task, rectified_fusion
from pat.lab.evaluation.stereo import disparity_errors
from pat.lab.evaluation.tables import markdown_table
from pat.networks import guided
from pat.networks.weights import load_weights
from pat.support.metrics import score


def _without_attention(alpha: Tensor, carried: Sequence[Any]) -> Tensor:
    (one,) = carried
    mixed = torch.lerp(one.fills[:, -1].to(one.bands), one.bands, one.weight)
    return guided.with_less_noise(alpha, mixed, one.weight)


def _without_examples(alpha: Tensor, carried: Sequence[Any]) -> Tensor:
    (one,) = carried
    mixed = torch.lerp(guided.by_example(alpha, one.bands, one.weight), one.bands, one.weight)
    return guided.with_less_noise(alpha, mixed, one.weight)


STAGES: Mapping[str, Mapping[str, Callable[..., Any]]] = {
    "nothing": {},
    "sub-pixel step": {"pat.matching.subpixel._precise": lambda views, segments, disparity, *_: disparity},
    "planes": {"pat.matching.subpixel._surfaces": lambda disparity, *_: disparity},
    "regression on detail": {"pat.matching.colour_transfer._each_detailed": lambda colour, *_: colour},
    "noise in colour": {"pat.matching.colour_transfer._without_noise": lambda colour, *_: colour},
    "saturation by brightness": {
        "pat.matching.colour_transfer._scaled_to_alpha": lambda colour, bright, *_: (colour, bright)
    },
    "fill by attention": {"pat.networks.guided.completed": _without_attention},
    "fill by examples": {"pat.networks.guided.completed": _without_examples},
    "smoothing": {"pat.networks.guided.with_less_noise": lambda alpha, colour, weight: colour},
    "median depth": {"pat.fusion.depth_filling.without_outliers": lambda depth: depth},
    "depth filling": {"pat.fusion.depth_filling.background_filled": lambda frame, *_: frame.depth},
}
"""Functions that a stage is replaced by, by the stage left out."""
NETWORKS = {"choice and certainty": "classical"}
"""Stages that another network is without."""


class StageScore(NamedTuple):
    """Scores of fusion with a stage left out: PSNR (dB), SSIM, the share of true disparities within a pixel
    (NaN without any), and core seconds, of one pair at one rate."""

    psnr: float
    ssim: float
    within: float
    seconds: float


@contextmanager
def left_out(stage: str) -> Iterator[None]:
    """A block in which fusion is without a stage."""
    with ExitStack() as stack:
        for name, function in STAGES.get(stage, {}).items():
            stack.enter_context(patch(name, function))
        yield


def score_stages(pairs: Sequence[StereoPair], rates: Sequence[int]) -> dict[str, dict[int, list[StageScore]]]:
    """Scores of fusion with each stage left out, by stage and rate, a list of pairs each."""
    scores: dict[str, dict[int, list[StageScore]]] = {}
    for stage in (*STAGES, *NETWORKS):
        how = FuseSettings(response="rec601", align=False)
        method = rectified_fusion(load_weights(NETWORKS.get(stage, "mono-colour")), settings=how)
        for rate in rates:
            with left_out(stage):
                scores.setdefault(stage, {})[rate] = [_score(method, pair, rate) for pair in pairs]
    return scores


def _score(method: Callable[..., Any], pair: StereoPair, rate: int) -> StageScore:
    task = mono_colour_task(pair, rate)
    begin = time.process_time()
    result = method(task.alpha, task.beta, pair.max_disparity or 120.0)
    seconds = time.process_time() - begin
    within = disparity_errors(result.disparity, task.disparity)[1] if task.disparity else None
    found = score(result.image.clamp(0, 1), task.ground_truth)
    return StageScore(*found, np.nan if within is None else within, seconds)


def stages_markdown(scores: Mapping[str, Mapping[int, Sequence[StageScore]]]) -> str:
    """A table: a line for each stage left out; for each rate PSNR, depth and seconds, as changes from the
    first line, nothing left out."""
    lines, rates = [], list(next(iter(scores.values())))
    whole = {rate: np.nanmean(np.array(scores["nothing"][rate]), 0) for rate in rates}
    for stage, by_rate in scores.items():
        cells = []
        for rate in rates:
            mean = np.nanmean(np.array(by_rate[rate]), 0)
            if stage == "nothing":
                cells.append(f"{mean[0]:.2f} dB / {mean[2]:.1%} / {mean[3]:.2f} s")
            else:
                change = mean - whole[rate]
                worst = max(np.array(by_rate[rate])[:, 0] - np.array(scores["nothing"][rate])[:, 0], key=abs)
                cells.append(f"{change[0]:+.2f} ({worst:+.2f}) / {change[2]:+.1%} / {change[3]:+.2f} s")
        lines.append([stage, *cells])
    return markdown_table(["left out", *(f"x{rate}: PSNR (largest) / depth / time" for rate in rates)], lines)
