"""Commands for developing networks: evaluate, ablate, data, render, train, settings."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from ..app.cli import options
from ..app.cli.options import Address, FieldName, NetworkName, Out, say, writable
from ..app.cli.parser import Option
from ..support.folders import check_apart

if TYPE_CHECKING:
    from .data.pairs import StereoPair
    from .evaluation.stereo import StereoRow

RenderedFolder = Annotated[Path, Option("FOLDER", "Folder written by `pat lab render`.", positional=True)]


@dataclass
class StereoSets:
    """Stereo pairs by data set, the network that fuses them, and where results go."""

    kitti: Path | None = None
    """Folder of KITTI pairs: image_2 / image_3, or left.png / right.png."""
    middlebury: Path | None = None
    """Folder of Middlebury's 2001 to 2006 collections."""
    flickr1024: Path | None = None
    """Folder of Flickr1024 pairs: 0001_L.png / 0001_R.png."""
    folder: Path | None = None
    """Folder of other pairs, named in any of these ways."""
    out: Out = Path("out/evaluate")
    """Folder for what is written."""
    network: NetworkName = "mono-colour"

    def sets(self) -> dict[str, Iterable[StereoPair]]:
        """Open the folders of stereo pairs, and check that results can be written.

        Returns:
            Iterators over the pairs, read on demand, by data set.

        Raises:
            ValueError: if no folder is given, one has no pair, or `out` cannot be written or is in one.
            FileNotFoundError: for a missing folder, or file of Middlebury's.
        """
        from .evaluation.stereo import DATA_SETS

        folders = {name: getattr(self, name) for name in DATA_SETS if getattr(self, name) is not None}
        if not folders:
            raise ValueError(f"no images: give at least one of --{', --'.join(DATA_SETS)}")
        check_apart(writable(self.out, folder=True), folders.values())
        return {name: DATA_SETS[name](folder) for name, folder in folders.items()}


@dataclass
class Evaluate(StereoSets):
    """Compare alpha alone, the classical baseline and the fusion on stereo pairs: PSNR, SSIM, images.

    The left image made grey is alpha, the right one, reduced, is beta, the left one in colour is the ground
    truth.

    Example: pat lab evaluate --kitti data/kitti --middlebury data/middlebury
    """

    rates: tuple[int, ...] = (2, 4)
    """Factors by which beta is reduced."""
    out: Out = Path("out/evaluate")
    """Folder for scores.md, scores.csv and, in a folder for each data set, strips of images."""

    def run(self) -> None:
        """Score all methods on all pairs; write scores and strips of images to `out`, and print the scores.

        Raises:
            FileNotFoundError: for a missing folder, image, or file of weights.
            ValueError: as `sets`, `evaluate_pairs` and `fuse_frame`, for images that cannot be read, and
                weights that cannot be used.
            OSError: if a result cannot be written.
        """
        from ..networks.weights import load_weights
        from .evaluation import protocols, stereo

        sets = self.sets()
        methods = {**protocols.BASELINES, "fusion": protocols.rectified_fusion(load_weights(self.network))}
        rows = stereo.evaluate_sets(sets, methods, self.rates, out=self.out)
        self.write(rows, stereo.sets_markdown(rows))

    def sets(self) -> dict[str, Iterable[StereoPair]]:
        """Open the folders of stereo pairs as `StereoSets.sets`, and check the rates.

        Returns:
            Iterators over the pairs, read on demand, by data set.

        Raises:
            ValueError: for no rates or one below 1; it and further errors as `StereoSets.sets`.
        """
        if not self.rates or min(self.rates) < 1:
            raise ValueError(f"--rates: {' '.join(map(str, self.rates))}: give whole numbers from 1 up")
        return super().sets()

    def write(self, rows: Mapping[str, Sequence[StereoRow]], text: str) -> None:
        """Write scores.md and scores.csv into `out`, and print `text`.

        Args:
            rows: scores by data set, for the CSV file.
            text: scores in Markdown, for scores.md.

        Raises:
            OSError: if they cannot be written.
        """
        from arraygeom.runtime.atomic import write_text

        from .evaluation.stereo import StereoRow
        from .evaluation.tables import write_csv

        write_text(self.out / "scores.md", text)
        all_rows = [(name, *row) for name, of_method in rows.items() for row in of_method]
        write_csv(self.out / "scores.csv", ("set", *StereoRow._fields), all_rows)
        print(text, end="")
        say(f"written: {self.out / 'scores.md'}, {self.out / 'scores.csv'}, images in {self.out}")


@dataclass
class Ablate:
    """Compare families of receptive fields by one network: the gain from calibration.

    Scenes are layered, of unrectified rigs whose alpha has 1 to 3 times beta's focal length; or rendered
    scenes of your own rig.

    Example: pat lab ablate --rendered scenes --network runs/mine/best.safetensors
    """

    network: NetworkName = "pat-supervised"
    photos: tuple[Path, ...] = ()
    """Folders of photographs; scikit-image's, and patterns, if none is given."""
    rendered: Path | None = None
    """Folder of scenes written by `pat lab render`: their first camera is alpha, their second beta."""
    scenes: int = 6
    """Number of scenes."""
    hw: Annotated[tuple[int, int], Option("H W")] = (240, 320)
    """Height and width of both images. The family `dense` compares each pixel with each: it takes longer than
    all others together, and is left out where that does not fit into 2 GiB, as at 240 x 320."""
    seed: int = 0
    """Random seed of the scenes."""
    field: FieldName = "auto"
    out: Out = Path("out/ablate")
    """Folder for ablation.md, ablation.csv and ablation.png."""

    def run(self) -> None:
        """Compare the families; write and print the table.

        Raises:
            FileNotFoundError: for a missing folder of rendered scenes, or file of weights.
            ValueError: for fewer than one scene, options of layered scenes next to --rendered, folders
                without photographs, `out` not writable or in one, an unusable field or weights, and as
                `ablate` and `rendered_cases`.
            OSError: if a result cannot be written.
        """
        from ..networks.weights import load_weights
        from .evaluation.ablation import FieldFamily, ablate, families, layered_cases, rendered_cases

        if self.scenes < 1:
            raise ValueError(f"--scenes: {self.scenes}: give at least 1")
        layered = [n for n in ("photos", "scenes", "hw") if getattr(self, n) != getattr(Ablate, n)]
        if self.rendered is not None and layered:
            raise ValueError(f"--{', --'.join(layered)}: of layered scenes: leave out with --rendered")
        check_apart(writable(self.out, folder=True), self.photos)
        network = load_weights(self.network)
        if self.rendered is not None:
            cases = rendered_cases(self.rendered, seed=self.seed)
        else:
            cases = layered_cases(self.scenes, photos=self.photos, hw=self.hw, seed=self.seed)
        chosen, given_field = families(), options.field_named(self.field)
        if given_field is not None:
            chosen[self.field] = FieldFamily(lambda disparity: given_field)
        ablate(network, cases, out=self.out, chosen=chosen)
        print((self.out / "ablation.md").read_text(encoding="utf-8"), end="")
        say(f"written: {self.out / 'ablation.md'}, and its figures and numbers beside it")


@dataclass
class DataInfo:
    """Summarise a folder of rendered scenes: sizes, time and memory they took, refused seeds."""

    folder: RenderedFolder

    def run(self) -> None:
        """Print the summary.

        Raises:
            FileNotFoundError: for a missing folder.
            ValueError: for a folder without complete scenes, and as `summarise` for a damaged one.
        """
        from .farm.job import summarise

        print(summarise(self.folder))


class Data:
    """Inspect rendered scenes."""

    commands: ClassVar[Mapping[str, Any]] = {"info": DataInfo}


@dataclass
class Render:
    """Render many scenes of a rig for training: workers, retries, resuming, clusters.

    Example: pat lab render config.yaml --scenes 900 --out data/ --workers 2

    The same command again renders what is missing. The file has at least `rig: rig.yaml`; see
    `pat.lab.farm.job.RenderConfig`.
    """

    config: Annotated[Path, Option("CONFIG", positional=True)]
    """File of the job (YAML): rig, seed, backend and its settings."""
    scenes: int
    """Number of scenes there should be in the end."""
    out: Out
    """Folder of the scenes."""
    workers: int = 1
    """Processes on this machine."""
    shard: Annotated[str, Option("I/N")] = "1/1"
    """Only every N-th scene from the I-th on, for batch systems."""
    scheduler: Address = None
    """Address of a Dask scheduler whose workers render the scenes, such as tcp://host:8786."""
    generator: Annotated[str | None, Option("MODULE:FUNCTION")] = None
    """The file's `blender.generator`, if it is code of your own: the file alone does not run it."""

    def run(self) -> None:
        """Render the missing scenes of the shard; exits with status 1 if some are still missing afterwards.

        Raises:
            FileNotFoundError: for a missing configuration file.
            ValueError: for an invalid configuration or shard, a missing rig or folder of photographs, code
                named in the file and not in --generator; it and further errors as `pat.lab.farm.job.render`.
            SystemExit: with status 1, if a scene failed.
        """
        from .farm.job import RenderConfig, Shard, render

        config = RenderConfig.load(self.config)
        if ":" in (named := config.blender.generator) and self.generator != named:
            raise ValueError(
                f"{self.config}: blender.generator: {named} is code, which a file alone does not run: "
                f"if you trust it, add --generator {named}"
            )
        report = render(
            config,
            scenes=self.scenes,
            out=self.out,
            workers=self.workers,
            shard=Shard.parse(self.shard),
            scheduler=self.scheduler,
            console=options.console(),
        )
        say(f"{self.out}: {report}" + ": the same command tries these again" * bool(report.failed))
        if report.failed:
            sys.exit(1)


@dataclass
class Train:
    """Train weights by a recipe, on scenes made from photographs during training.

    Example: pat lab train pat-supervised --photos ~/images --out runs/mine --minutes 60
    """

    config: Any

    @classmethod
    def parse(cls, arguments: list[str], prog: str) -> Train:
        """Parse the command's arguments; its options are the entries of the recipe.

        Returns:
            The command, ready to run.

        Raises:
            ValueError: as `command_line`, which also raises FileNotFoundError and, after `--help`,
                SystemExit.
        """
        from .training.config import command_line

        return cls(config=command_line(arguments, prog))

    def run(self) -> None:
        """Train, or continue a run that stopped, and print the weights' file.

        Raises:
            ValueError: for a folder with another run, and data that do not suit the recipe; it and further
                errors as `pat.lab.training.loop.train`.
        """
        from .training.loop import train

        say(f"written: {train(self.config)}")


@dataclass
class Settings:
    """List the settings of matching, fusion and networks: value, kind, and reason of each.

    Kinds: *physics* follows from a measurement, *size* is the amount of work at a time, *tuned* was chosen on
    images.

    Example: pat lab settings --kind tuned
    """

    kind: Literal["physics", "size", "tuned", "all"] = "all"
    """Kind of settings to list."""

    rooms: ClassVar[tuple[str, ...]] = ("pat.matching", "pat.fusion", "pat.networks")

    def run(self) -> None:
        """Print a line for each setting of `kind`, and their number."""
        from ..support.settings import all_settings

        entries = [s for s in all_settings(*self.rooms) if self.kind in ("all", s.kind)]
        for entry in entries:
            name = f"{entry.algorithm.removesuffix('Settings')}.{entry.name}"
            print(f"{entry.kind:8}{name} = {entry.value}  {entry.why}")
        print(f"{sum(s.numbers for s in entries)} numbers under {len(entries)} names")


@dataclass
class Import:
    """Convert a checkpoint of the paper's authors (best.pth.tar) to a weights file for `--network`.

    The file is read as tensors and numbers; nothing in it is run.

    Example: pat lab weights import log_2inputs/x4/best.pth.tar --out pat-authors.safetensors
    """

    checkpoint: Annotated[Path, Option("FILE", "Checkpoint, for any number of inputs.", positional=True)]
    out: Out = Path("pat-authors.safetensors")
    """Weights file to write."""

    def run(self) -> None:
        """Convert the checkpoint and write the weights.

        Raises:
            FileNotFoundError: for a missing file.
            ValueError: for a file that is no such checkpoint, and an `out` that cannot be written.
        """
        from ..networks.paper import PAT
        from ..networks.weights import save_weights
        from .training.authors import read_authors

        writable(self.out)
        read = read_authors(self.checkpoint)
        network = PAT(read.config)
        network.load_state_dict(read.state)
        save_weights(network, self.out, facts=read.facts)
        betas, c = read.config.betas, read.config
        what = f"{betas} beta{'s' * (betas > 1)}, images of {c.in_channels} channels, enlarged {c.scale}x"
        say(f"written: {self.out} (PAT for {what})")


class Weights:
    """Convert weights of other programs."""

    commands: ClassVar[Mapping[str, Any]] = {"import": Import}
