"""Memory of the command: its limit is kept, and its plan is within a tenth of what it has at most."""

import sys

import pytest

from .bench_memory import CASES, measured, size_of

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="peak memory is read as Linux tells it"),
]


@pytest.mark.parametrize(
    "case", CASES, ids=lambda case: f"{case.megapixels} megapixels, {case.name}, {case.limit}"
)
def test_the_plan_of_a_command_is_what_it_takes_and_its_limit_is_kept(case, tmp_path):
    """The process takes what was planned, at 24 megapixels as at 4, with a limit and without."""
    found = measured(case, tmp_path)
    assert 0.9 < found.plan / found.peak < 1.1
    if case.limit is not None:
        assert found.peak < size_of(case.limit)
