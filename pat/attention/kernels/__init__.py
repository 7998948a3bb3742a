"""Compiled loops of the CPU backend.

The work on one alpha pixel is done on *taps*, the pixels of beta that its samples touch. Neighbouring samples
share them (a bilinear look-up has four, of which the next sample usually needs two again), so all work along
the channels is done once for each tap: inner products of the query with its taps, sums of taps with weights,
and in backward the addition of the query to the taps' gradients. Neighbouring alpha pixels do so in turn, a
few taps at a time, since they share most of them. Everything else is work on samples, sixteen at a time.

Images are channels-last and flat, in float64 or float32.
"""

from pathlib import Path

from arraygeom.runtime.compiled import renew_with

from .backward import backward
from .channels import scatter
from .emit import LANES
from .forward import forward
from .layout import Call, Geometry, Gradients, Outputs, Saved, Share, TapList, block_scratch
from .local import ROWS, attend_rows, differentiate_rows

SOURCES = [*Path(__file__).parent.glob("*.py")]

for _entry in (forward, backward, scatter, attend_rows, differentiate_rows):
    renew_with(_entry, SOURCES)
