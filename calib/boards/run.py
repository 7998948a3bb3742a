"""Calibration from a folder of images to files, and a page of guidance while images are taken."""

from __future__ import annotations

import base64
import glob
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np

from arraygeom import Rig
from arraygeom.pair import depth_range
from arraygeom.runtime.atomic import write_text
from arraygeom.runtime.together import refuse_others, sweep, write_together

from .adequacy import coverage_advice, coverages, next_views, point_counts
from .board import Board
from .detect import BoardViews, DetectedImage, Detection, Progress, board_views, collect_folder, detected
from .intrinsics import Lens
from .photos import FrameKey, Grey, Photos, find_photos
from .poses import StartDeviations
from .report import by_cameras, html_page, report_html, summary, verdict
from .rig import Calibration, calibrate
from .target import parse_boards
from .uncertainty import intrinsics_of, rig_covariance
from .validation import compare_lenses

WIDTH = 420
"""Width of the images shown, pixels."""
COLOURS = (60, 60, 230), (80, 200, 80)
"""Colours (blue, green, red) of cells without and with points."""


class CalibrationOutput(NamedTuple):
    """Output of a calibration from a folder of images.

    Attributes:
        messages: sentences: verdict, summary and notes.
        written: paths of the files written.
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
        board: board, or several that may be in the images at once, as text.
        out: rig file (.yaml); the others get its name with other suffixes. All appear together.
        patterns: file name patterns by camera; None derives cameras from folders or names.
        lens: lens model; "auto" chooses for each camera the model that its images support.
        depth: depth range of the rig, metres; None keeps the start's, if there is one.
        start: file of a rig known to within `deviations`; one image of each camera is then enough, such as a
            file named like the camera. None for none.
        deviations: standard deviations about the start; None for the defaults.
        progress: function of the iterable of images and their number that yields them, to show progress; None
            for none.

    Returns:
        Messages and files.

    Raises:
        FileNotFoundError: for a missing folder, start or board file.
        ValueError: for unusable images, boards and options; nothing is written.
        OSError: if files cannot be written.
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


@dataclass
class Session:
    """State of a live calibration, repeated while images arrive in a folder.

    Attributes:
        board: the board.
        lens: lens model of all cameras.
        seen: size and detections of each image, by camera and moment.
        calibration: last calibration; None if it failed.
        problem: reason why there is no calibration; empty if there is one.
        photos: images by camera and moment.
    """

    board: Board
    lens: Lens = "brown-conrady"
    seen: dict[tuple[str, FrameKey], DetectedImage] = field(default_factory=dict)
    calibration: Calibration | None = None
    problem: str = "waiting for images"
    photos: Photos = field(default_factory=dict)

    def detect(self, photos: Photos) -> bool:
        """Detect the board in new images; unreadable ones are tried again later.

        Returns:
            True if one could be read.
        """
        fresh = [
            (name, key) for name, moments in photos.items() for key in moments if (name, key) not in self.seen
        ]
        for name, key in fresh:
            try:
                self.seen[name, key] = detected(photos[name][key], key, self.board)
            except ValueError as error:  # still being written: it is tried again
                self.problem = str(error)
        self.photos = photos
        return any(image in self.seen for image in fresh)

    def views(self) -> dict[str, BoardViews]:
        """Combine the detections of all cameras that have images.

        Returns:
            Detections by camera.

        Raises:
            ValueError: if a camera's images differ in size.
        """
        images = {name: self.images(name) for name in self.photos}
        return {
            name: board_views(name, self.photos[name], detections)
            for name, detections in images.items()
            if detections
        }

    def images(self, name: str) -> dict[FrameKey, DetectedImage]:
        """Return a camera's detections by moment, in order of arrival."""
        moments = self.photos[name]
        return {key: detection for (n, key), detection in self.seen.items() if n == name and key in moments}

    def calibrate(self) -> None:
        """Calibrate with all detections; sets `calibration`, or `problem` if that fails."""
        try:
            self.calibration, self.problem = calibrate(self.views(), self.board, lens=self.lens), ""
        except ValueError as error:
            self.calibration, self.problem = None, str(error)


def watch(
    folder: Path,
    board: Board,
    page: Path,
    *,
    patterns: Mapping[str, str] | None = None,
    lens: Lens = "brown-conrady",
    interval: float = 1.0,
    finished: Callable[[], bool] = lambda: False,
) -> Session:
    """Calibrate again and write a page whenever images arrive in a folder, until `finished` or Ctrl-C.

    The page shows detections, coverage, current uncertainty, and the view that would help most.

    Args:
        page: HTML file to write.
        patterns: file name patterns by camera; None derives cameras from folders or names.
        lens: lens model of all cameras.
        interval: seconds between looks at the folder.
        finished: function that returns True to stop.

    Returns:
        The final state.

    Raises:
        OSError: if the page cannot be written, or the folder is missing.
    """
    session, problem = Session(board, lens), ""
    write_text(page, _page(session))
    while not finished():
        before = problem
        try:
            photos, problem = find_photos(folder, patterns=patterns), ""
        except ValueError as error:
            photos, problem = {}, str(error)
        if fresh := session.detect(photos):
            write_text(page, _page(session))  # at once, with the advice of before
        if fresh or problem != before:
            if problem:
                session.problem = problem
            else:
                session.calibrate()
            write_text(page, _page(session))
        time.sleep(interval)
    return session


def _page(session: Session) -> str:
    calibration, notes = session.calibration, [session.problem]
    parts = [f"<h1>{len(session.seen)} images</h1>"]
    if calibration is not None and not session.problem:
        parts.append(f"<p>Reprojection error {calibration.rms:.3f} px, {len(calibration.frames)} frames.</p>")
        notes = list(calibration.notes)
    parts += [_note(note) for note in notes]
    parts += [_camera(session, name) for name in session.photos]
    return html_page(parts, "Calibration", '<meta http-equiv="refresh" content="2">')


def _note(text: str) -> str:
    return f'<p class="note">{escape(text)}</p>'


def _camera(session: Session, name: str) -> str:
    """HTML of one camera: detections, advice, the last image, coverage."""
    images = session.images(name)
    count = sum(bool(boards) for _, boards in images.values())
    parts = [f"<h2>{escape(name)}: the board is in {count} of {len(images)} images</h2>"]
    if session.calibration is not None and name in session.calibration.views:
        parts.append(_advice(session.calibration, name))
    if images:
        last = list(images)[-1]
        shown = _drawn(session.photos[name][last].read(), images[last][1])
        parts.append(f"<table><tr><td>{_picture(shown)}<br>the last: {escape(str(last))}</td>")
        cells = _picture(_coverage(images.values()))
        parts.append(f"<td>{cells}<br>where points were (red: nowhere)</td></tr></table>")
    return "".join(parts)


def _advice(calibration: Calibration, name: str) -> str:
    """HTML of a camera's focal length, the view that would help most, and missing coverage."""
    deviation = calibration.deviations().get(f"{name}.focal.0")
    stated = f" ± {deviation:.2g}" if deviation else ""
    parts = [f"<p>Focal length {float(calibration.rig[name].K[0, 0]):.1f} px{stated}.</p>"]
    covered = coverages(calibration)[name]
    intrinsics = intrinsics_of(calibration.fit, name)
    if len(intrinsics.covariance):
        parts += [
            f"<p><b>Next: {escape(best.text)}</b> (uncertainty of projection {best.before:.2g} px, "
            f"with it {best.after:.2g}).</p>"
            for best in next_views(intrinsics, calibration.board, float(np.mean(covered.depths)), count=1)
        ]
    return "".join([*parts, *map(_note, covered.missing)])


def _drawn(grey: Grey, boards: Mapping[FrameKey, Detection]) -> np.ndarray:
    """Image with its detected points."""
    scale = WIDTH / grey.shape[1]
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    small = cv2.cvtColor(small, cv2.COLOR_GRAY2BGR)
    for detection in boards.values():
        for x, y in (detection.x + 0.5) * scale - 0.5:
            cv2.circle(small, (round(float(x)), round(float(y))), 2, COLOURS[1], -1)
    return small


def _coverage(images: Collection[DetectedImage]) -> np.ndarray:
    """Image of the cells with and without points."""
    h, w = next(hw for hw, _ in images)
    counts = point_counts([d.x for _, boards in images for d in boards.values()], (h, w))
    cells = np.where((counts > 0)[..., None], COLOURS[1], COLOURS[0]).astype(np.uint8)
    return cv2.resize(cells, (WIDTH, round(WIDTH * h / w)), interpolation=cv2.INTER_NEAREST)


def _picture(image: np.ndarray) -> str:
    data = base64.b64encode(cv2.imencode(".jpg", image)[1].tobytes()).decode()
    return f'<img alt="" src="data:image/jpeg;base64,{data}">'
