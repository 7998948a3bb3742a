"""Runs: what they leave, going on after any stop, several processes, numbers that are not finite."""

import json
import os
import re
import shutil
import socket
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors import safe_open

from pat.lab.training import loop
from pat.lab.training.checkpoints import newest_checkpoint
from pat.lab.training.config import TrainConfig, save_config
from pat.lab.training.loop import rate_at, train
from pat.lab.training.losses import validation
from pat.lab.training.processes import Process
from pat.lab.training.samples import SampleSource, made_ahead, scenes
from pat.lab.training.watch import Watch
from pat.networks.configs import PATConfig
from pat.networks.weights import find_weights, load_weights, new_network, save_weights
from pat.support.locks import folder_lock
from tests.processes import room_for

from .runs import SMALL, losses, short_run

ROOT = Path(__file__).parents[4]


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """One thread, as in the processes of `command`: the rounding of convolutions depends on their number."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("training")


@pytest.fixture(scope="module")
def whole(folder):
    """A run that was never stopped."""
    config = short_run(folder, out=folder / "whole")
    train(config)
    return config


def test_samples_are_made_ahead(folder):
    """The second while the first is in use, and all in order."""
    config, asked = short_run(folder), threading.Event()

    def source():
        for number, group in enumerate(scenes(config)[0].steps([0])):
            if number == 1:
                asked.set()
            yield group

    first = next(made := made_ahead(source()))[0]
    assert asked.wait(600)
    second = next(made)[0]
    made.close()
    for given, plain in zip((first, second), scenes(config)[0](2)):
        assert torch.equal(given.alpha, plain.alpha)


class Stopped(Exception):
    pass


def stopped(config, step, monkeypatch, what="_advance"):
    """Train until about to do something of that step, as if the machine went off."""
    ordinary = getattr(loop.Run, what)

    def stopping(self, *args, **kwargs):
        if self.step == step:
            raise Stopped
        return ordinary(self, *args, **kwargs)

    with monkeypatch.context() as context:
        context.setattr(loop.Run, what, stopping)
        with pytest.raises(Stopped):
            train(config)


def test_a_run_leaves_what_it_says(whole):
    assert load_weights(whole.out / "best.safetensors").config == SMALL
    lines = [json.loads(line) for line in (whole.out / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [4, 8]
    assert all(line["psnr"] > 5 for line in lines)
    assert len(losses(whole.out)) == 1 + 8
    assert sorted(p.name for p in (whole.out / "images").iterdir()) == ["step-000004.png", "step-000008.png"]
    assert len(list((whole.out / "checkpoints").iterdir())) == 2
    again = load_weights(whole.out / "best.safetensors").state_dict()
    assert train(whole) == whole.out / "best.safetensors"
    assert all(
        torch.equal(v, again[k]) for k, v in load_weights(whole.out / "best.safetensors").state_dict().items()
    )


@pytest.mark.parametrize(
    ("step", "what"),
    [
        (5, "_advance"),
        pytest.param(6, "_save", marks=pytest.mark.slow),
        pytest.param(2, "_advance", marks=pytest.mark.slow),
        pytest.param(8, "_validate", marks=pytest.mark.slow),
    ],
)
def test_a_stopped_run_goes_on_bit_for_bit(step, what, folder, whole, monkeypatch):
    config = replace(whole, out=folder / f"stopped-{step}")
    stopped(config, step, monkeypatch, what)
    train(config)
    assert losses(config.out) == losses(whole.out)
    ours, theirs = (load_weights(c.out / "best.safetensors").state_dict() for c in (config, whole))
    assert all(torch.equal(ours[k], theirs[k]) for k in theirs)
    ours, theirs = (newest_checkpoint(c.out / "checkpoints") for c in (config, whole))
    assert all(torch.equal(ours.tensors[k], v) for k, v in theirs.tensors.items())


def command(*arguments, launcher=(), **environment):
    return subprocess.Popen(
        [sys.executable, *launcher, "-m", "pat", "lab", "train", *map(str, arguments)],
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT), **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def two_processes(config, file, monkeypatch):
    """This process and the command in another one, told of each other as by torchrun."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    told = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    other = command(file, RANK="1", LOCAL_RANK="1", **told)
    with monkeypatch.context() as context:
        for name, value in {"RANK": "0", "LOCAL_RANK": "0", **told}.items():
            context.setenv(name, value)
        train(config)
    return other


def by_torchrun(config, file, monkeypatch):
    return command(file, launcher=["-m", "torch.distributed.run", "--standalone", "--nproc_per_node", "2"])


def ends_as(running, config, whole):
    """The run ends well, with the losses of the whole one but for rounding."""
    said, _ = running.communicate()
    assert running.returncode == 0, said
    ours, theirs = ([[float(x) for x in row] for row in losses(c.out)[1:]] for c in (config, whole))
    torch.testing.assert_close(torch.tensor(ours), torch.tensor(theirs), rtol=0, atol=1e-4)


@pytest.mark.parametrize("run", [two_processes, pytest.param(by_torchrun, marks=pytest.mark.slow)])
def test_two_processes_are_as_one(run, folder, whole, monkeypatch):
    config = replace(whole, out=folder / run.__name__)
    save_config(config, folder / "two.yaml")
    ends_as(run(config, folder / "two.yaml", monkeypatch), config, whole)


def test_forty_steps_learn(folder):
    """From nothing, supervised by geometry, on scenes of three photographs: better on the fourth, and clearly
    more of it matched."""
    how = {"steps": 40, "batch": 1, "groups": 1, "validate": 20, "save": 50, "attention": 1.0}
    config = short_run(folder, out=folder / "learns", network=replace(SMALL, normalised=True), **how)
    train(config)
    before = validation(new_network(config.network).eval(), list(scenes(config)[1](8)))
    log = [json.loads(line) for line in (config.out / "log.jsonl").read_text().splitlines()]
    assert log[-1]["step"] == 40
    after = max(log, key=lambda line: line["psnr"])
    assert after["psnr"] > before["psnr"] + 0.05
    assert after["matched"] > before["matched"] + 0.05


def test_groups_must_be_shared_evenly():
    assert [Process(rank, 2).share(4) for rank in (0, 1)] == [[0, 2], [1, 3]]
    with pytest.raises(ValueError, match=r"3 groups .* 2 processes"):
        Process(0, 2).share(3)


def test_a_sample_that_is_not_finite_is_named_and_saved(folder, whole, monkeypatch):
    config = replace(whole, out=folder / "nan")
    ordinary = SampleSource.sample

    def poisoned(self, planned, step, group):
        given = ordinary(self, planned, step, group)
        if (step, group) == (4, 1):
            given.ground_truth[1, :, 5, 5] = torch.nan
        return given

    monkeypatch.setattr(SampleSource, "sample", poisoned)
    with pytest.raises(FloatingPointError, match=r"step 5.*sample 1.*group 1"):
        train(config)
    (file,) = config.out.glob("offending-*")
    assert file.name == "offending-step-5-group-1.safetensors"
    with safe_open(file, "pt") as saved:
        assert saved.get_tensor("ground_truth")[1].isnan().any()
        assert saved.get_tensor("betas/0").isfinite().all()
        assert saved.metadata()["samples"] == "[1]"
    assert newest_checkpoint(config.out / "checkpoints").facts["step"] == 3


def test_no_room_for_a_checkpoint(folder, whole, monkeypatch):
    """The system refuses to write, as on a full disk; the older checkpoint stays, a run can go on from it."""
    config = replace(whole, out=folder / "full")
    stopped(config, 4, monkeypatch)
    room = 2 * (whole.out / "best.safetensors").stat().st_size
    with room_for(room), pytest.raises(OSError, match=r"step 6 .*step-00000003") as caught:
        train(config)
    assert "\n" not in str(caught.value)
    assert [p.name for p in (config.out / "checkpoints").iterdir()] == ["step-00000003.safetensors"]
    train(config)
    assert losses(config.out) == losses(whole.out)


def test_another_recipe_is_not_mixed_in(whole):
    with pytest.raises(ValueError, match=r"rate: "):
        train(replace(whole, rate=2e-2))


def test_starting_from_weights(folder, whole):
    network = new_network(SMALL, whole.out / "best.safetensors")
    theirs = load_weights(whole.out / "best.safetensors").state_dict()
    assert all(torch.equal(v, theirs[k]) for k, v in network.state_dict().items())
    with pytest.raises(ValueError, match=r"holds a GuidedPAT .* a PAT "):
        new_network(SMALL, find_weights("mono-colour"))
    save_weights(new_network(replace(SMALL, dim=7)), folder / "other.safetensors")
    with pytest.raises(ValueError, match="recipe"):
        new_network(SMALL, folder / "other.safetensors")


def test_no_photographs(folder, whole):
    (folder / "empty").mkdir()
    for photos, message in (
        ((folder / "empty",), "image"),
        ((), "photos: "),
    ):
        with pytest.raises(ValueError, match=message):
            train(replace(whole, photos=photos, cache=None, out=folder / "none"))


def test_the_papers_network_trains_on_nearest_pixels(folder, whole):
    network = PATConfig(dim=4)
    config = replace(whole, network=network, loss="mse", field="nearest", out=folder / "paper", steps=2)
    assert load_weights(train(config)).config == network


def test_half_precision_and_compiled_parts_train(folder, whole):
    config = replace(whole, out=folder / "half", steps=2, precision="bfloat16")
    train(config)
    full, half = (float(losses(c.out)[1][1]) for c in (whole, config))
    assert full != half
    assert full == pytest.approx(half, abs=0.05)


def test_schedules():
    warm = TrainConfig(rate=1.0, warmup=4)
    assert [rate_at(warm, s, s / 100) for s in (1, 2)] == [0.25, 0.5]
    assert rate_at(warm, 50, 0.5) == pytest.approx(0.5)
    halving = TrainConfig(rate=1.0, schedule="halving", warmup=0)
    assert [rate_at(halving, 1, done) for done in (0.3, 0.4, 0.8)] == [1, 0.5, 0.25]


@pytest.mark.parametrize(
    ("name", "line"), [("log.jsonl", '{"psnr": 3}'), ("log.jsonl", "3"), ("steps.csv", "a,b,c,d")]
)
def test_a_damaged_line_is_named_by_its_file(tmp_path, name, line):
    (tmp_path / name).write_text(f"step,loss\n{line}\n" if name == "steps.csv" else f"{line}\n")
    with pytest.raises(ValueError, match=re.escape(str(tmp_path / name))):
        Watch(tmp_path, 1, 1, tensorboard=False)


def test_a_run_whose_checkpoints_are_all_damaged_does_not_begin_again(folder, whole):
    config = replace(whole, out=folder / "damaged")
    shutil.copytree(whole.out, config.out)
    newer, older = sorted((config.out / "checkpoints").iterdir(), reverse=True)
    newer.write_bytes(newer.read_bytes()[:1000])
    assert newest_checkpoint(config.out / "checkpoints").facts["step"] == 6
    header = int.from_bytes(older.read_bytes()[:8], "little")
    older.write_bytes(
        older.read_bytes()[: 8 + header].replace(b'\\"step\\"', b'\\"stop\\"')
        + older.read_bytes()[8 + header :]
    )
    log = (config.out / "log.jsonl").read_bytes()
    with pytest.raises(ValueError, match=r"step-00000008.*step-00000006"):
        train(config)
    assert (config.out / "log.jsonl").read_bytes() == log
    for file in (newer, older):
        file.unlink()
    train(config)
    assert losses(config.out) == losses(whole.out)


def test_one_run_at_a_time_writes_to_a_folder(folder, whole):
    config = replace(whole, out=folder / "twice")
    with folder_lock(config.out):
        with pytest.raises(ValueError, match="twice: "):
            train(config)
        assert {p.name for p in config.out.iterdir()} == {".lock", ".lock.json"}
