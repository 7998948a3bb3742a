"""Calibration of a folder of images to files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from glob import escape
from pathlib import Path
from typing import Literal, NamedTuple

from arraygeom import Rig
from arraygeom.atomic import sweep, write_text, write_together
from arraygeom.rig import depth_range

from .adequacy import coverage_advice, coverages
from .detect import Progress, collect_folder
from .intrinsics import Lens, compare_lenses
from .parameters import StartDeviations
from .report import by_cameras, report_html, summary
from .rig import calibrate
from .target import parse_boards
from .uncertainty import rig_covariance


class CalibrationOutput(NamedTuple):
    """Messages on the calibration, and the files written."""

    messages: list[str]
    written: list[Path]


def calibrate_photos(
    photos: Path,
    board: str | Sequence[str],
    out: Path,
    *,
    patterns: Mapping[str, str] | None = None,
    lens: Lens | Literal["auto"] = "brown-conrady",
    depth: tuple[float, float] | None = None,
    start: Path | None = None,
    deviations: StartDeviations | None = None,
    progress: Progress | None = None,
) -> CalibrationOutput:
    """Calibrate from a folder of images; write the rig file, its report and its covariance, the rig last.

    Several boards may be in the images at once. The lens "auto" is, for each camera, the model that its images support.
    `start` is the file of a rig known to within `deviations`: one image of each camera is enough then, such as one
    called like the camera.
    Raises ValueError and OSError for unusable images, and then writes nothing.
    """
    if out.suffix.lower() not in (".yaml", ".yml"):
        raise ValueError(f"{out}: a rig file's name ends in .yaml")
    if depth is not None:
        depth_range(*depth)
    target = parse_boards([board] if isinstance(board, str) else board)
    nominal = None if start is None else Rig.load(start)
    if nominal is not None:
        if lens == "auto":
            raise ValueError("--lens auto compares lenses on held-out frames: with --start name one")
        patterns = patterns or _named_like(photos, nominal)
    found = collect_folder(photos, target, patterns=patterns, progress=progress)
    comparisons = compare_lenses(found.views, target) if lens == "auto" else {}
    chosen = {name: comparisons[name].advised if lens == "auto" else lens for name in found.views}
    calibration = calibrate(found.views, target, lens=chosen, start=nominal, deviations=deviations)
    lenses = [f"{name}: {c.advice}" for name, c in comparisons.items()]
    rig = calibration.rig.replace(depth=depth, name=out.stem)
    written = [out.with_suffix(".html"), out.with_suffix(".covariance.json"), out]
    report = report_html(
        calibration,
        title=f"Calibration of {out.name}",
        notes=[*lenses, *found.notes],
        detected=found.views,
        photos=found.photos,
    )
    covariance = rig_covariance(calibration.fit)
    sweep(out.parent, out.stem)
    with write_together(out.parent, last=out.name, stale=[path.name for path in written[:2]]) as folder:
        write_text(folder / written[0].name, report)
        if covariance is not None:
            covariance.save(folder / written[1].name)
        rig.save(folder / out.name)
    advice = coverage_advice(calibration, coverages(calibration))
    messages = [summary(calibration), *by_cameras([*lenses, *found.notes, *calibration.notes, *advice])]
    return CalibrationOutput(messages, [path for path in written if path.exists()])


def _named_like(folder: Path, rig: Rig) -> dict[str, str] | None:
    """A pattern for each camera if the folder holds a file called like each."""
    patterns = {name: f"{escape(name)}.*" for name in rig.names}
    return patterns if all(any(folder.glob(pattern)) for pattern in patterns.values()) else None
