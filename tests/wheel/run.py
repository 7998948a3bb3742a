"""Published files, installed into empty environments and used there; for docs/reports/performance.md.

    python -m tests.wheel.run [--python PYTHON ...] [--lowest] [--torch 2.13.0] [--folder out/wheel] [--keep]

An sdist is built of the tree and the wheel of the sdist. For each interpreter an environment is made, with
the newest dependencies that constraints.txt allows and, with --lowest, with the oldest that pyproject.toml
allows; an environment with `arraygeom` alone is made for the first. Only the standard library is used. Exit
status 1 if anything fails.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import time
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
SAMPLE = ROOT / "pat" / "app" / "sample"
EXPLORE = """
from pathlib import Path
import pat
from arraygeom import Rig
from pat.app.explore import ExplorerScene, opened
folder = Path(pat.__file__).parent / "app" / "sample"
images = {name: pat.read_image(folder / f"{name}.png") for name in ("mono", "colour")}
opened(Rig.load(folder / "rig.yaml"), images).save("explorer.html")
"""
GEOMETRY = """
import torch
from arraygeom import Epipolar, Rig
rig = Rig.load("rig.yaml")
rig.save("again.yaml")
segment = Epipolar()(rig.pair("mono", "colour"), torch.tensor([120.0, 80.0]))
assert bool(segment.valid), segment
"""
STEPS = {
    "pat demo": "pat demo --out demo",
    "pat fuse a b": "pat fuse mono.png colour.png --out fused",
    "explorer, saved": "python explore.py",
}
IMPORTS = {"import arraygeom": "import arraygeom", "import pat": "import pat", "fuse": "from pat import fuse"}


def main() -> int:
    """Build, install, use; print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--python", nargs="+", default=[sys.executable], help="interpreters")
    parser.add_argument(
        "--lowest", action="store_true", help="the oldest dependencies too, with the first interpreter"
    )
    parser.add_argument("--torch", help="this version of torch everywhere (where one build can be had)")
    parser.add_argument("--folder", type=Path, default=ROOT / "out" / "wheel")
    parser.add_argument("--keep", action="store_true", help="keep the environments")
    given = parser.parse_args()
    folder = given.folder.absolute()
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    wheel, geometry = built(folder)
    print(
        f"{wheel.name}: {wheel.stat().st_size / 1e6:.2f} MB; {geometry.name}: "
        f"{geometry.stat().st_size / 1e3:.0f} kB"
    )
    print("\n| Python | dependencies | " + " | ".join([*STEPS, *IMPORTS]) + " |")
    print("| --- | --- |" + " ---: |" * (len(STEPS) + len(IMPORTS)), flush=True)
    cases = [(python, "newest") for python in given.python] + [(given.python[0], "lowest")] * given.lowest
    failed = [case for case in cases if not used(folder, wheel, *case, torch=given.torch, keep=given.keep)]
    alone = geometry_alone(folder, geometry, given.python[0], given.torch, given.keep)
    return int(bool(failed) or not alone or geometry.stat().st_size > 300e3)


def built(folder: Path) -> tuple[Path, Path]:
    """The wheel of the sdist, and that of arraygeom alone."""
    tools = environment(folder / "tools", sys.executable)
    call(tools, "pip", "install", "setuptools>=77")
    build = f"import setuptools.build_meta as b; b.build_sdist({str(folder)!r})"
    call(tools, "python", "-c", build, cwd=ROOT)
    (sdist,) = folder.glob("*.tar.gz")
    call(tools, "pip", "wheel", "--no-deps", "--wheel-dir", folder, sdist)
    copy = shutil.copytree(ROOT / "arraygeom", folder / "tree", ignore=shutil.ignore_patterns("__pycache__"))
    call(tools, "pip", "wheel", "--no-deps", "--wheel-dir", folder, copy)
    (wheel,), (geometry,) = folder.glob("arraygeom_pat-*.whl"), folder.glob("arraygeom-*.whl")
    return wheel, geometry


def used(folder: Path, wheel: Path, python: str, which: str, torch: str | None, keep: bool) -> bool:
    """Install the wheel and let it do its work; one row of the table."""
    here = environment(folder / "environment", python)
    version = subprocess.run(
        [here / "python", "-c", "import sys; print(sys.version.split()[0])"], capture_output=True
    )
    row = f"| {version.stdout.decode().strip()} | {which} | "
    try:
        limits = folder / "constraints.txt"
        text = (ROOT / "constraints.txt").read_text() if which == "newest" else lowest(torch)
        limits.write_text(text)
        call(
            here,
            "pip",
            "install",
            "--constraint",
            limits,
            *([f"torch=={torch}"] if torch else ["torch"]),
            wheel,
        )
        work = folder / "work"
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir()
        for name in ("mono.png", "colour.png"):
            shutil.copy(SAMPLE / name, work)
        (work / "explore.py").write_text(EXPLORE)
        times = [timed(here, step.split(), work) for step in STEPS.values()]
        times += [
            min(timed(here, ["python", "-c", code], work) for _ in range(3)) for code in IMPORTS.values()
        ]
        print(row + " | ".join(f"{seconds:.1f} s" for seconds in times) + " |", flush=True)
        return True
    except subprocess.CalledProcessError as error:
        print(f"{row}failed: {error.cmd}\n{error.output[-3000:]}", flush=True)
        return False
    finally:
        if not keep:
            shutil.rmtree(folder / "environment", ignore_errors=True)


def geometry_alone(folder: Path, wheel: Path, python: str, torch: str | None, keep: bool) -> bool:
    """Install arraygeom's own wheel and use it."""
    here = environment(folder / "geometry", python)
    try:
        words = ["--constraint", ROOT / "constraints.txt", *([f"torch=={torch}"] if torch else ["torch"])]
        call(here, "pip", "install", *words, wheel)
        shutil.copy(SAMPLE / "rig.yaml", folder)
        seconds = timed(here, ["python", "-c", GEOMETRY], folder)
        packages = call(here, "python", "-m", "pip", "list", "--format=freeze").split()
        print(
            f"\narraygeom alone: {seconds:.1f} s, with {len(packages)} packages: {' '.join(packages)}",
            flush=True,
        )
        more = [name for name in packages if re.match("(opencv|scipy|numba|pillow|arraygeom-pat)", name)]
        return bool(packages) and not more
    except subprocess.CalledProcessError as error:
        print(f"\narraygeom alone failed: {error.cmd}\n{error.output[-3000:]}", flush=True)
        return False
    finally:
        if not keep:
            shutil.rmtree(folder / "geometry", ignore_errors=True)


def lowest(torch: str | None) -> str:
    """Last patches of the oldest versions pyproject.toml allows; without torch if a version is given."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    pinned = [re.sub(r">=(\d+)$", r">=\1.0", requirement) for requirement in project["dependencies"]]
    pinned = [re.sub(">=([^,]*).*", r"==\1.*", requirement) for requirement in pinned]
    return "\n".join(line for line in pinned if not (torch and line.startswith("torch==")))


def environment(folder: Path, python: str) -> Path:
    """A new environment; the folder of its commands."""
    shutil.rmtree(folder, ignore_errors=True)
    subprocess.run([python, "-m", "venv", folder], check=True)
    return folder / ("Scripts" if os.name == "nt" else "bin")


def call(commands: Path, command: str, *words: str | Path, cwd: Path | None = None) -> str:
    """Return the output of a command of an environment.

    Raises:
        subprocess.CalledProcessError: with the output, if the command fails.
    """
    if command == "pip":
        line = [
            commands / "python",
            "-m",
            "pip",
            words[0],
            "--quiet",
            "--disable-pip-version-check",
            *words[1:],
        ]
    else:
        line = [commands / command, *words]
    line = [str(word) for word in line]
    without = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "VIRTUAL_ENV")}
    done = subprocess.run(
        line, cwd=cwd, env=without, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    if done.returncode:
        raise subprocess.CalledProcessError(done.returncode, " ".join(line), done.stdout)
    return done.stdout


def timed(commands: Path, words: list[str], cwd: Path) -> float:
    """Seconds that a command took."""
    begin = time.monotonic()
    call(commands, words[0], *words[1:], cwd=cwd)
    return time.monotonic() - begin


if __name__ == "__main__":
    sys.exit(main())
