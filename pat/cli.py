"""The command line: `pat ...`."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.progress import track
from rich.table import Table
from tyro.conf import OmitSubcommandPrefixes, Positional, UseAppendAction

from arraygeom import (
    Dense,
    Epipolar,
    EpipolarLine,
    HomographyDisplacement,
    Local,
    NearestVoxels,
    ReceptiveField,
    Rectified,
    Rig,
)

from .train import TrainConfig, train

if TYPE_CHECKING:
    from torch import Tensor

    from .fuse import FusedFrame, Tile

FIELDS: dict[str, Callable[[], ReceptiveField]] = {
    "epipolar": Epipolar,
    "line": EpipolarLine,
    "homography": HomographyDisplacement,
    "rectified": Rectified,
    "nearest": NearestVoxels,
    "local": Local,
    "dense": Dense,
}
FieldName = Literal["auto", "epipolar", "line", "homography", "rectified", "nearest", "local", "dense"]

console = Console(stderr=True, highlight=False)


@dataclass
class Demo:
    """Fuse the sample array of the package; write picture, depth, confidence and a figure, print PSNR and SSIM."""

    out: Path = Path("out/demo")
    """Folder for the results."""
    weights: str = "mono-colour"
    """Name of weights in the package, or a file."""

    def run(self) -> None:
        """Do it."""
        from .demo import ALPHA, BETA, classical, load_sample, report_figure
        from .images import write_text
        from .metrics import score
        from .results import save_frame

        sample = load_sample()
        console.print("classical baseline: semi-global matching, warped colour, guided filter")
        baseline = classical(sample.rig, sample.images, ALPHA, BETA)
        console.print(f"fusion with the weights '{self.weights}'")
        frame = fuse_frame(self.weights, sample.rig, sample.images, alpha=ALPHA)
        written = save_frame(frame, self.out)
        report_figure(sample, baseline, frame, self.out / "demo.png")
        rows = {"alpha alone": sample.images[ALPHA].expand(3, -1, -1), "classical": baseline, "fusion": frame.image}
        scores = {name: score(picture.clamp(0, 1), sample.truth) for name, picture in rows.items()}
        lines = [f"{name:12s} {psnr:6.2f} dB  {ssim:.4f}" for name, (psnr, ssim) in scores.items()]
        table = "\n".join(["                 PSNR    SSIM", *lines, ""])
        print(table, end="")
        write_text(self.out / "demo.md", f"```\n{table}```\n")
        console.print(f"written: {', '.join(map(str, [*written, self.out / 'demo.png']))}")


@dataclass
class Fuse:
    """Fuse one frame: a rig file and a picture of each camera in, one picture at alpha's view out.

    Example: pat fuse --rig rig.yaml --alpha mono --image mono=a.png --image colour=b.png --depth 2 20 --out out/
    """

    rig: Path
    """Rig file: cameras, poses, depth range."""
    alpha: str
    """The camera whose view is wanted."""
    image: UseAppendAction[tuple[str, ...]]
    """NAME=FILE, once for each camera."""
    depth: tuple[float, float] | None = None
    """Near and far bounds in metres, instead of the rig's; far may be inf."""
    out: Path = Path("out")
    """Folder for fused.png, confidence.png, depth.tif and depth.png."""
    weights: str = "mono-colour"
    """Name of weights in the package, or a file."""
    field: FieldName = "auto"
    """Where to look in the other cameras; auto takes what the rig allows."""
    max_memory: str | None = None
    """Working memory allowed, like 4GiB; larger frames are fused in tiles."""
    match_levels: bool = False
    """Bring every beta to alpha's brightness and contrast first (other exposures, filters)."""
    bits: Literal[8, 16] = 8
    """Bits a channel of fused.png."""

    def run(self) -> None:
        """Do it."""
        from .fuse import parse_bytes
        from .images import read_image
        from .results import save_frame

        rig = Rig.load(self.rig)
        files = dict(_name_and_file(text) for text in self.image)
        if len(files) < len(self.image):
            raise ValueError("--image: a camera is given twice; give each camera one picture")
        images = {rig.known(name): read_image(path, name=name) for name, path in files.items()}
        if self.max_memory is not None:
            parse_bytes(self.max_memory)
        frame = fuse_frame(
            self.weights,
            rig,
            images,
            alpha=self.alpha,
            depth=self.depth,
            field=None if self.field == "auto" else FIELDS[self.field](),
            max_memory=self.max_memory,
            match_levels=self.match_levels,
        )
        console.print(f"written: {', '.join(map(str, save_frame(frame, self.out, bits=self.bits)))}")


@dataclass
class Evaluate:
    """Compare alpha alone, the classical baseline and the fusion on stereo pairs: PSNR and SSIM, tables and pictures.

    The left picture made grey is alpha, the right one, reduced, is beta, the left one in colour is the truth.
    Example: pat evaluate --kitti data/kitti --middlebury data/middlebury
    """

    kitti: Path | None = None
    """Folder of KITTI pairs: image_2 / image_3, or left.png / right.png."""
    middlebury: Path | None = None
    """Folder of Middlebury's 2001 to 2006 collections."""
    flickr1024: Path | None = None
    """Folder of Flickr1024 pairs: 0001_L.png / 0001_R.png."""
    folder: Path | None = None
    """Folder of other pairs, with any of these ways of naming."""
    rates: tuple[int, ...] = (2, 4)
    """How many times beta is reduced."""
    out: Path = Path("out/evaluate")
    """Folder for scores.md, scores.csv and, for each data set, a strip of pictures a pair."""
    weights: str = "mono-colour"
    """Name of weights in the package, or a file."""

    def run(self) -> None:
        """Do it."""
        from .evaluate import DATA_SETS, METHODS, evaluate_sets, rectified_fusion, sets_markdown, write_csv
        from .images import write_text
        from .weights import load_weights

        folders = {name: getattr(self, name) for name in DATA_SETS if getattr(self, name) is not None}
        if not folders:
            raise ValueError(f"no pictures: give at least one of --{', --'.join(DATA_SETS)}")
        if not self.rates or min(self.rates) < 1:
            raise ValueError(f"--rates: {' '.join(map(str, self.rates))}: give whole numbers from 1 up")
        methods = {**METHODS, "fusion": rectified_fusion(load_weights(self.weights))}
        rows = evaluate_sets(folders, methods, self.rates, out=self.out)
        write_text(self.out / "scores.md", sets_markdown(rows))
        write_csv(self.out / "scores.csv", [row for found in rows.values() for row in found])
        print(sets_markdown(rows), end="")
        console.print(f"written: {self.out / 'scores.md'}, {self.out / 'scores.csv'}, pictures in {self.out}")


@dataclass
class Showcase:
    """Fuse real pictures: stereo pairs, calibrated pairs that are not rectified, the paper's fast + slow array."""

    data: Path
    """Folder with kitti, middlebury, flickr1024, syntim and hfr_lfr."""
    out: Path = Path("out/showcase")
    """Folder for showcase.md, the figures and the rig files."""
    weights: str = "mono-colour"
    """Name of weights in the package, or a file."""

    def run(self) -> None:
        """Do it."""
        from .showcase import showcase

        print(showcase(self.data, self.out, self.weights), end="")
        console.print(f"written: {self.out / 'showcase.md'}, and its figures and rig files")


@dataclass
class Show:
    """Draw a rig and where some alpha pixels look in the other cameras."""

    rig: Positional[Path]
    """Rig file."""
    alpha: str | None = None
    """The camera to look from; by default the first."""
    image: UseAppendAction[tuple[str, ...]] = ()
    """NAME=FILE: pictures to draw on, if wanted."""
    out: Path = Path("out/show")
    """Folder for rig.png (cameras in space; if calibrated) and fields.png (where some pixels look)."""

    def run(self) -> None:
        """Do it."""
        from arraygeom import Camera
        from arraygeom.viz import draw_fields, draw_rig

        from .images import read_image
        from .results import save_figure

        rig = Rig.load(self.rig)
        alpha = rig.known(self.alpha or rig.names[0])
        files = dict(_name_and_file(text) for text in self.image)
        images = {rig.known(name): read_image(path, name=name) for name, path in files.items()}
        written = []
        if any(isinstance(camera, Camera) for camera in rig.cameras.values()):
            written.append(save_figure(draw_rig(rig, alpha=alpha), self.out / "rig.png"))
        if len(rig.names) > 1:
            fields = draw_fields(rig, alpha, _spread_out(rig[alpha].hw), images=images)
            written.append(save_figure(fields, self.out / "fields.png"))
        console.print(f"written: {', '.join(map(str, written))}")


@dataclass
class Explore:
    """Serve a page on this machine: click a pixel of alpha, see where every other camera looks, and move the rig.

    Example: pat explore rig.yaml --image mono=a.png --image colour=b.png
    """

    rig: Positional[Path]
    """Rig file."""
    image: UseAppendAction[tuple[str, ...]]
    """NAME=FILE, once for each camera."""
    alpha: str | None = None
    """The camera to click in; by default the first with a picture."""
    port: int = 0
    """Port on localhost; 0 takes a free one."""
    browser: bool = True
    """Open the browser."""

    def run(self) -> None:
        """Do it."""
        from .images import read_image

        try:
            from .explore.page import serve
        except ModuleNotFoundError as error:
            raise ValueError(f"the explorer needs {error.name}: pip install 'arraygeom-pat[explore]'") from None
        rig = Rig.load(self.rig)
        files = dict(_name_and_file(text) for text in self.image)
        images = {rig.known(name): read_image(path, name=name) for name, path in files.items()}
        serve(rig, images, alpha=self.alpha, port=self.port, browser=self.browser)


@dataclass(frozen=True)
class Train(TrainConfig):
    """Train weights on scenes made from photographs while training.

    Example: pat train --photos ~/pictures --out runs/mine --minutes 60
    """

    def run(self) -> None:
        """Do it."""
        console.print(f"written: {train(self)}")


@dataclass
class Info:
    """Fields of view, baselines, pixel footprints, and how long segments are for every pair."""

    rig: Positional[Path]
    """Rig file of any format known."""
    depth: tuple[float, float] | None = None
    """Near and far bounds in metres, instead of the rig's."""
    json: bool = False
    """Print JSON instead of tables."""

    def run(self) -> None:
        """Do it."""
        from arraygeom.summary import summarise_cameras, summarise_pairs

        rig = Rig.load(self.rig)
        rig = rig if self.depth is None else rig.replace(depth=self.depth)
        if self.json:
            found: dict[str, list[Any]] = {"cameras": summarise_cameras(rig), "pairs": summarise_pairs(rig)}
            print(dumps({kind: [row._asdict() for row in rows] for kind, rows in found.items()}))
            return
        table = Table("camera", "pixels", "focal px", "view deg", "mm a pixel, near - far", box=None)
        for c in summarise_cameras(rig):
            wh = f"{c.wh[0]}x{c.wh[1]}"
            table.add_row(c.name, wh, _numbers(c.focal), _numbers(c.field_of_view, " x "), _numbers(c.footprint, " - "))
        Console().print(table)
        pairs = Table("alpha > beta", "baseline m", "turn deg", "seen", "segment px, median - most", box=None)
        pairs.add_column("depth step m, near - far")
        for p in summarise_pairs(rig):
            seen = "" if p.seen is None else f"{p.seen:.0%}"
            facts = (
                f"{p.baseline:.4g}",
                f"{p.rotation:.2f}",
                seen,
                _numbers(p.length, " - "),
                _numbers(p.depth_step, " - "),
            )
            pairs.add_row(f"{p.alpha} > {p.beta}", *facts)
        Console().print(pairs)


@dataclass
class Convert:
    """Read a rig file of one format and write it in another."""

    source: Positional[Path]
    """Rig file, or the folder of a format that is one."""
    target: Positional[Path]
    """File or folder to write."""
    read_as: str | None = None
    """Format of the source; by default recognised."""
    write_as: str = "native"
    """Format of the target."""

    def run(self) -> None:
        """Do it."""
        from arraygeom.io import read_rig, write_rig

        rig = read_rig(self.source, format=self.read_as)
        write_rig(rig, self.target, format=self.write_as)
        console.print(f"written: {self.target} ({len(rig.names)} cameras)")


@dataclass
class RigCommand:
    """Look at rig files and convert them."""

    command: OmitSubcommandPrefixes[
        Annotated[Info, tyro.conf.subcommand("info")]
        | Annotated[Convert, tyro.conf.subcommand("convert")]
        | Annotated[Show, tyro.conf.subcommand("show")]
    ]

    def run(self) -> None:
        """Do it."""
        self.command.run()


Command = (
    Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Fuse, tyro.conf.subcommand("fuse")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Showcase, tyro.conf.subcommand("showcase")]
    | Annotated[Show, tyro.conf.subcommand("show")]
    | Annotated[Explore, tyro.conf.subcommand("explore")]
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[RigCommand, tyro.conf.subcommand("rig")]
)


def fuse_frame(weights: str, rig: Rig, images: dict[str, Tensor], **options: Any) -> FusedFrame:
    """`pat.fuse.fuse` with named weights, and a bar on the terminal."""
    from .fuse import fuse
    from .weights import load_weights

    def bar(tiles: Iterable[Tile], total: int) -> Iterable[Tile]:
        return track(tiles, "fusing", total=total, console=console)

    return fuse(load_weights(weights), rig, images, progress=bar, **options)


def _numbers(values: tuple[float, float] | None, between: str = ", ") -> str:
    return "" if values is None else between.join(f"{v:.4g}" for v in values)


def _spread_out(hw: tuple[int, int]) -> Tensor:
    """Twelve pixels (12, 2) spread over a picture."""
    from arraygeom import pixel_grid

    spots = (pixel_grid((3, 4)) + 0.5) / pixel_grid((3, 4)).new_tensor([4, 3])
    return (spots * spots.new_tensor([hw[1], hw[0]])).floor().reshape(-1, 2)


def _name_and_file(text: str) -> tuple[str, Path]:
    name, separator, path = text.partition("=")
    if not (name and separator and path):
        raise ValueError(f"--image: '{text}' is not NAME=FILE, such as mono=a.png")
    return name, Path(path)


def _warn(message: Warning | str, *_: Any, **__: Any) -> None:
    """A warning as one line, without the place in the code that it comes from."""
    console.print(f"pat: warning: {message}", style="yellow", markup=False, soft_wrap=True)


def main(arguments: list[str] | None = None) -> None:
    """Run `pat`. Errors in what was given are one line on standard error, and exit status 2."""
    arguments = sys.argv[1:] if arguments is None else arguments
    debug = "--debug" in arguments
    command = tyro.cli(
        Command,  # type: ignore[arg-type]
        prog="pat",
        description="Fuse the pictures of an array of unlike cameras into one. --debug shows an error's traceback.",
        args=[a for a in arguments if a != "--debug"],
    )
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _warn
            command.run()
    except KeyboardInterrupt:
        console.print("pat: interrupted; no file is left half written", style="red")
        sys.exit(130)
    except (ValueError, OSError) as error:
        if debug:
            raise
        console.print(f"pat: {error}", style="red", markup=False, soft_wrap=True)
        sys.exit(2)
