"""Wrong uses get one sentence, except those of which nothing can be known."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from arraygeom import Pose
from arraygeom.checks import unchecked
from tests.arraygeom.wrong_uses import SILENT, WRONG


@pytest.fixture(scope="module")
def answers() -> dict[str, str]:
    """Return the messages that users get, without the types that are checked while testing."""
    command = [sys.executable, "-m", "tests.arraygeom.wrong_uses"]
    done = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_use_gets_a_sentence(answers, name):
    said = answers[name]
    assert (said == "") == (name in SILENT)
    assert "\n" not in said
    assert len(said) < 300


def test_of_what_is_right_nothing_is_said(answers):
    assert answers["right"] == ""


def test_at_most_five_are_silent():
    assert len(WRONG) >= 210
    assert len(SILENT) <= 5


def test_checks_are_off_by_one_flag_and_within_transformations():
    twice = 2 * torch.eye(3)
    with pytest.raises(ValueError, match="rotation"):
        Pose(twice, torch.zeros(3))
    with unchecked():
        assert torch.equal(Pose(twice, torch.zeros(3)).R, twice)
    assert torch.func.vmap(lambda R: Pose(R, torch.zeros(3)).apply(torch.ones(3)))(twice[None]).shape == (
        1,
        3,
    )
