"""arraygeom's tests, run with nothing but the packages that it needs, and pytest's."""

import os
import re
import subprocess
import sys
import tomllib
from importlib.metadata import distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
NEEDED = (
    "torch",
    "kornia",
    "numpy",
    "PyYAML",
    "jaxtyping",
    "filelock",
    "pytest",
    "pytest-timeout",
    "hypothesis",
)


def with_requirements(names):
    """The distributions of these names and all that they require, by normalised name."""
    found, left = {}, list(names)
    while left:
        name = left.pop()
        key = re.sub(r"[-_.]+", "-", name).lower()
        if key not in found:
            found[key] = distribution(name)
            requirements = map(Requirement, found[key].requires or ())
            left += [r.name for r in requirements if r.marker is None or r.marker.evaluate({"extra": ""})]
    return found.values()


def link_packages(folder):
    """A folder of links to them in this environment."""
    for one in with_requirements(NEEDED):
        for top in {file.parts[0] for file in one.files or ()} - {"..", "__pycache__"}:
            if not (folder / top).exists():
                (folder / top).symlink_to(one.locate_file(top))


def test_its_own_distribution_agrees_with_that_of_the_whole():
    """Version, bounds of what it needs, and packages: `make wheel` installs it alone."""
    own, whole = (
        tomllib.loads((ROOT / path).read_text()) for path in ("arraygeom/pyproject.toml", "pyproject.toml")
    )
    assert own["project"]["version"] == whole["project"]["version"]
    assert set(own["project"]["dependencies"]) <= set(whole["project"]["dependencies"])
    packages = {
        ".".join(path.parent.relative_to(ROOT).parts) for path in (ROOT / "arraygeom").rglob("__init__.py")
    }
    assert set(own["tool"]["setuptools"]["packages"]) == packages


@pytest.mark.parametrize("more", [["--collect-only"], pytest.param([], marks=pytest.mark.slow)])
def test_the_tests_of_arraygeom_need_torch_kornia_numpy_yaml_and_jaxtyping(tmp_path, more):
    link_packages(tmp_path)
    pytest_alone = [sys.executable, "-S", "-m", "pytest", "-q", "-m", "not slow", "-p", "no:cacheprovider"]
    command = [*pytest_alone, *more, "tests/arraygeom"]
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-4000:]
    blocked = subprocess.run(
        [sys.executable, "-S", "-c", "import numba"], env=environment, capture_output=True
    )
    assert blocked.returncode != 0, "numba is there all the same"
