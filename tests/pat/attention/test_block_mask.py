"""Segments as masks of scaled_dot_product_attention and of flex_attention."""

import pytest
import torch
from torch.nn.attention.flex_attention import flex_attention
from torch.nn.functional import scaled_dot_product_attention

from arraygeom import Epipolar, Segments, pixel_grid, sampling_locations, stack
from pat.attention import segment_block_mask
from tests.arraygeom.rigs import random_rig

HW = (16, 16)


def segments(seeds: tuple[int, ...] = (1,)) -> Segments:
    """Return the segments of alpha's every fourth pixel, in beta made 16 x 16."""
    rigs = [random_rig(seed).resize("alpha", (12, 16)).resize("beta", HW) for seed in seeds]
    found = [sampling_locations(Epipolar(), rig.pair("alpha", "beta")) for rig in rigs]
    return found[0] if len(seeds) == 1 else stack(found)


def test_distance_is_that_of_many_points_of_the_segment():
    found, g = segments(), torch.Generator().manual_seed(0)
    xy = 16 * torch.rand(*found.valid.shape, 2, generator=g)
    many = found.at(torch.linspace(0, 1, 2001)[:, None, None].expand(-1, *found.valid.shape))
    expected = (many - xy).norm(dim=-1).amin(0)
    torch.testing.assert_close(found.distance(xy)[found.valid], expected[found.valid], atol=2e-2, rtol=0)
    assert found.distance(xy)[~found.valid].isinf().all()


def test_distance_has_gradients():
    xy = torch.tensor([[3.0, 4.0], [12.0, 1.0]], dtype=torch.float64)
    ends = torch.tensor([[[1.0, 1.0], [9.0, 3.0]], [[2.0, 2.0], [8.0, 2.0]]], dtype=torch.float64)
    valid = torch.ones(2, dtype=torch.bool)

    def distance(xy, start, end):
        return Segments(start, end, valid).distance(xy)

    assert torch.autograd.gradcheck(
        distance, [t.requires_grad_() for t in (xy, ends[:, 0].clone(), ends[:, 1].clone())]
    )
    assert torch.autograd.grad(Segments(xy, xy, valid).distance(xy).sum(), xy)[0].isfinite().all()


@pytest.mark.parametrize("seeds", [(1,), (1, 2)])
def test_both_masks_give_the_same_attention(seeds):
    found, g = segments(seeds), torch.Generator().manual_seed(0)
    n = len(seeds)
    q, k, v = (torch.randn(n, 2, length, 8, generator=g) for length in (192, 256, 256))
    dense = found.mask(HW, radius=1.5).reshape(n, 1, 192, 256)
    expected = scaled_dot_product_attention(q, k, v, attn_mask=dense)
    ours = flex_attention(q, k, v, block_mask=segment_block_mask(found, HW, radius=1.5))
    some = dense.any(-1, keepdim=True).expand_as(ours)
    torch.testing.assert_close(ours[some], expected[some])
    assert (ours[~some] == 0).all()


def test_a_mask_is_the_pixels_near_the_segment():
    one = Segments(torch.tensor([2.0, 3.0]), torch.tensor([10.0, 3.0]), torch.tensor(True))
    mask = one.mask(HW, radius=1.0).reshape(HW)
    x, y = pixel_grid(HW).unbind(-1)
    assert mask.equal(((x - x.clamp(2, 10)) ** 2 + (y - 3) ** 2) <= 1)
    assert not Segments(one.start, one.end, torch.tensor(False)).mask(HW).any()
