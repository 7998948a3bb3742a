"""The public functions of `calib`."""

import importlib

import pytest


@pytest.mark.parametrize("package", ["calib.boards", "calib.images"])
def test_public_functions_are_found(package):
    module = importlib.import_module(package)
    assert all(callable(getattr(module, name)) for name in module.__all__)
    with pytest.raises(AttributeError, match="'nothing'"):
        module.nothing  # noqa: B018
