"""Segments as attention masks for other transformers."""

from __future__ import annotations

from torch import Tensor
from torch.nn.attention.flex_attention import BlockMask, create_block_mask

from arraygeom.pixels import HW
from arraygeom.segments import Segments


def segment_block_mask(segments: Segments, hw: HW, *, radius: float = 0.5, block: int = 128) -> BlockMask:
    """Make a `flex_attention` mask: alpha's pixels, row by row, attend to beta's pixels near their segments.

    Args:
        segments: segments (Ha, Wa), or (B, Ha, Wa) for a batch.
        hw: (height, width) of beta; keys are its H W pixels, row by row.
        radius: largest distance of a key from the segment, pixels of beta.
        block: number of queries, and of keys, in a block of the mask.

    Returns:
        The mask, for any number of heads, on the segments' device; without a batch for any batch. Queries
        without a key in reach, or with an invalid segment, get zeros. Torch evaluates all pairs of pixels:
        meant for features of some thousand pixels. `Segments.mask` is the same, dense, for
        scaled_dot_product_attention.
    """
    batch = segments.valid.shape[0] if segments.valid.ndim > 2 else None
    parts = (segments.start, segments.end, segments.valid)
    starts, ends, valids = (
        tensor.reshape(batch or 1, -1, *tensor.shape[segments.valid.ndim :]) for tensor in parts
    )
    width = hw[1]

    def within(b: Tensor, h: Tensor, query: Tensor, key: Tensor) -> Tensor:
        start, end, valid = (tensor[b if batch else 0, query] for tensor in (starts, ends, valids))
        dx, dy, u, v = end[0] - start[0], end[1] - start[1], key % width - start[0], key // width - start[1]
        along = ((u * dx + v * dy) / (dx * dx + dy * dy).clamp(min=1e-12)).clamp(0, 1)
        return valid & ((u - along * dx).square() + (v - along * dy).square() <= radius**2)

    return create_block_mask(
        within, batch, None, valids.shape[1], hw[0] * hw[1], device=segments.valid.device, BLOCK_SIZE=block
    )
