"""Files of a folder and of those within it, and what the system says of a file."""

from __future__ import annotations

import os
from pathlib import Path

MOST_SHOWN = 2000
"""Characters of a message."""


def files_below(folder: str | Path, within: frozenset[str] = frozenset()) -> list[Path]:
    """All regular files in a folder and in those within it, behind symbolic links too, sorted.

    Links that lead back to a folder that they are `within` (real paths) are not followed. Folders that cannot
    be read hold nothing, as for `Path.rglob`.
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


def error_text(error: Exception) -> str:
    """What an error says, in one line: the file and the cause, without the system's number for it."""
    text = f"{error}"
    if isinstance(error, OSError) and error.filename:
        text = f"{error.filename}: {error.strerror}"
    return " ".join(text.split())


def printable(text: str) -> str:
    """One line for a terminal, whatever others put into it: control characters as escapes, the middle of a
    very long one left out."""
    if len(text) > MOST_SHOWN:
        text = f"{text[: MOST_SHOWN // 2]} ... {text[-MOST_SHOWN // 2 :]}"
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
