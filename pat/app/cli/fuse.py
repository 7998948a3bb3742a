"""`pat fuse`: images of an array in, one image out."""

from __future__ import annotations

import filecmp
import logging
import shutil
import sys
import time
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from . import options
from .known import Known
from .options import FIRST, Numbers, Out, optional, say

if TYPE_CHECKING:
    from torch import Tensor

    from arraygeom import Rig
    from arraygeom.runtime.chunks import Tile

    from ...fusion.frame import Frame
    from ...fusion.fuse import FuseSettings
    from ...fusion.views import ViewFiles
    from ..from_images import ImageArray
    from ..healing import Healed
    from ..report import Facts

LOG = logging.getLogger(__name__)


@dataclass
class Fuse(Known):
    """Fuse the images of an array into one image at alpha's view: a frame, many frames, or a sequence.

    Without a rig: pat fuse mono.png colour.png
    With one: pat fuse rig.yaml --alpha mono --image mono=a.png --image colour=b.png --depth 2 20 --out out/

    Without a rig it is found from the images, and written to found_rig.yaml beside the result. Cameras are
    then called as their files are. With folders, or patterns such as "mono=day1/m_*.png" (quoted), for the
    images, frames are fused one by one, matched by names or by the numbers or times in them. With --sequence
    the cameras need not be synchronised (frame_rate and time_offset in the rig): every frame of alpha gets
    colour from the betas' frames nearest in time.
    """

    spellings: ClassVar[Mapping[str, str]] = {
        "--rig": FIRST,
        "--carry": "--propagate",
        "--no-carry": "--no-propagate",
        "--match-levels": "--normalise-radiometry",
        "--no-match-levels": "--no-normalise-radiometry",
    }

    focal: Numbers = ()
    """Without a rig: the focal length in pixels of a camera whose file does not state it."""
    out: Out = Path("out")
    """Folder for fused.png, confidence.png, depth.tif, depth_16.png (16 bits; 0 is unknown), depth.png,
    depth_nearest.tif and depth_farthest.tif (the true depth is between them in 9 of 10 pixels; not by
    assumed focal lengths), index.html (a page that shows them) and view.yaml (the rig of the fused view)."""
    align: bool = True
    """Find how far the other cameras lie off their search segments, and put that right."""
    exposure: Annotated[Literal["auto", "keep"] | None, optional("{auto,keep}")] = None
    """Brightness of the fused image: auto makes a dark or overexposed one as bright as a photograph; keep
    leaves it as alpha has it. By default auto of a single frame without a rig, else keep."""
    keep_alpha: bool = False
    """With --noise, leave alpha's values as recorded; always so if alpha has hardly any noise."""
    luminance: Literal["alpha", "mix", "beta"] = "alpha"
    """Whose brightness the fused image has: beta's, in alpha's detail, suits a near infrared alpha."""
    bits: Annotated[Literal[8, 16, 32] | None, optional("{8,16,32}")] = None
    """Bits a channel of the fused image: 8 or 16 sRGB-encoded, or 32 for linear light as floats (tif, exr).
    By default 16 if an image has more than 8, else 8; 32 of exr."""
    kind: Literal["png", "tif", "exr"] = "png"
    """Format of the fused image."""
    sequence: bool = False
    """Frames in order of time, the cameras not synchronised; also writes a video."""
    frame_rate: Numbers = ()
    """Frames a second of a camera, instead of the rig's."""
    time_offset: Numbers = ()
    """Seconds of a camera's first frame on a common clock, instead of the rig's."""
    speed: Annotated[float | None, optional("PIXELS")] = None
    """Fastest motion, pixels of alpha a second; by default estimated from alpha's frames."""
    video: Annotated[float | None, optional("FLOAT")] = None
    """Frames a second of the video of a sequence; 0 for none. By default 25, and of videos as alpha has."""
    propagate: bool = True
    """Propagate colour along motion between frames of a sequence; else each is fused alone, and flickers."""
    resume: bool = False
    """Fuse only frames not in --out yet, or whose images changed; of one frame, only unfinished tiles."""
    points: bool = False
    """Of a single frame, also write points.ply: the pixels of known depth as a coloured point cloud."""
    classical: bool = False
    """Show the classical baseline (semi-global matching, warped colour) on that page; seconds more."""
    on_error: Literal["stop", "skip"] = "stop"
    """What to do if a frame cannot be fused (a corrupt image, a full disk): stop, or report it and go on."""
    workers: int = 1
    """Processes on this machine, for many frames."""
    scheduler: Annotated[str | None, optional("ADDRESS")] = None
    """Address of a Dask scheduler whose workers fuse the frames, such as tcp://host:8786."""
    threads: Annotated[int | None, optional("INT")] = None
    """Threads in each process: by default 1 with several, else all cores."""
    precision: Literal["float32", "bfloat16", "int8"] = "float32"
    """Of the network's convolutions: the others are faster where the processor has them, see
    docs/performance.md."""
    device: Literal["cpu", "cuda", "auto"] = "cpu"
    """Where a single frame is fused: auto takes CUDA where there is such a GPU."""

    def run(self) -> None:
        """Check the options that can be checked at once, and fuse, with the rig that is given or found."""
        if self.bits not in {"png": (None, 8, 16), "tif": (None, 8, 16, 32), "exr": (None, 32)}[self.kind]:
            raise ValueError(
                f"--bits {self.bits} --kind {self.kind}: png holds 8 or 16 bits, exr 32, tif any"
            )
        if self.kind == "exr":
            from ...media.images import exr_writer

            exr_writer(self.out)
        self.image, with_rig = named_images(self.given, self.image, "fuse")
        self._settings()
        if options.device_of(self.device) != "cpu" and self.precision == "int8":
            raise ValueError("--precision int8 is for the CPU: leave it out, or --device")
        if self.classical and not self.report:
            raise ValueError("--classical needs the page: leave out --no-report")
        if self.workers < 1 or (self.threads is not None and self.threads < 1):
            raise ValueError("--workers and --threads are 1 or more")
        from arraygeom.runtime.threads import limited_to

        with self.judged(), limited_to(self.threads):
            self._with_rig() if with_rig else self._without_rig()

    def _with_rig(self) -> None:
        """Fuse with the rig that is given, healed by the images where these say so clearly."""
        from ...fusion.views import ViewFiles
        from ...media.raw import developed_rig
        from ..healing import checked_rig

        if self.focal:
            raise ValueError("--focal: the rig states the focal lengths: leave it out")
        rig = self._rig()
        alpha, files = files_by_camera(rig, self.alpha, self.given, self.image)
        files = self._frames(files)
        self._choose_bits(files)
        views = ViewFiles(rig, {name: paths[0] for name, paths in files.items()}, alpha=alpha)
        self._choose_weights(views)
        if self.sequence:
            return self._many(rig, files, alpha)
        with ThreadPoolExecutor(1) as beside:
            compared = beside.submit(checked_rig, views, heal=self.align)
            several = max(map(len, files.values())) > 1
            if several or self.strict or self.max_memory is not None:
                with options.working("comparing the rig with the images"):
                    healed = compared.result()
                rig = self._healed(rig, healed)
            if several:
                return self._many(rig, files, alpha)
            self._one(developed_rig(rig, files), views, alpha, views.files, healing=compared.result)

    def _choose_weights(self, views: ViewFiles) -> None:
        """The weights for any bands, unless asked otherwise, where no beta is meant to be in colour and they
        do not have three bands in all."""
        from ...networks.weights import weights_for

        betas = [name for name in views if name != views.alpha]
        if self.weights or any(views.rig[name].sensor.response == "rgb" for name in betas):
            return
        bands = [len(views[name]) for name in betas]
        if 3 not in bands and sum(bands) != 3:
            self.weights = weights_for(bands)
            say(f"weights: {self.weights} (--weights NAME takes others)")

    def _without_rig(self) -> None:
        """Fuse images, folders or videos alone. Raises ValueError for options that need a rig."""
        from ...support.locks import folder_lock
        from ..batch import find_images
        from ..from_images import camera_names, frames_of_videos

        with_rig = {"--depth": self.depth, "--frame-rate": self.frame_rate, "--time-offset": self.time_offset}
        if named := [option for option, value in with_rig.items() if value]:
            raise ValueError(f"{', '.join(named)}: needs a rig: give one with --rig RIG")
        with folder_lock(self.out):  # finding the rig takes long: what cannot be written to is refused before
            pass
        cameras = camera_names(self.given)
        focal = options.numbers_by_name(self.focal, "--focal")
        noise = options.noise_of(self.noise)
        levels = noise if isinstance(noise, dict) else {}
        for option, by_camera in {"--focal": focal, "--noise": levels}.items():
            if unknown := by_camera.keys() - cameras.keys():
                names = ", ".join(cameras)
                raise ValueError(f"{option}: no camera '{min(unknown)}'; the images' names are {names}")
        videos = [path for path in cameras.values() if path.suffix.lower() in options.VIDEO_SUFFIXES]
        if videos and (others := [path for path in cameras.values() if path not in videos]):
            raise ValueError(f"{videos[0]} is a video and {others[0]} is not: give images alone, or videos")
        if not videos:
            files = {name: find_images(path) for name, path in cameras.items()}
            refuse_same(files)
            return self._without_rig_from(files, {})
        with TemporaryDirectory() as folder:
            self._without_rig_from(*frames_of_videos(cameras, Path(folder)))

    def _without_rig_from(self, files: dict[str, list[Path]], rates: Mapping[str, float]) -> None:
        """Find the rig from each camera's first image and fuse; `rates` are frames a second, of videos."""
        from arraygeom.io.native import write
        from arraygeom.runtime.together import refuse_others, write_listed

        from ...fusion.results import FOUND_RIG
        from ...networks.weights import load_weights

        self.sequence |= bool(rates)
        files = self._frames(files)
        self._choose_bits(files)
        array = self.found_array(files, options.numbers_by_name(self.focal, "--focal"))
        if max(map(len, files.values())) == 1:
            measured = load_weights(array.weights).bands is None
            self.exposure = self.exposure or ("keep" if measured else "auto")
            first = {name: paths[0] for name, paths in files.items()}
            return self._one(array.rig, array.images, array.alpha, first, image_array=array)
        rig = array.recorded
        for name, rate in rates.items():
            if name in rig.names:
                rig = with_sensor(rig, name, frame_rate=rate)
        if self.video is None:
            self.video = rates.get(array.alpha)
        path = self.out / FOUND_RIG
        refuse_others(self.out, [FOUND_RIG])
        if not path.exists():  # frames that fail may want it; another job's is kept until this one is done
            write_listed(path, write(rig))
        say(f"the rig that was found: {path}")
        self._many(rig, {name: files[name] for name in rig.names}, array.alpha)
        write_listed(path, write(rig))

    def _choose_bits(self, files: Mapping[str, Sequence[Path]]) -> None:
        """As many bits as the images have, unless asked otherwise."""
        from ...media.images import has_many_bits

        if self.bits is None:
            deep = any(has_many_bits(paths[0]) for paths in files.values())
            self.bits = 32 if self.kind == "exr" else 16 if deep else 8

    def _frames(self, files: dict[str, list[Path]]) -> dict[str, list[Path]]:
        """The files of the frames that every camera has; all of them, of a sequence.

        Raises ValueError for options that are not of so many frames, and for files where results would go.
        """
        from ...fusion.frame_matching import matched_frames, warn_of_gaps
        from ...fusion.results import check_no_result

        prior_files = [path for path in (self.depth_map, self.matches) if path is not None]
        check_no_result(
            [*self.given, *prior_files, *(path for paths in files.values() for path in paths)], self.out
        )
        timed = {"--frame-rate": self.frame_rate, "--time-offset": self.time_offset, "--speed": self.speed}
        if self.sequence:
            warn_of_gaps(files)
        elif named := [option for option, value in timed.items() if value not in ((), None)]:
            raise ValueError(f"{', '.join(named)}: for a --sequence only: give that, or leave out")
        else:
            files = matched_frames(files)
        if self.sequence or max(map(len, files.values())) > 1:
            self.refuse_several()
        self._warn_of_ignored(one=max(map(len, files.values())) == 1)
        return files

    def _warn_of_ignored(self, *, one: bool) -> None:
        """Say which options do nothing for `one` frame, and for frames that are no sequence."""
        of_many = {
            "--sequence": self.sequence,
            "--workers": self.workers > 1,
            "--scheduler": self.scheduler is not None,
            "--on-error skip": self.on_error == "skip",
        }
        of_sequences = {"--video": self.video is not None, "--no-propagate": not self.propagate}
        if one and (named := [option for option, given in of_many.items() if given]):
            options.warn(f"{', '.join(named)}: for many frames, and each camera has one image")
        if not self.sequence and (named := [option for option, given in of_sequences.items() if given]):
            options.warn(f"{', '.join(named)}: for a --sequence only: of no effect")
        if self.sequence and self.video and (self.bits == 32 or self.kind == "exr"):
            options.warn("--video: of frames of 32 bits there is none: of no effect")

    def refuse_several(self) -> None:
        """Raise ValueError for options of single frames."""
        super().refuse_several()
        single = {
            "--points": self.points,
            "--classical": self.classical,
            "--device cuda": self.device == "cuda",
            "--exposure auto": self.exposure == "auto",
        }
        if named := [option for option, given in single.items() if given]:
            raise ValueError(f"{', '.join(named)}: for a single frame only: leave out for several")

    def _rig(self) -> Rig:
        rig = options.load_rig_or_say_no_image(self.given[0], self.depth)
        for entry, given in {"frame_rate": self.frame_rate, "time_offset": self.time_offset}.items():
            for name, value in options.numbers_by_name(given, f"--{entry.replace('_', '-')}").items():
                rig = with_sensor(rig, name, **{entry: value})
        return rig

    def _one(
        self,
        rig: Rig,
        images: Mapping[str, Tensor],
        alpha: str,
        files: Mapping[str, str | Path],
        *,
        image_array: ImageArray | None = None,
        healing: Callable[[], Healed | None] = lambda: None,
    ) -> None:
        """Fuse one frame. `rig` is of the files as they are developed; `image_array` is what they say of it,
        where it was found from them; `healing` gives the rig healed by them, and the frame is fused again."""
        from arraygeom import Camera
        from arraygeom.runtime.together import LISTS, sweep

        from ...fusion.inputs import measured_along
        from ...fusion.results import refuse_to_replace, save_frame
        from ...fusion.views import Views
        from ...media.raw import developed_rig
        from ...support.locks import folder_lock

        if self.points and not isinstance(rig[alpha], Camera):
            raise ValueError("--points needs a calibrated alpha, and the rig has only F for it: leave it out")
        begin, store, field = time.monotonic(), self.out / LISTS / "tiles", options.field_named(self.field)
        along = measured_along(Views(rig, images, alpha, dict.fromkeys(images, field)))

        def fused(rig: Rig) -> Frame:
            rig, field_given = self.with_known(rig, alpha, files, field)
            return fuse_with_progress(
                self.weights or "mono-colour",
                rig,
                images,
                alpha=alpha,
                device=self.device,
                precision=self.precision,
                settings=replace(self._settings(), field=field_given),
                explain=self.note,
                store=store,
            )

        with folder_lock(self.out):
            sweep(self.out)
            refuse_to_replace(self.out)
            if not self.resume:
                shutil.rmtree(store, ignore_errors=True)
            frame = fused(rig)
            if (healed := healing()) is not None and healed.text not in self._notes:
                rig = developed_rig(self._healed(rig, healed), files)
                frame = fused(rig)
            frame, gain = self._exposed(frame)
            if image_array is None and not frame.depth.isfinite().any():
                self.note("no depth: the rig knows its cameras by F alone, or the images match nowhere")
            found = None if image_array is None else image_array.lasting
            further = self._options_of_saving(frame, rig, alpha, files)
            pages = {}
            if self.report:
                adopted = () if image_array is None else image_array.notes
                facts = self._facts(rig, adopted, time.monotonic() - begin)
                pages["index.html"] = self._page(frame, rig, images, alpha, facts, gain)
            written = save_frame(frame, self.out, along=along, rig=found, pages=pages, **further)
            shutil.rmtree(store, ignore_errors=True)
        say(f"written to {self.out}: {', '.join(path.name for path in written)}")
        if self.report:
            say(f"to see the result, open {self.out / 'index.html'} in a browser")

    def _options_of_saving(
        self, frame: Frame, fused: Rig, alpha: str, files: Container[str]
    ) -> dict[str, Any]:
        """Options of `save_frame`; notes what some files will hold."""
        from ...fusion.results import band_names, describe_bands, view_of

        bits = self.bits or 8
        bands = band_names(frame, (name for name in fused.betas(alpha) if name in files))
        if said := describe_bands(frame, bands, self.kind):
            self.note(said)
        if self.points:
            self.note("points.ply: the pixels of known depth, in alpha's frame")
        return {
            "bits": bits,
            "kind": self.kind,
            "view": view_of(fused, alpha, bits=bits, bands=len(frame.image)),
            "points": fused[alpha] if self.points else None,
            "bands": bands,
        }

    def _healed(self, rig: Rig, healed: Healed | None) -> Rig:
        """The rig, or the one that its images healed, which is written beside the results."""
        from arraygeom.io.native import write
        from arraygeom.runtime.together import write_listed

        from ...fusion.results import HEALED_RIG

        if healed is None:
            return rig
        self.note(healed.text)
        path = self.out / HEALED_RIG
        if path.resolve() == self.given[0].resolve():
            self.note(f"the healed rig is not written: {path} is the one that was given: give another --out")
        else:
            write_listed(path, write(healed.rig))
            self.note(f"the healed rig: {path}")
        return healed.rig

    def _settings(self) -> FuseSettings:
        """What a frame and many frames have in common."""
        quiet = not self.sequence and self.luminance == "alpha"
        arguments = {"align": self.align, "keep_alpha": self.keep_alpha, "luminance": self.luminance}
        return self.settings(noise_by_default=quiet, **arguments)

    def _facts(self, rig: Rig, adopted: tuple[str, ...], seconds: float) -> Facts:
        """What the page says."""
        from arraygeom.runtime.text import length_unit

        from ...support.memory import peak_memory
        from ..report import Facts

        notes = [f"weights: {self.weights or 'mono-colour'}", *self._notes, *adopted]
        warned = [str(message) for message in options.WARNED]
        return Facts(notes, warned, seconds, peak_memory(), length_unit(rig))

    def _page(
        self, frame: Frame, rig: Rig, images: Mapping[str, Tensor], alpha: str, facts: Facts, gain: float
    ) -> str:
        """The page index.html, with the classical baseline if it is asked for."""
        from ..report import report_page

        if self.classical:
            facts = facts._replace(classical=self._classical(rig, images, alpha, gain))
        return report_page(frame, images, rig, alpha, facts)

    def _classical(self, rig: Rig, images: Mapping[str, Tensor], alpha: str, gain: float) -> Tensor | None:
        """The classical baseline, bright as the fused image; None, and a line, if cameras do not allow it."""
        from ...fusion.classical import classical_view
        from ...media.colour import exposed
        from ..report import LONGEST

        try:
            with options.working("classical baseline"):
                view = classical_view(rig, images, alpha, longest=LONGEST)
                return exposed(view, gain)
        except ValueError as error:
            say(f"no classical baseline: {error}")
            return None

    def _exposed(self, frame: Frame) -> tuple[Frame, float]:
        from ...media.colour import exposed, exposure_gain

        gain = exposure_gain(frame.image) if self.exposure == "auto" else 1.0
        if gain != 1:
            what = "dark" if gain > 1 else "overexposed"
            self.note(f"exposure: light times {gain:.2f}: the image is {what} (--exposure keep leaves it)")
        return frame._replace(image=exposed(frame.image, gain)), gain

    def _many(self, rig: Rig, files: dict[str, list[Path]], alpha: str) -> None:
        """Fuse many frames, or a sequence, by workers; exit with status 1 if some fail."""
        from ...support.jobs import Workers, cores
        from ..batch import Batch

        batch = Batch(
            rig,
            files,
            rig.require(alpha),
            self.out,
            sequence=self.sequence,
            speed=self.speed,
            bits=self.bits or 8,
            kind=self.kind,
            alone=not self.propagate,
            strict=self.strict,
            weights=self.weights or "mono-colour",
            precision=self.precision,
            settings=self._settings(),
        )
        rate = 25.0 if self.video is None else self.video
        video = rate if self.sequence and rate and self.bits != 32 else None
        several = self.workers > 1 or self.scheduler is not None
        threads = self.threads if self.threads is not None else 1 if several else cores()
        report = batch.run(
            workers=Workers(self.workers, self.scheduler, threads),
            resume=self.resume,
            on_error=self.on_error,
            video=video,
            console=options.console(),
        )
        shown = video is not None and (self.out / "fused.mp4").is_file()
        say(f"{self.out}: {report}{', and fused.mp4' * shown}")
        if report.failed:
            sys.exit(1)


def fuse_with_progress(
    weights: str,
    rig: Rig,
    images: Mapping[str, Tensor],
    *,
    device: str = "cpu",
    precision: Literal["float32", "bfloat16", "int8"] = "float32",
    **further: Any,
) -> Frame:
    """`fuse` with weights by name, the plan and a bar on the terminal. The frame is on the CPU."""
    from ...networks.weights import load_weights
    from ..front import fuse

    where = options.device_of(device)
    network = load_weights(weights, precision=precision).to(where)
    if where != "cpu":
        rig, images = rig.to(where), {name: image.to(where) for name, image in images.items()}
    options.say_when_compiling()
    with options.working_by_plan("fusing") as announce:
        frame = fuse(images, rig, network=network, progress=_numbered, announce=announce, **further)
    return frame.mapped(lambda tensor: tensor.cpu())


def _numbered(tiles: Iterable[Tile], count: int) -> Iterator[Tile]:
    """The tiles, each said as it begins where there are several."""
    for i, tile in enumerate(tiles, 1):
        if count > 1:
            LOG.info("tile %d of %d", i, count)
        yield tile


def with_sensor(rig: Rig, name: str, **changes: float) -> Rig:
    """The rig with some entries of a camera's sensor changed."""
    return rig.with_camera(name, rig[name].replace(sensor=replace(rig[name].sensor, **changes)))


def named_images(paths: Sequence[Path], image: Sequence[str], command: str) -> tuple[tuple[str, ...], bool]:
    """The images NAME=FILE of a rig's cameras, and whether the first argument is a rig. Imports no torch.

    Images that follow a rig are of the cameras that their names say. Raises ValueError for arguments that do
    not go together, FileNotFoundError for files that do not exist.
    """
    if paths and (image or is_rig_file(paths[0])):
        named = (*image, *(f"{path.stem}={path}" for path in paths[1:]))
        if not named:
            raise ValueError(
                f"{paths[0]}: {options.NO_IMAGE}; if it is a rig, give --image NAME=FILE for each camera"
            )
        options.files_by_name(named)
        options.refuse_missing(paths[0], rig=True)
        return named, True
    if image:
        files = " ".join(text.partition("=")[2] or text for text in image)
        raise ValueError(f"--image needs a rig: give --rig RIG, or the images alone: `pat {command} {files}`")
    if len(paths) < 2:
        raise ValueError(
            f"give two images or more, as `pat {command} mono.png colour.png`; "
            "or a rig, --alpha and each --image"
        )
    for path in paths:
        options.refuse_missing(path, rig=False)
    return (), False


def files_by_camera(
    rig: Rig, alpha: str | None, paths: Sequence[Path], image: Sequence[str]
) -> tuple[str, dict[str, list[Path]]]:
    """Alpha's name, and the image files of each camera of a rig. Raises ValueError without alpha, for names
    that the rig lacks, and for one image given twice."""
    from ..batch import find_images

    if alpha is None:
        raise ValueError(f"--alpha: give the camera whose view is wanted, one of {', '.join(rig.names)}")
    files = options.files_by_name(image)
    if unknown := [path for path in paths[1:] if path.stem not in rig.names]:
        raise ValueError(f"{unknown[0]}: no camera of the rig has its name: give --image NAME={unknown[0]}")
    files_of = {rig.require(name): find_images(path, name=name) for name, path in files.items()}
    refuse_same(files_of)
    return rig.require(alpha), files_of


def refuse_same(files: Mapping[str, Sequence[Path]]) -> None:
    """Raise ValueError if the first files of two cameras hold the same."""
    for (a, (first, *_)), (b, (second, *_)) in combinations(files.items(), 2):
        if first.is_file() and second.is_file() and filecmp.cmp(first, second, shallow=False):
            raise ValueError(
                f"the images of '{a}' and '{b}' are the same image, {second}: give each camera its own"
            )


def is_rig_file(path: Path) -> bool:
    """Whether a file is meant as a rig: neither folder nor pattern, nor named as images and videos are."""
    suffixes = options.IMAGE_SUFFIXES | options.VIDEO_SUFFIXES
    return not (any(c in path.name for c in "*?[") or path.suffix.lower() in suffixes or path.is_dir())
