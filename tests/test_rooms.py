"""The rooms: which may import which, and no circle of files, read from the imports wherever they stand."""

import ast
from collections.abc import Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("arraygeom", "calib", "pat", "experiments")
GROUND = {"arraygeom", "arraygeom.runtime"}
LOWEST = GROUND | {"pat.attention", "pat.media", "pat.sensors", "pat.support"}
MATCHING = LOWEST | {"pat.matching"}
NETWORKS = MATCHING | {"pat.networks"}
FUSION = NETWORKS | {"pat.fusion"}
CALIB = {"calib", "calib.boards", "calib.images"}
APP = FUSION | CALIB | {"pat.app"}
LAB = APP | {"pat.lab"}
MAY_IMPORT = {
    "arraygeom.runtime": set(),
    "arraygeom": GROUND,
    "calib": set(),
    "calib.boards": GROUND | {"calib"},
    "calib.images": GROUND | {"calib", "calib.boards"},
    **dict.fromkeys(("pat.attention", "pat.media", "pat.sensors", "pat.support"), LOWEST),
    "pat.matching": MATCHING,
    "pat.networks": NETWORKS,
    "pat.fusion": FUSION,
    "pat.app": APP,
    "pat.lab": LAB,
    "pat": APP,
    "experiments": LAB | {"pat", "experiments"},
}
"""The rooms that a room may import beside itself; a room's own folders may import one another."""
NEVER = {
    "pat.fusion": {"pat.networks.paper", "pat.networks.guided", "pat.networks.bandwise"},
    "pat.networks": {"pat.matching.kernels"},
}
"""Files that a room may not import either: the fusion knows a network by its protocol alone."""
NAMES_THE_LAB = "pat.app.cli."
"""Where the command table may name the lab, to import it when one of its commands is called."""


def modules_below(root: Path) -> dict[str, Path]:
    """The Python files of the project's packages by module name."""
    paths = [path for package in PACKAGES for path in sorted((root / package).rglob("*.py"))]
    return {
        ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__"): path
        for path in paths
    }


def imports_of(root: Path) -> dict[str, set[str]]:
    """The modules of the project that each one imports: in functions and for type checkers, too."""
    modules = modules_below(root)

    def named(name: str) -> str:
        while name and name not in modules:
            name = name.rpartition(".")[0]
        return name

    def imported(module: str, path: Path) -> Iterator[str]:
        package = module.split(".") if path.name == "__init__.py" else module.split(".")[:-1]
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                yield from (named(alias.name) for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                base = package[: len(package) - node.level + 1] if node.level else []
                source = ".".join([*base, *filter(None, [node.module])])
                yield from (named(f"{source}.{alias.name}") for alias in node.names)

    return {module: {*imported(module, path)} - {"", module} for module, path in modules.items()}


def room(module: str) -> str:
    """The room of a module: the longest name in the table that it lies in."""
    return max((r for r in MAY_IMPORT if f"{module}.".startswith(f"{r}.")), key=len)


def crossings(imports: Mapping[str, set[str]]) -> list[str]:
    """The imports that the table does not allow, such as "pat.media.video > pat.fusion.fuse"."""
    return [
        f"{module} > {other}"
        for module, others in imports.items()
        for other in sorted(others)
        if room(other) not in MAY_IMPORT[room(module)] | {room(module)}
        or other in NEVER.get(room(module), ())
    ]


def circle(imports: Mapping[str, set[str]]) -> list[str]:
    """The modules of a circle of imports; none if there is none."""
    try:
        TopologicalSorter(imports).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def names_of_the_lab(root: Path) -> list[str]:
    """Modules outside the lab that name one of its modules in a string, as importing by name takes."""
    return [
        module
        for module, path in modules_below(root).items()
        if room(module) not in ("pat.lab", "experiments") and not module.startswith(NAMES_THE_LAB)
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Constant) and f"{node.value}:".startswith(("pat.lab.", "pat.lab:"))
    ]


def test_rooms_import_what_is_below_them():
    assert crossings(imports_of(ROOT)) == []


def test_no_circle_of_files():
    assert circle(imports_of(ROOT)) == []


def test_nothing_but_the_command_table_names_the_lab():
    assert names_of_the_lab(ROOT) == []


def test_every_folder_of_pat_is_a_room():
    folders = {f"pat.{path.parent.name}" for path in (ROOT / "pat").glob("*/__init__.py")}
    assert folders == {r for r in MAY_IMPORT if r.startswith("pat.")}


@pytest.mark.parametrize(
    ("module", "line", "target"),
    [
        ("pat.media.video", "from ..fusion.fuse import fuse", "pat.fusion.fuse"),
        ("pat.media.video", "def f():\n    import pat.fusion.fuse", "pat.fusion.fuse"),
        ("pat.fusion.tiles", "from ..networks import paper", "pat.networks.paper"),
        ("pat.fusion.tiles", "from calib.images.doctor import verdict", "calib.images.doctor"),
        ("pat.app.batch", "from ..lab.commands import Train", "pat.lab.commands"),
        ("calib.boards.rig", "from ..images import doctor", "calib.images.doctor"),
        ("arraygeom.runtime.chunks", "from ..pixels import HW", "arraygeom.pixels"),
        ("pat.lab.commands", "import experiments.fit", "experiments.fit"),
    ],
)
def test_a_forbidden_import_is_found(module, line, target, tmp_path):
    for name, text in ((target, ""), (module, line)):
        path = tmp_path.joinpath(*name.split(".")).with_suffix(".py")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    assert crossings(imports_of(tmp_path)) == [f"{module} > {target}"]


def test_a_circle_is_found_through_type_checkers_and_functions(tmp_path):
    (tmp_path / "calib").mkdir()
    (tmp_path / "calib/__init__.py").write_text("")
    (tmp_path / "calib/a.py").write_text("if TYPE_CHECKING:\n    from .b import B")
    (tmp_path / "calib/b.py").write_text("def f():\n    from . import a")
    assert {*circle(imports_of(tmp_path))} == {"calib.a", "calib.b"}


def test_the_lab_named_elsewhere_is_found(tmp_path):
    for module in ("app/cli/main.py", "app/batch.py"):
        (tmp_path / "pat" / module).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "pat" / module).write_text('train = import_module("pat.lab.commands")')
    assert names_of_the_lab(tmp_path) == ["pat.app.batch"]
