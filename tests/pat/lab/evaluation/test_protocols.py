import pytest
import torch

from pat.lab.data import StereoPair
from pat.lab.evaluation.protocols import mono_colour_task, rectified_rig
from pat.media.colour import luminance


def test_a_task_is_grey_alpha_small_colour_beta_and_colour_ground_truth():
    pair = StereoPair("a", torch.rand(3, 13, 22), torch.rand(3, 13, 22))
    alpha, beta, ground_truth, _ = mono_colour_task(pair, 4)
    torch.testing.assert_close(ground_truth, pair.left[:, :12, :20])
    torch.testing.assert_close(alpha, luminance(ground_truth))
    assert beta.shape == (3, 3, 5)
    torch.testing.assert_close(beta[:, 0, 1], pair.right[:, :4, 4:8].mean((1, 2)))


@pytest.mark.parametrize(
    ("left", "right", "complaint"),
    [
        ((1, 8, 8), (1, 8, 8), "colour"),
        ((3, 8, 8), (3, 8, 9), "equal"),
        ((3, 1, 8), (3, 1, 8), r"\(1, 8\)"),
    ],
)
def test_pairs_that_cannot_serve_are_named(left, right, complaint):
    with pytest.raises(ValueError, match=f"tools: .*{complaint}"):
        mono_colour_task(StereoPair("tools", torch.rand(left), torch.rand(right)), 2)


def test_a_rig_without_disparity_is_refused():
    with pytest.raises(ValueError, match="max_disparity"):
        rectified_rig((8, 8), {"beta": (8, 8)}, 0)
