from dataclasses import replace

import pytest
import torch
from torch.nn.functional import interpolate, pad

from pat.data import StereoPair
from pat.data.pairs import Disparity
from pat.evaluation.protocols import AuthorsRows, halved, mono_colour_task, rectified_rig, reduce_by
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
    alpha, beta, ground_truth = mono_colour_task(pair, 4)
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
    with pytest.raises(ValueError, match="divides both sides"):
        reduce_by(torch.rand(3, 12, 12), rate)


def test_authors_rows_are_those_of_their_loader():
    """`arange(j - 80, j)` from column 80 on, columns 0 to 79 before: zero disparity is never among them."""
    hw = (4, 200)
    pair = rectified_rig(hw, {"beta": hw}, 80.0).pair("alpha", "beta")
    x = torch.tensor([[90.0, 2.0], [80.0, 0.0], [13.0, 3.0]])
    found = AuthorsRows()(pair, x)
    for (j, i), columns, rows in zip(x.tolist(), found.xy[..., 0], found.xy[..., 1]):
        wanted = torch.arange(j - 80, j) if j >= 80 else torch.arange(80.0)
        torch.testing.assert_close(columns, wanted)
        assert (rows == i).all()
    assert found.mask.all()
    with pytest.raises(ValueError, match="resize beta"):
        AuthorsRows()(rectified_rig(hw, {"beta": (2, 100)}, 80.0).pair("alpha", "beta"), x)


def test_halved_pairs_keep_the_point_at_its_disparity():
    """A smooth picture shifted by 6: at half the size by 3, with the same truth."""
    g = torch.Generator().manual_seed(0)
    wide = interpolate(torch.rand(1, 3, 6, 12, generator=g), size=(40, 86), mode="bicubic")[0]
    wide = wide.clamp(0, 1)
    truth = Disparity(torch.full((41, 81), 6.0), torch.ones(41, 81, dtype=torch.bool))
    whole = StereoPair("made", *(pad(v, (0, 1, 0, 1)) for v in (wide[..., :80], wide[..., 6:])))
    small = halved(replace(whole, disparity=truth))
    assert small.left.shape == small.right.shape == (3, 20, 40)
    assert small.disparity.value.shape == (20, 40)
    assert (small.disparity.value == 3).all()
    torch.testing.assert_close(small.left[..., 5:35], small.right[..., 2:32], atol=0.02, rtol=0)
