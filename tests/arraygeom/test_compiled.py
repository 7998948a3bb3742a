"""Compiled functions: those that only compiled ones call, and where nothing can be kept."""

import pytest

from arraygeom import compiled as module
from arraygeom import linked

caching = pytest.importorskip("numba.core.caching")


def test_without_a_folder_that_can_be_written_each_process_compiles_and_says_so(monkeypatch):
    monkeypatch.setattr(caching.FunctionCache._impl_class, "_locator_classes", [])
    module._warn_of_no_folder.cache_clear()
    with pytest.warns(UserWarning, match="NUMBA_CACHE_DIR"):
        double = module.compiled(lambda x: 2 * x, cache=True)
    module.separate_cache(double)
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


@pytest.fixture
def entry(monkeypatch, tmp_path):
    """`sum_of_halves`, compiled anew."""
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path))
    return module.compiled(sum_of_halves, cache=True)


def test_what_compiled_functions_alone_call_becomes_machine_code_only_within_them(entry, monkeypatch):
    from numba.core.codegen import JITCodeLibrary

    names, finalize = [], JITCodeLibrary._finalize_specific
    monkeypatch.setattr(JITCodeLibrary, "_finalize_specific", lambda self: (names.append(self.name), finalize(self))[1])
    assert entry(4.0) == 4.5
    assert names.count("sum_of_halves") == 1
    assert not {"half", "halves"} & {*names}


def test_called_from_python_such_a_function_raises(entry):
    entry(4.0)
    for number in (4.0, 4):
        with pytest.raises(TypeError):
            half(number)


def test_another_numba_compiles_it_as_any_other(monkeypatch):
    from numba.core.compiler import Compiler

    monkeypatch.setattr(linked, "_INTERNAL", ("no_such_name",))
    assert linked._linked_compiler.__wrapped__() is Compiler
