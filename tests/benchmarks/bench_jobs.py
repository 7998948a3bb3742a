"""A job of forty frames: speed, and what it survives. `python -m tests.benchmarks.bench_jobs [--frames 40]`.

Forty images of the sample array, each a little brighter, fused by `pat fuse`: with one and with two workers;
with a worker killed (kill -9) in the middle; with the whole command killed and begun again; with a corrupt
image, and one that disappears under way; and onto a disk that fills up (a small tmpfs, where mounting is
allowed). Every image of every run is compared, byte for byte, with that of the first run. Exits with 1 if
anything differs.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import psutil
from torch.nn.functional import interpolate

from arraygeom import Rig
from pat.data.sample_array import SAMPLE
from pat.media.images import read_image, write_image

ROOT = Path(__file__).parents[2]


@dataclass
class Job:
    """The images to fuse in `folder`, the images that should come of them, and what was found wrong."""

    folder: Path
    frames: int
    wanted: dict[str, bytes] = field(default_factory=dict)
    wrong: list[str] = field(default_factory=list)

    def make_images(self, scale: float) -> None:
        """Forty of each camera."""
        rig = Rig.load(SAMPLE / "rig.yaml")
        for name in rig.names:
            hw = tuple(round(n * scale / 2) * 2 for n in rig[name].hw)
            rig = rig.resize(name, hw)
            image = interpolate(read_image(SAMPLE / f"{name}.png")[None], hw, mode="area")[0]
            for i in range(self.frames):
                write_image(self.folder / name / f"{i:03d}.png", image * (0.7 + 0.3 * i / self.frames))
        rig.save(self.folder / "rig.yaml")

    def start(self, out: Path, *more: str) -> subprocess.Popen:
        """`pat fuse` of all frames."""
        images = [text for name in ("mono", "colour") for text in ("--image", f"{name}={self.folder / name}")]
        line = [
            sys.executable,
            "-m",
            "pat",
            "fuse",
            "--rig",
            self.folder / "rig.yaml",
            "--alpha",
            "mono",
            *images,
        ]
        run = [str(part) for part in (*line, "--out", out, "--threads", "1", *more)]
        log = out.with_suffix(".log").open("a")
        return subprocess.Popen(run, stdout=log, stderr=log, start_new_session=True, cwd=ROOT)

    def said(self, out: Path) -> str:
        """What the runs into a folder printed, in one line."""
        return re.sub(r"\s+", " ", out.with_suffix(".log").read_text())

    def compare(self, out: Path, what: str, *, without: tuple[int, ...] = ()) -> None:
        """Note what differs from the first run; nothing half-written may lie there."""
        found, gone = fused(out), {f"{i:03d}" for i in without}
        wanted = {name: content for name, content in self.wanted.items() if name[:3] not in gone}
        if found != wanted:
            other = sorted(n for n in found.keys() | wanted.keys() if found.get(n) != wanted.get(n))
            self.wrong.append(f"{what}: {len(other)} images differ, such as {other[:3]}")
        self.expect(all(p.name == ".keys" for p in out.glob(".*")), f"{what}: pieces of files")

    def expect(self, right: bool, what: str) -> None:
        """Note what is wrong."""
        self.wrong += [] if right else [what]


def fused(out: Path) -> dict[str, bytes]:
    """The fused images by name."""
    return {p.name: p.read_bytes() for p in sorted(out.glob("*_fused.png"))}


def count(out: Path) -> int:
    """How many frames are there."""
    return len(list(out.glob("*_fused.png")))


def wait_for(process: subprocess.Popen, condition: Callable[[], bool]) -> None:
    """Until something is so, or the process has ended."""
    while process.poll() is None and not condition():
        time.sleep(0.02)


def throughput(job: Job, workers: int) -> str:
    """All frames; the first run is the measure of the others."""
    out, begin = job.folder / f"workers{workers}", time.monotonic()
    process = job.start(out, "--workers", str(workers))
    wait_for(process, lambda: count(out) > workers)
    first, there = time.monotonic(), count(out)
    job.expect(process.wait() == 0, f"{workers} workers: {job.said(out)[-200:]}")
    seconds, rate = time.monotonic() - begin, 60 * (job.frames - there) / (time.monotonic() - first)
    job.wanted = job.wanted or fused(out)
    job.compare(out, f"{workers} workers")
    return f"{workers} worker(s): {job.frames} frames in {seconds:.0f} s; {rate:.1f} a minute once begun"


def kill_a_worker(job: Job) -> str:
    """SIGKILL to a worker that is at a frame."""
    out = job.folder / "killed_worker"
    process = job.start(out, "--workers", "2")
    wait_for(process, lambda: count(out) >= job.frames // 3)
    workers = [
        p
        for p in psutil.Process(process.pid).children(recursive=True)
        if "spawn_main" in " ".join(p.cmdline())
    ]
    max(workers, key=lambda p: sum(p.cpu_times()[:2])).kill()
    there = count(out)
    job.expect(process.wait() == 0, f"killed worker: {job.said(out)[-200:]}")
    job.compare(out, "killed worker")
    return f"a worker killed after {there} frames: {count(out)} frames, the same bits"


def kill_the_command(job: Job) -> str:
    """SIGKILL to the command and its workers; the same command with --resume."""
    out = job.folder / "killed_command"
    process = job.start(out, "--workers", "2")
    wait_for(process, lambda: count(out) >= job.frames // 3)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    before = {p.name: p.stat().st_mtime_ns for p in out.glob("*_fused.png")}
    job.expect(0 < len(before) < job.frames, f"killed command: {len(before)} frames were there")
    job.expect(job.start(out, "--workers", "2", "--resume").wait() == 0, f"resumed: {job.said(out)[-200:]}")
    after = {p.name: p.stat().st_mtime_ns for p in out.glob("*_fused.png")}
    job.expect(
        all(after[name] == when for name, when in before.items()), "resumed: finished frames were made again"
    )
    job.compare(out, "killed command")
    return f"the command killed after {len(before)} frames and resumed: {count(out)} frames, the same bits"


def bad_images(job: Job) -> str:
    """One image cut in half, one that is removed while the job runs."""
    corrupt, gone = job.folder / "mono" / "007.png", job.folder / "colour" / f"{job.frames - 2:03d}.png"
    kept, out = {p: p.read_bytes() for p in (corrupt, gone)}, job.folder / "bad"
    try:
        corrupt.write_bytes(kept[corrupt][: len(kept[corrupt]) // 2])
        stopped = job.start(out, "--on-error", "stop").wait()
        job.expect(stopped != 0 and count(out) == 7, f"stop: {count(out)} frames, status {stopped}")
        process = job.start(out, "--on-error", "skip", "--resume")
        wait_for(process, lambda: count(out) > 9)
        gone.unlink()
        job.expect(process.wait() == 1, f"skip: {job.said(out)[-200:]}")
        job.compare(out, "bad images", without=(7, job.frames - 2))
        for file, words in ((corrupt, "not an image"), (gone, "no such image")):
            job.expect(f"{file.name}: {words}" in job.said(out), f"{file} is not named")
    finally:
        for file, content in kept.items():
            file.write_bytes(content)
    done = job.start(out, "--resume").wait() == 0
    job.expect(done, f"mended: {job.said(out)[-200:]}")
    job.compare(out, "mended")
    return (
        "stopped at the corrupt image, or skipped it and the vanished one: "
        f"{job.frames - 2} right; mended: all"
    )


def full_disk(job: Job) -> str:
    """A tmpfs with room for about half of the frames, then for all."""
    disk = job.folder / "disk"
    disk.mkdir()
    size = sum(p.stat().st_size + 4096 for p in (job.folder / "workers1").iterdir() if p.is_file()) // 2
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(disk)]
    if shutil.which("mount") is None or subprocess.run(mount, stderr=subprocess.DEVNULL).returncode:
        return "full disk: not shown, mounting is not allowed here"
    try:
        out = disk / "out"
        out.with_suffix(".log").symlink_to(job.folder / "disk.log")
        status, there = job.start(out, "--on-error", "stop").wait(), count(out)
        job.expect(status != 0 and "No space left" in job.said(out), f"full disk: {job.said(out)[-200:]}")
        job.compare(out, "full disk", without=tuple(range(there, job.frames)))
        subprocess.run(["mount", "-o", f"remount,size={4 * size}", str(disk)], check=True)
        job.expect(job.start(out, "--resume").wait() == 0, f"room made: {job.said(out)[-200:]}")
        job.compare(out, "room made")
    finally:
        subprocess.run(["umount", "-l", str(disk)], check=False)
    return f"the disk was full after {there} frames, all whole; room made and resumed: the same bits"


def run(folder: Path, *, frames: int, scale: float, say: Callable[[str], None] = print) -> list[str]:
    """All of it; what is wrong."""
    job = Job(folder, frames)
    job.make_images(scale)
    for workers in (1, 2):
        say(throughput(job, workers))
    for part in (kill_a_worker, kill_the_command, bad_images, full_disk):
        say(part(job))
    return job.wrong


def main() -> None:
    """Print what happened."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--scale", type=float, default=0.5, help="size of the images, of the sample's")
    given = parser.parse_args()
    print(f"{os.cpu_count()} cores, load before: {os.getloadavg()[0]:.1f}", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        wrong = run(
            Path(folder), frames=given.frames, scale=given.scale, say=lambda text: print(text, flush=True)
        )
    print("\n".join(wrong) or "nothing wrong")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
