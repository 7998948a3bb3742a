"""The options that `pat fuse` and `pat align` share."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, UseAppendAction, arg

from . import options
from .options import WEIGHTS_HELP, Depth, FieldName, Images, Memory, optional, say

if TYPE_CHECKING:
    from torch import Tensor

    from arraygeom import Pair, ReceptiveField, Rig

    from ...fusion.fuse import FuseSettings
    from ..from_images import ImageArray

MATCHES_HELP = "Matched points to use: CSV (x0,y0,x1,y1 a line, of two images in order) or a COLMAP database."
MatchesFile = Annotated[Path | None, arg(metavar="FILE", help=MATCHES_HELP, help_behavior_hint="")]

NOISE = "NAME=ELECTRONS[,READ]|estimate|none"
OUT_OF_RANGE = 0.9
"""Share of a depth map outside the rig's depth range from which its unit must be wrong."""
OFF_LINES = 5.0
"""Pixels between matched points and the rig's lines in the median from which one of them must be wrong."""


@dataclass
class Known:
    """What `pat fuse` and `pat align` both get: an array, ways to match its images, facts of the scene."""

    given: Annotated[Positional[tuple[Path, ...]], arg(metavar="RIG|IMAGE IMAGE")] = ()
    """Rig file of any known format (also: --rig RIG); or, without, image, folder or video of each camera."""
    alpha: Annotated[str | None, optional("NAME")] = None
    """The camera whose view is wanted; without a rig, by default the largest grey image. Align: also --to."""
    image: Images = ()
    """With a rig: an image of each camera, once each; or NAME=FOLDER, or NAME=PATTERN."""
    depth: Depth = None
    """Near and far bounds in metres, instead of the rig's; far may be inf."""
    depth_map: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Depth of alpha's pixels, of one frame: PFM, TIFF or 16-bit PNG; matches are searched around it."""
    depth_scale: Annotated[float | None, arg(metavar="METRES", help_behavior_hint="")] = None
    """Metres of one unit of --depth-map; by default 1 of floats, and .001 of whole numbers."""
    depth_tolerance: float = 0.05
    """By what share --depth-map may be off; 0 takes it as it is."""
    matches: MatchesFile = None
    weights: Annotated[str | None, arg(metavar="NAME|FILE", help=WEIGHTS_HELP, help_behavior_hint="")] = None
    field: FieldName = "auto"
    max_memory: Memory = None
    """Memory limit of the whole process, such as 4GiB; larger frames are done in tiles."""
    normalise_radiometry: bool = False
    """First bring each beta to alpha's mean, contrast (other exposures, filters). Also: --match-levels."""
    response: Annotated[str, arg(metavar="fit|rec601|R,G,B")] = "fit"
    """How a mono alpha weighs red, green and blue; fit: found from matches, with gain and gamma."""
    noise: UseAppendAction[Annotated[tuple[str, ...], arg(metavar=NOISE)]] = ()
    """Low light: a camera's electrons at white and read noise in electrons, or estimate: views are denoised.
    A frame is by default fused so where an image shows noise plainly."""
    strict: bool = False
    """Write nothing, instead of warning, where the confidence says that the rig does not fit the images."""
    report: bool = True
    """Of a single frame, also write index.html: a page that shows images, confidence and depth."""

    def settings(self, *, noise_by_default: bool = False, **further: Any) -> FuseSettings:
        """How frames are fused. Raises ValueError for options that are none."""
        from ...fusion.fuse import FuseSettings

        of_map = [n for n in ("depth_scale", "depth_tolerance") if getattr(self, n) != getattr(Known, n)]
        if self.depth_map is None and of_map:
            named = ", ".join(f"--{name.replace('_', '-')}" for name in of_map)
            raise ValueError(f"{named}: needs --depth-map")
        return FuseSettings(
            field=options.field_named(self.field),
            max_memory=self.max_memory,
            match_levels=self.normalise_radiometry,
            response=options.response_of(self.response),
            noise=options.noise_of(self.noise, by_default=noise_by_default),
            **further,
        )

    @contextmanager
    def judged(self) -> Iterator[None]:
        """A block of work within --max-memory; exit status 3 if the rig does not fit the images."""
        from ...fusion.checks import LowConfidenceWarning, confidence_checked
        from ...support.memory import limited

        self._notes: list[str] = []
        try:
            with limited(self.settings().limit), confidence_checked(strict=self.strict):
                yield
        except Exception as error:
            if not isinstance(error.__cause__ or error, LowConfidenceWarning):
                raise
            say(f"pat: {error}; not written (--strict)", style="red")
            sys.exit(LowConfidenceWarning.exit_status)
        if any(isinstance(message, LowConfidenceWarning) for message in options.WARNED):
            sys.exit(LowConfidenceWarning.exit_status)

    def with_known(
        self, rig: Rig, alpha: str, files: Mapping[str, str | Path], field: ReceptiveField | None
    ) -> tuple[Rig, ReceptiveField | Mapping[str, ReceptiveField | None] | None]:
        """The rig, and the field around what is known, by beta; `field` if nothing is.

        Raises ValueError for options that do not go together, and for what is not of these cameras.
        """
        from arraygeom.rig import with_pixels

        if self.depth_map is None:
            if self.matches is None:
                return rig, field
            rig = with_pixels(rig)
            return rig, self._around_matches(rig, alpha, files, field)
        if self.matches is not None or field is not None:
            raise ValueError("--depth-map, --matches, --field: each excludes the others: give one of them")
        return rig, self._around_depth(rig, alpha)

    def found_array(self, files: Mapping[str, Sequence[Path]], focal: Mapping[str, float] = {}) -> ImageArray:
        """The array that each camera's first image says, whose weights and levels are then taken."""
        from ..from_images import array_from_images

        first = {name: paths[0] for name, paths in files.items()}
        options.say_when_compiling()
        with options.working("finding the rig"):
            array = array_from_images(first, alpha=self.alpha, weights=self.weights, focal=focal, say=say)
        if self.weights is None:
            say(f"weights: {array.weights} (--weights NAME takes others)")
        self.weights = array.weights
        self.normalise_radiometry |= array.match_levels
        return array

    def note(self, line: str) -> None:
        """Say a line, and keep it for the page."""
        say(line)
        self._notes.append(line)

    def refuse_several(self) -> None:
        """Raise ValueError if something is known, which is of a single frame."""
        if self.depth_map is not None or self.matches is not None:
            raise ValueError("--depth-map, --matches: for a single frame only: give one image of each camera")

    def _around_depth(self, rig: Rig, alpha: str) -> ReceptiveField:
        """The field around the depth map. Raises ValueError for depths outside the rig's range."""
        import torch

        from arraygeom import Camera
        from arraygeom.fields import AroundDepth
        from arraygeom.runtime.text import length_unit

        from ...media.depth_maps import read_depth

        view = rig[alpha]
        if not isinstance(view, Camera) or rig.depth is None:
            raise ValueError("--depth-map: needs a calibrated rig: give --rig RIG and --depth NEAR FAR")
        assert self.depth_map is not None
        depth = read_depth(self.depth_map, hw=view.hw, scale=self.depth_scale)
        near, far = (float(bound) for bound in rig.depth)
        finite = depth[depth.isfinite()]
        if float(((finite < near) | (finite > far)).float().mean()) > OUT_OF_RANGE:
            some = finite[:: len(finite) // 100_000 + 1]  # torch takes quantiles of 2^24 numbers at most
            low, high = some.quantile(torch.tensor([0.05, 0.95])).tolist()
            raise ValueError(
                f"{self.depth_map}: holds {low:.3g} to {high:.3g} m, the rig's depth range is {near:g} to "
                f"{far:g} {length_unit(rig)}: state its unit with --depth-scale, or another range with "
                "--depth"
            )
        return AroundDepth(depth, self.depth_tolerance, view)

    def _around_matches(
        self, rig: Rig, alpha: str, files: Mapping[str, str | Path], field: ReceptiveField | None
    ) -> Mapping[str, ReceptiveField | None]:
        """Each beta's field: around its matches with alpha, if it has some. Raises as `_check_matches`."""
        from arraygeom import LensView
        from arraygeom.fields import AroundMatches
        from arraygeom.io.point_matches import read_matches

        assert self.matches is not None
        fields = dict.fromkeys(rig.betas(alpha), field)
        matches = read_matches(self.matches, files, {name: rig[name].hw for name in files})
        for names, points in matches.items():
            if alpha not in names:
                continue
            (a, b) = (names, points) if names[0] == alpha else (names[::-1], points[::-1])
            alpha_view, beta_view = rig[a[0]], rig[a[1]]
            assert isinstance(alpha_view, LensView)
            assert isinstance(beta_view, LensView)
            if rig.pair(*a).calibrated:
                _check_matches(self.matches, a, rig.pair(*a), *b)
            fields[a[1]] = AroundMatches.from_points(
                *b, alpha_view.hw, views=(alpha_view, beta_view), field=field
            )
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
