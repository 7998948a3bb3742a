"""Every usual mistake made with rigs whose ground truth is known, and the name it is given."""

import json
import math
import re

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from arraygeom import Camera, Distortion, Link, Pose, Rig, View, triangulate
from arraygeom.lenses import PolynomialFisheye
from arraygeom.runtime.text import UNSCALED
from calib.images.doctor import diagnose, diagnose_matches
from calib.images.evidence import DriftEvidence
from calib.images.hypotheses import TRANSPOSE, hypotheses, on_cameras, swap
from calib.images.least_squares import most_probable
from calib.images.matches import PointMatches
from calib.images.parameters import UNCERTAIN, apply_change, free_parameters
from calib.images.residuals import sampson_of_pairs
from pat.app.cli.main import main
from pat.media.images import write_image
from tests.benchmarks.bench_drift import drifted
from tests.benchmarks.bench_names import OPENGL, cropped, negated, reordered, shifted, turned
from tests.calib.scenes import rectified_images, rectified_pair, seen_points, texture, unlike_pair, vector
from tests.calib.simulated import simulated_matches, simulated_rig


def sizes(rig):
    return {name: camera.hw for name, camera in rig.cameras.items()}


def each(change):
    return lambda rig: on_cameras(rig, rig.names, change)


def one(change):
    return lambda rig: on_cameras(rig, rig.names[1:], change)


def posed(change):
    return lambda c: c.replace(cam_from_world=change(c.cam_from_world))


def angles_reversed(pose):
    angles = Rotation.from_matrix(pose.R.numpy()).as_euler("XYZ")
    return Pose(torch.from_numpy(Rotation.from_euler("ZYX", angles[::-1]).as_matrix()), pose.t)


def with_numbers(camera, *, focal=1.0, centre=1.0):
    K = camera.K.clone()
    K[:2, :2] *= focal
    K[:2, 2] = (K[:2, 2] + 0.5) * centre - 0.5
    return camera.replace(K=K)


FLIP = torch.diag(vector(1, -1, 1))
MISTAKES = {
    "sign of t": one(posed(lambda p: Pose(p.R, -p.t))),
    "half-pixel shift": one(shifted(0.5)),
    "one-pixel shift": one(shifted(-1.0)),
    "R transposed": each(posed(lambda p: Pose(p.R.T, p.t))),
    "pose inverted": each(posed(Pose.inverse)),
    "centre as t": each(posed(lambda p: Pose(p.R, -p.R.T @ p.t))),
    "OpenGL axes": one(posed(lambda p: Pose(OPENGL @ p.R, OPENGL @ p.t))),
    "order of quaternions": each(posed(lambda p: reordered(p, (3, 0, 1, 2)))),
    "degrees and radians": each(posed(lambda p: Pose(turned(p.R, math.pi / 180), p.t))),
    "cameras swapped": lambda rig: swap(rig, *rig.names),
    "units": each(posed(lambda p: Pose(p.R, 1000 * p.t))),
    "x and y exchanged": each(lambda c: c.replace(K=TRANSPOSE @ c.K @ TRANSPOSE)),
    "frame of t": one(posed(lambda p: Pose(p.R, p.R @ p.t))),
    "order of angles": each(posed(angles_reversed)),
    "left-handed": each(posed(lambda p: Pose(FLIP @ p.R @ FLIP, FLIP @ p.t))),
    "focal length": each(lambda c: with_numbers(c, focal=0.02)),
    "resized": one(lambda c: c.resize((c.hw[0] // 2, c.hw[1] // 2)).replace(hw=c.hw)),
    "rotated or mirrored": lambda rig: rig.rot90("second", 2),
}


def same_size(rig: Rig) -> Rig:
    """The pair with images of one size, so that swapping them does not show in their sizes."""
    return rig.with_camera("second", rig["second"].replace(hw=rig["first"].hw))


@pytest.mark.parametrize("kind", [kind for kind in MISTAKES if "shift" not in kind])
def test_mistake_is_named_and_undone(kind):
    rig = same_size(unlike_pair())
    points = seen_points(rig)
    found = diagnose_matches(MISTAKES[kind](rig), sizes(rig), points)
    assert found.named.kind == kind, found.verdict
    assert not found.healthy
    assert found.after.misfit < 0.1 < found.before.penalised_misfit
    again = diagnose_matches(found.named.rig, sizes(rig), points)
    assert again.healthy, again.verdict


@pytest.mark.parametrize("kind", ["half-pixel shift", "one-pixel shift"])
def test_a_small_shift_is_offered_but_not_named(kind):
    """A small drift explains it as well."""
    rig = same_size(unlike_pair())
    found = diagnose_matches(MISTAKES[kind](rig), sizes(rig), seen_points(rig, noise=0.01))
    assert not found.healthy
    assert found.named.kind == "nothing"
    assert kind in [h.kind for h in found.equal]
    assert "drift" in found.verdict


@pytest.mark.parametrize("field", ["wide", "narrow"])
@pytest.mark.parametrize("draw", range(4))
def test_a_drifted_rig_is_not_given_a_name(field, draw):
    g = np.random.default_rng([draw, 3])
    rig = simulated_rig(field, 2, g)
    bad = drifted(rig, ("rotation .3", "centre 5 px", "focal +2 %", "rotation 1")[draw], g)
    found = diagnose_matches(bad, sizes(rig), simulated_matches(rig, field, g))
    assert found.named.kind == "nothing", found.verdict
    assert found.named.rig is bad


@pytest.mark.parametrize(
    "repair", [MISTAKES["x and y exchanged"], each(lambda c: c.resize((360, 480)).replace(hw=c.hw))]
)
def test_a_drift_that_a_mistake_would_explain_is_not_named(repair):
    """The smallest drift that leaves the points on their lines by the repaired rig too."""
    g = np.random.default_rng([2, 77])
    rig = simulated_rig("narrow", 2, g)
    points = simulated_matches(rig, "narrow", g, wrong=0.0)
    parameters = free_parameters(rig, rig.names, free=UNCERTAIN)

    def distances(z):
        return sampson_of_pairs(repair(apply_change(rig, parameters, z)), points)

    count = sum(len(p.sigma) for p in parameters)
    z = most_probable(distances, torch.zeros(count).double(), torch.eye(count).double())
    assert z.abs().max() < 4
    drifted = apply_change(rig, parameters, z)
    found = diagnose_matches(drifted, sizes(rig), points)
    assert found.before.misfit > 3
    assert found.named.kind == "nothing", found.verdict


@pytest.mark.parametrize("field", ["wide", "narrow"])
@pytest.mark.parametrize("draw", range(3))
def test_rotations_in_degrees_are_found_with_their_lost_turns(field, draw):
    g = np.random.default_rng([draw, 5])
    rig = simulated_rig(field, 2, g)
    in_degrees = each(posed(lambda p: Pose(turned(p.R, 180 / math.pi), p.t)))
    found = diagnose_matches(in_degrees(rig), sizes(rig), simulated_matches(rig, field, g))
    assert found.named.kind == "degrees and radians", found.verdict
    for name, camera in rig.cameras.items():
        assert torch.allclose(found.named.rig[name].R, camera.R, atol=1e-9)


def test_a_repair_that_leaves_far_more_than_another_is_not_as_good():
    """Cameras swapped whose lenses are unlike: a wrong sign of the baseline leaves points off their lines."""
    rig = same_size(unlike_pair())
    found = diagnose_matches(swap(rig, "first", "second"), sizes(rig), seen_points(rig))
    assert found.named.kind == "cameras swapped"
    assert not found.equal


@pytest.mark.parametrize("lens", [False, True])
def test_nothing_is_wrong(lens):
    rig = unlike_pair(lens=lens)
    found = diagnose_matches(rig, sizes(rig), seen_points(rig))
    assert found.named.kind == "nothing"
    assert found.healthy
    assert "nothing wrong" in found.verdict
    assert found.before.front == found.before.inside == 1.0


@pytest.mark.parametrize(
    ("words", "change"), [("ignored", lambda c: c.replace(distortion=None)), ("wrong sign", negated)]
)
def test_wrong_distortion_is_named(words, change):
    rig = unlike_pair(lens=True)
    found = diagnose_matches(each(change)(rig), sizes(rig), seen_points(rig))
    assert found.named.kind == "distortion"
    assert words in found.named.words
    assert found.after.misfit < 0.3 * found.before.misfit


def test_distortion_applied_twice_is_named():
    straight = unlike_pair()
    curved = {
        n: c.replace(distortion=unlike_pair(lens=True)[n].distortion) for n, c in straight.cameras.items()
    }
    found = diagnose_matches(straight.replace(cameras=curved), sizes(straight), seen_points(straight))
    assert "undistorted already" in found.named.words
    assert found.named.rig["first"].distortion is None


def test_drift_is_no_mistake():
    rig = unlike_pair()
    drifted = rig.perturbed({"second.rotation": vector(0.001, -0.002, 0.012)})
    found = diagnose_matches(drifted, sizes(rig), seen_points(rig))
    assert found.named.kind == "nothing"
    assert not found.healthy
    assert "refine" in found.verdict
    assert found.before.misfit > 0.5


def test_what_cannot_be_distinguished_is_said():
    """Equal cameras side by side: an inverted pose is the same as images swapped."""
    rig = rectified_pair()
    found = diagnose_matches(each(posed(Pose.inverse))(rig), sizes(rig), seen_points(rig))
    kinds = {found.named.kind, *(h.kind for h in found.equal)}
    assert {"pose inverted", "cameras swapped"} <= kinds
    assert found.before.front < 0.1
    assert found.after.front > 0.9
    assert found.certain


def test_nothing_is_certain_where_repairs_of_equal_lines_give_other_depths():
    """The right camera sees 3 px to one side: an inverted pose is not quite the same as images swapped."""
    rig = rectified_pair().perturbed({"right.centre": vector(3, 0)})
    found = diagnose_matches(each(posed(Pose.inverse))(rig), sizes(rig), seen_points(rig))
    assert {"pose inverted", "cameras swapped"} <= {found.named.kind, *(h.kind for h in found.equal)}
    assert not found.certain


def test_an_f_of_which_one_side_counts_from_one():
    rig = unlike_pair()
    F = rig.pair("first", "second").fundamental
    shift = torch.eye(3).double()
    shift[:2, 2] = -1
    views = {name: View(hw=camera.hw) for name, camera in rig.cameras.items()}
    matlab = Rig(views, links={("first", "second"): Link(F @ shift)})
    found = diagnose_matches(matlab, sizes(rig), seen_points(rig, noise=0.02))
    assert found.named.kind == "one-pixel shift", found.verdict
    assert math.isnan(found.before.front)


def test_cameras_may_be_linked_in_a_chain():
    g = np.random.default_rng(0)
    rig = simulated_rig("wide", 3, g)
    points = simulated_matches(rig, "wide", g, wrong=0.0)
    views = {name: View(hw=camera.hw) for name, camera in rig.cameras.items()}
    linked = Rig(views, links={names: Link(rig.pair(*names).fundamental) for names in points})
    assert diagnose_matches(linked, sizes(rig), points).named.kind == "nothing"


@pytest.mark.parametrize(("hw", "kind"), [((120, 160), "resized"), ((320, 240), "rotated or mirrored")])
def test_images_of_another_size(hw, kind):
    rig = unlike_pair()
    true = rig.resize("first", hw) if kind == "resized" else rig.rot90("first", 1)
    found = diagnose_matches(rig, sizes(true), seen_points(true))
    assert found.named.kind == kind
    assert found.named.rig["first"].hw == hw
    assert found.after.misfit < 0.1


def test_a_mirrored_image_is_found():
    rig, images = rectified_pair(), rectified_images()
    assert diagnose(rig, images).healthy
    found = diagnose(rig, images | {"right": images["right"].flip(-2)})
    assert "mirrored top to bottom" in found.named.words
    assert found.before.handed < 0.1


def test_bad_input_is_one_clear_line():
    rig, images = rectified_pair(), rectified_images()
    with pytest.raises(ValueError):
        diagnose(rig, {"left": images["left"]})
    with pytest.raises(ValueError, match=r"left.*right"):
        diagnose(rig, {"left": images["left"], "right": images["left"]})
    with pytest.raises(ValueError, match=r"left.*right"):
        diagnose(rig, images | {"right": texture(seed=5)})
    with pytest.raises(ValueError, match="'right'"):
        diagnose(rig, {"left": images["left"], "rihgt": images["right"]})
    for count in (0, 3):
        few = {("left", "right"): PointMatches(*torch.rand(2, count, 2).double())}
        with pytest.raises(ValueError, match="points"):
            diagnose_matches(rig, sizes(rig), few)


def test_depths_of_a_rig_of_unknown_scale_are_not_in_metres():
    rig, images = rectified_pair(), rectified_images()
    rig = rig.replace(name=UNSCALED, depth=tuple(20 * float(bound) for bound in rig.depth))
    text = diagnose(rig, images).as_text()
    assert re.search(r"median depth \S+ baselines", text)
    assert re.search(r"excludes the scene, which is \S+ to \S+ baselines away", text)


def test_command_line(tmp_path, capsys):
    rig, images = rectified_pair(), rectified_images()
    files = [f"--image={name}={tmp_path / name}.png" for name in images]
    for name, image in images.items():
        write_image(tmp_path / f"{name}.png", image)
    each(posed(Pose.inverse))(rig).save(tmp_path / "rig.yaml")

    def doctor(name, fixed, *more):
        main(["rig", "doctor", str(tmp_path / name), *files, "--out", str(tmp_path / fixed), *more])

    doctor("rig.yaml", "fixed.yaml")
    said = capsys.readouterr().out
    assert "likely mistake" in said
    assert said.count("median depth") == 1
    given = (tmp_path / "rig.yaml").read_bytes() + b"# Gr\xf6\xdfe\r\n"  # not UTF-8: kept as it is
    (tmp_path / "other.yaml").write_bytes(given)
    doctor("rig.yaml", "other.yaml")
    assert (tmp_path / "other.yaml.old").read_bytes() == given
    doctor("rig.yaml", "rig.yaml")
    assert "former file" in capsys.readouterr().err
    assert (tmp_path / "rig.yaml").read_text() == (tmp_path / "fixed.yaml").read_text()
    assert "likely mistake" not in (tmp_path / "rig.yaml.old").read_text()
    assert Rig.load(tmp_path / "rig.yaml.old")["right"].t[0] > 0
    doctor("fixed.yaml", "none.yaml", "--json")
    captured = capsys.readouterr()
    assert json.loads(captured.out)["healthy"]
    assert "no rig written" in captured.err
    assert not (tmp_path / "none.yaml").exists()
    each(posed(Pose.inverse))(rig.perturbed({"right.centre": vector(3, 0)})).save(tmp_path / "other.yaml")
    with pytest.raises(SystemExit, match="4"):
        doctor("other.yaml", "none.yaml")
    assert not (tmp_path / "none.yaml").exists()


def test_points_whose_equations_are_singular_are_invalid():
    """A rotation in degrees taken for radians leaves a point whose rounded equations cannot be solved."""
    g = np.random.default_rng([6, 5])
    rig = simulated_rig("wide", 2, g)
    (names, matches), *_ = simulated_matches(rig, "wide", g).items()
    in_degrees = posed(lambda p: Pose(turned(p.R, 180 / math.pi), p.t))
    cameras = [in_degrees(camera) for camera in rig.pair(*names).cameras]
    assert not triangulate(cameras, torch.stack(list(matches))).valid.all()


def test_only_a_distortion_may_have_the_wrong_sign():
    """The numbers of a camera model are not negated."""
    cameras = dict(simulated_rig("wide", 2, np.random.default_rng(0)).cameras)
    lenses = (PolynomialFisheye(vector(0.01, -0.02)), Distortion("kannala-brandt", vector(0.1, 0, 0, 0)))
    for name, lens in zip(cameras, lenses):
        cameras[name] = cameras[name].replace(distortion=lens)
    rig = Rig(cameras, depth=(1, 10))
    named = [
        h.words for h in hypotheses(rig, {n: c.hw for n, c in cameras.items()}) if "sign (the" in h.words
    ]
    second = list(cameras)[1]
    assert named == [
        f"distortion of {who} with the wrong sign (the inverse map)" for who in ("all cameras", f"'{second}'")
    ]


def test_a_rig_without_a_depth_range_is_told_one():
    """The range is the one that fusion then searches: it holds all points."""
    rig = unlike_pair()
    points = seen_points(rig)
    assert "states no depth" not in diagnose_matches(rig, sizes(rig), points).as_text()
    found = diagnose_matches(rig.replace(depth=None), sizes(rig), points)
    near, far = (float(bound) for bound in rig.depth)
    assert found.depth is not None
    assert 0.8 * near < found.depth[0] < found.depth[1] < 1.3 * far
    assert f"--depth {found.depth[0]:.3g} {found.depth[1]:.3g}" in found.as_text()
    assert json.loads(found.as_json())["depth"] == list(found.depth)


ONE_PART = {
    "principal point": each(lambda c: with_numbers(c, centre=0.5)),
    "principal point of one": one(lambda c: with_numbers(c, centre=0.5)),
    "focal lengths": each(lambda c: with_numbers(c, focal=0.5)),
    "zoomed": one(lambda c: with_numbers(c, focal=0.7)),
    "x of the translation": one(posed(lambda p: Pose(p.R, p.t * vector(-1, 1, 1)))),
    "NeRF": each(posed(lambda p: p.inverse() @ Pose(OPENGL, torch.zeros(3).double()))),
}


@pytest.mark.parametrize("part", ONE_PART)
def test_mistakes_in_a_part_of_the_numbers_are_named(part):
    rig = same_size(unlike_pair())
    found = diagnose_matches(ONE_PART[part](rig), sizes(rig), seen_points(rig))
    assert part.removesuffix(" of one") in found.named.words, found.verdict
    assert found.after.depth == pytest.approx(
        diagnose_matches(rig, sizes(rig), seen_points(rig)).before.depth, rel=0.02
    )


@pytest.mark.parametrize(
    ("change", "kind"), [({"focal": 0.5, "centre": 0.5}, "resized"), ({"focal": 0.01}, "focal length")]
)
def test_what_lines_cannot_see_the_size_of_the_image_can(change, kind):
    """Rectified pairs of which one image is resized."""
    rig = rectified_pair()
    found = diagnose_matches(each(lambda c: with_numbers(c, **change))(rig), sizes(rig), seen_points(rig))
    assert found.named.kind == kind
    assert not found.healthy


@pytest.mark.parametrize("which", [one, each])
def test_a_cropped_image_is_named(which):
    """A fifth was cut off at the left and the top, and K is for the whole image."""
    rig = same_size(unlike_pair())
    offset = vector(0, 0, 1)
    cut = which(lambda c: c.replace(K=c.K + 0.2 * vector(c.hw[1], c.hw[0], 0)[:, None] * offset))
    found = diagnose_matches(cut(rig), sizes(rig), seen_points(rig))
    assert found.named.kind == "cropped", found.verdict
    off = found.named.rig["second"].K[:2, 2] - rig["second"].K[:2, 2]
    assert off.norm() < 0.05 * max(rig["second"].hw)


def test_a_drifted_principal_point_is_no_crop():
    """It stays where those of whole images are."""
    rig = same_size(unlike_pair())
    drifted_rig = rig.perturbed({"second.centre": vector(-20, 10)})
    found = diagnose_matches(drifted_rig, sizes(rig), seen_points(rig))
    assert "cropped" not in {hypothesis.kind for hypothesis in found.tried}


def test_evidence_is_that_of_the_best_drift_that_was_met():
    """The first step overshoots; the cost was that of the start, and the drift another."""
    rig = unlike_pair()
    ((names, points),) = seen_points(rig).items()
    used = torch.ones(len(points.alpha), dtype=torch.bool)
    found = DriftEvidence.from_points(one(cropped)(rig), {names: points}, used, 0.1)
    assert found.cost == pytest.approx(found._at(found.z, used))


def test_an_odd_principal_point_that_points_confirm_is_healthy():
    """A sensor that is off its lens's axis by a tenth of its side."""
    rig = same_size(unlike_pair()).perturbed({"second.centre": vector(32, -16)})
    found = diagnose_matches(rig, sizes(rig), seen_points(rig))
    assert found.healthy, found.verdict


def test_which_of_two_cameras_was_zoomed_is_left_open():
    """Lines of a rectified pair tell the ratio of the focal lengths alone."""
    rig = rectified_pair()
    bad = on_cameras(rig, ["left"], lambda c: with_numbers(c, focal=0.7)).replace(depth=None)
    found = diagnose_matches(bad, sizes(rig), seen_points(rig))
    assert found.named.kind == "focal length", found.verdict
    assert {"left", "right"} == set(re.findall("left|right", found.verdict))
    assert not found.certain


def test_a_factory_calibration_is_healthy():
    """1.3 px are as small a share of an image as factories reach."""
    rig = unlike_pair()
    some = rig.perturbed({"second.rotation": vector(0.0008, -0.0005, 0.0008)})
    found = diagnose_matches(some, sizes(rig), seen_points(rig))
    assert 0.2 < found.before.misfit < 0.48
    assert found.healthy
    assert "refine" in found.verdict


def test_points_beyond_the_end_of_a_lens_count_for_nobody():
    """A factory lens with a pole within its image: points beyond do not make its rig 1000 px off."""
    c = [-9.2, 65.3, 0, 0, -87.72, -9.278, 65.55, -87.83]
    K = torch.tensor([[808.0, 0, 640], [0, 808, 400], [0, 0, 1]], dtype=torch.float64)
    lens = Distortion("brown-conrady", torch.tensor(c, dtype=torch.float64))
    left = Camera(K=K, cam_from_world=Pose.identity(), hw=(800, 1280), distortion=lens)
    right = left.replace(cam_from_world=Pose(torch.eye(3).double(), torch.tensor([-0.075, 0, 0]).double()))
    rig = Rig({"left": left, "right": right})
    g = torch.Generator().manual_seed(0)
    depth = 1 + 3 * torch.rand(1500, generator=g, dtype=torch.float64)
    xy = (torch.rand(1500, 2, generator=g, dtype=torch.float64) - 0.5) * torch.tensor([1.5, 0.9])
    X = torch.cat([xy, torch.ones(1500, 1)], -1) * depth[:, None]

    def seen(camera: Camera) -> torch.Tensor:
        """The formula's pixels, of points beyond the pole too."""
        x = (X + camera.t)[:, :2] / X[:, 2:]
        u = x.square().sum(-1, keepdim=True)
        k1, k2, _, _, k3, k4, k5, k6 = c
        x = x * (1 + u * (k1 + u * (k2 + u * k3))) / (1 + u * (k4 + u * (k5 + u * k6)))
        return x * 808 + K[:2, 2] + 0.05 * torch.randn(x.shape, generator=g, dtype=torch.float64)

    points = PointMatches(seen(left), seen(right))
    inside = left.contains(points.alpha) & right.contains(points.beta)
    inside &= (xy.norm(dim=-1) > 0.72) | (torch.rand(1500, generator=g) < 0.1)
    found = diagnose_matches(rig, sizes(rig), {("left", "right"): points.only(inside)})
    assert found.healthy
    assert found.beyond > 50
    assert f"{found.beyond} of" in found.as_text()
