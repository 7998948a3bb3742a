"""Calibration of a folder of images to files, and files of boards to print."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from matplotlib import rc_context

from arraygeom.atomic import sweep, write_atomically, write_text, write_together
from arraygeom.rig import depth_range

from .collect import Progress, collect_folder
from .intrinsics import Lens
from .report import coverages, report_html, rig_covariance, summary
from .rig import calibrate
from .target import draw_board, parse_board


class CalibrationOutput(NamedTuple):
    """Messages on the calibration, and the files written."""

    messages: list[str]
    written: list[Path]


def calibrate_photos(
    photos: Path,
    board: str,
    out: Path,
    *,
    patterns: Mapping[str, str] | None = None,
    lens: Lens = "brown-conrady",
    depth: tuple[float, float] | None = None,
    progress: Progress | None = None,
) -> CalibrationOutput:
    """Calibrate from a folder of images; write the rig file, its report and its covariance, the rig last.

    Raises ValueError and OSError for unusable images, and then writes nothing.
    """
    if out.suffix.lower() not in (".yaml", ".yml"):
        raise ValueError(f"{out}: a rig file's name ends in .yaml")
    if depth is not None:
        depth_range(*depth)
    target = parse_board(board)
    found = collect_folder(photos, target, patterns=patterns, progress=progress)
    calibration = calibrate(found.views, target, lens=lens)
    rig = calibration.rig.replace(depth=depth, name=out.stem)
    written = [out.with_suffix(".html"), out.with_suffix(".covariance.json"), out]
    covariance = rig_covariance(calibration)
    sweep(out.parent, out.stem)
    with write_together(out.parent, last=out.name, stale=[path.name for path in written[:2]]) as folder:
        write_text(
            folder / written[0].name, report_html(calibration, title=f"Calibration of {out.name}", notes=found.notes)
        )
        if covariance is not None:
            covariance.save(folder / written[1].name)
        rig.save(folder / out.name)
    advice = [f"{name}: {text}" for name, c in coverages(calibration).items() for text in c.missing]
    messages = [summary(calibration), *found.notes, *calibration.notes, *advice]
    return CalibrationOutput(messages, [path for path in written if path.exists()])


def write_board(board: str, out: Path) -> Path:
    """Write a board as a PDF or SVG of its true size. Raises ValueError for another ending."""
    if out.suffix.lower() not in (".pdf", ".svg"):
        raise ValueError(f"{out}: a board is written as .pdf or .svg, which keep its true size")
    figure = draw_board(parse_board(board))
    with write_atomically(out) as temporary, rc_context({"svg.fonttype": "path"}):
        figure.savefig(temporary)
    return out
