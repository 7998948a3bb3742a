"""The wheel's content is enough: `pat demo` runs from it in an empty folder. `make wheel` installs it too."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def call(*command, cwd, **environment):
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, env={**os.environ, **environment})
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@pytest.mark.slow
def test_the_demo_runs_from_the_wheel(tmp_path):
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet")
    call(*pip, "wheel", "--no-deps", "--wheel-dir", str(tmp_path), str(ROOT), cwd=tmp_path)
    (wheel,) = tmp_path.glob("*.whl")
    call(*pip, "install", "--no-deps", "--target", str(tmp_path / "installed"), str(wheel), cwd=tmp_path)
    empty = tmp_path / "empty"
    empty.mkdir()
    script = (
        "import pat; print(pat.__file__); from pat.app.cli.main import main; main(['demo', '--out', 'here'])"
    )
    printed = call(sys.executable, "-c", script, cwd=empty, PYTHONPATH=str(tmp_path / "installed"))
    assert str(tmp_path / "installed") in printed.splitlines()[0]
    assert "fusion" in printed
    assert (empty / "here" / "fused.png").exists()
    assert sorted(p.parent.name for p in (tmp_path / "installed").glob("*/py.typed")) == [
        "arraygeom",
        "calib",
        "pat",
    ]
