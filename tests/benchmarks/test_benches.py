"""Benchmarks run seldom: they find what they import, and their options are read.

What they call is checked by mypy (`make check`); one once called a function whose arguments had changed.
"""

import importlib
from pathlib import Path

import cv2
import pytest
import tyro

from tests.benchmarks import bench_doctor
from tests.benchmarks.printed import print_tables

BENCHES = sorted(path.stem for path in Path(__file__).parent.glob("bench_*.py"))


@pytest.mark.parametrize("name", BENCHES)
def test_a_benchmark_begins(name, capsys):
    if name == "bench_explorer":
        pytest.importorskip("selenium")
    module = importlib.import_module(f"tests.benchmarks.{name}")
    begin = next(found for found in ("Args", "main") if hasattr(module, found))
    with pytest.raises(SystemExit) as ended:
        tyro.cli(getattr(module, begin), args=["--help"])
    assert ended.value.code == 0
    assert "usage" in capsys.readouterr().out


def test_the_doctors_mistakes_are_known_before_anything_is_read(tmp_path):
    with pytest.raises(ValueError, match=r"--only: no mistake 'lenses': there are nothing, resized, "):
        bench_doctor.main(tmp_path / "absent", only=("units", "lenses"))


def test_opencv_is_seeded_by_the_doctors_seed_and_not_by_printing(monkeypatch, tmp_path):
    seeds = []
    monkeypatch.setattr(cv2, "setRNGSeed", seeds.append)
    monkeypatch.setattr(bench_doctor, "subjects", lambda data: [])
    print_tables("none", [[]], None)
    bench_doctor.main(tmp_path / "absent", seed=3, only=())
    assert seeds == [3]
