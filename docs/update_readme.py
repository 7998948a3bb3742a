"""Keeps the figures in docs/results.md those that the commands print: `make readme`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from torch.nn.functional import interpolate

from arraygeom.runtime.atomic import write_text
from pat.app.cli.parser import Option, script
from pat.media.images import read_image, write_image


@dataclass
class Readme:
    """Put what commands wrote between `<!-- NAME:begin -->` and `<!-- NAME:end -->` of a document."""

    document: Path = Path("docs/results.md")
    """The document to bring up to date."""
    block: Annotated[tuple[str, ...], Option(repeat=True)] = ()
    """NAME=FILE, once for each block."""
    image: tuple[Path, Path] | None = None
    """An image to take over at 3/4 of its size, and the name to give it."""

    def run(self) -> None:
        """Do it."""
        text = self.document.read_text()
        for name, _, file in (argument.partition("=") for argument in self.block):
            text = with_block(text, name, without_images(Path(file).read_text()))
        if self.image:
            image = read_image(self.image[0])[None]
            write_image(
                self.image[1], interpolate(image, scale_factor=0.75, mode="bicubic", antialias=True)[0]
            )
        write_text(self.document, text)


def with_block(text: str, name: str, content: str) -> str:
    """The text, that block replaced. Raises ValueError if its marks are not there once, in order."""
    begin, end = (f"<!-- {name}:{which} -->" for which in ("begin", "end"))
    if text.count(begin) != 1 or text.count(end) != 1 or text.index(begin) > text.index(end):
        raise ValueError(f"the document needs one {begin} and, after it, one {end}")
    return f"{text[: text.index(begin)]}{begin}\n\n{content.strip()}\n\n{text[text.index(end) :]}"


def write_block(document: Path, name: str, content: str) -> None:
    """Replace that block of a document, atomically."""
    write_text(document, with_block(document.read_text(), name, content))


def without_images(text: str) -> str:
    """Markdown without the lines that are only an image."""
    return "".join(line for line in text.splitlines(keepends=True) if not line.startswith("!["))


if __name__ == "__main__":
    script(Readme).run()
