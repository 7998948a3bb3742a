"""Moments of images: whole, where a weight is, and local."""

import numpy as np
import pytest
import torch

from pat.matching.normalisation import Moments, equalising_blurs, mean_moments, moments, normalised
from pat.media.filters import LocalMoments, blurred, box_mean


def image(seed: int, bands: int = 1) -> torch.Tensor:
    return torch.rand(2, bands, 20, 30, generator=torch.Generator().manual_seed(seed))


def test_moments_are_numpys_also_where_the_weight_is():
    one, weight = image(0), (image(1) > 0.6).float()
    whole, part = moments(one), moments(one, weight)
    for i in range(2):
        values = one[i].numpy()
        here = values[weight[i].numpy() > 0]
        assert np.allclose([float(p[i]) for p in whole], [values.mean(), values.std(ddof=1)], atol=1e-6)
        assert np.allclose([float(p[i]) for p in part], [here.mean(), here.std()], atol=1e-5)
    nowhere = moments(one, 0 * weight)
    torch.testing.assert_close(nowhere.mean, whole.mean)


def test_an_image_gets_the_mean_and_the_deviation_of_another():
    one, other = image(0, 3), 0.2 * image(1) + 0.5
    for found, wanted in zip(moments(normalised(one, other)), moments(other)):
        torch.testing.assert_close(found, wanted)
    torch.testing.assert_close(normalised(normalised(one, other), one), one)
    weak = normalised(0.01 * one, one, largest_gain=4.0)
    torch.testing.assert_close(moments(weak).deviation, 0.04 * moments(one).deviation)
    assert normalised(0 * one, other).isfinite().all()


def test_moments_of_several_images_are_averaged():
    found = mean_moments([image(0)[0], image(1)[0]])
    expected = Moments(*(torch.stack(p).mean(0) for p in zip(moments(image(0)[0]), moments(image(1)[0]))))
    torch.testing.assert_close(found, expected)


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


def test_images_of_few_rows_are_as_sharp_as_their_columns_are():
    """Less than three pairs of rows have no second difference."""
    one = torch.rand(1, 1, 4, 40, generator=torch.Generator().manual_seed(0))
    assert equalising_blurs(one, one) == ([0.0], [0.0])
    (own,), (other,) = equalising_blurs(one, 0.3 * one)
    assert 0 < own < 3
    assert other == 0


@pytest.mark.parametrize("hw", [(40, 50), (9, 50), (3, 4), (1, 1)])
def test_images_that_want_gradients_are_blurred_alike(hw):
    images = torch.rand(3, 1, *hw)
    wanting = images.clone().requires_grad_()
    found = blurred(wanting, [0.0, 0.8, 3.0])
    torch.testing.assert_close(found.detach(), blurred(images, [0.0, 0.8, 3.0]), atol=1e-5, rtol=0)
    found.sum().backward()
    assert wanting.grad.isfinite().all()
