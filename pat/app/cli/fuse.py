"""`pat fuse`: fuses one frame of an array to one image."""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from . import options
from .fusing import Files, Fusing, Recordings
from .known import Around, KnownFile
from .options import Out, say
from .parser import Option, UsageError

if TYPE_CHECKING:
    from torch import Tensor

    from arraygeom import Rig
    from arraygeom.runtime.chunks import Tile

    from ...fusion.frame import Frame
    from ..from_images import ImageArray

LOG = logging.getLogger(__name__)
EXTRAS = "page", "classical", "points", "none"


@dataclass
class Fuse(Around, Fusing):
    """Fuse one image of each camera of an array into one image at alpha's view.

    Examples:
        pat fuse mono.png colour.png
        pat fuse rig.yaml --alpha mono --image mono=a.png --image colour=b.png --depth 2 20 --out out/

    Without a rig it is found from the images, and written to found_rig.yaml beside the result, unless they
    determine no lines; cameras are then called as their files, or bands, are. `pat batch` fuses many frames,
    `pat sequence` frames in order of time. The same command again goes on where it was stopped.
    """

    headings: ClassVar[Mapping[str, str]] = {
        "the rig, and where to search": "misfit focal field around",
        "brightness and noise": "response match_levels noise luminance exposure",
        "files": "format extras",
        "the machine": "max_memory device",
    }

    out: Out = Path("out")
    """Folder for fused.png, confidence.png, depth.tif, depth_16.png (16 bits; 0 is unknown), depth.png,
    depth_nearest.tif and depth_farthest.tif (the true depth is between them in 9 of 10 pixels; not by
    assumed focal lengths), index.html (a page that shows them) and view.yaml (the rig of the fused view)."""
    exposure: Literal["auto", "keep"] | None = None
    """Brightness of the fused image: auto makes a dark or overexposed one as bright as a photograph; keep
    leaves it as alpha has it. By default auto without a rig, else keep."""
    extras: Annotated[str, Option("NAME[,NAME]")] = "page"
    """What is written beside the images: page (index.html), classical (the page, with the classical baseline:
    semi-global matching, warped colour; seconds more), points (points.ply: the pixels of known depth as a
    coloured point cloud), none."""
    device: Literal["cpu", "cuda", "auto"] = "cpu"
    """Where the frame is fused: auto takes CUDA where there is such a GPU."""

    def run(self) -> None:
        """Fuse the frame, with the given rig or one found from the images.

        Raises:
            UsageError: for invalid options.
            ValueError: for images or a rig that cannot be used.
            FileNotFoundError: for a missing file, and unknown weights.
            FileExistsError: for files in the way that no run wrote.
            OSError: if files cannot be written.
            SystemExit: as `judged`.
        """
        self._extras = options.extras_of(self.extras, EXTRAS)
        image, with_rig = self.named("fuse")
        options.device_of(self.device)
        with self.judged(), self.recordings(image, with_rig=with_rig) as frame:
            self._fuse(frame)

    def known_files(self) -> list[Path]:
        """Return the file of --around, if given."""
        return [] if self.around is None else [KnownFile.parse(self.around).path]

    def frames(self, files: Files) -> Files:
        """Check that there is one image of each camera; returns the files unchanged.

        Raises:
            UsageError: for several frames.
        """
        if several := [name for name, paths in files.items() if len(paths) > 1]:
            count = len(files[several[0]])
            raise UsageError(
                several[0], "one image; `pat batch` or `pat sequence` fuses many", f"{count} images"
            )
        return files

    def _fuse(self, given: Recordings) -> None:
        """Fuse the frame and write its files."""
        from arraygeom import Camera
        from arraygeom.runtime.together import LISTS, sweep

        from ...fusion.inputs import measured_along
        from ...fusion.views import ViewFiles, Views
        from ...media.raw import developed_rig
        from ...support.locks import folder_lock
        from ..results import band_names, describe_bands, refuse_to_replace, save_frame, view_of

        alpha, found, points, begin = given.alpha, given.found, "points" in self._extras, time.monotonic()
        if points and not isinstance(given.rig[alpha], Camera):
            raise UsageError("--extras points", "a calibrated alpha, and it has F alone: leave it out")
        with folder_lock(self.out):
            sweep(self.out)
            refuse_to_replace(self.out)
            images: Mapping[str, Tensor]
            if found is None:
                views = ViewFiles(given.rig, given.first, alpha=alpha)
                rig, images = developed_rig(self.healed(views), given.files), views
            else:
                rig, images = found.rig, found.images
            field, tiles = options.field_named(self.field), self.out / LISTS / "tiles"
            along = measured_along(Views(rig, images, alpha, dict.fromkeys(images, field)))
            searched, around = self.with_known(images, rig, alpha, given.first, field)
            settings = self.fuse_settings(noise_by_default=self.luminance in ("alpha", "recorded"))
            frame = fuse_with_progress(
                self.network or "mono-colour",
                searched,
                images,
                alpha=alpha,
                device=self.device,
                settings=replace(settings, field=around),
                explain=self.note,
                store=tiles,
            )
            frame, gain = self._exposed(frame, found)
            if not frame.depth.isfinite().any():
                self.note(no_depth(rig, alpha))
            elif along == "distance":
                self.note("depth is the distance along the ray, in depth.tif too")
            bands = band_names(frame, (name for name in rig.betas(alpha) if name in given.files))
            if said := describe_bands(frame, bands, self.kind):
                self.note(said)
            if points:
                self.note("points.ply: the pixels of known depth, in alpha's frame")
            pages = {}
            if {"page", "classical"} & self._extras:
                pages["index.html"] = self._page(frame, rig, images, given, gain, begin)
            written = save_frame(
                frame,
                self.out,
                bits=self.bits,
                kind=self.kind,
                view=view_of(rig, alpha, bits=self.bits, bands=len(frame.image)),
                points=rig[alpha] if points else None,
                rig=None if found is None else found.lasting,
                bands=bands,
                along=along,
                pages=pages,
            )
            shutil.rmtree(tiles, ignore_errors=True)
        say(f"written to {self.out}: {', '.join(path.name for path in written)}")
        if pages:
            say(f"to see the result, open {self.out / 'index.html'} in a browser")

    def _page(
        self,
        frame: Frame,
        rig: Rig,
        images: Mapping[str, Tensor],
        given: Recordings,
        gain: float,
        begin: float,
    ) -> str:
        """HTML of index.html; with the classical baseline if requested, as bright as the fused image, and a
        message if the cameras do not allow it. `begin` is the clock's time when the work began."""
        from arraygeom.runtime.text import length_unit

        from ...support.memory import peak_memory
        from ..report import LONGEST, Facts, report_page

        alpha, found = given.alpha, given.found
        notes = [f"network: {self.network or 'mono-colour'}", *self._notes, *(found.notes if found else ())]
        warned = [str(message) for message in options.WARNED]
        facts = Facts(notes, warned, time.monotonic() - begin, peak_memory(), length_unit(rig))
        if "classical" in self._extras:
            from ...fusion.classical import classical_view
            from ...media.colour import exposed

            try:
                with options.working("classical baseline"):
                    view = classical_view(rig, images, alpha, longest=LONGEST)
                facts = facts._replace(classical=exposed(view, gain))
            except ValueError as error:
                say(f"no classical baseline: {error}")
        return report_page(frame, images, rig, alpha, facts)

    def _exposed(self, frame: Frame, found: ImageArray | None) -> tuple[Frame, float]:
        """Frame with the requested brightness, and the factor of light."""
        from ...media.colour import exposed, exposure_gain
        from ...networks.weights import load_weights

        photograph = found is not None and load_weights(found.weights).bands is not None
        exposure = self.exposure or ("auto" if photograph else "keep")
        gain = exposure_gain(frame.image) if exposure == "auto" else 1.0
        if gain != 1:
            what = "dark" if gain > 1 else "overexposed"
            self.note(f"exposure: light times {gain:.2f}: the image is {what} (--exposure keep leaves it)")
        return frame._replace(image=exposed(frame.image, gain)), gain


def no_depth(rig: Rig, alpha: str) -> str:
    """Say why a fused frame has no depth."""
    from arraygeom.runtime.text import OPEN

    pairs = [rig.pair(alpha, name) for name in rig.betas(alpha)]
    if rig.name == OPEN or all(pair.at_one_place for pair in pairs):
        return "no depth: a homography registers the images (cameras at one place, or a far or flat scene)"
    by_lines = "the rig knows its cameras by F alone" if not any(p.calibrated for p in pairs) else ""
    return f"no depth: {by_lines or 'the images match nowhere'}"


def fuse_with_progress(
    weights: str, rig: Rig, images: Mapping[str, Tensor], *, device: str = "cpu", **further: Any
) -> Frame:
    """Fuse with weights by name, showing the plan and a bar on the terminal.

    Args:
        weights: name or file of the weights.
        rig: the cameras.
        images: images (c, h, w) by camera.
        device: "cpu", "cuda" or "auto" (the GPU if there is one).
        further: further arguments of `pat.fuse` but `network`, `progress` and `announce`.

    Returns:
        The frame, on the CPU.

    Raises:
        ValueError: as `fuse` and `load_weights`, and for a GPU that is not available.
        TypeError: as `fuse`.
        FileNotFoundError: for unknown weights.
    """
    from ...networks.weights import load_weights
    from ..front import fuse

    where = options.device_of(device)
    network = load_weights(weights).to(where)
    if where != "cpu":
        rig, images = rig.to(where), {name: image.to(where) for name, image in images.items()}
    options.say_when_compiling()
    with options.working_by_plan("fusing") as announce:
        frame = fuse(images, rig, network=network, progress=_numbered, announce=announce, **further)
    return frame.mapped(lambda tensor: tensor.cpu())


def _numbered(tiles: Iterable[Tile], count: int) -> Iterator[Tile]:
    """Tiles, each logged when it begins if there are several."""
    for i, tile in enumerate(tiles, 1):
        if count > 1:
            LOG.info("tile %d of %d", i, count)
        yield tile
