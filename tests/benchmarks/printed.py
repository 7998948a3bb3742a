"""Tables of a benchmark: printed while they grow, then written to a file."""

from collections.abc import Iterable
from pathlib import Path

from arraygeom.atomic import write_text


def print_tables(title: str, tables: Iterable[Iterable[str]], out: Path | None) -> None:
    """Print the rows of each table as they come, with a blank line between tables; write them to `out` if given."""
    lines: list[str] = []
    for table in tables:
        for row in table:
            print(row, flush=True)
            lines.append(row)
        lines.append("")
    if out:
        write_text(out, f"# {title}\n\n" + "\n".join(lines).rstrip() + "\n")
