"""The blocks of the networks."""

import pytest
import torch

from pat.support.blocks import plain, stacked


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_stacked_channels_are_those_of_the_parts(dtype):
    """For compiled loops (float32) and for torch."""
    small = torch.rand(2, 3, 34, 40, dtype=dtype)
    large = torch.rand(2, 5, 68, 80, dtype=dtype)[:, 1:3]
    assert plain(large) == (dtype == torch.float32)
    found = stacked(small, large, small[:, :1])
    wanted = torch.cat([small, torch.nn.functional.pixel_unshuffle(large, 2), small[:, :1]], 1)
    assert torch.equal(found, wanted)
    assert found.is_contiguous(memory_format=torch.channels_last)


def test_stacked_channels_have_the_type_of_the_parts_whatever_is_the_default():
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        found = stacked(
            torch.rand(1, 2, 4, 6, dtype=torch.float32), torch.rand(1, 1, 8, 12, dtype=torch.float32)
        )
    finally:
        torch.set_default_dtype(before)
    assert found.dtype == torch.float32
