import pytest
import torch

from arraygeom.pixels import (
    coarse_grid,
    map_homogeneous,
    pixel_grid,
    resize_matrix,
    rot90_matrix,
)


def blob(hw: tuple[int, int], x: float, y: float, *, sigma: float = 2.0) -> torch.Tensor:
    """An image (1, 1, H, W) of one bright spot."""
    grid = pixel_grid(hw, dtype=torch.float64)
    offset = grid - torch.tensor([x, y], dtype=torch.float64)
    return torch.exp(-0.5 * offset.square().sum(-1) / sigma**2)[None, None]


def centroid(image: torch.Tensor) -> torch.Tensor:
    grid = pixel_grid(image.shape[-2:], dtype=image.dtype)
    return (image[0, 0, ..., None] * grid).sum((0, 1)) / image.sum()


def test_maps_and_their_inverses():
    eye = torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(resize_matrix((3, 7), (9, 2)) @ resize_matrix((9, 2), (3, 7)), eye)
    torch.testing.assert_close(rot90_matrix((7, 3), 3) @ rot90_matrix((3, 7), 1), eye)
    torch.testing.assert_close(rot90_matrix((3, 7), 4), eye)


def test_homogeneous_map_is_the_matrix_product():
    g = torch.Generator().manual_seed(0)
    M, x = (torch.randn(*s, generator=g, dtype=torch.float64) for s in ((2, 4, 3), (2, 5, 6, 2)))
    homogeneous = torch.cat([x, torch.ones(2, 5, 6, 1, dtype=torch.float64)], -1)
    expected = torch.einsum("bki,bhwi->bhwk", M, homogeneous)
    torch.testing.assert_close(map_homogeneous(M, x), expected)
    torch.testing.assert_close(map_homogeneous(M, x[:1]), torch.einsum("bki,hwi->bhwk", M, homogeneous[0]))
    torch.testing.assert_close(map_homogeneous(M[0], x[0, 0, 0]), expected[0, 0, 0])
    with pytest.raises(ValueError, match="batched"):
        map_homogeneous(M[None], x[0, 0, 0])


def test_homogeneous_map_keeps_its_precision_under_autocast():
    x = pixel_grid((800, 1280))[-1, -3:]
    with torch.autocast("cpu", dtype=torch.bfloat16):
        torch.testing.assert_close(map_homogeneous(torch.eye(3), x)[..., :2], x, atol=0, rtol=0)


def test_coarse_grid_reaches_all_corners():
    grid = coarse_grid((48, 64))
    assert grid[-1, -1].tolist() == [63.0, 47.0]
    assert grid[0].diff(dim=0)[:, 0].max() <= 16
    assert coarse_grid((1, 1)).tolist() == [[[0.0, 0.0]]]
