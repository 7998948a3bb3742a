import dataclasses
import math
import re
from functools import partial

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from arraygeom import (
    Camera,
    Curved,
    Distortion,
    Epipolar,
    EpipolarLine,
    LensView,
    Pose,
    Rig,
    View,
    epipolar_distance,
    intrinsics,
    pixel_grid,
    resize_matrix,
    rig_check,
    rotation_from_vector,
)
from arraygeom.io import read_rig
from arraygeom.lenses import FlatPort, Orthographic, RollingShutter
from arraygeom.pose import rotation_error
from arraygeom.runtime.text import UNSCALED
from arraygeom.summary import summarise_cameras, summarise_pairs
from tests.arraygeom.rigs import known_by_f, parallel_rig, random_rig, scene_points, two_cameras

EVERYTHING = ("rotation", "translation", "focal", "centre")


def test_a_pair_follows_what_happens_to_betas_image_as_its_rig_does():
    for rig in (random_rig(0), known_by_f(random_rig(0))):
        one, other = rig.pair("alpha", "beta"), rig.resize("beta", (30, 31))
        one = one.transform_beta(resize_matrix(one.beta.hw, (30, 31)), (30, 31))
        assert one.beta.hw == other["beta"].hw
        torch.testing.assert_close(one.fundamental, other.pair("alpha", "beta").fundamental)


@pytest.mark.parametrize(
    "change",
    [
        lambda r, n: r.resize(n, (30, 31)),
        lambda r, n: r.crop(n, 2, -5, (20, 90)),
        lambda r, n: r.rot90(n, 1),
        lambda r, n: r.rot90(n, 2),
    ],
)
@pytest.mark.parametrize("name", ["alpha", "beta"])
def test_links_follow_what_happens_to_images(change, name):
    """The calibrated rig is the oracle of the uncalibrated one."""
    known, unknown = change(random_rig(0), name), change(known_by_f(random_rig(0)), name)
    assert known[name].hw == unknown[name].hw
    X = scene_points(random_rig(0))
    x_alpha, x_beta = (known[n].project(X).x for n in ("alpha", "beta"))
    F = unknown.pair("alpha", "beta").fundamental
    assert epipolar_distance(F, x_alpha, x_beta).abs().max() < 1e-9
    H = unknown.pair("alpha", "beta").homography
    expected = known.pair("alpha", "beta").homography
    torch.testing.assert_close(H / H[2, 2], expected / expected[2, 2])


def test_a_link_serves_both_ways():
    forth, back = (known_by_f(random_rig(0)).pair(*names) for names in (("alpha", "beta"), ("beta", "alpha")))
    torch.testing.assert_close(back.fundamental, forth.fundamental.T)
    torch.testing.assert_close(back.homography @ forth.homography, torch.eye(3, dtype=torch.float64))


def test_what_is_not_free_stays_bit_identical():
    rig = random_rig(0)
    changes = rig.parameters(free=["beta.rotation", "beta.focal", "depth.near"])
    moved = rig.perturbed({name: v + 0.01 for name, v in changes.items()})
    assert torch.equal(moved["alpha"].K, rig["alpha"].K)
    assert torch.equal(moved["alpha"].R, rig["alpha"].R)
    assert torch.equal(moved["alpha"].t, rig["alpha"].t)
    assert torch.equal(moved["beta"].t, rig["beta"].t)
    assert torch.equal(moved["beta"].K[:, 2], rig["beta"].K[:, 2])
    assert torch.equal(moved.depth[1], rig.depth[1])
    torch.testing.assert_close(moved["beta"].K.diagonal()[:2], rig["beta"].K.diagonal()[:2] + 0.01)
    assert moved.depth[0] == rig.depth[0] + 0.01
    assert not torch.equal(moved["beta"].R, rig["beta"].R)


@pytest.mark.parametrize("turns", range(4))
def test_focal_lengths_of_rotated_images(turns):
    """Changing the focal length and turning commute."""
    rig = random_rig(0)
    change = {"beta.focal": torch.tensor([1.0, 2.0], dtype=torch.float64)}
    a, b = rig.perturbed(change).rot90("beta", turns), rig.rot90("beta", turns).perturbed(change)
    torch.testing.assert_close(a["beta"].K, b["beta"].K)


def test_an_optimiser_finds_a_disturbed_camera_and_stays_on_the_manifold():
    """1,000 steps on rotation and translation of beta bring its projections back."""
    rig = random_rig(1)
    X = scene_points(rig, 50)
    target = rig["beta"].project(X).x
    g = torch.Generator().manual_seed(0)
    names = [f"beta.{p}" for p in ("rotation", "translation")]
    guess = rig.perturbed({n: 0.03 * torch.randn(3, generator=g, dtype=torch.float64) for n in names})
    before = (guess["beta"].project(X).x - target).abs().max()
    for _ in range(1000):
        changes = guess.parameters(free=names)
        loss = (guess.perturbed(changes)["beta"].project(X).x - target).square().mean()
        slopes = torch.autograd.grad(loss, list(changes.values()))
        guess = guess.perturbed({n: -2e-5 * s for n, s in zip(names, slopes)})
    assert rotation_error(guess["beta"].R) < 1e-15
    assert (guess["beta"].project(X).x - target).abs().max() < 0.2 * before


def test_patterns_choose_parameters():
    rig = random_rig(0)
    assert set(rig.parameters(free=["beta.*"])) == {f"beta.{p}" for p in EVERYTHING}
    assert set(rig.parameters(free=["*.focal", "depth.*"])) == {
        "alpha.focal",
        "beta.focal",
        "depth.near",
        "depth.far",
    }
    assert all(v.requires_grad and not v.any() for v in rig.parameters(free=["*"]).values())


def test_wrong_names_are_refused():
    rig = random_rig(0)
    with pytest.raises(ValueError, match="'beta'"):
        rig["bta"]
    with pytest.raises(ValueError, match="'gamma"):
        rig.parameters(free=["gamma.*"])
    with pytest.raises(ValueError, match=r"beta\.zoom"):
        rig.perturbed({"beta.zoom": torch.zeros(2)})


@pytest.mark.parametrize("depth", [(0, 1), (3, 2), (-1, 2), (float("nan"), 2)])
def test_impossible_depths_are_refused(depth):
    with pytest.raises(ValueError, match="0 < near <= far"):
        two_cameras(depth=depth)


def test_pairs_say_what_they_lack():
    rig = Rig({"a": View(hw=(4, 6)), "b": View(hw=(8, 12))})
    pair = rig.pair("a", "b")
    torch.testing.assert_close(pair.homography, resize_matrix((4, 6), (8, 12)))
    for wanted, words in (("cameras", "calibrated"), ("depth_range", "depth"), ("fundamental", "link")):
        with pytest.raises(ValueError, match=words):
            getattr(pair, wanted)


def test_betas_and_replacement():
    rig = random_rig(0).with_camera("third", View(hw=(5, 5)))
    assert rig.betas("beta") == ("alpha", "third")
    assert rig.to(torch.float32).pair("alpha", "beta").fundamental.dtype == torch.float32


def test_a_scaled_rig_shows_the_scaled_scene_alike():
    rig, X = random_rig(0).replace(depth=(1.0, 4.0)), scene_points(random_rig(0))
    scaled = rig.scaled(1e3)
    for name in rig.names:
        torch.testing.assert_close(scaled[name].project(1e3 * X).x, rig[name].project(X).x)
    assert [float(bound) for bound in scaled.depth] == [1e3, 4e3]
    numbers = {"distance": 0.02, "thickness": 0.01, "glass": 1.5, "water": 1.33}
    port = FlatPort(**{name: torch.tensor(value).double() for name, value in numbers.items()})
    view = LensView(hw=(4, 6), K=intrinsics(5.0, (4, 6)), distortion=port)
    assert float(Rig({"a": view}).scaled(1e3)["a"].distortion.distance) == pytest.approx(20)
    assert known_by_f(random_rig(0)).scaled(2.0).links == known_by_f(random_rig(0)).links


@pytest.mark.parametrize("turned", [False, True])
def test_overlap_of_large_images_through_lenses_is_checked_by_few_pixels(monkeypatch, turned):
    """Fifteen such cameras are 210 pairs: a coarse grid of pixels is enough for each."""
    lens, asked = Distortion("brown-conrady", torch.tensor([-0.1, 0.01, 0, 0]).double()), []
    undistort = Distortion.undistort
    monkeypatch.setattr(
        Distortion, "undistort", lambda self, x: asked.append(x.numel() // 2) or undistort(self, x)
    )
    behind = rotation_from_vector(torch.tensor([0, torch.pi * turned, 0]).double())
    poses = Pose.identity(), Pose.from_centre(behind, torch.tensor([0.1, 0, 0]).double())
    hw = 3000, 4000
    cameras = [Camera(K=intrinsics(4000, hw), cam_from_world=pose, hw=hw, distortion=lens) for pose in poses]
    odd = Rig({"a": cameras[0], "b": cameras[1]}).check()
    assert sum("sees nothing" in sentence for sentence in odd) == 2 * turned
    assert turned or sum(asked) < 10_000


class Numbers(TorchDispatchMode):
    """Counts the numbers that torch's operators return."""

    count = 0

    def __torch_dispatch__(self, function, types, arguments=(), named=None):
        result = function(*arguments, **(named or {}))
        self.count += sum(x.numel() for x in tree_leaves(result) if isinstance(x, torch.Tensor))
        return result


@pytest.mark.parametrize("own_lenses", [False, True])
def test_a_rig_of_many_cameras_is_described_in_seconds(own_lenses, monkeypatch):
    """No pair of cameras and no lens beyond a number is looked at: twenty thousand would take minutes."""
    monkeypatch.setattr(rig_check, "MOST_LENSES", 10)
    monkeypatch.setattr(rig_check, "MOST_PAIRS", 10)
    lens = torch.tensor([-0.1, 0.01, 0, 0]).double()

    def numbers(count: int) -> int:
        cameras = {
            f"c{i}": Camera(
                K=intrinsics(900.0 + 1e-3 * i * own_lenses, (800, 1000)),
                cam_from_world=Pose.from_centre(
                    torch.eye(3).double(), torch.tensor([0.01 * i, 0, 0]).double()
                ),
                hw=(800, 1000),
                distortion=Distortion("brown-conrady", lens.clone()),
            )
            for i in range(count)
        }
        with Numbers() as counted:
            Rig(cameras).check()
            summarise_cameras(Rig(cameras), 10)
        return counted.count

    few, more = numbers(40), numbers(160)
    assert more < 1.5 * few


def test_a_pixel_of_parallel_rays_covers_the_same_at_any_depth():
    camera = Camera(
        K=intrinsics(500.0, (8, 10)), cam_from_world=Pose.identity(), hw=(8, 10), distortion=Orthographic()
    )
    (summary,) = summarise_cameras(Rig({"a": camera}, depth=(1.0, math.inf)))
    assert summary.footprint == (2.0, 2.0)


def test_some_of_many_different_lenses_are_looked_at(monkeypatch):
    monkeypatch.setattr(rig_check, "MOST_LENSES", 10)
    looked, fold = [], Distortion("brown-conrady", torch.tensor([-0.6, 0, 0, 0]).double())
    coverage = rig_check.coverage
    monkeypatch.setattr(rig_check, "coverage", lambda camera: looked.append(camera) or coverage(camera))
    cameras = {
        f"c{i}": Camera(K=intrinsics(90.0 + i, (80, 100)), cam_from_world=Pose.identity(), hw=(80, 100))
        for i in range(40)
    }
    rig = Rig({name: camera.replace(distortion=fold) for name, camera in cameras.items()})
    assert any("lens model" in sentence for sentence in rig_check.file_oddities(rig))
    assert len(looked) == 10


def test_a_rig_under_water_without_a_depth_range_is_checked():
    """Nothing is known of what such cameras see of each other: no complaint, and no error."""
    one = partial(torch.tensor, dtype=torch.float64)
    port = FlatPort(distance=one(0.05), thickness=one(0.01), glass=one(1.52), water=one(1.333))
    poses = [Pose.identity(), Pose.from_centre(torch.eye(3).double(), torch.tensor([0.1, 0, 0]).double())]
    K = intrinsics(600.0, (480, 640))
    cameras = [Camera(K=K, cam_from_world=pose, hw=(480, 640), distortion=port) for pose in poses]
    assert not any("sees nothing" in s for s in Rig({"a": cameras[0], "b": cameras[1]}).check())


@pytest.mark.parametrize(("t", "depth"), [(1e-3, (50, 100)), (60, (1, 2)), (1e-6, (1, 2))])
def test_what_is_odd_about_a_rig_of_unknown_scale_is_not_in_metres(t, depth):
    poses = [Pose.identity(), Pose.from_centre(torch.eye(3), torch.tensor([t, 0.0, 0.0]))]
    cameras = [Camera(K=intrinsics(90.0, (48, 64)), cam_from_world=pose, hw=(48, 64)) for pose in poses]
    rig = Rig({"a": cameras[0], "b": cameras[1]}, depth=depth)
    in_metres = [
        re.findall(r"\bm?m\b|metres", " ".join(r.check())) for r in (rig, rig.replace(name=UNSCALED))
    ]
    assert in_metres[0]
    assert not in_metres[1]


def test_cameras_at_one_position_are_one_sentence():
    """Five bands whose tags state no translations give one sentence, not one per pair."""
    rig = random_rig(0)
    bands = dict.fromkeys(("blue", "green", "red"), rig["alpha"])
    odd = [s for s in Rig({**bands, "beta": rig["beta"]}).check() if "same position" in s]
    assert odd == ["'blue', 'green' and 'red' are at the same position: between them depth has no effect"]


@pytest.mark.parametrize(
    ("centre", "turn", "steps"),
    [
        ((0.5, 0, 0), 0.0, (2 * 2 / 50, 10 * 10 / 50)),  # beside: depth^2 / (focal length x baseline)
        ((0, 0, 12.0), math.pi, (None, None)),  # facing
        ((0, 0, 1.0), 0.0, (None, None)),  # ahead
        ((6.0, 0, 6.0), -math.pi / 2, (None, None)),  # from the side
    ],
)
def test_a_pixel_of_depth_is_what_moves_the_point_by_a_pixel(centre, turn, steps):
    K = intrinsics(100.0, (60, 100))
    alpha = Camera(K=K, cam_from_world=Pose.identity(), hw=(60, 100))
    R = rotation_from_vector(torch.tensor([0, turn, 0], dtype=torch.float64))
    pose = Pose.from_centre(R, torch.tensor(centre, dtype=torch.float64))
    beta = alpha.replace(cam_from_world=pose)
    (summary,) = summarise_pairs(Rig({"alpha": alpha, "beta": beta}, depth=(2.0, 10.0)), "alpha")
    x = pixel_grid((60, 100), dtype=torch.float64).reshape(-1, 2)
    for depth, step, expected in zip((2.0, 10.0), summary.depth_step, steps):
        here = beta.project(alpha.unproject(x, torch.full_like(x[:, 0], depth)))
        there = beta.project(alpha.unproject(x, torch.full_like(x[:, 0], depth + step)))
        seen = here.valid & there.valid & beta.contains(here.x)
        if not seen.any():
            assert math.isnan(step)
            continue
        assert float((there.x - here.x).norm(dim=-1)[seen].median()) == pytest.approx(1, rel=0.2)
        assert expected is None or step == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("factor", [1e3, 1e-6])
@pytest.mark.parametrize(
    ("field", "moves"), [(Epipolar(), False), (EpipolarLine(), False), (Curved(9), False), (Curved(9), True)]
)
def test_fields_in_another_unit_are_the_same(field, moves, factor):
    """Near and far limits of lines and infinity scale with the rig's unit."""
    rig = random_rig(0).replace(depth=(1.0, math.inf))
    if moves:
        velocity, rotation, readout = (
            torch.tensor(v).double() for v in ([1.0, 0.2, 0.1], [0.1, 0.2, 0.3], 0.02)
        )
        shutter = RollingShutter(velocity=velocity, rotation=rotation, readout=readout)
        rig = rig.with_camera("beta", dataclasses.replace(rig["beta"], distortion=shutter))
    x = pixel_grid(rig["alpha"].hw).double()
    found, wanted = (field(r.pair("alpha", "beta"), x) for r in (rig.scaled(factor), rig))
    for part, value in vars(wanted).items():
        torch.testing.assert_close(vars(found)[part], value, rtol=0, atol=1e-6)


def test_what_torch_offers_of_a_tensor_a_rig_offers_too():
    rig = two_cameras(centre=(0.3, 0.0, 0.0), depth=(1.0, 8.0))
    name = rig.names[1]
    assert rig.float()[name].K.dtype == torch.float32
    assert rig.float().double()[name].K.dtype == torch.float64
    assert rig.double() == rig.cpu() == rig
    free = rig.clone().requires_grad_()
    assert free[name].K.requires_grad
    assert not rig[name].K.requires_grad
    copied = free.clone()
    copied[name].t.sum().backward()
    assert free[name].cam_from_world.t.grad is not None
    assert not free.detach()[name].K.requires_grad
    assert free.requires_grad_(False)[name].K.requires_grad is False
    meta = rig.to("meta")
    assert meta[name].K.is_meta
    assert meta.depth[0].is_meta
    depth = torch.tensor(2.0, dtype=torch.float64)
    pair = rig.pair(*rig.names)
    assert torch.equal(pair.homography_at(2.0), pair.homography_at(depth))


@pytest.mark.parametrize("factor", [0, -1e-3, float("inf"), float("nan")])
def test_lengths_are_scaled_by_a_positive_factor(factor, tmp_path):
    """A rig scaled by 0 had all cameras at one place, without a word; by -1 it was mirrored."""
    rig = parallel_rig(80.0, (48, 64), {"a": (), "b": (0.1,)}, (1.0, 50.0))
    rig.save(tmp_path / "rig.yaml")
    for scaled in (rig.scaled, rig["b"].scaled, lambda factor: read_rig(tmp_path / "rig.yaml", scale=factor)):
        with pytest.raises(ValueError, match=r"(factor|scale)[^/]*$"):
            scaled(factor)


def test_an_uncalibrated_alpha_has_no_summaries_and_an_unknown_one_is_refused():
    rig = parallel_rig(80.0, (48, 64), {"a": (), "b": (0.1,)}, (1.0, 50.0))
    rig = rig.with_camera("c", View(hw=(48, 64)))
    assert summarise_pairs(rig, "c") == []
    with pytest.raises(ValueError, match="'d'"):
        summarise_pairs(rig, "d")


def test_the_unit_of_a_batch_of_rigs_is_asked_for_one_of_them():
    K = torch.stack([intrinsics(focal, (80, 100)) for focal in (90.0, 95.0)])
    rig = Rig({n: Camera(K=K, cam_from_world=Pose.identity(), hw=(80, 100)) for n in "ab"})
    with pytest.raises(ValueError, match="batch"):
        rig_check.unit_oddity(rig)
    assert rig_check.unit_oddity(rig[0]) is None
