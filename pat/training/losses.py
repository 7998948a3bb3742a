"""What training minimises, and what tells how far it is."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, binary_cross_entropy_with_logits, mse_loss, smooth_l1_loss

from pat.bandwise import BandwisePAT
from pat.guided import COARSE, GuidedPAT, Match
from pat.model import Fused
from pat.weights import Network

from .samples import Sample


def picture_loss(image: Tensor, truth: Tensor) -> Tensor:
    """Minus the mean PSNR over 10, but for a floor under the error: every sample pulls alike."""
    return ((image - truth).square().flatten(1).mean(1) + 1e-5).log10().mean()


PICTURE_LOSSES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {"psnr": picture_loss, "mse": mse_loss}


class Objective(nn.Module):
    """A network and its loss in one module, so that DistributedDataParallel sees one forward."""

    def __init__(self, network: Network, loss: str) -> None:
        super().__init__()
        self.network = network
        self.picture_loss = PICTURE_LOSSES[loss]

    def forward(self, given: Sample) -> Tensor:
        """The loss of a group of samples."""
        fused, matches = explained(self.network, given)
        loss = self.picture_loss(fused.image, given.truth)
        return loss + match_loss(fused, matches, given) if matches else loss


def explained(network: nn.Module, given: Sample) -> tuple[Fused, list[Match]]:
    """The network's answer, and its first look where it tells of one."""
    if isinstance(network, (GuidedPAT, BandwisePAT)):
        return network.explain(given.alpha, given.betas, given.looks)
    return network(given.alpha, given.betas, given.looks), []


def match_loss(fused: Fused, matches: list[Match], given: Sample) -> Tensor:
    """How far off the looks were where beta sees the point, pixels, and how wrong the confidence."""
    total = fused.image.new_zeros(())
    for i, match in enumerate(matches):
        near = given.position[i].movedim(-1, 1)
        seen = given.visible[i][:, None]
        coarse = avg_pool2d(near, COARSE)
        all_seen = avg_pool2d(seen.float(), COARSE)
        error = smooth_l1_loss(match.position, coarse, reduction="none", beta=2.0).sum(1, keepdim=True)
        weight = 0.1 + 0.9 * all_seen
        total = total + 0.02 * (error.clamp(max=40) * weight).sum() / weight.sum()
        fine = (fused.position[i] - near).abs().sum(1, keepdim=True).clamp(max=6.0)
        total = total + 0.02 * (fine * seen).sum() / seen.sum().clamp(min=1)
        good = all_seen * ((match.position - coarse).square().sum(1, keepdim=True) < 9).float()
        total = total + 0.1 * binary_cross_entropy_with_logits(match.logit, good.detach())
    return total / len(matches)


@torch.no_grad()
def validation(network: nn.Module, samples: list[Sample]) -> dict[str, float]:
    """Mean PSNR, and the share of visible pixels matched within a pixel and a half."""
    psnr, near = [], []
    for given in samples:
        fused = network(given.alpha, given.betas, given.looks)
        error = (fused.image.clamp(0, 1) - given.truth).square().flatten(1).mean(1)
        psnr.append(-10 * error.clamp(min=1e-8).log10().mean())
        off = (fused.position[0] - given.position[0].movedim(-1, 1)).norm(dim=1)
        near.append((off[given.visible[0]] < 1.5).float().mean())
    return {"psnr": float(torch.stack(psnr).mean()), "matched": float(torch.stack(near).mean())}
