"""Locks of folders: one command at a time, stale ones recognised, folders that cannot be written to named."""

import json
import os
import signal
import socket
import subprocess
import sys
from errno import EACCES
from pathlib import Path

import pytest

from pat.support.locks import LOCK, OWNER, folder_lock

ROOT = Path(__file__).parents[3]
HOLD = """
import sys, time
from pathlib import Path
from pat.support.locks import folder_lock
with folder_lock(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(3600)
"""


@pytest.fixture
def holder(tmp_path):
    """A process that holds the lock of a folder."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, tmp_path / "out"], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


def test_a_folder_is_one_commands_until_that_is_gone(holder, tmp_path):
    out = tmp_path / "out"
    wanted = (
        rf"out: another command is writing there \(process {holder.pid} on {socket.gethostname()}\): "
        rf"wait for it"
    )
    with pytest.raises(ValueError, match=wanted), folder_lock(out):
        pass
    assert (out / LOCK).is_file()
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    assert json.loads((out / OWNER).read_text())["pid"] == holder.pid
    with folder_lock(out):
        assert json.loads((out / OWNER).read_text())["pid"] == os.getpid()
    assert not (out / LOCK).exists()
    assert not (out / OWNER).exists()


def test_a_lock_of_another_machine_is_not_taken(tmp_path):
    (tmp_path / OWNER).write_text('{"pid": 7, "host": "far.example"}')
    with pytest.raises(ValueError, match=r"7.*far.example.*\.lock"), folder_lock(tmp_path):
        pass
    boot = Path("/proc/sys/kernel/random/boot_id")
    if boot.is_file():  # a container of this machine, which is gone: its host's name was its own
        owner = {"pid": 7, "host": "f00ba4", "boot": boot.read_text().strip()}
        (tmp_path / OWNER).write_text(json.dumps(owner))
        with folder_lock(tmp_path):
            pass
    (tmp_path / OWNER).write_text("damaged")
    with folder_lock(tmp_path):
        pass


def test_a_folder_left_empty_is_removed(tmp_path):
    with folder_lock(tmp_path / "a" / "b"):
        assert (tmp_path / "a" / "b").is_dir()
    assert not (tmp_path / "a").exists()
    with folder_lock(tmp_path / "a" / "b"):
        (tmp_path / "a" / "kept").touch()
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["kept"]


def test_a_folder_that_may_not_be_looked_into_is_named(tmp_path, monkeypatch):
    """`Path.exists` and `Path.is_dir` raise there."""

    def forbidden(path, *_, **__):
        raise PermissionError(EACCES, "Permission denied", str(path))

    for name in ("stat", "mkdir"):
        monkeypatch.setattr(Path, name, forbidden)
    with pytest.raises(ValueError, match="Permission denied"), folder_lock(tmp_path / "secret" / "out"):
        pass


def test_what_cannot_be_a_folder_is_named(tmp_path):
    (tmp_path / "file").touch()
    for out in (tmp_path / "file", tmp_path / "file" / "deeper" / "out"):
        wanted = r"cannot write there \(.*file is a file\): give another folder"
        with pytest.raises(ValueError, match=wanted), folder_lock(out):
            pass
    for out in (Path("/proc/nothing"), Path("/proc/self")):
        wanted = r"^/proc/\w+: cannot write there \(/proc/\w+: .*\): give another folder"
        with pytest.raises(ValueError, match=wanted), folder_lock(out):
            pass
