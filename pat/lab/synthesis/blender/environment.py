"""Python environment in which Blender runs, apart from this one: bpy wants other versions of NumPy."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path

from arraygeom.runtime.extras import install_line

FOLDER = Path(sys.prefix) / "blender"
"""Folder of the environment, within this one, where `make synthesis` makes it."""


def blender_python() -> str:
    """Return the path of a Python interpreter that has bpy: this one, or else that of `FOLDER`.

    Raises:
        ValueError: in one line with the command to install it, if OpenEXR or such an interpreter is missing.
    """
    if find_spec("OpenEXR") is None:
        line = install_line("OpenEXR", "synthesis")
        raise ValueError(f"rendering needs OpenEXR to read what Blender writes: {line}")
    if find_spec("bpy") is not None:
        return sys.executable
    python = FOLDER / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")
    if not (python.is_file() and any(FOLDER.rglob("site-packages/bpy"))):
        raise ValueError(
            "rendering needs Blender as a Python module, in an environment of its own: `make synthesis` in a "
            f"checkout, or python3.11 -m venv {FOLDER} && {python} -m pip install 'bpy==5.0.1'"
        )
    return str(python)
