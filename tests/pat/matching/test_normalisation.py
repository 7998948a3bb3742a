"""Moments of images, whole and where a weight is; their sharpness."""

import numpy as np
import torch

from pat.matching.normalisation import Moments, equalising_blurs, mean_moments, moments, normalised


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


def test_images_of_few_rows_are_as_sharp_as_their_columns_are():
    """Less than three pairs of rows have no second difference."""
    one = torch.rand(1, 1, 4, 40, generator=torch.Generator().manual_seed(0))
    assert equalising_blurs(one, one) == ([0.0], [0.0])
    (own,), (other,) = equalising_blurs(one, 0.3 * one)
    assert 0 < own < 3
    assert other == 0
