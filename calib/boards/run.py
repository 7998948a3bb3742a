"""Calibration from a folder of images to files, and a page of guidance while images are taken."""

from __future__ import annotations

import glob
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Literal, NamedTuple

from arraygeom import Rig
from arraygeom.pair import depth_range
from arraygeom.runtime.atomic import write_text
from arraygeom.runtime.together import refuse_others, sweep, write_together

from .adequacy import coverage_advice
from .board import Board
from .detect import DetectedImage, Progress, board_views, collect_folder, detected
from .intrinsics import Lens
from .photos import FrameKey, Photos, find_photos
from .poses import StartDeviations
from .report import by_cameras, html_page, report_html, summary, verdict
from .rig import calibrate
from .target import parse_boards
from .uncertainty import rig_covariance
from .validation import compare_lenses

REFRESH = '<meta http-equiv="refresh" content="2">'
"""HTML that loads a page again every two seconds."""


class CalibrationOutput(NamedTuple):
    """Output of a calibration from a folder of images.

    Attributes:
        messages: verdict (of two cameras and more), summary, and notes, which may name cameras.
        written: paths of the files written: report, covariance if there is one, rig.
    """

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
    """Calibrate from a folder of images, and write a rig file with its HTML report.

    A covariance file is written too if the parameters are observable.

    Args:
        photos: folder of images; see `find_photos`.
        board: board as text (see `parse_board`), or several that may be in the images at once.
        out: rig file (.yaml); the others get its name with other suffixes. All appear together.
        patterns: file name patterns by camera; None derives cameras from folders or names.
        lens: lens model; "auto" (not with a start) chooses for each camera the model that its images
            support. With a start, for its pinholes alone: others keep their kind of lens.
        depth: depth range of the rig, metres; None keeps the start's, if there is one.
        start: file of a rig known to within `deviations`; one image of each camera is then enough, such as a
            file named like the camera. None for none.
        deviations: standard deviations about the start; None for the defaults.
        progress: function that shows progress, as `collect_folder` takes it; None for none.

    Returns:
        Messages and files.

    Raises:
        FileNotFoundError: for a missing folder, start or board file.
        ValueError: for unusable images, boards, start and options, and as `calibrate`; nothing is written.
        cv2.error: as `calibrate`.
        FileExistsError: for a report or covariance in the way that no run wrote, or that changed since.
        OSError: if files cannot be read or written.
    """
    if out.suffix.lower() not in (".yaml", ".yml"):
        raise ValueError(f"{out}: a rig file's name ends in .yaml")
    if depth is not None:
        depth_range(*depth)
    written = [out.with_suffix(".html"), out.with_suffix(".covariance.json"), out]
    sweep(out.parent, out.name)
    refuse_others(out.parent, [path.name for path in written[:2]], group=out.name)
    target = parse_boards([board] if isinstance(board, str) else board)
    nominal = None if start is None else Rig.load(start)
    if nominal is not None:
        if lens == "auto":
            raise ValueError("lens: auto compares lenses on held-out frames: with a start name one")
        named = {name: f"{glob.escape(name)}.*" for name in nominal.names}
        if not patterns and all(any(photos.glob(pattern)) for pattern in named.values()):
            patterns = named  # a file called like each camera
    collected = collect_folder(photos, target, patterns=patterns, progress=progress)
    comparisons = compare_lenses(collected.views, target) if lens == "auto" else {}
    chosen = {name: comparisons[name].advised if lens == "auto" else lens for name in collected.views}
    calibration = calibrate(collected.views, target, lens=chosen, start=nominal, deviations=deviations)
    lenses = [f"{name}: {c.advice}" for name, c in comparisons.items()]
    stated = depth if depth is not None or nominal is None else nominal.depth
    rig = calibration.rig.replace(depth=stated, name=out.stem)
    notes = by_cameras([*lenses, *collected.notes, *calibration.notes, *coverage_advice(calibration)])
    title = f"Calibration of {out.name}"
    report = report_html(
        calibration, title=title, notes=notes, detected=collected.views, photos=collected.photos
    )
    covariance = rig_covariance(calibration.fit)
    with write_together(out.parent, group=out.name, last=out.name, given=[out.name]) as folder:
        write_text(folder / written[0].name, report)
        if covariance is not None:
            covariance.save(folder / written[1].name, rig)
        rig.save(folder / out.name)
    return CalibrationOutput(
        [*filter(None, [verdict(calibration)]), summary(calibration), *notes],
        [path for path in written if path.exists()],
    )


# While images are taken -------------------------------------------------------------------------------------


def watch(
    folder: Path,
    board: Board,
    page: Path,
    *,
    patterns: Mapping[str, str] | None = None,
    lens: Lens = "brown-conrady",
    interval: float = 1.0,
    finished: Callable[[], bool] = lambda: False,
) -> dict[tuple[str, FrameKey], DetectedImage]:
    """Calibrate again and write a page whenever images arrive in a folder, until `finished` or Ctrl-C.

    The page is the calibration's report, with what is missing and the views that would help most; while there
    is none, or an image cannot be read, it says where the board was found and what is wrong. Such images are
    tried again; others are read once, even if replaced.

    Args:
        page: HTML file to write.
        patterns: file name patterns by camera; None derives cameras from folders or names.
        lens: lens model of all cameras.
        interval: seconds between looks at the folder.
        finished: function that returns True to stop.

    Returns:
        Size and detections of each image, by camera and moment, once `finished`; also of files that are gone,
        which the page leaves out.

    Raises:
        OSError: if the page cannot be written, or the folder is missing or cannot be read.
        cv2.error: as `calibrate`.
        KeyboardInterrupt: for Ctrl-C.
    """
    seen: dict[tuple[str, FrameKey], DetectedImage] = {}
    shown: tuple[int, str] | None = None
    photos: Photos = {}
    problem = "waiting for images"
    while True:
        if (state := (len(seen), problem)) != shown:
            shown = state
            found = {
                name: {key: seen[name, key] for key in moments if (name, key) in seen}
                for name, moments in photos.items()
            }
            notes = [
                f"{name}: the board is in {sum(bool(boards) for _, boards in images.values())} of "
                f"{len(images)} images"
                for name, images in found.items()
            ]
            write_text(page, _page([*notes, problem]))  # at once, before the calibration
            if found and not problem:
                write_text(page, _calibrated_page(found, photos, board, lens, notes))
        if finished():
            return seen
        time.sleep(interval)
        try:
            photos, problem = find_photos(folder, patterns=patterns), ""
        except ValueError as error:
            photos, problem = {}, str(error)
        for name, key in [(name, key) for name, moments in photos.items() for key in moments]:
            if (name, key) not in seen:
                try:
                    seen[name, key] = detected(photos[name][key], key, board)
                except (ValueError, OSError) as error:  # still being written, or renamed: tried again
                    problem = str(error)


def _page(notes: Iterable[str]) -> str:
    parts = [f'<p class="note">{escape(note)}</p>' for note in filter(None, notes)]
    return html_page(["<h1>Calibration</h1>", *parts], "Calibration", REFRESH)


def _calibrated_page(
    found: Mapping[str, Mapping[FrameKey, DetectedImage]],
    photos: Photos,
    board: Board,
    lens: Lens,
    notes: Sequence[str],
) -> str:
    """Report of a calibration with all detections; a page that says why there is none yet."""
    try:
        views = {name: board_views(name, photos[name], images) for name, images in found.items() if images}
        calibration = calibrate(views, board, lens=lens)
    except ValueError as error:
        return _page([*notes, str(error)])
    notes = by_cameras([*notes, *calibration.notes, *coverage_advice(calibration, always=True)])
    return report_html(calibration, notes=notes, further=REFRESH)
