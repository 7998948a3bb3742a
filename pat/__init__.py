"""The physics-aware transformer: one image from an array of unlike cameras."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .networks.weights import Network


def from_pretrained(name: str | Path) -> Network:
    """The network of a weights file, or of a name that ships with the package, such as "mono-colour".

    Shapes and version are checked, and nothing is unpickled. Raises FileNotFoundError for neither, ValueError for a
    file that is not of this format or does not fit.
    """
    from .networks.weights import load_weights

    return load_weights(name)
