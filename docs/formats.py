"""The table of rig formats, from what their modules state: `python -m docs.formats` puts it into rigs.md.

A module's docstring has its convention in a paragraph that begins "Source convention:", and a last one of
lines that begin "Written by:", "Refused:" and "Sample:".
"""

from __future__ import annotations

import inspect
import re
from pathlib import Path

from arraygeom.io import READERS, WRITERS
from arraygeom.runtime.atomic import write_text

from .update_readme import with_block

PAGE = Path(__file__).with_name("rigs.md")
COLUMNS = {
    "written by": "Written by",
    "refused, or left out with a warning": "Refused",
    "a file of it": "Sample",
    "its convention, and what is done about it": "Source convention",
}


def table() -> str:
    """A row for each module of readers, with all names of its formats."""
    modules: dict[str, list[str]] = {}
    for name, reader in READERS.items():
        modules.setdefault(inspect.getdoc(inspect.getmodule(reader)) or "", []).append(name)
    rows = ["| name | " + " | ".join(COLUMNS) + " | we write it |", "|---" * (len(COLUMNS) + 2) + "|"]
    for doc, names in modules.items():
        if "native" in names:
            continue
        cells = [stated(doc, label) for label in COLUMNS.values()]
        written = "yes" if any(name in WRITERS for name in names) else ""
        rows.append(f"| {', '.join(f'`{name}`' for name in names)} | {' | '.join(cells)} | {written} |")
    return "\n".join(rows)


def stated(doc: str, label: str) -> str:
    """Return the text after a label in a docstring, as a table's cell. Raises ValueError without one."""
    found = re.search(rf"^{label}: (.+?)(?=\n\n|\nWritten by: |\nRefused: |\nSample: |\Z)", doc, re.M | re.S)
    if found is None:
        raise ValueError(f"a reader's module has no '{label}:': {doc.splitlines()[0]}")
    return " ".join(found[1].split()).removesuffix(".").replace("|", r"\|")


if __name__ == "__main__":
    write_text(PAGE, with_block(PAGE.read_text(), "formats", table()))
