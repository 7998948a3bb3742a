"""Compiled functions: what is kept, who waits for whom, and where nothing can be kept."""

import errno
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from filelock import FileLock

from arraygeom.runtime import compiled as module

caching = pytest.importorskip("numba.core.caching")


def test_without_a_folder_that_can_be_written_each_process_compiles_and_says_so(monkeypatch):
    monkeypatch.setattr(caching.FunctionCache._impl_class, "_locator_classes", [])
    module._warn_of_no_folder.cache_clear()
    with pytest.warns(UserWarning, match="NUMBA_CACHE_DIR"):
        double = module.compiled(lambda x: 2 * x, cache=True)
    assert double(21) == 42
    assert module.cache_folder(double) is None


@module.compiled
def half(x):
    return x / 2


@module.compiled
def halves(x):
    return half(x), half(x + 1)


def sum_of_halves(x):
    a, b = halves(x)
    return a + b


def lock_of(entry) -> Path:
    return Path(module.cache_folder(entry)) / "sum_of_halves.lock"


@pytest.fixture
def entry(monkeypatch, tmp_path):
    """`sum_of_halves`, compiled anew."""
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path))
    return module.compiled(sum_of_halves, cache=True)


def test_one_process_compiles_and_others_wait_for_it(entry):
    lock = lock_of(entry)
    with ThreadPoolExecutor() as beside, FileLock(lock) as held:
        waiting = beside.submit(entry, 4.0)
        time.sleep(0.3)
        assert not waiting.done()
        assert not [*lock.parent.glob("*.nbc")]
        held.release()
        assert waiting.result() == 4.5


def test_a_process_that_has_waited_long_compiles_itself(entry, monkeypatch):
    monkeypatch.setattr(module, "LONGEST", 0.1)
    with FileLock(lock_of(entry)):
        assert entry(4.0) == 4.5


def test_where_files_cannot_be_locked_each_process_compiles(entry, monkeypatch):
    def refused(*_):
        raise OSError(errno.ENOLCK, "no locks")

    monkeypatch.setattr(FileLock, "_acquire", refused)
    assert entry(4.0) == 4.5


def test_what_is_kept_is_loaded(entry):
    entry(4.0)
    again = module.compiled(sum_of_halves, cache=True)
    assert again(4.0) == 4.5
    assert again.stats.cache_hits
