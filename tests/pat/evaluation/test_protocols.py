import pytest
import torch

from pat.data import StereoPair
from pat.evaluation.protocols import mono_colour_task, reduce_by
from pat.media.colour import luminance


def edge(width, x):
    """White right of `x`, in pixels with 0 the centre of the first, and black left of it."""
    columns = torch.arange(width)
    return (columns + 0.5 - x).clamp(0, 1).expand(1, 12, width)


def edge_position(image):
    """Where the edge of `edge` is, from the share of white."""
    return image.shape[2] - 0.5 - float(image[0, 0].sum())


@pytest.mark.parametrize("rate", [1, 2, 3, 4])
@pytest.mark.parametrize("x", [7.5, 10.0, 11.25])
def test_reducing_keeps_the_centre_convention(rate, x):
    assert edge_position(edge(24, x)) == pytest.approx(x)
    assert edge_position(reduce_by(edge(24, x), rate)) == pytest.approx((x + 0.5) / rate - 0.5)


def test_a_task_is_grey_alpha_small_colour_beta_and_colour_ground_truth():
    pair = StereoPair("a", torch.rand(3, 13, 22), torch.rand(3, 13, 22))
    alpha, beta, ground_truth, _ = mono_colour_task(pair, 4)
    torch.testing.assert_close(ground_truth, pair.left[:, :12, :20])
    torch.testing.assert_close(alpha, luminance(ground_truth))
    assert beta.shape == (3, 3, 5)
    torch.testing.assert_close(beta[:, 0, 1], pair.right[:, :4, 4:8].mean((1, 2)))


@pytest.mark.parametrize(
    ("left", "right", "complaint"), [((1, 8, 8), (1, 8, 8), "colour"), ((3, 8, 8), (3, 8, 9), "equal sizes")]
)
def test_pairs_that_cannot_serve_are_named(left, right, complaint):
    with pytest.raises(ValueError, match=f"tools: .*{complaint}"):
        mono_colour_task(StereoPair("tools", torch.rand(left), torch.rand(right)), 2)


@pytest.mark.parametrize("rate", [0, 5])
def test_a_rate_that_does_not_divide_is_refused(rate):
    with pytest.raises(ValueError, match="divisor of both sides"):
        reduce_by(torch.rand(3, 12, 12), rate)
