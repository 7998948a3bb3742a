"""Lenses of cameras known by F alone: found where they distort lines, left out where they do not."""

import functools

import pytest
import torch

from arraygeom import (
    Camera,
    Distortion,
    LensView,
    Link,
    Pose,
    Rig,
    View,
    apply_homography,
    intrinsics,
    resize_matrix,
    rotation_from_vector,
)
from calib.images.doctor import diagnose_matches
from calib.images.lenses import largest_distortion, with_lenses
from calib.images.matches import PointMatches, fit_fundamental, match_cameras, undistort_matches
from calib.images.refinement import Refinement, refine_matches
from calib.images.residuals import line_distances
from experiments.showcase import FAST, FAST_FRAME, SCENE, SLOW_FRAME, published_matrices
from pat.app.cli.main import main
from pat.media.images import read_image
from tests.calib.scenes import seen_points, vector

HW = (480, 640)
NAMES = ("a", "b")


def pair(k1: float) -> Rig:
    turn = rotation_from_vector(torch.deg2rad(vector(1, -6, 2)))
    poses = Pose.identity(), Pose.from_centre(turn, vector(0.5, 0.05, 0.0))
    lens = Distortion("brown-conrady", vector(k1, 0.2 * k1**2, 0, 0))
    cameras = [
        Camera(K=intrinsics(f, HW), cam_from_world=p, hw=HW, distortion=lens)
        for f, p in zip((700, 650), poses)
    ]
    return Rig(dict(zip(NAMES, cameras)))


def lenses(rig: Rig) -> set[str]:
    views = {name: view for name, view in rig.cameras.items() if isinstance(view, LensView)}
    return {name for name, view in views.items() if view.distortion is not None}


def matches(rig, *, count=400, noise=0.05, wrong=True) -> dict[tuple[str, str], PointMatches]:
    """Points at 2 to 7 m, one in twenty wrong."""
    (names, (x, y)), *_ = seen_points(rig, count=count, near=2.0, far=7.0, noise=noise).items()
    if wrong:
        g = torch.Generator().manual_seed(1)
        y[::20] += 4 * torch.randn(len(y), 2, generator=g, dtype=torch.float64)[::20]
    return {names: PointMatches(x, y)}


@functools.cache
def found_by_points() -> tuple[dict[tuple[str, str], PointMatches], Rig, Refinement]:
    """Points, the rig of them with no regard to lenses, and what refining finds."""
    points = matches(pair(-0.25))
    rig = known_by_f(points)
    return points, rig, refine_matches(rig, [points])


def known_by_f(points: dict[tuple[str, str], PointMatches]) -> Rig:
    """Two sizes, and F of the points with no regard to lenses."""
    return Rig({name: View(hw=HW) for name in NAMES}, links={NAMES: Link(fit_fundamental(points[NAMES]))})


def median(rig: Rig, points: dict[tuple[str, str], PointMatches]) -> float:
    return float(line_distances(rig, points).abs().median())


def test_distorted_lines_are_followed(tmp_path):
    exact = matches(pair(-0.25), noise=0.0, wrong=False)
    _, rig, found = found_by_points()
    assert found.accepted
    assert found.held_out[1].median < 0.06 < 0.12 < found.held_out[0].median
    assert median(found.rig, exact) < 0.03 < 0.12 < median(rig, exact)
    assert lenses(found.rig) == set(NAMES)
    assert "F does not fit without lens distortion: a by up to" in found.as_text()
    found.rig.save(tmp_path / "rig.yaml")
    again = Rig.load(tmp_path / "rig.yaml")
    assert torch.allclose(line_distances(again, exact), line_distances(found.rig, exact), atol=1e-9)


def test_a_map_for_fusion_comes_with_the_lens():
    pair_found = found_by_points()[2].rig.pair(*NAMES)
    x, y = undistort_matches(pair_found, matches(pair(-0.25), noise=0.0, wrong=False)[NAMES])
    assert (apply_homography(pair_found.homography, x).x - y).norm(dim=-1).median() < 40
    assert (apply_homography(resize_matrix(HW, HW), x).x - y).norm(dim=-1).median() > 60


def test_no_lens_is_made_up():
    points = matches(pair(0.0))
    found = refine_matches(known_by_f(points), [points])
    assert lenses(found.rig) == set()
    assert median(found.rig, points) < 0.06


def test_a_lens_that_is_known_is_kept_and_improved():
    """A rig with lenses, refined again from other points: nothing is added, and it stays as good."""
    points, _, once = found_by_points()
    bad = once.rig.perturbed({"a.distortion": vector(0.01, 0, 0, 0)})
    again = refine_matches(bad, [points])
    assert again.accepted
    assert any(change.name == "a.distortion" for change in again.changes)
    assert median(again.rig, points) < 0.06 < median(bad, points)


def test_bending_is_what_no_straight_camera_does():
    rig = with_lenses(Rig({n: View(hw=HW) for n in NAMES}, links={NAMES: Link(torch.eye(3).double())}))
    assert float(largest_distortion(rig["a"])) < 1e-6
    view = rig["a"].replace(distortion=Distortion("brown-conrady", vector(0.05, 0, 0, 0)))
    corner = torch.tensor([[0.0, 0.0]], dtype=torch.float64)
    moved = float((view.undistort(corner)[0] - corner).norm())
    assert 0.1 * moved < float(largest_distortion(view)) < 0.7 * moved


def test_the_doctor_takes_lenses_of_uncalibrated_cameras_as_they_are():
    points, _, found = found_by_points()
    diagnosis = diagnose_matches(found.rig, dict.fromkeys(NAMES, HW), points)
    assert diagnosis.healthy
    assert diagnosis.before.off < 0.1


@pytest.mark.slow
def test_the_papers_array_through_the_commands(shared_data, tmp_path, capsys):
    """Published F's are 1.5 to 2 px off; no F fits these images to less than 0.4: their lenses distort."""
    folder = shared_data / "hfr_lfr"
    files = {FAST: folder / SCENE / f"{FAST_FRAME}.png"}
    links = {}
    for name, F in published_matrices(folder / "fundamental_matrices.json").items():
        files[name] = folder / SCENE / f"{name}_{SLOW_FRAME}.png"
        links[FAST, name] = Link(F)
    images = {name: read_image(file) for name, file in files.items()}
    Rig({n: View(hw=tuple(p.shape[1:])) for n, p in images.items()}, links=links).save(
        tmp_path / "published.yaml"
    )
    arguments = [f"--image={name}={file}" for name, file in files.items()]
    better = ["--out", str(tmp_path / "better.yaml")]
    main(["rig", "refine", str(tmp_path / "published.yaml"), *arguments, *better])
    assert "F does not fit without lens distortion" in capsys.readouterr().out
    main(["rig", "start", *arguments, "--out", str(tmp_path / "started.yaml")])
    points = match_cameras(images)
    for file in ("better.yaml", "started.yaml"):
        rig = Rig.load(tmp_path / file)
        assert all(isinstance(rig[name], LensView) for name in files)
        for names in links:
            assert rig.links[names].H is not None
            assert median(rig, {names: points[names]}) < 0.2
