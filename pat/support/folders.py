"""Listing of files in folders, and one-line texts of errors."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

MOST_SHOWN = 2000
"""Characters of a message that are shown at most."""


def files_below(folder: str | Path, within: frozenset[str] = frozenset()) -> list[Path]:
    """List all regular files in a folder and its subfolders, through symbolic links too.

    Args:
        folder: the folder; one that is missing or cannot be read counts as empty, at any depth.
        within: real paths of the folders above, which links may not lead back to; callers leave it empty.

    Returns:
        Paths that begin with `folder`, sorted.

    Raises:
        PermissionError: for a folder whose names can be read but not its entries.
    """
    real = os.path.realpath(folder)
    if real in within:
        return []
    try:
        entries = list(Path(folder).iterdir())
    except OSError:
        return []
    below = [file for path in entries if path.is_dir() for file in files_below(path, within | {real})]
    return sorted([path for path in entries if path.is_file()] + below)


def check_apart(out: Path, folders: Iterable[Path]) -> None:
    """Raise ValueError for an output folder that is, or is below, a folder whose images are read."""
    for folder in folders:
        if out.resolve().is_relative_to(folder.resolve()):
            raise ValueError(f"--out: {out} is in {folder}, whose images are read: give one outside of it")


def error_text(error: Exception) -> str:
    """Return an error's message in one line; for an OSError the file and the cause, without its errno."""
    text = f"{error}"
    if isinstance(error, OSError) and error.filename:
        text = f"{error.filename}: {error.strerror}"
    return " ".join(text.split())


def printable(text: str) -> str:
    """Make a text safe to print on one terminal line.

    Returns:
        The text with characters that do not print (line ends, control codes, other spaces than " ") as
        escapes such as "\\n"; of one longer than `MOST_SHOWN` characters the middle becomes " ... ".
    """
    if len(text) > MOST_SHOWN:
        text = f"{text[: MOST_SHOWN // 2]} ... {text[-MOST_SHOWN // 2 :]}"
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
