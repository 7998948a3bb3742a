"""File names for names of cameras, bands and scenes that others chose."""

from __future__ import annotations

import hashlib
import re
import unicodedata
from collections import Counter
from collections.abc import Iterable

LONGEST = 80
"""Longest unchanged name, in bytes; file systems allow 255 for the whole file name."""
_DIGEST = 12
"""Hexadecimal digits that distinguish changed names."""
_RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)
"""Names of devices on Windows, with any suffix."""
_CHANGED = re.compile(rf".*-[0-9a-f]{{{_DIGEST}}}", re.DOTALL)


def file_names(names: Iterable[str]) -> dict[str, str]:
    """Make a file name (or the beginning of one) for each name; no two names share one.

    Letters and digits of any script, ``. _ + - , = @ ~ ( )`` and spaces within stay, others become "_", in
    Unicode's NFC. A name that this changes, that is empty or reserved, begins or ends with "." or a space,
    is longer than `LONGEST` bytes, equals another one so written but for case, or ends like a changed one,
    gets "-" and a digest of the name at its end, and is cut to `LONGEST` bytes with it.

    >>> file_names(["left", "a/b"])
    {'left': 'left', 'a/b': 'a_b-c14cddc033f6'}

    Returns:
        File names by name.
    """
    kept = {name: re.sub(r"[^\w.+\-,=@~() ]", "_", unicodedata.normalize("NFC", name)) for name in names}
    count = Counter(text.casefold() for text in kept.values())
    alone = {name for name, text in kept.items() if text == name and count[text.casefold()] == 1}
    return {
        name: text if name in alone and _is_plain(text) else _changed(name, text)
        for name, text in kept.items()
    }


def _is_plain(text: str) -> bool:
    fits = text == text.strip(" ").rstrip(".") and not text.startswith(".") and len(text.encode()) <= LONGEST
    return fits and text != "" and not (_RESERVED.fullmatch(text) or _CHANGED.fullmatch(text))


def _changed(name: str, text: str) -> str:
    text = text.encode()[: LONGEST - 1 - _DIGEST].decode(errors="ignore").lstrip(".")
    text = f"_{text}" if _RESERVED.fullmatch(text) else text
    return f"{text}-{hashlib.sha256(name.encode('utf-8', 'surrogatepass')).hexdigest()[:_DIGEST]}"
