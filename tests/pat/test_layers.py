"""Rooms that make and hold images import only the rooms below them."""

import ast
from pathlib import Path

import pytest

PAT = Path(__file__).parents[2] / "pat"
BELOW = {
    "support": set(),
    "media": set(),
    "sensors": {"media", "support"},
    "synthesis": {"media", "sensors", "support"},
    "data": {"media", "sensors", "synthesis", "support"},
}


def rooms_imported(path: Path) -> set[str]:
    """The rooms of `pat` that a file imports, absolutely or relatively."""
    own = ("pat", *path.relative_to(PAT).parent.parts)
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            base = own[: len(own) - node.level + 1] if node.level else ()
            module = (*base, *(node.module or "").split("."))
        elif isinstance(node, ast.Import):
            module = tuple(node.names[0].name.split("."))
        else:
            continue
        if module[0] == "pat" and len(module) > 1 and module[1]:
            found.add(module[1])
    return found


@pytest.mark.parametrize("room", BELOW)
def test_a_room_imports_only_rooms_below_it(room):
    allowed = BELOW[room] | {room}
    assert {
        p.name: rooms_imported(p) - allowed for p in (PAT / room).rglob("*.py") if rooms_imported(p) - allowed
    } == {}
