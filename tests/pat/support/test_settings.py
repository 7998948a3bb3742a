"""Every number of an algorithm's settings says what kind it is and where it is from."""

from dataclasses import dataclass

import pytest

from pat.lab.commands import Settings
from pat.matching.semi_global import HALF_SIZE
from pat.matching.subpixel import FULL_SIZE
from pat.support.schema import entries_of
from pat.support.settings import all_settings, listed, physics, size, tuned


@dataclass(frozen=True)
class SomeSettings:
    a: float = physics(1.0, "light")
    b: tuple[int, int] = tuned((2, 3), "pairs")
    c: int = size(4, "rows")


def test_entries_have_value_kind_and_reason():
    found = [(s.name, s.value, s.kind, s.why, s.numbers) for s in listed(SomeSettings(c=5))]
    assert found == [
        ("a", 1.0, "physics", "light", 1),
        ("b", (2, 3), "tuned", "pairs", 2),
        ("c", 5, "size", "rows", 1),
    ]


def test_a_number_without_a_kind_is_refused():
    @dataclass(frozen=True)
    class Unsaid:
        a: float = 1.0

    with pytest.raises(ValueError, match=r"Unsaid\.a"):
        list(listed(Unsaid()))


def test_fewer_than_50_numbers_were_tuned():
    found = [s for s in all_settings(*Settings.rooms) if s.kind == "tuned"]
    assert len({s.algorithm for s in found}) > 5
    assert sum(s.numbers for s in found) < 50
    assert all(len(s.why) > 20 for s in found)


def test_of_settings_that_a_room_has_twice_what_differs_is_counted():
    found = [s.value for s in all_settings("pat.matching") if s.algorithm == "SemiGlobalSettings"]
    steps = [s.value for s in all_settings("pat.matching") if s.name == "step" and s.kind == "tuned"]
    assert sorted(steps) == [HALF_SIZE.step, FULL_SIZE.step]
    assert found.count(HALF_SIZE.block) == 1


def test_json_too_deep_to_read_has_no_entries(tmp_path):
    (tmp_path / "deep.json").write_text("[" * 100_000)
    assert entries_of(tmp_path / "deep.json") == {}
