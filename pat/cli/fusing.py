"""`pat fuse` and `pat demo`: images of an array in, one image out."""

from __future__ import annotations

import shutil
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from . import options
from .options import Depth, FieldName, Images, Memory, Numbers, Out, RigFile, Weights, optional, say

if TYPE_CHECKING:
    from torch import Tensor

    from arraygeom import Rig

    from ..fusion.results import Frame


@dataclass
class Fuse:
    """Fuse the images of an array into one image at alpha's view: a frame, many frames, or a sequence.

    Example: pat fuse rig.yaml --alpha mono --image mono=a.png --image colour=b.png --depth 2 20 --out out/

    With folders, or patterns such as "mono=day1/m_*.png" (quoted), for the images, frames are fused one by one:
    the first of each camera, the second, and so on. With --sequence the cameras need not be synchronised (frame_rate
    and time_offset in the rig): every frame of alpha gets colour from the betas' frames nearest in time.
    """

    spellings: ClassVar[Mapping[str, str]] = {
        "--carry": "--propagate",
        "--no-carry": "--no-propagate",
        "--match-levels": "--normalise-radiometry",
        "--no-match-levels": "--no-normalise-radiometry",
    }

    rig: RigFile
    alpha: Annotated[str, options.arg(metavar="NAME")]
    """The camera whose view is wanted."""
    image: Images
    """An image of each camera, once each; or NAME=FOLDER, or NAME=PATTERN."""
    depth: Depth = None
    """Near and far bounds in metres, instead of the rig's; far may be inf."""
    out: Out = Path("out")
    """Folder for fused.png, confidence.png, depth.tif, depth.png and view.yaml (the rig of the fused view)."""
    weights: Weights = "mono-colour"
    field: FieldName = "auto"
    """Receptive field in the other cameras; auto takes what the rig allows."""
    max_memory: Memory = None
    """Memory limit of the whole process, such as 4GiB; larger frames are fused in tiles."""
    normalise_radiometry: bool = False
    """First bring every beta to alpha's mean and contrast (other exposures, filters). Also: --match-levels."""
    response: Annotated[str, options.arg(metavar="fit|rec601|R,G,B")] = "fit"
    """How a mono alpha weighs red, green and blue; fit: found from matches, with gain and gamma."""
    align: bool = True
    """Find how far the other cameras lie off their search segments, and put that right."""
    bits: Literal[8, 16, 32] = 8
    """Bits a channel of the fused image: 8 or 16 sRGB-encoded, or 32 for linear light as floats (tif, exr)."""
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
    video: float = 25.0
    """Frames a second of the video of a sequence; 0 for none."""
    propagate: bool = True
    """Propagate colour along motion between frames of a sequence; else each is fused by itself, and flickers."""
    resume: bool = False
    """Fuse only frames that are not in --out yet, or whose images changed; of one frame, only unfinished tiles."""
    strict: bool = False
    """Write nothing, instead of warning, where the confidence says that the rig does not fit the images."""
    on_error: Literal["stop", "skip"] = "stop"
    """What to do when a frame cannot be fused (a corrupt image, a full disk): stop, or report it and go on."""
    workers: int = 1
    """Processes on this machine, for many frames."""
    scheduler: Annotated[str | None, optional("ADDRESS")] = None
    """Address of a Dask scheduler whose workers fuse the frames, such as tcp://host:8786."""
    threads: Annotated[int | None, optional("INT")] = None
    """Threads in each process: by default 1 with several, else all cores."""

    def run(self) -> None:
        from ..fusion.batch import find_images
        from ..support.memory import parse_bytes

        if self.bits not in {"png": (8, 16), "tif": (8, 16, 32), "exr": (32,)}[self.kind]:
            raise ValueError(f"--bits {self.bits} --kind {self.kind}: png holds 8 or 16 bits, exr 32, tif any")
        if self.max_memory is not None:
            parse_bytes(self.max_memory)
        options.response_of(self.response)
        rig = self._rig()
        files = options.files_by_name(self.image)
        found = {rig.require(name): find_images(path, name=name) for name, path in files.items()}
        with self._judged():
            if self.sequence or max(map(len, found.values())) > 1:
                self._many(rig, found)
            else:
                self._one(rig, {name: paths[0] for name, paths in found.items()})

    @contextmanager
    def _judged(self) -> Iterator[None]:
        """Exit status 3 if the rig does not fit the images."""
        from ..fusion.checks import LowConfidenceWarning, confidence_checked

        categories: list[type[Warning]] = []
        with confidence_checked(strict=self.strict):
            show = warnings.showwarning

            def noted(message: Warning | str, category: type[Warning], *further: Any, **options: Any) -> None:
                categories.append(category)
                show(message, category, *further, **options)

            warnings.showwarning = noted
            try:
                yield
            except Exception as error:
                if not isinstance(error.__cause__ or error, LowConfidenceWarning):
                    raise
                say(f"pat: {error}; not written (--strict)", style="red")
                sys.exit(LowConfidenceWarning.exit_status)
        if LowConfidenceWarning in categories:
            sys.exit(LowConfidenceWarning.exit_status)

    def _rig(self) -> Rig:
        rig = options.load_rig(self.rig, self.depth)
        for name, rate in options.numbers_by_name(self.frame_rate, "--frame-rate").items():
            rig = rig.with_camera(name, rig[name].replace(sensor=replace(rig[name].sensor, frame_rate=rate)))
        for name, offset in options.numbers_by_name(self.time_offset, "--time-offset").items():
            rig = rig.with_camera(name, rig[name].replace(sensor=replace(rig[name].sensor, time_offset=offset)))
        return rig

    def _one(self, rig: Rig, files: dict[str, Path]) -> None:
        from arraygeom.atomic import sweep

        from ..fusion.results import save_frame, view_of
        from ..fusion.views import ViewFiles
        from ..support.locks import folder_lock

        images = ViewFiles(rig, files, alpha=rig.require(self.alpha))
        rig = images.developed
        store = self.out / ".tiles"
        with folder_lock(self.out):
            sweep(self.out)
            if not self.resume:
                shutil.rmtree(store, ignore_errors=True)
            frame = fuse_with_progress(
                self.weights,
                rig,
                images,
                alpha=self.alpha,
                field=options.field_named(self.field),
                max_memory=self.max_memory,
                match_levels=self.normalise_radiometry,
                response=options.response_of(self.response),
                align=self.align,
                explain=say,
                store=store,
            )
            view = view_of(rig, self.alpha, bits=self.bits, bands=len(frame.image))
            written = save_frame(frame, self.out, bits=self.bits, kind=self.kind, view=view)
            shutil.rmtree(store, ignore_errors=True)
        say(f"written: {', '.join(map(str, written))}")

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
            field=options.field_named(self.field),
            match_levels=self.normalise_radiometry,
            response=options.response_of(self.response),
            align=self.align,
            max_memory=self.max_memory,
            bits=self.bits,
            kind=self.kind,
            alone=not self.propagate,
            strict=self.strict,
        )
        several = self.workers > 1 or self.scheduler is not None
        report = batch.run(
            workers=Workers(self.workers, self.scheduler, self.threads or (1 if several else cores())),
            resume=self.resume,
            on_error=self.on_error,
            video=self.video if self.sequence and self.video and self.bits != 32 else None,
            console=options.console(),
        )
        say(f"{self.out}: {report}")
        if report.failed:
            sys.exit(1)


@dataclass
class Demo:
    """Fuse the sample array of the package: image, depth, confidence, a figure, PSNR and SSIM."""

    out: Out = Path("out/demo")
    """Folder for the results."""
    weights: Weights = "mono-colour"

    def run(self) -> None:
        from arraygeom.atomic import write_text

        from ..data.sample_array import ALPHA, BETA, load_sample
        from ..evaluation.baseline import classical
        from ..evaluation.metrics import score
        from ..fusion.results import save_frame
        from ..systems.demo import save_demo_figure

        sample = load_sample()
        say("classical baseline: semi-global matching, warped colour, edge-aware smoothing")
        baseline = classical(sample.rig, sample.images, ALPHA, BETA)
        say(f"fusion with the weights '{self.weights}'")
        frame = fuse_with_progress(self.weights, sample.rig, sample.images, alpha=ALPHA)
        written = save_frame(frame, self.out)
        save_demo_figure(sample, baseline, frame, self.out / "demo.png")
        rows = {"alpha alone": sample.images[ALPHA].expand(3, -1, -1), "classical": baseline, "fusion": frame.image}
        scores = {name: score(image.clamp(0, 1), sample.ground_truth) for name, image in rows.items()}
        lines = [f"{name:12s} {psnr:6.2f} dB  {ssim:.4f}" for name, (psnr, ssim) in scores.items()]
        table = "\n".join(["                 PSNR    SSIM", *lines, ""])
        print(table, end="")
        write_text(self.out / "demo.md", f"```\n{table}```\n")
        say(f"written: {', '.join(map(str, [*written, self.out / 'demo.png']))}")


def fuse_with_progress(weights: str, rig: Rig, images: Mapping[str, Tensor], **further: Any) -> Frame:
    """`fuse` with weights by name, the plan and a bar on the terminal."""
    from ..fusion.fuse import fuse
    from ..networks.weights import load_weights

    bar: Any = options.progress("fusing")
    return fuse(load_weights(weights), rig, images, progress=bar, announce=lambda p: say(f"plan: {p}"), **further)
