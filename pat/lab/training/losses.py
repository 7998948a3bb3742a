"""Training losses and validation metrics."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn.functional import mse_loss

from pat.attention.scores import Compared, peak_position
from pat.networks.paper import PAT
from pat.networks.protocol import Comparing, FusionNetwork, FusionOutput, fused_at_once

from .attention_loss import attention_loss
from .samples import Sample


def image_loss(image: Tensor, ground_truth: Tensor) -> Tensor:
    """Compute minus a tenth of the mean PSNR of images (b, c, h, w) in 0..1, with a floor of 1e-5 on the
    error.

    Returns:
        A scalar; every image has the same weight.
    """
    return ((image - ground_truth).square().flatten(1).mean(1) + 1e-5).log10().mean()


IMAGE_LOSSES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {"psnr": image_loss, "mse": mse_loss}


class Objective(nn.Module):
    """Network and its loss in one module, so that DistributedDataParallel sees one forward.

    Args:
        network: network in training.
        loss: name of the image loss, "psnr" or "mse"; others raise KeyError.
        attention: weight of the attention loss; 0 leaves it out.
    """

    def __init__(self, network: PAT, loss: str, *, attention: float = 0.0) -> None:
        super().__init__()
        self.network = network
        self.image_loss = IMAGE_LOSSES[loss]
        self.attention = attention

    def forward(self, sample: Sample) -> Tensor:
        """Compute the loss of a group of samples.

        Returns:
            A scalar, with gradient: the image loss plus `attention` times the attention loss.

        Raises:
            ValueError: for samples that do not fit the network, and an attention loss without segments.
        """
        if not self.attention:
            return self.image_loss(self.network(sample.inputs).image, sample.ground_truth)
        fused, compared = self.network.compare(sample.inputs)
        where = attention_loss(compared, sample.position, sample.visible)
        return self.image_loss(fused.image, sample.ground_truth) + self.attention * where


@torch.no_grad()
def validation(network: FusionNetwork, samples: list[Sample]) -> dict[str, float]:
    """Measure a network on validation samples, matches by the first beta of each.

    Args:
        samples: groups of samples.

    Returns:
        Means over the groups by name: "psnr" of images clipped to 0..1, in dB, each sample's at most 80;
        "matched", the share of visible pixels whose match is within 1.5 pixels of beta; and "peaks", the
        share whose largest weight is within one pixel, only for networks that are `Comparing` and fields of
        segments. The last two leave out groups without a visible pixel, and are NaN if all are.

    Raises:
        ValueError: for no samples.
    """
    if not samples:
        raise ValueError("no samples to validate on: give one group or more")
    psnr, near, peaks = [], [], []
    for sample in samples:
        fused, compared = _compared(network, sample)
        error = (fused.image.clamp(0, 1) - sample.ground_truth).square().flatten(1).mean(1)
        psnr.append(-10 * error.clamp(min=1e-8).log10().mean())
        for where, visible in list(zip(sample.position, sample.visible))[:1]:
            off = (fused.position[0] - where.movedim(-1, 1)).norm(dim=1)
            near.append((off[visible] < 1.5).float().mean())
            for one in compared[:1]:
                off = (peak_position(one) - where.movedim(-1, 1)).norm(dim=1)
                peaks.append((off[visible] <= 1).float().mean())
    matched = float(torch.stack(near).nanmean()) if near else math.nan
    metrics = {"peaks": float(torch.stack(peaks).nanmean())} if peaks else {}
    return {"psnr": float(torch.stack(psnr).mean()), "matched": matched} | metrics


def _compared(network: FusionNetwork, sample: Sample) -> tuple[FusionOutput, list[Compared]]:
    if isinstance(network, Comparing) and sample.fields[0].pixels is not None:
        return network.compare(sample.inputs)
    return fused_at_once(network, sample.inputs), []
