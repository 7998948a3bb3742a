"""A small share of `make kills`, and that it sees what it is to see."""

import sys
from contextlib import contextmanager

import pytest

import arraygeom.io
import arraygeom.runtime.atomic
from tests.kills.jobs import conversion_job
from tests.kills.killing import killed, mixed, reference

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="limits of processes and /proc are Linux's")


@pytest.fixture(scope="module")
def conversion(tmp_path_factory):
    """The job, what it makes, and a folder."""
    folder = tmp_path_factory.mktemp("kills")
    job = conversion_job(folder)
    return job, reference(job, folder), folder


@pytest.mark.parametrize("way", ["moment", "write", "cut"])
def test_a_killed_conversion_leaves_whole_files(way, conversion):
    found = killed(*conversion, way=way, kills=2)
    assert (found.kills, found.faults) == (2, [])
    assert found.finished >= 1


def test_files_written_in_place_are_seen(conversion, monkeypatch):
    """The same with writes that are not atomic, and files that do not come together."""

    @contextmanager
    def in_place(path):
        yield path
        arraygeom.runtime.atomic.flush(path)

    @contextmanager
    def one_by_one(folder, *, group, last):
        yield folder

    monkeypatch.setattr(arraygeom.io, "write_together", one_by_one)
    mixed_files = killed(*conversion, way="write", kills=3)
    assert any("of another making" in fault for fault in mixed_files.faults)
    monkeypatch.setattr(arraygeom.runtime.atomic, "write_atomically", in_place)
    torn_files = killed(*conversion, way="write", kills=2)
    assert any("torn" in fault for fault in torn_files.faults)


def test_files_of_two_makings():
    old, new = {"a": b"1", "last": b"1"}, {"a": b"2", "last": b"2"}
    assert mixed(new, [new, old], "last") == []
    assert mixed(old, [new, old], "last") == []
    assert mixed({"a": b"2"}, [new, old], "last") == []
    assert mixed({"a": b"1", "last": b"2"}, [new, old], "last") != []
    assert mixed({"last": b"2"}, [new, old], "last") != []
    assert mixed({"a": b"", "last": b"2"}, [new, old], "last") == ["torn: a"]
