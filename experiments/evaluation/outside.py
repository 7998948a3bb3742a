"""Disparities from elsewhere through the same fusion: OpenCV's SGBM's, the true ones, a rough prior."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

from arraygeom import ReceptiveField
from arraygeom.fields import AroundDepth
from pat.fusion.classical import checked_disparity
from pat.fusion.fuse import FuseSettings
from pat.lab.data.pairs import PAPER_DISPARITY, Disparity, StereoPair
from pat.lab.evaluation.protocols import MonoColourTask, enlarged, hw_of, mono_colour_task, rectified_fusion
from pat.lab.evaluation.stereo import disparity_errors
from pat.lab.evaluation.tables import grouped, markdown_table
from pat.media.colour import luminance, to_bytes
from pat.networks.protocol import FusionNetwork
from pat.support.metrics import score

PRIOR = 0.05
"""Share by which the depths of the prior are off at most."""
BUMP = 64
"""Pixels between the values from which the prior's error is interpolated."""


class OutsideRow(NamedTuple):
    """One source of disparities on one pair; seconds of the fusion, and of SGBM where it is one."""

    pair: str
    source: str
    psnr: float
    end_point_error: float
    within_one: float
    seconds: float


def evaluate_outside(pairs: Iterable[StereoPair], network: FusionNetwork) -> list[OutsideRow]:
    """Every source on every pair, all with true disparity, beta reduced to half."""
    rows = []
    for pair in pairs:
        task = mono_colour_task(pair, 2)
        rows += [_row(pair.name, task, network, source, field_of) for source, field_of in SOURCES.items()]
    return rows


def outside_markdown(rows: Sequence[OutsideRow]) -> str:
    """A line for each source: means over the pairs."""
    lines = []
    for source, of_source in grouped(rows, "source").items():
        psnr, error, within, seconds = np.mean([row[2:] for row in of_source], 0)
        lines.append([source, f"{psnr:.2f}", f"{error:.2f}", f"{within:.1%}", f"{seconds:.1f}"])
    pairs = f"disparity, {len(grouped(rows, 'pair'))} pairs"
    return markdown_table([pairs, "dB", "mean error, px", "within 1 px", "seconds"], lines)


FieldOf = Callable[[MonoColourTask], ReceptiveField | None]


def _row(
    pair: str, task: MonoColourTask, network: FusionNetwork, source: str, field_of: FieldOf
) -> OutsideRow:
    began = time.perf_counter()
    fusion = rectified_fusion(network, settings=FuseSettings(field=field_of(task)))
    fused = fusion(task.alpha, task.beta, PAPER_DISPARITY)
    seconds = time.perf_counter() - began
    assert fused.disparity is not None
    error, within = disparity_errors(fused.disparity, _truth(task))
    assert error is not None
    assert within is not None
    psnr = score(fused.image.clamp(0, 1), task.ground_truth).psnr
    return OutsideRow(pair, source, psnr, error, within, seconds)


def _around(disparity: Float[Tensor, "h w"], valid: Tensor, tolerance: float) -> AroundDepth:
    """The field around a disparity of a `rectified_rig`."""
    depth = disparity.shape[1] / torch.where(valid & (disparity > 0), disparity, torch.nan)
    return AroundDepth(depth, tolerance)


def _sgbm(task: MonoColourTask) -> ReceptiveField:
    beta = enlarged(luminance(task.beta), hw_of(task.alpha))
    images = to_bytes(task.alpha[0]), to_bytes(beta[0])
    disparity, consistent = checked_disparity(*images, round(PAPER_DISPARITY))
    return _around(torch.from_numpy(disparity), torch.from_numpy(consistent), 0.0)


def _true(task: MonoColourTask) -> ReceptiveField:
    return _around(*_truth(task), 0.0)


def _prior(task: MonoColourTask) -> ReceptiveField:
    disparity, valid = _truth(task)
    h, w = disparity.shape
    coarse = torch.rand(1, 1, h // BUMP + 2, w // BUMP + 2, generator=torch.Generator().manual_seed(0))
    error = interpolate(coarse, (h, w), mode="bilinear", align_corners=True)[0, 0]
    return _around(disparity * (1 + PRIOR * (2 * error - 1)), valid, PRIOR)


def _truth(task: MonoColourTask) -> Disparity:
    assert task.disparity is not None
    return task.disparity


SOURCES: dict[str, FieldOf] = {
    "own matches": lambda task: None,
    "OpenCV's SGBM, own where it has none": _sgbm,
    "true disparities": _true,
    "true depth to 5 %, as a prior": _prior,
}
"""The field of each source; None: the default."""
