"""Every field of the toolkit with one network whose only way to the other camera is the field.

On rectified pairs with true disparity, where all fields are comparable; on the same with F alone; and on
unrectified rigs of layered scenes with exact positions.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import (
    Curved,
    Dense,
    Epipolar,
    EpipolarLine,
    HomographyDisplacement,
    Link,
    Local,
    NearestVoxels,
    Pair,
    ReceptiveField,
    Rectified,
    View,
    Widened,
    pixel_grid,
)
from arraygeom.fields.straight import covering_displacement
from experiments.peaks import with_peak
from pat.lab.data.pairs import PAPER_DISPARITY, Disparity, StereoPair
from pat.lab.evaluation.protocols import enlarged, hw_of, mono_colour_task, rectified_rig
from pat.lab.evaluation.tables import grouped, markdown_table
from pat.lab.synthesis.photos import PhotoBank
from pat.networks.protocol import Comparing
from pat.support.metrics import score

from .sweeps import ALPHA, BETA, RecordedScene, fused, made, rig_of

DENSE_LIMIT = 2**28
"""Samples that an image may take; more are left out."""


class Case(NamedTuple):
    """A scene with what fields know of its pair, and the largest displacement from H x, pixels of beta."""

    kind: str
    name: str
    pair: Pair
    scene: RecordedScene
    max_displacement: float


class FieldRow(NamedTuple):
    """One field on one case; `note` says why there are no figures, where there are none.

    `peaks` is the share, of the pixels whose true position is known and in beta, whose largest weight is
    within a pixel of it. `seconds` are the processor's, all threads together. `mebibytes` is by how much the
    process grew at most.
    """

    kind: str
    case: str
    field: str
    psnr: float = math.nan
    ssim: float = math.nan
    peaks: float = math.nan
    seconds: float = math.nan
    mebibytes: float = math.nan
    note: str = ""


def fields_of(max_displacement: float) -> dict[str, ReceptiveField]:
    """The families by name, for pairs whose points move up to so many pixels from H x."""
    return {
        "epipolar": Epipolar(),
        "full line": EpipolarLine(),
        "homography + displacement": HomographyDisplacement(max_displacement),
        "nearest voxels": NearestVoxels(),
        "rectified": Rectified(max_displacement, alpha_is="left"),
        "curved": Curved(math.ceil(max_displacement) + 1),
        "local 5x5": Local(),
        "widened by 1 px": Widened(Epipolar(), across=1.0),
        "dense": Dense(),
    }


def rectified_cases(pairs: Iterable[StereoPair], *, linked: bool = False) -> Iterator[Case]:
    """Pairs with true disparity, the right halved and enlarged; F and H alone if `linked`."""
    for pair in pairs:
        if pair.disparity is None:
            continue
        task = mono_colour_task(pair, 2)
        assert task.disparity is not None
        h, w = hw_of(task.alpha)
        beta = enlarged(task.beta, (h, w))
        scene = RecordedScene({ALPHA: task.alpha, BETA: beta}, task.ground_truth, *_truth(task.disparity))
        rig = rectified_rig((h, w), {BETA: (h, w)}, PAPER_DISPARITY)
        geometry = row_link((h, w)) if linked else rig.pair(ALPHA, BETA)
        yield Case("F alone" if linked else "rectified pairs", pair.name, geometry, scene, PAPER_DISPARITY)


def row_link(hw: tuple[int, int]) -> Pair:
    """A rectified pair of which only F is known, and H of the points at infinity."""
    F = torch.tensor([[0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
    return Pair(View(hw=hw), View(hw=hw), link=Link(F, torch.eye(3, dtype=torch.float64)))


def _truth(disparity: Disparity) -> tuple[Float[Tensor, "h w 2"], Tensor]:
    """Where left's pixels are in right, and where that is known and in the image."""
    difference = pixel_grid(hw_of(disparity.value), dtype=torch.float64).clone()
    difference[..., 0] -= disparity.value
    return difference, disparity.valid & (difference[..., 0] >= -0.5)


def layered_cases(bank: PhotoBank, count: int, *, hw: tuple[int, int] = (96, 128)) -> Iterator[Case]:
    """Unrectified rigs, of different focal lengths, in front of layered scenes."""
    for number in range(count):
        rig = rig_of(hw, ratio=(1.0, 1.25)[number % 2], ahead=(0.0, 30.0)[number // 2 % 2])
        pair = rig.pair(ALPHA, BETA)
        largest = float(covering_displacement(pair))
        yield Case("unrectified", f"scene {number}", pair, made(rig, bank, number), largest)


def evaluate_fields(
    network: Comparing,
    cases: Iterable[Case],
    *,
    fields: Callable[[float], Mapping[str, ReceptiveField]] = fields_of,
) -> list[FieldRow]:
    """Every field on every case. The first is computed once before, so that what is loaded and compiled then
    is not counted as its time and memory."""
    rows: list[FieldRow] = []
    for case in cases:
        chosen = fields(case.max_displacement)
        if not rows:
            _row(network, case, *next(iter(chosen.items())))
        for name, field in chosen.items():
            rows.append(_row(network, case, name, field))
    return rows


def _row(network: Comparing, case: Case, name: str, field: ReceptiveField) -> FieldRow:
    alpha, beta = case.scene.images[ALPHA], case.scene.images[BETA]
    pixels = math.prod(hw_of(alpha)) * math.prod(hw_of(beta))
    if isinstance(field, Dense) and pixels > DENSE_LIMIT:
        return FieldRow(case.kind, case.name, name, note=f"{pixels:.1g} samples: left out")
    began = time.process_time()
    try:
        result, grown = with_peak(partial(fused, network, case.pair, alpha, beta, field))
    except ValueError as error:
        return FieldRow(case.kind, case.name, name, note=f"{error}".partition(":")[0])
    seconds = time.process_time() - began
    psnr, ssim = score(result.image.clamp(0, 1), case.scene.ground_truth)
    mebibytes = math.nan if grown is None else grown / 2**20
    return FieldRow(case.kind, case.name, name, psnr, ssim, result.peaks(case.scene), seconds, mebibytes)


def fields_markdown(rows: Sequence[FieldRow]) -> str:
    """A table for each kind of cases: means over them, fields as lines."""
    parts = []
    for kind, of_kind in grouped(rows, "kind").items():
        lines = [_line(name, own) for name, own in grouped(of_kind, "field").items()]
        title = f"{kind} ({len(grouped(of_kind, 'case'))})"
        columns = [title, "PSNR", "SSIM", "peaks within 1 px", "CPU s", "MiB", ""]
        parts.append(markdown_table(columns, lines, align="lrrrrrl"))
    return "\n".join(parts)


def _line(name: str, rows: Sequence[FieldRow]) -> list[str]:
    served = [row for row in rows if not row.note]
    if not served:
        return [name, "", "", "", "", "", rows[0].note]
    columns = {"psnr": ".2f", "ssim": ".4f", "peaks": ".1%", "seconds": ".1f", "mebibytes": ".0f"}
    means = {column: sum(getattr(row, column) for row in served) / len(served) for column in columns}
    return [name, *(f"{means[column]:{how}}" for column, how in columns.items()), ""]
