"""A command's options parsed by tyro, whose boxes of text become one line."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from contextlib import redirect_stderr
from typing import Any

import tyro


def _choices(given: str, option: str, choices: str) -> str:
    """What an option can be, without the None of one that may be left out, numbers in order."""
    named = [choice for choice in choices.split(", ") if choice != "'None'"]
    if all(choice.strip("'").isdecimal() for choice in named):
        named.sort(key=lambda choice: int(choice.strip("'")))
    return f"{option}: {given} is not one of {', '.join(named)}"


REWORDED: tuple[tuple[str, str | Callable[[re.Match[str]], str]], ...] = (
    (r"^Error parsing (\S+): ", r"\1: "),
    (r"no type matching (?:\{None\}\|)?\{(.+?)\} could be instantiated from \[(.*?)\].*", r"wanted \1, got \2"),
    (r"Could not find valid parse for arguments: \[(.*?)\].*", r"\1 does not fit"),
    (r"invalid literal for int\(\) with base 10: (.+)", r"\1 is not a whole number"),
    (r"could not convert string to float: (.+)", r"\1 is not a number"),
    (
        r"^invalid choice (.+) for argument '(\S+)'\. Expected one of \((.*?),?\)\.",
        lambda found: _choices(*found.groups()),
    ),
    (r"^Missing value for argument '(\S+)'.*", r"\1: give a value"),
    (r"^Missing from .+?: (\S+) (.+?) \(required\)", r"\1 is missing: \2"),
    (r"^Unrecognized options: ", r"unknown here: "),
    (r" Perhaps you meant: (\S+).*", r"; did you mean \1?"),
)
"""tyro's messages, and the same in the words of `--help`."""


def parsed(command: Any, prog: str, arguments: list[str]) -> Any:
    """The command with its options. Raises ValueError, one line, for what tyro refuses; `--help` exits."""
    said = io.StringIO()
    try:
        with redirect_stderr(said):
            return tyro.cli(command, prog=prog, args=arguments, config=(tyro.conf.DisallowNone,))
    except SystemExit as stop:
        if not stop.code:
            raise
    raise ValueError(f"{reworded(said.getvalue())} (`{prog} --help` explains)")


def reworded(box: str) -> str:
    """One line of what a box of tyro says, without the help that it repeats.

    >>> reworded("╭─ Unrecognized options ──╮\\n│ Unrecognized options: --x │\\n╰─────╯")
    'unknown here: --x'
    """
    lines = box.strip().splitlines()  # without a frame, where the terminal has no Unicode, the title is underlined
    rows = [row.strip("│ ") for row in (lines[1:-1] if box.startswith("╭") else lines[2:])]
    said = [" ".join(text.split()) for text in re.split(r"[─-]{9,}", " ".join(rows))]
    text = " ".join(part for i, part in enumerate(said) if part and (i == 0 or part.startswith("Perhaps you meant")))
    for pattern, words in REWORDED:
        text = re.sub(pattern, words, text)
    return text
