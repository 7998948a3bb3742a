"""C3 attention: collect, correlate, combine."""

from pat.attention.attend import attend, attend_with_statistics
from pat.attention.block_mask import segment_block_mask
from pat.attention.reference import Attended

__all__ = ["Attended", "attend", "attend_with_statistics", "segment_block_mask"]
