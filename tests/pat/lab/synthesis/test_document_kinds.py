from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest

from pat.support.schema import from_document, read_yaml, to_document


@dataclass(frozen=True)
class Inner:
    size: tuple[int, int] = (4, 6)
    mode: Literal["fast", "slow"] = "fast"


@dataclass(frozen=True)
class Outer:
    rate: float
    folders: tuple[Path, ...] = ()
    inner: Inner = field(default_factory=Inner)
    other: Inner | None = None
    names: Mapping[str, int] = field(default_factory=dict)
    loud: bool = False

    def __post_init__(self):
        if self.rate < 0:
            raise ValueError("rate must not be negative")


def test_plain_data_becomes_dataclasses():
    made = from_document(
        Outer, {"rate": "1e-3", "folders": ["a"], "inner": {"size": [1, 2]}, "names": {"x": 3}}, "file"
    )
    assert made == Outer(1e-3, (Path("a"),), Inner((1, 2)), None, {"x": 3})
    assert from_document(Outer, to_document(made), "file") == made
    assert from_document(Outer, {"rate": 1, "other": {"mode": "slow"}}, "file").other == Inner(mode="slow")


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ({}, "file.rate: "),
        ({"rate": -1}, "file: "),
        ({"rate": 1, "fodlers": []}, "file.fodlers.*'folders'"),
        ({"rate": 1, "folders": 3}, "file.folders: "),
        ({"rate": 1, "inner": {"size": [1]}}, "file.inner.size: "),
        ({"rate": 1, "inner": {"size": [1, 2.5]}}, r"file.inner.size\[1\]: "),
        ({"rate": 1, "inner": {"mode": "fst"}}, "file.inner.mode.*'fst'"),
        ({"rate": 1, "other": {"mod": 1}}, "file.other.mod.*'mode'"),
        ({"rate": 1, "loud": "yes"}, "file.loud.*'yes'"),
        ({"rate": True}, "file.rate: "),
        ({"rate": 1, "names": [1]}, "file.names: "),
        ([1], "file: "),
    ],
)
def test_what_does_not_fit_is_named_with_its_entry(data, words):
    with pytest.raises(ValueError, match=words):
        from_document(Outer, data, "file")


def test_a_file_that_is_not_yaml(tmp_path):
    (tmp_path / "a.yaml").write_text("a: [1\nb: 2\n")
    with pytest.raises(ValueError, match=r"a\.yaml: .*line 2"):
        read_yaml(tmp_path / "a.yaml")
    with pytest.raises(FileNotFoundError, match=r"b\.yaml: "):
        read_yaml(tmp_path / "b.yaml")
