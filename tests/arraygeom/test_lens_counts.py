"""Random lenses beyond their folds: answers without a flag are right. The table of docs/lenses.md, smaller."""

import pytest

pytest.importorskip("cv2")
from tests.benchmarks.bench_lenses import FAMILIES, LIBRARIES, counted, drawn


@pytest.mark.parametrize("name", FAMILIES)
def test_no_answer_without_a_flag_is_wrong(name):
    lenses = drawn(name, 60)
    wrong, missed, wrong_back, missed_back, _ = counted(name, LIBRARIES["arraygeom"](name), lenses)
    assert wrong == wrong_back == "0"
    assert int(missed) + int(missed_back) < 120
    if name == "kannala-brandt":  # the count sees what is wrong
        assert int(counted(name, LIBRARIES["OpenCV"](name), lenses)[0]) > 100
