"""A small share of `make fuzz`, that the sandbox sees what it is to see, and files that fuzzing has found."""

import json
import os
import random
import signal
import struct
import sys
import time
import zlib
from functools import partial
from pathlib import Path

import pytest
import torch

from arraygeom import Rig
from arraygeom.io import RigFileError
from calib.boards.uncertainty import RigCovariance
from pat.lab.synthesis.photos import read_photographs
from pat.lab.training import checkpoints
from pat.lab.training.checkpoints import FORMAT, collect, newest_checkpoint, restore, write_checkpoint
from pat.networks.weights import load_weights, save_weights
from pat.support.memory import keep_freed
from pat.support.tensor_files import write_tensors
from tests.fuzz import cases, sandbox
from tests.fuzz.run import faults_of

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="limits of processes are Linux's")


@pytest.mark.parametrize(
    ("kind", "count"),
    [("rig", 19), ("image", 20), ("video", 4), ("weights", 4), ("checkpoint", 4), ("covariance", 4)],
)
def test_damaged_files_are_read_or_refused(kind, count, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = faults_of(kind, count, first=10_000)
    assert [
        (c.seed, c.number, c.outcome) for c in found if c.outcome.verdict not in ("read", "refused")
    ] == []
    assert any(c.outcome.verdict == "refused" for c in found)


@pytest.mark.parametrize(
    ("case", "verdict"),
    [
        (lambda: "read", "read"),
        (lambda: "refused", "refused"),
        (lambda: "half a file", "fault"),
        (lambda: 1 / 0, "traceback"),
        (lambda: os.kill(os.getpid(), signal.SIGSEGV), "signal 11"),
        (lambda: time.sleep(60), "hang"),
        (lambda: sum(range(10**12)), "hang"),
        (lambda: bytearray(5 << 30), "traceback"),
    ],
    ids=["read", "refused", "fault", "traceback", "crash", "sleep", "hang", "memory"],
)
def test_the_sandbox_sees(case, verdict, tmp_path, monkeypatch):
    monkeypatch.setattr(sandbox, "SECONDS", 1)
    if verdict == "hang":
        monkeypatch.setattr(sandbox, "WAITING", 3)
    assert sandbox.ended(case, tmp_path / "log").verdict == verdict


def measured(log: Path) -> bool:
    """Return True if 200 MiB are measured, by the largest of some measurements: a single one may
    be too low."""
    case = partial(sandbox.ended, lambda: "read" if len(bytearray(200 << 20)) else "", log)
    return 190 << 20 < max(case().peak for _ in range(5)) < 230 << 20


def test_the_sandbox_measures_the_memory_of_the_case(tmp_path):
    assert measured(tmp_path / "log")


def test_the_sandbox_measures_what_its_parent_freed_and_holds(tmp_path):
    def parent() -> str:
        keep_freed()
        freed, above = bytearray(b"1") * (300 << 20), bytearray(1000)
        del freed
        return "read" if measured(tmp_path / "log") and above else "not measured"

    outcome = sandbox.ended(parent, tmp_path / "parent's log")
    assert outcome.verdict == "read", outcome


def bomb(hw: tuple[int, int]) -> bytes:
    """A PNG file of black pixels, small on the disk."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", hw[1], hw[0], 8, 0, 0, 0, 0)
    rows = zlib.compressobj(9)
    data = b"".join([rows.compress(b"\0" * (hw[1] + 1)) for _ in range(hw[0])]) + rows.flush()
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def test_a_photograph_that_claims_too_much_is_passed_over(tmp_path):
    (tmp_path / "bomb.png").write_bytes(bomb((20_000, 20_000)))
    (tmp_path / "good.png").write_bytes(bomb((64, 64)))

    def case() -> str:
        found = read_photographs((tmp_path,), 1024)
        return "read" if [image.shape for image in found] == [(64, 64, 3)] else f"{len(found)} images"

    outcome = sandbox.ended(case, tmp_path / "log")
    assert outcome.verdict == "read"
    assert outcome.seconds < 5


@pytest.mark.parametrize(
    "text", ["[" * 100_000, '{"names": ["a"], "covariance": [[NaN]]}', '{"names": [1], "covariance": [[1]]}']
)
def test_covariance_files_that_are_none(text, tmp_path):
    (tmp_path / "c.json").write_text(text)
    with pytest.raises(ValueError, match=r"c\.json: "):
        RigCovariance.load(tmp_path / "c.json")


FACTS = {"step": 3, "best": 1.0, "minutes": 0.5, "done": False, "recipe": "steps: 10"}


@pytest.mark.parametrize(
    "wrong",
    [
        {"step": "3"},
        {"step": -1},
        {"step": True},
        {"best": None},
        {"best": float("nan")},
        {"minutes": -1},
        {"minutes": 2**64 - 1},
        {"done": 0},
        {"recipe": {}},
    ],
)
def test_checkpoints_with_wrong_facts_are_damaged(wrong, tmp_path):
    path = write_checkpoint(tmp_path, collect(*cases.training(), FACTS))
    assert newest_checkpoint(tmp_path).facts == FACTS
    write_tensors(path, {}, {"format": FORMAT, "facts": json.dumps(FACTS | wrong)})
    with pytest.raises(ValueError, match=r"checkpoint[^/]*$"):
        newest_checkpoint(tmp_path)


def test_a_checkpoint_read_with_facts_of_other_types_is_a_fault(tmp_path, monkeypatch):
    path = write_checkpoint(tmp_path, collect(*cases.training(), FACTS))
    assert cases.use_checkpoint(path, random.Random(0)) == "read"
    monkeypatch.setitem(checkpoints.FACTS, "done", (bool, str))
    write_checkpoint(tmp_path, collect(*cases.training(), FACTS | {"done": "no"}))
    assert cases.use_checkpoint(path, random.Random(0)).startswith("facts of other types")


@pytest.mark.timeout(60)
def test_a_pipe_in_place_of_a_checkpoint_is_not_waited_for(tmp_path):
    path = write_checkpoint(tmp_path, collect(*cases.training(), FACTS))
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(ValueError, match="checkpoint"):
        newest_checkpoint(tmp_path)


def test_a_bit_that_changed_in_a_checkpoint_or_in_weights_is_seen(tmp_path):
    """The file is still a valid one, of other numbers."""
    path = write_checkpoint(tmp_path, collect(*cases.training(), FACTS))
    save_weights(cases.small_network(), tmp_path / "weights.safetensors")
    for file in (path, tmp_path / "weights.safetensors"):
        content = bytearray(file.read_bytes())
        content[-3] ^= 1
        file.write_bytes(content)
    with pytest.raises(ValueError, match="checkpoint"):
        newest_checkpoint(tmp_path)
    with pytest.raises(ValueError, match="written"):
        load_weights(tmp_path / "weights.safetensors")


def test_a_checkpoint_of_another_network_or_optimiser_is_refused(tmp_path):
    checkpoint = collect(*cases.training(), FACTS)
    tensors = {name: t for name, t in checkpoint.tensors.items() if not name.startswith("average")}
    with pytest.raises(ValueError, match="network"):
        restore(checkpoint._replace(tensors=tensors), *cases.training())
    for name in ("optimiser/x/exp_avg", "optimiser/0/exp_avg", "optimiser/99/step"):
        with pytest.raises(ValueError, match="optimiser"):
            restore(
                checkpoint._replace(tensors=checkpoint.tensors | {name: torch.ones(3)}), *cases.training()
            )


@pytest.mark.parametrize("kind", ["image", "video", "weights", "checkpoint", "covariance"])
def test_what_is_damaged_was_whole(kind, tmp_path):
    make, check, _ = cases.KINDS[kind]
    for seed in make(tmp_path):
        assert check(seed.file, random.Random(0)) == "read", seed


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("focal: 800", "focal: 1.0e-308"),
        ("focal: 800", "focal: 1.0e+300"),
        ("centre: [319.5", "centre: [1.0e+300"),
        ("translation: [-0.1", "translation: [1.0e+300"),
        ("depth: [2,", "depth: [1.0e-308,"),
    ],
)
def test_numbers_that_no_camera_has_are_refused(old, new, tmp_path):
    """Their squares or inverses are 0 or infinite."""
    rig = (Path(cases.__file__).parent / "native.yaml").read_text()
    assert old in rig
    (tmp_path / "rig.yaml").write_text(rig.replace(old, new))
    with pytest.raises(RigFileError, match=r"pixels|metres"):
        Rig.load(tmp_path / "rig.yaml")


@pytest.mark.parametrize(("cameras", "distorted"), [(100, True), (1000, False)])
def test_rigs_of_many_cameras_are_read_and_summarised_within_seconds(
    cameras, distorted, tmp_path, monkeypatch
):
    """The tests' own checks of shapes take half of it; of so many, not every pair is described."""
    monkeypatch.setattr(sandbox, "SECONDS", 15 if distorted else 30)
    lens = (
        ", distortion: {model: brown-conrady, coefficients: [-0.1, 0.02, 0.001, 0.001]}" if distorted else ""
    )
    entries = (
        f"  c{i}: {{size: [64, 48], focal: 50, translation: [{i}, 0, 0]{lens}}}" for i in range(cameras)
    )
    text = "\n".join(["format: arraygeom-rig 1", "depth: [1, 10]", "cameras:", *entries])
    rig, model = tmp_path / "rig.yaml", tmp_path / "model"
    rig.write_text(text)
    for command in (
        ("info", rig),
        ("convert", rig, model, "--write-as", "colmap"),
        ("convert", model, tmp_path / "again.yaml"),
    ):
        outcome = sandbox.ended(
            lambda command=command: cases.command("rig", *map(str, command)), tmp_path / "log"
        )
        assert outcome.verdict == "read", outcome


def test_a_rig_of_huge_images_is_summarised_within_seconds(tmp_path):
    rig = (Path(cases.__file__).parent / "native.yaml").read_text()
    (tmp_path / "rig.yaml").write_text(rig.replace("size: [640, 400]", "size: [65535, 16384]"))
    outcome = sandbox.ended(
        lambda: cases.command("rig", "info", str(tmp_path / "rig.yaml")), tmp_path / "log"
    )
    assert outcome.verdict == "read"
    assert outcome.peak < 2**30
