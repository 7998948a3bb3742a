"""Pixel maps: the effect of resizing, cropping, padding and rotating an image on its coordinates.

Each is a 3x3 matrix A, `x_new ~ A x_old`, on pixels whose first centre is (0, 0). Cameras follow by K' = A K,
fundamental matrices by F' = A_beta^-T F A_alpha^-1.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Real
from torch import Tensor

from .runtime.tracing import followed

HW = tuple[int, int]


def pixel_grid(
    hw: HW, *, dtype: torch.dtype = torch.float32, device: torch.device | str | None = None
) -> Float[Tensor, "h w 2"]:
    """Return the centres (x, y) of all pixels of an image.

    >>> pixel_grid((2, 3))[1, 2].tolist()
    [2.0, 1.0]
    """
    return torch.stack(pixel_coordinates(hw, dtype=dtype, device=device), dim=-1)


def pixel_coordinates(
    hw: HW, *, dtype: torch.dtype = torch.float32, device: torch.device | str | None = None
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """Return x and y of the centres of all pixels: expanded views of a row and a column, without memory."""
    rows, columns = (torch.arange(n, dtype=dtype, device=device) for n in hw)
    x, y = torch.meshgrid(columns, rows, indexing="xy")
    return x, y


def resize_matrix(old: HW, new: HW) -> Float[Tensor, "3 3"]:
    """Return the pixel map of a resize: c' = (c + 0.5) s - 0.5, s being the ratio of sizes along each axis.

    >>> (resize_matrix((4, 4), (2, 2)) @ torch.tensor([0.5, 0.5, 1.0], dtype=torch.float64)).tolist()
    [0.0, 0.0, 1.0]
    """
    sy, sx = (n / o for n, o in zip(new, old))
    return _matrix([[sx, 0, 0.5 * sx - 0.5], [0, sy, 0.5 * sy - 0.5], [0, 0, 1]])


def shift_matrix(left: float, top: float) -> Float[Tensor, "3 3"]:
    """Return the pixel map that crops `left` columns and `top` rows; negative numbers pad."""
    return _matrix([[1, 0, -left], [0, 1, -top], [0, 0, 1]])


def rot90_matrix(hw: HW, quarter_turns: int) -> Float[Tensor, "3 3"]:
    """Return the matrix from an image's pixels to those after `torch.rot90(image, quarter_turns, (-2, -1))`.

    The rotation is counter-clockwise, for negative turns clockwise; `hw` is the size before it. In float64.

    >>> (rot90_matrix((2, 3), 1) @ torch.tensor([2.0, 0.0, 1.0], dtype=torch.float64)).tolist()
    [0.0, 0.0, 1.0]
    """
    A = torch.eye(3, dtype=torch.float64)
    for _ in range(quarter_turns % 4):
        A = _matrix([[0, 1, 0], [-1, 0, hw[1] - 1], [0, 0, 1]]) @ A
        hw = hw[1], hw[0]
    return A


def floating(x: Real[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Convert pixels to float32 or float64: integers and half precision, which hold no position, become
    float32.

    Raises:
        TypeError: for a value that is no tensor.
    """
    if not isinstance(x, Tensor):
        raise TypeError(f"the points are a {type(x).__name__}: give a tensor, as by `torch.as_tensor`")
    return x.to(torch.promote_types(x.dtype, torch.float32))


def within(x: Real[Tensor, "*n 2"], hw: HW, slack: float = 0.0) -> Bool[Tensor, "*n"]:
    """Return True for points on the image's area, [-0.5, W - 0.5] x [-0.5, H - 0.5], and `slack` around."""
    (column, row), (h, w), low = x.unbind(-1), hw, -0.5 - slack  # faster than an axis of length 2
    return (column >= low) & (column <= w + slack - 0.5) & (row >= low) & (row <= h + slack - 0.5)


def product(A: Float[Tensor, "*b i j"], B: Float[Tensor, "*c j k"]) -> Float[Tensor, "*d i k"]:
    """Multiply small matrices in the wider of their types, float32 or float64.

    Float32 products (half precision's too) are computed by explicit multiplications and additions: TF32 and
    autocast lower `matmul` to ten or eight bits.

    Returns:
        The product A B, with the batch axes of both broadcast.
    """
    dtype = torch.promote_types(torch.promote_types(A.dtype, B.dtype), torch.float32)
    A, B = A.to(dtype), B.to(dtype)
    if dtype == torch.float64:
        return A @ B
    total = A[..., :1] * B[..., :1, :]
    for j in range(1, A.shape[-1]):
        total = torch.addcmul(total, A[..., j, None], B[..., j, None, :])
    return total


def broadcasts(batch: Sequence[int], points: Sequence[int]) -> bool:
    """Return True if the axes of points begin with a batch's; an axis of length 1 of either fits any."""
    return len(points) >= len(batch) and all(a == b or 1 in (a, b) for a, b in zip(batch, points))


def broadcast_shapes(*shapes: Sequence[int]) -> torch.Size:
    """Compute `torch.broadcast_shapes`, whose first call in a process takes half a second to import sympy.

    Returns:
        The common shape.

    Raises:
        RuntimeError: for shapes that do not broadcast, while torch compiles or transforms.
        ValueError: for shapes that do not broadcast, otherwise.
    """
    return torch.broadcast_shapes(*shapes) if followed() else torch.Size(np.broadcast_shapes(*shapes))


def map_homogeneous(M: Float[Tensor, "*b k 3"], x: Real[Tensor, "*n 2"]) -> Float[Tensor, "*m k"]:
    """Compute M (x, y, 1) for every point, in the precision of `x` (`floating`).

    A batch of matrices (*b, k, 3) takes points (*b, ..., 2), or with axes of length 1 in place of *b.
    By explicit multiplications and additions, as `product`, in float64 too.

    Returns:
        Homogeneous coordinates (*m, k), not divided; *m are the points' axes, broadcast with the batch's.

    Raises:
        ValueError: for points without the batch's axes.
    """
    x = floating(x)
    batch = M.ndim - 2
    if not broadcasts(M.shape[:-2], x.shape[:-1]):
        raise ValueError(
            f"a rig batched over {tuple(M.shape[:-2])} needs pixels (*batch, ..., 2), got {tuple(x.shape)}"
        )
    beside = (...,) + (None,) * (x.ndim - 1 - batch)
    u, v = x.unbind(-1)
    rows = [[m[beside] for m in row.unbind(-1)] for row in M.to(x.dtype).unbind(-2)]
    return torch.stack([torch.addcmul(torch.addcmul(c, a, u), b, v) for a, b, c in rows]).movedim(0, -1)


def coarse_grid(hw: HW, spacing: int = 16) -> Float[Tensor, "h w 2"]:
    """Return about every `spacing`-th pixel centre, the outermost included, float64.

    >>> coarse_grid((3, 5), 2)[0, :, 0].tolist()
    [0.0, 2.0, 4.0]
    """
    rows, columns = (torch.linspace(0, n - 1, -(-(n - 1) // spacing) + 1, dtype=torch.float64) for n in hw)
    return torch.stack(torch.meshgrid(columns, rows, indexing="xy"), dim=-1)


def safe_sqrt(x: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Compute square roots whose gradient at 0 is 0; 0 for numbers below 0, and for NaN."""
    positive = x > 0
    return torch.where(positive, torch.where(positive, x, 1.0).sqrt(), 0.0)


def to_homogeneous(x: Float[Tensor, "*n d"]) -> Float[Tensor, "*n d+1"]:
    """Append a coordinate of 1."""
    return torch.nn.functional.pad(x, (0, 1), value=1.0)


def _matrix(rows: list[list[float]]) -> Tensor:
    return torch.tensor(rows, dtype=torch.float64)
