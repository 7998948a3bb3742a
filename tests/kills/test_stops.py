"""Whole commands, as if killed before each of their file operations: former results or new ones are whole.

A kill leaves a folder as it is, so a copy of it before an operation is what a kill there would leave: one run
shows all of them.
"""

import shutil
import sys
from functools import partial

import pytest

from arraygeom.runtime.together import sweep
from tests.arraygeom.runtime.test_together import EVENTS
from tests.kills.jobs import (
    _frames_mixed,
    _frames_of,
    alignment_job,
    batch_job,
    calibration_job,
    conversion_job,
    frame_job,
)
from tests.kills.killing import files_of, started, status_of

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="forks")

JOBS = {
    "conversion": conversion_job,
    "frame": frame_job,
    "batch": partial(batch_job, frames=2),
    "alignment": alignment_job,
    "calibration": calibration_job,
}


def copy_before_operations(out, copies) -> None:
    """Copy a folder before each file operation in it."""
    count, copying = 0, False

    def hook(event, arguments):
        nonlocal count, copying
        if event not in EVENTS or copying or str(out) not in f"{arguments[0]}":
            return
        copying = True
        count += 1
        if out.exists():
            shutil.copytree(out, copies / f"{count:04d}")
        copying = False

    sys.addaudithook(hook)


def run(arguments, log, watch=lambda: None) -> None:
    child = started(arguments, log, before=watch)
    assert status_of(child) == 0, log.read_text()[-2000:]


@pytest.mark.parametrize("name", JOBS)
def test_killed_before_any_file_operation_all_files_of_one_making_are_there(tmp_path, name):
    job, out, copies, log = JOBS[name](tmp_path), tmp_path / "out", tmp_path / "copies", tmp_path / "log"
    seen = _frames_of if name == "batch" else files_of
    run(job.former(out), log)
    former = seen(out)
    for mine in ("mine", "mine.png"):
        (out / mine).write_text(mine)
    run(job.arguments(out), log, lambda: copy_before_operations(out, copies))
    (out / "mine").unlink()
    (out / "mine.png").unlink()
    new = seen(out)
    assert former != new
    assert all(former.values())
    assert all(new.values())
    found = []
    for copy in sorted(copies.iterdir()):
        for mine in ("mine", "mine.png"):
            assert (copy / mine).read_text() == mine
            (copy / mine).unlink()
        assert job.faults(copy, [former, new]) == [], copy
        sweep(copy)
        if name == "batch":
            assert _frames_mixed(copy, [former, new]) == [], copy
            assert seen(copy).keys() == former.keys(), copy
        else:
            assert seen(copy) in (former, new), copy
        found.append(seen(copy))
    print(f"{name}: {len(found)} stops")
    assert former in found
    assert len(found) > 10
