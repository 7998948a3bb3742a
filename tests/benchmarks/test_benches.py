"""Benchmarks run seldom: they find what they import, and their options are read.

What they call is checked by mypy (`make check`); one once called a function whose arguments had changed.
"""

import importlib
from pathlib import Path

import pytest
import tyro

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
