"""Bundle adjustment: derivatives, recovered ground truth, robustness to outliers, a correct covariance."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from scipy.stats import chi2

from arraygeom import Camera, Rig
from calib.boards import intrinsics
from calib.boards.bundle import (
    CameraPrior,
    Observations,
    camera_jacobian,
    changed,
    intrinsic_values,
    linearised,
    normal_equations,
    parameter_names,
)
from calib.boards.rig import calibrate
from calib.boards.solve import adjust, noise
from calib.boards.target import parse_board
from tests.calib.board_scenes import (
    BOARD,
    all_free,
    board_poses,
    camera,
    errors_of,
    four_cameras,
    scene_of,
    see,
    tensor,
)
from tests.calib.tracks import (
    CALISCOPE_BOARD,
    CALISCOPE_RMS,
    FIFTEEN_RMS,
    caliscope,
    caliscope_views,
    fifteen_cameras,
    free_points,
    rms_and_mean,
)


def shaken(problem, size, seed=0):
    """The problem, all that is free moved: by `size` times 0.01 rad, 0.01 m, 5 px, 0.02 of coefficients."""
    random = np.random.default_rng(seed)
    cameras = {}
    for (name, c), mask in zip(problem.cameras.items(), all_free(problem.cameras, lens=2).values()):
        scale = np.array([0.01] * 6 + [5.0] * 4 + [0.02] * (len(mask) - 10))
        cameras[name] = changed(c, torch.from_numpy(size * mask * scale * random.normal(size=len(mask))))
    change = size * 0.01 * random.normal(size=(len(problem.frames), 6))
    still = np.zeros(len(problem.names))
    return replace(problem.stepped(still, change), cameras=cameras)


@pytest.fixture(scope="module")
def small():
    """Two cameras, eight boards, noise of 0.1 px; the ground truth."""
    rig = Rig({name: four_cameras()[name] for name in ("mono", "colour")})
    boards = board_poses(8, spread=0.2)
    return rig, boards, scene_of(rig, boards, see(rig, boards, noise=0.1))


@pytest.mark.parametrize(
    ("lens", "model"),
    [
        ((), "none"),
        ((-0.3, 0.1, 0.001, -0.002, 0.02), "brown-conrady"),
        ((5.7, 1.6, 6e-5, -7e-5, -0.1, 6.0, 3.1, 0.0), "brown-conrady"),
        ((0.02, -0.01, 0.003, 0.0), "kannala-brandt"),
    ],
)
def test_derivatives_are_those_of_finite_differences(lens, model):
    c = camera((520.0, 530.0), (480, 640), (0.1, -0.2, 0.3), (4.0, -9.0, 70.0), lens, model)
    X = np.random.default_rng(0).normal((0.0, 0.1, 2.0), (0.4, 0.3, 0.3), (40, 3))
    found = camera_jacobian(c, X)
    for i, step in enumerate(1e-6 * torch.eye(found.shape[-1], dtype=torch.float64)):
        ends = [changed(c, s * step).project(torch.from_numpy(X)).x.numpy() for s in (1, -1)]
        expected = (ends[0] - ends[1]) / 2e-6
        assert np.abs(expected - found[..., i]).max() < 1e-5 * (1 + np.abs(found[..., i]).max()), i


def test_derivatives_of_boards(small):
    """Derivatives of the pixels by the poses of the boards."""
    _, _, problem = small
    problem = replace(problem, sigma={"mono": 1.0, "colour": 1.0})
    found, still = linearised(problem)["colour"].by_board, np.zeros(len(problem.names))
    for i in range(6):
        step = np.zeros((8, 6))
        step[:, i] = 1e-6
        ahead, behind = (problem.stepped(still, sign * step).residuals["colour"] for sign in (1, -1))
        assert np.abs((behind - ahead) / 2e-6 - found[..., i]).max() < 1e-5 * (1 + np.abs(found).max())


def test_a_problems_points_are_projected_once(small, monkeypatch):
    project, counts = Camera.project, []

    def counted(camera, X):
        counts.append(len(X))
        return project(camera, X)

    monkeypatch.setattr(Camera, "project", counted)
    problem = replace(small[2], sigma=dict.fromkeys(small[2].cameras, 0.1))
    assert problem.loss == problem.loss
    assert noise(problem, 0).keys() == problem.sigma.keys()
    assert len(counts) == len(problem.cameras)
    assert replace(problem, sigma=dict.fromkeys(problem.cameras, 1.0)).loss < problem.loss


def test_views_of_the_same_points_are_solved_once(small, monkeypatch):
    """Once before the adjustment, and once more where there were fewer points at first."""
    solved, counts = intrinsics._solved, []

    def counted(*given):
        counts.append(given)
        return solved(*given)

    monkeypatch.setattr(intrinsics, "_solved", counted)
    rig, boards, _ = small
    views = see(rig, boards, noise=0.1)["mono"]
    found = intrinsics.initial_camera("mono", views, BOARD, "brown-conrady")
    assert len(counts) == 2
    assert found.views.count > sum(len(d.ids) for d in counts[0][1].seen.values())
    again = solved("mono", found.views, BOARD, "brown-conrady")[0]
    torch.testing.assert_close(again.K, found.camera.K, rtol=1e-6, atol=0)  # OpenCV 5 is not the same twice
    torch.testing.assert_close(
        again.distortion.coefficients, found.camera.distortion.coefficients, rtol=1e-4, atol=1e-6
    )


def test_perfect_corners_recover_the_ground_truth():
    rig, boards = four_cameras(), board_poses(10)
    ground_truth = scene_of(rig, boards, see(rig, boards))
    fit = adjust(shaken(ground_truth, 1.0))
    assert fit.converged
    assert fit.problem.rms() < 1e-6
    for name, c in fit.problem.cameras.items():
        assert float((c.K - rig[name].K).abs().max()) < 1e-4
        assert float((c.t - rig[name].t).abs().max()) < 1e-7


def test_the_least_squares_are_scipys(small):
    """The minimum and covariance that a general solver finds without Schur complement or autodiff."""
    _, _, problem = small
    fit = adjust(problem)
    count = len(fit.names)

    def residuals(change):
        moved = fit.problem.stepped(change[:count], change[count:].reshape(-1, 6))
        return np.concatenate([(r / fit.problem.sigma[n]).ravel() for n, r in moved.residuals.items()])

    theirs = least_squares(residuals, np.zeros(count + 48), x_scale="jac", max_nfev=4)
    assert 2 * theirs.cost == pytest.approx(float((residuals(np.zeros(count + 48)) ** 2).sum()), rel=2e-3)
    deviations = np.sqrt(np.linalg.inv(theirs.jac.T @ theirs.jac).diagonal()[:count])
    assert np.sqrt(fit.covariance.diagonal()) == pytest.approx(deviations, rel=0.05)


def test_a_prior_has_its_stated_weight(small):
    """The fit with a prior is the weighted mean of the fit without and the prior."""
    _, _, problem = small
    alone = adjust(problem)
    at = list(alone.names).index("mono.focal.0")
    deviation = float(np.sqrt(alone.covariance[at, at]))
    mean = intrinsic_values(alone.problem.cameras["mono"])
    mean[6] += 2 * deviation
    information = np.zeros((len(mean), len(mean)))
    information[6, 6] = deviation**-2
    held = adjust(replace(alone.problem, priors={"mono": CameraPrior(mean, information)}))
    moved = float(held.problem.cameras["mono"].K[0, 0] - alone.problem.cameras["mono"].K[0, 0])
    assert moved == pytest.approx(deviation, rel=0.05)
    assert held.covariance[at, at] == pytest.approx(deviation**2 / 2, rel=0.05)


def test_outliers_have_no_influence(small):
    _, _, problem = small
    clean = adjust(problem)
    x = problem.seen["mono"].x.copy()
    x[::40] += np.random.default_rng(1).uniform(20, 60, x[::40].shape)
    fit = adjust(replace(problem, seen={**problem.seen, "mono": problem.seen["mono"]._replace(x=x)}))
    for name, c in clean.problem.cameras.items():
        change = (fit.problem.cameras[name].K - c.K).diagonal()[:2].abs().tolist()
        assert change[0] < 1.5 * clean.deviations[f"{name}.focal.0"]
        assert change[1] < 1.5 * clean.deviations[f"{name}.focal.1"]
    assert fit.problem.sigma["mono"] == pytest.approx(0.1, rel=0.25)


def test_an_unobservable_scale_has_no_covariance(small):
    _, _, problem = small
    X, seen = problem.world("mono")[:60], {}
    for name, c in problem.cameras.items():
        x, _, valid = c.project(torch.from_numpy(X))
        index = np.flatnonzero(valid.numpy())
        seen[name] = Observations(index, np.zeros((len(index), 3)), x.numpy()[index])
    poses = {name: np.arange(len(parameter_names(c))) < 6 for name, c in problem.cameras.items()}
    poses["mono"][:] = False
    points = replace(free_points(problem.cameras, X, seen), free=poses)
    assert adjust(points, rounds=1).covariance is None


def test_fixed_numbers_stay_bit_identical(small):
    _, _, problem = small
    free = all_free(problem.cameras, lens=0)
    free["colour"][6:8] = False
    started = replace(shaken(problem, 0.1), free=free)
    fit, started = adjust(started, rounds=1), started.cameras
    assert torch.equal(fit.problem.cameras["mono"].R, started["mono"].R)
    assert torch.equal(fit.problem.cameras["colour"].K.diagonal(), started["colour"].K.diagonal())
    assert fit.problem.cameras["colour"].distortion == started["colour"].distortion


@pytest.mark.slow
def test_the_covariance_is_true():
    """Thirty draws of noise: squared errors in the covariance's units are chi-square, each number's too."""
    rig, boards = four_cameras(), board_poses(24)
    squares, relative = [], []
    for draw in range(30):
        ground_truth = scene_of(rig, boards, see(rig, boards, noise=0.15, seed=draw))
        fit = adjust(ground_truth)
        error = errors_of(fit, rig)
        squares.append(error @ np.linalg.solve(fit.covariance, error))
        relative.append(error / np.sqrt(fit.covariance.diagonal()))
    count = len(error)
    low, high = chi2.ppf([0.001, 0.999], 30 * count)
    assert low < np.sum(squares) < high
    assert 0.9 < np.sqrt(np.mean(np.square(relative))) < 1.1
    assert np.abs(np.mean(relative, axis=0)).max() < 4 / np.sqrt(30)


@pytest.mark.slow
def test_fifteen_cameras_fit_better_than_published(shared_data):
    problem = fifteen_cameras(shared_data).problem
    rms, mean = rms_and_mean(adjust(problem).problem)
    assert rms < FIFTEEN_RMS
    assert mean < 0.6


@pytest.mark.slow
def test_caliscopes_tracks_fit_better_than_published(shared_data):
    """Its own intrinsics, corners as free points, as its calibration has them: at most its own RMS.

    Least squares lower the RMS; the robust fit lowers the mean, and leaves larger residuals to a few frames.
    """
    published = caliscope(shared_data).problem
    free = {name: np.arange(15) < (6 if i else 0) for i, name in enumerate(published.cameras)}
    squares, robust = (adjust(replace(published, free=free), rounds=rounds) for rounds in (0, 4))
    before, after = rms_and_mean(published), rms_and_mean(squares.problem)
    assert before[0] == pytest.approx(CALISCOPE_RMS, abs=1e-3)
    assert after[0] < before[0]
    assert rms_and_mean(robust.problem)[1] < before[1]


@pytest.mark.slow
def test_caliscopes_corners_through_all_of_calibrate(shared_data):
    """Rigid boards, cameras not quite synchronised, nothing known before: at most its own RMS."""
    found = calibrate(caliscope_views(shared_data), parse_board(CALISCOPE_BOARD))
    assert found.rms < CALISCOPE_RMS
    assert any("taken at the same moments" in note for note in found.notes)


def test_world_points_of_boards_are_their_poses(small):
    _, boards, problem = small
    seen = {"mono": Observations(np.array([2]), np.array([[0.1, 0.2, 0.0]]), np.zeros((1, 2)))}
    expected = boards[2].apply(tensor(0.1, 0.2, 0.0)[None])
    assert np.abs(replace(problem, seen=seen).world("mono") - expected.numpy()).max() < 1e-15


def test_the_step_solves_the_whole_system(small):
    """Schur's complement against the full matrix."""
    _, _, problem = small
    problem = replace(problem, sigma={"mono": 0.1, "colour": 0.1})
    equations = normal_equations(problem, linearised(problem))
    c, (b, d) = len(equations.g), equations.h.shape
    full = np.zeros((c + b * d, c + b * d))
    full[:c, :c] = equations.H
    for i in range(b):
        at = slice(c + i * d, c + (i + 1) * d)
        full[at, at] = equations.B[i] + 1e-12 * np.eye(d)
        full[:c, at], full[at, :c] = equations.W[i], equations.W[i].T
    scale = 1 / np.sqrt(full.diagonal())
    right = np.concatenate([equations.g, equations.h.ravel()])
    expected = scale * np.linalg.solve(full * scale[:, None] * scale, scale * right)
    cameras, blocks = equations.solve(0.0)
    found = np.concatenate([cameras, blocks.ravel()])
    assert np.abs((found - expected) / scale).max() < 1e-4
