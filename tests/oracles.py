"""Other libraries to compare with: a test that reaches for one that is not installed is skipped."""

from typing import Any

import pytest


class Oracle:
    """A module, imported when it is first used."""

    def __init__(self, module: str) -> None:
        self._module = module

    def __getattr__(self, name: str) -> Any:
        found = pytest.importorskip(
            self._module, reason=f"compares with {self._module}, which is not installed"
        )
        return getattr(found, name)
