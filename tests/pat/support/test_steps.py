"""Steps of long work reach the innermost block that shows them, and nothing stays behind."""

import logging

from pat.support.steps import steps_shown


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
