"""Memory: amounts are parsed, and freed memory is returned to the system."""

import subprocess
import sys

import numpy as np
import pytest

from pat.support.memory import ROOM, SLACK, give_back, how_many_fit, limited, parse_bytes, planned, resident


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_freed_memory_is_given_back():
    """Every other block is freed: those that stay keep the C library from returning the rest by itself."""
    blocks = [np.ones(2**16, np.uint8) for _ in range(4000)]
    blocks = blocks[::2]
    before = resident()
    give_back()
    assert before - resident() > 0.8 * 2000 * 2**16
    assert all(block[0] == 1 for block in blocks)


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_tasks_fit_into_what_a_limit_leaves():
    assert how_many_fit(2**30) is None
    with limited((resident() + 3.5 * 2**30) / ROOM):
        assert how_many_fit(2**30) == 3
        assert how_many_fit(2**40) == 1
    assert how_many_fit(2**30) is None


def test_bytes_are_read():
    assert parse_bytes("4GiB") == 4 * 2**30
    assert parse_bytes("500 MB") == 5e8
    assert parse_bytes(2e9) == 2e9
    for wrong in ("4 gigs", "nan", "nanGiB", float("nan"), 7, float("inf")):
        with pytest.raises(ValueError, match=f"max_memory: '{wrong}'"):
            parse_bytes(wrong)


KEPT = """
import time
import numpy as np
from pat.support.memory import NEAR, keep_freed, limited, resident

def kept(tenths=0):
    # Every other block is freed: those that stay keep the C library from returning the top of its heap.
    blocks = [np.ones(2**20) for _ in range(40)]
    before, blocks = resident(), blocks[::2]
    while tenths and resident() > before - 2**27:
        time.sleep(0.1)
        tenths -= 1
    return 1 - (before - resident()) / (len(blocks) * 2**23)

keep_freed()
begin = resident()
first = kept()
with limited(100 * begin):
    far = kept(2)
with limited((begin + 240 * 2**20) / NEAR):
    near = kept(3000)
print(round(first), round(far), round(near), round(kept(2)))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_freed_memory_is_kept_but_near_a_limit():
    """In a process of its own, as the options are of a whole process."""
    done = subprocess.run([sys.executable, "-c", KEPT], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["1", "1", "0", "1"]


@pytest.mark.parametrize(("limit", "wanted"), [(None, SLACK * 2.0), (1.5, 1.5), (3.0, SLACK * 2.0)])
def test_a_large_task_takes_what_is_planned_whatever_more_is_allowed(limit, wanted, monkeypatch):
    """Freed memory is returned though the limit is far."""
    monkeypatch.setattr("pat.support.memory._keeps", True)
    assert planned(limit, 2.0, large=True) == wanted
    assert planned(limit, 2.0, large=False) == limit
