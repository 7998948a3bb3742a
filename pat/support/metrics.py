"""Image quality (PSNR, SSIM), and the confidence interval of a mean."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from skimage.metrics import structural_similarity
from torch import Tensor

SSIM_WINDOW = 11
"""Side of the SSIM window in pixels: a Gaussian of sigma 1.5 cut at 3.5 sigma."""


class Score(NamedTuple):
    """Quality of an image against its ground truth.

    Attributes:
        psnr: peak signal-to-noise ratio in dB for a peak of 1; infinite for equal images.
        ssim: structural similarity; 1 for equal images.
    """

    psnr: float
    ssim: float


def score(image: Float[Tensor, "_ _ _"], ground_truth: Float[Tensor, "_ _ _"]) -> Score:
    """Compute PSNR over all channels, and scikit-image's SSIM averaged over channels.

    Args:
        image: (c, h, w), values 0..1; nothing is clipped or rounded.
        ground_truth: image of the same shape.

    Returns:
        PSNR in dB, infinite for equal images, and SSIM of Wang et al. 2004: Gaussian window of sigma 1.5 (11
        x 11), K1 = 0.01, K2 = 0.03, population covariance. NaN values give NaN. No gradient.

    Raises:
        ValueError: if the shapes differ, or a side is under 11 pixels.
    """
    if image.shape != ground_truth.shape:
        got, wanted = tuple(image.shape), tuple(ground_truth.shape)
        raise ValueError(f"the image is {got} and the ground truth {wanted}: give equal shapes")
    if min(image.shape[-2:]) < SSIM_WINDOW:
        raise ValueError(f"SSIM needs sides of {SSIM_WINDOW} pixels or more, got {tuple(image.shape[-2:])}")
    values, true_values = (x.detach().cpu().double().numpy() for x in (image, ground_truth))
    with np.errstate(divide="ignore"):
        psnr = -10 * np.log10(np.square(values - true_values).mean())
    how = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    ssim = structural_similarity(true_values, values, data_range=1, channel_axis=0, **how)
    return Score(float(psnr), float(ssim))


def bootstrap_interval(values: Sequence[float]) -> tuple[float, float]:
    """Compute the 95 % percentile bootstrap interval of a mean (Efron & Tibshirani 1993, section 13.3).

    Returns:
        Lower and upper bound from 10,000 resamples with a fixed seed; (nan, nan) for fewer than two values,
        or if one is NaN; either may be infinite or NaN if a value is infinite.
    """
    if len(values) < 2:
        return math.nan, math.nan
    drawn = np.random.default_rng(0).choice(np.asarray(values, float), (10_000, len(values)))
    low, high = np.quantile(drawn.mean(1), [0.025, 0.975])
    return float(low), float(high)
