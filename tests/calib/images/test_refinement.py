"""Perturbed rigs and their refinement, against ground truth."""

import math

import numpy as np
import pytest
import torch

from arraygeom import Camera, Distortion, Link, Rig, View
from arraygeom.runtime.text import UNSCALED
from calib.images.depth_change import SMALL, relative_change
from calib.images.hypotheses import swap
from calib.images.matches import PointMatches, image_sizes, match_cameras
from calib.images.parameters import apply_change, free_parameters
from calib.images.refinement import FREE, RefinementProblem, jacobian, refine, refine_matches, solve
from calib.images.residuals import epipolar_residuals, median_off, sampson_of_pairs
from pat.app.cli.main import main
from pat.media.images import write_image
from tests.benchmarks.bench_drift import DRIFTS, drifted, with_lens_mistake
from tests.benchmarks.bench_drift import error as depth_error
from tests.calib.real import bumblebee, syntim
from tests.calib.scenes import (
    HW,
    rectified_images,
    rectified_pair,
    seen_points,
    texture,
    unlike_pair,
    vector,
)
from tests.calib.simulated import simulated_matches, simulated_rig, worse


def drawn(rig: Rig) -> Rig:
    """The rig with each camera turned and its principal point moved, in random directions."""
    return worse(rig, torch.Generator().manual_seed(0))


@pytest.mark.parametrize("lens", [False, True])
def test_a_perturbed_rig_returns(lens):
    rig = unlike_pair(lens=lens)
    bad, exact = drawn(rig), seen_points(rig, noise=0.0, seed=1)
    assert median_off(bad, exact) > 1
    found = refine_matches(bad, [seen_points(rig)], force=True)
    assert found.accepted
    assert found.held_out[1].median < 0.25 < found.held_out[0].median
    assert median_off(found.rig, exact) < 0.2
    assert found.rig["first"].R is bad["first"].R
    assert "second.rotation" in found.as_text()
    assert "degrees" in found.as_text()


def small_drift() -> tuple[Rig, Rig]:
    """A narrow pair, its second camera rotated by 0.1 degrees about its vertical axis and its horizontal."""
    rig = simulated_rig("narrow", 2, np.random.default_rng(5))
    return rig, rig.perturbed({"c1.rotation": vector(0.0012, 0.0012, 0)})


def test_depth_that_points_do_not_determine_stays():
    """Rotation about the vertical hardly moves a line: determined parameters return, depth keeps
    its value."""
    rig, bad = small_drift()
    points = simulated_matches(rig, "narrow", np.random.default_rng(6))
    found = refine_matches(bad, [points])
    assert found.accepted
    assert found.held_out[1].median < 0.5 * found.held_out[0].median
    assert found.depth.change < 0.02
    before, after = (depth_error(r, rig, points) for r in (bad, found.rig))
    assert after < before + 0.01
    assert "lines mended, depth not determined" in found.as_text()


def test_a_change_of_depth_that_points_do_not_determine_is_refused():
    rig = simulated_rig("wide", 2, np.random.default_rng(7))
    points = simulated_matches(rig, "wide", np.random.default_rng(8))
    bad = rig.perturbed({"c1.focal": 0.02 * rig["c1"].K[:2, :2].diagonal()})
    found = refine_matches(bad, [points])
    assert found.depth.change > SMALL
    assert not found.accepted
    assert any("depth would change" in objection for objection in found.objections)
    assert refine_matches(bad, [points], force=True).accepted


@pytest.mark.parametrize("field", ["narrow", "wide"])
def test_a_wrong_focal_length_does_not_ruin_depth(field):
    rig = simulated_rig(field, 2, np.random.default_rng(7))
    points = simulated_matches(rig, field, np.random.default_rng(8))
    bad = rig.perturbed({"c1.focal": 0.02 * rig["c1"].K[:2, :2].diagonal()})
    found = refine_matches(bad, [points])
    before, after = (depth_error(r, rig, points) for r in (bad, found.rig))
    assert after < before + 0.01
    assert found.held_out[1].median < 0.25 * found.held_out[0].median


def test_swapped_cameras_are_not_accepted():
    rig = simulated_rig("narrow", 2, np.random.default_rng(9))
    points = simulated_matches(rig, "narrow", np.random.default_rng(10))
    found = refine_matches(swap(rig, "c0", "c1"), [points])
    assert not found.accepted
    assert found.objections
    assert "not accepted" in found.as_text()
    assert refine_matches(swap(rig, "c0", "c1"), [points], force=True).accepted


def test_points_behind_the_cameras_are_not_accepted():
    """Parallel cameras of the same K, swapped, have the right lines: only the side of the points shows it."""
    g = np.random.default_rng(9)
    rig = simulated_rig("wide", 2, g)
    alpha, pose = rig["c0"], rig["c1"].cam_from_world
    parallel = rig.replace(cameras={"c0": alpha, "c1": alpha.replace(cam_from_world=pose.replace(R=alpha.R))})
    points = simulated_matches(parallel, "wide", g)
    drift = swap(parallel, "c0", "c1").perturbed({"c1.rotation": vector(0.004, 0, 0)})
    found = refine_matches(drift, [points])
    assert found.held_out[1].median < 0.3
    assert not found.accepted
    assert any("100% of the points lie behind a camera" in text for text in found.objections)


def test_a_prior_binds():
    """A change of many prior deviations is refused, with the parameter's name and what to do."""
    rig = simulated_rig("wide", 2, np.random.default_rng(11))
    bad = rig.perturbed({"c1.rotation": vector(0.03, 0, 0)})
    points = simulated_matches(rig, "wide", np.random.default_rng(12))
    sigma = {"rotation": math.radians(0.1), "centre": 1.0}
    problem = RefinementProblem.from_frames(bad, ["rotation", "centre"], frames=[points], sigma=sigma)
    found = problem.report(problem.solve(near_depth=False))
    assert not found.accepted
    assert any("standard deviations" in text and "sigma" in text for text in found.objections)


def test_wrong_points_do_not_matter():
    rig = unlike_pair()
    (names, points), *_ = seen_points(rig).items()
    wrong = points.beta.clone()
    wrong[::8] += torch.from_numpy(np.random.default_rng(0).uniform(-20, 20, wrong[::8].shape))
    found = refine_matches(drawn(rig), [{names: PointMatches(points.alpha, wrong)}], force=True)
    assert median_off(found.rig, seen_points(rig, noise=0.0, seed=1)) < 0.25


def test_several_frames_hold_a_whole_one_out():
    rig = unlike_pair()
    frames = [seen_points(rig, count=100, seed=seed) for seed in range(3)]
    found = refine_matches(drawn(rig), frames, force=True)
    assert found.held_out[0].points == 100
    assert (
        sum(
            len(m.alpha)
            for m in RefinementProblem.from_frames(rig, ["rotation"], frames=frames).used.values()
        )
        == 200
    )
    assert found.accepted


def test_what_images_do_not_determine_is_unobservable_and_named():
    """Side by side and alike, a shift of both principal points along the rows moves no line."""
    rig = rectified_pair()
    bad = rig.perturbed({"right.rotation": vector(0.003, 0, 0.004)})
    found = refine_matches(bad, [seen_points(rig)], free=["rotation", "centre", "translation"])
    assert {"left.centre x", "right.centre x", "right.translation x"} <= set(found.unobservable)
    for name in ("left", "right"):
        assert found.rig[name].K[0, 2] == bad[name].K[0, 2]
    assert median_off(found.rig, seen_points(rig, noise=0.0, seed=1)) < 0.1


def test_translations_are_freed_where_points_demand_it():
    """Only points that no turn or shift of principal points explains change the baseline."""
    rig = unlike_pair()
    exact = seen_points(rig, noise=0.0, seed=1)
    moved = rig.perturbed({"second.translation": vector(0, 0.006, 0.012)})
    found = refine_matches(moved, [seen_points(rig, count=400)])
    assert any(change.name == "second.translation" for change in found.changes)
    assert median_off(found.rig, exact) < 0.1
    rotated = refine_matches(drawn(rig), [seen_points(rig)])
    assert not any("translation" in change.name for change in rotated.changes)
    only = refine_matches(moved, [seen_points(rig, count=400)], free=["rotation"])
    assert not any("translation" in change.name for change in only.changes)


def test_a_refusal_says_what_else_to_free():
    """A rotation that stands in for a shift of the principal point is refused with that hint."""
    rig = unlike_pair()
    bad, points = rig.perturbed({"second.centre": vector(0, 8, 0)[:2]}), seen_points(rig, count=200)
    for free, advice in ((["rotation"], "free "), (FREE, "")):
        problem = RefinementProblem.from_frames(bad, free, frames=[points])
        solution = problem.solve()
        refused = problem.report(solution._replace(z=torch.zeros_like(solution.z))).objections[0]
        assert advice in refused
        assert ("alone" in refused) == bool(advice)


def test_a_rig_of_unknown_scale_is_not_refined_in_millimetres():
    rig = unlike_pair().replace(name=UNSCALED)
    moved = rig.perturbed({"second.translation": vector(0, 0.006, 0.012)})
    found = refine_matches(moved, [seen_points(rig, count=400)])
    (change,) = (change for change in found.changes if change.name == "second.translation")
    assert change.unit == "baselines"
    assert max(map(abs, change.amount)) < 0.1


def test_units_of_length_do_not_matter():
    """No threshold is in metres."""
    rig, bad = small_drift()
    points = simulated_matches(rig, "narrow", np.random.default_rng(6))
    found = [refine_matches(bad.scaled(factor), [points]) for factor in (1.0, 1e-8, 1e8)]
    assert len({str(refined.depth) for refined in found}) == 1


def test_a_tight_prior_holds():
    rig = unlike_pair()
    found = refine_matches(
        drawn(rig), [seen_points(rig)], sigma={"centre": 1e-4, "rotation": math.radians(1)}
    )
    assert any("centre" in name for name in found.unobservable)
    assert not any("centre" in change.name for change in found.changes)


def test_a_good_rig_stays_as_it_is():
    rig = unlike_pair()
    found = refine_matches(rig, [seen_points(rig)])
    assert median_off(found.rig, seen_points(rig, noise=0.0, seed=1)) < 0.1


def test_held_out_points_reject_a_fit_to_wrong_points():
    rig = unlike_pair()
    drifted = rig.perturbed({"second.rotation": vector(0.01, 0.005, 0)})
    found = refine_matches(rig, [seen_points(drifted), seen_points(rig, seed=2)])
    assert not found.accepted
    assert found.rig is rig
    assert found.changes == ()
    assert "not accepted" in found.as_text()


def test_deviations_are_those_of_repeated_draws():
    """Rigs that drifted in every parameter, by the prior: the error over the draws is the stated
    deviation."""
    rig, errors = rectified_pair(), []
    parameters = free_parameters(
        rig, rig.names, free=["right.rotation", "right.translation", "*.focal", "*.centre"]
    )
    for seed in range(6):
        g = torch.Generator().manual_seed(seed)
        z = 0.7 * torch.randn(sum(len(u.sigma) for u in parameters), generator=g, dtype=torch.float64)
        bad = apply_change(rig, parameters, -z)
        fit = RefinementProblem.from_frames(
            bad, ["right.rotation"], frames=[seen_points(rig, noise=0.2, seed=seed)]
        )
        found = fit.solve()
        errors.append((found.full[:3] - z[:3]) / found.covariance.diagonal()[:3].sqrt())
    rms = torch.stack(errors).square().mean(0).sqrt()
    assert (rms > 0.3).all()
    assert (rms < 2).all()


@pytest.mark.parametrize("lens", [False, True])
def test_derivatives_are_those_of_finite_differences(lens):
    rig = unlike_pair(lens=lens)
    pairs = seen_points(rig, count=20)
    free = ["rotation", "translation", "focal", "centre"] + (["distortion"] if lens else [])
    given = free_parameters(rig, rig.names, free=free)
    z = 0.1 * torch.ones(sum(len(u.sigma) for u in given), dtype=torch.float64)

    def algebraic_over_fixed_gradient(z):
        return sampson_of_pairs(apply_change(rig, given, z), pairs)

    _, J = jacobian(algebraic_over_fixed_gradient, z)
    (names, points), *_ = pairs.items()
    fixed = epipolar_residuals(apply_change(rig, given, z).pair(*names), points)
    for k in (0, 4, len(z) - 1):
        step = torch.zeros_like(z)
        step[k] = 1e-4
        ends = [
            epipolar_residuals(apply_change(rig, given, z + s * step).pair(*names), points).sampson
            for s in (1, -1)
        ]
        difference = (ends[0] - ends[1]) / 2e-4
        near_zero = fixed.sampson.abs() < 3
        assert torch.allclose(J[near_zero, k], difference[near_zero], atol=0.05, rtol=0.05)


def test_solving_without_data_returns_the_prior():
    found = solve(lambda z: [0 * z.sum() + torch.zeros(5, dtype=torch.float64)], 3)
    assert not found.active.any()
    assert found.z.tolist() == [0, 0, 0]


def test_a_fundamental_matrix_is_refined():
    rig = unlike_pair()
    bad = drawn(rig).pair("first", "second").fundamental
    views = {name: View(hw=camera.hw) for name, camera in rig.cameras.items()}
    uncalibrated = Rig({**views, "third": View(hw=HW)}, links={("first", "second"): Link(bad)})
    points = seen_points(rig)
    found = refine_matches(uncalibrated, [{**points, ("first", "third"): points["first", "second"]}])
    assert found.accepted
    assert "changed: F of first > second" in found.as_text()
    assert median_off(found.rig, seen_points(rig, noise=0.0, seed=1)) < 0.1


def test_unknown_cameras_have_no_parameters():
    with pytest.raises(ValueError, match="third"):
        free_parameters(unlike_pair(), ["first", "third"], free=FREE)


def test_links_without_lines_are_left_out():
    rig = unlike_pair()
    bad, points = drawn(rig).pair("first", "second").fundamental, seen_points(rig)
    views = {name: View(hw=camera.hw) for name, camera in rig.cameras.items()}
    flat = {("first", "third"): Link.from_homography(torch.eye(3).double())}
    linked = Rig({**views, "third": View(hw=HW)}, links={("first", "second"): Link(bad), **flat})
    open_points = {("first", "third"): points["first", "second"]}
    assert refine_matches(linked, [points | open_points]).accepted
    with pytest.raises(ValueError, match="does not relate"):
        refine_matches(linked, [open_points])


def test_bad_input_is_one_clear_line():
    rig, images = rectified_pair(), rectified_images()
    with pytest.raises(ValueError):
        refine(rig, [{"left": images["left"]}])
    with pytest.raises(ValueError, match=r"left.*right"):
        refine(rig, [{"left": images["left"], "right": images["left"]}])
    with pytest.raises(ValueError, match=r"left.*right"):
        refine(rig, [images | {"right": texture(seed=5)}])
    with pytest.raises(ValueError, match=r"100x80.*320x240"):
        refine(rig, [images | {"right": texture((80, 100))}])
    with pytest.raises(ValueError, match="rotatoin"):
        refine(rig, [images], free=["rotatoin"])
    with pytest.raises(ValueError):
        refine(rig, [images], free=["left.rotation"])
    unknown = Rig({name: View(hw=HW) for name in images})
    with pytest.raises(ValueError):
        refine(unknown, [images])
    with pytest.raises(ValueError, match=r"^sigma"):
        refine(rig, [images], sigma={"center": 3})
    with pytest.raises(ValueError, match="frame"):
        refine(rig, [])
    with pytest.raises(ValueError, match="frames"):
        refine(rig, [images, images], matches=[match_cameras(images)])


@pytest.mark.parametrize(
    ("changed", "text"),
    [
        (lambda image: image[0], "'left'.*float32"),
        (lambda image: image[None], "'left'.*float32"),
        (lambda image: (image * 255).byte(), "'left'.*uint8"),
    ],
)
def test_images_of_another_kind_are_refused_by_name(changed, text):
    with pytest.raises(ValueError, match=text):
        image_sizes({name: changed(image) for name, image in rectified_images().items()})


def test_images_that_want_gradients_are_matched():
    images = rectified_images()
    found = match_cameras({name: image.clone().requires_grad_() for name, image in images.items()})
    assert torch.equal(found["left", "right"].beta, match_cameras(images)["left", "right"].beta)
    with pytest.raises(ValueError, match="'top'"):
        match_cameras(images, alpha="top")


def test_command_line(tmp_path, capsys, refusal):
    rig, images = rectified_pair(), rectified_images()
    files = [f"--image={name}={tmp_path / name}.png" for name in images]
    for name, image in images.items():
        write_image(tmp_path / f"{name}.png", image)
    rig.perturbed({"right.rotation": vector(0.004, 0, 0.002)}).save(tmp_path / "rig.yaml")
    command = ["rig", "refine", str(tmp_path / "rig.yaml"), *files, "--free", "rotation"]
    main([*command, "--out", str(tmp_path / "better.yaml")])
    assert "changed: right.rotation" in capsys.readouterr().out
    assert "# lines mended" in (tmp_path / "better.yaml").read_text()
    better = Rig.load(tmp_path / "better.yaml")
    assert isinstance(better["right"], Camera)
    assert better["right"].hw == HW
    assert median_off(better, seen_points(rig, noise=0.0)) < 0.15
    assert "--image" in refusal(
        *command, f"--image=left={tmp_path / 'left.png'}", "--out", tmp_path / "none.yaml"
    )
    assert not (tmp_path / "none.yaml").exists()


def test_depth_that_is_lost_counts_as_changed():
    g = np.random.default_rng(0)
    rig = simulated_rig("wide", 2, g)
    points = simulated_matches(rig, "wide", g)
    reversed_rig = swap(rig, "c0", "c1")
    assert relative_change(rig, reversed_rig, points) == 1.0


def test_poses_do_not_stand_in_for_lenses():
    """Lines that wrong lenses bend change depth by one per cent at most."""
    g = np.random.default_rng([0, 2, 4])
    rig = simulated_rig("wide", 2, g)
    matches = simulated_matches(rig, "wide", g)
    lens = Distortion("brown-conrady", torch.tensor([0.2, 0.0, 0.0, 0.0], dtype=torch.float64))
    bent = rig.replace(
        cameras={name: camera.replace(distortion=lens) for name, camera in rig.cameras.items()}
    )
    found = refine_matches(bent, [matches])
    assert depth_error(found.rig, rig, matches) < depth_error(bent, rig, matches) + 0.01


@pytest.mark.parametrize(
    ("name", "kind", "seed"),
    [
        pytest.param("SmRub", "k1 +.05", 0, marks=pytest.mark.slow),
        ("SmRub", "centre 5 px", 1),
        pytest.param("thing01", "k1 +.05", 0, marks=pytest.mark.slow),
        ("Poly", "rotation 1", 1),
    ],
)
def test_depth_does_not_change_for_nothing(shared_data, name, kind, seed):
    """Poses that fit the lines of `thing01` best would change depth by 16 per cent, from 2.5 to 14 off."""
    pairs = bumblebee(shared_data, (name,)) if name == "thing01" else syntim(shared_data, (name,))
    (pair,) = (pair for pair in pairs if name in pair.name)
    matches = match_cameras(pair.images)
    rig = Rig({name: pair.rig[name] for name in pair.images})
    lens = kind.startswith("k1")
    bad = (
        with_lens_mistake(rig, kind)
        if lens
        else drifted(rig, kind, np.random.default_rng([seed, DRIFTS.index(kind)]))
    )
    assert bad is not None
    found = refine_matches(bad, [matches])
    assert depth_error(found.rig, rig, matches) < depth_error(bad, rig, matches) + 0.01
