"""Gradients by a rig's numbers beside differences, and a rig found by them from one pair of images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from arraygeom import Camera, Curved, Distortion, Epipolar, Pair, Rig, Segments, sampling_locations
from arraygeom.pixels import shift_matrix
from pat.app.sample_array import ALPHA, BETA, SampleArray
from pat.attention import attend
from pat.fusion.fuse import FuseSettings, fuse_frame
from pat.fusion.steps import hw_at_alphas_resolution, of_size
from pat.lab.evaluation.tables import markdown_table
from pat.networks.paper import PAT
from pat.networks.protocol import FusionNetwork

UNITS: dict[str, tuple[str, float, int | None]] = {
    **{f"rotation {axis}": ("rotation", math.radians(1), i) for i, axis in enumerate("xyz")},
    **{f"translation {axis}": ("translation", 0.1, i) for i, axis in enumerate("xyz")},
    **{"focal length": ("focal", 0.01, None), "k1": ("distortion", 1.0, 0)},
}
"""Parameter of beta, unit and axis by name: degrees, tenths of the baseline, 1 % of the focal length, 1."""
AT, STEP = 0.07, 1e-3
"""Position and step of the differences, in these units; the step of k1 is ten times as large."""
POINTS = 8
"""Points within the step at which gradients of the paper's network are averaged."""
REACH = 10
"""Pixels of alpha within which a pixel of the paper's image depends on segments."""
BORDER = 8.0
"""Pixels of beta within which attention fades, in the rows that say so."""


def moved(rig: Rig, changes: dict[str, Tensor]) -> Rig:
    """Change beta by these multiples of `UNITS`."""
    camera, steps = rig.cameras[BETA], dict[str, Tensor]()
    assert isinstance(camera, Camera)
    if "k1" in changes and camera.distortion is None:
        lens = Distortion("brown-conrady", camera.t.new_zeros(4))
        rig = rig.with_camera(BETA, camera.replace(distortion=lens))
    sizes = {"translation": camera.t.norm(), "focal": camera.K[0, 0]}
    lengths = {"rotation": 3, "translation": 3, "focal": 2, "distortion": 4}
    for name, value in changes.items():
        kind, unit, axis = UNITS[name]
        ways = torch.eye(lengths[kind], dtype=torch.float64)
        step = value * unit * sizes.get(kind, 1.0) * (ways.sum(0) if axis is None else ways[axis])
        steps[f"{BETA}.{kind}"] = steps.get(f"{BETA}.{kind}", torch.zeros(())) + step
    return rig.perturbed(steps)


class GradientRow(NamedTuple):
    """Gradient and difference of the mean squared error of the image, per unit, in a region of alpha."""

    network: str
    parameter: str
    region: str
    gradient: float
    difference: float

    @property
    def off(self) -> float:
        """Distance of the gradient from the difference, as a share of the latter."""
        return abs(self.gradient - self.difference) / max(abs(self.difference), 1e-12)


def cropped(sample: SampleArray) -> SampleArray:
    """Keep a window of alpha, and less of beta than it would need: segments cross beta's border."""
    (top, left, h, w), (beta_top, beta_left, bh, bw) = (120, 200, 128, 160), (125, 150, 96, 112)
    rig = sample.rig.crop(ALPHA, top, left, (h, w)).crop(BETA, beta_top, beta_left, (bh, bw))
    window = (..., slice(top, top + h), slice(left, left + w))
    of_beta = sample.images[BETA][:, beta_top : beta_top + bh, beta_left : beta_left + bw]
    return SampleArray(rig, {ALPHA: sample.images[ALPHA][window], BETA: of_beta}, sample.ground_truth[window])


def regions(rig: Rig) -> dict[str, Tensor]:
    """Mark alpha's pixels (h, w) around which all segments are in beta, and those around segments that cross
    its border."""
    pair, margin = rig.pair(ALPHA, BETA), 200
    (h, w), field = pair.beta.hw, Epipolar()
    around = pair.transform_beta(shift_matrix(-margin, -margin), (h + 2 * margin, w + 2 * margin))
    here, whole = (sampling_locations(field, one) for one in (pair, around))
    assert isinstance(here, Segments)
    assert isinstance(whole, Segments)
    kept = here.valid & ((here.length - whole.length).abs() < 1e-2)

    def near(mask: Tensor) -> Tensor:
        return max_pool2d(mask.float()[None, None], 2 * REACH + 1, 1, REACH)[0, 0] > 0

    crossing = near(here.valid & ~kept) | (near(~here.valid) & near(here.valid))
    return {"interior": ~near(~kept), "border": crossing}


def gradient_rows(
    networks: dict[str, FusionNetwork], sample: SampleArray, parameters: Sequence[str]
) -> list[GradientRow]:
    """Compare gradients of `fuse(differentiable=True)` with differences: by network, parameter and region.

    A difference is a mean over its step. So are the gradients of the paper's network, in float64; others are
    taken in the middle.
    """
    rows, masks = [], regions(sample.rig)
    settings = FuseSettings(align=False, response="rec601")

    def errors(
        network: FusionNetwork, name: str, by: Tensor, *, differentiable: bool = False
    ) -> list[Tensor]:
        rig, dtype = (
            moved(sample.rig, {name: by}),
            torch.float64 if isinstance(network, PAT) else torch.float32,
        )
        images = {camera: image.to(dtype) for camera, image in sample.images.items()}
        frame = fuse_frame(
            images, rig, alpha=ALPHA, network=network, settings=settings, differentiable=differentiable
        )
        error = (frame.image - sample.ground_truth).double().square().mean(0)
        return [error[mask].mean() for mask in masks.values()]

    def gradients(network: FusionNetwork, name: str, at: float) -> list[float]:
        by = torch.tensor(at, dtype=torch.float64, requires_grad=True)
        found = errors(network, name, by, differentiable=True)
        return [float(torch.autograd.grad(error, by, retain_graph=True)[0]) for error in found]

    for title, network in networks.items():
        network, points = (network.double(), POINTS) if isinstance(network, PAT) else (network, 1)
        for name in parameters:
            step = 10 * STEP if name == "k1" else STEP
            offsets = [step * ((2 * i + 1) / points - 1) for i in range(points)]
            each = [gradients(network, name, AT + offset) for offset in offsets]
            ends = (errors(network, name, torch.tensor(AT + s, dtype=torch.float64)) for s in (step, -step))
            for region, slopes, after, before in zip(masks, zip(*each), *ends):
                difference = float(after - before) / (2 * step)
                rows.append(GradientRow(title, name, region, sum(slopes) / points, difference))
    return rows


def found_rig(
    network: PAT, sample: SampleArray, names: Sequence[str], *, stride: int = 4, steps: int = 60
) -> Tensor:
    """Find beta's true numbers from a pair of images: the rig under which attention's score is largest.

    Features are computed once: they do not depend on the rig. The score is that of alpha's query and the key
    that attention gathers along the segments; L-BFGS maximises its mean over every `stride`-th pixel.

    Args:
        names: parameters that are wrong at first, as `WRONG` says.

    Returns:
        The share of each error that is left.
    """
    hw = hw_at_alphas_resolution(sample.rig.pair(ALPHA, BETA))
    rig = sample.rig.resize(BETA, hw)
    with torch.no_grad():
        query = network.query_and_key(sample.images[ALPHA][None]).query
        key = network.query_and_key(of_size(sample.images[BETA], hw)[None]).key
    ys, xs = (torch.arange(2 * stride, side - 2 * stride, stride) for side in query.shape[2:])
    query, x = query[..., ys[:, None], xs], torch.stack(torch.meshgrid(xs, ys, indexing="xy"), -1).double()
    left = torch.ones(len(names), dtype=torch.float64, requires_grad=True)

    def loss() -> Tensor:
        optimiser.zero_grad()
        pair = moved(rig, {name: WRONG[name] * share for name, share in zip(names, left)}).pair(ALPHA, BETA)
        value = -mean_score(pair, query, key, x)
        value.backward()
        return value

    optimiser = torch.optim.LBFGS([left], max_iter=steps, line_search_fn="strong_wolfe")
    optimiser.step(loss)
    return left.detach()


def mean_score(pair: Pair, query: Tensor, key: Tensor, x: Tensor) -> Tensor:
    """Compute the mean inner product of queries with the keys that attention gathers for pixels x."""
    field = Curved(96, nodes=16) if pair.has_lens else Epipolar()
    locations = sampling_locations(field, pair, x)
    samples = 96 if isinstance(locations, Segments) else None
    return (query * attend(query, key, key, locations, samples=samples, border=4.0)).sum(1).mean()


WRONG = dict.fromkeys(("rotation x", "rotation y", "rotation z"), 0.3)
WRONG |= {"translation y": 0.5, "translation z": 0.5, "focal length": 1.0, "k1": 0.03}
"""Units by which each parameter is wrong at first: translations turn the baseline by 3 degrees."""
RECOVERED = [*((name,) for name in WRONG), ("rotation x", "rotation y", "rotation z"), tuple(WRONG)]
"""Sets of parameters that are wrong together."""


def gradients_markdown(rows: Sequence[GradientRow]) -> str:
    """Make the table of gradients: percent by which each is off the difference, by region."""
    lines = []
    for network, parameter in dict.fromkeys((row.network, row.parameter) for row in rows):
        mine = {row.region: row for row in rows if row[:2] == (network, parameter)}
        cells = (
            f"{row.gradient:.3g} | {row.difference:.3g} | {100 * row.off:.1f} %" for row in mine.values()
        )
        lines.append([network, parameter, *" | ".join(cells).split(" | ")])
    parts = ("gradient", "difference", "off")
    columns = [f"{region}, {part}" for region in ("interior", "border") for part in parts]
    return markdown_table(["network", "parameter", *columns], lines)


def recovered_markdown(network: PAT, sample: SampleArray) -> str:
    """Make the table of what is left of wrong numbers."""
    lines = []
    for names in RECOVERED:
        left = ", ".join(f"{100 * abs(float(share)):.0f} %" for share in found_rig(network, sample, names))
        lines.append([", ".join(names), ", ".join(f"{WRONG[name]:g}" for name in names), left])
    return markdown_table(["wrong", "by, units", "left of each"], lines)
