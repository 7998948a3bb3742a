"""Rigs from images alone."""

import pytest
import torch

from arraygeom import Rig, apply_homography
from calib.images.from_images import rig_from_images
from calib.images.matches import PointMatches, fit_homography
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
    with pytest.raises(ValueError, match="spot"):
        rig_from_images(images, matches=matches((22, 22)))


TILTED = torch.tensor([[0.62, 0.01, -38], [-0.015, 0.63, -42], [-2e-5, 3e-5, 1]], dtype=torch.float64)
"""Homography from a colour camera to a thermal one beside it."""


def clicked(count: int, seed: int, noise: float = 1.0) -> PointMatches:
    """Points clicked by hand in 640x480 and 320x240."""
    generator = torch.Generator().manual_seed(seed)
    alpha = 100 + torch.rand(count, 2, generator=generator).double() * torch.tensor([420.0, 280.0])
    beta = apply_homography(TILTED, alpha).x
    return PointMatches(alpha, beta + noise * torch.randn(count, 2, generator=generator))


@pytest.mark.parametrize("seed", range(5))
def test_ten_clicked_points_are_a_homography(seed):
    """Also with a wrong one among them; and all over the image, not only where points are."""
    points = clicked(10, seed)
    points.beta[3] += torch.tensor([40.0, -25.0])
    corners = torch.tensor([[70.0, 80], [560, 80], [560, 430], [70, 430]], dtype=torch.float64)
    off = apply_homography(fit_homography(points), corners).x - apply_homography(TILTED, corners).x
    assert float(off.norm(dim=-1).max()) < 10


def test_a_few_matches_register_images_that_have_nothing_in_common():
    images = {"colour": texture(seed=1), "thermal": texture(seed=2)}
    found = rig_from_images(images, matches={("colour", "thermal"): clicked(10, 0)}, alpha="thermal")
    pair = found.rig.pair("thermal", "colour")
    assert pair.at_one_place
    x = torch.tensor([[100.0, 100.0]], dtype=torch.float64)
    assert float((apply_homography(pair.homography, apply_homography(TILTED, x).x).x - x).norm()) < 6
    assert "10 of 10" in found.as_text()
    with pytest.raises(ValueError, match="3 points"):
        rig_from_images(images, matches={("colour", "thermal"): clicked(3, 0)})
