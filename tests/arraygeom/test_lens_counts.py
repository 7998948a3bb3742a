"""Random lenses beyond their folds: unflagged answers are right. A smaller docs/reports/lenses.md."""

import numpy as np
import pytest

pytest.importorskip("cv2")
from tests.benchmarks.bench_lenses import FAMILIES, LIBRARIES, before_fold, counted, direction, drawn


@pytest.mark.parametrize("name", FAMILIES)
def test_no_answer_without_a_flag_is_wrong(name):
    lenses = drawn(name, 60)
    wrong, missed, wrong_back, missed_back, _ = counted(name, LIBRARIES["arraygeom"](name), lenses)
    assert wrong == wrong_back == "0"
    assert int(missed) + int(missed_back) < 120
    if name == "kannala-brandt":  # the count sees what is wrong
        assert int(counted(name, LIBRARIES["OpenCV"](name), lenses)[0]) > 100


@pytest.mark.parametrize(
    "c",
    [
        (-0.439, 0.051, 0.003, 0.008, 0.02, 0, 0, 0),
        (-0.476, 0.036, -0.003, 0.005, 0.03, -0.04, -0.029, 0.006),
    ],
)
def test_past_a_fold_in_a_dip_of_the_slope_nothing_is_valid(c):
    """Tangential terms fold the image where the radial slope is least; further out it looks right again."""
    rng = np.random.default_rng(0)
    around, theta = rng.uniform(0, 2 * np.pi, 20_000), rng.uniform(0.6, 1.1, 20_000)
    angle = theta[:, None] * np.stack([np.cos(around), np.sin(around)], -1)
    each = np.broadcast_to(np.array(c), (20_000, 8))
    _, valid = LIBRARIES["arraygeom"]("brown-conrady").project(np.array([c]), direction(angle)[None])
    kept = before_fold(FAMILIES["brown-conrady"], each, angle)
    assert int((valid[0] & ~kept).sum()) == 0
    assert int(valid.sum()) > 0.5 * int(kept.sum())  # in some directions there is no fold
