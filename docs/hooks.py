"""What the site's pages take from elsewhere.

In place of a link titled "included", alone in its line, the file or notebook it leads to; in place of the
comment `<!-- commands -->` what is made of the code. On a code host the link is a link.
"""

from __future__ import annotations

import base64
import contextlib
import io
import json
import os
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
MISSING = "*(not made yet)*"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Fill in what a page asks for."""
    markdown = re.sub(
        r'(?m)^\[[^]]*\]\((?:\.\./)+(\S+) "included"\)$', lambda found: included(found[1]), markdown
    )
    if "<!-- commands -->" in markdown:
        markdown = markdown.replace("<!-- commands -->", commands())
    return markdown


def included(name: str) -> str:
    """A notebook, or a file of the repository without its first heading; a note if it has not been made."""
    path = ROOT / name
    if path.suffix == ".ipynb":
        return notebook(path.stem)
    if not path.exists():
        return MISSING
    return re.sub(r"\A# .*\n", "", path.read_text(encoding="utf-8"))


def notebook(name: str) -> str:
    """A notebook as it stands in the repository, with what it put out. Its links lead to these pages."""
    cells = json.loads((ROOT / "notebooks" / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"]
    text = "\n\n".join(part for cell in cells for part in cell_parts(cell))
    return re.sub(r"\]\((\d_\w+)\.ipynb\)", r"](\1.md)", text).replace("](../docs/", "](../")


def cell_parts(cell: dict[str, Any]) -> list[str]:
    """Markdown as it is; code, and below it what was printed and drawn."""
    source = "".join(cell["source"])
    if cell["cell_type"] == "markdown":
        return [source]
    return [f"```python\n{source}\n```", *(shown(output) for output in cell["outputs"])]


def shown(output: dict[str, Any]) -> str:
    """An image, of the size that its notebook shows it with; a table, or text."""
    data = output.get("data", {})
    for kind in ("text/markdown", "text/html"):
        if kind in data:
            return "".join(data[kind])
    if "image/svg+xml" in data:
        drawing = base64.b64encode("".join(data["image/svg+xml"]).encode()).decode()
        return f'<img class="figure" alt="" src="data:image/svg+xml;base64,{drawing}">'
    if "image/png" in data:
        size = output["metadata"].get("image/png", {})
        width = f' width="{size["width"]}"' if "width" in size else ""
        image = "".join(data["image/png"]).replace("\n", "")
        return f'<img class="figure" alt=""{width} src="data:image/png;base64,{image}">'
    text = "".join(output.get("text") or data.get("text/plain", ""))
    return f"```text\n{text.rstrip()}\n```"


def commands() -> str:
    """Every command with what its --help says."""
    from pat.app.cli.main import command_paths

    return "\n".join(
        f"## pat {' '.join(path)}\n\n```text\n{help_of(path)}\n```\n" for path in command_paths()
    )


def help_of(path: tuple[str, ...]) -> str:
    """What `pat PATH --help` prints, without colours."""
    from pat.app.cli.main import main

    os.environ |= {"COLUMNS": "110", "NO_COLOR": "1", "TERM": "dumb"}
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        main([*path, "--help"])
    text = re.sub(r"\x1b\[[0-9;]*m", "", printed.getvalue())
    return "\n".join(line.rstrip() for line in text.strip().splitlines())
