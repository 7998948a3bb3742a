"""Attention to windows is `attend` with a `Local` field."""

import pytest
import torch

from arraygeom import Local, Pair, View, lazily
from pat.attention import attend
from pat.networks.blocks import plain, stacked
from pat.networks.windows import ROWS, attend_to_windows


@pytest.mark.parametrize("spacing", [1, 3, 8])
@pytest.mark.parametrize("hw", [(5, 9), (2 * ROWS + 3, 40)])
def test_it_is_attention_with_a_local_field(hw, spacing):
    g = torch.Generator().manual_seed(spacing)
    query, key, value = (torch.randn(2, n, *hw, generator=g) for n in (9, 9, 4))
    field = lazily(Local(7, spacing=spacing), Pair(View(hw=hw), View(hw=hw)))
    wanted = attend(query.double(), 5 * key.double(), value.double(), field, interpolation="nearest")
    torch.testing.assert_close(
        attend_to_windows(query, 5 * key, value, 7, spacing).double(), wanted, rtol=1e-5, atol=1e-5
    )


def test_threads_change_no_bit():
    query, key, value = (torch.randn(1, n, 70, 50) for n in (9, 9, 4))
    before, found = torch.get_num_threads(), []
    try:
        for n in (1, 2, 5):
            torch.set_num_threads(n)
            found.append(attend_to_windows(query, key, value, 7, 3))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(one, found[0]) for one in found)


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
