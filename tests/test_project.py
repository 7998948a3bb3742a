"""The project agrees with itself: names, versions, and what its documents say."""

import ast
import doctest
import functools
import importlib
import importlib.metadata
import inspect
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from arraygeom.runtime.extras import needs

ROOT = Path(__file__).parents[1]
PACKAGES = ("arraygeom", "pat", "calib")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = {"OpenEXR", "Imath", "triton", "jupyterlab"}
"""Modules that need not be installed."""

SHAPED = {
    "Float",
    "Float32",
    "Float64",
    "Bool",
    "Int",
    "Int32",
    "Int64",
    "UInt8",
    "Integer",
    "Real",
    "Num",
    "Shaped",
}

READING_FILES = {
    *("open", "read_text", "read_bytes", "write_text", "write_bytes", "safe_load"),
    *(
        "imread",
        "imwrite",
        "FileStorage",
        "loadtxt",
        "savetxt",
        "genfromtxt",
        "loadmat",
        "fromfile",
        "tofile",
    ),
}


def sources(*packages: str) -> list[Path]:
    return [path for package in packages for path in sorted((ROOT / package).rglob("*.py"))]


@functools.cache
def imports(path: Path, *, at_once: bool = False) -> set[str]:
    """The outermost names of all modules that a file imports from other packages.

    `at_once`: by being imported, so not those in functions, nor for type checkers.
    """
    names: set[str] = set()
    tree = ast.parse(path.read_text())
    for node in tree.body if at_once else ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names.add(node.module.partition(".")[0])
    return names


@functools.cache
def names(path: Path) -> set[str]:
    """All names that a file's code uses: variables, attributes, imported names."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Name):
            found.add(node.id)
        elif isinstance(node, ast.Attribute):
            found.add(node.attr)
        elif isinstance(node, ast.alias):
            found.add(node.name.rpartition(".")[2])
    return found


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def load(path: Path):
    try:
        return importlib.import_module(module_name(path))
    except ModuleNotFoundError as error:
        if error.name in EXTRAS:
            pytest.skip(f"{error.name} is not installed")
        raise


def each(paths: list[Path]):
    return pytest.mark.parametrize("path", paths, ids=module_name)


def pins() -> dict[str, list[Requirement]]:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    found: dict[str, list[Requirement]] = {}
    for pin in (Requirement(line) for line in lines if line and not line.startswith("#")):
        found.setdefault(canonicalize_name(pin.name), []).append(pin)
    return found


def blocks(document: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", (ROOT / document).read_text(), re.M | re.S)


def test_arraygeom_has_no_network():
    assert [p.name for p in sources("arraygeom") if names(p) & {"Module", "Parameter", "Sequential"}] == []


def test_one_module_uses_grid_sample():
    assert [module_name(p) for p in sources(*PACKAGES) if "grid_sample" in names(p)] == ["arraygeom.sampling"]


GEOMETRY_NEEDS = {"torch", "kornia", "numpy", "yaml", "jaxtyping", *sys.stdlib_module_names}
GEOMETRY_MAY_USE = {
    "atomic.py": {"filelock"},
    "compiled.py": {"numba"},
    "opencv.py": {"cv2"},
    "image_bytes.py": {"cv2", "kornia_rs", "PIL", "tifffile"},
    "matfile.py": {"scipy"},
    "viz.py": {"matplotlib"},
    "xmp.py": {"PIL"},
}
"""What single files of arraygeom import when it is needed, and say so in one line where it is not there."""


@each(sources("arraygeom"))
def test_arraygeom_needs_few_packages(path):
    assert imports(path, at_once=True) <= GEOMETRY_NEEDS - {"kornia"}, (
        "kornia takes 0.4 s to import: import it where used"
    )
    assert imports(path) <= GEOMETRY_NEEDS | GEOMETRY_MAY_USE.get(path.name, set())


def test_importing_arraygeom_and_fusion_is_light():
    code = "import sys, {}; print(*sorted(sys.modules))"

    def loaded(module: str) -> set[str]:
        done = subprocess.run(
            [sys.executable, "-c", code.format(module)], cwd=ROOT, capture_output=True, text=True
        )
        return set(done.stdout.split())

    assert not loaded("arraygeom") & {"kornia", "cv2", "scipy", "matplotlib"}
    of_batches = loaded("pat.app.batch")
    assert "pat.fusion.fuse" in of_batches
    assert not of_batches & {"matplotlib", "av", "anywidget", "bpy"}


def test_an_optional_package_that_is_missing_is_named_with_its_extra():
    with (
        pytest.raises(ImportError, match=r"'\.\[video\]'"),
        needs("video", "writing video"),
    ):
        importlib.import_module("av_.video")


def test_extras_exist_that_messages_name():
    extras = PROJECT["optional-dependencies"]
    named = {n for p in sources(*PACKAGES) for n in re.findall(r'needs\("(\w+)", "', p.read_text())}
    named |= {
        extra
        for texts in extras.values()
        for text in texts
        for extra in Requirement(text).extras
        if "pat" in text
    }
    assert {"video", "plots", "calibration"} <= named <= set(extras)


def test_arraygeom_touches_files_only_in_io():
    assert {
        p.name: names(p) & READING_FILES
        for p in sources("arraygeom")
        if names(p) & READING_FILES
        and "io" not in p.relative_to(ROOT).parts
        and p.name not in ("atomic.py", "compiled.py", "together.py")
    } == {}


def test_arraygeom_draws_only_in_viz():
    assert [p.name for p in sources("arraygeom") if imports(p) & {"matplotlib"} and p.stem != "viz"] == []


def test_at_most_one_module_imports_blender():
    assert len([p for p in sources(*PACKAGES) if "bpy" in imports(p)]) <= 1


@each([p for p in sources(*PACKAGES) if "jaxtyping" in imports(p)])
def test_shapes_are_strings(path):
    """Shapes that a formatter has unquoted, `Float[Tensor, b * n]`, mean something else or nothing."""
    subscripts = [n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.Subscript)]
    shaped = [n for n in subscripts if isinstance(n.value, ast.Name) and n.value.id in SHAPED]
    unquoted = [n for n in shaped if not isinstance(n.slice.elts[1], ast.Constant)]
    assert [f"line {n.lineno}: {ast.unparse(n)}" for n in unquoted] == []


@each([p for p in sources(*PACKAGES) if p.name == "__init__.py"])
def test_public_names_exist_and_are_documented(path):
    module = load(path)
    for name in getattr(module, "__all__", []):
        value = getattr(module, name)
        if inspect.isclass(value) or inspect.isfunction(value):
            assert value.__doc__, f"{name} has no docstring"
            assert not value.__doc__.startswith(f"{name}("), f"{name} has only the docstring Python made"


@each([p for p in sources(*PACKAGES) if ">>>" in p.read_text()])
def test_examples_in_docstrings(path):
    results = doctest.testmod(load(path))
    assert results.attempted
    assert not results.failed


def test_every_public_class_name_occurs_once():
    places: dict[str, list[str]] = {}
    for path in sources(*PACKAGES):
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places.setdefault(node.name, []).append(module_name(path))
    assert {name: modules for name, modules in places.items() if len(modules) > 1} == {}


def test_one_version():
    newest = re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.M)
    assert newest
    assert newest[1] == PROJECT["version"] == importlib.metadata.version(PROJECT["name"])


def test_what_is_asked_for_is_pinned_exactly_and_in_range():
    pinned = pins()
    optional = PROJECT["optional-dependencies"]
    for text in PROJECT["dependencies"] + optional["dev"] + optional["video"] + optional["plots"]:
        asked = Requirement(text)
        for pin in pinned[canonicalize_name(asked.name)]:
            (only,) = pin.specifier
            assert only.operator == "=="
            assert "+" not in only.version, "a local version exists on one index only"
            assert asked.specifier.contains(only.version), f"{pin} is not in {asked}"


def test_documents_name_targets_and_files_that_exist():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M))
    for document in ("README.md", "CONTRIBUTING.md"):
        text = (ROOT / document).read_text()
        assert set(re.findall(r"^make (\S+)", text, re.M)) <= targets
        assert [link for link in re.findall(r"\]\(([^):#]+)\)", text) if not (ROOT / link).exists()] == []


def test_continuous_integration_can_start():
    assert os.access(ROOT / ".ci/run", os.X_OK)


def test_licence_is_the_one_stated():
    text = (ROOT / "LICENSE").read_text()
    assert PROJECT["license"] == "Apache-2.0"
    assert "Apache License\n                           Version 2.0, January 2004" in text


def test_no_message_or_page_installs_this_distribution_from_an_index():
    """Nobody owns its name there: an installation by that name would run a stranger's code."""
    named = re.compile(r"install[^\n]*['\" ]arraygeom-pat")
    texts = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "notebooks").glob("*.ipynb")]
    texts += [path for room in ("arraygeom", "calib", "pat") for path in (ROOT / room).rglob("*.py")]
    assert [str(path) for path in texts if named.search(path.read_text())] == []
