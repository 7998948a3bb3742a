"""Figures of the documentation as commands print them: reports hold them, other pages quote their rows."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Annotated

from torch.nn.functional import interpolate

from arraygeom.runtime.atomic import write_text
from pat.app.cli.parser import Option, script
from pat.media.images import read_image, write_image

QUOTE = re.compile(r"<!-- from (\S+): ([^\n]+?)(?: \| ([^\n]+?))? -->\n.*?<!-- end -->", re.S)
"""A place for rows of a report: its path from the page, first cells of the rows, and, after a bar, heads of
columns if not all are wanted; between semicolons."""


@dataclass
class Readme:
    """Put what commands wrote between `<!-- NAME:begin -->` and `<!-- NAME:end -->` of a document, dated.

    Pages in the folder above that quote the document get its new rows.
    """

    document: Path
    """The document to bring up to date."""
    block: Annotated[tuple[str, ...], Option(repeat=True)] = ()
    """NAME=FILE, once for each block."""
    image: tuple[Path, Path] | None = None
    """An image to take over at 3/4 of its size, and the name to give it."""

    def run(self) -> None:
        """Write the document, its image, and the pages that quote it."""
        for name, _, file in (argument.partition("=") for argument in self.block):
            write_block(self.document, name, without_images(Path(file).read_text()))
        if self.image:
            image = read_image(self.image[0])[None]
            write_image(
                self.image[1], interpolate(image, scale_factor=0.75, mode="bicubic", antialias=True)[0]
            )


def with_block(text: str, name: str, content: str) -> str:
    """Return the text with a block replaced. Raises ValueError if its marks are not there once, in order."""
    begin, end = (f"<!-- {name}:{which} -->" for which in ("begin", "end"))
    if text.count(begin) != 1 or text.count(end) != 1 or text.index(begin) > text.index(end):
        raise ValueError(f"the document needs one {begin} and, after it, one {end}")
    return f"{text[: text.index(begin)]}{begin}\n\n{content.strip()}\n\n{text[text.index(end) :]}"


def write_block(document: Path, name: str, content: str) -> None:
    """Replace a document's block by today's content, and the rows that pages in the folder above quote."""
    content = f"*Printed on {date.today()}.*\n\n{content}"
    write_text(document, with_block(document.read_text(), name, content))
    for page in document.resolve().parent.parent.glob("*.md"):
        if QUOTE.search(page.read_text()):
            write_text(page, quoting(page))


def quoting(page: Path) -> str:
    """The text of a page with its quoted rows as the reports have them now.

    Raises ValueError for a row that its report does not have.
    """

    def rows(found: re.Match[str]) -> str:
        wanted, columns = found[2].split("; "), found[3].split("; ") if found[3] else None
        parts = list(quoted((page.parent / found[1]).read_text(), wanted, columns))
        if missing := [name for name in wanted if not any(f"| {name} |" in part for part in parts)]:
            raise ValueError(f"{page.name}: no row {missing[0]!r} in {found[1]}")
        return "{}\n{}\n\n{} <!-- end -->".format(
            found[0].splitlines()[0], "\n\n".join(parts[:-1]), parts[-1]
        )

    return QUOTE.sub(rows, page.read_text())


def quoted(report: str, wanted: Sequence[str], columns: Sequence[str] | None = None) -> Iterator[str]:
    """Yield the tables of a report that have wanted rows and columns, cut to these; last, their date."""
    date_line, of_chosen = "", ""
    for part in re.findall(r"^\*Printed [^*]+\*|(?:^\|.*\n?)+", report, re.M):
        if part.startswith("*"):
            date_line = part
            continue
        head, rule, *rows = ([cell.strip() for cell in line.split("|")[1:-1]] for line in part.splitlines())
        kept = [0, *(head.index(name) for name in columns if name in head)] if columns else range(len(head))
        chosen = [row for row in rows if row[0] in wanted]
        if chosen and len(kept) > 1:
            of_chosen = date_line
            yield "\n".join(f"| {' | '.join(row[i] for i in kept)} |" for row in (head, rule, *chosen))
    if of_chosen:
        yield of_chosen


def without_images(text: str) -> str:
    """Markdown without the lines that are only an image."""
    return "".join(line for line in text.splitlines(keepends=True) if not line.startswith("!["))


if __name__ == "__main__":
    script(Readme).run()
