"""Every kind of input of `bench_inputs`, on real images that are not in this repository."""

from pathlib import Path

import pytest

from .bench_inputs import what_came
from .input_kinds import kinds

DATA = Path(__file__).parents[3] / "shared" / "data"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not DATA.is_dir(), reason=f"needs the real images of {DATA}"),
]


@pytest.mark.parametrize("kind", list(kinds(DATA)), ids=lambda kind: kind.name)
def test_every_kind_of_input(kind, tmp_path):
    came = what_came(kind, tmp_path)
    assert came.as_wanted(kind), came
