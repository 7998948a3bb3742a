"""Uncertainty of projection, halves of the frames, proposed views, lens models, the watched folder's page."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from arraygeom import Pose, Rig
from calib.boards.adequacy import coverage_advice, next_views, proposed_views
from calib.boards.bundle import camera_jacobian, parameter_names
from calib.boards.intrinsics import board_pose
from calib.boards.report import by_cameras, draw_adequacy, report_html
from calib.boards.rig import calibrate
from calib.boards.run import watch
from calib.boards.simulation import simulate_photos
from calib.boards.solve import misfit_notes
from calib.boards.uncertainty import intrinsics_of, uncertainty
from calib.boards.validation import LensComparison, compare_lenses, half_difference
from tests.calib.board_scenes import BOARD, board_poses, camera, errors_of, see

TRUE = camera(700.0, (480, 640), lens=(-0.2, 0.05, 0.0, 0.0, 0.0))
RATIONAL = (-2.0, 1.5, 0.001, -0.001, 0.05, -1.6, 1.2, 0.1)


@pytest.fixture(scope="module")
def found():
    return calibrate(see(Rig({"cam": TRUE}), board_poses(12, spread=0.4), noise=0.2), BOARD)


def test_a_calibration_is_shown_in_a_few_lines(found):
    """A notebook shows no residuals."""
    assert "Rig" in repr(found)
    assert len(repr(found)) < 1000


def test_lenses_that_there_are_not():
    """They counted as none, without a word."""
    views = see(Rig({"cam": TRUE}), board_poses(4, spread=0.4), noise=0.2)
    with pytest.raises(ValueError, match=r"'cam'.*brown-conrady"):
        calibrate(views, BOARD, lens={"other": "none"})


def test_an_adjustment_that_goes_on_is_said(found):
    """A fit that has not converged is reported."""
    going = "the adjustment has not come to rest"
    for converged in (True, False):
        assert (going in " ".join(misfit_notes(replace(found.fit, converged=converged)))) != converged


def test_projections_are_off_by_what_is_said(found):
    known = intrinsics_of(found.fit, "cam")
    x, deviation = uncertainty(known, 1.5)
    X = known.camera.unproject(torch.from_numpy(x), torch.full((len(x),), 1.5, dtype=torch.float64))
    true = TRUE.replace(cam_from_world=Pose.identity())
    parts = []
    for points in (torch.from_numpy(known.seen), X):
        off = true.project_local(points).x - known.camera.project_local(points).x
        by_pose = camera_jacobian(known.camera, points.numpy())[..., :6].reshape(-1, 6)
        parts.append((off.numpy().ravel(), by_pose))
    (at_boards, pose), (off, by_pose) = parts
    off = off - by_pose @ np.linalg.lstsq(pose, at_boards, rcond=None)[0]
    off = np.linalg.norm(off.reshape(-1, 2), axis=1)
    assert 0.1 < np.median(off / deviation) < 2.5
    assert deviation[0] > np.median(deviation)


def test_points_far_beyond_the_boards_are_less_certain(found):
    """Boards are at 0.9 to 2.4 m: a change of the focal length that they absorb shows at other depths."""
    known = intrinsics_of(found.fit, "cam")
    near, far = (np.median(uncertainty(known, depth)[1]) for depth in (1.5, 15.0))
    assert far > 1.1 * near


def test_halves_are_compared_only_where_boards_were_seen():
    """Boards in the middle of the image: nothing is said of its corners, where the lens is extrapolated."""
    boards = board_poses(10, spread=0.05, depth=(1.6, 2.4))
    fit = calibrate(see(Rig({"cam": TRUE}), boards, noise=0.2), BOARD).fit
    x, _ = half_difference(fit, 1.5)["cam"]
    seen = fit.problem.seen["cam"].x
    assert 20 < len(x) < 200
    assert max(np.linalg.norm(seen - each, axis=1).min() for each in x) < 32


def test_halves_are_compared_only_where_both_saw_boards():
    """Boards to the left in even frames, and to the right in the others, meet in a stripe."""
    boards = board_poses(12, spread=0.1, depth=(1.6, 2.4))
    side = torch.tensor([[-0.3, 0.0, 0.0], [0.3, 0.0, 0.0]], dtype=torch.float64).repeat(6, 1)
    fit = calibrate(see(Rig({"cam": TRUE}), Pose(boards.R, boards.t + side), noise=0.2), BOARD).fit
    x, _ = half_difference(fit, 1.5)["cam"]
    seen, block = fit.problem.seen["cam"].x, fit.problem.seen["cam"].block
    halves = [seen[block % 2 == half] for half in (0, 1)]
    assert len(x) > 5
    assert all(np.linalg.norm(half - each, axis=1).min() < 32 for half in halves for each in x)


def test_a_camera_of_half_the_rate_is_in_one_half_alone():
    """Its boards are all in even frames; the report is made all the same."""
    rig = Rig({"fast": TRUE, "slow": camera(700.0, (480, 640), (0.1, 0.0, 0.0))})
    views = see(rig, board_poses(12, spread=0.2), noise=0.2)
    views["slow"] = views["slow"].only(range(0, 12, 2))
    calibration = calibrate(views, BOARD)
    assert half_difference(calibration.fit, 1.5) == {}
    assert "Adequacy of each camera" in report_html(calibration)


FISHEYES = {
    "kannala-brandt": ("kannala-brandt", (0.02, -0.01, 0.003, -0.001), 240.0),
    "omni": ("unified", (0.9, -0.1, 0.02, 0.0, 0.0), 420.0),
    "double-sphere": ("double-sphere", (-0.2, 0.6), 190.0),
    "extended-unified": ("extended-unified", (0.6, 1.1), 240.0),
    "scaramuzza": ("scaramuzza", (-0.4, 0.05, -0.05), 240.0),
    "thin-prism-fisheye": ("thin-prism-fisheye", (0.02, -0.01, 1e-3, -1e-3, 0.003, -0.001, 1e-3, 0.0), 240.0),
}
"""Model, coefficients and focal length in pixels of some lenses."""


@pytest.mark.parametrize("lens", FISHEYES)
def test_fisheyes_of_each_model_are_found(lens):
    model, coefficients, focal = FISHEYES[lens]
    true = camera(focal, (480, 640), lens=coefficients, model=model)
    boards = board_poses(12, depth=(0.4, 0.9), spread=0.7)
    found = calibrate(see(Rig({"a": true}), boards, noise=0.05), BOARD, lens=lens)
    assert found.rms == pytest.approx(0.05 * 2**0.5, rel=0.1)
    if len(found.fit.names) < 4 + len(coefficients):
        # A double sphere's xi and focal length stand for one another: where a fit ends short, xi is 0.
        assert lens == "double-sphere"
        assert [note for note in found.notes if "xi" in note]
    else:
        deviations = np.sqrt(found.fit.covariance.diagonal())
        assert np.abs(errors_of(found.fit, Rig({"a": true})) / deviations).max() < 4


@pytest.mark.parametrize(
    "lens",
    [
        "double-sphere",
        *(
            pytest.param(lens, marks=pytest.mark.slow)
            for lens in ("omni", "extended-unified", "thin-prism-fisheye")
        ),
    ],
)
def test_one_fisheye_by_another_model(lens):
    model, coefficients, focal = FISHEYES["kannala-brandt"]
    true = camera(focal, (480, 640), lens=coefficients, model=model)
    views = see(Rig({"a": true}), board_poses(10, depth=(0.4, 0.9), spread=0.7), noise=0.05)
    assert calibrate(views, BOARD, lens=lens).rms < 0.12


def test_halves_differ_by_no_more_than_their_uncertainty(found):
    x, off = half_difference(found.fit, 1.5)["cam"]
    _, deviation = uncertainty(intrinsics_of(found.fit, "cam"), 1.5)
    assert len(x) == len(off)
    assert 0.3 < np.median(np.linalg.norm(off, axis=1)) / np.median(deviation) < 6


def test_views_are_proposed_where_they_are_missing():
    """Boards at the left only: the next view is at the right."""
    poses = board_poses(10, spread=0.1, depth=(1.0, 1.4))
    left = Pose(poses.R, poses.t - torch.tensor([0.35, 0.0, 0.0], dtype=torch.float64))
    fit = calibrate(see(Rig({"cam": TRUE}), left, noise=0.1), BOARD).fit
    first, second = next_views(intrinsics_of(fit, "cam"), BOARD, 1.2)
    assert "right, " in first.text
    assert first.after < 0.6 * first.before
    assert second.before == first.after > second.after


def test_tilts_are_named_by_the_edge_that_is_nearer():
    views = proposed_views(TRUE, BOARD)
    edges = {
        "left": BOARD.points[:, 0] == 0,
        "right": BOARD.points[:, 0] == BOARD.points[:, 0].max(),
        "upper": BOARD.points[:, 1] == 0,
        "lower": BOARD.points[:, 1] == BOARD.points[:, 1].max(),
    }
    for text, X in views.items():
        nearest = min(edges, key=lambda edge: X[edges[edge], 2].mean())
        assert text.endswith(f"{nearest} edge nearer")
        side = {"left": X[:, 0].mean() < 0, "right": X[:, 0].mean() > 0}
        assert all(is_there for name, is_there in side.items() if name in text.split(",")[0])


def test_the_simplest_of_equal_lenses_is_advised():
    g = np.random.default_rng(0)
    base = g.uniform(0.9, 1.1, 20)
    brown = base + g.normal(0, 1e-3, 20)
    errors = {"none": 4 * base, "brown-conrady": brown, "rational": base, "tilted": 1.2 * base}
    assert LensComparison(errors).advised == "brown-conrady"
    assert LensComparison({**errors, "rational": 0.8 * base}).advised == "rational"
    assert "brown-conrady 1.0" in LensComparison(errors).advice
    assert "too few frames" in LensComparison({}).advice


def test_a_lens_that_sees_the_board_behind_it_gives_no_pose():
    """One line says so, and the comparison of lenses leaves the model out."""
    seen = next(iter(see(Rig({"cam": TRUE}), board_poses(1), noise=0.2)["cam"].seen.values()))
    wrong = camera(60.0, (480, 640), lens=(0.0, 0.0, 0.0, 0.0), model="kannala-brandt", offset=(1e3, 0.0))
    with pytest.raises(ValueError, match="640x480"):
        board_pose(wrong, seen, BOARD)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lens", "advised"), [((-0.2, 0.05, 0.0, 0.0, 0.0), "brown-conrady"), (RATIONAL, "rational")]
)
def test_the_lens_that_the_images_support_is_advised(lens, advised):
    boards = board_poses(12, seed=3, spread=0.7, depth=(0.6, 1.6))
    views = see(Rig({"c": camera(420.0, (480, 640), lens=lens)}), boards, noise=0.05)
    assert compare_lenses(views, BOARD)["c"].advised == advised


def test_rational_lenses_are_fitted():
    true = camera(420.0, (480, 640), lens=RATIONAL)
    views = see(Rig({"c": true}), board_poses(12, seed=3, spread=0.7, depth=(0.6, 1.6)), noise=0.05)
    rational, brown = (calibrate(views, BOARD, lens=lens) for lens in ("rational", "brown-conrady"))
    assert len(parameter_names(rational.rig["c"])) == 18
    assert rational.rms == pytest.approx(0.05 * 2**0.5, rel=0.1)
    assert brown.rms > 2 * rational.rms


def test_no_board_is_mistaken_for_its_mirror_image_by_a_poor_start():
    """With one radial term a board near the corner can start from the other side; it ends on the
    right one."""
    true = camera(420.0, (480, 640), lens=RATIONAL)
    views = see(Rig({"c": true}), board_poses(12, seed=5, spread=0.7, depth=(0.6, 1.6)), noise=0.05)
    assert calibrate(views, BOARD).rms < 0.15


SMALL = Rig({"a": camera(330.0, (240, 320))})
"""Whose photographs arrive in the folders that are watched."""


def test_a_folder_is_watched(tmp_path):
    """Images arrive by and by: the page says what is missing, then what would help most."""
    source, folder = tmp_path / "all", tmp_path / "photos"
    simulate_photos(SMALL, BOARD, source, count=5)
    (folder / "a").mkdir(parents=True)
    pages, page = [], tmp_path / "page.html"

    def finished():
        if page.exists():
            pages.append(page.read_text())
        arrived = len(list((folder / "a").iterdir()))
        for image in sorted((source / "a").iterdir())[arrived : arrived + (2, 3)[arrived > 0]]:
            (folder / "a" / image.name).write_bytes(image.read_bytes())
        return len(pages) == 4

    assert len(watch(folder, BOARD, page, interval=0.0, finished=finished)) == 5
    assert "waiting for images" in pages[0]
    assert "the board is found in 2 of its images" in pages[1]
    assert "two more views would help most: the board at the" in pages[2]
    assert 'http-equiv="refresh"' in pages[2]
    assert pages[3] == pages[2]


def test_what_was_detected_is_shown_before_it_is_calibrated(tmp_path, monkeypatch):
    simulate_photos(SMALL, BOARD, tmp_path / "photos", count=1)
    page, shown = tmp_path / "page.html", []

    def calibrate(*_, **__):
        shown.append(page.read_text())
        raise ValueError("too few images")

    monkeypatch.setattr("calib.boards.run.calibrate", calibrate)
    turns = iter((False, True))
    watch(tmp_path / "photos", BOARD, page, interval=0.0, finished=lambda: next(turns))
    assert "a: the board is in 1 of 1 images" in shown[0]
    assert "too few images" in page.read_text()


def test_what_is_wrong_with_the_folder_is_on_the_page_until_it_is_mended(tmp_path, monkeypatch):
    """The page said that it waits for images, for ever."""
    simulate_photos(SMALL, BOARD, tmp_path / "photos", count=2)
    image = tmp_path / "photos/a/000.png"
    page, pages = tmp_path / "page.html", []
    wrong = image.rename(image.with_name("1.png"))
    monkeypatch.setattr("calib.boards.run.calibrate", lambda *_, **__: pytest.fail("calibrated"))

    def finished():
        pages.append(page.read_text())
        if len(pages) == 2:
            wrong.rename(image)
            monkeypatch.setattr("calib.boards.run.calibrate", too_few)
        return len(pages) == 3

    def too_few(*_, **__):
        raise ValueError("too few images")

    watch(tmp_path / "photos", BOARD, page, interval=0.0, finished=finished)
    assert "two images have one number" in pages[1]
    assert "two images have one number" not in pages[2]
    assert "too few images" in pages[2]


def test_an_image_that_goes_before_it_is_read_does_not_end_the_guidance(tmp_path, monkeypatch):
    simulate_photos(SMALL, BOARD, tmp_path / "photos", count=1)
    page, turns = tmp_path / "page.html", iter((False, False, True))

    def gone(*_):
        raise FileNotFoundError("000.png: renamed")

    monkeypatch.setattr("calib.boards.run.detected", gone)
    watch(tmp_path / "photos", BOARD, page, interval=0.0, finished=lambda: next(turns))
    assert "000.png" in page.read_text()


def test_notes_of_several_cameras_are_one():
    notes = ["a: no points: here", "b: no points: here", "held to the start", "b: bent", "a: no points: here"]
    assert by_cameras(notes) == ["a, b: no points: here", "held to the start", "b: bent"]


def test_images_that_show_no_view_of_the_board_have_none_proposed():
    """A strip shows less than the board's height: the report proposes no view."""
    views = see(Rig({"cam": camera(1150.0, (160, 1600))}), board_poses(12, spread=0.1, depth=(6, 14)))
    strip = calibrate(views, BOARD)
    said = " ".join(coverage_advice(strip))
    assert "no points at the" in said
    assert "views would help" not in said


def test_maps_of_uncertainty_show_the_images_area(found):
    """They extend from -0.5 to W - 0.5."""
    for axes in draw_adequacy(found, (0.9, 2.4)).axes[:3]:
        assert axes.get_xlim() == (-0.5, 639.5)
        assert axes.get_ylim() == (479.5, -0.5)
