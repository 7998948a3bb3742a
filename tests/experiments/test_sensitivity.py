"""Tuned numbers halved and doubled: that every one is found and changed, and the table."""

from pathlib import Path

import pytest

from experiments.evaluation import sensitivity
from experiments.evaluation.sensitivity import Change, scores_with, sensitivity_markdown, tuned_entries
from experiments.evaluation.stages import STAGE_CONDITIONS


def test_conditions_are_known_and_reasons_name_one_setting_each():
    states = {state for states in (sensitivity.USUAL, *sensitivity.STATES.values()) for state in states}
    assert states <= set(STAGE_CONDITIONS)
    entries = tuned_entries()
    assert len(entries) > 20
    reasons = {(entry.algorithm, entry.name): entry.why for entry in entries}
    assert len(set(reasons.values())) == len(reasons)


def test_a_process_changes_the_number_before_its_room_is_imported(monkeypatch, tmp_path):
    program = sensitivity.WORKER.replace(
        "from experiments.evaluation.sensitivity import print_scores",
        "from pat.networks.recall import SETTINGS\n"
        "import json\n"
        "def print_scores(folder, states):\n"
        "    print(json.dumps({'x2': [SETTINGS.distance, SETTINGS.scales]}))",
    )
    monkeypatch.setattr(sensitivity, "WORKER", program)
    entry = next(entry for entry in tuned_entries() if entry.name == "distance")
    kept, _ = scores_with(tmp_path, None, 1.0, ["x2"])["x2"]
    halved, scales = scores_with(tmp_path, entry, 0.5, ["x2"])["x2"]
    assert (halved, scales) == (kept / 2, 3)
    with pytest.raises(RuntimeError, match="no such reason"):
        scores_with(Path("nowhere"), entry._replace(why="no such reason"), 0.5, ["x2"])


def test_the_table_has_the_largest_change_and_its_condition():
    entry = tuned_entries()[0]
    changes = [Change({"x2": 0.1, "x4": -0.2}, {"x2": 0.001, "x4": 0.0})] * 2
    cell = "-0.20 (x4) / +0.1%"
    name = f"{entry.algorithm.removesuffix('Settings')}.{entry.name} = {entry.value}"
    assert sensitivity_markdown([(entry, changes)]).splitlines()[2] == f"| {name} | {cell} | {cell} |"
