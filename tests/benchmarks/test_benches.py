"""Benchmarks run seldom: they find what they import, and their options are read.

What they call is checked by mypy (`make check`); one once called a function whose arguments had changed.
"""

import importlib
import json
import subprocess
import sys
from pathlib import Path

import pytest

from pat.app.cli.parser import script
from tests.benchmarks.bench_job import STAGE_NAMES, Case, fuse_arguments

BENCHES = sorted(path.stem for path in Path(__file__).parent.glob("bench_*.py"))


@pytest.mark.parametrize("name", BENCHES)
def test_a_benchmark_begins(name, capsys):
    if name == "bench_explorer":
        pytest.importorskip("selenium")
    module = importlib.import_module(f"tests.benchmarks.{name}")
    begin = next(found for found in ("Args", "main") if hasattr(module, found))
    with pytest.raises(SystemExit) as ended:
        script(getattr(module, begin), ["--help"])
    assert ended.value.code == 0
    assert "usage" in capsys.readouterr().out


def test_every_part_of_a_frame_is_met(tmp_path):
    part = [sys.executable, "-m", "tests.benchmarks.job_parts"]
    subprocess.run([*part, "scene", str(tmp_path), "160", "120", "1"], check=True)
    fuse = fuse_arguments(Case("tiny", (160, 120)), tmp_path, tmp_path / "out")
    printed = subprocess.run([*part, "stages", *fuse], capture_output=True, text=True, check=False).stdout
    assert json.loads(printed.splitlines()[-1])["stages"].keys() == set(STAGE_NAMES)
