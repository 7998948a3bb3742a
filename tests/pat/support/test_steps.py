"""Steps of long work reach the innermost block that shows them, and nothing stays behind."""

import logging
import re
import time
from pathlib import Path

import numpy as np
import pytest

from arraygeom.runtime.progress import log_step, part, progress, stage
from calib.images.from_images import rig_from_images
from pat.media.images import read_image
from pat.support import steps
from pat.support.steps import steps_shown

ARRAY = Path(__file__).parents[4] / "shared" / "data" / "hfr_lfr" / "pillow_1"


def test_steps_are_shown_by_the_innermost_block_alone():
    log, outer, inner = logging.getLogger("calib.images.matches"), [], []
    before = logging.getLogger("calib").level
    with steps_shown(outer.append):
        log.info("features of %s", "a")
        with steps_shown(inner.append):
            log.info("matching")
        log.warning("not a step")
        log.info("refining")
    log.info("nobody is told")
    assert outer == ["features of a", "refining"]
    assert inner == ["matching"]
    assert logging.getLogger("calib").level == before
    assert not logging.getLogger("calib").handlers


@pytest.fixture
def clock(monkeypatch):
    """A clock that a test sets, in seconds."""
    now = [100.0]
    monkeypatch.setattr(steps.time, "monotonic", lambda: now[0])
    return now


def test_the_time_left_follows_from_the_share_of_the_stage_that_is_done(clock):
    log, shown = logging.getLogger("calib"), []

    @stage("first", new=True)
    def first():
        log_step(log, 0, "a")
        clock[0] += 10
        with part(0.2, 0.6), stage():
            log.info("b")
            clock[0] += 10
            log_step(log, 0.5, "c")
            log_step(log, 0.25, "again")

    with steps_shown(shown.append):
        first()
        with stage("second", new=True):
            log.info("d")
            clock[0] += 30
            log_step(log, 0.5, "e")
            log_step(log, 0.97, "f")
        log.info("g")
    assert shown[:2] == ["a (first)", "b (first), about 40 s left"]
    assert shown[2:4] == ["c (first), about 30 s left", "again (first), about 30 s left"]
    assert shown[4:] == ["d (second)", "e (second), about 30 s left", "f (second)", "g"]


def steps_of_a_rig_from_images(images):
    """For each step: processor seconds since the beginning, the share of its stage done; the end is last."""
    begin, found = time.process_time(), []
    with steps_shown(lambda line: found.append((time.process_time() - begin, progress()))):
        rig_from_images(images)
    return [*found, (time.process_time() - begin, None)]


@pytest.mark.slow
@pytest.mark.skipif(not ARRAY.is_dir(), reason="no images of the fast + slow array")
def test_estimates_of_a_rig_from_images_are_within_half(clock):
    """Each step counts by its least processor time of three runs: other processes only make it longer."""
    images = {name: read_image(ARRAY / f"{name}.png")[:1] for name in ("141", "cam1_4", "cam2_4")}
    runs = [steps_of_a_rig_from_images(images) for _ in range(3)]
    ends = np.min([np.diff([at for at, _ in run], prepend=0.0) for run in runs], 0).cumsum()
    said: list[tuple[float, str]] = []
    with steps_shown(lambda line: said.append((clock[0], line))):
        for clock[0], (_, (name, share)) in zip(ends, runs[0][:-1]):
            with stage(name, new=True), part(share, 1):
                logging.getLogger("calib").info("a step")
    estimates = [
        (ends[-1] - at, int(found[1])) for at, line in said if (found := re.search(r"about (\d+) s", line))
    ]
    assert len(estimates) >= 4
    assert all(left / 1.5 - 1 <= seconds <= 1.5 * left + 1 for left, seconds in estimates), estimates
