"""The paper's own tables: its protocols, printed figures, its code's fields, controls that must score less.

`table1` is mono + colour (its Table 1). `table2` is mono + three bands (its Table 2): the bands of right are
three cameras, each of one channel.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import Pair, Positions, ReceptiveField, Rectified, Segments
from pat import FuseSettings, fuse
from pat.app.from_images import found_rig
from pat.app.sample_array import BETA, SAMPLE
from pat.fusion.steps import of_size
from pat.lab.data.pairs import Disparity, StereoPair
from pat.lab.evaluation.protocols import StereoMethod, StereoResult, cut_to_multiple, hw_of, rectified_fusion
from pat.lab.evaluation.stereo import StereoRow
from pat.media.images import read_image
from pat.networks.protocol import FusionNetwork
from pat.networks.weights import Network

PRINTED = {
    "table1": {
        "flickr1024": {2: (27.26, 0.8992), 4: (25.85, 0.8840)},
        "kitti": {2: (29.55, 0.9097), 4: (28.40, 0.8957)},
    },
    "table2": {
        "flickr1024": {2: (25.55, 0.8714), 4: (24.00, 0.8493)},
        "kitti": {2: (28.77, 0.8955), 4: (28.13, 0.8903)},
    },
}
"""PSNR and SSIM of fusion as the paper prints them, by protocol, data set, rate; on its choice of images."""


def halved(pair: StereoPair) -> StereoPair:
    """The pair at half the size (cubic, as MATLAB's), as the paper's code tests: its "x2" and its "x4"."""
    hw = pair.left.shape[-2] // 2, pair.left.shape[-1] // 2
    disparity = None
    if pair.disparity is not None:
        value, valid = (t[: 2 * hw[0] : 2, : 2 * hw[1] : 2] for t in pair.disparity)
        disparity = Disparity(value / 2, valid)

    left, right = (of_size(cut_to_multiple(image, 2), hw) for image in (pair.left, pair.right))
    return replace(pair, left=left, right=right, disparity=disparity)


@dataclass(frozen=True)
class AuthorsRows:
    """Rows of the paper's test loader: `arange(j - 80, j)` in column j; columns 0 to 79 in the first 80.

    The pixel itself, zero disparity, is not among them.
    """

    length: int = 80

    def __call__(self, pair: Pair, x: Float[Tensor, "*n 2"]) -> Positions:
        """Integer positions in beta's pixels. Raises ValueError for views of unequal sizes."""
        if pair.alpha.hw != pair.beta.hw:
            sizes = f"alpha is {pair.alpha.hw}, beta {pair.beta.hw}"
            raise ValueError(f"the authors' rows need views of one size, and {sizes}: resize beta")
        column = x[..., :1].round()
        first = (column - self.length).clamp(min=0)
        columns = first + torch.arange(self.length, dtype=x.dtype, device=x.device)
        xy = torch.stack([columns, x[..., 1:].round().expand_as(columns)], -1)
        return Positions(xy, columns < pair.beta.hw[1])


@dataclass(frozen=True)
class ShuffledField:
    """A field in which each alpha pixel has another one's segment: the same segments, wrongly assigned."""

    field: ReceptiveField

    def __call__(self, pair: Pair, x: Float[Tensor, "*n 2"]) -> Segments | Positions:
        """The segments of the pixels to which a random permutation takes x."""
        h, w = pair.alpha.hw
        order = torch.randperm(h * w, generator=torch.Generator().manual_seed(0)).to(x.device)
        column, row = x[..., 0].round().long().clamp(0, w - 1), x[..., 1].round().long().clamp(0, h - 1)
        drawn = order[row * w + column]
        return self.field(pair, torch.stack([drawn % w, drawn // w], -1).to(x))


def controls(network: FusionNetwork, *, bands: bool = False) -> dict[str, StereoMethod]:
    """Return the controls that fusion must beat if it uses beta: no beta (zeros), beta of another scene,
    shuffled fields."""
    other = read_image(SAMPLE / f"{BETA}.png")
    fusion = rectified_fusion(network, bands=bands)

    def shuffled(alpha: Tensor, beta: Tensor, max_disparity: float) -> StereoResult:
        field = ShuffledField(Rectified(max_disparity, alpha_is="left"))
        fused = rectified_fusion(network, bands=bands, settings=FuseSettings(field=field))
        return fused(alpha, beta, max_disparity)

    return {
        "no beta": lambda alpha, beta, most: fusion(alpha, torch.zeros_like(beta), most),
        "another scene's beta": lambda alpha, beta, most: fusion(alpha, of_size(other, hw_of(beta)), most),
        "shuffled fields": shuffled,
    }


def with_found_rig(network: Network) -> StereoMethod:
    """The fusion of two images with the rig found from them."""

    def fused(alpha: Tensor, beta: Tensor, max_disparity: float) -> StereoResult:
        images = {"alpha": alpha, "beta": beta}
        rig, _ = found_rig(images, "alpha", {}, network.bands, lambda line: None)
        return StereoResult(fuse(images, rig, alpha="alpha", network=network).image)

    return fused


def falls(rows: Sequence[StereoRow], *, names: Iterable[str]) -> str:
    """A line for each of `names`: its mean PSNR against the fusion's, and the extremes over the images."""
    psnr = {(row.pair, row.rate, row.method): row.psnr for row in rows}
    lines = []
    for name in names:
        gains = [psnr[pair, rate, name] - value for (pair, rate, m), value in psnr.items() if m == "fusion"]
        line = f"{np.mean(gains):+.2f} dB against fusion, {min(gains):+.2f} to {max(gains):+.2f}"
        lines.append(f"- {name}: {line}\n")
    return "".join(lines)
