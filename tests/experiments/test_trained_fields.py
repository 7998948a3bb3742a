"""The paper's network trained with each field: arms are where they say, and differ in nothing else."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from arraygeom import Epipolar, pixel_grid
from arraygeom.fields import named_field
from experiments.evaluation.trained_fields import (
    ARMS,
    CONTROL,
    RECIPE,
    Elsewhere,
    Rows,
    Scored,
    TruePosition,
    compare_trained,
    trained_markdown,
)
from pat.lab.evaluation.ablation import sample_photographs
from pat.lab.training.samples import degraded, source_of
from pat.media.images import write_image
from tests.arraygeom.rigs import random_rig

PAIR = random_rig(1).pair("alpha", "beta")
X = pixel_grid(PAIR.alpha.hw, dtype=torch.float64)[::8, ::8].reshape(-1, 2)


def test_arms_are_fields_of_recipes():
    assert all(callable(named_field(name)) for name in ARMS.values())


def test_rows_are_as_long_around_the_same_points():
    exact, rows = Epipolar()(PAIR, X), Rows()(PAIR, X)
    inside = rows.valid & ((rows.length - exact.length).abs() < 1e-6)
    assert inside.float().mean() > 0.2
    assert torch.equal(rows.start[inside][:, 1], rows.end[inside][:, 1])
    assert torch.allclose((rows.start + rows.end)[inside], (exact.start + exact.end)[inside])


def test_segments_elsewhere_are_those_of_other_pixels():
    w = PAIR.alpha.hw[1]
    other = torch.stack([(X[:, 0] + w / 2) % w, X[:, 1]], -1)
    assert torch.equal(Elsewhere()(PAIR, X).start, Epipolar()(PAIR, other).start)


def test_the_true_position_is_known_in_training():
    source = source_of(replace(RECIPE, hw=(32, 48)), sample_photographs(count=1), 0)
    scene = source.layered["general"].sample(2, torch.Generator().manual_seed(0))
    made = degraded(scene, torch.Generator().manual_seed(0), field=TruePosition(), recording=RECIPE.recording)
    segments, seen = made.fields[0].straight, made.visible[0]
    assert (segments.start - made.position[0])[seen & segments.valid].abs().max() < 1e-3
    assert segments.valid[seen].float().mean() > 0.99
    with pytest.raises(ValueError, match="position"):
        TruePosition()(PAIR, X)


def test_differences_are_of_the_same_images():
    rows = [
        Scored(arm, seed, i, i + gain, 9)
        for arm, gain in ((CONTROL, 0), ("rows", -1))
        for seed in (0, 1)
        for i in (0, 5)
    ]
    line = trained_markdown(rows).splitlines()[3]
    assert "-1.00 (-1.00 to -1.00)" in line
    assert line.count("-1.00") == 5


@pytest.mark.slow
def test_every_arm_is_trained_and_scored(tmp_path):
    photos = tmp_path / "photos"  # beside the runs, whose pictures would be photographs too
    photos.mkdir()
    for i in range(24):
        write_image(photos / f"{i}.png", torch.rand(3, 64, 64, generator=torch.Generator().manual_seed(i)))
    recipe = replace(
        RECIPE, photos=(photos,), out=tmp_path / "runs", hw=(32, 48), steps=2, validate=2, warmup=1
    )
    rows, panels = compare_trained(recipe, [0], batches=1)
    assert {row.arm for row in rows} == {*ARMS}
    assert len(panels) == 3 * len(ARMS)
    again, _ = compare_trained(recipe, [0], batches=1)
    assert again == rows
