"""How well a calibrated confidence holds: `python -m pat.evaluation.calibration --middlebury DIR`.

Each pair of the half is judged by a calibration that was fitted to the others, under every condition at once:
no pair takes part in judging itself. The last line that is printed is the calibration fitted to all of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import torch
import tyro
from rich.progress import track
from torch import Generator, Tensor

from ..data.pairs import PAPER_DISPARITY, StereoPair, middlebury_pairs
from ..fusion.fuse import fuse
from ..matching.calibration import ConfidenceCalibration, Reliability, fit_calibration, reliability
from ..networks.protocol import FusionNetwork
from ..networks.weights import load_weights
from .conditions import CONDITIONS, regions_of
from .halves import Half, of_half
from .protocols import hw_of, rectified_field, rectified_rig
from .tables import distinct, markdown_table

PIXELS = 20_000
"""Of a pair under a condition that take part, drawn evenly: every pair counts the same."""
CALIBRATED_ON = ("x1", "ideal", "x4", "x8", "alpha random", "200 electrons")


class Judged(NamedTuple):
    """Some pixels of a pair under a condition (n): confidence, error in pixels, whether beta sees them."""

    pair: str
    condition: str
    confidence: Tensor
    error: Tensor
    same: Tensor


class Held(NamedTuple):
    """How a calibration held under a condition: before and after it; true positions within the intervals."""

    raw: Reliability
    calibrated: Reliability
    covered: float


def judged(network: FusionNetwork, pairs: Iterable[StereoPair], conditions: Sequence[str]) -> list[Judged]:
    """Confidence and error of every pair with true disparity under every condition, fused as `fuse` does."""
    found = []
    for pair in pairs:
        found += [_judged(network, pair, name) for name in conditions if pair.disparity is not None]
    return found


def _judged(network: FusionNetwork, pair: StereoPair, condition: str) -> Judged:
    assert pair.disparity is not None
    (alpha, beta, _), noise = CONDITIONS[condition].recorded(pair)
    h, w = hw_of(alpha)
    rig = rectified_rig((h, w), {"beta": hw_of(beta)}, PAPER_DISPARITY)
    images, field = {"alpha": alpha, "beta": beta}, rectified_field(PAPER_DISPARITY)
    stated = None if noise is None else {"alpha": noise, "beta": noise}
    frame = fuse(network, rig, images, alpha="alpha", field=field, noise=stated)
    value, known = (x[:h, :w] for x in pair.disparity)
    error = (w / frame.depth - value).abs().nan_to_num(float(w))
    at = known.flatten().nonzero()[:, 0]
    at = at[torch.randperm(len(at), generator=Generator().manual_seed(0))[:PIXELS]]
    planes = frame.confidence, error, regions_of(pair, (h, w))["seen"]
    return Judged(pair.name, condition, *(x.flatten()[at] for x in planes))


def held_out(found: Sequence[Judged]) -> dict[str, Held]:
    """By condition, and over "all", how calibrations held on pairs that took no part in them."""
    pairs = distinct(j.pair for j in found)
    fitted = {pair: calibration_of([j for j in found if j.pair != pair]) for pair in pairs}
    names = distinct(j.condition for j in found)
    return {n: _held([j for j in found if n in (j.condition, "all")], fitted) for n in [*names, "all"]}


def calibration_of(found: Sequence[Judged]) -> ConfidenceCalibration:
    """The calibration that all of these together ask for."""
    columns = (torch.cat([getattr(j, name) for j in found]) for name in ("confidence", "error", "same"))
    return fit_calibration(*columns)


def _held(found: Sequence[Judged], fitted: Mapping[str, ConfidenceCalibration]) -> Held:
    confidence = torch.cat([j.confidence for j in found])
    right = torch.cat([j.same & (j.error <= 1) for j in found])
    stated = torch.cat([fitted[j.pair].probabilities(j.confidence) for j in found])
    inside = torch.cat([j.error <= fitted[j.pair].half_widths(j.confidence) for j in found])
    return Held(reliability(confidence, right), reliability(stated, right), float(inside.float().mean()))


def calibration_markdown(held: Mapping[str, Held]) -> str:
    """ConfidenceCalibration errors and coverage by condition, and the reliability over all."""
    columns = ["condition", "calibration error, as it is", "calibrated", "true position in the 90 % interval"]
    lines = [
        [name, f"{one.raw.error:.3f}", f"{one.calibrated.error:.3f}", f"{one.covered:.1%}"]
        for name, one in held.items()
    ]
    return markdown_table(columns, lines) + "\n" + _reliability_table(held["all"].calibrated)


def _reliability_table(found: Reliability) -> str:
    lines = [
        [f"{float(stated):.2f}", f"{float(right):.2f}", f"{float(share):.1%}"]
        for stated, right, share in zip(*found)
        if share > 0
    ]
    return markdown_table(["probability stated", "share that is right", "of the pixels"], lines)


@dataclass(frozen=True)
class CalibrationRun:
    """What is measured."""

    middlebury: Path
    """Folder of Middlebury's scenes."""
    weights: str = "mono-colour"
    """The network whose confidence it is."""
    half: Half = "tune"
    """Pairs that take part: settings are chosen on tune."""
    conditions: tuple[str, ...] = CALIBRATED_ON


def main(run: CalibrationRun) -> str:
    """The tables, and the calibration fitted to all pairs."""
    pairs = list(of_half(middlebury_pairs(run.middlebury), run.half))
    found = judged(load_weights(run.weights), track(pairs, "fusing"), run.conditions)
    rounded = {k: [round(x, 4) for x in v] for k, v in asdict(calibration_of(found)).items()}
    return f"{calibration_markdown(held_out(found))}\n{rounded}"


if __name__ == "__main__":
    print(main(tyro.cli(CalibrationRun, prog="python -m pat.evaluation.calibration")))
