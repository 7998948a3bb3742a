"""`pat align`: brings every camera's own values to the pixels of one camera."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from ...media.suffixes import IMAGE_SUFFIXES
from ...support.folders import check_apart
from . import options
from .fusing import files_by_camera, named_images
from .known import Around
from .options import Out, say
from .parser import Option, UsageError

if TYPE_CHECKING:
    from torch import Tensor

    from arraygeom import Rig

    from ...fusion.align import Aligned


EXTRAS = "page", "npy", "tif", "separate", "none"


@dataclass
class Align(Around):
    """Align an array's images: every camera's own values at the pixels of one, with masks; no fused image.

    Examples:
        pat align IMG_0000_*.TIF
        pat align flight/
        pat align rig.yaml --alpha mono --image mono=a.png --image nir=b.tif --depth 2 20 --out out/

    Values keep their recorded type and bits. Without a rig it is found from the tags of the images, or from
    the images, and written to found_rig.yaml beside the result, unless they determine no lines. A folder of a
    multispectral camera's captures has one rig, found from several. With folders, or quoted patterns, frames
    are aligned one by one, matched by names or by the numbers or times in them.
    """

    headings: ClassVar[Mapping[str, str]] = {
        "the rig, and where to search": "misfit around response match_levels noise",
        "the aligned images": "interpolation confidence fill extras",
        "the machine": "max_memory",
    }

    out: Out = Path("out")
    """Folder for aligned.tif (all bands, with names and wavelengths), NAME_visibility.png (255 seen, 128
    occluded, 0 outside), NAME_confidence.png, NAME_positions.npy, depth.tif, visibility.txt, index.html."""
    interpolation: Literal["nearest", "bilinear", "cubic"] = "bilinear"
    """Interpolation between recorded values; nearest keeps them."""
    confidence: float = 0.5
    """Confidence, 0 to 1, from which a camera counts as seeing a point: lower keeps more, more mistakes."""
    fill: Literal["none", "propagate"] = "none"
    """Pixels a camera does not see: none leaves them without a value, propagate takes the nearest seen."""
    extras: Annotated[str, Option("NAME[,NAME]")] = "page,npy"
    """What is written beside the images: page (index.html, of a single frame); the sub-pixel positions (x, y)
    of alpha's pixels in each camera's image, as npy or tif; none. And separate: a file of each camera,
    NAME.tif, instead of one of all bands."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.confidence <= 1:
            raise UsageError("--confidence", "a number from 0 to 1", f"{self.confidence:g}")

    def run(self) -> None:
        """Align one frame or several, with the given rig or one found from the images.

        Raises:
            UsageError: for invalid options.
            ValueError: for images or a rig that cannot be used.
            FileNotFoundError: for a missing file.
            FileExistsError: for files in the way that no run wrote.
            OSError: if files cannot be written.
            SystemExit: as `judged`.
        """
        flight = self._flight()
        image, with_rig = ((), False) if flight else named_images(self.given, self.image, "align")
        options.writable(self.out, folder=True)
        check_apart(self.out, () if with_rig else filter(Path.is_dir, self.given))
        self.settings()
        self._extras = options.extras_of(self.extras, EXTRAS)
        with self.judged():
            for frame in self._frames_with_rig(image) if with_rig else self._frames_without(flight):
                self._align(frame)

    def _flight(self) -> dict[str, list[Path]]:
        """Files of several captures, in one folder or listed, by band; empty for others."""
        folders = [path for path in self.given if path.is_dir()]
        listed = all(path.is_file() and path.suffix.lower() in IMAGE_SUFFIXES for path in self.given)
        if self.image or not (len(folders) == len(self.given) == 1 or (listed and len(self.given) > 2)):
            return {}
        from ..batch import find_images
        from ..from_images import by_capture

        return by_capture(find_images(folders[0]) if folders else self.given)

    def _frames_with_rig(self, image: tuple[str, ...]) -> Iterator[_Frame]:
        """Frames of the given rig, which is checked against the first one."""
        from ...fusion.views import ViewFiles
        from ..frame_matching import matched_frames
        from ..healing import checked_rig

        rig = options.load_rig(self.given[0], self.depth, or_image=True)
        alpha, files = files_by_camera(rig, self.alpha, self.given, image)
        files = matched_frames(files)
        for i, paths in enumerate(options.by_frame(files)):
            views = ViewFiles(rig, paths, alpha=alpha)
            if i == 0:
                checked_rig(views, heal=False)
            yield _Frame(views.developed, rig, views, paths, alpha, name=_name_of(files, alpha, paths))

    def _frames_without(self, flight: Mapping[str, list[Path]]) -> Iterator[_Frame]:
        """Frames of the rig that is found from the first one, or from a flight's captures."""
        from ...fusion.views import ViewFiles
        from ..batch import find_images
        from ..frame_matching import matched_frames
        from ..from_images import camera_names

        if self.depth:
            raise UsageError("--depth", "a rig: give one with --rig RIG")
        cameras = {} if flight else camera_names(self.given)
        files = flight or matched_frames({name: find_images(path) for name, path in cameras.items()})
        array = self.found_array(files, flight=bool(flight))
        files = {name: files[name] for name in array.rig.names}
        for i, paths in enumerate(options.by_frame(files)):
            again = i or flight
            images = ViewFiles(array.recorded, paths, alpha=array.alpha) if again else array.images
            name = _name_of(files, array.alpha, paths)
            found = array.lasting is not None
            yield _Frame(array.rig, array.recorded, images, paths, array.alpha, array.notes, name, found)

    def _align(self, frame: _Frame) -> None:
        """Align a frame, write its files and print the summary."""
        from arraygeom.io.native import write
        from arraygeom.runtime.together import sweep, write_listed

        from ...support.locks import folder_lock
        from ..aligned_files import RecordedFiles, refuse_to_replace, save_aligned
        from ..results import FOUND_RIG

        begin = time.monotonic()
        options.say_when_compiling()
        with folder_lock(self.out):
            if frame.name and self.around is not None:
                raise UsageError("--around", "a single frame: give one image of each camera")
            sweep(self.out)
            separate = "separate" in self._extras
            refuse_to_replace(self.out, frame.recorded.names, separate=separate, name=frame.name)
            aligned = self._aligned(frame)
            pages = {}
            if "page" in self._extras and not frame.name:
                pages["index.html"] = self._page(aligned, frame, time.monotonic() - begin)
            written = save_aligned(
                aligned,
                self.out,
                separate=separate,
                positions="tif" if "tif" in self._extras else "npy" if "npy" in self._extras else "none",
                name=frame.name,
                keep=frame.files.values(),
                recorded=RecordedFiles(frame.recorded, frame.files),
                pages=pages,
            )
            if frame.rig_found:
                write_listed(self.out / FOUND_RIG, write(frame.recorded))
                written.append(self.out / FOUND_RIG)
        prefix = f"{frame.name}_" if frame.name else ""
        print((self.out / f"{prefix}visibility.txt").read_text(), end="")
        say(f"written to {self.out}: {', '.join(path.name for path in written)}")

    def _aligned(self, frame: _Frame) -> Aligned:
        """Align a frame, with the plan and a bar on the terminal."""
        from ..aligned_files import RecordedFiles
        from ..front import align

        rig, field = self.with_known(frame.images, frame.rig, frame.alpha, frame.files, None)
        with options.working_by_plan(f"aligning {frame.name}".strip()) as announce:
            return align(
                frame.images,
                rig,
                alpha=frame.alpha,
                settings=replace(self.settings(align=self.correct), field=field),
                recorded=RecordedFiles(frame.recorded, frame.files),
                interpolation=self.interpolation,
                min_confidence=self.confidence,
                fill=self.fill,
                explain=lambda line: self.note(f"{frame.name}: {line}" if frame.name else line),
                announce=None if frame.name else announce,
            )

    def _page(self, aligned: Aligned, frame: _Frame, seconds: float) -> str:
        """HTML of index.html."""
        from ..aligned_page import aligned_page
        from ..report import Facts

        texts = [str(message) for message in options.WARNED]
        return aligned_page(aligned, frame.recorded, Facts((*self._notes, *frame.notes), texts, seconds))


@dataclass(frozen=True)
class _Frame:
    """One frame to align: rig of its developed images, rig of its files, and both.

    `rig_found` is True if the rig was found from the images. The name is a prefix of output files; empty for
    a single frame.
    """

    rig: Rig
    recorded: Rig
    images: Mapping[str, Tensor]
    files: Mapping[str, Path]
    alpha: str
    notes: tuple[str, ...] = ()
    name: str = ""
    rig_found: bool = False


def _name_of(files: Mapping[str, Sequence[Path]], alpha: str, paths: Mapping[str, Path]) -> str:
    """Name of a frame among several: alpha's file without suffix; empty for a single frame."""
    return paths[alpha].stem if len(files[alpha]) > 1 else ""
