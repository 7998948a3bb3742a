"""Docstrings begin with a verb or a noun, and name what a public function returns and raises."""

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from itertools import chain, pairwise
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]
UNREVISED: tuple[str, ...] = ()
"""Rooms whose docstrings are not revised yet: to shrink to none, and never to grow."""
VAGUE = ("What", "How", "Of", "Those", "That", "By", "As", "Whether")
"""First words that leave open what a thing yields."""
MOST_VAGUE = 0.05
"""Largest share of a room's docstrings that may begin so."""
NAMING = {
    *("Return", "Yield", "Compute", "Read", "List", "Make", "Draw", "Convert", "Format", "Build", "Describe"),
    *(
        "Encode",
        "Decode",
        "Evaluate",
        "Multiply",
        "Select",
        "Round",
        "Compose",
        "Sample",
        "Estimate",
        "Parse",
    ),
    *("Summarise", "Load", "Permute", "Keep", "Import", "Open", "Enlarge", "Warp", "Derive", "Assemble"),
    *("Average", "Plot", "Escape", "Combine", "Adjust", "Extract", "Observe", "Fit", "Detect", "Reduce"),
    *("Split", "Stack", "Join", "Add", "Apply", "Find", "Name", "Clamp", "Scale", "Reshape", "Append"),
    *("Correct", "Measure", "Shorten", "Check", "Say", "Count", "Context"),
}
"""First words whose object is what a function returns ("Context manager" too): it needs no `Returns:`."""
NOT_NAMED = {"NotImplementedError", "AssertionError", "StopIteration"}
"""Exceptions that are no part of a function's contract."""


class Documented(NamedTuple):
    """A docstring with the code that it belongs to.

    Attributes:
        place: path and qualified name.
        node: definition; None for a string after a constant.
        text: the docstring.
        is_public: True if no name on the way to it begins with an underscore.
    """

    place: str
    node: ast.AST | None
    text: str
    is_public: bool


def documented(node: ast.AST, place: str, *, is_public: bool = True) -> Iterator[Documented]:
    """Yield the docstrings of a module or class and of its contents, functions within functions excepted."""
    if text := ast.get_docstring(node):  # type: ignore[arg-type]
        yield Documented(place, node, text, is_public)
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        return
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            public = is_public and (not child.name.startswith("_") or child.name == "__call__")
            yield from documented(child, f"{place}:{child.name}", is_public=public)
    body = getattr(node, "body", [])
    for assigned, string in pairwise(body):
        if isinstance(assigned, ast.Assign | ast.AnnAssign) and isinstance(string, ast.Expr):
            text = string.value.value if isinstance(string.value, ast.Constant) else None
            if isinstance(text, str):
                yield Documented(f"{place}:{string.lineno}", None, text, is_public)


@cache
def rooms() -> dict[str, list[Documented]]:
    """Return every room's docstrings, by its folder."""
    found = defaultdict(list)
    for package in ("arraygeom", "calib", "pat"):
        for path in sorted((ROOT / package).rglob("*.py")):
            place = path.relative_to(ROOT)
            room = "/".join(place.parts[:2]) if len(place.parts) > 2 else package
            found[room] += documented(ast.parse(path.read_text(encoding="utf-8")), str(place))
    return dict(found)


def functions(room: str) -> Iterator[tuple[Documented, ast.FunctionDef]]:
    """Yield the public functions and methods of a room with a docstring; commands' are their help."""
    for each in rooms()[room]:
        is_help = each.place.startswith("pat/app/cli")
        if each.is_public and not is_help and isinstance(each.node, ast.FunctionDef):
            yield each, each.node


def is_property(node: ast.FunctionDef) -> bool:
    """Return True if a method is read like an attribute."""
    return any("property" in ast.unparse(decorator) for decorator in node.decorator_list)


def raised(node: ast.AST) -> Iterator[str]:
    """Yield the names of the exceptions that a function's own statements raise and do not catch."""
    for part in ast.iter_child_nodes(node):
        if isinstance(part, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef | ast.Lambda):
            continue
        if isinstance(part, ast.Raise) and part.exc is not None:
            kind = part.exc.func if isinstance(part.exc, ast.Call) else part.exc
            name = ast.unparse(kind).rpartition(".")[2]
            if name == "fail":  # of a rig file being read
                yield "RigFileError"
            elif name[:1].isupper() and name not in NOT_NAMED:
                yield name
        if isinstance(part, ast.Try):
            caught = " ".join(ast.unparse(handler).partition(":")[0] for handler in part.handlers)
            tried = ast.Module(part.body, [])
            yield from (name for name in raised(tried) if name not in caught)
            yield from raised(ast.Module([*part.handlers, *part.orelse, *part.finalbody], []))  # type: ignore[list-item]
        else:
            yield from raised(part)


def listed(text: str, section: str) -> set[str]:
    """Return the names that a docstring's section lists."""
    match = re.search(rf"^{section}:\n((?:    .*\n?|\n)*)", text + "\n", re.MULTILINE)
    return set(re.findall(r"^    \*{0,2}(\w+): ", match[1], re.MULTILINE)) if match else set()


def arguments(node: ast.FunctionDef) -> set[str]:
    """Return the names of a function's arguments."""
    given = node.args
    several = [one for one in (given.vararg, given.kwarg) if one is not None]
    return {one.arg for one in (*given.posonlyargs, *given.args, *given.kwonlyargs, *several)}


def fields(node: ast.ClassDef) -> set[str]:
    """Return the names of a class's fields and its bases', and of the attributes that its methods use."""
    bases = [base for one in node.bases for base in classes().get(ast.unparse(one), ())]
    stated = [one.target for one in node.body if isinstance(one, ast.AnnAssign)]
    used = [
        one for one in ast.walk(node) if isinstance(one, ast.Attribute) and ast.unparse(one.value) == "self"
    ]
    own = {one.id for one in stated if isinstance(one, ast.Name)} | {one.attr for one in used}
    return own.union(*map(fields, bases))


@cache
def classes() -> dict[str, list[ast.ClassDef]]:
    """Return the public classes of all rooms by name."""
    found: dict[str, list[ast.ClassDef]] = {}
    for each in chain(*rooms().values()):
        if isinstance(each.node, ast.ClassDef):
            found.setdefault(each.node.name, []).append(each.node)
    return found


REVISED = sorted(set(rooms()) - set(UNREVISED))


def test_only_rooms_that_exist_are_left_out():
    assert set(UNREVISED) <= set(rooms())


@pytest.mark.parametrize("room", REVISED)
def test_docstrings_begin_with_a_verb_or_a_noun(room):
    vague = [each.place for each in rooms()[room] if each.text.split()[0] in VAGUE]
    assert len(vague) <= MOST_VAGUE * len(rooms()[room]), f"say what the thing yields: {vague}"


@pytest.mark.parametrize("room", REVISED)
def test_public_functions_name_what_they_return(room):
    silent = [
        each.place
        for each, node in functions(room)
        if node.returns is not None
        and ast.unparse(node.returns) not in ("None", "NoReturn")
        and not is_property(node)
        and not any(section in each.text for section in ("Returns:", "Yields:"))
        and each.text.split()[0] not in NAMING
    ]
    assert not silent, f"add `Returns:`, or begin with a verb whose object is the result: {silent}"


@pytest.mark.parametrize("room", REVISED)
def test_public_functions_name_what_they_raise(room):
    unnamed = [
        f"{each.place} raises {name}"
        for each, node in functions(room)
        for name in sorted(set(raised(node)))
        if name not in each.text
    ]
    assert not unnamed, f"name it in `Raises:` and say for what: {unnamed}"


@pytest.mark.parametrize("room", sorted(rooms()))
def test_sections_name_arguments_and_fields_that_are_there(room):
    absent = []
    for each in rooms()[room]:
        names: set[str] = set()
        if isinstance(each.node, ast.FunctionDef):
            names = listed(each.text, "Args") - arguments(each.node)
        elif isinstance(each.node, ast.ClassDef):
            made = [
                one for one in each.node.body if isinstance(one, ast.FunctionDef) and one.name == "__init__"
            ]
            names = listed(each.text, "Attributes") - fields(each.node)
            names |= listed(each.text, "Args") - set().union(*map(arguments, made)) if made else set()
        absent += [f"{each.place}: {name}" for name in sorted(names)]
    assert not absent, f"documented, and not there: {absent}"
