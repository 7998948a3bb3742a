"""The ablation's rows as a table, as JSON, and as one figure of curves with intervals."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from arraygeom.runtime.atomic import write_text
from arraygeom.viz import new_figure
from pat.lab.evaluation.tables import grouped, markdown_table
from pat.media.figures import save_figure
from pat.support.metrics import bootstrap_interval

from .sweeps import SWEEPS, Row

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MEASURES = {"psnr": ("gain in PSNR, dB", "{:+.2f}"), "peaks": ("peaks within a pixel, %", "{:.1f}")}
"""Label and format of each measure drawn."""


def write_report(rows: Sequence[Row], out: Path) -> None:
    """ablation.md, ablation.json, ablation.svg and ablation.png in a folder."""
    write_text(out / "ablation.md", markdown(rows))
    write_text(out / "ablation.json", json.dumps([_plain(row) for row in rows], indent=0))
    for kind in ("svg", "png"):
        save_figure(curves(rows), out / f"ablation.{kind}")


SHIPPED = Path(__file__).with_name("ablation.json")


def shipped_rows(path: Path = SHIPPED) -> list[Row]:
    """The rows of `python -m experiments sweeps` with the weights that ship, computed once."""
    rows = json.loads(path.read_text(encoding="utf-8"))
    return [Row._make(math.nan if row[k] is None else row[k] for k in Row._fields) for row in rows]


def markdown(rows: Sequence[Row]) -> str:
    """A table for each sweep and measure: fields as lines, values as columns; means over scenes.

    PSNR is against the first field at the first value, scene by scene: scenes differ by more than fields.
    """
    return "\n".join(
        f"#### {sweep}: {SWEEPS[sweep][0] if sweep in SWEEPS else 'rigs'}\n\n{_tables(own)}"
        for sweep, own in grouped(rows, "sweep").items()
    )


def _tables(rows: Sequence[Row]) -> str:
    """The tables of one sweep, and what could not be measured."""
    values, parts = grouped(rows, "value"), []
    for measure, (label, form) in MEASURES.items():
        fields = grouped(rows, "field")
        drawn = {field: [_drawn(rows, field, value, measure) for value in values] for field in fields}
        texts = {
            field: [form.format(np.mean(v)) if v else "" for v in cells] for field, cells in drawn.items()
        }
        lines = [[field, *cells] for field, cells in texts.items()]
        parts.append(markdown_table([label, *(f"{v:g}" for v in values)], lines))
    notes = dict.fromkeys(f"{row.field} at {row.value:g}: {row.note}" for row in rows if row.note)
    return "\n".join(parts) + "".join(f"\n{note}." for note in notes) + "\n" * bool(notes)


def curves(rows: Sequence[Row]) -> Figure:
    """A column a sweep, a row a measure, a curve a field; bars are 95 % intervals of the mean.

    PSNR is drawn as in `markdown`.
    """
    sweeps = grouped(rows, "sweep")
    figure = new_figure(figsize=(3.2 * len(sweeps), 6.0))
    axes = figure.subplots(len(MEASURES), len(sweeps), squeeze=False)
    for line, measure in zip(axes, MEASURES):
        for axis, (sweep, own) in zip(line, sweeps.items()):
            draw_sweep(axis, own, measure)
            axis.set_xlabel(SWEEPS[sweep][0].replace(", ", ",\n") if sweep in SWEEPS else sweep, fontsize=8)
    handles, labels = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=len(labels), frameon=False)
    figure.tight_layout(rect=(0, 0.05, 1, 1))
    return figure


def draw_sweep(axis: Axes, rows: Sequence[Row], measure: str) -> None:
    """Draw the curves of one sweep, a field each, with intervals of 95 %."""
    values = grouped(rows, "value")
    for field in grouped(rows, "field"):
        drawn = {value: _drawn(rows, field, value, measure) for value in values}
        measured = [value for value in values if drawn[value]]
        means = np.array([np.mean(drawn[value]) for value in measured])
        bounds = np.array([bootstrap_interval(drawn[value]) for value in measured]).reshape(-1, 2)
        spread = np.abs(np.nan_to_num(bounds.T - means)) if len(measured) else None
        style: dict[str, Any] = {"marker": "o", "markersize": 3, "capsize": 2, "linewidth": 1}
        axis.errorbar(measured, means, yerr=spread, label=field, **style)
    axis.set_ylabel(MEASURES[measure][0], fontsize=8)
    axis.tick_params(labelsize=8)
    axis.grid(alpha=0.3)


def _drawn(rows: Sequence[Row], field: str, value: float, measure: str) -> list[float]:
    """Return the measure of each scene of one sweep, where there is one: gains in dB, peaks in percent."""
    some = [row for row in rows if (row.field, row.value) == (field, value) and not row.note]
    if measure == "peaks":
        return [100 * row.peaks for row in some]
    first = {row.scene: row.psnr for row in rows if (row.field, row.value) == (rows[0].field, rows[0].value)}
    return [row.psnr - first[row.scene] for row in some if row.scene in first]


def _plain(row: Row) -> dict[str, object]:
    """Seven digits; NaN is no JSON."""
    plain = {k: float(f"{v:.7g}") if isinstance(v, float) else v for k, v in row._asdict().items()}
    return {k: None if v != v else v for k, v in plain.items()}
