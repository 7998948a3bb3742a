"""Command line: `pat COMMAND ...`."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator, Mapping
from importlib.metadata import entry_points
from inspect import getdoc
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, ClassVar, NoReturn

from ...support.folders import error_text
from ...support.schema import near
from . import align, batch, calibration, demo, fuse, rigs, sequence
from .options import WARNED, refuse_missing, rig_first, say, warn
from .parser import UsageError, parse


class Lab:
    """Train, render, evaluate: for the development of networks."""

    # By name: the lab uses all rooms, and none of them imports it.
    commands: ClassVar[Mapping[str, Any]] = {
        name: f"pat.lab.commands:{name.capitalize()}"
        for name in ("train", "render", "evaluate", "ablate", "data", "settings", "weights")
    }


class Pat:
    """Fuse the images of an array of unlike cameras into one.

    The group of all commands: `commands` has a class, a group, or the path "module:Class" of one by word.
    """

    commands: ClassVar[Mapping[str, Any]] = {
        "fuse": fuse.Fuse,
        "batch": batch.FuseBatch,
        "sequence": sequence.FuseSequence,
        "align": align.Align,
        "show": rigs.Show,
        "explore": rigs.Explore,
        "calibrate": calibration.Calibrate,
        "board": calibration.PrintBoard,
        "rig": rigs.RigCommands,
        "demo": demo.Demo,
        "warm-up": demo.WarmUp,
        "lab": Lab,
    }


def command_named(group: Any, name: str) -> Any:
    """Return the command or group of that name in a group, imported if only its path is known.

    Raises:
        KeyError: for an unknown name.
    """
    command = group.commands[name]
    return resolve_name(command) if isinstance(command, str) else command


def command_paths(group: Any = Pat, before: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Yield the words of every command, such as ("rig", "info")."""
    for name in group.commands:
        command = command_named(group, name)
        inner = hasattr(command, "commands")
        yield from command_paths(command, (*before, name)) if inner else [(*before, name)]


def main(arguments: list[str] | None = None, *, group: Any = Pat, prog: str = "pat") -> None:
    """Run a command of `pat`, or of another group of commands.

    Errors, but a TypeError and the like of the program itself, are printed as one line on standard error;
    with --debug they are raised.

    Args:
        arguments: words after the program's name; None for this process's.
        group: class with `commands` by name, as `Pat`; `prog` is its name in messages.

    Raises:
        SystemExit: with status 0 after --help and --version, 2 for printed errors, 130 for an interrupt, 141
            for a broken pipe; others by the commands.
    """
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
    """Run the command; exceptions become one line and an exit status."""
    command = None
    try:
        with warnings.catch_warnings():
            warnings.showwarning = warn
            WARNED.clear()
            command = _command(_with_plugins(arguments), group, prog)
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
        _fail(error, _as_option(f"{error}", command), debug)
    except ImportError as error:
        remedy = "" if "pip install" in f"{error}" else ": in a checkout, pip install '.[all]'"
        _fail(error, f"{error}{remedy}", debug)
    except MemoryError as error:
        _fail(error, "out of memory: give smaller images, or --max-memory where there is one", debug)
    except Exception as error:
        notes = getattr(error, "__notes__", [])[:1]
        if not (notes or isinstance(error, RuntimeError | LookupError | ArithmeticError)):
            raise
        said = ", ".join([f"{type(error).__name__}: {error}", *notes])
        _fail(error, f"{said} (--debug shows where)", debug)


def _with_plugins(arguments: list[str]) -> list[str]:
    """The arguments without `--plugin MODULE`, once these and installed plugins are imported."""
    rest, names, words = [], [], iter(arguments)
    for word in words:
        option, _, value = word.partition("=")
        if option == "--plugin":
            names.append(value or next(words, ""))
        else:
            rest.append(word)
    if names or entry_points(group="arraygeom.plugins"):
        from arraygeom.runtime.extras import load_plugins  # imports torch

        load_plugins(names)
    return rest


def _as_option(text: str, command: Any) -> str:
    """A message that begins with an argument of Python's, as "alpha: ...", with the command's option."""
    name = text.partition(":")[0]
    options = {*getattr(command, "__dataclass_fields__", {})} - {"rig", "given", "source", "target"}
    return f"--{name.replace('_', '-')}{text[len(name) :]}" if name in options else text


def _fail(error: BaseException, text: str, debug: bool) -> NoReturn:
    if debug:
        raise error
    say(f"pat: {' '.join(line.strip() for line in text.splitlines())}", style="red")
    sys.exit(2)


def _command(arguments: list[str], group: Any, prog: str) -> Any:
    """Command that arguments name, with parsed options. Raises UsageError for an unknown one."""
    if "--version" in arguments:
        from importlib.metadata import version

        print(f"arraygeom-pat {version('arraygeom-pat')}")
        sys.exit(0)
    if arguments[:1] == ["help"]:
        arguments = [*arguments[1:], "--help"]
    path, command = prog, group
    while hasattr(command, "commands"):
        word = arguments[0] if arguments else "--help"
        if word in ("--help", "-h"):
            print(_help(path, command))
            sys.exit(0)
        if word not in command.commands:
            moved = command is Pat and word in Lab.commands
            wanted = f"`pat lab {word}`" if moved else f"a command{near(word, command.commands)}"
            raise UsageError(f"{path} {word}", wanted)
        path, command, arguments = f"{path} {word}", command_named(command, word), arguments[1:]
    try:
        if hasattr(command, "parse"):
            return command.parse(arguments, path)
        return parse(command, rig_first(arguments, command), prog=path)
    except UsageError as error:
        raise ValueError(f"{error} (`{path} --help` explains)") from None


def _help(path: str, group: Any) -> str:
    """Help of a group of commands: a line for each, from its docstring."""
    commands = {name: command_named(group, name) for name in group.commands}
    lines = [f"usage: {path} COMMAND ...", "", _first_line(group), "", "commands:"]
    lines += [f"  {name:10s} {_first_line(command)}" for name, command in commands.items()]
    lines += [
        "",
        f"`{path} COMMAND --help` explains a command's options; --debug shows an error's traceback;",
        "--plugin MODULE imports a camera, a field or a rig format of your own.",
    ]
    return "\n".join([*lines, *(["`pat --version` prints the version."] if group is Pat else [])])


def _first_line(command: Any) -> str:
    return (getdoc(command) or "").partition("\n")[0]
