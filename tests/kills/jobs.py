"""The jobs that are killed: a frame, many frames, a sequence, training, calibration, rendering; all small."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import torch
import yaml
from safetensors import safe_open

from arraygeom.io import read_rig
from calib.boards.simulation import photograph
from calib.boards.target import parse_board
from pat.lab.synthesis.blender.environment import blender_python
from pat.lab.training.checkpoints import newest_checkpoint, read_checkpoint
from pat.lab.training.config import save_config
from pat.media.images import write_image
from pat.networks.guided import GuidedPAT
from pat.networks.weights import save_weights
from tests.calib.board_scenes import board_poses, camera
from tests.kills.killing import Job, files_of, mixed
from tests.pat.fusion import moving
from tests.pat.lab.training.runs import short_run

FIXTURES = Path(__file__).parents[1] / "arraygeom" / "fixtures"
FRAMES = 6
BOARD = "charuco:9x7:60mm"
SCENE = """
depth: [2, 20]
cameras:
  mono: {size: [96, 64], focal: 120}
  colour: {size: [80, 60], focal: 90, rotation: [0, 1, 0.5], translation: [-0.1, 0, 0], response: rgb}
"""


Arguments = Callable[[Path], list[str]]


def whole(last: str) -> Callable[[Path, list[dict[str, bytes]]], list[str]]:
    """Return the faults of the files of a folder, of which `last` is written last."""
    return lambda out, versions: mixed(files_of(out), versions, last)


def conversion_job(folder: Path) -> Job:
    """A rig written as a COLMAP model, over that of another rig."""
    rig = read_rig(FIXTURES / "kalibr.yaml")
    for name, made in (("new", rig), ("old", rig.with_camera("cam0", rig["cam1"]))):
        made.save(folder / f"{name}.yaml")

    def arguments(name: str) -> Arguments:
        return lambda out: ["rig", "convert", str(folder / f"{name}.yaml"), str(out), "--write-as", "colmap"]

    return Job("conversion", arguments("new"), files_of, whole("images.txt"), former=arguments("old"))


def frame_job(folder: Path) -> Job:
    """One frame, over the results of another one."""
    options = ["--extras", "points"]

    def arguments(i: int) -> Arguments:
        images = _images(folder, f"fast_{i}.png", "slow_0.png")
        return lambda out: [*_fuse(folder), *images, "--out", str(out), *options]

    return Job("fuse", arguments(0), files_of, whole("fused.png"), former=arguments(1))


def alignment_job(folder: Path) -> Job:
    """Aligned images of one frame, over those of another one."""

    def arguments(i: int) -> Arguments:
        images = _images(folder, f"fast_{i}.png", "slow_0.png")
        return lambda out: [
            *_fuse(folder, "align")[:-4],
            *images,
            "--out",
            str(out),
            "--extras",
            "npy,separate",
        ]

    return Job("alignment", arguments(0), files_of, whole("aligned.tif"), former=arguments(1))


def batch_job(folder: Path, *more: str, name: str = "batch", frames: int = FRAMES) -> Job:
    """Return a job of several frames, each with its own files. Earlier ones are kept.

    Those of the former command have other colours.
    """

    further = more or ("--threads", "1")

    def arguments(beta: str) -> Arguments:
        images = _images(folder, f"fast_[0-{frames - 1}].png", f"{beta}/[0-{frames - 1}].png")
        return lambda out: [*_fuse(folder, "batch"), *images, "--out", str(out), *further]

    job = Job(name, arguments("many"), _frames_of, _frames_mixed, again=("--resume",), kept=_times)
    return job if frames == FRAMES else job._replace(former=arguments("darker"))


def sequence_job(folder: Path) -> Job:
    """A sequence: key frames, frames, and a video, which is not compared."""

    def arguments(out: Path) -> list[str]:
        further = ["--speed", "300", "--threads", "1"]
        return [*_fuse(folder, "sequence"), *_images(folder, "", ""), "--out", str(out), *further]

    return Job("sequence", arguments, _frames_of, _frames_mixed, again=("--resume",), kept=_times)


def _fuse(folder: Path, command: str = "fuse") -> list[str]:
    """The common part of commands that fuse; makes what they need."""
    if not (folder / "fusion" / "rig.yaml").exists():
        torch.manual_seed(0)
        save_weights(GuidedPAT(), folder / "fusion" / "tiny.safetensors")
        frames, _ = moving.recording(FRAMES, 0.003)
        for name, images in frames.items():
            for i, image in enumerate(images):
                write_image(folder / "fusion" / name / f"{name}_{i}.png", image)
        for i in range(FRAMES):
            write_image(folder / "fusion" / "many" / f"{i}.png", frames["slow"][0])
            write_image(folder / "fusion" / "darker" / f"{i}.png", 0.8 * frames["slow"][0])
        moving.rig(0.003).save(folder / "fusion" / "rig.yaml")
    made = folder / "fusion"
    weights = str(made / "tiny.safetensors")
    return [command, str(made / "rig.yaml"), "--alpha", "fast", "--network", weights, "--misfit", "warn"]


def _images(folder: Path, fast: str, slow: str) -> list[str]:
    made = folder / "fusion"
    beta = made / slow if slow.startswith(("many", "darker")) else made / "slow" / slow
    return ["--image", f"fast={made / 'fast' / fast}", "--image", f"slow={beta}"]


def _frames_of(out: Path) -> dict[str, bytes]:
    return {name: content for name, content in files_of(out).items() if name.endswith((".png", ".tif"))}


def _frames_mixed(out: Path, versions: list[dict[str, bytes]]) -> list[str]:
    """The files of each frame are of one making."""
    found, faults = _frames_of(out), []
    for frame in {name.rsplit("_", 1)[0] for name in found}:
        parts = [
            {n: c for n, c in files.items() if n.rsplit("_", 1)[0] == frame} for files in (found, *versions)
        ]
        faults += mixed(parts[0], parts[1:], f"{frame}_fused.png")
    return faults


def _times(out: Path) -> dict[str, int]:
    return {path.name: path.stat().st_mtime_ns for path in out.glob("*_fused.png")}


def training_job(folder: Path) -> Job:
    """A run of six steps with two validations; it continues by the same command."""
    base = short_run(folder, steps=6, validate=3, save=2, groups=1)

    def arguments(out: Path) -> list[str]:
        save_config(replace(base, out=out, cache=out.with_suffix(".npz")), out.with_suffix(".yaml"))
        return ["lab", "train", str(out.with_suffix(".yaml"))]

    return Job("training", arguments, _run_of, _run_faults)


def _run_of(out: Path) -> dict[str, bytes]:
    """The numbers of each step, validations less their time, tensors of weights and last checkpoint."""
    checkpoint = newest_checkpoint(out / "checkpoints")
    assert checkpoint is not None
    found = {name: tensor.numpy().tobytes() for name, tensor in checkpoint.tensors.items()}
    with safe_open(out / "best.safetensors", "pt") as file:
        found |= {f"best/{key}": file.get_tensor(key).numpy().tobytes() for key in file.keys()}  # noqa: SIM118
    lines = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    found["log"] = repr([{k: v for k, v in line.items() if k != "minutes"} for line in lines]).encode()
    return found | {"steps": (out / "steps.csv").read_bytes()}


def _run_faults(out: Path, versions: list[dict[str, bytes]]) -> list[str]:
    """Checkpoints and images are whole, and the lines of steps those of a run that nobody killed."""
    checkpoints = list((out / "checkpoints").glob("step-*.safetensors"))
    faults = [f"torn: {file.name}" for file in checkpoints if read_checkpoint(file) is None]
    faults += [f"torn: {f.name}" for f in out.glob("images/step-*.png") if cv2.imread(str(f)) is None]
    steps = (out / "steps.csv").read_bytes() if (out / "steps.csv").exists() else b""
    return faults + ([] if versions[0]["steps"].startswith(steps) else ["other steps"])


def calibration_job(folder: Path) -> Job:
    """A calibration, over the rig, report and covariance of one with another lens."""
    photos = folder / "board"
    if not photos.exists():
        lens = (-0.2, 0.05, 0, 0, 0)
        cameras = {
            "a": camera(330.0, (240, 320), lens=lens),
            "b": camera(280.0, (220, 300), (0.15, 0, 0), (0, -6, 1)),
        }
        boards = board_poses(6, depth=(0.8, 1.2), spread=0.1)
        for name, c in cameras.items():
            (photos / name).mkdir(parents=True)
            for i in range(6):
                pose = c.cam_from_world @ boards[i]
                image = photograph(c, pose, parse_board(BOARD))
                cv2.imwrite(str(photos / name / f"{i}.png"), image)

    def arguments(lens: str) -> Arguments:
        given = ["calibrate", str(photos), "--board", BOARD, "--lens", lens]
        return lambda out: [*given, "-o", str(out / "rig.yaml")]

    return Job(
        "calibration", arguments("brown-conrady"), files_of, whole("rig.yaml"), former=arguments("none")
    )


def rendering_job(folder: Path, backend: str = "layered", scenes: int = 4) -> Job:
    """Scenes made by two worker processes."""
    (folder / "scene.yaml").write_text(SCENE)
    config = folder / f"{backend}.yaml"
    settings = {
        "layered": {"backend": "layered", "layered": {"layers": [4, 7], "oversampling": 1}},
        "blender": {"backend": "blender", "blender": {"settings": {"width": 96, "samples": 2}}},
    }
    config.write_text(yaml.safe_dump({"rig": "scene.yaml", "seed": 1, **settings[backend]}))

    def arguments(out: Path) -> list[str]:
        return ["lab", "render", str(config), "--out", str(out), "--scenes", str(scenes), "--workers", "2"]

    def compared(out: Path) -> dict[str, bytes]:
        made = files_of(out / "scenes")
        return {n: content for n, content in made.items() if not n.endswith(("farm.json", "render.json"))}

    def faults(out: Path, versions: list[dict[str, bytes]]) -> list[str]:
        found, wrong = compared(out), []
        for scene in {name.partition("/")[0] for name in found}:
            here, right = (
                {n: c for n, c in files.items() if n.startswith(scene)} for files in (found, versions[0])
            )
            wrong += [] if here == right else [f"not whole: scene {scene}"]
        return wrong

    def kept(out: Path) -> dict[str, int]:
        return {path.name: path.stat().st_mtime_ns for path in (out / "scenes").glob("*")}

    name = "rendering" if backend == "layered" else "rendering by Blender"
    return Job(name, arguments, compared, faults, kept=kept)


def all_jobs(folder: Path) -> Iterator[Job]:
    """Return the jobs of the table."""
    yield conversion_job(folder)
    yield frame_job(folder)
    yield batch_job(folder)
    yield batch_job(folder, "--workers", "2", name="batch, two workers")
    yield sequence_job(folder)
    yield training_job(folder)
    yield calibration_job(folder)
    yield rendering_job(folder)
    try:
        blender_python()
    except ValueError as error:
        print(f"rendering by Blender is left out: {error}", file=sys.stderr)
    else:
        yield rendering_job(folder, "blender", scenes=3)
