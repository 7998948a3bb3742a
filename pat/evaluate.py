"""Fusions compared on stereo pairs by the paper's mono + colour protocol: scores, tables, pictures."""

from __future__ import annotations

import csv
import io
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from rich.progress import track
from torch import Tensor
from torch.nn.functional import interpolate

from arraygeom import Rectified, Rig, View
from pat.classical import classical_fusion
from pat.data import (
    PAPER_DISPARITY,
    MonoColourTask,
    StereoPair,
    flickr_pairs,
    folder_pairs,
    kitti_pairs,
    middlebury_pairs,
    mono_colour_task,
)
from pat.fuse import fuse
from pat.images import write_image, write_text
from pat.metrics import bootstrap_interval, score
from pat.model import FusionNetwork

Fusion = Callable[[Tensor, Tensor, float], Tensor]
"""(alpha (1, H, W), beta (3, Hb, Wb), max_disparity in alpha pixels) -> a colour picture (3, H, W), 0..1."""


T = TypeVar("T")


class Row(NamedTuple):
    """How one method did on one pair with beta reduced `rate` times."""

    pair: str
    rate: int
    method: str
    psnr: float
    ssim: float


def alpha_alone(alpha: Tensor, beta: Tensor, max_disparity: float) -> Tensor:
    """The grey picture three times: what no colour at all scores."""
    return alpha.expand(3, -1, -1)


def beta_alone(alpha: Tensor, beta: Tensor, max_disparity: float) -> Tensor:
    """The colour picture enlarged (bicubic) and left where it is: what no matching at all scores."""
    return interpolate(beta[None], alpha.shape[1:], mode="bicubic", align_corners=False)[0]


def classical(alpha: Tensor, beta: Tensor, max_disparity: float) -> Tensor:
    """`classical_fusion` as a method."""
    return classical_fusion(alpha, beta, max_disparity=max_disparity)


def rectified_fusion(network: FusionNetwork) -> Fusion:
    """`fuse` with a network as a method, alpha on the left: it looks along rows, up to `max_disparity` pixels."""

    def fused(alpha: Tensor, beta: Tensor, max_disparity: float) -> Tensor:
        rig = Rig({"alpha": View(hw=_hw(alpha)), "beta": View(hw=_hw(beta))})
        field = Rectified(max_disparity, alpha_is="left")
        return fuse(network, rig, {"alpha": alpha, "beta": beta}, alpha="alpha", field=field).image

    return fused


BASELINES: dict[str, Fusion] = {"alpha": alpha_alone, "beta": beta_alone, "classical": classical}
"""What a fusion can be compared with."""
METHODS = {name: BASELINES[name] for name in ("alpha", "classical")}
"""What every table shows beside a fusion."""


DATA_SETS: dict[str, Callable[[Path], Iterable[StereoPair]]] = {
    "kitti": kitti_pairs,
    "middlebury": middlebury_pairs,
    "flickr1024": flickr_pairs,
    "folder": folder_pairs,
}
"""How the folder of each data set is read."""


def evaluate_sets(
    folders: Mapping[str, Path], methods: Mapping[str, Fusion], rates: Sequence[int], *, out: Path
) -> dict[str, list[Row]]:
    """`evaluate_pairs` on data sets by name (see `DATA_SETS`): rows by set, a strip of pictures a pair in out/set.

    All folders are looked into before the work begins: a missing one raises FileNotFoundError or ValueError.
    """
    pairs = {name: DATA_SETS[name](folder) for name, folder in folders.items()}
    return {name: evaluate_pairs(found, methods, rates, pictures=out / name) for name, found in pairs.items()}


def evaluate_pairs(
    pairs: Iterable[StereoPair],
    methods: Mapping[str, Fusion],
    rates: Sequence[int] = (2, 4),
    *,
    max_disparity: float = PAPER_DISPARITY,
    pictures: str | Path | None = None,
) -> list[Row]:
    """Each method's scores on each pair at each rate: whole frames, values cut to 0..1 and not rounded.

    `max_disparity`, in alpha's pixels, is the same for all (the paper's: 120 / rate pixels of beta). With
    `pictures`, a folder, a strip for each pair and rate goes there: beta enlarged, each method, the truth.
    Raises ValueError naming the method and the pair if a result has another shape than the truth or is not
    finite.
    """
    rows = []
    for pair in track(pairs, "evaluating", disable=not sys.stderr.isatty()):
        for rate in rates:
            task = mono_colour_task(pair, rate)
            images = {name: _fused(name, fuse, pair, task, max_disparity) for name, fuse in methods.items()}
            rows += [Row(pair.name, rate, name, *score(image, task.truth)) for name, image in images.items()]
            if pictures:
                write_image(Path(pictures) / f"{pair.name.replace('/', '-')}_x{rate}.png", _strip(task, images))
    return rows


class Summary(NamedTuple):
    """A method's means over pairs at one rate, with the 95% bootstrap interval of mean PSNR."""

    rate: int
    method: str
    pairs: int
    psnr: float
    psnr_interval: tuple[float, float]
    ssim: float


def summarise(rows: Sequence[Row]) -> list[Summary]:
    """One summary for each rate and method, in the order in which they appear."""
    groups: dict[tuple[int, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.rate, row.method), []).append(row)
    return [_summary(*key, group) for key, group in sorted(groups.items(), key=lambda item: item[0][0])]


def write_csv(path: str | Path, rows: Sequence[Row]) -> None:
    """One line for each row, all digits; the file appears whole or not at all."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(Row._fields)
    writer.writerows(rows)
    write_text(path, text.getvalue())


def write_markdown(path: str | Path, rows: Sequence[Row]) -> None:
    """`markdown(rows)` in a file that appears whole or not at all."""
    write_text(path, markdown(rows))


def markdown(rows: Sequence[Row]) -> str:
    """A table for each rate: pairs and mean as lines, methods as columns, PSNR / SSIM in the cells."""
    rates = _unique(row.rate for row in rows)
    return "\n".join(_table([row for row in rows if row.rate == rate]) for rate in rates)


def _hw(image: Tensor) -> tuple[int, int]:
    return image.shape[-2], image.shape[-1]


def sets_markdown(rows: Mapping[str, Sequence[Row]]) -> str:
    """`markdown` of each data set under its name, and what `structure_kept` says of each."""
    return "\n".join(f"#### {name}\n\n{markdown(rows)}\n{structure_kept(rows)}\n" for name, rows in rows.items())


def structure_kept(rows: Sequence[Row], *, method: str = "fusion", than: str = "alpha") -> str:
    """One line: on which pairs, if any, the SSIM of `method` is below that of alpha alone."""
    ssim = {(row.pair, row.rate, row.method): row.ssim for row in rows}
    cases = [(pair, rate) for pair, rate, name in ssim if name == method]
    lost = [f"{pair} {rate}x" for pair, rate in cases if ssim[pair, rate, method] < ssim[pair, rate, than]]
    kept = f"SSIM of {method} is at least that of {than} in {len(cases) - len(lost)} of {len(cases)} cases"
    return f"{kept}; **below it**: {', '.join(lost)}." if lost else f"{kept}."


def _fused(name: str, fuse: Fusion, pair: StereoPair, task: MonoColourTask, max_disparity: float) -> Tensor:
    image = fuse(task.alpha, task.beta, max_disparity).detach().cpu()
    if image.shape != task.truth.shape:
        raise ValueError(
            f"{name} on {pair.name}: gave {tuple(image.shape)}, wanted a picture {tuple(task.truth.shape)}"
        )
    if not image.isfinite().all():
        raise ValueError(f"{name} on {pair.name}: gave NaN or infinite values")
    return image.float().clamp(0, 1)


def _strip(task: MonoColourTask, images: Mapping[str, Tensor]) -> Float[Tensor, "3 h w"]:
    return torch.cat([beta_alone(task.alpha, task.beta, 0.0), *images.values(), task.truth], -1)


def _summary(rate: int, method: str, rows: Sequence[Row]) -> Summary:
    psnrs = [row.psnr for row in rows]
    ssim = float(np.mean([row.ssim for row in rows]))
    return Summary(rate, method, len(rows), float(np.mean(psnrs)), bootstrap_interval(psnrs), ssim)


def _table(rows: Sequence[Row]) -> str:
    """The table of one rate."""
    methods = _unique(row.method for row in rows)
    scores = {(row.pair, row.method): f"{row.psnr:.2f} / {row.ssim:.4f}" for row in rows}
    pairs = _unique(row.pair for row in rows)
    lines = [[pair, *(scores.get((pair, method), "") for method in methods)] for pair in pairs]
    means = {summary.method: _mean_cell(summary) for summary in summarise(rows)}
    header = [f"beta reduced {rows[0].rate}x" if rows[0].rate > 1 else "beta as it is", *methods]
    rule = ["---", *("---:" for _ in methods)]
    table = [header, rule, *lines, ["**mean**", *(means[method] for method in methods)]]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in table)


def _mean_cell(summary: Summary) -> str:
    low, high = summary.psnr_interval
    interval = f" ({low:.2f} to {high:.2f})" if summary.pairs > 1 else ""
    return f"**{summary.psnr:.2f}**{interval} / **{summary.ssim:.4f}**"


def _unique(items: Iterable[T]) -> list[T]:
    return list(dict.fromkeys(items))
