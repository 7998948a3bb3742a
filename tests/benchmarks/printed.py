"""Tables of a benchmark: printed while they grow, then written to a file."""

import argparse
from collections.abc import Iterable
from pathlib import Path

from arraygeom.atomic import write_text


def data_and_out(description: str) -> argparse.Namespace:
    """The options of a benchmark on real images: the folder `data`, and the file `out` for its tables."""
    parser = argparse.ArgumentParser(description=description.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--out", type=Path)
    return parser.parse_args()


def print_tables(title: str, tables: Iterable[Iterable[str]], out: Path | None) -> None:
    """Print each table's rows as they come, a blank line between tables; write them to `out` if given."""
    lines: list[str] = []
    for table in tables:
        for row in table:
            print(row, flush=True)
            lines.append(row)
        lines.append("")
    if out:
        write_text(out, f"# {title}\n\n" + "\n".join(lines).rstrip() + "\n")
