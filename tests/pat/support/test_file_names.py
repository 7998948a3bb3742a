"""File names for names that others chose."""

import re

from hypothesis import given
from hypothesis import strategies as st

from pat.support.file_names import LONGEST, file_names

ODD = ["../../evil", "/abs/path/x", "a/b", "a\\b", "a\0b", "a\nb", "\x1b[31m", "", ".", "..", ".lock", "CON"]
ODD += ["nul.txt", "x" * 300, "é" * 60, "trailing.", "trailing ", " a", "a:b", "a*b?", '"', "\ud800", "Ⅷ / 8"]


def test_usual_names_stay():
    names = ["left", "cam0", "IMG_0000_1", "mono 2", "über", "a.b-c", "Right"]
    assert file_names(names) == {name: name for name in names}


def test_odd_names_become_plain_ones_that_differ():
    found = file_names(ODD)
    for text in found.values():
        assert re.fullmatch(r"[\w.+\-,=@~() ]+", text)
        assert text.strip(" ") == text.strip(" .").strip(" ")
        assert not text.startswith(".")
        assert len(text.encode()) <= LONGEST + 1
        assert text.split(".")[0].casefold() not in ("con", "nul")
    assert len({text.casefold() for text in found.values()}) == len(ODD)


def test_names_that_differ_by_case_or_imitate_a_digest():
    named = file_names(["a", "A", "b"])
    assert named["b"] == "b"
    assert named["a"].casefold() != named["A"].casefold()
    assert file_names([named["a"], "a", "A"])[named["a"]] != named["a"]


@given(st.lists(st.text(), unique=True, max_size=6))
def test_no_two_names_share_a_file(names):
    found = file_names(names)
    assert list(found) == names
    assert len({text.casefold() for text in found.values()}) == len(names)
    assert not any(c in text for text in found.values() for c in "/\\\0\n\x1b")
