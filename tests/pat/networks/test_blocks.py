"""The blocks of the networks."""

import pytest
import torch

from pat.support.blocks import plain, stacked


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_stacked_channels_are_those_of_the_parts(dtype):
    """By compiled loops in float32, by torch otherwise."""
    small = torch.rand(2, 3, 34, 40, dtype=dtype)
    large = torch.rand(2, 5, 68, 80, dtype=dtype)[:, 1:3]
    assert plain(large) == (dtype == torch.float32)
    found = stacked(small, large, small[:, :1])
    wanted = torch.cat([small, torch.nn.functional.pixel_unshuffle(large, 2), small[:, :1]], 1)
    assert torch.equal(found, wanted)
    assert found.is_contiguous(memory_format=torch.channels_last)
