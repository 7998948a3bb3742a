"""A large thing in parts is the whole."""

import weakref

import numpy as np
import pytest
import torch
from torch.autograd import forward_ad, gradcheck
from torch.nn.functional import avg_pool2d, max_pool2d, pad

from arraygeom.runtime.chunks import area, assembled, chunked, spans, tiles_of, whole

IMAGE = torch.rand(2, 3, 23, 37, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def blurred(image):
    """The mean of 5 x 5 pixels, zeros beyond the edges."""
    return avg_pool2d(pad(image, (2,) * 4), 5, 1)


@pytest.mark.parametrize("rows", [1, 7, 22, 23, 100])
def test_rows_are_the_whole(rows):
    assert torch.equal(chunked(torch.exp, IMAGE, rows=rows), IMAGE.exp())


@pytest.mark.parametrize(("axis", "rows"), [(-2, 5), (-1, 8), ((-2, -1), (5, 8)), ((-2, -1), 9)])
def test_with_a_halo_rows_and_tiles_are_the_whole(axis, rows):
    torch.testing.assert_close(chunked(blurred, IMAGE, rows=rows, halo=2, axis=axis), blurred(IMAGE))
    assert not torch.allclose(chunked(blurred, IMAGE, rows=rows, halo=1, axis=axis), blurred(IMAGE))


def test_several_tensors_give_several_of_reduced_size():
    def function(a, b):
        return a + b, max_pool2d(a, 2), max_pool2d(b, 4)[:, 0]

    given = IMAGE[..., :20, :36], IMAGE.flip(0)[..., :20, :36]
    for options in ({"rows": 4}, {"rows": 12, "halo": 4}, {"rows": 8, "halo": 8, "axis": (-2, -1)}):
        made = chunked(function, *given, **options)
        assert [type(made), len(made)] == [tuple, 3]
        assert all(map(torch.equal, made, function(*given)))


def test_a_last_row_that_makes_no_pixel_of_a_reduced_size_is_dropped():
    assert torch.equal(chunked(lambda x: max_pool2d(x, 2), IMAGE, rows=6), max_pool2d(IMAGE, 2))


def test_the_axis_may_be_of_points_and_the_results_of_fewer_axes():
    points = IMAGE.flatten(0, 2)
    made = chunked(lambda x: (x.sum(-1), x[:, 0] > 0.5), points, rows=10, axis=0)
    torch.testing.assert_close(made[0], points.sum(-1))
    assert torch.equal(made[1], points[:, 0] > 0.5)


def test_nothing_is_one_part():
    assert chunked(torch.exp, IMAGE[..., :0, :]).shape == (2, 3, 0, 37)
    assert spans(0, 4) == [(0, 0)]


def test_parts_lie_in_memory_as_the_whole_would():
    made = chunked(lambda x: x.contiguous(memory_format=torch.channels_last).exp(), IMAGE, rows=5)
    assert made.is_contiguous(memory_format=torch.channels_last)
    assert chunked(torch.exp, IMAGE, rows=5).is_contiguous()


@pytest.mark.parametrize("axis", [-2, (-2, -1)])
def test_gradients_pass_through(axis):
    image, scale = IMAGE[:1, :1, :6, :5].clone().requires_grad_(), torch.tensor(0.7).double().requires_grad_()
    assert gradcheck(
        lambda x, s: chunked(lambda part: blurred(part * s), x, rows=2, halo=2, axis=axis), (image, scale)
    )


def test_transformations_pass_through():
    def tripled(x):
        return chunked(lambda part: 3 * part.sin(), x, rows=2)

    expected = 3 * IMAGE.cos()
    torch.testing.assert_close(torch.func.grad(lambda x: tripled(x).sum())(IMAGE), expected)
    torch.testing.assert_close(torch.func.vmap(tripled)(IMAGE), 3 * IMAGE.sin())
    torch.testing.assert_close(torch.func.jvp(tripled, (IMAGE,), (torch.ones_like(IMAGE),))[1], expected)
    with forward_ad.dual_level():
        dual = forward_ad.make_dual(IMAGE, torch.ones_like(IMAGE))
        torch.testing.assert_close(forward_ad.unpack_dual(tripled(dual)).tangent, expected)


def test_tiles_cover_a_frame_once_and_end_at_its_borders():
    tiles = list(tiles_of((23, 37), (8, 10), 3))
    assert [len(tiles), sum(area(tile.inner) for tile in tiles)] == [12, 23 * 37]
    assert tiles[0] == ((0, 8, 0, 10), (0, 11, 0, 13))
    assert tiles[-1] == ((16, 23, 30, 37), (13, 23, 27, 37))
    assert list(tiles_of((23, 37), 40, 3)) == [whole((23, 37))]


def test_each_part_is_asked_for_once():
    asked = []

    def make(box):
        asked.append(box)
        return IMAGE[..., box[0] : box[1], box[2] : box[3]]

    tiles = list(tiles_of((23, 37), 16, 4))
    assert torch.equal(assembled((23, 37), ((tile, make(tile.outer)) for tile in tiles)), IMAGE)
    assert asked == [tile.outer for tile in tiles]


def test_parts_are_forgotten():
    """At any time only the whole and one part are held."""
    memory = []

    def make(box):
        assert [array() for array in memory] == [None] * len(memory)
        array = np.zeros((box[1] - box[0], 4))
        memory.append(weakref.ref(array))
        return [torch.from_numpy(array)]

    assembled((40, 4), ((tile, make(tile.outer)) for tile in tiles_of((40, 4), (8, 4), 0)))
    assert len(memory) == 5
