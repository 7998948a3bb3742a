"""Compiled functions where nothing can be kept."""

import pytest

from arraygeom import compiled as module

caching = pytest.importorskip("numba.core.caching")


def test_without_a_folder_that_can_be_written_each_process_compiles_and_says_so(monkeypatch):
    monkeypatch.setattr(caching.FunctionCache._impl_class, "_locator_classes", [])
    module._warn_of_no_folder.cache_clear()
    with pytest.warns(UserWarning, match="NUMBA_CACHE_DIR"):
        double = module.compiled(lambda x: 2 * x, cache=True)
    module.separate_cache(double)
    assert double(21) == 42
    assert module.cache_folder(double) is None
