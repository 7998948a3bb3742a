"""Ablation: the same scenes for every family; calibrated wins; unsupported families are named."""

import csv
import json
import math

import pytest
import torch

from arraygeom import Distortion, Pair, Rig
from pat.fusion.classical import classical
from pat.lab.evaluation.ablation import (
    ALPHA,
    BETA,
    AblationRow,
    ablate,
    crops,
    disparity,
    families,
    layered_cases,
    markdown,
    point_errors,
    rendered_cases,
)
from pat.lab.synthesis.rendered import RenderedFrame, save_frame
from pat.media.colour import linear_from_srgb
from pat.media.images import read_image
from pat.networks.configs import PATConfig
from pat.networks.paper import PAT
from pat.networks.weights import load_weights
from pat.support.metrics import score

CHOSEN = (
    "calibrated",
    "rectified, warped",
    "rectified assumption",
    "rotated by 1 deg",
    "centre off by 10 px",
    "local 5x5",
    "dense",
)


@pytest.fixture(scope="module")
def case():
    return next(layered_cases(1, hw=(64, 96), seed=3))


def test_cases_are_unrectified_rigs_that_see_the_same_scene(case):
    assert 1 <= case.ratio <= 3
    alpha, beta = case.rig.pair(ALPHA, BETA).cameras
    assert alpha.K[0, 0] / beta.K[0, 0] == pytest.approx(case.ratio)
    baseline = classical(case.rig, case.images, ALPHA, BETA)
    grey = case.images[ALPHA].expand(3, -1, -1)
    assert score(baseline, case.ground_truth).psnr > score(grey, case.ground_truth).psnr + 3


def test_every_family_is_there():
    names = list(families())
    assert names[0] == "calibrated"
    assert {"rectified assumption", "homography + displacement", "nearest voxels", "local 5x5", "dense"} <= {
        *names
    }
    assert sum(name.startswith(("rotated by", "centre off")) for name in names) == 6


def test_perturbed_rigs_are_off_by_what_they_say(case):
    """Seen by the middle ray: degrees between the axes, pixels between the points."""
    all_families, g = families(), torch.Generator().manual_seed(0)
    beta = case.rig[BETA]
    for degrees in (0.1, 0.3, 1.0):
        moved = all_families[f"rotated by {degrees:g} deg"].assumed(case.rig, g)[BETA]
        chord = (moved.R - beta.R).norm() / 8**0.5
        assert float(2 * chord.asin().rad2deg()) == pytest.approx(degrees, rel=1e-3)
        torch.testing.assert_close(moved.centre, beta.centre)
    for pixels in (1.0, 3.0, 10.0):
        moved = all_families[f"centre off by {pixels:g} px"].assumed(case.rig, g)[BETA]
        assert float((moved.K - beta.K).norm()) == pytest.approx(pixels)


def test_unsupported_families_are_named_and_the_rest_is_ordered(case, tmp_path):
    chosen = {name: family for name, family in families().items() if name in CHOSEN}
    rows = {
        row.family: row for row in ablate(load_weights("mono-colour"), [case], out=tmp_path, chosen=chosen)
    }
    assert rows["local 5x5"].note == rows["dense"].note == ""
    calibrated = rows["calibrated"].psnr
    assert calibrated > rows["rectified assumption"].psnr + 1
    assert rows["rectified, warped"].psnr == pytest.approx(calibrated, abs=1.5)
    assert rows["rectified, warped"].within_one > rows["rectified assumption"].within_one + 0.2
    assert calibrated > rows["rotated by 1 deg"].psnr
    assert calibrated > rows["centre off by 10 px"].psnr
    assert calibrated > rows["alpha alone"].psnr + 2
    with (tmp_path / "ablation.csv").open() as file:
        assert [r["family"] for r in csv.DictReader(file)] == ["alpha alone", "classical", *chosen]
    assert rows["calibrated"].end_point_error < rows["centre off by 10 px"].end_point_error
    assert rows["calibrated"].within_one > rows["rectified assumption"].within_one
    assert "| dense |" in (tmp_path / "ablation.md").read_text()
    assert read_image(tmp_path / "ablation.png").shape[0] == 3


def test_no_scenes_are_refused_and_leave_nothing(tmp_path):
    with pytest.raises(ValueError, match="scenes"):
        ablate(PAT(PATConfig()), [], {}, out=tmp_path)
    assert not list(tmp_path.iterdir())


def test_the_papers_network_supports_every_family(tmp_path):
    case = next(layered_cases(1, hw=(32, 48), seed=1))
    chosen = {name: families()[name] for name in ("calibrated", "nearest voxels", "local 5x5", "dense")}
    rows = ablate(PAT(PATConfig(dim=4)), [case], out=tmp_path, chosen=chosen)
    assert [row.family for row in rows if row.note] == []


def test_rows_are_grouped_by_focal_ratio():
    rows = [AblationRow("a", 1.2, "calibrated", 30.0, 0.9), AblationRow("b", 2.5, "calibrated", 34.0, 0.9)]
    rows += [AblationRow("a", 1.2, "other", 29.0, 0.8), AblationRow("b", 2.5, "other", note="cannot")]
    lines = markdown(rows).splitlines()
    header = "| ratio below 1 | ratio 1 to 1.5 | ratio 1.5 to 2 | ratio from 2 |"
    assert any(header in line for line in lines)
    assert "| calibrated | 32.00 (30.00 to 34.00) | 0.9000 | +0.00 |  | 30.00 |  | 34.00 |  |  |  |" in lines
    assert "| other | 29.00 | 0.8000 | -1.00 |  | 29.00 |  |  |  |  | 1 scene omitted |" in lines
    narrow = AblationRow("c", 0.5, "calibrated", 31.0, 0.9)
    assert (
        "| calibrated | 31.00 | 0.9000 | +0.00 | 31.00 |  |  |  |  |  |  |" in markdown([narrow]).splitlines()
    )
    assert markdown([narrow]).startswith(
        "1 scene; the focal ratio is alpha's focal length over beta's. PSNR in dB."
    )
    assert lines[0].startswith("2 scenes; ")
    assert lines[0].endswith("PSNR in dB, behind it a 95% interval.")
    empty = markdown([AblationRow("d", 1.2, "other", note="cannot")]).splitlines()[-1]
    assert empty.count("|") == lines[-1].count("|")


def test_a_figure_that_is_missing_empties_no_column():
    rows = [AblationRow("a", 1.2, "calibrated", note="cannot"), AblationRow("a", 1.2, "other", 29.0, 0.8)]
    rows += [
        AblationRow("b", 2.5, "calibrated", 34.0, 0.9),
        AblationRow("b", 2.5, "other", 33.0, 0.8, 1.5, 0.4),
    ]
    (line,) = [line for line in markdown(rows).splitlines() if line.startswith("| other")]
    assert "| -1.00 |" in line
    assert "| 1.50 | 40.0% |" in line
    assert "nan" not in markdown(rows[:2])


@pytest.mark.parametrize(("k1", "off"), [(1e-7, 0.01), (-0.2, 0.2)])
@pytest.mark.parametrize("equal_resolution", [False, True])
def test_a_lens_changes_the_largest_displacement_little(case, k1, off, equal_resolution):
    network = PAT(PATConfig(equal_resolution=equal_resolution))
    pair = case.rig.pair(ALPHA, BETA)
    lens = Distortion("brown-conrady", torch.tensor([k1, 0.0, 0.0, 0.0], dtype=torch.float64))
    bent = Pair(*(camera.replace(distortion=lens) for camera in pair.cameras), pair.depth)
    assert disparity(network, bent) == pytest.approx(disparity(network, pair), rel=off)


def test_what_was_not_fused_is_not_in_the_picture(case):
    rows = [AblationRow("a", 1.2, "calibrated", 30.0, 0.9), AblationRow("a", 1.2, "other", note="cannot")]
    found = crops(case, {"calibrated": case.ground_truth}, rows)
    assert [title.split(": ")[1].split("\n")[0] for title in found] == ["ground truth", "calibrated"]


def test_the_true_depth_has_no_error(case):
    assert point_errors(case, case.depth) == (0, 1)
    error, within = point_errors(case, torch.full_like(case.depth, torch.nan))
    assert math.isnan(error)
    assert math.isnan(within)
    assert point_errors(case, case.depth * 1.05)[0] > 0.1


def test_rendered_folders(tmp_path, case):
    """Folders as a renderer leaves them, with the images of a layered scene."""
    folder = tmp_path / "scenes" / "one"
    folder.mkdir(parents=True)
    with pytest.raises(ValueError, match=r"rendered[^/]*$"):
        rendered_cases(tmp_path)
    case.rig.save(folder / "rig.yaml")
    images = {ALPHA: case.ground_truth, BETA: case.images[BETA]}
    for name, image in images.items():
        linear = linear_from_srgb(image)
        index = torch.ones(image.shape[1:], dtype=torch.long)
        save_frame(folder / f"{name}.npz", RenderedFrame(time=0.0, rgb=linear, depth=case.depth, index=index))
    frames = {name: [{"file": f"{name}.npz", "time": 0.0}] for name in images}
    (folder / "render.json").write_text(json.dumps({"frames": frames}))
    (read,) = rendered_cases(tmp_path)
    assert (read.ground_truth - case.ground_truth).abs().max() < 2e-3
    assert read.ratio == pytest.approx(case.ratio)
    assert torch.equal(read.depth, case.depth)
    nothing = RenderedFrame(time=0.0, rgb=linear, depth=torch.full_like(case.depth, torch.inf), index=index)
    save_frame(folder / f"{ALPHA}.npz", nothing)
    with pytest.raises(ValueError, match="one: "):
        next(rendered_cases(tmp_path))
    (folder / f"{ALPHA}.npz").write_bytes(b"PK")
    with pytest.raises(ValueError, match="one: "):
        next(rendered_cases(tmp_path))
    Rig({BETA: case.rig[BETA]}).save(folder / "rig.yaml")
    with pytest.raises(ValueError, match="one: "):
        next(rendered_cases(tmp_path))
    (tmp_path / "scenes" / "two").mkdir()
    with pytest.raises(ValueError, match=r"two.*render.json"):
        rendered_cases(tmp_path)
