"""Explanations of matched points: one homography against epipolar lines."""

import pytest
import torch

from arraygeom import (
    Camera,
    Distortion,
    Link,
    Pair,
    Pose,
    Rig,
    View,
    epipolar_lines,
    intrinsics,
    rotation_from_vector,
)
from arraygeom.runtime.text import ASSUMED, OPEN, UNSCALED
from calib.images.doctor import diagnose_matches
from calib.images.explanations import explain
from calib.images.from_images import rig_from_images
from calib.images.matches import PointMatches, fit_fundamental
from calib.images.refinement import refine_matches
from pat.app.cli.main import main
from pat.app.results import save_frame, view_of
from pat.fusion.frame import Frame
from pat.media.images import write_image
from tests.calib.scenes import HW, rectified_pair, seen_points, vector

VGA = (480, 640)


def points_of(depth, *, t=(-0.1, 0.0, 0.0), turn=(0, 0.05, 0.02), focal=600.0, noise=0.3, seed=0, count=150):
    """Points matched between two cameras: pixels of the first, their depths by a function of the rays."""
    g = torch.Generator().manual_seed(seed)
    K, K_beta = (intrinsics(f, VGA).double() for f in (600.0, focal))
    x = torch.rand(count, 2, generator=g).double() * vector(600, 440) + 20
    rays = torch.cat([x, torch.ones(count, 1).double()], -1) @ torch.linalg.inv(K).T
    X = rays * depth(rays, g)[:, None]
    Y = (X @ rotation_from_vector(vector(*turn)).T + vector(*t)) @ K_beta.T
    y = Y[:, :2] / Y[:, 2:] + noise * torch.randn(count, 2, generator=g).double()
    inside = ((y > 0) & (y < vector(640, 480))).all(-1)
    return PointMatches(x[inside], y[inside])


def wall(rays, g):
    return 3 / (rays @ vector(0.2, 0.1, 1.0))


def room(rays, g):
    return 1.5 + 4 * torch.rand(len(rays), generator=g).double()


def explained(matches):
    return explain(matches, Pair(View(hw=VGA), View(hw=VGA), link=Link(fit_fundamental(matches))))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    "change",
    [
        {"depth": wall},
        {"depth": wall, "count": 3000},
        {"depth": room, "t": (0.0, 0.0, 0.0), "focal": 1100.0},
        {"depth": lambda rays, g: 300 * room(rays, g)},
    ],
    ids=["plane", "plane, many points", "one place, another zoom", "far"],
)
def test_points_of_one_homography_leave_lines_open(change, seed):
    assert not explained(points_of(**change, seed=seed)).has_lines


@pytest.mark.parametrize(("depth", "t"), [(wall, -0.1), (room, 0.0), (lambda *x: 300 * room(*x), -0.1)])
def test_doctor_and_refine_say_what_the_points_leave_open(depth, t):
    """A wall, cameras at one place, a skyline: of a rig that is right, as of one that has turned."""
    R, t = rotation_from_vector(vector(0, 0.05, 0.02)), vector(t, 0.0, 0.0)
    camera = Camera(K=intrinsics(600.0, VGA).double(), cam_from_world=Pose.identity(), hw=VGA)
    rig = Rig({"a": camera, "b": camera.replace(cam_from_world=Pose(R, t if float(t[0]) else t - 0.1))})
    for points, open_ in ((points_of(depth, t=t), True), (points_of(room), False)):
        pairs = {("a", "b"): points}
        turned = rig.perturbed({"b.rotation": vector(0.005, 0, 0)})
        diagnosis = diagnose_matches(turned, {"a": VGA, "b": VGA}, pairs)
        for found in (diagnosis, refine_matches(turned, [pairs])):
            assert bool(found.undetermined) == open_
            assert ("homography" in found.as_text()) == open_


@pytest.mark.parametrize("wrong", [2, 5])
def test_a_few_wrong_matches_make_no_lines(wrong):
    matches = points_of(wall)
    matches.beta[:wrong] += vector(25.0, 3.0) * torch.linspace(-1, 1.5, wrong).double()[:, None]
    assert not explained(matches).has_lines


def test_wrong_matches_along_lines_make_no_lines():
    """Fourteen of 3,000, which the search for points that agree with lines lets through."""
    matches = points_of(wall, count=3000)
    line = epipolar_lines(fit_fundamental(matches), matches.alpha[::200])
    along = torch.stack([-line[:, 1], line[:, 0]], -1) / line[:, :2].norm(dim=-1, keepdim=True)
    matches.beta[::200] += 5 * along
    assert not explained(matches).has_lines


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    "change",
    [{}, {"t": (0.0, 0.0, -0.3)}, {"turn": (0.0, 0.0, 0.0)}, {"focal": 1000.0}],
    ids=["aside", "ahead", "parallel", "another zoom"],
)
def test_depth_makes_lines(change, seed):
    assert explained(points_of(room, **change, seed=seed)).has_lines


def test_a_few_things_before_a_wall_make_lines():
    """DEGENSAC's case: most points are on one plane."""

    def mostly_wall(rays, g):
        return torch.where(torch.arange(len(rays)) % 10 == 0, room(rays, g), wall(rays, g))

    assert explained(points_of(mostly_wall, count=300)).has_lines


def test_lenses_are_no_parallax():
    """Two different lenses at one place have no depth."""
    one = rectified_pair()["left"]
    turned = Pose(rotation_from_vector(vector(0.01, -0.02, 0.03)), torch.zeros(3).double())
    lens = Distortion("brown-conrady", vector(-0.05, 0.01, 0.0, 0.0))
    rig = Rig({"left": one, "right": one.replace(cam_from_world=turned, distortion=lens)})
    (seen,) = seen_points(rig, noise=0.1, near=1.6, far=7.0).values()
    pair = Pair(View(hw=HW), View(hw=HW), link=Link(fit_fundamental(seen)))
    assert float((seen.alpha - seen.beta).norm(dim=-1).median()) > 4
    assert not explain(seen, pair).has_lines


def test_a_rig_of_one_homography_has_it_as_its_map():
    """The case planar_matches: F is arbitrary, its lines may be 34 to 80 degrees wrong, the map is not."""
    images = {name: torch.zeros(1, *VGA) for name in "ab"}
    matches = points_of(wall)
    found = rig_from_images(images, matches={("a", "b"): matches})
    assert found.rig.name == OPEN
    assert "lines and depth" in found.as_text()
    exact = points_of(wall, noise=0.0)
    moved = torch.cat([exact.alpha, torch.ones(len(exact.alpha), 1)], -1) @ found.rig.links["a", "b"].H.T
    assert float((moved[:, :2] / moved[:, 2:] - exact.beta).norm(dim=-1).max()) < 0.5
    assert rig_from_images(images, matches={("a", "b"): points_of(room)}).rig.name != OPEN


def test_the_command_says_that_the_file_is_for_these_images(tmp_path, capsys):
    matches = points_of(wall)
    rows = "\n".join(",".join(map(str, row)) for row in torch.cat(list(matches), -1).tolist())
    (tmp_path / "m.csv").write_text(f"x0,y0,x1,y1\n{rows}\n")
    for name in "ab":
        write_image(tmp_path / f"{name}.png", torch.rand(1, *VGA))
    files = [f"--image={name}={tmp_path / name}.png" for name in "ab"]
    main(["rig", "start", *files, "--matches", str(tmp_path / "m.csv"), "--out", str(tmp_path / "rig.yaml")])
    said = "".join(capsys.readouterr())
    assert OPEN in " ".join(said.split())
    assert not isinstance(Rig.load(tmp_path / "rig.yaml")["a"], Camera)


def test_depth_has_no_bounds_where_focal_lengths_are_assumed(tmp_path):
    """Bounds of depth are not stated as if the focal lengths were known."""
    rig = rectified_pair()
    depth = torch.full((16, 16), 3.0)
    frame = Frame(torch.rand(3, 16, 16), depth, depth / 3, 0.01 * depth)
    for name, bounds in ((UNSCALED, True), (ASSUMED, False)):
        view = view_of(rig.replace(name=name), "left", bits=8)
        written = {path.name for path in save_frame(frame, tmp_path / name[-5:], view=view)}
        assert "depth.tif" in written
        assert ({"depth_nearest.tif", "depth_farthest.tif"} <= written) == bounds
