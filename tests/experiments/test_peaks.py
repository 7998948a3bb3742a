"""Peaks of memory are those of the work."""

import sys

import numpy as np
import pytest

from experiments.peaks import with_peak


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_the_peak_of_work_is_what_it_held_at_most():
    """100 MiB allocated and freed count, earlier memory does not."""
    held = np.ones(2**25)
    del held
    value, grown = with_peak(lambda: float(np.ones(100 * 2**17).sum()))
    assert value == 100 * 2**17
    assert 95 * 2**20 < grown < 115 * 2**20
