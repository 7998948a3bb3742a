"""`python -m experiments COMMAND ...`: the paper's arrays, fusion of real images, the docs' tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pat.app.cli.main import main
from pat.app.cli.options import MaybeOut, Memory, NetworkName, Out, progress, say, working, writable
from pat.app.cli.parser import Option
from pat.lab.data.windows import scene_folders
from pat.sensors import seed_for
from pat.support.schema import read_yaml

from .alignment import evaluate_alignment
from .evaluation import commands
from .fast_slow.recorded import run_recorded
from .sensors import read_chains, record_rendered
from .showcase import showcase
from .system import NAMES, load_system, run_system


@dataclass
class Showcase:
    """Fuse real images: stereo pairs, calibrated pairs not rectified, the paper's fast + slow array."""

    data: Path
    """Folder with kitti, middlebury, flickr1024, syntim and hfr_lfr."""
    out: Out = Path("out/showcase")
    """Folder for showcase.md, the figures and the rig files."""
    network: NetworkName = "mono-colour"

    def run(self) -> None:
        """Write and print the tables. Raises ValueError or FileNotFoundError naming what is missing."""
        writable(self.out, folder=True)
        print(showcase(self.data, self.out, self.network), end="")
        say(f"written: {self.out / 'showcase.md'}, and its figures and rig files")


@dataclass
class Alignment:
    """Measure how well bands are aligned, beside a homography: stereo as bands, multispectral cameras."""

    data: Path = Path("data")
    """Folder with middlebury, multispectral and nine_band_array."""
    scenes: tuple[str, ...] = ("middlebury", "rededge", "sequoia", "nine-band")
    """Some of these, or motorcycle, which needs no data."""
    out: Out = Path("out/alignment")
    """Folder for alignment.md and a figure of each scene."""

    def run(self) -> None:
        """Write and print the table. Raises ValueError or FileNotFoundError naming what is missing."""
        writable(self.out, folder=True)
        with working("aligning") as retitle:
            text = evaluate_alignment(self.data, self.out, self.scenes, each=retitle)
        print(text, end="")
        say(f"written: {self.out / 'alignment.md'}, and figures")


@dataclass
class SystemsList:
    """List the paper's four arrays."""

    def run(self) -> None:
        """Print a line for each."""
        for name in NAMES:
            print(f"{name:12s} {load_system(name).title}")


@dataclass
class SystemsRun:
    """Render a scene for an array, record it, fuse it, compare with the ground truth: PSNR, SSIM and images.

    Example: python -m experiments systems run fast-slow --out out/fast-slow
    """

    name: Annotated[str, Option(positional=True)]
    """One of the names that `python -m experiments systems list` prints."""
    full: bool = False
    """At the full size of the paper's cameras; by default reduced, minutes on two cores."""
    scene: Literal["layered", "rendered"] = "layered"
    """Photographs on planes; or a still life (visible-nir: landscape) rendered by Blender, as one sees it."""
    recording: Path | None = None
    """For fast-slow: the paper's frames, not a rendered scene: a folder with pillow_1 and the matrices."""
    out: MaybeOut = None
    """Folder for the results; by default out/systems/NAME."""
    network: NetworkName = "mono-colour"
    max_memory: Memory = None
    """Memory limit of fusing, such as 4GiB."""

    def run(self) -> None:
        """Print the scores, and the expected ones where they are of the same settings."""
        out = writable(self.out or Path("out/systems") / self.name, folder=True)
        if self.recording is None:
            how: dict[str, Any] = {"full": self.full, "scene": self.scene, "max_memory": self.max_memory}
            result = run_system(self.name, out, say=say, weights=self.network, **how)
        elif self.name == "fast-slow":
            result = run_recorded(self.recording, out, weights=self.network, say=say)
        else:
            raise ValueError(f"--recording is of fast-slow, not of '{self.name}'")
        print(result.table, end="")
        if self.recording is None and self.scene == "layered" and not self.full:
            say(f"\nexpected:\n{load_system(self.name).expected}")
        say(f"written: {', '.join(map(str, result.written))}")


class Systems:
    """Run the paper's four arrays, each from a rendered scene to figures."""

    commands: ClassVar[Mapping[str, Any]] = {"list": SystemsList, "run": SystemsRun}


@dataclass
class Record:
    """Record rendered scenes as their cameras would: of each scene images and a rig, for `pat fuse`."""

    folder: Annotated[Path, Option("FOLDER", "Folder written by `pat lab render`.", positional=True)]
    out: Out = Path("out/recorded")
    """Folder for a folder of each scene."""
    sensors: Path | None = None
    """File (YAML) with a list of steps for each camera, instead of those that follow from their responses."""
    seed: int = 0
    """Seed of the noise."""

    def run(self) -> None:
        """Write images and rigs. Raises ValueError for a folder without scenes, and for unknown steps."""
        chains = None if self.sensors is None else read_chains(read_yaml(self.sensors), str(self.sensors))
        scenes = scene_folders(self.folder)
        writable(self.out, folder=True)
        for scene in progress("recording")(scenes, len(scenes)):
            record_rendered(scene, self.out / scene.name, chains, seed=seed_for(self.seed, scene.name))
        say(f"written: {self.out} (images and rig.yaml of each of {len(scenes)} scenes)")


class Experiments:
    """Run the paper's arrays, fuse real images, and measure the tables of the documentation."""

    commands: ClassVar[Mapping[str, Any]] = {
        "systems": Systems,
        "showcase": Showcase,
        "alignment": Alignment,
        "evaluate": commands.Evaluate,
        "conditions": commands.Conditions,
        "outside": commands.Outside,
        "stages": commands.Stages,
        "sensitivity": commands.Sensitivity,
        "gradients": commands.Gradients,
        "certainty": commands.Certainty,
        "sweeps": commands.Sweeps,
        "fields": commands.Fields,
        "trained-fields": commands.TrainedFields,
        "record": Record,
    }


if __name__ == "__main__":
    main(group=Experiments, prog="python -m experiments")
