"""Comparison of methods on stereo pairs by the paper's protocols: scores, tables, images."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from rich.progress import track
from torch import Tensor

from ...media.images import write_image
from ...support.metrics import score
from ..data.pairs import PAPER_DISPARITY, Disparity, StereoPair, folder_pairs, middlebury_pairs
from .protocols import MonoColourTask, StereoMethod, StereoResult, enlarged, hw_of, mono_colour_task
from .tables import grouped, interval_cell, markdown_table

DATA_SETS: dict[str, Callable[[Path], Iterable[StereoPair]]] = {
    "kitti": folder_pairs,
    "middlebury": middlebury_pairs,
    "flickr1024": folder_pairs,
    "folder": folder_pairs,
}
"""Readers of folders by data set."""


class StereoRow(NamedTuple):
    """Scores of one method on one pair.

    Attributes:
        pair: name of the pair.
        rate: factor by which beta is reduced.
        method: name of the method.
        psnr: PSNR in dB.
        ssim: SSIM.
        end_point_error: mean absolute error of disparity, pixels of alpha; None if no pixel has both a true
            and a finite estimated one.
        within_one: share of pixels of known true disparity with an error of at most one pixel, unknown
            estimates counting as wrong; None likewise.
    """

    pair: str
    rate: int
    method: str
    psnr: float
    ssim: float
    end_point_error: float | None = None
    within_one: float | None = None


def evaluate_sets(
    sets: Mapping[str, Iterable[StereoPair]],
    methods: Mapping[str, StereoMethod],
    rates: Sequence[int],
    *,
    out: Path,
) -> dict[str, list[StereoRow]]:
    """Evaluate methods on data sets by `evaluate_pairs`, with its `max_disparity`; it says what is raised.

    Args:
        sets: pairs by data set.
        methods: fusion methods by name.
        rates: factors by which beta is reduced.
        out: folder for strips of images, in a folder for each set.

    Returns:
        Rows by data set.
    """
    return {name: evaluate_pairs(pairs, methods, rates, images=out / name) for name, pairs in sets.items()}


def evaluate_pairs(
    pairs: Iterable[StereoPair],
    methods: Mapping[str, StereoMethod],
    rates: Sequence[int] = (2, 4),
    *,
    max_disparity: float = PAPER_DISPARITY,
    images: Path | None = None,
) -> list[StereoRow]:
    """Score each method on each pair at each rate: whole frames, values clipped to 0..1, not rounded.

    Args:
        pairs: stereo pairs, read one at a time.
        methods: fusion methods by name.
        rates: factors by which beta is reduced.
        max_disparity: largest disparity that methods are told, pixels of alpha, the same for all pairs.
        images: folder for one strip of each pair and rate (beta enlarged, each method, the ground truth), a
            PNG file; None writes none.

    Returns:
        One row for each pair, rate and method.

    Raises:
        ValueError: as `mono_colour_task`, and for sides too short for SSIM (`score`). Errors of methods, of
            reading and of writing pass.
    """
    rows = []
    for pair in track(pairs, "evaluating", disable=not sys.stderr.isatty()):
        for rate in rates:
            task = mono_colour_task(pair, rate)
            results = {n: method(task.alpha, task.beta, max_disparity) for n, method in methods.items()}
            rows += [_row(pair.name, rate, name, result, task) for name, result in results.items()]
            if images:
                fused = [result.image.clamp(0, 1) for result in results.values()]
                strip = torch.cat([enlarged(task.beta, hw_of(task.alpha)), *fused, task.ground_truth], -1)
                write_image(images / f"{pair.name.replace('/', '-')}_x{rate}.png", strip)
    return rows


PrintedScores = Mapping[int, tuple[float, float]]
"""Published (PSNR, SSIM) by rate."""


def sets_markdown(
    rows: Mapping[str, Sequence[StereoRow]], *, printed: Mapping[str, PrintedScores] = {}, depth: bool = True
) -> str:
    """Format rows of several data sets: the tables of `markdown`, the sentence of `structure_kept`, and the
    table of `depth_markdown` if wanted.

    Args:
        rows: rows by data set; they include the methods "fusion" and "alpha".
        printed: published scores by data set, shown in a column of their own.
        depth: True to add the errors of disparity where its truth is known.

    Returns:
        Markdown, a heading for each set.

    Raises:
        KeyError: for a pair and rate with "fusion" and without "alpha".
    """
    parts = []
    for name, of_set in rows.items():
        scores = markdown(of_set, printed=printed.get(name, {}))
        parts.append(f"#### {name}\n\n{scores}\n{structure_kept(of_set)}\n")
        parts += [errors] if depth and (errors := depth_markdown(of_set)) else []
    return "\n".join(parts)


def markdown(rows: Sequence[StereoRow], *, printed: PrintedScores = {}) -> str:  # noqa: B006
    """Format rows as one table for each rate: pairs and mean in lines, methods in columns, PSNR / SSIM in
    cells.

    Args:
        rows: scores of one data set.
        printed: published scores by rate, shown as a column with a mean only.

    Returns:
        Markdown; the mean PSNR of several pairs has a 95 % bootstrap interval; empty text for no rows.
    """
    return "\n".join(_table(own, printed.get(rate)) for rate, own in grouped(rows, "rate").items())


def _table(rows: Sequence[StereoRow], printed: tuple[float, float] | None = None) -> str:
    """Table of one rate."""
    methods = grouped(rows, "method")
    scores = {(row.pair, row.method): f"{row.psnr:.2f} / {row.ssim:.4f}" for row in rows}
    columns = [f"beta reduced {rows[0].rate}x" if rows[0].rate > 1 else "beta as it is", *methods]
    lines = [[pair, *(scores.get((pair, m), "") for m in methods)] for pair in grouped(rows, "pair")]
    lines.append(["**mean**", *map(_mean_cell, methods.values())])
    if printed:
        columns.append("the paper, printed, on its own data")
        cells = [""] * (len(lines) - 1) + [f"{printed[0]:.2f} / {printed[1]:.4f}"]
        lines = [[*line, cell] for line, cell in zip(lines, cells)]
    return markdown_table(columns, lines)


def _mean_cell(rows: Sequence[StereoRow]) -> str:
    """Mean PSNR with its 95% bootstrap interval, and mean SSIM."""
    psnr = [row.psnr for row in rows]
    return f"**{np.mean(psnr):.2f}**{interval_cell(psnr)} / **{np.mean([row.ssim for row in rows]):.4f}**"


def depth_markdown(rows: Sequence[StereoRow]) -> str:
    """Format disparity errors: end-point error in pixels / share within one pixel, a line for each pair.

    Returns:
        Markdown table of the rows with errors, and their mean; empty text if there is none.
    """
    with_disparity = [row for row in rows if row.end_point_error is not None]
    if not with_disparity:
        return ""
    columns = list(product(grouped(with_disparity, "method"), grouped(with_disparity, "rate")))
    lines = []
    for pair, own in [*grouped(with_disparity, "pair").items(), ("**mean**", with_disparity)]:
        groups = grouped(own, "method", "rate")
        lines.append([pair, *(_depth_cell(groups.get(key, ())) for key in columns)])
    return markdown_table(["depth", *(f"{method}, {rate}x" for method, rate in columns)], lines)


def _depth_cell(rows: Sequence[StereoRow]) -> str:
    if not rows:
        return ""
    errors = np.array([(row.end_point_error, row.within_one) for row in rows], float)
    return "{:.2f} px / {:.1%}".format(*errors.mean(0))


def structure_kept(rows: Sequence[StereoRow]) -> str:
    """Count the pairs and rates where fusion's SSIM is at least that of alpha alone, and name the others.

    Args:
        rows: scores of the methods "fusion" and "alpha" on the same pairs; others are ignored.

    Returns:
        A sentence in Markdown.

    Raises:
        KeyError: for a pair and rate with "fusion" and without "alpha".
    """
    ssim = {(row.pair, row.rate, row.method): row.ssim for row in rows}
    cases = [(pair, rate) for pair, rate, name in ssim if name == "fusion"]
    lost = [f"{p} {r}x" for p, r in cases if ssim[p, r, "fusion"] < ssim[p, r, "alpha"]]
    kept = f"SSIM of fusion is at least that of alpha in {len(cases) - len(lost)} of {len(cases)} cases"
    return f"{kept}; **below it**: {', '.join(lost)}." if lost else f"{kept}."


def _row(pair: str, rate: int, method: str, result: StereoResult, task: MonoColourTask) -> StereoRow:
    errors: tuple[float | None, float | None] = (None, None)
    if result.disparity is not None and task.disparity is not None:
        errors = disparity_errors(result.disparity, task.disparity)
    return StereoRow(pair, rate, method, *score(result.image.clamp(0, 1), task.ground_truth), *errors)


def disparity_errors(
    disparity: Float[Tensor, "h w"], ground_truth: Disparity
) -> tuple[float | None, float | None]:
    """Compare estimated with true disparity.

    Args:
        disparity: estimate in pixels; NaN or infinite where unknown.
        ground_truth: true disparity of the same pixels, in the same unit.

    Returns:
        Mean absolute error in pixels where both are known, and share of all known true disparities with an
        error of at most 1; (None, None) if none can be compared.
    """
    value, valid = ground_truth
    compared = valid & disparity.isfinite()
    if not compared.any():
        return None, None
    error = (disparity.to(value) - value)[compared].abs().double()
    return float(error.mean()), int((error <= 1).sum()) / int(valid.sum())
