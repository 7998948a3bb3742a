import math

import numpy as np
import pytest
import torch
from scipy import ndimage, stats

from pat.lab.data.pairs import Disparity
from pat.lab.evaluation.stereo import disparity_errors
from pat.support.metrics import bootstrap_interval, score


def ssim_of_wang(a, b):
    """Equation 13 of Wang et al. 2004, averaged away from the border."""
    mean = lambda x: ndimage.gaussian_filter(x, 1.5, truncate=3.5)  # noqa: E731
    var_a, var_b, cov = (
        mean(a * a) - mean(a) ** 2,
        mean(b * b) - mean(b) ** 2,
        mean(a * b) - mean(a) * mean(b),
    )
    c1, c2 = 0.01**2, 0.03**2
    index = (2 * mean(a) * mean(b) + c1) * (2 * cov + c2)
    index /= (mean(a) ** 2 + mean(b) ** 2 + c1) * (var_a + var_b + c2)
    return index[5:-5, 5:-5].mean()


def test_psnr_is_the_closed_form():
    ground_truth = torch.rand(3, 20, 30)
    assert score(ground_truth + 0.1, ground_truth).psnr == pytest.approx(20, abs=1e-5)


def test_ssim_is_wangs():
    rng = np.random.default_rng(0)
    a, b = rng.random((2, 3, 40, 50))
    b = 0.7 * a + 0.3 * b
    expected = np.mean([ssim_of_wang(x, y) for x, y in zip(a, b)])
    assert score(torch.from_numpy(b), torch.from_numpy(a)).ssim == pytest.approx(expected, abs=1e-9)


def test_equal_images_score_best():
    image = torch.rand(1, 11, 11)
    assert score(image, image) == (math.inf, 1.0)


@pytest.mark.parametrize(("shape", "complaint"), [((3, 20, 21), "shapes"), ((3, 20, 10), "11 pixels")])
def test_what_cannot_be_compared_is_refused(shape, complaint):
    ground_truth = torch.rand(3, 20, 20 if complaint == "equal shapes" else 10)
    with pytest.raises(ValueError, match=complaint):
        score(torch.rand(shape), ground_truth)


def test_disparity_errors_count_only_where_valid():
    ground_truth = torch.zeros(2, 2)
    found = torch.tensor([[0.5, 1.0], [4.5, 100.0]])
    valid = torch.tensor([[True, True], [True, False]])
    assert disparity_errors(found, Disparity(ground_truth, valid)) == pytest.approx((2.0, 2 / 3))
    assert disparity_errors(found, Disparity(ground_truth, torch.zeros_like(valid))) == (None, None)


def test_the_interval_of_a_mean_is_scipys():
    values = np.random.default_rng(1).normal(30, 2, 25).tolist()
    theirs = stats.bootstrap(
        (values,), np.mean, n_resamples=20_000, method="percentile", rng=np.random.default_rng(2)
    ).confidence_interval
    assert bootstrap_interval(values) == pytest.approx(tuple(theirs), abs=0.05)
    assert bootstrap_interval(values) == bootstrap_interval(values)


def test_one_value_has_no_interval():
    assert all(math.isnan(x) for x in bootstrap_interval([30.0]))
