"""No public name appears or vanishes by accident: each is listed in public_names.txt."""

import ast
from pathlib import Path

ROOT = Path(__file__).parents[1]
LISTED = Path(__file__).with_name("public_names.txt")


def public(path: Path) -> list[str]:
    """Return the names that a module offers: `__all__`, or its definitions without an underscore, without
    imports."""
    tree = ast.parse(path.read_text())
    names: list[str] = []
    for node in tree.body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        assigned = [t.id for t in targets if isinstance(t, ast.Name)]
        if "__all__" in assigned:
            return ast.literal_eval(node.value)
        defined = isinstance(node, (ast.FunctionDef, ast.ClassDef))
        names += [n for n in ([node.name] if defined else assigned) if not n.startswith("_")]
    return names


def every_name() -> list[str]:
    paths = sorted(
        p for package in ("arraygeom", "pat", "calib") for p in (ROOT / package).rglob("__init__.py")
    )
    modules = {".".join(p.relative_to(ROOT).parent.parts): public(p) for p in paths}
    return sorted(f"{module}.{name}" for module, names in modules.items() for name in names)


def test_public_names_are_those_listed():
    listed, found = set(LISTED.read_text().split()), set(every_name())
    assert found - listed == set(), "new: if meant, `python tests/test_public_names.py` lists them"
    assert listed - found == set(), "gone: if meant, `python tests/test_public_names.py` takes them out"


if __name__ == "__main__":
    LISTED.write_text("\n".join(every_name()) + "\n")
