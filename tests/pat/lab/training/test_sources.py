"""Rendered scenes, stereo pairs and lenses as sources of samples: what they give, what is wrong with them."""

import json
import shutil
from dataclasses import replace
from functools import partial
from itertools import islice, pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Generator

from arraygeom import Camera, Pose, Rig, intrinsics, rotation_from_vector
from arraygeom.distortion import BROWN_CONRADY, Distortion
from arraygeom.pixels import pixel_grid
from arraygeom.sampling import sample
from arraygeom.undistortion import resampled
from pat.lab.data.windows import RenderedView, read_view, reduced_depth, undistorted, window
from pat.lab.farm.backends import LayeredSettings
from pat.lab.synthesis.check import CheckLimits
from pat.lab.synthesis.layered import LayeredScenes
from pat.lab.synthesis.patterns import patterns
from pat.lab.synthesis.photos import PhotoBank
from pat.lab.synthesis.rendered import Rendered, save_frame
from pat.lab.synthesis.rig_distribution import RigDistribution
from pat.lab.synthesis.rigs import random_rigs
from pat.lab.training.config import RecordingConfig, TrainConfig, save_config
from pat.lab.training.lenses import lens_over, through_lenses
from pat.lab.training.loop import train
from pat.lab.training.samples import degraded, pair_of, plan, scenes, transfer
from pat.lab.training.scenes import (
    ACTIVE,
    GROUPS_PER_EXCHANGE,
    SKY,
    RenderedCrops,
    active_items,
    batched,
    finite_window,
)
from pat.lab.training.stereo import MeasuredPairs
from pat.media.colour import luminance
from pat.media.images import write_image
from pat.networks.configs import PATConfig

from .runs import losses, short_run
from .test_loop import by_torchrun, ends_as, one_thread, stopped  # noqa: F401

EXACT = RecordingConfig(gain=0, blur=0, noise=0, paper=0)


def generator(seed: int = 0) -> Generator:
    return Generator().manual_seed(seed)


def make_rig() -> Rig:
    """Alpha, a wider beta that is turned, and one that sees half as much."""
    turned = rotation_from_vector(torch.tensor([0.01, 0.03, 0.02]).double())
    wide, tele = (torch.tensor(t).double() for t in ([-0.1, 0.01, 0.0], [0.08, 0.02, 0.01]))
    cameras = {
        "mono": Camera(K=intrinsics(130.0, (96, 128)), cam_from_world=Pose.identity(), hw=(96, 128)),
        "wide": Camera(K=intrinsics(80.0, (80, 112)), cam_from_world=Pose(turned, wide), hw=(80, 112)),
        "tele": Camera(K=intrinsics(250.0, (96, 128)), cam_from_world=Pose(turned.mT, tele), hw=(96, 128)),
    }
    return Rig(cameras, depth=(2.0, 12.0))


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    """Four layered scenes of patterns; copy what you break."""
    root = tmp_path_factory.mktemp("rendered")
    render = LayeredSettings(layers=(4, 7), oversampling=1).renderer(make_rig(), CheckLimits())
    for seed in range(4):
        render(seed, root / "scenes" / f"{seed:06d}")
    return root


@pytest.fixture
def broken(rendered, tmp_path):
    shutil.copytree(rendered, tmp_path / "data")
    return tmp_path / "data"


def stereo(folder, *, count: int = 4, hw: tuple[int, int] = (80, 120), disparity: int = 6):
    """Pairs cut from wide smooth images: what left has at x, right has at x - disparity; the scale is 3."""
    for i in range(count):
        coarse = torch.rand(1, 3, hw[0] // 6, hw[1] // 6, generator=generator(i))
        wide = torch.nn.functional.interpolate(coarse, (hw[0], hw[1] + disparity), mode="bicubic").clamp(
            0, 1
        )[0]
        one = folder / "2006_third" / str(i)
        write_image(one / "view1.png", wide[:, :, :-disparity])
        write_image(one / "view5.png", wide[:, :, disparity:])
        for name in ("disp1.png", "disp5.png"):
            write_image(one / name, torch.full((1, *hw), 3 * disparity / 255))
    return folder


def at(given, position):
    """Beta's colours at positions (B, 32, 48, 2) of alpha's pixels in it."""
    found = sample(given.betas[0], position.to(given.ground_truth).flatten(1, 2)).values
    return found.unflatten(2, (32, 48))


def refused(crops, root, hw=(32, 48), **how):
    """Return the one line that refuses a folder that cannot be used."""
    with pytest.raises(ValueError) as caught:
        crops([root], hw=hw, **how).sample(8, generator(), number=0)
    assert "\n" not in str(caught.value)
    return str(caught.value)


# What steps are made of ------------------------------------------------------------------------------------


def test_without_these_sources_all_steps_are_of_layered_scenes():
    kinds = {p.kind for p in islice(plan(TrainConfig(), 1), 200)}
    assert kinds == {"rectified", "general"}
    assert {p.kind for p in islice(plan(TrainConfig(rectified=1.0), 1), 200)} == {"rectified"}


def test_shares_are_shares():
    config = TrainConfig(
        rendered=0.3, rendered_from=(Path("a"),), measured=0.2, measured_from=(Path("b"),), reuse=1.0
    )
    kinds = [p.kind for p in islice(plan(config, 0), 2000)]
    assert kinds.count("rendered") / 2000 == pytest.approx(0.3, abs=0.03)
    assert kinds.count("measured") / 2000 == pytest.approx(0.2, abs=0.03)
    assert kinds.count("rectified") == pytest.approx(kinds.count("general"), rel=0.2)


def test_all_items_are_drawn_equally_often():
    count = ACTIVE + 5
    drawn = [active_items(number, count, 3) for number in range(20 * GROUPS_PER_EXCHANGE * count)]
    assert all(len(hand) == len(set(hand)) == ACTIVE for hand in drawn)
    assert all(len(set(a) ^ set(b)) <= 2 for a, b in pairwise(drawn))
    times = torch.bincount(torch.tensor(drawn[GROUPS_PER_EXCHANGE * ACTIVE :]).flatten())
    assert len(times) == count
    assert times.max() <= 1.2 * times.min()
    assert active_items(40, count, 3) == drawn[40] != active_items(40, count, 4)
    newest = [active[0] for active in drawn[::GROUPS_PER_EXCHANGE]]
    assert sorted(newest[:count]) == sorted(newest[count : 2 * count])
    assert newest[:count] != newest[count : 2 * count]


# Rendered scenes -------------------------------------------------------------------------------------------


def through(root):
    """Put lenses before two cameras of every scene: images distorted, nothing known beyond the old ones."""
    for folder in (root / "scenes").iterdir():
        source = Rendered(folder)
        rig = source.rig
        for name, k1 in (("mono", -0.4), ("wide", 0.3)):
            lens = Distortion(BROWN_CONRADY, torch.tensor([k1, 0.01, 0, 0]).double())
            camera, frame = rig[name], source.frame(name)
            lossy = camera.replace(distortion=lens)
            depth = resampled(frame.depth[None], camera, lossy, interpolation="nearest")
            rgb = resampled(frame.rgb, camera, lossy).values[0].clamp(min=0)
            known = torch.where(depth.valid[0], depth.values[0, 0], torch.nan)
            plain = replace(frame, rgb=rgb, depth=known)
            save_frame(folder / source.about["frames"][name][0]["file"], plain)
            rig = rig.with_camera(name, lossy)
        rig.save(folder / "rig.yaml")
    return root


@pytest.mark.parametrize("lenses", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_true_depth_says_where_alphas_pixels_are_in_beta(lenses, broken):
    crops = RenderedCrops([through(broken) if lenses else broken], hw=(32, 48))
    seen, moved, visible = [], [], []
    for number in range(4):
        given = degraded(crops.sample(4, generator(number), number=number), generator(), recording=EXACT)
        assert given.position[0].isfinite().all()
        found = at(given, given.position[0])
        for image, collected in ((given.ground_truth, seen), (given.ground_truth.roll(3, -1), moved)):
            collected.append((found - image).abs().mean(1)[given.visible[0]].quantile(0.8))
        visible.append(given.visible[0].float().mean())
    assert torch.stack(visible).mean() > 0.5
    assert torch.stack(seen).mean() < 0.015
    assert torch.stack(moved).mean() > 3 * torch.stack(seen).mean()


def test_scenes_behind_lenses_are_undistorted(rendered, broken):
    """Colours and depth are those of the same ray in the image without a lens."""
    folder = through(broken) / "scenes" / "000001"
    before, view = Rendered(rendered / "scenes" / "000001"), undistorted(read_view(folder, "mono"))
    assert view.camera.distortion is None
    assert view.depth.isnan().any()
    x = pixel_grid((96, 128), dtype=torch.float64)[4:-4:3, 4:-4:3].flatten(0, 1)
    where = view.camera.project_local(before.rig["mono"].rays(x)[0]).x.float()
    ours, theirs = (torch.cat([v.rgb, v.depth[None]])[None] for v in (view, before.frame("mono")))
    found = sample(ours, where[None], interpolation="nearest").values[0]
    error = (found - sample(theirs, x[None].float()).values[0]).abs()
    assert error[:3].mean(0).quantile(0.8) < 0.02
    assert (error[3] < 0.1).float().mean() > 0.9


def test_windows_reach_beyond_images():
    camera = Camera(K=intrinsics(5.0, (4, 6)), cam_from_world=Pose.identity(), hw=(4, 6))
    view = RenderedView(torch.rand(3, 4, 6), torch.rand(4, 6) + 1, camera)
    beyond = window(view, -1, 3, (6, 6), (6, 6))
    assert torch.equal(beyond.rgb[:, 1:5, :3], view.rgb[:, :, 3:])
    assert torch.equal(beyond.rgb[:, 0, 3:], view.rgb[:, 0, 5:].expand(3, 3))
    assert torch.equal(beyond.depth.isfinite().nonzero().amin(0), torch.tensor([1, 0]))
    assert beyond.depth.isfinite().sum() == 4 * 3
    X = torch.tensor([0.3, -0.2, 2.0]).double()
    torch.testing.assert_close(
        beyond.camera.project(X).x, camera.project(X).x - torch.tensor([3.0, -1.0]).double()
    )


def test_reduced_depth_is_exact_on_planes_and_takes_sides_at_edges():
    plane = (1 / (0.2 + 0.001 * torch.arange(16.0))).expand(1, 8, 16).clone()
    wanted = 1 / (0.2 + 0.001 * ((torch.arange(4.0) + 0.5) * 4 - 0.5))
    torch.testing.assert_close(reduced_depth(plane, (2, 4))[0, 0], wanted)
    near = plane[0, 0, 5].item()
    plane[..., 6:] = 1.0
    found = reduced_depth(plane, (2, 4))[0, 0]
    assert found[1].item() in (pytest.approx(near), 1.0)
    torch.testing.assert_close(found[2:], torch.ones(2))


def test_any_camera_is_alpha_and_betas_are_others(rendered):
    crops = RenderedCrops([rendered], hw=(32, 48), resolutions=(0.5,))
    focal = {float(c.K[0, 0]) / times for c in make_rig().cameras.values() for times in (1, 2)}
    batches = [crops.sample(3, generator(number), number=number, betas=3) for number in range(12)]
    drawn = torch.cat([b.cameras[0].K[:, 0, 0] for b in batches])
    assert set(drawn.tolist()) == focal
    for batch in batches:
        assert [tuple(image.shape) for image in batch.images] == [(3, 3, 32, 48), *[(3, 3, 16, 24)] * 3]
        assert (batch.cameras[1].K[:, 0, 0] / batch.cameras[0].K[:, 0, 0]).sub(0.5).abs().max() < 0.03
        assert torch.equal(batch.cameras[1].t, batch.cameras[3].t)
        assert not torch.equal(batch.cameras[1].t, batch.cameras[2].t)
        assert (batch.cameras[1].t.norm(dim=1) > 0.05).all()


def test_samples_of_scenes_depend_on_their_number_alone(rendered):
    used, fresh = (RenderedCrops([rendered], hw=(32, 48)) for _ in range(2))
    for number in range(3):
        used.sample(2, generator(number), number=number)
    one, other = (crops.sample(2, generator(9), number=7) for crops in (used, fresh))
    assert all(
        torch.equal(a, b)
        for a, b in zip(
            one.images + one.depth + [one.cameras[0].K], other.images + other.depth + [other.cameras[0].K]
        )
    )


def test_the_sky_is_seen_by_both_at_infinity():
    """Two cameras apart and turned: points without end are where the infinite homography puts them."""
    turn = rotation_from_vector(torch.tensor([0.05, 0.1, 0.02]).double())
    beta = Pose(turn, torch.tensor([-0.5, 0.0, 0.1]).double())
    K = intrinsics(60.0, (32, 48))
    cameras = [Camera(K=K, cam_from_world=pose, hw=(32, 48)) for pose in (Pose.identity(), beta)]
    sky = torch.full((32, 48), torch.inf)
    views = [
        finite_window(RenderedView(torch.rand(3, 32, 48), sky, c), 0, 0, (32, 48), (32, 48)) for c in cameras
    ]
    batch = batched([views], "cpu")
    assert batch.depth_range.max() <= SKY
    position, visible = transfer(pair_of(batch, 1, generator()), batch.depth[0], batch.depth[1])
    x = K @ turn @ torch.linalg.inv(K) @ torch.tensor([20.0, 12.0, 1.0]).double()
    torch.testing.assert_close(position[0, 12, 20].double(), (x / x[2])[:2], atol=1e-3, rtol=0)
    assert visible[0, 12, 20]
    assert visible.float().mean() > 0.5


def test_what_is_wrong_with_scenes(broken, tmp_path):
    said = partial(refused, RenderedCrops)
    (tmp_path / "empty").mkdir()
    assert "rendered" in said(tmp_path / "empty")
    assert "256x128 (mono 128x96, wide 112x80" in said(broken, (128, 256))
    assert "4 are too few" in said(broken, choose=lambda i: i > 10)
    scene = broken / "scenes" / "000002"
    rig = Rig.load(scene / "rig.yaml")
    frames = Rendered(scene).about["frames"]
    for name in rig.names:
        rig = rig.with_camera(name, rig[name].resize((90, 120)))
    rig.save(scene / "rig.yaml")
    assert "000002: the image of '" in (error := said(broken))
    assert "its rig says 120x90: remove it" in error
    for name in rig.names:
        (scene / frames[name][0]["file"]).write_bytes(b"half")
    assert "000002: cannot be read (" in said(broken)
    (scene / "render.json").unlink()
    assert "000002: is not a whole scene (no render.json)" in said(broken)
    rig.replace(cameras={"mono": rig["mono"]}).save(broken / "scenes" / "000000" / "rig.yaml")
    assert "1 of 1 cameras" in said(broken / "scenes" / "000000")


def test_a_flipped_byte_names_the_scene(broken):
    """NumPy raises ValueError for a damaged archive, but zlib.error, TokenError and others too."""
    scene = broken / "scenes" / "000000"
    file = scene / Rendered(scene).about["frames"]["mono"][0]["file"]
    whole, refusals = file.read_bytes(), []
    for i in range(0, len(whole), 101):
        file.write_bytes(whole[:i] + bytes([whole[i] ^ 255]) + whole[i + 1 :])
        try:
            read_view(scene, "mono")
        except ValueError as error:
            refusals.append(str(error))
    assert refusals
    assert all(refusal.startswith(f"{scene}: cannot be read") for refusal in refusals)


# Stereo pairs ----------------------------------------------------------------------------------------------


def test_a_pairs_cameras_put_what_one_shows_where_the_other_shows_it(tmp_path):
    """6 pixels of disparity are (6 / 85) of the nearest depth's: beta has there what alpha has."""
    crops = MeasuredPairs([stereo(tmp_path)], hw=(32, 48))
    sides, reductions = set(), set()
    for number in range(4):
        batch = crops.sample(3, generator(number), number=number)
        given = degraded(batch, generator(), recording=EXACT)
        near, baseline = batch.depth_range[:, 0], batch.cameras[1].t[:, 0]
        sides |= set(baseline.sign().tolist())
        reductions |= set((85 / (48 / near)).round().int().tolist())
        depth = (near * 85 / 6)[:, None, None].expand(3, 32, 48)
        torch.testing.assert_close(batch.depth[0], depth, rtol=1e-3, atol=0)
        assert given.visible[0][..., 8:-8].all()
        assert (at(given, given.position[0]) - given.ground_truth)[..., 8:-8].abs().max() < 0.03
        assert (given.betas[0] - given.ground_truth)[..., 8:-8].abs().max() > 0.1
        torch.testing.assert_close(given.alpha, luminance(given.ground_truth), atol=0.003, rtol=0)
        held = given.fields[0].at(torch.tensor([[24.0, 16.0]]).double())
        assert held.valid.all()
    assert (sides, reductions) == ({-1.0, 1.0}, {1, 2})


def test_betas_of_pairs_are_reduced_and_three_are_bands(tmp_path):
    crops = MeasuredPairs([stereo(tmp_path)], hw=(32, 48), resolutions=(0.25,))
    batch = crops.sample(2, generator(), number=0, betas=3)
    assert [tuple(i.shape[2:]) for i in batch.images] == [(32, 48), (8, 12), (8, 12), (8, 12)]
    given = degraded(batch, generator(), recording=EXACT)
    assert [tuple(b.shape) for b in given.betas] == [(2, 1, 32, 48)] * 3


def test_middleburys_collections_say_their_largest_disparity(shared_data):
    crops = MeasuredPairs([shared_data / "middlebury" / "2006_third"], hw=(96, 192))
    assert {round(pair.max_disparity) for pair in crops.pairs} == {85}
    assert crops.sample(2, generator(), number=0).images[0].std() > 0.05


def test_what_is_wrong_with_pairs(tmp_path):
    said = partial(refused, MeasuredPairs)
    (tmp_path / "empty").mkdir()
    assert "stereo" in said(tmp_path / "empty")
    root = stereo(tmp_path / "pairs")
    assert "120x80" in said(root, (96, 256))
    file = root / "2006_third" / "2" / "view5.png"
    whole = file.read_bytes()
    write_image(file, torch.rand(3, 80, 119))
    assert "view5.png 119x80" in said(root)
    write_image(file, torch.rand(1, 80, 120))
    assert "view5.png 120x80" in said(root)
    write_image(file.with_name("view1.png"), torch.rand(1, 80, 120))
    assert "grey" in said(root)
    file.write_bytes(b"nothing")
    assert "view5.png" in said(root)
    for image in root.glob("2006_third/*/view*.png"):
        image.write_bytes(whole[: len(whole) // 2])
    assert "view1.png" in said(root)


# Lenses ----------------------------------------------------------------------------------------------------


RIGS = RigDistribution(mode="general", parallax=(4.0, 12.0), resolutions=(1.0,))


@pytest.fixture(scope="module")
def scene():
    bank = PhotoBank(patterns(np.random.default_rng(0), 6))
    return LayeredScenes(bank, RIGS, hw=(48, 64)).sample(3, generator())


@pytest.mark.parametrize("mode", ["rectified", "general"])
def test_a_lens_sees_all_that_the_pinhole_sees_but_for_what_is_lost(mode):
    strengths = []
    for seed in range(6):
        pinhole = (
            random_rigs(replace(RIGS, mode=mode), 1, (48, 64), generator(seed))
            .cameras[1][0]
            .to(torch.float64)
        )
        lens = lens_over(pinhole, generator(seed))
        rays, valid = pinhole.rays(torch.tensor([[0.0, 0.0], [63, 0], [0, 47], [63, 47], [30, 20]]).double())
        x = lens.project_local(rays)
        assert (valid & x.valid & lens.contains(x.x)).all()
        strengths.append(float(lens.distortion.coefficients[0]))
        lossy = lens_over(pinhole, generator(seed), 0.2)
        assert not lossy.contains(lossy.project_local(rays[:4]).x).all()
    assert min(strengths) < 0 < max(strengths)
    assert max(map(abs, strengths)) <= 0.3


def test_undistorted_images_show_what_they_showed_and_say_what_they_lost(scene):
    smooth = torch.nn.functional.avg_pool2d(scene.images[1], 5, 1, 2)
    undistorted_images = through_lenses(smooth, scene.cameras[1], lambda image: image, generator(1))
    assert undistorted_images.valid[:, 1:-1, 1:-1].all()
    assert (undistorted_images.values - smooth)[..., 3:-3, 3:-3].abs().max() < 0.03
    distorted = []
    cut = through_lenses(smooth, scene.cameras[1], lambda b: distorted.append(b) or b, generator(1), lost=0.3)
    assert (distorted[0] - smooth).abs().max() > 0.1
    assert 0.3 < cut.valid.float().mean() < 0.95
    assert ((cut.values - smooth).abs().amax(1)[cut.valid] < 0.05).float().mean() > 0.97


def test_what_a_lens_lost_is_not_visible(scene):
    plain, lossy = (degraded(scene, generator(2), recording=replace(EXACT, lens=p)) for p in (0.0, 1.0))
    torch.testing.assert_close(plain.ground_truth, scene.images[0], atol=0.003, rtol=0)
    assert not (lossy.visible[0] & ~degraded(scene, generator(2), recording=EXACT).visible[0]).any()
    assert lossy.visible[0].float().mean() < plain.visible[0].float().mean()
    assert (lossy.ground_truth - plain.ground_truth)[..., 4:-4, 4:-4].abs().mean() < 0.01


# Runs ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def mixed(rendered, tmp_path_factory):
    """A run on all sources, never stopped."""
    folder = tmp_path_factory.mktemp("mixed")
    sources = {
        "rendered": 0.5,
        "rendered_from": (rendered,),
        "measured": 0.5,
        "measured_from": (stereo(folder / "pairs"),),
    }
    cheap = {
        "network": PATConfig(dim=4),
        "steps": 6,
        "validate": 6,
        "batch": 1,
        "hw": (16, 32),
        "photos": (),
        "cache": None,
    }
    config = replace(
        short_run(folder), **sources, **cheap, recording=RecordingConfig(lens=0.5), out=folder / "whole"
    )
    train(config)
    return config


def test_a_run_on_all_sources_goes_on_bit_for_bit(mixed, monkeypatch):
    kinds = {p.kind for p in islice(plan(mixed, mixed.seed + 1), mixed.steps)}
    assert {"rendered", "measured"} == kinds
    config = replace(mixed, out=mixed.out.with_name("stopped"))
    stopped(config, 5, monkeypatch)
    train(config)
    assert losses(config.out) == losses(mixed.out)
    lines = [json.loads(line) for line in (mixed.out / "log.jsonl").read_text().splitlines()]
    assert lines[-1]["psnr"] > 5


@pytest.mark.slow
def test_two_processes_on_all_sources_are_as_one(mixed):
    config = replace(mixed, out=mixed.out.with_name("two"))
    save_config(config, config.out.with_suffix(".yaml"))
    ends_as(by_torchrun(config, config.out.with_suffix(".yaml"), None), config, mixed)


def test_photographs_are_not_needed_where_everything_comes_from_folders(mixed):
    learn, examine = scenes(mixed)
    assert len(list(learn(3))) == 3
    assert {str(f) for f in learn.folders["rendered"].folders}.isdisjoint(
        map(str, examine.folders["rendered"].folders)
    )
    assert set(learn.folders["measured"].pairs).isdisjoint(examine.folders["measured"].pairs)
