"""Rigs from images alone."""

import pytest
import torch

from arraygeom import Rig
from calib.images.from_images import rig_from_images
from calib.images.matches import PointMatches
from calib.images.residuals import line_distances
from pat.app.cli.main import main
from pat.media.images import write_image
from tests.calib.scenes import rectified_images, rectified_pair, seen_points, texture


def test_lines_and_map_come_from_images_alone():
    images = rectified_images()
    found = rig_from_images(images)
    points = seen_points(rectified_pair(), near=3.0, far=5.5, noise=0.0)
    assert line_distances(found.rig, points).abs().median() < 0.5
    assert found.distance["left", "right"] < 0.3
    assert found.rig.pair("left", "right").link.H is not None
    assert 3 < found.fits["left", "right"].displacement < 12


def test_focal_lengths_are_used_where_they_help():
    found = rig_from_images(rectified_images(), focal={"left": 310.0, "right": 290.0})
    points = seen_points(rectified_pair(), near=3.0, far=5.5, noise=0.0)
    assert line_distances(found.rig, points).abs().median() < 0.5


def test_with_an_alpha_only_its_pairs_are_related():
    images = rectified_images()
    shifted = {"middle": images["right"][..., :-8, 6:]}
    found = rig_from_images(images | shifted, alpha="right")
    assert set(found.rig.links) == {("right", "left"), ("right", "middle")}
    assert set(rig_from_images(images | shifted).rig.links) >= {("left", "right"), ("left", "middle")}


def test_bad_input_is_one_clear_line():
    images = rectified_images()
    with pytest.raises(ValueError):
        rig_from_images({"left": images["left"]})
    with pytest.raises(ValueError, match=r"left.*right"):
        rig_from_images(images | {"right": texture(seed=5)})
    with pytest.raises(ValueError, match="middle"):
        rig_from_images(images, focal={"middle": 300.0})


def test_command_line(tmp_path, capsys):
    for name, image in rectified_images().items():
        write_image(tmp_path / f"{name}.png", image)
    files = [f"--image={name}={tmp_path / name}.png" for name in ("left", "right")]
    main(["rig", "start", *files, "--out", str(tmp_path / "rig.yaml")])
    assert "left > right" in capsys.readouterr().out
    assert ("left", "right") in Rig.load(tmp_path / "rig.yaml").links


def test_points_in_one_spot_are_held_out_too():
    """Points of which none is in a square to hold out are split all the same."""
    torch.manual_seed(0)
    images = {name: torch.zeros(1, 240, 320) for name in "ab"}

    def matches(extent):
        alpha = 25 + torch.rand(60, 2).double() * torch.tensor(extent)
        moved = torch.tensor([1.0, 0]) * (10 + 40 * torch.rand(60, 1))
        return {("a", "b"): PointMatches(alpha, alpha + moved + 0.05 * torch.randn(60, 2))}

    assert rig_from_images(images, matches=matches((22, 46))).distance["a", "b"] < 1
    with pytest.raises(ValueError, match="in one spot, so that none can be held out"):
        rig_from_images(images, matches=matches((22, 22)))
