"""A rig that fits its images badly says so, wherever it is used."""

import math
import re
import subprocess
import sys

import pytest
import torch

from arraygeom import Link, Pose, Rig
from arraygeom.pixels import shift_matrix
from calib.images import rig_check
from calib.images.depth_change import share_outside
from calib.images.matches import PointMatches, match_cameras
from calib.images.rig_check import find_misfit, misfit_warning, share_unlike
from pat.app.cli.main import main
from pat.media.images import write_image
from tests.arraygeom.rigs import known_by_f
from tests.calib.scenes import rectified_images, rectified_pair, texture, vector


def test_a_rig_that_fits_says_nothing():
    assert misfit_warning(rectified_pair(), rectified_images()) is None


def test_a_drifted_rig_is_named():
    bad = rectified_pair().perturbed({"right.rotation": vector(0.02, 0, 0)})
    found = misfit_warning(bad, rectified_images())
    assert found is not None
    assert 5.5 < float(re.search(r"lie ([\d.]+) px", found)[1]) < 6.6
    assert "`pat rig doctor` says: none of the usual mistakes, but the rig is 6." in found


def test_a_link_of_H_alone_hides_no_misfit_of_another():
    """Its points have no lines that they could be off."""
    bad, images = (
        known_by_f(rectified_pair().perturbed({"right.rotation": vector(0.02, 0, 0)})),
        rectified_images(),
    )
    links = {**bad.links, ("left", "third"): Link.from_homography(shift_matrix(9, 9))}
    rig = bad.with_camera("third", bad["left"]).replace(links=links)
    assert find_misfit(rig, {**images, "third": images["left"].roll(7, -1)}).off > 5


def test_points_behind_the_cameras_and_wrong_units_are_named():
    """Lines stay where they are under both."""
    rig, images = rectified_pair(), rectified_images()
    right = rig["right"]
    for factor in (-1.0, 1000.0):
        pose = Pose(right.R, right.t * factor)
        wrong = rig.with_camera("right", right.replace(cam_from_world=pose)).replace(
            depth=rig.depth or (0.5, 50.0)
        )
        found = find_misfit(wrong, images)
        assert found is not None
        assert found.outside > 0.9
        assert "behind the cameras or outside the depth range" in found.text
        assert found.mistaken
        assert "`pat rig doctor` says: likely mistake: " in found.text


def test_cameras_at_one_position_are_named():
    """All lines are points, and any point lies on them: 0 px say nothing."""
    rig = rectified_pair()
    wrong = rig.with_camera("right", rig["right"].replace(cam_from_world=rig["left"].cam_from_world))
    found = find_misfit(wrong, rectified_images())
    assert found is not None
    assert (
        "`pat rig doctor` says: none of the usual mistakes: the points lie on their lines, but" in found.text
    )
    assert found.text.endswith(
        "'left' and 'right' are at the same position: between them depth has no effect"
    )


def test_cameras_that_are_at_one_place_are_no_misfit():
    """Points without parallax are neither behind the cameras nor a sign of radians."""
    one, image = rectified_pair()["left"], rectified_images()["left"]
    rig = Rig({"left": one, "right": one.crop(0, 6, (one.hw[0], one.hw[1] - 6))})
    assert rig.pair("left", "right").at_one_place
    assert find_misfit(rig, {"left": image, "right": image[..., 6:]}) is None


def test_a_depth_range_without_the_scene_is_named_with_the_scenes_depth():
    rig, images = rectified_pair(), rectified_images()
    for depth, units in ((15.0, 20.0), False), ((200.0, 300.0), True):
        found = find_misfit(rig.replace(depth=depth), images)
        assert found is not None
        assert found.outside > 0.9
        said = re.search(
            r"the depth range excludes the scene, which is ([\d.]+) to ([\d.]+) m away", found.text
        )
        assert said is not None, found.text
        assert 1.5 < float(said[1]) < float(said[2]) < 8
        assert ("metres taken for centimetres" in found.text) == units
        assert "drifted" not in found.text


def test_nothing_is_said_where_nothing_can_be():
    rig, images = rectified_pair(), rectified_images()
    assert misfit_warning(rig, {"left": images["left"]}) is None
    assert misfit_warning(rig, images | {"right": texture(seed=5)}) is None
    assert misfit_warning(rig, images | {"right": torch.zeros(1, 10, 10)}) is None


def test_show_warns(tmp_path, capsys):
    bad, images = rectified_pair().perturbed({"right.rotation": vector(0.02, 0, 0)}), rectified_images()
    for name, image in images.items():
        write_image(tmp_path / f"{name}.png", image)
    bad.save(tmp_path / "rig.yaml")
    files = [f"--image={name}={tmp_path / name}.png" for name in images]
    main(["show", str(tmp_path / "rig.yaml"), *files, "--out", str(tmp_path)])
    assert "badly: 1" in (said := " ".join(capsys.readouterr().err.split()))
    assert "`pat rig doctor` says: none of the usual mistakes" in said


@pytest.mark.parametrize(("off", "sides"), [(0.0, [240]), (0.02, [240, 320])])
def test_images_are_compared_at_full_size_only_where_small_ones_do_not_fit(monkeypatch, off, sides):
    monkeypatch.setattr(rig_check, "ROUGH_SIDE", 240)
    seen = []

    def noted(images):
        seen.append(max(images["left"].shape))
        return match_cameras(images)

    monkeypatch.setattr(rig_check, "match_cameras", noted)
    found = find_misfit(rectified_pair().perturbed({"right.rotation": vector(off, 0, 0)}), rectified_images())
    assert seen == sides
    assert (found is None) == (off == 0)


def test_too_few_points_of_observable_depth_are_no_share():
    points = torch.tensor([[10.0, 20.0], [30.0, 25.0], [50.0, 60.0]], dtype=torch.float64)
    few = {("left", "right"): PointMatches(points, points - 5)}
    assert math.isnan(share_outside(rectified_pair(), few))


def test_what_a_comparison_needs_is_imported_fast():
    """Nor does it take sympy, which `torch.broadcast_shapes` imports, to make a camera."""
    camera = "Camera(K=intrinsics(5.0, (4, 5)), cam_from_world=Pose.identity(), hw=(4, 5))"
    code = f"""
import sys, calib.boards.rig_diff, calib.images.rig_check
from arraygeom import Camera, Pose, intrinsics
assert not {camera}.batch_shape
print(*sys.modules)
"""
    modules = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split()
    assert {"scipy.stats", "scipy.spatial", "kornia", "sympy"}.isdisjoint(modules)


def test_a_depth_map_whose_pixels_match_nothing_is_not_judged():
    """Two betas have points in common, alpha has none with either."""
    rig, images = rectified_pair(), rectified_images()
    rig = rig.with_camera("third", rig["left"])
    images["third"] = texture(tuple(images["left"].shape[-2:]), seed=5)
    assert math.isnan(share_unlike(rig, images, "third", torch.ones(images["left"].shape[-2:]), 0.1))
