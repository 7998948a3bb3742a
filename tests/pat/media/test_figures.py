"""Panels of images side by side."""

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from pat.media.figures import GAP, TITLE, colour_depth, draw_panels, save_figure


@pytest.mark.parametrize("factor", [0.5, 4.0], ids=["reduced", "enlarged"])
def test_panels_keep_their_shape_and_stand_row_by_row(factor):
    wide = round(110 * 4.0) // 2 - GAP
    h, w = round(wide / factor) // 2, round(wide / factor)
    (red, green), grey = torch.zeros(2, 3, h, w), torch.full((1, h, h), 0.5)
    red[0], green[1] = 1, 1
    drawn = draw_panels({"a": red, "b": green, "square": grey}, columns=2, width=4.0)
    high = round(wide * h / w)
    rows = [TITLE + high // 2 + i * (TITLE + high) for i in range(2)]
    middles = [GAP // 2 + wide // 2 + i * (wide + GAP) for i in range(2)]
    assert drawn.size == (2 * (wide + GAP), 2 * (TITLE + high) + GAP)
    assert drawn.getpixel((middles[0], rows[0])) == (255, 0, 0)
    assert drawn.getpixel((middles[1], rows[0])) == (0, 255, 0)
    assert drawn.getpixel((middles[0], rows[1])) == (128, 128, 128)
    assert drawn.getpixel((middles[0] - high // 2 - 4, rows[1])) == (255, 255, 255)
    assert drawn.getpixel((middles[1], rows[1])) == (255, 255, 255)
    title = drawn.crop((0, 0, wide, TITLE)).getextrema()
    assert title[0][0] < 100


def test_long_titles_of_two_lines_stay_above_their_panels():
    white = torch.ones(3, 50, 100)
    drawn = draw_panels({"a title wider than a panel is\n21.3 dB": white, "": white}, columns=2, width=2.0)
    dark = np.asarray(drawn.convert("L")) < 128
    rows, columns = (np.flatnonzero(dark.any(axis)) for axis in (1, 0))
    assert rows.max() < 2 * TITLE
    assert columns.max() < drawn.width // 2


@pytest.mark.parametrize("name", ["figure", "figure.xyz"])
def test_a_figure_of_no_format_is_refused_and_leaves_nothing(name, tmp_path):
    with pytest.raises(ValueError, match=name):
        save_figure(Figure(), tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_a_depth_of_zero_is_unknown_and_changes_no_colour():
    depth = torch.linspace(1.0, 5.0, 200).reshape(10, 20)
    unknown = torch.zeros_like(depth, dtype=torch.bool)
    unknown[:3] = True
    coloured, wanted = (colour_depth(torch.where(unknown, gap, depth)) for gap in (0.0, torch.nan))
    assert torch.equal(coloured, wanted)
