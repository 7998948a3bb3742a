"""The examples of conventions.md and of every docstring run, and give what they say."""

import doctest
import importlib
import pkgutil
from pathlib import Path

import pytest
import torch

import arraygeom
from arraygeom.runtime.compiled import can_compile

PAGE = Path(arraygeom.__file__).parent / "conventions.md"
MODULES = [
    m.name
    for m in pkgutil.walk_packages(arraygeom.__path__, "arraygeom.")
    if can_compile() or not m.name.endswith("kernels")
]


def test_conventions():
    results = doctest.testfile(str(PAGE), module_relative=False)
    assert results.failed == 0
    assert results.attempted > 20


@pytest.mark.parametrize("name", MODULES)
def test_docstrings(name):
    module = importlib.import_module(name)
    assert doctest.testmod(module, extraglobs={"torch": torch}).failed == 0
