"""Options shared by `pat fuse`, `pat batch` and `pat sequence`, and an array's images with their rig."""

from __future__ import annotations

import filecmp
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple

from ...media.suffixes import IMAGE_SUFFIXES, VIDEO_SUFFIXES
from . import options
from .known import Known
from .options import NETWORK_HELP, FieldName, Numbers, Out, say
from .parser import Option, UsageError

if TYPE_CHECKING:
    from arraygeom import Rig

    from ...fusion.fuse import FuseSettings
    from ...fusion.views import ViewFiles
    from ..from_images import ImageArray

Format = Literal["png", "png8", "png16", "tif", "tif8", "tif16", "tif32", "exr"]
Files = dict[str, list[Path]]


class Recordings(NamedTuple):
    """Images of an array with their rig.

    Attributes:
        rig: rig of the recorded files.
        files: files by camera, in the order of frames.
        alpha: camera whose view is fused.
        found: array found from the first images; None for a given rig.
        rates: frames for each second of videos, by camera; empty for images.
    """

    rig: Rig
    files: Files
    alpha: str
    found: ImageArray | None = None
    rates: Mapping[str, float] = {}

    @property
    def first(self) -> dict[str, Path]:
        """First file of each camera."""
        return {name: paths[0] for name, paths in self.files.items()}


@dataclass
class Fusing(Known):
    """Base class of the commands that fuse: options on images and fusion, and the reading of both.

    Fields are options of the command line, each described beside its name. A subclass defines `run`.
    """

    focal: Numbers = ()
    """Without a rig: the focal length in pixels of a camera whose file does not state it."""
    out: Out = Path("out")
    """Folder for the results."""
    network: Annotated[str | None, Option("NAME|FILE", NETWORK_HELP)] = None
    field: FieldName = "auto"
    luminance: Literal["alpha", "recorded", "mix", "beta"] = "alpha"
    """Whose brightness the fused image has: alpha's, denoised where it is noisy, or as recorded; beta's, in
    alpha's detail, suits a near infrared alpha; or a mix."""
    format: Format = "png"
    """Format of the fused image and bits a channel: by default 16 if an image has more than 8; tif32 and exr
    hold linear light as floats."""

    takes_videos: ClassVar[bool] = False

    @property
    def kind(self) -> Literal["png", "tif", "exr"]:
        """Format without bits."""
        return self.format[:3]  # type: ignore[return-value]

    def fuse_settings(self, **further: Any) -> FuseSettings:
        """Make the settings of fusion from the options.

        Args:
            further: further fields of the settings, or `noise_by_default` of `settings`.

        Raises:
            ValueError: for invalid options, and as `field_named`.
        """
        return self.settings(
            field=options.field_named(self.field),
            align=self.correct,
            keep_alpha=self.luminance == "recorded",
            luminance="alpha" if self.luminance == "recorded" else self.luminance,
            **further,
        )

    def frames(self, files: Files) -> Files:
        """Select and order the files of the frames to fuse.

        Raises:
            ValueError: for files that cannot be matched to frames.
        """
        from ..frame_matching import matched_frames

        return matched_frames(files)

    def timed(self, rig: Rig) -> Rig:
        """Return the rig with the command line's clocks; here unchanged."""
        return rig

    def named(self, command: str) -> tuple[tuple[str, ...], bool]:
        """Split the arguments into a rig and its images.

        Args:
            command: name of the command, for messages.

        Returns:
            Images NAME=FILE of the rig's cameras, and True; or no images, and False without a rig.

        Raises:
            ValueError: as `named_images`, and for a format whose extra is not installed.
            FileNotFoundError: as `named_images`.
        """
        if self.kind == "exr":
            from ...media.images import exr_writer

            exr_writer(self.out)
        return named_images(self.given, self.image, command)

    @contextmanager
    def recordings(self, image: Sequence[str], *, with_rig: bool) -> Iterator[Recordings]:
        """Context manager that yields the images with the given rig or one found.

        Sets `bits`, and `network` if none was named (with a rig only where the default does not suit);
        without a rig also the options that the array found asks for. Frames of videos exist within the block
        only.

        Args:
            image: images NAME=FILE, as `named` returns them.
            with_rig: True if a rig is given, False to find one from the images.

        Raises:
            ValueError: for options that contradict each other, before images are read, and a rig, images or
                videos that cannot be used.
            FileNotFoundError: for a missing file; for unknown weights too where a rig is sought by matching.
        """
        self.fuse_settings()
        if with_rig:
            yield self._with_rig(image)
            return
        with TemporaryDirectory() as folder:
            yield self._without_rig(Path(folder))

    def _with_rig(self, image: Sequence[str]) -> Recordings:
        """Images of the given rig."""
        if self.focal:
            raise UsageError("--focal", "no rig, which states focal lengths: leave it out")
        rig = self.timed(options.load_rig(self.given[0], self.depth, or_image=True))
        alpha, files = files_by_camera(rig, self.alpha, self.given, image)
        files = self._checked(files)
        self._choose_weights(rig, alpha, {name: paths[0] for name, paths in files.items()})
        return Recordings(rig, files, alpha)

    def _without_rig(self, folder: Path) -> Recordings:
        """Images with the rig found from the first ones; frames of videos go to a folder."""
        from ...support.locks import folder_lock
        from ..batch import find_images
        from ..from_images import camera_names, video_frames

        if self.depth:
            raise UsageError("--depth", "a rig: give one with --rig RIG")
        with folder_lock(self.out):  # finding the rig takes long: what cannot be written to is refused before
            pass
        cameras = camera_names(self.given)
        focal = options.numbers_by_name(self.focal, "--focal")
        noise = options.noise_of(self.noise)
        for option, named in {"--focal": focal, "--noise": noise if isinstance(noise, dict) else {}}.items():
            if unknown := named.keys() - cameras.keys():
                raise UsageError(option, f"a name of the images, {', '.join(cameras)}", min(unknown))
        videos = [path for path in cameras.values() if path.suffix.lower() in VIDEO_SUFFIXES]
        if videos and (others := [path for path in cameras.values() if path not in videos]):
            raise ValueError(f"{videos[0]} is a video and {others[0]} is not: give images alone, or videos")
        files: Files
        rates: Mapping[str, float] = {}
        if videos:
            if not self.takes_videos:
                raise UsageError(f"{videos[0]}", "images; `pat sequence` takes videos")
            files, rates = video_frames(cameras, folder)
        else:
            files = {name: find_images(path) for name, path in cameras.items()}
            refuse_same(files)
        files = self._checked(files)
        array = self.found_array(files, weights=self.network, focal=focal)
        self.network = array.weights
        return Recordings(array.recorded, {n: files[n] for n in array.rig.names}, array.alpha, array, rates)

    def known_files(self) -> list[Path]:
        """Return further files that the options name."""
        return []

    def _checked(self, files: Files) -> Files:
        """Files of the frames. Raises ValueError for files where results would go."""
        from ...media.images import has_many_bits
        from ..results import check_no_result

        images = (path for paths in files.values() for path in paths)
        check_no_result([*self.given, *self.known_files(), *images], self.out)
        files = self.frames(files)
        deep = any(has_many_bits(paths[0]) for paths in files.values())
        stated = self.format.removeprefix(self.kind)
        self.bits = int(stated) if stated else 32 if self.kind == "exr" else 16 if deep else 8
        return files

    def _choose_weights(self, rig: Rig, alpha: str, files: Mapping[str, Path]) -> None:
        """Choose weights for any bands, unless requested otherwise, if no beta is meant to be in colour and
        they do not have three bands in all."""
        from ...fusion.views import ViewFiles
        from ...networks.weights import weights_for

        betas = [name for name in files if name != alpha]
        if self.network or any(rig[name].sensor.response == "rgb" for name in betas):
            return
        views = ViewFiles(rig, files, alpha=alpha)
        bands = [len(views[name]) for name in betas]
        if 3 not in bands and sum(bands) != 3:
            self.network = weights_for(bands)
            say(f"network: {self.network} (--network NAME takes others)")

    def healed(self, views: ViewFiles) -> Rig:
        """Compare the rig with the images, and refine it, or warn, if they contradict it (`checked_rig`).

        Returns:
            The rig of the views, or the refined one, which is then written beside the results too.

        Raises:
            LowConfidenceWarning: for a rig that is wrong, with `--misfit refuse` (within `judged`).
            OSError: if it cannot be written, or a file in its place was written by no run.
        """
        from arraygeom.io.native import write
        from arraygeom.runtime.together import write_listed

        from ..healing import checked_rig
        from ..results import HEALED_RIG

        with options.working("comparing the rig with the images"):
            healed = checked_rig(views, heal=self.correct)
        if healed is None:
            return views.rig
        self.note(healed.text)
        path = self.out / HEALED_RIG
        write_listed(path, write(healed.rig))
        self.note(f"the healed rig: {path}")
        return healed.rig


def with_sensor(rig: Rig, name: str, **changes: float) -> Rig:
    """Return the rig with some entries of a camera's sensor changed."""
    return rig.with_camera(name, rig[name].replace(sensor=replace(rig[name].sensor, **changes)))


def named_images(paths: Sequence[Path], image: Sequence[str], command: str) -> tuple[tuple[str, ...], bool]:
    """Split a command's arguments into a rig and its images. Imports no torch.

    Images that follow a rig belong to the cameras that their names say.

    Args:
        paths: positional arguments.
        image: values of --image.

    Returns:
        Images NAME=FILE, and True if the first argument is taken as a rig, as it always is with `image`; else
        no images, and False.

    Raises:
        ValueError: for fewer than two images without a rig, a rig without images, `image` without a rig, text
            other than NAME=FILE, and a camera named twice.
        FileNotFoundError: for a missing rig file, and without a rig for a missing image; a rig's images are
            not looked for here.
    """
    if paths and (image or is_rig_file(paths[0])):
        named = (*image, *(f"{path}" if is_named(path) else f"{path.stem}={path}" for path in paths[1:]))
        if not named:
            options.refuse_missing(paths[0], rig=False)
            raise ValueError(
                f"{paths[0]}: {options.NO_IMAGE}; if it is a rig, give --alpha NAME, and --image NAME=FILE "
                "for each camera"
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
    """Find the image files of each camera of a rig.

    Args:
        rig: the rig.
        alpha: value of --alpha; None raises.
        paths: positional arguments, the rig's file first.
        image: images NAME=FILE; FILE may be a folder or a pattern.

    Returns:
        Alpha's name, and files by camera, for the cameras in `image` alone; alpha may be missing.

    Raises:
        ValueError: without alpha, for names that the rig lacks or that are given twice, one image given
            twice, and as `find_images`.
        FileNotFoundError: for a FILE that matches no image.
    """
    from ..batch import find_images

    if alpha is None:
        raise ValueError(f"--alpha: give the camera whose view is wanted, one of {', '.join(rig.names)}")
    files = options.files_by_name(image)
    if unknown := [path for path in paths[1:] if path.stem not in rig.names and not is_named(path)]:
        raise ValueError(f"{unknown[0]}: no camera of the rig has its name: give --image NAME={unknown[0]}")
    files_of = {rig.require(name): find_images(path, name=name) for name, path in files.items()}
    refuse_same(files_of)
    return rig.require(alpha), files_of


def refuse_same(files: Mapping[str, Sequence[Path]]) -> None:
    """Check that no two cameras have the same image: their first files are compared byte by byte.

    Raises:
        ValueError: naming both cameras, if they have.
    """
    for (a, (first, *_)), (b, (second, *_)) in combinations(files.items(), 2):
        if first.is_file() and second.is_file() and filecmp.cmp(first, second, shallow=False):
            raise ValueError(f"'{a}' and '{b}' have the same image, {second}: give each camera its own")


def is_named(path: Path) -> bool:
    """Return True for a NAME=FILE in a path's place, whose FILE exists and which is no file itself."""
    _, _, file = f"{path}".partition("=")
    return bool(file) and not path.exists() and (Path(file).exists() or options.is_pattern(file))


def is_rig_file(path: Path) -> bool:
    """Return True for a path meant as a rig: neither folder nor pattern, nor named like an image
    or a video."""
    path = Path(f"{path}".partition("=")[2]) if is_named(path) else path
    suffixes = IMAGE_SUFFIXES | VIDEO_SUFFIXES
    return not (options.is_pattern(path.name) or path.suffix.lower() in suffixes or path.is_dir())
