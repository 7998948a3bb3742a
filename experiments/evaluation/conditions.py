"""Fusion under what real cameras do: other responses, exposures, noise, misalignment; by region, with depth.

Each rectified colour pair is recorded under each condition: left as the mono alpha, right, reduced, as the
colour beta. The ground truth is left in colour.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Generator, Tensor
from torch.nn.functional import interpolate

from arraygeom import Rectified, sample
from arraygeom.viz import new_figure
from pat import FuseSettings
from pat.fusion.classical import classical_fusion, denoised_knowing, raw_disparity
from pat.fusion.fuse import corrections_of
from pat.lab.data.pairs import PAPER_DISPARITY, Disparity, StereoPair
from pat.lab.evaluation.protocols import (
    MonoColourTask,
    StereoMethod,
    StereoResult,
    enlarged,
    hw_of,
    mono_colour_task,
    rectified_fusion,
    rectified_rig,
)
from pat.lab.evaluation.stereo import disparity_errors
from pat.lab.evaluation.tables import grouped, markdown_table
from pat.media.colour import from_luma_chroma, luminance, to_bytes, to_luma_chroma
from pat.media.figures import save_figure
from pat.networks.protocol import FusionNetwork
from pat.sensors.noise_level import NoiseLevel
from pat.support.metrics import bootstrap_interval, score

LEFT_CROP = 64
"""Columns at the left that stereo super-resolution leaves out of its scores."""
READ_NOISE = 2.0
"""Electrons, in the low-light conditions."""
REGIONS = ("whole", "seen", "occluded", "beyond", "cropped")


@dataclass(frozen=True)
class Condition:
    """Condition in which a pair is recorded.

    Attributes:
        rate: factor by which beta is reduced.
        right: function applied to the right image (C, H, W) before it is reduced.
        alpha: weights of red, green and blue in alpha.
        beta: function applied to beta.
        noise: noise level of both cameras; None for none.
    """

    rate: int = 2
    right: Callable[[Tensor], Tensor] = lambda image: image
    alpha: tuple[float, float, float] | Literal["luma", "random"] = "luma"
    beta: Callable[[Tensor], Tensor] = lambda image: image
    noise: NoiseLevel | None = None

    def recorded(self, pair: StereoPair) -> MonoColourTask:
        """The pair under this condition; what is drawn at random depends on the pair's name alone."""
        g = Generator().manual_seed(int(hashlib.sha256(pair.name.encode()).hexdigest()[:8], 16))
        task = mono_colour_task(replace(pair, right=self.right(pair.right)), self.rate)
        alpha, beta = task.alpha, self.beta(task.beta)
        if self.alpha != "luma":
            alpha = luminance(task.ground_truth, _random_weights(g) if self.alpha == "random" else self.alpha)
        if self.noise is not None:
            alpha, beta = (self.noise.recorded(image[None], g)[0] for image in (alpha, beta))
        return task._replace(alpha=alpha, beta=beta)


def _random_weights(g: Generator) -> tuple[float, float, float]:
    drawn = torch.rand(3, generator=g) + 0.1
    red, green, blue = (drawn / drawn.sum()).tolist()
    return red, green, blue


def _moved(rows: float = 0.0, degrees: float = 0.0) -> Callable[[Tensor], Tensor]:
    """The image with its content `rows` lower and rotated about its middle."""

    def moved(image: Tensor) -> Tensor:
        h, w = image.shape[-2:]
        c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        y, x = torch.meshgrid(
            torch.arange(h) - (h - 1) / 2 - rows, torch.arange(w) - (w - 1) / 2, indexing="ij"
        )
        columns = (c * x + s * y + (w - 1) / 2).clamp(0, w - 1)
        where = torch.stack([columns, (c * y - s * x + (h - 1) / 2).clamp(0, h - 1)], -1).reshape(1, -1, 2)
        return sample(image[None], where, interpolation="bicubic").values.reshape(image.shape).clamp(0, 1)

    return moved


def _vignetted(image: Tensor) -> Tensor:
    """Cos^4 of up to 30 degrees in the corners."""
    h, w = image.shape[-2:]
    y, x = torch.meshgrid(torch.linspace(-1, 1, h) * h / w, torch.linspace(-1, 1, w), indexing="ij")
    tangent = math.tan(math.radians(30)) * (x.square() + y.square()).sqrt() / math.hypot(1, h / w)
    return image * (1 + tangent.square()) ** (-2 / 2.2)


def _low_light(electrons: float) -> Condition:
    return Condition(noise=NoiseLevel.from_electrons(electrons, READ_NOISE))


CONDITIONS: dict[str, Condition] = {
    "ideal": Condition(),
    "x1": Condition(rate=1),
    "x4": Condition(rate=4),
    "x8": Condition(rate=8),
    "alpha = mean": Condition(alpha=(1 / 3, 1 / 3, 1 / 3)),
    "alpha = .2/.4/.4": Condition(alpha=(0.2, 0.4, 0.4)),
    "alpha = .6/.3/.1": Condition(alpha=(0.6, 0.3, 0.1)),
    "alpha random": Condition(alpha="random"),
    "beta x .6": Condition(beta=lambda beta: 0.6 * beta),
    "beta x .6, gamma 1.3": Condition(beta=lambda beta: 0.6 * beta**1.3),
    "alpha random, beta x .6": Condition(alpha="random", beta=lambda beta: 0.6 * beta),
    "beta vignetted": Condition(beta=_vignetted),
    "rows off 1 px": Condition(right=_moved(rows=1)),
    "rows off 3 px": Condition(right=_moved(rows=3)),
    "rotated .3 degrees": Condition(right=_moved(degrees=0.3)),
    "1000 electrons": _low_light(1000),
    "200 electrons": _low_light(200),
    "50 electrons": _low_light(50),
}
"""Conditions by name. Rows, degrees in pixels and angles of the right image before it is reduced."""


class ConditionRow(NamedTuple):
    """One method on one pair under one condition: PSNR by region that has pixels, SSIM, depth.

    `end_point_error` (pixels) and `within_one` (shares of pixels whose truth is known: of all, of seen ones)
    are None without a true disparity, or where the method gives none.
    """

    pair: str
    condition: str
    method: str
    ssim: float
    psnr: Mapping[str, float]
    end_point_error: float | None = None
    within_one: tuple[float, float] | None = None


def methods_of(network: FusionNetwork, level: NoiseLevel | None) -> dict[str, StereoMethod]:
    """Return the methods to compare: classical, denoised first if there is noise, ours with and without
    corrections."""
    methods: dict[str, StereoMethod] = {"classical": classical}
    if level is None:
        methods["classical, corrected"] = lambda a, b, d: corrected_classical(network, a, b, d)
    else:
        methods["denoised, classical"] = lambda a, b, d: classical(
            denoised_knowing(a, level), denoised_knowing(b, level), d
        )
    methods["uncorrected"] = rectified_fusion(network, settings=FuseSettings(response="rec601", align=False))
    noise = None if level is None else {"alpha": level, "beta": level}
    methods["fusion"] = rectified_fusion(network, settings=FuseSettings(noise=noise))
    return methods


def corrected_classical(
    network: FusionNetwork, alpha: Tensor, beta: Tensor, max_disparity: float
) -> StereoResult:
    """The classical baseline with alpha's response as the fusion finds it."""
    rig = rectified_rig(hw_of(alpha), {"beta": hw_of(beta)}, max_disparity)
    images, field = {"alpha": alpha, "beta": beta}, Rectified(max_disparity, alpha_is="left")
    response = corrections_of(
        images, rig, alpha="alpha", network=network, settings=FuseSettings(field=field, align=False)
    ).response
    image = classical_fusion(response.of_alpha(alpha), response.of_beta(beta), max_disparity)
    return StereoResult(response.undone(image))


def classical(alpha: Tensor, beta: Tensor, max_disparity: float) -> StereoResult:
    """The classical baseline, disparity by OpenCV's semi-global matching; NaN where that gives nothing."""
    right = luminance(enlarged(beta, hw_of(alpha)))[0]
    disparity = torch.from_numpy(raw_disparity(to_bytes(alpha[0]), to_bytes(right), max_disparity))
    image = classical_fusion(alpha, beta, max_disparity)
    return StereoResult(image, torch.where(disparity >= 0, disparity, torch.nan))


def regions_of(task: MonoColourTask) -> dict[str, Bool[Tensor, "h w"]]:
    """Where left's pixels are seen in right, occluded, beyond its left edge; and all but left columns."""
    h, w = hw_of(task.ground_truth)
    regions = {"whole": torch.ones(h, w, dtype=torch.bool)}
    regions["cropped"] = torch.arange(w).expand(h, w) >= LEFT_CROP
    return regions if task.disparity is None else regions | task.disparity.regions()._asdict()


def chroma_bound(task: MonoColourTask, rate: int) -> Float[Tensor, "3 h w"]:
    """Left's own colours reduced, then enlarged: what beta's resolution would allow if it stood at alpha."""
    luma, chroma = to_luma_chroma(task.ground_truth)
    small = interpolate(chroma[None], scale_factor=1 / rate, mode="area")
    return from_luma_chroma(luma, interpolate(small, luma.shape[1:], mode="bicubic", align_corners=False)[0])


def evaluate_conditions(
    pairs: Sequence[StereoPair],
    network: FusionNetwork,
    conditions: Iterable[str],
    *,
    progress: Callable[[Iterable[StereoPair], int], Iterable[StereoPair]] = lambda pairs, total: pairs,
) -> list[ConditionRow]:
    """Every method on every colour pair under every condition (`CONDITIONS`). Raises KeyError for others."""
    chosen = {name: CONDITIONS[name] for name in conditions}
    rows = []
    for pair in progress(pairs, len(pairs)):
        for name, condition in chosen.items():
            task = condition.recorded(pair)
            regions = regions_of(task)
            if condition == CONDITIONS["ideal"]:
                bound = StereoResult(chroma_bound(task, condition.rate))
                rows.append(_row((pair.name, name, "bound of beta's resolution"), bound, task, regions))
            for method, run in methods_of(network, condition.noise).items():
                result = run(task.alpha, task.beta, PAPER_DISPARITY)
                rows.append(_row((pair.name, name, method), result, task, regions))
    return rows


def _row(
    names: tuple[str, str, str], result: StereoResult, task: MonoColourTask, regions: Mapping[str, Tensor]
) -> ConditionRow:
    image, truth = result.image.clamp(0, 1), task.ground_truth
    error = (image - truth).square().mean(0)
    means = {n: float(error[region].mean()) for n, region in regions.items() if region.any()}
    psnr = {n: -10 * math.log10(max(mean, 1e-12)) for n, mean in means.items()}
    depth = depth_errors(result.disparity, task.disparity, regions)
    return ConditionRow(*names, score(image, truth).ssim, psnr, *depth)


def depth_errors(
    estimate: Tensor | None, ground_truth: Disparity | None, regions: Mapping[str, Tensor]
) -> tuple[float | None, tuple[float, float] | None]:
    """The end-point error, and shares within a pixel: of all with known ground truth, and of those seen.

    A pixel of unknown disparity is not within one pixel, and is left out of the end-point error.
    """
    if estimate is None or ground_truth is None:
        return None, None
    error, of_all = disparity_errors(estimate, ground_truth)
    _, of_seen = disparity_errors(estimate, Disparity(ground_truth.value, regions["seen"]))
    return error, None if of_all is None or of_seen is None else (of_all, of_seen)


def conditions_markdown(rows: Sequence[ConditionRow]) -> str:
    """PSNR / SSIM by condition and method with intervals of the gain over classical; regions; depth."""
    depth = "Depth, without noise or misalignment:"
    parts = _by_condition(rows), "By region, ideal:", "", _by_region(rows), depth, "", _depth(rows)
    return "\n".join(parts)


def _by_condition(rows: Sequence[ConditionRow]) -> str:
    methods = [m for m in grouped(rows, "method") if m != "bound of beta's resolution"]
    lines = []
    for name, own in grouped(rows, "condition").items():
        by_method = grouped(own, "method")
        cells = [_mean_cell(by_method.get(m, ())) for m in methods]
        gains = _gains(own)
        low, high = bootstrap_interval(gains)
        lines.append([name, *cells, f"{np.mean(gains):+.2f} ({low:+.2f} to {high:+.2f})"])
    return markdown_table(["condition", *methods, "fusion over classical, 95 %"], lines)


def _gains(rows: Sequence[ConditionRow]) -> list[float]:
    """Return the gains of fusion over classical, in one condition: decibels, pair by pair."""
    psnr = {(r.method, r.pair): r.psnr["whole"] for r in rows}
    return [value - psnr["classical", pair] for (method, pair), value in psnr.items() if method == "fusion"]


def _mean_cell(rows: Sequence[ConditionRow]) -> str:
    if not rows:
        return ""
    return f"{np.mean([r.psnr['whole'] for r in rows]):.2f} / {np.mean([r.ssim for r in rows]):.4f}"


def _by_region(rows: Sequence[ConditionRow]) -> str:
    ideal = [r for r in rows if r.condition == "ideal"]
    lines = []
    for method, ours in grouped(ideal, "method").items():
        values = [[r.psnr[region] for r in ours if region in r.psnr] for region in REGIONS]
        lines.append([method, *(f"{np.mean(v):.2f}" if v else "" for v in values)])
    names = ["whole", "seen by beta", "occluded", "beyond beta's edge"]
    return markdown_table(["PSNR", *names, f"without the left {LEFT_CROP} columns"], lines)


def _depth(rows: Sequence[ConditionRow]) -> str:
    """A table of errors of disparity under ideal conditions."""
    lines = []
    with_disparity = [r for r in rows if r.condition in ("ideal", "x1") and r.within_one is not None]
    for (condition, method), matching in grouped(with_disparity, "condition", "method").items():
        shares = [100 * float(np.mean([r.within_one[i] for r in matching if r.within_one])) for i in range(2)]
        errors = [r.end_point_error for r in matching if r.end_point_error is not None]
        name = "OpenCV's SGBM" if method == "classical" else method
        rate = f"x{CONDITIONS[condition].rate}"
        lines.append([rate, name, f"{np.mean(errors):.2f} px", *(f"{share:.1f} %" for share in shares)])
    columns = ["beta", "", "end-point error", "within 1 px, of all", "of those that beta sees"]
    return markdown_table(columns, lines)


Curves = Mapping[str, list[tuple[float, float]]]
"""Points (x, y) by name."""


def save_curves(plots: Mapping[str, Curves], path: Path, *, ylabel: str) -> None:
    """Curves in one figure, a plot beside the other by the title of its x axis, written atomically."""
    from matplotlib import colormaps

    figure = new_figure(figsize=(5 * len(plots), 4), layout="constrained")
    for i, (title, curves) in enumerate(plots.items()):
        axes = figure.add_subplot(1, len(plots), i + 1, xlabel=title, ylabel=ylabel)
        axes.set_prop_cycle(color=colormaps["tab20"](range(20)))
        for name, points in curves.items():
            axes.plot(*zip(*points), marker="o", label=name)
        axes.grid(alpha=0.3)
        axes.legend(loc="upper left", bbox_to_anchor=(1, 1))
    save_figure(figure, path)


def save_condition_curves(rows: Sequence[ConditionRow], path: Path) -> None:
    """A figure: mean PSNR against electrons at white, and against rows off, as far as evaluated."""
    conditions = {row.condition for row in rows}
    axes = {
        "electrons at white": {50: "50 electrons", 200: "200 electrons", 1000: "1000 electrons"},
        "rows off (px)": {0: "ideal", 1: "rows off 1 px", 3: "rows off 3 px"},
    }
    plots = {title: _curve(rows, named) for title, named in axes.items() if set(named.values()) <= conditions}
    if plots:
        save_curves(plots, path, ylabel="PSNR (dB)")


def _curve(rows: Sequence[ConditionRow], points: Mapping[int, str]) -> dict[str, list[tuple[float, float]]]:
    curves: dict[str, list[tuple[float, float]]] = {}
    for x, name in points.items():
        for method, own in grouped([r for r in rows if r.condition == name], "method").items():
            if method != "bound of beta's resolution":
                curves.setdefault(method, []).append((x, float(np.mean([r.psnr["whole"] for r in own]))))
    return curves
