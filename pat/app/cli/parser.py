"""Command lines from dataclasses and functions: an option for each field, of its type, with its docstring.

A field's `Annotated` type may hold an `Option`; a class's `headings` assign fields to headings of its help,
the others coming first. Imports nothing that takes long.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import inspect
import re
import sys
import textwrap
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, is_dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from ...support.schema import near

T = TypeVar("T")
WIDTH = 110
MISSING = dataclasses.MISSING


class UsageError(ValueError):
    """Error for a command line that cannot be run.

    Args:
        option: name of the option or argument.
        expected: description of what it expects.
        got: value that it got; None to leave that out of the message.
        text: message in place of both; empty for none.
    """

    def __init__(self, option: str, expected: str, got: object = None, *, text: str = "") -> None:
        said = f"expected {expected}" + (f", got {got}" if got is not None else "")
        super().__init__(f"{option}: {text or said}")


@dataclass(frozen=True)
class Option:
    """Properties of an option that a field's type does not state.

    Attributes:
        metavar: name of its value in the help; None for one by the field's type.
        help: help text; None for the field's docstring.
        short: short name, such as "-o"; None for none.
        also: further names, such as "--matches".
        positional: True for an argument without a name.
        repeat: True if the option is given once for each value.
    """

    metavar: str | None = None
    help: str | None = None
    short: str | None = None
    also: tuple[str, ...] = ()
    positional: bool = False
    repeat: bool = False


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        option, _, said = message.removeprefix("argument ").partition(": ")
        if option.startswith("the following"):
            option = said.partition(", ")[0]
            text = f"is needed: {(self._entry(option).help or '').rstrip('.')}"
            raise UsageError(option, "a value", text=text)
        if re.match(r"expected .* arguments?$", said):
            metavar = self._entry(option).metavar
            said = metavar if isinstance(metavar, str) else " ".join(metavar or ())
        raise UsageError(option, said.removeprefix("expected "))

    def _entry(self, option: str) -> argparse.Action:
        """Option or argument by the name that argparse gives it in messages."""
        return next(a for a in self._actions if option in ("/".join(a.option_strings), a.metavar, a.dest))


def parse(
    kind: Callable[..., T],
    arguments: Sequence[str] | None = None,
    *,
    prog: str = "",
    base: Any = None,
    description: str = "",
) -> T:
    """Parse a command line for a class or a function; returns the instance, or the function's result.

    Args:
        kind: dataclass or function whose fields or parameters are the options; its docstring is the help.
        arguments: words; None for this process's.
        prog: name of the program in the help; empty for this process's.
        base: instance of `kind` that holds the defaults, and is copied with changes; None for the class's.
        description: help text; empty for the docstring.

    Raises:
        UsageError: for unknown and missing options, and invalid values; what `kind` itself raises passes.
        SystemExit: after `--help`, which prints.
        OSError: for a dataclass without its source (`field_docs`).
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    parser = _Parser(
        prog=prog or None,
        description=(description or inspect.getdoc(kind) or "").replace("%", "%%"),
        formatter_class=partial(argparse.RawDescriptionHelpFormatter, max_help_position=34, width=WIDTH),
        allow_abbrev=False,
        add_help=False,
    )
    headings: Mapping[str, str] = getattr(kind, "headings", {})
    heading_of = {name: title for title, names in headings.items() for name in names.split()}
    groups = {title: parser.add_argument_group(title) for title in ("arguments", "options", *headings)}
    groups["options"].add_argument("-h", "--help", action="help", help="Print this help.")
    entries = list(_entries(kind, base))
    for entry in entries:
        title = "arguments" if entry.option.positional else heading_of.get(entry.name, "options")
        entry.add_to(groups[title])
    positional = [entry.metavar for entry in entries if entry.option.positional]
    parser.usage = " ".join([parser.prog, *positional, "[options]"]).replace("%", "%%")
    known, rest = parser.parse_known_intermixed_args(words)
    if rest:
        raise _unknown(rest[0], [f"--{entry.dashed}" for entry in entries if not entry.option.positional])
    values = {name: value for name, value in vars(known).items() if value is not argparse.SUPPRESS}
    given = {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
    if base is None:
        base = kind(**{name: given.pop(name) for name in [*given] if "." not in name})
    return _changed(base, given) if given else base


def script(kind: Callable[..., T], arguments: Sequence[str] | None = None) -> T:
    """Parse the command line of a stand-alone script, and end the process for a bad one.

    Arguments and result are as for `parse`.

    Raises:
        SystemExit: with one line, status 1, where `parse` raises UsageError, and after `--help`.
    """
    try:
        return parse(kind, arguments)
    except UsageError as error:
        sys.exit(f"{error}")


def _unknown(word: str, options: list[str]) -> UsageError:
    if word.startswith("-"):
        text = f"there is no such option{near(word, options)}"
        return UsageError(word.partition("=")[0], "another option", text=text)
    advice = ": write the option before each, as in --image a=A --image b=B" if "=" in word else ""
    return UsageError(word, f"an option before it{advice}")


def _changed(base: Any, given: Mapping[str, Any]) -> Any:
    """Copy of a dataclass with some entries changed, by their dotted names."""
    own = {name: value for name, value in given.items() if "." not in name}
    for part in {name.partition(".")[0] for name in given if "." in name}:
        inner = {n.partition(".")[2]: v for n, v in given.items() if n.startswith(f"{part}.")}
        own[part] = _changed(getattr(base, part), inner)
    return replace(base, **own)


@dataclass
class _Entry:
    """Field or parameter as an option."""

    name: str
    kind: Any
    default: Any
    doc: str
    option: Option = Option()

    def __post_init__(self) -> None:
        while typing.get_origin(self.kind) is typing.Annotated:
            self.kind, *more = typing.get_args(self.kind)
            self.option = next((entry for entry in more if isinstance(entry, Option)), self.option)
        if typing.get_origin(self.kind) in (typing.Union, types.UnionType):
            kinds = [kind for kind in typing.get_args(self.kind) if kind is not type(None)]
            self.kind = kinds[0] if len(kinds) == 1 else str
            self.__post_init__()

    @property
    def dashed(self) -> str:
        return self.name.replace("_", "-")

    @property
    def negated(self) -> str:
        """Negative option, such as --no-report and --recording.no-ideal."""
        before, dot, last = self.dashed.rpartition(".")
        return f"--{before}{dot}no-{last}"

    @property
    def metavar(self) -> str:
        return self.option.metavar or self.dashed.upper()

    @property
    def help(self) -> str:
        """Help text, with the default where that is informative."""
        text = " ".join((self.option.help or self.doc).split())
        value = self.default
        if value not in (None, (), "", MISSING) and not isinstance(value, bool) and "default" not in text:
            shown = " ".join(map(str, value)) if isinstance(value, tuple) else value
            text = f"{text.rstrip('.')} (default: {shown})." if text else f"Default: {shown}."
        return text.replace("%", "%%")

    def add_to(self, group: Any) -> None:
        """Add the option (a flag that is True by default as --no-NAME) to a parser's group (argparse's); if
        not given it leaves no entry in the result."""
        how: dict[str, Any] = {"default": argparse.SUPPRESS, "help": self.help}
        how |= {} if self.option.positional else {"dest": self.name}
        flag, members = f"--{self.dashed}", typing.get_args(self.kind)
        if self.kind is bool:
            off = self.default is True
            group.add_argument(self.negated if off else flag, action=f"store_{not off}".lower(), **how)
            return
        several = typing.get_origin(self.kind) is tuple
        convert, metavar = _conversion(members[0] if several else self.kind)
        how |= {"type": convert, "metavar": self.option.metavar or metavar}
        if several and self.option.repeat:
            how |= {"action": "append"}
        elif several and members[1:] == (...,):
            how |= {"nargs": "*"}
        elif several:
            names = tuple((self.option.metavar or " ".join([metavar] * len(members))).split())
            how |= {"nargs": len(members), "metavar": names}
        required = self.default is MISSING
        if self.option.positional:
            group.add_argument(self.name, **how, **({} if several or required else {"nargs": "?"}))
        else:
            names = (flag, *([self.option.short] if self.option.short else []), *self.option.also)
            group.add_argument(*names, required=required, **how)


def _conversion(kind: Any) -> tuple[Callable[[str], Any], str]:
    """Conversion from text to a type, and the name of such a value."""
    if typing.get_origin(kind) is typing.Literal:
        choices = {str(choice): choice for choice in typing.get_args(kind)}
        return partial(_chosen, choices), f"{{{','.join(choices)}}}"
    plain: dict[Any, tuple[Callable[[str], Any], str]] = {
        int: (partial(_number, int, "a whole number"), "N"),
        float: (partial(_number, float, "a number"), "NUMBER"),
        Path: (Path, "PATH"),
    }
    return plain.get(kind, (str, "TEXT"))


def _chosen(choices: Mapping[str, Any], text: str) -> Any:
    if text not in choices:
        raise argparse.ArgumentTypeError(f"expected one of {', '.join(choices)}, got '{text}'")
    return choices[text]


def _number(kind: Callable[[str], Any], name: str, text: str) -> Any:
    try:
        return kind(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected {name}, got '{text}'") from None


def _entries(kind: Any, base: Any, before: str = "") -> Iterator[_Entry]:
    """Options of a class or function; those of nested dataclasses have dotted names."""
    hints = typing.get_type_hints(kind, include_extras=True)
    if not is_dataclass(kind):
        for name, parameter in inspect.signature(kind).parameters.items():
            default = MISSING if parameter.default is parameter.empty else parameter.default
            yield _Entry(name, hints[name], default, "")
        return
    docs = field_docs(kind)
    for field in dataclasses.fields(kind):
        made = field.default_factory
        default = field.default if made is MISSING else made()
        default = default if base is None else getattr(base, field.name)
        if is_dataclass(default) and not isinstance(default, type):
            yield from _entries(type(default), default, f"{before}{field.name}.")
        elif field.init:
            yield _Entry(before + field.name, hints[field.name], default, docs.get(field.name, ""))


def field_docs(kind: Any) -> dict[str, str]:
    """Return the docstrings that follow some of a dataclass's fields, parents' included, by field.

    Raises:
        OSError: for a class whose source is not there; TypeError for a built-in one, `object` excepted.
    """
    docs: dict[str, str] = {}
    for parent in reversed(kind.__mro__):
        if parent is object:
            continue
        (body,) = ast.parse(textwrap.dedent(inspect.getsource(parent))).body
        for field, text in pairwise(typing.cast(ast.ClassDef, body).body):
            if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
                docs[ast.unparse(field.target)] = str(getattr(text.value, "value", ""))
    return docs
