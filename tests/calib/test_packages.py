"""The public functions of `calib`, and the one direction of its imports."""

import ast
import importlib
from pathlib import Path

import pytest

import calib


@pytest.mark.parametrize("package", ["calib.boards", "calib.images"])
def test_public_functions_are_found(package):
    module = importlib.import_module(package)
    assert all(callable(getattr(module, name)) for name in module.__all__)
    with pytest.raises(AttributeError, match="'nothing'"):
        module.nothing  # noqa: B018


def test_boards_do_not_import_images():
    sources = Path(calib.__file__).parent.glob("boards/*.py")
    imports = [node for path in sources for node in ast.walk(ast.parse(path.read_text()))]
    modules = [node.module or "" for node in imports if isinstance(node, ast.ImportFrom)]
    assert not [module for module in modules if "images" in module.split(".")]
