"""Sweeps of calibration: rigs are off as they say, scenes exact, one's own field runs, reports are read."""

from __future__ import annotations

import json
import math
import xml.etree.ElementTree as ElementTree

import pytest
import torch

from arraygeom import Epipolar, Pose, pixel_grid, rotation_from_vector, sample
from arraygeom.epipolar import epipolar_distance
from experiments.__main__ import Experiments
from experiments.evaluation.sweep_report import markdown, shipped_rows, write_report
from experiments.evaluation.sweeps import (
    ALPHA,
    BETA,
    SWEEPS,
    Resampled,
    Row,
    ablate,
    made,
    point,
    seen_at,
)
from pat.app.cli.main import main
from pat.lab.evaluation.ablation import sample_photographs

HW = (48, 64)


@pytest.fixture(scope="module")
def bank():
    return sample_photographs(count=2)


@pytest.mark.parametrize("sweep", [*SWEEPS])
def test_scenes_are_exact_for_every_rig(sweep, bank):
    """Beta at the true positions is alpha's ground truth where it sees the point, and only there."""
    # Beta's wider view is coarser, and a larger turn of the lens blurs: the first values are enough.
    scene = made(point(sweep, SWEEPS[sweep][1][1], hw=HW).rig, bank, 0)
    seen = sample(scene.images[BETA][None], scene.position[None].float()).values[0]
    off = (seen - scene.ground_truth).abs().mean(0)
    assert scene.visible.float().mean() > 0.5
    assert off[scene.visible].mean() < 0.03
    assert off[scene.visible].mean() < 0.3 * off[~scene.visible].mean()


def test_a_rig_may_stand_anywhere(bank):
    """Scenes are before alpha, not before the world's origin."""
    rig, turn = point("baseline", 12, hw=HW).rig, torch.tensor([0.2, 1.0, -0.1], dtype=torch.float64)
    world = Pose(rotation_from_vector(turn), 3 * turn)
    moved = {n: c.replace(cam_from_world=c.cam_from_world @ world) for n, c in rig.cameras.items()}
    here, there = (made(r, bank, 0) for r in (rig, rig.replace(cameras=moved)))
    torch.testing.assert_close(there.ground_truth, here.ground_truth, atol=1e-3, rtol=0)
    assert (there.visible == here.visible).float().mean() > 0.99


def test_calibrations_are_off_by_what_they_say():
    for degrees in SWEEPS["rotation"][1]:
        given = point("rotation", degrees)
        turn = given.assumed[BETA].R @ given.rig[BETA].R.T
        found = math.degrees(math.acos(min(1.0, (float(turn.trace()) - 1) / 2)))
        assert found == pytest.approx(degrees, abs=2e-6)
        torch.testing.assert_close(given.assumed[BETA].centre, given.rig[BETA].centre)
    for pixels in SWEEPS["principal point"][1]:
        given = point("principal point", pixels)
        assert float((given.assumed[BETA].K - given.rig[BETA].K).norm()) == pytest.approx(pixels)
    for ratio in SWEEPS["focal ratio"][1]:
        rig = point("focal ratio", ratio).rig
        assert float(rig[ALPHA].K[0, 0] / rig[BETA].K[0, 0]) == pytest.approx(ratio)
    ahead = point("ahead", 90).rig[BETA].centre
    torch.testing.assert_close(ahead / ahead.norm(), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))


def test_parallax_is_that_of_the_nearest_points():
    for pixels in SWEEPS["baseline"][1]:
        pair = point("baseline", pixels).rig.pair(ALPHA, BETA)
        alpha, beta = pair.cameras
        far, near = (
            beta.project(alpha.unproject(torch.tensor([64.0, 48.0]).double(), torch.tensor(d).double())).x
            for d in (1e6, 2.0)
        )
        assert float((near - far).norm()) == pytest.approx(pixels, rel=0.1)


def test_ones_own_field_on_ones_own_rig(network, bank):
    class Own:
        def __call__(self, pair, x):
            return Epipolar()(pair, x)

    fields = {"calibrated": Epipolar(), "own": Own()}
    rows = ablate(network, {"mine": point("ahead", 30, hw=HW).rig}, fields, scenes=2, photos=bank)
    assert [(r.sweep, r.field, r.scene) for r in rows] == [
        ("mine", name, scene) for scene in (0, 1) for name in fields
    ]
    for ours, own in zip(rows[::2], rows[1::2]):
        assert (ours.psnr, ours.ssim, ours.peaks) == (own.psnr, own.ssim, own.peaks)
    assert all(0 <= r.peaks <= 1 for r in rows)


def test_ones_own_way_is_given_calibration_and_images(network, bank):
    class Own:
        def fuse(self, network, rig, images):
            return Resampled().fuse(network, rig, images)

    rigs = {"mine": point("baseline", 12, hw=HW).rig}
    ours, own = ablate(network, rigs, {"ours": Resampled(), "own": Own()}, scenes=1, photos=bank)
    assert (ours.psnr, ours.ssim, ours.peaks) == (own.psnr, own.ssim, own.peaks)


def test_what_was_resampled_comes_back(network, bank):
    """A network that returns alpha: its picture survives both resamplings, and so do matches' positions."""

    class Identity:
        betas = 1

        def compare(self, inputs):
            fused, compared = network.compare(inputs)
            return fused._replace(image=inputs.alpha.expand(-1, 3, -1, -1)), compared

    given = point("baseline", 12, hw=HW)
    scene = made(given.rig, bank, 0)
    result = Resampled().fuse(Identity(), given.rig, scene.images)
    inner = (slice(None), slice(6, -6), slice(6, -6))
    assert (result.image[inner] - scene.images[ALPHA].expand(3, -1, -1)[inner]).abs().mean() < 0.02
    pair = given.rig.pair(ALPHA, BETA)
    x = pixel_grid(HW, dtype=torch.float64)
    off = epipolar_distance(pair.fundamental, x[inner[1:]], result.peak[0][inner[1:]])
    assert off.abs().median() < 0.75  # pixels of beta, half a pixel of them by the nearest look-up


def test_a_camera_ahead_cannot_be_rectified_and_the_table_says_so(network, bank):
    rows = ablate(network, [point("ahead", 90, hw=HW)], {"rectified": Resampled()}, scenes=1, photos=bank)
    assert math.isnan(rows[0].psnr)
    assert "motion forwards" in rows[0].note
    assert "rectified at 90: the baseline is nearly along an optical axis" in markdown(rows)


def test_what_beta_does_not_see_is_hidden():
    pair = point("baseline", 24, hw=HW).rig.pair(ALPHA, BETA)
    depth = torch.full(HW, 4.0, dtype=torch.float64)
    _, same = seen_at(pair, depth, depth)
    _, behind = seen_at(pair, depth, depth / 2)
    assert same.float().mean() > 0.5
    assert not behind.any()


def made_up() -> list[Row]:
    return [
        Row(sweep, value, field, scene, 25 + value + scene, 0.9, 0.5, 1.0)
        for sweep in ("rotation", "ahead")
        for value in (0.0, 1.0)
        for field in ("calibrated", "rows")
        for scene in (0, 1)
    ] + [Row("ahead", 1.0, "resampled", 0, note="cannot")]


def test_reports_are_written_and_read_back(tmp_path):
    write_report(made_up(), tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == {
        f"ablation.{kind}" for kind in ("md", "json", "svg", "png")
    }
    back = shipped_rows(tmp_path / "ablation.json")
    assert repr(back) == repr(made_up())
    ElementTree.parse(tmp_path / "ablation.svg")
    assert "| calibrated | +0.00 | +1.00 |" in (tmp_path / "ablation.md").read_text()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--scenes", "0"], "give at least 1"),
        (["--sweeps", "zoom"], "no sweep 'zoom'"),
        (["--without", "all"], "no field 'all'"),
        (["--network", "mono-colour"], "matches without attention"),
    ],
)
def test_the_command_refuses_in_a_line(arguments, words, tmp_path, refusal):
    assert words in refusal("sweeps", *arguments, "--out", tmp_path / "out")


def test_the_command_writes_what_it_says(tmp_path, capsys):
    arguments = ["--sweeps", "ahead", "--without", "dense", "--scenes", "1", "--hw", "48", "64"]
    main(["sweeps", *arguments, "--out", str(tmp_path)], group=Experiments)
    rows = json.loads((tmp_path / "ablation.json").read_text())
    assert {row["field"] for row in rows} == {"calibrated segments", "rectified, warped", "rows", "local 5x5"}
    assert "#### ahead" in capsys.readouterr().out
