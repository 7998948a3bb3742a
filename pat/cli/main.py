"""The command line: `pat ...`."""

from __future__ import annotations

import math
import shutil
import sys
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.progress import track
from rich.table import Table
from tyro.conf import OmitSubcommandPrefixes, Positional, UseAppendAction

from arraygeom import Rig
from arraygeom.fields import FIELDS

from ..training.train import TrainConfig

if TYPE_CHECKING:
    from torch import Tensor

    from ..fusion.fuse import Plan, Tile
    from ..fusion.results import Frame

FieldName = Literal["auto", "epipolar", "line", "homography", "rectified", "nearest", "local", "dense", "curved"]

console = Console(stderr=True, highlight=False)


@dataclass
class Demo:
    """Fuse the sample array of the package; write image, depth, confidence and a figure, print PSNR and SSIM."""

    out: Path = Path("out/demo")
    """Folder for the results."""
    weights: str = "mono-colour"
    """Name of weights in the package, or a file."""

    def run(self) -> None:
        """Do it."""
        from arraygeom.atomic import write_text

        from ..data.sample_array import ALPHA, BETA, load_sample
        from ..evaluation.baseline import classical
        from ..evaluation.metrics import score
        from ..fusion.results import save_frame
        from ..systems.demo import save_demo_figure

        sample = load_sample()
        console.print("classical baseline: semi-global matching, warped colour, edge-aware smoothing")
        baseline = classical(sample.rig, sample.images, ALPHA, BETA)
        console.print(f"fusion with the weights '{self.weights}'")
        frame = fuse_frame(self.weights, sample.rig, sample.images, alpha=ALPHA)
        written = save_frame(frame, self.out)
        save_demo_figure(sample, baseline, frame, self.out / "demo.png")
        rows = {"alpha alone": sample.images[ALPHA].expand(3, -1, -1), "classical": baseline, "fusion": frame.image}
        scores = {name: score(image.clamp(0, 1), sample.ground_truth) for name, image in rows.items()}
        lines = [f"{name:12s} {psnr:6.2f} dB  {ssim:.4f}" for name, (psnr, ssim) in scores.items()]
        table = "\n".join(["                 PSNR    SSIM", *lines, ""])
        print(table, end="")
        write_text(self.out / "demo.md", f"```\n{table}```\n")
        console.print(f"written: {', '.join(map(str, [*written, self.out / 'demo.png']))}")


@dataclass
class Fuse:
    """Fuse one frame: a rig file and an image of each camera in, one image at alpha's view out. Or many frames.

    Example: pat fuse --rig rig.yaml --alpha mono --image mono=a.png --image colour=b.png --depth 2 20 --out out/

    With folders, or patterns such as "mono=day1/m_*.png" (quoted), for the images, frames are fused one by one:
    the first of each camera, the second, and so on. With --sequence the cameras have clocks of their own (frame_rate
    and time_offset in the rig): every frame of alpha gets colour from the betas' frames nearest in time.
    """

    rig: Path
    """Rig file: cameras, poses, depth range."""
    alpha: str
    """The camera whose view is wanted."""
    image: UseAppendAction[tuple[str, ...]]
    """NAME=FILE, once for each camera; or NAME=FOLDER, or NAME=PATTERN."""
    depth: tuple[float, float] | None = None
    """Near and far bounds in metres, instead of the rig's; far may be inf."""
    out: Path = Path("out")
    """Folder for fused.png, confidence.png, depth.tif, depth.png and view.yaml (the rig of the fused view)."""
    weights: str = "mono-colour"
    """Name of weights in the package, or a file."""
    field: FieldName = "auto"
    """Where to look in the other cameras; auto takes what the rig allows."""
    max_memory: str | None = None
    """Memory that the process may take in all, like 4GiB; larger frames are fused in tiles."""
    match_levels: bool = False
    """Bring every beta to alpha's brightness and contrast first (other exposures, filters)."""
    bits: Literal[8, 16, 32] = 8
    """Bits a channel of the fused image: 8 or 16 coded as sRGB, or 32 for linear light as floats (tif, exr)."""
    kind: Literal["png", "tif", "exr"] = "png"
    """Format of the fused image."""
    sequence: bool = False
    """Frames in the order of time, the cameras not synchronised; also writes a video."""
    frame_rate: UseAppendAction[tuple[str, ...]] = ()
    """NAME=FRAMES A SECOND, instead of the rig's."""
    time_offset: UseAppendAction[tuple[str, ...]] = ()
    """NAME=SECONDS of the first frame after a common clock, instead of the rig's."""
    speed: float | None = None
    """How fast things move at most, pixels of alpha a second; by default estimated from alpha's frames."""
    video: float = 25.0
    """Frames a second of the video of a sequence; 0 for none."""
    carry: bool = True
    """Carry colour along motion between frames of a sequence; else each is fused by itself, and flickers."""
    resume: bool = False
    """Fuse only the frames that are not in --out; of a single frame, only the tiles that were not finished."""
    on_error: Literal["stop", "skip"] = "stop"
    """What to do when a frame cannot be fused (a corrupt image, a full disk): stop, or report it and go on."""
    workers: int = 1
    """Processes on this machine, for many frames."""
    scheduler: str | None = None
    """Address of a Dask scheduler whose workers fuse the frames, like tcp://host:8786."""
    threads: int | None = None
    """Threads in each process: 1 with several, else all cores."""

    def run(self) -> None:
        """Do it."""
        from ..fusion.batch import find_images
        from ..support.memory import parse_bytes

        if self.bits not in {"png": (8, 16), "tif": (8, 16, 32), "exr": (32,)}[self.kind]:
            raise ValueError(f"--bits {self.bits} --kind {self.kind}: png holds 8 or 16 bits, exr 32, tif any")
        if self.max_memory is not None:
            parse_bytes(self.max_memory)
        rig = self._rig()
        files = dict(_name_and_file(text) for text in self.image)
        if len(files) < len(self.image):
            raise ValueError("--image: a camera is given twice; give each camera one image")
        found = {rig.require(name): find_images(path, name=name) for name, path in files.items()}
        if self.sequence or max(map(len, found.values())) > 1:
            return self._many(rig, found)
        self._one(rig, {name: paths[0] for name, paths in found.items()})

    def _rig(self) -> Rig:
        rig = Rig.load(self.rig)
        rig = rig if self.depth is None else rig.replace(depth=self.depth)
        for text in self.frame_rate:
            name, rate = _name_and_number(text, "frame-rate")
            rig = rig.with_camera(name, rig[name].replace(sensor=replace(rig[name].sensor, frame_rate=rate)))
        for text in self.time_offset:
            name, offset = _name_and_number(text, "time-offset")
            rig = rig.with_camera(name, rig[name].replace(sensor=replace(rig[name].sensor, time_offset=offset)))
        return rig

    def _one(self, rig: Rig, files: dict[str, Path]) -> None:
        from ..fusion.results import save_frame, view_of
        from ..fusion.views import ViewFiles

        images = ViewFiles(rig, files, alpha=rig.require(self.alpha))
        rig = images.developed
        store = self.out / ".tiles"
        if not self.resume:
            shutil.rmtree(store, ignore_errors=True)
        frame = fuse_frame(
            self.weights,
            rig,
            images,
            alpha=self.alpha,
            field=None if self.field == "auto" else FIELDS[self.field](),
            max_memory=self.max_memory,
            match_levels=self.match_levels,
            store=store,
        )
        view = view_of(rig, self.alpha, bits=self.bits, bands=len(frame.image))
        written = save_frame(frame, self.out, bits=self.bits, kind=self.kind, view=view)
        shutil.rmtree(store, ignore_errors=True)
        console.print(f"written: {', '.join(map(str, written))}")

    def _many(self, rig: Rig, files: dict[str, list[Path]]) -> None:
        from ..fusion.batch import Batch
        from ..support.jobs import Workers, cores

        batch = Batch(
            rig,
            files,
            rig.require(self.alpha),
            self.out,
            weights=self.weights,
            sequence=self.sequence,
            speed=self.speed,
            field=None if self.field == "auto" else FIELDS[self.field](),
            match_levels=self.match_levels,
            max_memory=self.max_memory,
            bits=self.bits,
            kind=self.kind,
            alone=not self.carry,
        )
        several = self.workers > 1 or self.scheduler is not None
        report = batch.run(
            workers=Workers(self.workers, self.scheduler, self.threads or (1 if several else cores())),
            resume=self.resume,
            on_error=self.on_error,
            video=self.video if self.sequence and self.video and self.bits != 32 else None,
            console=console,
        )
        console.print(f"{self.out}: {report}")
        if report.failed:
            sys.exit(1)


@dataclass
class Evaluate:
    """Compare alpha alone, the classical baseline and the fusion on stereo pairs: PSNR and SSIM, tables and images.

    The left image made grey is alpha, the right one, reduced, is beta, the left one in colour is the truth.
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
    protocol: Literal["table1", "table2"] = "table1"
    """The paper's: mono + colour (table1), or mono + three bands (table2)."""
    controls: bool = False
    """Also fuse without beta, with another scene's, and with shuffled fields: the fusion must fall."""
    out: Path = Path("out/evaluate")
    """Folder for scores.md, scores.csv and, for each data set, a strip of images a pair."""
    weights: str = "mono-colour"
    """Name of weights in the package, or a file."""

    def run(self) -> None:
        """Do it."""
        from arraygeom.atomic import write_text

        from ..evaluation.protocols import BASELINES, PROTOCOLS, controls, rectified_fusion
        from ..evaluation.stereo import DATA_SETS, StereoRow, evaluate_sets, falls, sets_markdown
        from ..evaluation.tables import write_csv
        from ..networks.weights import load_weights

        folders = {name: getattr(self, name) for name in DATA_SETS if getattr(self, name) is not None}
        if not folders:
            raise ValueError(f"no images: give at least one of --{', --'.join(DATA_SETS)}")
        if not self.rates or min(self.rates) < 1:
            raise ValueError(f"--rates: {' '.join(map(str, self.rates))}: give whole numbers from 1 up")
        network, bands = load_weights(self.weights), PROTOCOLS[self.protocol]
        wrong = controls(network, bands=bands) if self.controls else {}
        methods = {**BASELINES, "fusion": rectified_fusion(network, bands=bands), **wrong}
        rows = evaluate_sets(folders, methods, self.rates, out=self.out)
        every = [row for found in rows.values() for row in found]
        text = sets_markdown(rows, protocol=self.protocol) + ("\n" + falls(every, names=wrong) if wrong else "")
        write_text(self.out / "scores.md", text)
        write_csv(self.out / "scores.csv", StereoRow._fields, every)
        print(text, end="")
        console.print(f"written: {self.out / 'scores.md'}, {self.out / 'scores.csv'}, images in {self.out}")


@dataclass
class Ablate:
    """What knowing the rig is worth: the same weights on the same scenes with every family of receptive fields.

    Scenes are layered photographs seen by unrectified rigs, alpha's focal length 1 to 3 times beta's.
    Example: pat ablate --scenes 12 --out out/ablate
    """

    weights: str = "mono-colour"
    """Name of weights in the package, or a file."""
    photos: tuple[Path, ...] = ()
    """Folders of photographs; those that scikit-image ships if none is given."""
    rendered: Path | None = None
    """Folder with scenes that `pat render` made, instead: their first camera is alpha, their second beta."""
    scenes: int = 12
    """How many scenes."""
    hw: tuple[int, int] = (240, 320)
    """Height and width of both images."""
    seed: int = 0
    """Of the scenes."""
    out: Path = Path("out/ablate")
    """Folder for ablation.md, ablation.csv and ablation.png."""

    def run(self) -> None:
        """Do it."""
        from ..evaluation.ablation import ablate, layered_cases, rendered_cases
        from ..networks.weights import load_weights

        if self.scenes < 1:
            raise ValueError(f"--scenes: {self.scenes}: give at least 1")
        if self.rendered is not None:
            cases = rendered_cases(self.rendered, seed=self.seed)
        else:
            cases = layered_cases(self.scenes, photos=self.photos, hw=self.hw, seed=self.seed)
        ablate(load_weights(self.weights), cases, out=self.out)
        print((self.out / "ablation.md").read_text(encoding="utf-8"), end="")
        console.print(f"written: {self.out / 'ablation.md'}, ablation.csv and ablation.png beside it")


@dataclass
class Showcase:
    """Fuse real images: stereo pairs, calibrated pairs that are not rectified, the paper's fast + slow array."""

    data: Path
    """Folder with kitti, middlebury, flickr1024, syntim and hfr_lfr."""
    out: Path = Path("out/showcase")
    """Folder for showcase.md, the figures and the rig files."""
    weights: str = "mono-colour"
    """Name of weights in the package, or a file."""

    def run(self) -> None:
        """Do it."""
        from ..systems.showcase import showcase

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
    """NAME=FILE: images to draw on, if wanted."""
    out: Path = Path("out/show")
    """Folder for rig.png (cameras in space; if calibrated) and fields.png (where some pixels look)."""

    def run(self) -> None:
        """Do it."""
        from arraygeom import Camera
        from arraygeom.viz import draw_fields, draw_rig

        from ..media.figures import save_figure
        from ..media.images import read_image

        rig = Rig.load(self.rig)
        alpha = rig.require(self.alpha or rig.names[0])
        files = dict(_name_and_file(text) for text in self.image)
        images = {rig.require(name): read_image(path, name=name) for name, path in files.items()}
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
    """The camera to click in; by default the first with an image."""
    port: int = 0
    """Port on localhost; 0 takes a free one."""
    browser: bool = True
    """Open the browser."""

    def run(self) -> None:
        """Do it."""
        from ..media.images import read_image

        try:
            from ..explore.page import serve
        except ModuleNotFoundError as error:
            raise ValueError(f"the explorer needs {error.name}: pip install 'arraygeom-pat[explore]'") from None
        rig = Rig.load(self.rig)
        files = dict(_name_and_file(text) for text in self.image)
        images = {rig.require(name): read_image(path, name=name) for name, path in files.items()}
        serve(rig, images, alpha=self.alpha, port=self.port, browser=self.browser)


@dataclass
class Train:
    """Train weights by a recipe, on scenes made from photographs while training; see `pat train --help`.

    Example: pat train mono-colour-small --photos ~/images --out runs/mine --minutes 60
    """

    config: TrainConfig

    def run(self) -> None:
        """Do it."""
        from ..training.train import train

        console.print(f"written: {train(self.config)}")


@dataclass
class Calibrate:
    """Photographs of a board in, a rig out, with a report of how good it is.

    A folder for each camera, or file names like left01.jpg, right01.jpg; images of one moment have the same number.
    Example: pat calibrate photos/ --board charuco:8x6:30mm -o rig.yaml
    """

    photos: Positional[Path]
    """Folder with the images (or videos) of all cameras."""
    board: str
    """charuco:8x6:30mm (squares), chessboard:9x6:25mm (inner corners), circles:7x5:20mm or acircles:4x11:20mm."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("rig.yaml")
    """The rig file; its report (.html) and covariance (.covariance.json) go beside it."""
    camera: UseAppendAction[tuple[str, ...]] = ()
    """NAME=PATTERN, once for each camera, such as left='left*.jpg', where folders and names do not tell."""
    lens: Literal["brown-conrady", "kannala-brandt", "none"] = "brown-conrady"
    """Model of the lenses; kannala-brandt for fisheyes."""
    depth: tuple[float, float] | None = None
    """Near and far bounds in metres of what the rig will look at, written into the rig."""

    def run(self) -> None:
        """Do it."""
        from calib.boards.run import calibrate_photos

        def bar(items: Iterable[Any], total: int) -> Iterable[Any]:
            return track(items, "looking for the board", total=total, console=console)

        patterns = dict(_name_and_file(text, "--camera") for text in self.camera)
        said = calibrate_photos(
            self.photos,
            self.board,
            self.out,
            patterns={name: str(pattern) for name, pattern in patterns.items()},
            lens=self.lens,
            depth=self.depth,
            progress=bar,
        )
        print("\n".join(said.messages))
        console.print(f"written: {', '.join(map(str, said.written))}")


@dataclass
class Board:
    """Make a calibration board to print, at its true size. Example: pat board charuco:8x6:30mm -o board.pdf"""

    board: Positional[str]
    """charuco:8x6:30mm (squares), chessboard:9x6:25mm (inner corners), circles:7x5:20mm or acircles:4x11:20mm."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("board.pdf")
    """File to write, ending in .pdf or .svg."""

    def run(self) -> None:
        """Do it."""
        from calib.boards.run import write_board

        console.print(f"written: {write_board(self.board, self.out)}")


@dataclass
class Render:
    """Render many scenes of a rig for training: workers, retries, resuming, clusters.

    Example: pat render config.yaml --scenes 900 --out data/ --workers 2. The same command again makes what is
    missing. The file has at least `rig: rig.yaml`; see `pat.farm.job.RenderConfig`.
    """

    config: Positional[Path]
    """What to render (YAML): rig, seed, backend and its settings."""
    scenes: int
    """How many scenes there should be in the end."""
    out: Path
    """Folder of the scenes."""
    workers: int = 1
    """Processes on this machine; with --scheduler local, of that cluster."""
    shard: str = "1/1"
    """i/n: only every n-th scene from the i-th on, for batch systems."""
    scheduler: str | None = None
    """Address of a Dask scheduler (tcp://...), or "local"."""

    def run(self) -> None:
        """Do it."""
        from ..farm.folders import Shard
        from ..farm.job import RenderConfig
        from ..farm.run import render
        from ..farm.workshop import Stopped

        config, shard = RenderConfig.load(self.config), Shard.parse(self.shard)
        options: dict[str, Any] = {"workers": self.workers, "shard": shard, "scheduler": self.scheduler}
        try:
            summary = render(config, scenes=self.scenes, out=self.out, console=console, **options)
        except Stopped as error:
            raise ValueError(str(error)) from None
        console.print(f"{self.out}: {summary}", soft_wrap=True)
        if not summary.complete:
            sys.exit(1)


@dataclass
class DataShow:
    """Draw samples of rendered scenes: recorded images, where some pixels look, truth and depth."""

    folder: Positional[Path]
    """Folder that `pat render` made."""
    out: Path = Path("out/data.png")
    """Image to write."""
    samples: int = 6
    """How many patches."""
    alpha: str | None = None
    """The camera that is fused for; by default the first."""
    sensors: Path | None = None
    """File (YAML) with a list of steps for each camera, instead of what their responses say."""
    seed: int = 0
    """Of the choice of patches, and of noise."""

    def run(self) -> None:
        """Do it."""
        import torch

        from ..data import ScenePatches
        from ..data.show import draw_patches
        from ..media.figures import save_figure
        from ..sensors import generator_for, read_chains
        from ..support.schema import read_yaml

        if self.samples < 1:
            raise ValueError(f"--samples: {self.samples}: give a whole number from 1 up")
        chains = None if self.sensors is None else read_chains(read_yaml(self.sensors), str(self.sensors))
        data = ScenePatches(self.folder, alpha=self.alpha, chains=chains, seed=self.seed)
        chosen = torch.randperm(len(data), generator=generator_for(self.seed, "show"))[: self.samples]
        save_figure(draw_patches([data[i] for i in chosen.tolist()]), self.out)
        console.print(f"written: {self.out} ({len(data)} patches of {len(data.scenes)} scenes in {self.folder})")


@dataclass
class DataInfo:
    """What a folder of rendered scenes holds: sizes, seeds refused, scenes given up and why."""

    folder: Positional[Path]
    """Folder that `pat render` made."""

    def run(self) -> None:
        """Do it."""
        from ..farm.summary import summarise

        Console().print(summarise(self.folder), highlight=False, soft_wrap=True)


@dataclass
class DataCommand:
    """Look at rendered scenes."""

    command: OmitSubcommandPrefixes[
        Annotated[DataShow, tyro.conf.subcommand("show")] | Annotated[DataInfo, tyro.conf.subcommand("info")]
    ]

    def run(self) -> None:
        """Do it."""
        self.command.run()


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
class Doctor:
    """Find the usual mistakes in a rig, by features matched between one image of each camera.

    Half-pixel and one-pixel shifts, R transposed, pose inverted, units, cameras swapped, images resized, cropped,
    turned or mirrored without the rig, x and y exchanged, distortion ignored, applied twice or with the wrong sign.
    Example: pat rig doctor rig.yaml --image mono=a.png --image colour=b.png --fix better.yaml
    """

    rig: Positional[Path]
    """Rig file of any format known."""
    image: UseAppendAction[tuple[str, ...]]
    """NAME=FILE, once for each of two or more cameras."""
    fix: Path | None = None
    """Write the repaired rig there, if a mistake is named."""
    json: bool = False
    """Print JSON instead of text."""

    def run(self) -> None:
        """Do it."""
        from calib.images.doctor import diagnose

        rig = Rig.load(self.rig)
        found = diagnose(rig, named_images(rig, self.image))
        print(found.as_json() if self.json else found.as_text())
        if self.fix is not None and found.named.kind != "nothing":
            found.repaired.save(self.fix)
            console.print(f"written: {self.fix} ({found.named.words}: undone)")
        elif self.fix is not None:
            console.print("no rig written: no mistake was named")


@dataclass
class Refine:
    """Improve a rig by ordinary images of its cameras: points matched between them, then the fusion's own error.

    Points that were held out decide: no rig is written unless they come nearer to their lines.
    Example: pat rig refine rig.yaml --image mono=a.png --image colour=b.png --out better.yaml
    """

    rig: Positional[Path]
    """Rig file of any format known."""
    image: UseAppendAction[tuple[str, ...]]
    """NAME=FILE, once for each camera and frame: the first files of all cameras are one frame, and so on."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Rig file to write."""
    free: tuple[str, ...] = ("rotation", "centre")
    """What may change: rotation, translation, focal, centre (principal_point), distortion; or CAMERA.rotation. Unless
    it is said, translation too where held-out points come nearer so."""
    sigma: tuple[str, ...] = ()
    """KIND=NUMBER: what it is known to, one standard deviation: degrees, pixels; for translation and focal, a part."""
    photometric: bool = True
    """Let the fusion's own error have its say after the points."""

    def run(self) -> None:
        """Do it."""
        from calib.images.refinement import refine

        from ..attention import attend_with_statistics

        rig = Rig.load(self.rig)
        found = refine(
            rig,
            frames_of(rig, self.image),
            free=[kind for text in self.free for kind in text.split(",")],
            sigma=_deviations(self.sigma),
            attend=attend_with_statistics if self.photometric else None,
        )
        print(found.as_text())
        if found.accepted:
            found.rig.save(self.out)
            console.print(f"written: {self.out}")
        else:
            console.print("no rig written")


@dataclass
class Start:
    """Make a rig from images alone: fundamental matrices and rough maps, good enough to fuse with.

    Example: pat rig start --image mono=a.png --image colour=b.png --focal mono=800 --out rig.yaml
    """

    image: UseAppendAction[tuple[str, ...]]
    """NAME=FILE, once for each camera."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Rig file to write."""
    focal: UseAppendAction[tuple[str, ...]] = ()
    """NAME=PIXELS: rough focal lengths, if known; used where they help."""

    def run(self) -> None:
        """Do it."""
        from calib.images.from_images import rig_from_images

        from ..media.images import read_image

        files = _files_by_name(self.image)
        images = {name: read_image(path, name=name) for name, path in files.items()}
        found = rig_from_images(images, focal=_numbers_by_name("--focal", self.focal))
        print(found.as_text())
        found.rig.save(self.out)
        console.print(f"written: {self.out}")


@dataclass
class RigCommand:
    """Look at rig files, convert them, find what is wrong with them and make them better."""

    command: OmitSubcommandPrefixes[
        Annotated[Info, tyro.conf.subcommand("info")]
        | Annotated[Convert, tyro.conf.subcommand("convert")]
        | Annotated[Show, tyro.conf.subcommand("show")]
        | Annotated[Doctor, tyro.conf.subcommand("doctor")]
        | Annotated[Refine, tyro.conf.subcommand("refine")]
        | Annotated[Start, tyro.conf.subcommand("start")]
    ]

    def run(self) -> None:
        """Do it."""
        self.command.run()


@dataclass
class SystemsList:
    """The paper's four arrays."""

    def run(self) -> None:
        """Do it."""
        from ..systems import NAMES, load_system

        for name in NAMES:
            print(f"{name:12s} {load_system(name).title}")


@dataclass
class SystemsRun:
    """Render a scene for an array, record it, fuse it, compare with the truth: PSNR, SSIM and images.

    Example: pat systems run fast-slow --out out/fast-slow
    """

    name: Positional[str]
    """One of those that `pat systems list` names."""
    full: bool = False
    """At the full size of the paper's cameras; by default reduced, minutes on two cores."""
    photos: Path | None = None
    """Folder of photographs for the scene's surfaces; by default patterns and images that scikit-image ships."""
    recording: Path | None = None
    """For fast-slow: the paper's own frames in place of a rendered scene, a folder with pillow_1 and the matrices."""
    out: Path | None = None
    """Folder for the results; by default out/systems/NAME."""
    weights: str = "mono-colour"
    """Name of weights in the package, or a file."""
    max_memory: str | None = None
    """Memory that fusing may take in all, like 4GiB; a single frame is then fused in a process of its own, measured."""

    def run(self) -> None:
        """Do it."""
        from ..systems import load_system, run_system

        out = self.out or Path("out/systems") / self.name
        if self.recording is not None:
            return self._recorded(self.recording, out)
        result = run_system(
            self.name,
            out,
            full=self.full,
            photos=self.photos,
            weights=self.weights,
            max_memory=self.max_memory,
            say=lambda text: console.print(text, soft_wrap=True),
        )
        print(result.table, end="")
        if not self.full and load_system(self.name).expected:
            console.print(f"\nexpected:\n{load_system(self.name).expected}", markup=False)
        console.print(f"written: {', '.join(map(str, result.written))}", soft_wrap=True)

    def _recorded(self, recording: Path, out: Path) -> None:
        from ..systems.fast_slow.recorded import run_recorded

        if self.name != "fast-slow":
            raise ValueError(f"--recording is of fast-slow, not of '{self.name}'")
        result = run_recorded(recording, out, weights=self.weights, say=lambda t: console.print(t, soft_wrap=True))
        print(result.table, end="")
        console.print(f"written: {', '.join(map(str, result.written))}", soft_wrap=True)


@dataclass
class Systems:
    """The paper's four arrays, each from a rendered scene to figures."""

    command: OmitSubcommandPrefixes[
        Annotated[SystemsList, tyro.conf.subcommand("list")] | Annotated[SystemsRun, tyro.conf.subcommand("run")]
    ]

    def run(self) -> None:
        """Do it."""
        self.command.run()


Command = (
    Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Fuse, tyro.conf.subcommand("fuse")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Ablate, tyro.conf.subcommand("ablate")]
    | Annotated[Showcase, tyro.conf.subcommand("showcase")]
    | Annotated[Show, tyro.conf.subcommand("show")]
    | Annotated[Systems, tyro.conf.subcommand("systems")]
    | Annotated[Explore, tyro.conf.subcommand("explore")]
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Render, tyro.conf.subcommand("render")]
    | Annotated[Calibrate, tyro.conf.subcommand("calibrate")]
    | Annotated[Board, tyro.conf.subcommand("board")]
    | Annotated[DataCommand, tyro.conf.subcommand("data")]
    | Annotated[RigCommand, tyro.conf.subcommand("rig")]
)


def fuse_frame(weights: str, rig: Rig, images: Mapping[str, Tensor], **options: Any) -> Frame:
    """`pat.fusion.fuse.fuse` with named weights, and a bar on the terminal."""
    from ..fusion.fuse import fuse
    from ..networks.weights import load_weights

    def bar(tiles: Iterable[Tile], total: int) -> Iterable[Tile]:
        return track(tiles, "fusing", total=total, console=console)

    def tell(planned: Plan) -> None:
        console.print(f"plan: {planned}")

    return fuse(load_weights(weights), rig, images, progress=bar, announce=tell, **options)


def _numbers(values: tuple[float, float] | None, between: str = ", ") -> str:
    return "" if values is None else between.join(f"{v:.4g}" for v in values)


def _spread_out(hw: tuple[int, int]) -> Tensor:
    """Twelve pixels (12, 2) spread over an image."""
    from arraygeom import pixel_grid

    spots = (pixel_grid((3, 4)) + 0.5) / pixel_grid((3, 4)).new_tensor([4, 3])
    return (spots * spots.new_tensor([hw[1], hw[0]])).floor().reshape(-1, 2)


def named_images(rig: Rig, texts: Iterable[str]) -> dict[str, Tensor]:
    """The images of `--image NAME=FILE`, by camera. Raises ValueError for a camera given twice, or not of the rig."""
    from ..media.images import read_image

    return {rig.require(name): read_image(path, name=name) for name, path in _files_by_name(texts).items()}


def frames_of(rig: Rig, texts: Iterable[str]) -> list[dict[str, Tensor]]:
    """The images of `--image NAME=FILE`, a camera's first in the first frame, its second in the second, and so on.

    Raises ValueError for cameras with unlike numbers of images.
    """
    from ..media.images import read_image

    files: dict[str, list[Path]] = {}
    for name, path in map(_name_and_file, texts):
        files.setdefault(rig.require(name), []).append(path)
    counts = {name: len(paths) for name, paths in files.items()}
    if len(set(counts.values())) > 1:
        spoken = ", ".join(f"'{name}' {count}" for name, count in counts.items())
        raise ValueError(f"--image: every camera needs an image of every frame; given are {spoken}")
    frames = zip(*files.values())
    return [{n: read_image(path, name=n) for n, path in zip(files, frame)} for frame in frames]


def _files_by_name(texts: Iterable[str]) -> dict[str, Path]:
    pairs = [_name_and_file(text) for text in texts]
    if len(dict(pairs)) < len(pairs):
        raise ValueError("--image: a camera is given twice; give each camera one image")
    return dict(pairs)


def _deviations(texts: Iterable[str]) -> dict[str, float]:
    """Standard deviations by kind; rotations in degrees are turned into radians."""
    found = _numbers_by_name("--sigma", texts)
    return {kind: math.radians(value) if kind == "rotation" else value for kind, value in found.items()}


def _numbers_by_name(option: str, texts: Iterable[str]) -> dict[str, float]:
    found = {}
    for text in texts:
        name, _, number = text.partition("=")
        try:
            found[name] = float(number)
        except ValueError:
            raise ValueError(f"{option}: '{text}' is not NAME=NUMBER") from None
    return found


def _name_and_file(text: str, option: str = "--image") -> tuple[str, Path]:
    name, separator, path = text.partition("=")
    if not (name and separator and path):
        raise ValueError(f"{option}: '{text}' is not NAME=FILE, such as mono=a.png")
    return name, Path(path)


def _command(arguments: list[str]) -> Any:
    if arguments[:1] == ["train"]:
        from ..training.config import command_line

        return Train(command_line(arguments[1:]))
    return tyro.cli(
        Command,  # type: ignore[arg-type]
        prog="pat",
        description="Fuse the images of an array of unlike cameras into one. --debug shows an error's traceback.",
        args=arguments,
    )


def _name_and_number(text: str, option: str) -> tuple[str, float]:
    name, _, number = text.partition("=")
    try:
        return name, float(number)
    except ValueError:
        raise ValueError(f"--{option}: '{text}' is not NAME=NUMBER, such as mono=30") from None


def _warn(message: Warning | str, *_: Any, **__: Any) -> None:
    """A warning as one line, without the place in the code that it comes from."""
    console.print(f"pat: warning: {message}", style="yellow", markup=False, soft_wrap=True)


def main(arguments: list[str] | None = None) -> None:
    """Run `pat`. Errors in what was given are one line on standard error, and exit status 2."""
    arguments = sys.argv[1:] if arguments is None else arguments
    debug = "--debug" in arguments
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _warn
            _command([a for a in arguments if a != "--debug"]).run()
    except KeyboardInterrupt:
        console.print("pat: interrupted; no file is left half written", style="red")
        sys.exit(130)
    except (ValueError, OSError, FloatingPointError) as error:
        if debug:
            raise
        console.print(f"pat: {error}", style="red", markup=False, soft_wrap=True)
        sys.exit(2)
