"""Calibration of camera rigs.

`calib.boards` calibrates a rig from images of a calibration board; `calib.images` finds mistakes in a rig,
refines it, or makes an uncalibrated one, from ordinary images. `calib.images` may use `calib.boards`, not the
reverse.
"""

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def _lazy(package: str, modules: Mapping[str, str]) -> Callable[[str], Any]:
    """Return a package's `__getattr__` that imports functions on first use: OpenCV and matplotlib load
    slowly."""

    def get(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        return getattr(import_module(f"{package}.{modules[name]}"), name)

    return get


__all__ = ["boards", "images"]


def __getattr__(name: str) -> Any:
    """Import one of the two packages on first use.

    Raises:
        AttributeError: for any other name.
    """
    if name not in __all__:
        raise AttributeError(f"module 'calib' has no attribute '{name}'")
    return import_module(f"calib.{name}")


def __dir__() -> list[str]:
    return __all__
