"""C3 attention: collect, correlate, combine."""

from pat.attention.reference import Attended
from pat.attention.torch_op import attend, attend_with_statistics

__all__ = ["Attended", "attend", "attend_with_statistics"]
