"""The command line: `pat COMMAND ...`."""

from __future__ import annotations

import io
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import redirect_stderr
from dataclasses import make_dataclass
from importlib import import_module
from inspect import getdoc
from pathlib import Path
from typing import Annotated, Any, ClassVar, NoReturn, Union

import tyro

from ...support.folders import error_text
from . import align, calibration, demo, fuse, rigs
from .options import WARNED, refuse_missing, respelled, say, warn

research: Any = import_module("pat.lab.commands")
"""By name: the lab uses all rooms, and none of them imports it."""


class Pat:
    """Fuse the images of an array of unlike cameras into one."""

    users: ClassVar[Mapping[str, Any]] = {
        "fuse": fuse.Fuse,
        "align": align.Align,
        "show": rigs.Show,
        "explore": rigs.Explore,
        "calibrate": calibration.Calibrate,
        "board": calibration.PrintBoard,
        "rig": rigs.RigCommands,
        "demo": demo.Demo,
        "warm-up": demo.WarmUp,
    }
    research: ClassVar[Mapping[str, Any]] = {
        "evaluate": research.Evaluate,
        "ablate": research.Ablate,
        "data": research.Data,
        "render": research.Render,
        "train": research.Train,
        "settings": research.Settings,
        "weights": research.WeightsCommands,
    }
    commands: ClassVar[Mapping[str, Any]] = {**users, **research}


def command_paths(group: Any = Pat, before: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """The words of every command, such as ("rig", "info")."""
    for name, command in group.commands.items():
        inner = hasattr(command, "commands")
        yield from command_paths(command, (*before, name)) if inner else [(*before, name)]


def main(arguments: list[str] | None = None, *, group: Any = Pat, prog: str = "pat") -> None:
    """Run `pat`, or another group. Errors in what was given: a line on standard error and exit status 2."""
    arguments = sys.argv[1:] if arguments is None else arguments
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:  # closed: the next file that is opened would take its place
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115
    try:
        try:
            _run([a for a in arguments if a != "--debug"], group, prog, debug="--debug" in arguments)
        finally:
            sys.stdout.flush()
    except OSError as error:  # of the flush
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(error, BrokenPipeError):
            say(f"pat: standard output: {error.strerror}", style="red")
        sys.exit(141 if isinstance(error, BrokenPipeError) else 2)


def _run(arguments: list[str], group: Any, prog: str, *, debug: bool) -> None:
    """Run the command; whatever it raises becomes one line and an exit status."""
    try:
        with warnings.catch_warnings():
            warnings.showwarning = warn
            WARNED.clear()
            command = _command(arguments, group, prog)
            if isinstance(rig := getattr(command, "rig", None), Path):
                refuse_missing(rig, rig=True)
            command.run()
    except KeyboardInterrupt:
        say("pat: interrupted; no file is left incomplete", style="red")
        sys.exit(130)
    except BrokenPipeError:
        raise
    except OSError as error:
        _fail(error, error_text(error), debug)
    except (ValueError, FloatingPointError) as error:
        _fail(error, f"{error}", debug)
    except ImportError as error:
        remedy = "" if "pip install" in f"{error}" else ": pip install 'arraygeom-pat[all]'"
        _fail(error, f"{error}{remedy}", debug)
    except MemoryError as error:
        _fail(error, "out of memory: give smaller images, or --max-memory where there is one", debug)
    except Exception as error:
        notes = getattr(error, "__notes__", [])[:1]
        if not (notes or isinstance(error, RuntimeError | LookupError | ArithmeticError)):
            raise
        said = ", ".join([f"{type(error).__name__}: {error}", *notes])
        _fail(error, f"{said} (--debug shows where)", debug)


def _fail(error: BaseException, text: str, debug: bool) -> NoReturn:
    if debug:
        raise error
    say(f"pat: {' '.join(line.strip() for line in text.splitlines())}", style="red")
    sys.exit(2)


def _command(arguments: list[str], group: Any, prog: str) -> Any:
    """The command that arguments name, options parsed. Raises ValueError for one that does not exist."""
    if "--tyro-print-completion" in arguments or "--tyro-write-completion" in arguments:
        return tyro.cli(_union(group), prog=prog, args=arguments)
    if "--version" in arguments:
        from importlib.metadata import version

        print(f"arraygeom-pat {version('arraygeom-pat')}")
        sys.exit(0)
    path, command = prog, group
    while hasattr(command, "commands"):
        word = arguments[0] if arguments else "--help"
        if word in ("--help", "-h"):
            print(_help(path, command))
            sys.exit(0)
        if word not in command.commands:
            from ...support.schema import near

            raise ValueError(f"no command '{path} {word}'{near(word, command.commands)}")
        path, command, arguments = f"{path} {word}", command.commands[word], arguments[1:]
    arguments = respelled(arguments, command)
    return parsed(command, path, arguments)


def _help(path: str, group: Any) -> str:
    """The help of a group of commands: a line for each, from its docstring."""
    parts = {"commands": group.commands}
    if group is Pat:
        parts = {"commands": Pat.users, "for the development of networks": Pat.research}
    lines = [f"usage: {path} COMMAND ...", "", _first_line(group)]
    for title, commands in parts.items():
        lines += ["", f"{title}:"]
        lines += [f"  {name:10s} {_first_line(command)}" for name, command in commands.items()]
    lines += [
        "",
        f"`{path} COMMAND --help` explains a command's options; --debug shows an error's traceback.",
    ]
    return "\n".join([*lines, *(["`pat --version` prints the version."] if group is Pat else [])])


def _first_line(command: Any) -> str:
    return (getdoc(command) or "").partition("\n")[0]


def _union(group: Any) -> Any:
    """All commands of a group as one type, for the completion of the shell."""
    made = []
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            inner = tyro.conf.OmitSubcommandPrefixes[_union(command)]
            command = make_dataclass(name, [("command", inner)])
        made.append(Annotated[command, tyro.conf.subcommand(name)])
    return Union[tuple(made)]  # noqa: UP007


def _choices(value: str, option: str, choices: str) -> str:
    """What an option can be, without the None of one that may be left out, numbers in order."""
    named = [choice for choice in choices.split(", ") if choice != "'None'"]
    if all(choice.strip("'").isdecimal() for choice in named):
        named.sort(key=lambda choice: int(choice.strip("'")))
    return f"{option}: {value} is not one of {', '.join(named)}"


REWORDED: tuple[tuple[str, str | Callable[[re.Match[str]], str]], ...] = (
    (r"^Error parsing TrainConfig: ", ""),
    (r"^Error parsing (\S+): ", r"\1: "),
    (
        r"no type matching (?:\{None\}\|)?\{(.+?)\} could be instantiated from \[(.*?)\].*",
        r"wanted \1, got \2",
    ),
    (r"Could not find valid parse for arguments: \[(.*?)\].*", r"\1 does not fit"),
    (r"invalid literal for int\(\) with base 10: (.+)", r"\1 is not a whole number"),
    (r"could not convert string to float: (.+)", r"\1 is not a number"),
    (
        r"^invalid choice (.+) for argument '(\S+)'\. Expected one of \((.*?),?\)\.",
        lambda match: _choices(*match.groups()),
    ),
    (r"^Missing value for argument '(\S+)'.*", r"\1: give a value"),
    (r"^Missing from .+?: (\S+) (.+?) \(required\)", r"\1 is missing: \2"),
    (
        r"^Unrecognized options: ([^-\s]\S*=\S+).*",
        r"\1: write the option before each, as in --image a=A --image b=B",
    ),
    (r"^Unrecognized options: ", r"unknown here: "),
    (r" Perhaps you meant: (\S+).*", r"; did you mean \1?"),
)
"""tyro's messages, and the same in the words of `--help`."""


def parsed(command: Any, prog: str, arguments: list[str]) -> Any:
    """The command with its options. Raises ValueError, one line, for what tyro refuses; `--help` exits."""
    said = io.StringIO()
    try:
        with redirect_stderr(said):
            if hasattr(command, "parse"):
                return command.parse(arguments)
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
    # without a frame, where the terminal has no Unicode, the title is underlined
    lines = box.strip().splitlines()
    rows = [row.strip("│ ") for row in (lines[1:-1] if box.startswith("╭") else lines[2:])]
    said = [" ".join(text.split()) for text in re.split(r"[─-]{9,}", " ".join(rows))]
    hints = [sentence for sentence in said[1:] if sentence.startswith("Perhaps you meant")]
    text = " ".join(sentence for sentence in (*said[:1], *hints) if sentence)
    for pattern, words in REWORDED:
        text = re.sub(pattern, words, text)
    return text
