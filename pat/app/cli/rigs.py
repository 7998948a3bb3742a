"""`pat show`, `pat explore` and `pat rig ...`: draw, inspect, convert, check and refine rig files."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from . import options
from .known import MatchesFile
from .options import Depth, FieldName, Images, MaybeOut, Name, Numbers, Out, RigFile, say
from .parser import Option

if TYPE_CHECKING:
    from torch import Tensor

    from arraygeom import Rig
    from arraygeom.summary import CameraSummary, PairSummary
    from calib.images.matches import Pairs
    from calib.images.refined import Refinement


@dataclass
class Show:
    """Draw a rig, search segments of some alpha pixels, and how far matched points lie from their lines."""

    rig: RigFile
    alpha: Name = None
    """The camera whose pixels are chosen; by default the first."""
    image: Images = ()
    """Images to draw on, if wanted; with two or more, points are matched in them."""
    out: Out = Path("out/show")
    """Folder for rig.png (cameras in space; if calibrated), fields.png (search segments of some pixels) and,
    with images, matches.png (patches around matched points, and how far they lie from their lines)."""

    def run(self) -> None:
        """Write the drawings, and warn of a rig that does not fit the images.

        Raises:
            ValueError: for a rig or images that cannot be used, and an unknown alpha.
            FileExistsError: for files in the way that no run wrote.
            FileNotFoundError: for a missing file.
            OSError: if files cannot be written.
        """
        from arraygeom import Camera
        from arraygeom.runtime.together import refuse_others, write_together
        from arraygeom.viz import draw_fields, draw_matches, draw_rig

        from ...media.figures import save_figure

        options.writable(self.out, folder=True)
        refuse_others(self.out, ["rig.png", "fields.png", "matches.png"], group="show")
        rig = options.load_rig(self.rig)
        alpha = rig.require(self.alpha or rig.names[0])
        images = options.read_images(rig, self.image)
        warn_of_misfit(rig, images)
        figures = {}
        if any(isinstance(camera, Camera) for camera in rig.cameras.values()):
            figures["rig.png"] = draw_rig(rig, alpha=alpha)
        if len(rig.names) > 1:
            figures["fields.png"] = draw_fields(rig, alpha, _twelve_pixels(rig[alpha].hw), images=images)
        with options.working("matching points of the images"):
            points = matched_points(rig, alpha, images)
        if points:
            figures["matches.png"] = draw_matches(rig, alpha, points, images)
        with write_together(self.out, group="show", last="rig.png") as folder:
            for name, figure in figures.items():
                save_figure(figure, folder / name)
        say(f"written: {', '.join(str(self.out / name) for name in figures)}")


def warn_of_misfit(rig: Rig, images: Mapping[str, Tensor]) -> None:
    """Print a warning if a rig fits its images badly."""
    from calib.images.rig_check import misfit_warning

    if (warning := misfit_warning(rig, images)) is not None:
        say(f"pat: {warning}", style="yellow")


def matched_points(rig: Rig, alpha: str, images: Mapping[str, Tensor]) -> dict[str, tuple[Tensor, Tensor]]:
    """Match points between alpha's image (c, h, w), 0..1, and each beta's.

    Returns:
        Points (n, 2) of alpha and of the beta, pixels, by beta. Betas without an image, with one that cannot
        be matched, or that the rig does not relate to alpha, are left out; all without an image of alpha.
    """
    from calib.images.matches import match_cameras
    from calib.images.residuals import related

    points: dict[str, tuple[Tensor, Tensor]] = {}
    for name in rig.betas(alpha) if alpha in images else ():
        if name in images:
            with suppress(ValueError):
                pair = related(rig, match_cameras({alpha: images[alpha], name: images[name]}))
                points[name] = pair[alpha, name].alpha, pair[alpha, name].beta
    return points


def given_matches(path: Path | None, texts: Sequence[str], images: Mapping[str, Tensor]) -> Pairs | None:
    """Read the matches of a file between the cameras' images of `--image NAME=FILE`.

    Args:
        path: file of matched points; None for none.
        texts: values NAME=FILE of --image.
        images: images (c, h, w) of the same cameras, whose sizes points must fit.

    Returns:
        Matches by pair of names; None without a file.

    Raises:
        ValueError: for a file that does not suit the images, and as `files_by_name`.
        FileNotFoundError: for a missing file.
    """
    if path is None:
        return None
    from calib.images.matches import PointMatches

    from ..point_matches import read_matches

    files = options.files_by_name(texts)
    sizes = {name: (image.shape[1], image.shape[2]) for name, image in images.items()}
    return {names: PointMatches(*points) for names, points in read_matches(path, files, sizes).items()}


def _twelve_pixels(hw: tuple[int, int]) -> Tensor:
    """Pixels (12, 2) spread over an image."""
    from arraygeom import pixel_grid

    grid = (pixel_grid((3, 4)) + 0.5) / pixel_grid((3, 4)).new_tensor([4, 3])
    return (grid * grid.new_tensor([hw[1], hw[0]])).floor().reshape(-1, 2)


@dataclass
class Explore:
    """Explore receptive fields in the browser: point at a pixel of alpha, see its segments, move the rig.

    Example: pat explore rig.yaml --image mono=a.png --image colour=b.png
    """

    rig: RigFile
    image: Images = ()
    """An image of each camera, once each; without any a checkered room is shown."""
    alpha: Name = None
    """The camera to point in; by default the first with an image."""
    field: FieldName = "auto"
    network: Annotated[str | None, Option("NAME|FILE")] = None
    """A network of the paper whose attention to show, as pat-supervised; else correlations of windows."""
    save: Annotated[Path | None, Option("FILE.html")] = None
    """Write a page of one file that needs no server, and end."""
    port: int = 0
    """Port on localhost; 0 takes a free one."""
    browser: bool = True
    """Print the address of the page, and open no browser."""

    def run(self) -> None:
        """Serve the explorer until Ctrl+C, or save its page.

        Raises:
            ValueError: for a rig, images, a covariance beside the rig or options that it cannot use.
            FileNotFoundError: for a missing file.
            OSError: if the page cannot be written.
        """
        from ..explore import opened, serve

        if self.save is not None:
            options.writable(self.save, option="--save")
        rig = options.load_rig(self.rig)
        images = options.read_images(rig, self.image) if self.image else None
        if images:
            warn_of_misfit(rig, images)
        options.field_named(self.field)
        covariance = None
        if (beside := self.rig.with_suffix(".covariance.json")).is_file():
            from calib.boards.uncertainty import RigCovariance  # imports matplotlib

            covariance = RigCovariance.load(beside, rig)
        files = {"": self.rig, **options.files_by_name(self.image)}
        explorer = opened(
            rig,
            images,
            alpha=self.alpha,
            network=self.network,
            field=self.field,
            covariance=covariance,
            files={name: str(file) for name, file in files.items()},
        )
        if explorer.error:
            raise ValueError(explorer.error)
        if self.save is None:
            serve(explorer, port=self.port, browser=self.browser)
        else:
            explorer.save(self.save)
            say(f"written: {self.save}")


MOST_CAMERAS = 12
"""Number of cameras up to which `pat rig info` describes every pair."""
MOST_ROWS = 100
"""Number of cameras in its tables."""


@dataclass
class Info:
    """Print fields of view, baselines, pixel footprints, and how long segments are for every pair."""

    rig: RigFile
    depth: Depth = None
    """Near and far bounds in metres, instead of the rig's."""
    alpha: Name = None
    """Only pairs with this alpha, the 50 nearest; by default all, and of over 12 cameras the first's."""
    json: bool = False
    """Print JSON instead of tables."""

    def run(self) -> None:
        """Print what is odd about the rig, and a line for each camera and pair (of large rigs some), or JSON.

        Raises:
            ValueError: for a file that is no rig, invalid bounds, and an unknown alpha.
            FileNotFoundError: for a missing file.
        """
        from arraygeom.io import ANY_SCALE, recognise
        from arraygeom.runtime.text import length_unit
        from arraygeom.summary import summarise_cameras, summarise_pairs

        rig = options.load_rig(self.rig, self.depth)
        if rig.name:
            say(rig.name)
        warn_of_oddities(rig)
        unit = length_unit(rig)
        if (kind := recognise(self.rig)) in ANY_SCALE:
            unit = "units"
            say(f"lengths are in units of the file: {kind} files state none, and seldom are in metres")
        alpha = None if self.alpha is None else rig.require(self.alpha)
        if alpha is None and len(rig.names) > MOST_CAMERAS:
            alpha, count = rig.names[0], len(rig.names)
            say(f"pairs with alpha '{alpha}' and its nearest cameras, of {count}: --alpha NAME for others")
        cameras = summarise_cameras(rig, None if self.json else MOST_ROWS)
        pairs = summarise_pairs(rig, alpha)
        if self.json:
            document = {"cameras": [c._asdict() for c in cameras], "pairs": [p._asdict() for p in pairs]}
            return options.print_json(document)
        if len(rig.names) > MOST_ROWS:
            say(f"the first {MOST_ROWS} of {len(rig.names)} cameras: --json has all")
        print_tables(cameras, pairs, unit)


def warn_of_oddities(rig: Rig) -> None:
    """Print what is odd about a rig, except for what reading its file has warned of."""
    from arraygeom.rig_check import file_oddities

    warned = tuple(file_oddities(rig))
    for oddity in rig.check():
        if not oddity.endswith(warned):
            say(f"pat: {oddity}", style="yellow")


def print_tables(cameras: Sequence[CameraSummary], pairs: Sequence[PairSummary], unit: str) -> None:
    """Print two tables of cameras (views and lenses) and, if there are any, one of pairs, on standard output.

    `unit` is the unit of lengths; footprints of pixels are in thousandths of it, mm for "m".
    """
    from rich.console import Console
    from rich.table import Table

    fine, baseline = ("mm", "baseline m") if unit == "m" else (f"{unit}/1000", "baseline")
    of_cameras = Table("camera", "pixels", "focal px", "view deg", f"{fine} a pixel, near - far", box=None)
    of_lenses = Table("camera", "lens", "covers", "coefficients", box=None)
    for c in cameras:
        further = _two(c.focal), _two(c.field_of_view, " x "), _two(c.footprint, " - ")
        numbers = " ".join(f"{number:.4g}" for number in c.coefficients)
        of_lenses.add_row(c.name, c.lens or "none", f"{100 * c.covered:.0f} %", numbers)
        of_cameras.add_row(c.name, f"{c.wh[0]}x{c.wh[1]}", *further)
    lengths = "segment px, median - longest", f"depth step {unit}, near - far"
    of_pairs = Table("alpha > beta", baseline, "rotation deg", "seen", *lengths, box=None)
    for p in pairs:
        share = "" if p.seen is None else f"{p.seen:.0%}"
        further = share, _two(p.length, " - "), _two(p.depth_step, " - ")
        of_pairs.add_row(f"{p.alpha} > {p.beta}", f"{p.baseline:.4g}", f"{p.rotation:.2f}", *further)
    for table in (of_cameras, of_lenses, of_pairs)[: 2 + bool(pairs)]:
        Console(markup=False, emoji=False).print(table)


def _two(values: tuple[float, float] | None, between: str = ", ") -> str:
    return "" if values is None else between.join(f"{v:.4g}" for v in values)


@dataclass
class Convert:
    """Convert a rig file from one format to another."""

    source: Annotated[Path, Option("RIG", positional=True)]
    """Rig file, or folder where the format is one; also: --rig RIG."""
    target: Annotated[Path, Option("OUT", positional=True)]
    """File or folder to write."""
    read_as: Annotated[str | None, Option("FORMAT")] = None
    """Format of the source; by default recognised."""
    size: Annotated[tuple[int, int] | None, Option("W H")] = None
    """Size of the images, pixels: for files that state none, or several."""
    lens: Annotated[str | None, Option("MODEL")] = None
    """Lens model of the coefficients, as brown-conrady or kannala-brandt: for files that do not say."""
    refit: bool = False
    """Replace a lens whose model ends within the image by a fitted brown-conrady lens (k1 k2 p1 p2 k3)."""
    write_as: Annotated[str, Option("FORMAT")] = "native"
    """Format of the target."""

    def run(self) -> None:
        """Read the rig, fit its lenses anew if asked, and write it.

        Raises:
            FileNotFoundError: for a missing file.
            ValueError: for a damaged file, an unknown format or lens, a size that it contradicts or that is
                below 1, and a rig that the target format cannot hold.
            FileExistsError: for files in a target folder that no run wrote.
            OSError: if it cannot be written.
        """
        from arraygeom.io import read_rig, write_rig

        from ..lens_refit import refit_rig

        hw = None if self.size is None else (self.size[1], self.size[0])
        if hw is not None and min(hw) < 1:
            raise ValueError(f"--size: wanted width and height in pixels, got {hw[1]} {hw[0]}")
        rig = read_rig(self.source, format=self.read_as, hw=hw, lens=self.lens)
        if hw is not None and all(view.hw != hw for view in rig.cameras.values()):
            h, w = rig[rig.names[0]].hw
            raise ValueError(f"--size: the file states {w}x{h} for '{rig.names[0]}': leave it out")
        if self.refit:
            rig, said = refit_rig(rig)
            for sentence in said or ["no lens ends within its image: none is fitted anew"]:
                say(sentence)
        write_rig(rig, self.target, format=self.write_as)
        say(f"written: {self.target} ({len(rig.names)} cameras)")


@dataclass
class Doctor:
    """Find the usual mistakes in a rig, by features matched between one image of each camera.

    Half-pixel and one-pixel shifts, R transposed, pose inverted, the centre given as t, t in the other frame,
    OpenGL axes, left-handed systems, order of angles and quaternions, radians taken for degrees, units,
    cameras swapped, images resized, zoomed, cropped, rotated or mirrored without the rig, x and y exchanged,
    distortion ignored, applied twice or with the wrong sign.

    Example: pat rig doctor rig.yaml --image mono=a.png --image colour=b.png --out better.yaml
    """

    rig: RigFile
    image: Images
    """An image of each of two or more cameras."""
    matches: MatchesFile = None
    out: MaybeOut = None
    """The repaired rig to write if a mistake is found. A former file is kept as NAME.old. Exit status
    4, and nothing is written, if several mistakes with different repairs explain the images as well."""
    json: bool = False
    """Print JSON instead of text."""

    def run(self) -> None:
        """Print the diagnosis, and write the repaired rig to `out`, if given, for a mistake that is certain.

        Raises:
            FileNotFoundError: for a missing file.
            ValueError: for a rig, images or matches that cannot be used.
            OSError: if it cannot be written.
            SystemExit: with status 4, if a rig is to be written and several repairs do as well.
        """
        from arraygeom.runtime.atomic import write_atomically
        from calib.images.doctor import diagnose

        if self.out is not None:
            options.writable(self.out)
        rig = options.load_rig(self.rig)
        with options.working("matching features and trying mistakes"):
            images = options.read_images(rig, self.image, sized=False)
            diagnosis = diagnose(rig, images, given_matches(self.matches, self.image, images))
        if self.json:
            options.print_json(json.loads(diagnosis.as_json()))
        else:
            print(diagnosis.as_text())
        if self.out is None:
            return
        if diagnosis.named.kind == "nothing":
            return say("no rig written: no mistake was found")
        if not diagnosis.certain:
            say("no rig written: several mistakes explain these images as well: correct the rig file by hand")
            raise SystemExit(REFUSED)
        kept = ""
        if self.out.exists():
            former = self.out.with_name(f"{self.out.name}.old")
            with write_atomically(former) as temporary:
                temporary.write_bytes(self.out.read_bytes())
            kept = f"; the former file: {former}"
        diagnosis.named.rig.save(self.out)
        say(f"written: {self.out} ({diagnosis.named.words}: undone{kept})")


REFUSED = 4
"""Exit status of a refused refinement of a rig that does not fit."""
BADLY = 1.0
"""Median distance of held-out points from their lines, pixels, above which a rig does not fit."""


@dataclass
class Refine:
    """Refine a rig by points matched between ordinary images of its cameras.

    No rig is written unless held-out points come nearer to their epipolar lines, the changes agree with their
    standard deviations, and depth changes by 1.5 per cent at most, as matched points do not determine it.

    Example: pat rig refine rig.yaml --image mono=a.png --image colour=b.png --out better.yaml
    """

    rig: RigFile
    image: Images
    """Once for each camera and frame: the first files of all cameras are one frame, and so on."""
    out: Out
    """Rig file to write."""
    matches: MatchesFile = None
    free: tuple[str, ...] = ("rotation", "translation", "focal", "centre")
    """Free parameters: rotation, translation, focal, centre (principal_point), distortion; CAMERA.KIND."""
    sigma: Annotated[tuple[str, ...], Option("KIND=NUMBER")] = ()
    """Standard deviation of a parameter before refinement: degrees, pixels; translation, focal relative."""
    force: bool = False
    """Write the refined rig in spite of objections."""

    def run(self) -> None:
        """Refine the rig, print the changes, and write it; exits with status 4 if it is refused though the
        old one does not fit.

        Raises:
            ValueError: for a rig, images or options that cannot be used.
            FileNotFoundError: for a missing file.
            OSError: if it cannot be written.
            SystemExit: with status 4, as above.
        """
        from arraygeom.io.native import write
        from arraygeom.runtime.atomic import write_text
        from calib.images.refinement import refine

        options.writable(self.out)
        rig = options.load_rig(self.rig)
        deviations = options.numbers_by_name(self.sigma, "--sigma")
        options.say_when_compiling()
        frames = options.read_frames(rig, self.image)
        if self.matches is not None and len(frames) > 1:
            raise ValueError(f"--matches needs one frame, got {len(frames)}: give one image of each camera")
        matches = given_matches(self.matches, self.image, frames[0])
        with options.working("matching features and refining"):
            refined = refine(
                rig,
                frames,
                matches=None if matches is None else [matches],
                free=[kind for text in self.free for kind in text.split(",")],
                sigma={kind: math.radians(s) if kind == "rotation" else s for kind, s in deviations.items()},
                force=self.force,
            )
        print(refined.as_text())
        if not refined.accepted:
            return self._refused(refined)
        notes = "".join(f"# {line}\n" for line in ["pat rig refine:", *refined.as_text().splitlines()])
        write_text(self.out, write(refined.rig) + notes)
        say(f"written: {self.out}")

    def _refused(self, refined: Refinement) -> None:
        """Say why no rig is written, and what to do; exits if the given rig does not fit."""
        off = refined.held_out[0].median
        force = "--force follows the lines, whatever that does to depth" if refined.objections else ""
        if not off > BADLY:
            return say(f"no rig written: {force}".rstrip(": "))
        first = {text.partition("=")[0]: text.partition("=")[2] for text in self.image[::-1]}
        say(
            f"no rig written, though points lie {off:.1f} px from their lines: {force}; or fuse without a "
            f"rig: `pat fuse {' '.join(first.values())}`",
            style="yellow",
        )
        sys.exit(REFUSED)


@dataclass
class RigFromImages:
    """Make a rig from images alone: fundamental matrices and rough homographies, good enough to fuse with.

    Example: pat rig start --image mono=a.png --image colour=b.png --focal mono=800 --out rig.yaml
    """

    image: Images
    """An image of each camera, once each."""
    out: Out
    """Rig file to write."""
    focal: Numbers = ()
    """Rough focal lengths in pixels, if known; used where they help."""
    matches: MatchesFile = None

    def run(self) -> None:
        """Estimate and write the rig, and print its statistics.

        Raises:
            ValueError: for images with too little in common or that cannot be read, and invalid options.
            FileNotFoundError: for a missing file.
            OSError: if it cannot be written.
        """
        from arraygeom.runtime.text import OPEN
        from calib.images.from_images import rig_from_images

        from ...media.images import read_image

        options.writable(self.out)
        images = {n: read_image(path, name=n) for n, path in options.files_by_name(self.image).items()}
        focal = options.numbers_by_name(self.focal, "--focal")
        with options.working("matching features and fitting lines"):
            matches = given_matches(self.matches, self.image, images)
            result = rig_from_images(images, focal=focal, matches=matches)
        print(result.as_text())
        result.rig.save(self.out)
        say(f"written: {self.out}" + (f" ({OPEN})" if result.rig.name == OPEN else ""))


@dataclass
class RigDiff:
    """Compare two calibrations of a rig, in pixels and in depth: has it moved?

    A motion of the whole rig is no difference. Whether one is larger than the calibrations' own errors is
    judged by the covariance files that `pat calibrate` writes beside its rigs.

    Example: pat rig diff may.yaml october.yaml --out diff.png
    """

    first: Annotated[Path, Option("A", positional=True)]
    """Rig file."""
    second: Annotated[Path, Option("B", positional=True)]
    """Rig file of the same cameras."""
    depth: Depth = None
    """Near and far bounds in metres between which rigs are compared, instead of the first one's."""
    image: Images = ()
    """An image of each camera: which rig fits them better, by points matched in them."""
    matches: MatchesFile = None
    out: MaybeOut = None
    """Picture to write: how far pixels and depths differ, over the images."""

    def run(self) -> None:
        """Print the comparison and the verdict.

        Raises:
            ValueError: for rigs of other cameras, no depth range, files that cannot be used, and options that
                contradict each other.
            FileNotFoundError: for a missing file.
            OSError: if the picture cannot be written.
        """
        from calib.boards.rig_diff import draw_difference, rig_difference
        from calib.boards.uncertainty import RigCovariance

        from ...media.figures import figure_file, save_figure

        if self.out is not None:
            figure_file(options.writable(self.out))
        if self.matches is not None and not self.image:
            raise ValueError("--matches needs --image: give the images of the cameras, NAME=FILE for each")
        a, b = options.load_rig(self.first), options.load_rig(self.second)
        depth = self.depth or (a.depth or b.depth)
        if depth is None:
            raise ValueError("--depth: neither rig states a depth range: give NEAR FAR, metres")
        near, far = (float(bound) for bound in depth)
        beside = [path.with_suffix(".covariance.json") for path in (self.first, self.second)]
        covariances = [RigCovariance.load(p, rig) if p.is_file() else None for p, rig in zip(beside, (a, b))]
        difference = rig_difference(a, b, covariances=(covariances[0], covariances[1]), depth=(near, far))
        for path, covariance in zip(beside, covariances):
            if covariance is None and any(covariances):
                options.warn(f"{path}: not there: that rig counts as calibrated as well as the other")
        if not any(covariances):
            options.warn("no covariance file beside the rigs: calibrate with `pat calibrate`")
        print(difference.as_text())
        if self.image:
            print(self._on_images(a, b))
        if self.out is not None:
            save_figure(draw_difference(difference), self.out)
            say(f"written: {self.out}")

    def _on_images(self, a: Rig, b: Rig) -> str:
        """Sentence on which rig's lines are nearer to points matched in the images."""
        from calib.images.matches import match_cameras
        from calib.images.residuals import line_distances, nearer

        images = options.read_images(a, self.image)
        with options.working("matching points of the images"):
            pairs = given_matches(self.matches, self.image, images) or match_cameras(images)
        of_a, of_b = line_distances(a, pairs), line_distances(b, pairs)
        medians = f"{of_a.abs().median():.2f} px from A's lines and {of_b.abs().median():.2f} px from B's"
        text = f"on the images: {len(of_a)} points, {medians}"
        closer = float((of_a.abs() < of_b.abs()).float().mean())
        if nearer(of_b, of_a):
            return f"{text}: A fits better, at {closer:.0%} of them"
        if nearer(of_a, of_b):
            return f"{text}: B fits better, at {1 - closer:.0%} of them"
        return f"{text}: neither fits significantly better"


class RigCommands:
    """Inspect, convert, draw, check, refine and compare rig files."""

    commands: ClassVar[Mapping[str, Any]] = {
        "info": Info,
        "convert": Convert,
        "show": Show,
        "doctor": Doctor,
        "refine": Refine,
        "start": RigFromImages,
        "diff": RigDiff,
    }
