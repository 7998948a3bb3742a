"""The compiled loops of the CPU backend.

The work on one alpha pixel is done on *taps*, the pixels of beta that its samples touch. Neighbouring
samples share them (a bilinear look-up has four, of which the next sample usually needs two again), so all
work along the channels is done once a tap: inner products of the query with its taps, sums of taps with
weights, and in backward the addition of the query to the taps' gradients. Neighbouring alpha pixels do so
in turn, a few taps at a time, since they share most of them. Everything else is work on samples, sixteen at
a time.

Images come channels-last and flat. The numbers in them are float64, float32, or 16-bit ones seen as
integers: uint16 is bfloat16, int16 is float16. Arithmetic is in float64 for the first and in float32 for the
others.
"""

import hashlib
from pathlib import Path

from arraygeom.compiled import cache_file

from .backward import backward
from .channels import scatter
from .emit import LANES, compiled, separate_cache
from .forward import forward
from .layout import Call, Geometry, Gradients, Outputs, Saved, Share, TapList, block_scratch
from .local import ROWS, attend_rows

__all__ = [
    "LANES",
    "ROWS",
    "Call",
    "Geometry",
    "Gradients",
    "Outputs",
    "Saved",
    "Share",
    "TapList",
    "attend_rows",
    "backward",
    "block_scratch",
    "compiled",
    "forward",
    "scatter",
    "separate_cache",
]


def _watch_all_sources() -> None:
    """numba's cache is renewed when the file of the entry point changes; here when any file of this folder does."""
    sources = b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py")))
    stamp = hashlib.sha256(sources).hexdigest()
    for entry in (forward, backward, scatter, attend_rows):
        if (file := cache_file(entry)) is not None:
            file._source_stamp = stamp
        separate_cache(entry)


_watch_all_sources()
