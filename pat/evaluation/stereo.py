"""Fusions compared on stereo pairs by the paper's protocols: scores, controls, tables, images.

The protocol `table1` is the paper's mono + colour (its Table 1): left made grey is alpha, right, reduced, is beta.
`table2` is mono + three bands (its Table 2): the bands of right are three cameras, each of one channel.
"""

from __future__ import annotations

import csv
import io
import math
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from rich.progress import track
from torch import Tensor
from torch.nn.functional import interpolate

from arraygeom import Camera, Pair, Pose, Positions, ReceptiveField, Rectified, Rig, Segments, intrinsics
from arraygeom.atomic import write_text
from arraygeom.pixels import HW
from pat.data import (
    PAPER_DISPARITY,
    Disparity,
    StereoPair,
    folder_pairs,
    middlebury_pairs,
)
from pat.data.sample_array import BETA, SAMPLE
from pat.evaluation.baseline import classical_fusion
from pat.evaluation.metrics import bootstrap_interval, disparity_score, score
from pat.evaluation.protocols import MonoColourTask, mono_colour_task
from pat.fusion.fuse import fuse
from pat.media.images import read_image, write_image
from pat.networks.protocol import FusionNetwork

T = TypeVar("T")


class Answer(NamedTuple):
    """A colour image (3, H, W), 0..1, and the disparity (H, W) that it was found at, pixels of alpha; NaN unknown."""

    image: Tensor
    disparity: Tensor | None = None


Fusion = Callable[[Tensor, Tensor, float], Tensor | Answer]
"""(alpha (1, H, W), beta (3, Hb, Wb), max_disparity in alpha pixels) -> a colour image (3, H, W), 0..1, or more."""


class Row(NamedTuple):
    """How one method did on one pair with beta reduced `rate` times.

    Where the true disparity is known and the method tells one: its mean error, pixels, and the share of all pixels
    with a true disparity that is within one pixel of it.
    """

    pair: str
    rate: int
    method: str
    psnr: float
    ssim: float
    end_point_error: float | None = None
    within_one: float | None = None


def alpha_alone(alpha: Tensor, beta: Tensor, max_disparity: float) -> Tensor:
    """The grey image three times: what no colour at all scores."""
    return alpha.expand(3, -1, -1)


def beta_alone(alpha: Tensor, beta: Tensor, max_disparity: float) -> Tensor:
    """The colour image enlarged (bicubic) and left where it is: what no matching at all scores."""
    return interpolate(beta[None], alpha.shape[1:], mode="bicubic", align_corners=False)[0]


def classical(alpha: Tensor, beta: Tensor, max_disparity: float) -> Tensor:
    """`classical_fusion` as a method."""
    return classical_fusion(alpha, beta, max_disparity=max_disparity)


def rectified_fusion(
    network: FusionNetwork,
    *,
    bands: bool = False,
    beta: Callable[[Tensor], Tensor] = lambda beta: beta,
    shuffled: bool = False,
) -> Fusion:
    """`fuse` with a network as a method, alpha on the left: it looks along rows, up to `max_disparity` pixels.

    With `bands` each channel of beta is a camera. For controls: `beta` makes of beta what the network is given, and
    `shuffled` lets each pixel look where another one, drawn at random, should.
    """

    def fused(alpha: Tensor, given: Tensor, max_disparity: float) -> Answer:
        image = beta(given)
        betas = dict(zip("rgb", image.split(1))) if bands else {"beta": image}
        rig = rectified_rig(_hw(alpha), {name: _hw(band) for name, band in betas.items()}, max_disparity)
        field: ReceptiveField = Rectified(max_disparity, alpha_is="left")
        field = Shuffled(field) if shuffled else field
        frame = fuse(network, rig, {"alpha": alpha, **betas}, alpha="alpha", field=field)
        return Answer(frame.image, alpha.shape[-1] / frame.depth)

    return fused


def rectified_rig(hw: HW, betas: Mapping[str, HW], max_disparity: float) -> Rig:
    """Cameras one behind the other along x, such that disparity is alpha's width over depth, pixels of alpha.

    All see the same field of view; betas are at one place, one metre to the right of alpha.
    """
    alpha = Camera(K=intrinsics(float(hw[1]), hw), cam_from_world=Pose.identity(), hw=hw)
    right = alpha.replace(cam_from_world=Pose(alpha.R, alpha.t.new_tensor([-1.0, 0.0, 0.0])))
    cameras = {"alpha": alpha} | {name: right.resize(size) for name, size in betas.items()}
    return Rig(cameras, depth=(hw[1] / max_disparity, math.inf))


@dataclass(frozen=True)
class Shuffled:
    """A field that tells each alpha pixel where another one should look: the same looks, in the wrong places."""

    field: ReceptiveField
    seed: int = 0

    def __call__(self, pair: Pair, x: Float[Tensor, "*n 2"]) -> Segments | Positions:
        """The looks of the pixels that a random permutation puts in the place of x."""
        h, w = pair.alpha.hw
        order = torch.randperm(h * w, generator=torch.Generator().manual_seed(self.seed)).to(x.device)
        column, row = x[..., 0].round().long().clamp(0, w - 1), x[..., 1].round().long().clamp(0, h - 1)
        drawn = order[row * w + column]
        return self.field(pair, torch.stack([drawn % w, drawn // w], -1).to(x))


def controls(network: FusionNetwork, *, bands: bool = False) -> dict[str, Fusion]:
    """A fusion that uses beta must fall with each: no beta (zeros), beta of another scene, shuffled fields."""
    other = read_image(SAMPLE / f"{BETA}.png")[None]

    def foreign(beta: Tensor) -> Tensor:
        return interpolate(other, _hw(beta), mode="bicubic", align_corners=False, antialias=True)[0].clamp(0, 1)

    return {
        "no beta": rectified_fusion(network, bands=bands, beta=torch.zeros_like),
        "another scene's beta": rectified_fusion(network, bands=bands, beta=foreign),
        "shuffled fields": rectified_fusion(network, bands=bands, shuffled=True),
    }


PROTOCOLS = {"table1": False, "table2": True}
"""Whether each channel of beta is a camera of its own."""
PRINTED = {
    ("table1", "flickr1024"): {2: (27.26, 0.8992), 4: (25.85, 0.8840)},
    ("table1", "kitti"): {2: (29.55, 0.9097), 4: (28.40, 0.8957)},
    ("table2", "flickr1024"): {2: (25.55, 0.8714), 4: (24.00, 0.8493)},
    ("table2", "kitti"): {2: (28.77, 0.8955), 4: (28.13, 0.8903)},
}
"""PSNR and SSIM of fusion as the paper prints them, by protocol, data set and rate; on its own choice of images."""

BASELINES: dict[str, Fusion] = {"alpha": alpha_alone, "beta": beta_alone, "classical": classical}
"""What a fusion can be compared with."""
METHODS = {name: BASELINES[name] for name in ("alpha", "classical")}
"""What every table shows beside a fusion."""


DATA_SETS: dict[str, Callable[[Path], Iterable[StereoPair]]] = {
    "kitti": folder_pairs,
    "middlebury": middlebury_pairs,
    "flickr1024": folder_pairs,
    "folder": folder_pairs,
}
"""How the folder of each data set is read."""


def evaluate_sets(
    folders: Mapping[str, Path], methods: Mapping[str, Fusion], rates: Sequence[int], *, out: Path
) -> dict[str, list[Row]]:
    """`evaluate_pairs` on data sets by name (see `DATA_SETS`): rows by set, a strip of images a pair in out/set.

    All folders are looked into before the work begins: a missing one raises FileNotFoundError or ValueError.
    """
    pairs = {name: DATA_SETS[name](folder) for name, folder in folders.items()}
    return {name: evaluate_pairs(found, methods, rates, images=out / name) for name, found in pairs.items()}


def evaluate_pairs(
    pairs: Iterable[StereoPair],
    methods: Mapping[str, Fusion],
    rates: Sequence[int] = (2, 4),
    *,
    max_disparity: float = PAPER_DISPARITY,
    images: str | Path | None = None,
) -> list[Row]:
    """Each method's scores on each pair at each rate: whole frames, values cut to 0..1 and not rounded.

    `max_disparity`, in alpha's pixels, is the same for all (the paper's: 120 / rate pixels of beta). With
    `images`, a folder, a strip for each pair and rate goes there: beta enlarged, each method, the truth.
    Raises ValueError naming the method and the pair if a result has another shape than the truth or is not
    finite.
    """
    rows = []
    for pair in track(pairs, "evaluating", disable=not sys.stderr.isatty()):
        for rate in rates:
            task = mono_colour_task(pair, rate)
            answers = {name: _fused(name, fuse, pair, task, max_disparity) for name, fuse in methods.items()}
            rows += [_row(pair, rate, name, answer, task.ground_truth) for name, answer in answers.items()]
            if images:
                fused = {name: answer.image for name, answer in answers.items()}
                write_image(Path(images) / f"{pair.name.replace('/', '-')}_x{rate}.png", _strip(task, fused))
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


Printed = Mapping[int, tuple[float, float]]
"""PSNR and SSIM by rate that somebody printed."""


def markdown(rows: Sequence[Row], *, printed: Printed = {}) -> str:  # noqa: B006
    """A table for each rate: pairs and mean as lines, methods as columns, PSNR / SSIM in the cells.

    `printed` figures of the paper, by rate, get a column with a mean only.
    """
    rates = _unique(row.rate for row in rows)
    return "\n".join(_table([row for row in rows if row.rate == rate], printed.get(rate)) for rate in rates)


def depth_markdown(rows: Sequence[Row]) -> str:
    """Errors of depth where it is known: end-point error in pixels / share within one pixel. Empty if nowhere."""
    told = [row for row in rows if row.end_point_error is not None]
    if not told:
        return ""
    methods, rates = _unique(row.method for row in told), _unique(row.rate for row in told)
    head = ["depth", *(f"{method}, {rate}x" for method in methods for rate in rates)]
    found = {(row.pair, row.method, row.rate): row for row in told}
    lines = [
        [pair, *(_depth_cell([found[pair, m, r]]) if (pair, m, r) in found else "" for m in methods for r in rates)]
        for pair in _unique(row.pair for row in told)
    ]
    groups = [[row for row in told if (row.method, row.rate) == (m, r)] for m in methods for r in rates]
    table = [head, ["---", *("---:" for _ in head[1:])], *lines, ["**mean**", *map(_depth_cell, groups)]]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in table)


def falls(rows: Sequence[Row], *, method: str = "fusion", names: Iterable[str]) -> str:
    """One line for each control: by how much mean PSNR is below that of `method`, and the least of any image."""
    psnr = {(row.pair, row.rate, row.method): row.psnr for row in rows}
    lines = []
    for name in names:
        fall = [value - psnr[pair, rate, name] for (pair, rate, m), value in psnr.items() if m == method]
        lines.append(f"- {name}: {np.mean(fall):.2f} dB below {method}, at least {min(fall):.2f} dB\n")
    return "".join(lines)


def _hw(image: Tensor) -> HW:
    return image.shape[-2], image.shape[-1]


def sets_markdown(rows: Mapping[str, Sequence[Row]], *, protocol: str = "") -> str:
    """`markdown` of each data set under its name, and what `structure_kept` says of each.

    With a protocol, also the paper's printed figures, and errors of depth.
    """
    return "\n".join(_set_markdown(name, found, protocol) for name, found in rows.items())


def _set_markdown(name: str, rows: Sequence[Row], protocol: str) -> str:
    tables = markdown(rows, printed=PRINTED.get((protocol, name), {}))
    depth = depth_markdown(rows) if protocol else ""
    return f"#### {name}\n\n{tables}\n{structure_kept(rows)}\n" + (f"\n{depth}" if depth else "")


def structure_kept(rows: Sequence[Row], *, method: str = "fusion", than: str = "alpha") -> str:
    """One line: on which pairs, if any, the SSIM of `method` is below that of alpha alone."""
    ssim = {(row.pair, row.rate, row.method): row.ssim for row in rows}
    cases = [(pair, rate) for pair, rate, name in ssim if name == method]
    lost = [f"{pair} {rate}x" for pair, rate in cases if ssim[pair, rate, method] < ssim[pair, rate, than]]
    kept = f"SSIM of {method} is at least that of {than} in {len(cases) - len(lost)} of {len(cases)} cases"
    return f"{kept}; **below it**: {', '.join(lost)}." if lost else f"{kept}."


def _fused(name: str, fuse: Fusion, pair: StereoPair, task: MonoColourTask, max_disparity: float) -> Answer:
    given = fuse(task.alpha, task.beta, max_disparity)
    answer = given if isinstance(given, Answer) else Answer(given)
    image = answer.image.detach().cpu()
    if image.shape != task.ground_truth.shape:
        raise ValueError(
            f"{name} on {pair.name}: gave {tuple(image.shape)}, wanted an image {tuple(task.ground_truth.shape)}"
        )
    if not image.isfinite().all():
        raise ValueError(f"{name} on {pair.name}: gave NaN or infinite values")
    return Answer(image.float().clamp(0, 1), answer.disparity)


def _row(pair: StereoPair, rate: int, method: str, answer: Answer, ground_truth: Tensor) -> Row:
    errors: tuple[float | None, float | None] = (None, None)
    if answer.disparity is not None and pair.disparity is not None:
        errors = disparity_errors(answer.disparity.detach().cpu(), pair.disparity)
    return Row(pair.name, rate, method, *score(answer.image, ground_truth), *errors)


def disparity_errors(found: Float[Tensor, "h w"], ground_truth: Disparity) -> tuple[float | None, float | None]:
    """Mean error of `found` where it and the truth are known, and the share of known truth that is within a pixel.

    The truth may be larger by what was cut off at the bottom and the right.
    """
    h, w = found.shape
    value, valid = ground_truth.value[:h, :w], ground_truth.valid[:h, :w]
    told = valid & found.isfinite()
    if not told.any():
        return None, None
    errors = disparity_score(found.to(value), value, told)
    return errors.end_point_error, errors.within_one * float(told.sum() / valid.sum())


def _strip(task: MonoColourTask, images: Mapping[str, Tensor]) -> Float[Tensor, "3 h w"]:
    return torch.cat([beta_alone(task.alpha, task.beta, 0.0), *images.values(), task.ground_truth], -1)


def _summary(rate: int, method: str, rows: Sequence[Row]) -> Summary:
    psnrs = [row.psnr for row in rows]
    ssim = float(np.mean([row.ssim for row in rows]))
    return Summary(rate, method, len(rows), float(np.mean(psnrs)), bootstrap_interval(psnrs), ssim)


def _depth_cell(rows: Sequence[Row]) -> str:
    error, within = (float(np.mean([getattr(row, name) for row in rows])) for name in ("end_point_error", "within_one"))
    return f"{error:.2f} px / {within:.1%}"


def _table(rows: Sequence[Row], printed: tuple[float, float] | None = None) -> str:
    """The table of one rate."""
    methods = _unique(row.method for row in rows)
    scores = {(row.pair, row.method): f"{row.psnr:.2f} / {row.ssim:.4f}" for row in rows}
    pairs = _unique(row.pair for row in rows)
    lines = [[pair, *(scores.get((pair, method), "") for method in methods)] for pair in pairs]
    means = {summary.method: _mean_cell(summary) for summary in summarise(rows)}
    header = [f"beta reduced {rows[0].rate}x" if rows[0].rate > 1 else "beta as it is", *methods]
    last = ["**mean**", *(means[method] for method in methods)]
    if printed:
        header, lines = [*header, "the paper, printed, on its own data"], [[*line, ""] for line in lines]
        last = [*last, f"{printed[0]:.2f} / {printed[1]:.4f}"]
    table = [header, ["---", *("---:" for _ in header[1:])], *lines, last]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in table)


def _mean_cell(summary: Summary) -> str:
    low, high = summary.psnr_interval
    interval = f" ({low:.2f} to {high:.2f})" if summary.pairs > 1 else ""
    return f"**{summary.psnr:.2f}**{interval} / **{summary.ssim:.4f}**"


def _unique(items: Iterable[T]) -> list[T]:
    return list(dict.fromkeys(items))
