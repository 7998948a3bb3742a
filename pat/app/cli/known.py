"""Options shared by `pat fuse`, `pat batch`, `pat sequence` and `pat align`."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

from ...media.suffixes import IMAGE_SUFFIXES
from ...support.memory import parse_bytes
from . import options
from .options import Depth, Images, Memory, Name, say
from .parser import Option, UsageError

if TYPE_CHECKING:
    from torch import Tensor

    from arraygeom import Pair, ReceptiveField, Rig

    from ...fusion.fuse import FuseSettings
    from ..from_images import ImageArray

MATCHES_HELP = "Matched points to use: CSV (x0,y0,x1,y1 a line, of two images in order) or a COLMAP database."
MatchesFile = Annotated[Path | None, Option("FILE", MATCHES_HELP)]

NOISE = "NAME=ELECTRONS[,READ]|estimate|none"
NEEDS_RIG = "a calibrated rig for a depth map: give --rig RIG and --depth NEAR FAR"
FRAMES = 5
"""Captures of a flight that its rig is found from."""
OUT_OF_RANGE = 0.9
"""Share of a depth map outside the rig's depth range above which its unit must be wrong."""
UNLIKE = 0.25
"""Share of matched points at other depths above which a depth map is contradicted: at most .01 in seven
Middlebury pairs with their own maps, from .56 with these upside down."""
OFF_LINES = 5.0
"""Median distance in pixels of matched points from the rig's lines above which one of them must be wrong."""


@dataclass
class Known:
    """Base class of commands on an array's images: options on rig, depth, noise and matching.

    Fields are options of the command line, each described beside its name. A subclass defines `run`.

    Raises:
        UsageError: for a --max-memory that is no amount of memory.
    """

    given: Annotated[tuple[Path, ...], Option("RIG|IMAGE IMAGE ...", positional=True)] = ()
    """Rig file of any known format (also: --rig RIG), then images; or, without a rig, an image, a folder or a
    video of each camera."""
    alpha: Name = None
    """The camera whose view is wanted; without a rig, by default the largest grey image."""
    image: Images = ()
    """With a rig: an image of each camera, once each; or NAME=FOLDER, or NAME=PATTERN."""
    depth: Depth = None
    """Near and far bounds in metres, instead of the rig's; far may be inf."""
    misfit: Literal["correct", "warn", "refuse"] = "correct"
    """If matches lie beside the rig's search segments: correct moves these, and warns where images still do
    not fit; warn only warns; refuse corrects, and writes nothing where they still do not fit."""
    response: Annotated[str, Option("fit|rec601|R,G,B")] = "fit"
    """Weights of red, green and blue in a mono alpha; fit finds them from matches, with gain and gamma."""
    match_levels: bool = False
    """Bring each beta to alpha's mean and contrast before matching, for other exposures or filters."""
    noise: Annotated[tuple[str, ...], Option(NOISE, repeat=True)] = ()
    """Denoise in low light: a camera's electrons at white and its read noise in electrons, or estimate. By
    default noise that shows plainly is estimated; none leaves it."""
    max_memory: Memory = None
    """Memory limit of the whole process, such as 4GiB; larger frames are done in tiles."""

    def __post_init__(self) -> None:
        if self.max_memory is None:
            return
        try:
            parse_bytes(self.max_memory)
        except ValueError:
            raise UsageError("--max-memory", "bytes, as 4GiB or 500MB", self.max_memory) from None

    @property
    def correct(self) -> bool:
        """True if the rig is corrected where it does not fit."""
        return self.misfit != "warn"

    def settings(self, *, noise_by_default: bool = False, **further: Any) -> FuseSettings:
        """Make the settings of fusion from the options.

        Args:
            noise_by_default: True to look for noise without --noise.
            further: further fields of the settings.

        Raises:
            ValueError: for invalid options.
        """
        from ...fusion.fuse import FuseSettings

        return FuseSettings(
            max_memory=self.max_memory,
            match_levels=self.match_levels,
            response=options.response_of(self.response),
            noise=options.noise_of(self.noise, by_default=noise_by_default),
            **further,
        )

    @contextmanager
    def judged(self) -> Iterator[None]:
        """Context manager for the command's work, within --max-memory, and for its notes (`note`).

        Raises:
            SystemExit: with status 3, if the work warned (shown as in `main`) that the rig does not fit the
                images; with `--misfit refuse` before that frame is written. Other errors of the work pass.
            ValueError: for invalid options.
        """
        from ...fusion.checks import LowConfidenceWarning, confidence_checked
        from ...support.memory import limited

        self._notes: list[str] = []
        try:
            with limited(self.settings().limit), confidence_checked(strict=self.misfit == "refuse"):
                yield
        except Exception as error:
            if not isinstance(error.__cause__ or error, LowConfidenceWarning):
                raise
            say(f"pat: {error}; not written (--misfit refuse)", style="red")
            sys.exit(LowConfidenceWarning.exit_status)
        if any(isinstance(message, LowConfidenceWarning) for message in options.WARNED):
            sys.exit(LowConfidenceWarning.exit_status)

    def found_array(
        self,
        files: Mapping[str, Sequence[Path]],
        *,
        weights: str | None = None,
        focal: Mapping[str, float] = {},
        matches: Path | None = None,
        flight: bool = False,
    ) -> ImageArray:
        """Find the array from each camera's first image, or from the images of a flight's middle capture.

        Prints what it finds; `match_levels` is set to True if the array needs it.

        Args:
            files: image files by camera, in the order of frames.
            weights: name of the weights; None to choose them by the bands.
            focal: focal lengths in pixels by camera.
            matches: file of matched points; None to match the images.
            flight: True to use other captures too, unless `matches` are given.

        Raises:
            ValueError: as `array_from_images`, and for a memory limit that the images' size exceeds.
            FileNotFoundError: for a missing file, and unknown weights.
        """
        from arraygeom.runtime.image_bytes import image_header

        from ...support.memory import check_limit
        from ..from_images import array_from_images

        count = min(map(len, files.values()))
        # the first frame, then others all over; of a flight, first and last ones may be of the ground
        chosen = dict.fromkeys([count // 2 * flight, *(count * i // FRAMES for i in range(FRAMES) if flight)])
        first, *further = ({name: paths[i] for name, paths in files.items()} for i in chosen)
        headers = [image_header(path.read_bytes()) for path in first.values()]
        check_limit(min((math.prod(header.hw) for header in headers if header), default=0))
        options.say_when_compiling()
        with options.working("finding the rig"):
            array = array_from_images(
                first,
                alpha=self.alpha,
                weights=weights,
                focal=focal,
                matches=matches,
                further=further if matches is None else (),
                say=say,
            )
        if weights is None:
            say(f"network: {array.weights} (--network NAME takes others)")
        self.match_levels |= array.match_levels
        return array

    def note(self, line: str) -> None:
        """Print a line on standard error, and keep it for the page."""
        say(line)
        self._notes.append(line)


class KnownFile(NamedTuple):
    """Parsed value of `--around FILE[,scale=METRES][,tolerance=SHARE]`.

    Attributes:
        path: depth map or matched points.
        scale: metres for each unit of a depth map; None: 1 for floats, 0.001 for whole numbers.
        tolerance: relative error of the depth map; 0 = exact. Of no effect on points, as `scale`.
    """

    path: Path
    scale: float | None = None
    tolerance: float = 0.05

    @classmethod
    def parse(cls, text: str) -> KnownFile:
        """Parse the option's text, in which the path has no comma, and check that the file exists.

        Raises:
            UsageError: for another name than scale and tolerance, a scale of 0 or less, a tolerance below 0,
                and a missing file.
            ValueError: for what is no NAME=NUMBER, and a name given twice.
        """
        path, *parts = text.split(",")
        numbers = options.numbers_by_name(parts, "--around")
        if unknown := numbers.keys() - {"scale", "tolerance"}:
            raise UsageError("--around", "FILE[,scale=METRES][,tolerance=SHARE]", min(unknown))
        known = cls(Path(path), **numbers)
        if known.scale is not None and known.scale <= 0:
            raise UsageError("--around", "a scale of more than 0", known.scale)
        if known.tolerance < 0:
            raise UsageError("--around", "a tolerance of 0 or more", known.tolerance)
        if not known.path.is_file():
            raise UsageError("--around", "an existing depth map, or file of matched points", path)
        return known

    @property
    def is_depth(self) -> bool:
        """True for a depth map, False for matched points."""
        return self.path.suffix.lower() in IMAGE_SUFFIXES | {".pfm"}


@dataclass
class Around(Known):
    """Base class of commands with --around: a file of known depth or matches of one frame.

    Raises:
        UsageError: as `Known`, and as `KnownFile.parse`, which may raise ValueError too.
    """

    around: Annotated[str | None, Option("FILE", also=("--matches", "--depth-map"))] = None
    """Search around known depths or matches only. FILE is a depth map of alpha's pixels (PFM, TIFF, 16-bit
    PNG), or matched points: CSV with x0,y0,x1,y1 a line, of two images in order, or a COLMAP database.
    Without a rig, matched points determine it; ten are enough to lay one image on the other. For a depth map,
    FILE,scale=METRES is the length of one unit (by default 1 for floats, .001 for whole numbers) and
    FILE,tolerance=SHARE its relative error (by default .05; 0 takes it as exact)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.around is not None:
            KnownFile.parse(self.around)

    def found_array(self, files: Mapping[str, Sequence[Path]], **further: Any) -> ImageArray:
        """The array by the matches that are given, if any. Raises UsageError for a depth map."""
        if self.around is None:
            return super().found_array(files, **further)
        known = KnownFile.parse(self.around)
        if known.is_depth:
            raise UsageError("--around", NEEDS_RIG)
        self.around = None
        return super().found_array(files, **further, matches=known.path)

    def with_known(
        self,
        images: Mapping[str, Tensor],
        rig: Rig,
        alpha: str,
        files: Mapping[str, str | Path],
        field: ReceptiveField | None,
    ) -> tuple[Rig, ReceptiveField | Mapping[str, ReceptiveField | None] | None]:
        """Apply --around: restrict the search to known depth or matches.

        Args:
            images: images (c, h, w) by camera.
            rig: rig of the images.
            alpha: name of alpha.
            files: image file of each camera, by whose names matches are found.
            field: field of --field; None for the default.

        Returns:
            The rig (`with_pixels` around matches), and the field: one for all betas around a depth map; one
            for each by name around matches, `field` for a beta without any; `field` itself without --around.

        Raises:
            ValueError: for options that contradict each other, files that cannot be read or do not suit these
                cameras, and an alpha that the rig lacks.
        """
        from arraygeom.rig import with_pixels

        if self.around is None:
            return rig, field
        known = KnownFile.parse(self.around)
        if not known.is_depth:
            rig = with_pixels(rig)
            return rig, _around_matches(known.path, rig, alpha, files, field)
        if field is not None:
            raise UsageError("--field", "no other field beside the depth map of --around")
        return rig, _around_depth(known, images, rig, alpha)


def _around_depth(known: KnownFile, images: Mapping[str, Tensor], rig: Rig, alpha: str) -> ReceptiveField:
    """Field around the depth map, with a warning if matched points contradict it. Raises ValueError for
    depths outside the rig's range."""
    import torch

    from arraygeom import Camera
    from arraygeom.fields import AroundDepth
    from arraygeom.runtime.text import length_unit
    from arraygeom.runtime.warned import warn
    from calib.images.rig_check import share_unlike

    from ...media.depth_maps import read_depth

    view = rig[alpha]
    if not isinstance(view, Camera) or rig.depth is None:
        raise UsageError("--around", NEEDS_RIG)
    depth = read_depth(known.path, hw=view.hw, scale=known.scale)
    near, far = (float(bound) for bound in rig.depth)
    finite = depth[depth.isfinite()]
    if float(((finite < near) | (finite > far)).float().mean()) > OUT_OF_RANGE:
        some = finite[:: len(finite) // 100_000 + 1]  # torch takes quantiles of 2^24 numbers at most
        low, high = some.quantile(torch.tensor([0.05, 0.95])).tolist()
        raise ValueError(
            f"{known.path}: holds {low:.3g} to {high:.3g} m, the rig's depth range is {near:g} to "
            f"{far:g} {length_unit(rig)}: state its unit with --around FILE,scale=METRES, or another range "
            "with --depth"
        )
    off = share_unlike(rig, images, alpha, depth, max(2 * known.tolerance, 0.1))
    if off > UNLIKE:
        warn(
            f"{known.path}: {off:.0%} of the points matched between the images are at other depths: "
            f"is it upright, of '{alpha}', and in the rig's unit?"
        )
    return AroundDepth(depth, known.tolerance, view)


def _around_matches(
    path: Path, rig: Rig, alpha: str, files: Mapping[str, str | Path], field: ReceptiveField | None
) -> Mapping[str, ReceptiveField | None]:
    """Field of each beta, around its matches with alpha if there are any. Raises as `_check_matches`."""
    from arraygeom import LensView
    from arraygeom.fields import AroundMatches

    from ..point_matches import read_matches

    fields = dict.fromkeys(rig.betas(alpha), field)
    for names, points in read_matches(path, files, {name: rig[name].hw for name in files}).items():
        if alpha not in names:
            continue
        (a, b) = (names, points) if names[0] == alpha else (names[::-1], points[::-1])
        view, beta_view = rig[a[0]], rig[a[1]]
        assert isinstance(view, LensView)
        assert isinstance(beta_view, LensView)
        if rig.pair(*a).calibrated:
            _check_matches(path, a, rig.pair(*a), *b)
        fields[a[1]] = AroundMatches.from_points(*b, view.hw, views=(view, beta_view), field=field)
    return fields


def _check_matches(file: Path, names: tuple[str, str], pair: Pair, x: Tensor, x_beta: Tensor) -> None:
    """Warn if the matches (n, 2) of two cameras are far off the lines of their calibrated pair.

    Raises ValueError if most lie behind the cameras.
    """
    from arraygeom import depth_of
    from arraygeom.runtime.warned import warn

    of_pair, found = f"of '{names[0]}' and '{names[1]}'", depth_of(pair, x, x_beta)
    behind = float((~found.valid).float().mean())
    if behind > OUT_OF_RANGE:
        raise ValueError(
            f"{file}: {behind:.0%} of the matches {of_pair} are behind the cameras by the rig: "
            "are its columns in the order of the images?"
        )
    alpha, beta = pair.cameras
    nearest = beta.project(alpha.unproject(x, found.depth)).x
    off = float((nearest - x_beta).norm(dim=-1)[found.valid].median())
    if off > OFF_LINES:
        warn(
            f"{file}: matches {of_pair} lie {off:.0f} px (median) off the lines that the rig allows: "
            "are they of these images, x before y? Else mend the rig: `pat rig doctor`"
        )
