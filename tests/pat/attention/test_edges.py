"""Halves, and numbers of samples that depend on the data: attention at the edges of what it takes."""

import pytest
import torch

from arraygeom import Epipolar, Positions, Segments, sample
from pat.attention import attend
from tests.arraygeom.rigs import random_rig
from tests.arraygeom.test_precision import WHOLE


@pytest.mark.parametrize("width", [6, 7, 4000, 12_000])
def test_the_nearest_pixel_of_halves_is_the_same_everywhere(width):
    """Attention takes the pixel on whose area a position lies; `sample` rounded halves either way."""
    image = torch.arange(width, dtype=torch.float32).expand(1, 1, 1, width)
    halves = torch.arange(width - 1, dtype=torch.float32)[-50:] + 0.5
    x = torch.stack([halves, torch.zeros_like(halves)], -1)
    found = sample(image, x[None], interpolation="nearest").values[0, 0]
    assert found.equal(halves + 0.5)
    where = Positions(x[None, :, None], torch.ones(1, len(x), 1, dtype=torch.bool))
    query = torch.ones(1, 1, 1, len(x))
    assert attend(query, torch.ones_like(image), image, where, interpolation="nearest").flatten().equal(found)


def test_a_number_of_samples_by_the_longest_segment_cannot_be_traced():
    segments = Epipolar()(random_rig(1).pair("alpha", "beta"), WHOLE)
    query, image = torch.randn(1, 2, *segments.valid.shape), torch.randn(1, 2, 40, 60)

    def attended(start, samples=None):
        return attend(query, image, image, Segments(start, segments.end, segments.valid), samples=samples)

    starts = torch.stack([segments.start, segments.start + 0.1]).float()
    with pytest.raises(NotImplementedError, match="`samples`"):
        torch.vmap(attended)(starts)
    torch.testing.assert_close(torch.vmap(lambda s: attended(s, 5))(starts)[0], attended(starts[0], 5))


def test_a_field_without_positions_is_refused():
    image = torch.ones(1, 2, 3, 4)
    with pytest.raises(ValueError, match="samples"):
        attend(image, image, image, lambda x: Positions(x[:, None][:, :0], x[:, :0] > 0))


def test_a_bias_on_another_device_is_refused():
    image, valid = torch.ones(1, 2, 3, 4), torch.ones(3, 4, dtype=torch.bool)
    ends = torch.zeros(3, 4, 2)
    with pytest.raises(ValueError, match="bias is on meta"):
        attend(image, image, image, Segments(ends, ends, valid), bias=torch.zeros(1, device="meta"))
