"""Stages left out: that each is there to be left out, what pairs are recorded with, and the table."""

import numpy as np
import pytest
import torch

from experiments.evaluation.stages import STAGE_CONDITIONS, STAGES, StageScore, left_out, stages_markdown
from tests.experiments.test_conditions import pair


@pytest.mark.parametrize("stage", STAGES)
def test_what_a_stage_replaces_is_there_and_its_conditions_are_known(stage):
    with left_out(stage):
        pass
    assert set(STAGES[stage].conditions) <= set(STAGE_CONDITIONS)


def test_noise_is_of_the_named_cameras_and_the_fusion_is_told_only_that():
    quiet, both, alone, grain = (
        STAGE_CONDITIONS[name]
        for name in ("x2", "200 electrons", "50 electrons, of alpha alone", "4000 electrons, not stated")
    )
    ideal = quiet.recorded(pair())
    assert not torch.equal(both.recorded(pair()).beta, ideal.beta)
    assert torch.equal(alone.recorded(pair()).beta, ideal.beta)
    assert not torch.equal(alone.recorded(pair()).alpha, ideal.alpha)
    assert not torch.equal(grain.recorded(pair()).alpha, ideal.alpha)
    told = [condition.noise and set(condition.noise) for condition in (quiet, both, alone, grain)]
    assert told == [None, {"alpha", "beta"}, {"alpha"}, None]


def test_the_table_has_changes_from_the_first_line_and_blanks_where_a_stage_does_nothing():
    whole = [StageScore(30.0, 0.9, 0.8, 1.0), StageScore(40.0, 0.9, np.nan, 1.0)]
    without = [StageScore(29.0, 0.9, 0.7, 0.5), StageScore(40.5, 0.9, np.nan, 0.5)]
    table = stages_markdown({"nothing": {"x2": whole, "x4": whole}, "planes": {"x4": without}}).splitlines()
    assert table[0] == "| left out | x2 | x4 |"
    assert table[2] == "| nothing | 35.00 dB / 80.0% / 1.00 s | 35.00 dB / 80.0% / 1.00 s |"
    assert table[3] == "| planes |  | -0.25 (-1.00) / -10.0% / -0.50 s |"
