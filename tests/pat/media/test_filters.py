"""Filters: local moments, means within squares, blurs; with and without gradients."""

import numpy as np
import pytest
import torch

from pat.media.filters import LocalMoments, blurred, box_mean


def image(seed: int, bands: int = 1) -> torch.Tensor:
    return torch.rand(2, bands, 20, 30, generator=torch.Generator().manual_seed(seed))


def test_local_moments_are_those_of_squares():
    bands, one = image(0, 3).double(), image(1).double()
    found = LocalMoments.within(2, bands, one)
    a, b = (p[0, 0, 5:10, 7:12].numpy() for p in (bands, one))
    covariance = np.cov(a.ravel(), b.ravel(), ddof=0)
    at = (0, 0, 7, 9)
    assert np.isclose(found.bands[at], a.mean())
    assert np.isclose(found.image[at], b.mean())
    assert np.allclose([found.variance_of_bands[at], found.variance_of_image[at]], covariance.diagonal())
    assert np.isclose(found.covariance[at], covariance[0, 1])
    assert np.isclose(found.slope(0.0)[at], covariance[0, 1] / covariance[1, 1])


def test_box_means_with_gradients_are_those_without():
    one = image(3)
    torch.testing.assert_close(box_mean(one.clone().requires_grad_(), 3).detach(), box_mean(one, 3))


@pytest.mark.parametrize("hw", [(40, 50), (9, 50), (3, 4), (1, 1)])
def test_images_that_want_gradients_are_blurred_alike(hw):
    images = torch.rand(3, 1, *hw)
    wanting = images.clone().requires_grad_()
    found = blurred(wanting, [0.0, 0.8, 3.0])
    torch.testing.assert_close(found.detach(), blurred(images, [0.0, 0.8, 3.0]), atol=1e-5, rtol=0)
    found.sum().backward()
    assert wanting.grad.isfinite().all()
