"""Transformations of torch on public operators: right, or one error of ours."""

import subprocess
import sys

import pytest
import torch

from tests.transformations.operators import ATTENTION, FIELDS, GEOMETRY, OPERATORS
from tests.transformations.run import CHECKS, verdict

REFUSED = {"sample", "Moved", "fit_homography", "rectify", "approximated", 'attend, backend="cpu"'}
"""Operators of which some transformations are refused."""


@pytest.mark.parametrize("operator", [*GEOMETRY, *FIELDS])
@pytest.mark.parametrize("transformation", ["grad", "jvp", "vmap", "jacfwd", "autocast"])
def test_geometry(operator, transformation):
    found = verdict(operator, transformation)
    assert found == "right" or (operator in REFUSED and found.startswith("refused"))


@pytest.mark.parametrize("operator", ATTENTION)
@pytest.mark.parametrize("transformation", ["grad", "vjp", "jvp", "vmap", "jacrev", "autocast"])
def test_attention(operator, transformation):
    found = verdict(operator, transformation)
    assert found == "right" or (operator in REFUSED and found.startswith("refused: backend 'cpu' has no"))


def whole_graphs(operators: list[str]) -> dict[str, str]:
    """Compilation's verdicts, by a process without the tests' shape checks, which Dynamo cannot trace."""
    text = (
        f"from tests.transformations.run import verdict\nfor o in {operators}: print(verdict(o, 'compile'))"
    )
    found = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
    return dict(zip(operators, found.stdout.splitlines(), strict=True))


def test_whole_graphs():
    found = whole_graphs(["Epipolar", "undistort, brown-conrady", "Rectified"])
    assert set(found.values()) == {"right"}


@pytest.mark.slow
def test_every_whole_graph():
    found = whole_graphs(list(OPERATORS))
    assert {o: text for o, text in found.items() if not text.startswith(("right", "refused"))} == {}


@pytest.mark.slow
@pytest.mark.parametrize("operator", OPERATORS)
@pytest.mark.parametrize("transformation", [name for name in CHECKS if name != "compile"])
def test_every_one(operator, transformation):
    assert verdict(operator, transformation).startswith(("right", "refused"))


def test_a_wrong_answer_is_seen():
    """The oracle is none if a derivative that is off passes."""
    from tests.transformations.run import Operator, check_grad

    off = Operator(lambda x: x.square() + (x.detach() - x), torch.ones(3, dtype=torch.float64))
    with pytest.raises(AssertionError, match="off, of"):
        check_grad(off)
