"""Several RGB betas of one scene: what one cannot see another can."""

from dataclasses import replace

import pytest
import torch

from arraygeom import Camera, Pose, Rig, Segments, intrinsics, pixel_grid
from arraygeom.fields import pinhole_track
from arraygeom.runtime.chunks import tiles_of
from pat import fuse
from pat.fusion.inputs import frame_inputs
from pat.fusion.views import Views
from pat.matching import inputs as inputs_module
from pat.matching import multiview as several
from pat.matching.colour_transfer import transferred
from pat.matching.inputs import Colours, Matches
from pat.matching.match import in_each_beta, located, match
from pat.matching.multiview import NEAR as AGREES
from pat.matching.multiview import MatchedBeta, agreed, with_likeliest_colours
from pat.media.colour import luminance
from pat.networks.guided import combined
from pat.networks.weights import load_weights
from pat.support.metrics import score

H, W = 96, 192
NEAR, FAR = 2.0, 8.0


@pytest.fixture(scope="module")
def network():
    return load_weights("mono-colour")


def smooth_texture(seed, hw):
    g = torch.Generator().manual_seed(seed)
    coarse, fine = (torch.rand(1, 3, hw[0] // n, hw[1] // n, generator=g) for n in (16, 4))
    parts = [
        torch.nn.functional.interpolate(t, size=hw, mode="bicubic", align_corners=False)
        for t in (coarse, fine)
    ]
    return (0.7 * parts[0] + 0.3 * parts[1])[0].clamp(0, 1)


def camera(x):
    """At x metres to the right of alpha: disparity is 24 px per metre of it at 8 m, 96 at 2 m."""
    camera = Camera(K=intrinsics(float(W), (H, W)), cam_from_world=Pose.identity(), hw=(H, W))
    return camera.replace(cam_from_world=Pose(camera.R, camera.t.new_tensor([-x, 0.0, 0.0])))


def seen_from(x):
    """A near square in front of a wall, seen from x metres to the right of alpha."""
    wall, square = smooth_texture(1, (H, W + 128)), smooth_texture(2, (40, 48))
    image = wall[:, :, 64 + round(W / FAR * x) :][:, :, :W].clone()
    left = 72 - round(W / NEAR * x)
    image[:, 28:68, left : left + 48] = square
    return image


@pytest.fixture(scope="module")
def scene():
    cameras = {"mono": camera(0.0), "left": camera(-0.25), "right": camera(0.25)}
    images = {"mono": luminance(seen_from(0.0)), "left": seen_from(-0.25), "right": seen_from(0.25)}
    return Rig(cameras, depth=(NEAR, FAR)), images, seen_from(0.0)


def fused(network, scene, *names):
    rig, images, ground_truth = scene
    frame = fuse({name: images[name] for name in ("mono", *names)}, rig, alpha="mono", network=network)
    return score(frame.image.clamp(0, 1), ground_truth).psnr, frame


def test_two_colour_cameras_on_opposite_sides_see_more_than_either(network, scene):
    (one, left), (other, _), (both, frame) = (
        fused(network, scene, *n) for n in (["left"], ["right"], ["left", "right"])
    )
    assert both > max(one, other) + 1.0
    assert frame.confidence.mean() > left.confidence.mean()
    hidden_on_the_right = (slice(30, 66), slice(126, 138))
    depth = frame.depth[hidden_on_the_right]
    assert (depth - FAR).abs().nanmedian() < 0.5


def carried(bands, weight, likeness, fills=0.0):
    """Colours of four pixels of one band, all alike."""
    plane = torch.zeros(1, 1, 2, 2)
    return Colours(plane + bands, plane + weight, plane + likeness, torch.zeros(1, 1, 1, 2, 2) + fills)


def test_of_betas_each_counts_by_its_odds():
    both = combined([carried(1.0, 0.9, 1.0, fills=1.0), carried(0.0, 0.6, 0.0)])
    for plane in (both.bands, both.likeness, both.fills):
        torch.testing.assert_close(plane, torch.full_like(plane, 9 / (9 + 1.5)))
    torch.testing.assert_close(both.weight, torch.full_like(both.weight, 0.9))
    one = carried(0.3, 0.6, 1.0)
    assert combined([one]) is one


def test_fills_that_betas_share_stay_shared():
    one, other = carried(1.0, 0.9, 1.0), carried(0.0, 0.6, 1.0)
    assert combined([one, other._replace(fills=one.fills)]).fills is one.fills


def test_of_betas_a_pixel_that_one_does_not_see_is_the_others():
    seen, nowhere = carried(1.0, 0.5, 0.0), carried(0.0, 0.0, 1.0)
    assert combined([seen, nowhere]).bands.min() > 0.99
    assert all(plane.isfinite().all() for plane in combined([nowhere, nowhere]))


def test_colours_are_where_a_beta_is_most_like_alpha(network, scene):
    """At its own match or the agreed one; for betas with some of the bands where all agree."""
    rig, images, _ = scene
    inputs = replace(frame_inputs(network, Views.of(rig, images, alpha="mono")).inputs, bands=3)
    found = in_each_beta(replace(inputs, betas=inputs.betas[:1]))
    own = found.betas[0]
    far = own.disparity + torch.where(own.disparity < 10, 7, -7)  # within the segments
    wrong = torch.zeros(own.hw, dtype=torch.bool)
    wrong[20:76, 90:130] = True
    mixed = replace(own, disparity=torch.where(wrong, far, own.disparity))
    agree = replace(own, disparity=torch.where(wrong, own.disparity, far), facts=own.facts + 0.1)
    both = (Matches((one, one)) for one in (mixed, agree))
    taken = with_likeliest_colours(inputs, *both).betas[0]
    seen = own.facts.repeat_interleave(2, -1).repeat_interleave(2, -2)[0, 0] < 0.1
    right = (taken.disparity - own.disparity)[0, 0].abs() < 0.01
    assert right[seen & wrong].double().mean() > 0.85
    assert right[seen & ~wrong].double().mean() > 0.85
    torch.testing.assert_close(taken.facts, own.facts)
    both = (Matches((one, one)) for one in (mixed, agree))
    assert with_likeliest_colours(replace(inputs, bands=6), *both).betas[0] is agree


def test_colour_that_betas_share_is_of_consistent_matches(network, scene):
    rig, images, _ = scene
    inputs = replace(frame_inputs(network, Views.of(rig, images, alpha="mono")).inputs, bands=3)
    one, other = located(replace(inputs, learned=False)).betas
    given = Matches((one, replace(other, facts=torch.ones_like(other.facts))))
    shared, alone = (transferred(replace(inputs, bands=n), given).betas[0].carried.fills for n in (3, 6))
    assert (shared - alone).abs().mean() < 0.05 * alone.abs().mean()


def test_the_order_of_the_betas_does_not_matter(network, scene):
    rig, images, _ = scene
    turned = Rig({n: rig[n] for n in ("mono", "right", "left")}, depth=(NEAR, FAR))
    one, other = (fuse(images, r, alpha="mono", network=network).image for r in (rig, turned))
    assert (one - other).abs().max() < 2e-2
    assert (one - other).abs().mean() < 1e-4


def test_tiles_of_several_betas_are_as_the_whole(network, scene, monkeypatch):
    from pat.fusion import fuse as module

    rig, images, _ = scene
    plan = module.plan_frame
    tiles = list(tiles_of((H, W), 64, 640))
    assert len(tiles) > 1
    whole = fuse(images, rig, alpha="mono", network=network).image
    monkeypatch.setattr(module, "plan_frame", lambda *a, **k: plan(*a, **k)._replace(tiles=tiles))
    assert (fuse(images, rig, alpha="mono", network=network).image - whole).abs().max() < 1e-5


def test_strips_change_nothing_and_pieces_little(network, scene, monkeypatch):
    rig, images, _ = scene
    whole = fuse(images, rig, alpha="mono", network=network).image
    monkeypatch.setattr(several, "STRIP", 10 * W)
    assert (fuse(images, rig, alpha="mono", network=network).image - whole).abs().max() < 1e-6
    monkeypatch.setattr(inputs_module, "SETTINGS", inputs_module.InputsSettings(halo=32, at_once=15_000))
    assert len(frame_inputs(network, Views.of(rig, images, alpha="mono")).inputs.pieces) > 1
    found = fuse(images, rig, alpha="mono", network=network).image
    assert ((found - whole).abs().amax(0) > 0.02).float().mean() < 0.05


def test_a_part_of_the_inputs_has_the_tracks_of_the_whole(network, scene):
    rig, images, _ = scene
    inputs = frame_inputs(network, Views.of(rig, images, alpha="mono")).inputs
    part = inputs.cut((16, 64, 48, 144))
    assert part.can_agree
    x = torch.tensor([[3.0, 5.0], [60.0, 20.0]], dtype=torch.float64)
    depths = torch.tensor([1 / NEAR, 1 / FAR], dtype=torch.float64)
    for own, of_part in zip(inputs.betas, part.betas):
        there = own.track(x + torch.tensor([48.0, 16.0])).at(depths) - torch.tensor(of_part.offset)
        torch.testing.assert_close(of_part.track(x).at(depths), there)


def test_shared_colour_counts_once(network, scene):
    rig, images, _ = scene
    matches = match(frame_inputs(network, Views.of(rig, images, alpha="mono")).inputs)
    one, other = matches.betas
    assert one.carried.fills is other.carried.fills
    assert matches.nbytes == H * W * (2 * (8 + 3 + 4) + 2 * 2 * (3 + 1 + 1) + 2 * 3)
    one, other = matches.cut((0, 32, 0, 64)).betas
    assert one.carried.fills is other.carried.fills


def test_a_band_camera_beside_a_colour_camera_gives_better_depth(network, scene):
    rig, images, _ = scene
    frame = fuse(images | {"right": luminance(images["right"])}, rig, alpha="mono", network=network)
    _, alone = fused(network, scene, "left")
    assert frame.image.shape[0] == 3
    depth = torch.full((H, W), FAR)
    depth[28:68, 72:120] = NEAR
    one, both = (float(((f.depth - depth).abs() > 0.5).float().mean()) for f in (alone, frame))
    assert both < 0.8 * one


def test_uncalibrated_colour_cameras_are_fused_too(network, scene):
    from arraygeom import Link
    from arraygeom import View as Known

    rig, images, _ = scene
    links = {
        ("mono", n): Link(rig.pair("mono", n).fundamental, rig.pair("mono", n).homography)
        for n in ("left", "right")
    }
    known = Rig({n: Known(hw=rig[n].hw) for n in rig.cameras}, links=links)
    frame = fuse(images, known, alpha="mono", network=network)
    assert frame.image.shape == (3, H, W)
    assert frame.depth.isnan().all()


def test_the_depth_buffer_finds_what_is_hidden():
    """A near and a far point at one pixel of beta: the far one is hidden by their disparities' difference."""
    hw = (4, 8)
    pair = Rig({"a": camera(0.0), "b": camera(1.0)}).pair("a", "b")
    y, x = torch.meshgrid(torch.arange(4.0), torch.arange(8.0), indexing="ij")
    pixels = torch.stack([x, y], -1).double() * 8 + torch.tensor([60.0, 0.0])
    track = pinhole_track(pair, pixels)
    near = torch.full(hw, 1 / NEAR, dtype=torch.float64)
    far = torch.full(hw, 1 / FAR, dtype=torch.float64)
    segments = Segments(track.at(near), track.at(far), torch.ones(hw, dtype=torch.bool))
    none, facts = torch.zeros(hw).double(), torch.zeros(3, *hw).double()
    view = MatchedBeta(segments, track, none, facts, none, (H, W))
    depths = far.clone()
    depths[1, 7] = 1 / NEAR
    buffer = view.depth_buffer()
    view.splat(depths, buffer)
    found = view.distance_from_front(depths, buffer)
    assert found[1, 7] == 0
    column = (track.at(depths)[1, 7, 0] + 0.5).div(2).floor()
    same = ((track.at(depths)[1, :, 0] + 0.5).div(2).floor() == column) & (depths[1] < 0.4)
    assert same.sum() <= 1
    assert (found[1][same] > AGREES).all()
    assert (found[torch.tensor([0, 2, 3])] == 0).all()
    assert replace(segments, valid=~segments.valid).valid.sum() == 0


def test_a_band_unlike_alpha_is_matched_through_one_that_is_like_it():
    """Bright where alpha is dark and where it is bright: neither its sign nor its edges tell the depth."""

    def unlike(image):
        return (2 * luminance(image) - 1).abs().clamp(0, 1)

    network, near = (
        load_weights("mono-spectral"),
        {"alone": {}, "with": {"left": luminance(seen_from(-0.25))}},
    )
    cameras = {"mono": camera(0.0), "right": camera(0.25), "left": camera(-0.25)}
    images = {"mono": luminance(seen_from(0.0)), "right": unlike(seen_from(0.25))}
    found = {}
    for name, more in near.items():
        rig = Rig({n: cameras[n] for n in images | more}, depth=(NEAR, FAR))
        frame = fuse(images | more, rig, alpha="mono", network=network)
        found[name] = score(frame.image[:1].clamp(0, 1), unlike(seen_from(0.0))).psnr
    assert found["with"] > found["alone"] + 3


def test_betas_whose_lengths_do_not_fit_agree_all_the_same(network, scene):
    """Cameras calibrated by pairs: the right one is too far away in the rig, so its depths are too large."""
    _, images, ground_truth = scene
    cameras = {"mono": camera(0.0), "left": camera(-0.25), "right": camera(0.25)}
    wrong = cameras | {"right": camera(0.4)}
    true, found = (
        fuse(images, Rig(c, depth=(NEAR, 2 * FAR)), alpha="mono", network=network).image.clamp(0, 1)
        for c in (cameras, wrong)
    )
    assert score(found, ground_truth).psnr > score(true, ground_truth).psnr - 0.5
    inputs = frame_inputs(network, Views.of(Rig(wrong, depth=(NEAR, 2 * FAR)), images, alpha="mono")).inputs
    alone = in_each_beta(inputs).betas
    scales = sorted(a.scale for a in several.ambiguities(inputs, alone))
    assert 1.0 in scales
    assert scales[1] / scales[0] == pytest.approx(1.6, rel=0.05)
    inputs = frame_inputs(network, Views.of(Rig(cameras, depth=(NEAR, FAR)), images, alpha="mono")).inputs
    assert several.ambiguities(inputs, in_each_beta(inputs).betas) == [several.NO_AMBIGUITY] * 2


def test_a_plane_is_no_ambiguity():
    """Most wrong matches agree with a plane, and so does a flat scene: no reason to bring depths together."""
    y, x = torch.meshgrid(torch.arange(64.0).double(), torch.arange(80.0).double(), indexing="ij")
    g = torch.Generator().manual_seed(3)
    depths = 0.1 + 0.3 * torch.rand(64, 80, generator=g, dtype=torch.float64)
    known, rise = torch.ones(64, 80, dtype=torch.bool), torch.full((64, 80), 100.0, dtype=torch.float64)
    flat = torch.where(torch.rand(64, 80, generator=g) < 0.7, 0.12 + 1e-3 * x, depths)
    scaled = 1.5 * depths + 1e-3 * y - 0.02
    other = several._Sampled(depths, known, rise)
    assert several._Sampled(flat, known, rise).against(other, x, y) == several.NO_AMBIGUITY
    found = several._Sampled(scaled, known, rise).against(other, x, y)
    assert found.scale == pytest.approx(1.5, rel=1e-3)
    assert found.plane == pytest.approx((0, 1e-3, -0.02), abs=1e-5)


def test_depth_is_what_betas_agree_on_of_what_was_chosen_for_each(network, scene):
    """The more certain one counts; `disparity`, where colours are from, stays what it is without a choice."""
    rig, images, _ = scene
    inputs = frame_inputs(network, Views.of(rig, images, alpha="mono")).inputs
    alone, depth = in_each_beta(inputs), torch.full((H, W), FAR, dtype=torch.float64)
    depth[28:68, 72:120] = NEAR
    true = [disparity_of(depth, beta) for beta in inputs.betas]
    given = [
        replace(one, chosen=disparity + off, certainty=torch.full_like(one.facts[:, :2], probability))
        for one, disparity, off, probability in zip(alone.betas, true, (0.0, 5.0), (0.9, 0.1))
    ]
    found, seen = agreed(inputs, Matches(tuple(given))), inputs.betas[0].field.straight.valid[0, :H, :W]
    for one, without, disparity in zip(found.betas, agreed(inputs, alone).betas, true):
        torch.testing.assert_close(one.disparity, without.disparity)
        torch.testing.assert_close(one.facts, without.facts)
        assert without.chosen is None
        off = (one.chosen - disparity)[0, 0, :H, :W].abs()
        assert (off[seen] < 0.01).double().mean() > 0.99


def disparity_of(depth, beta):
    """(1, 1, H, W), of alpha's pixels: how far along their segments, from the end, beta's are."""
    segments, x = beta.field.straight, pixel_grid((H, W), dtype=torch.float64)
    towards = segments.start[0, :H, :W] - segments.end[0, :H, :W]
    along = beta.track(x).at(1 / depth) - segments.end[0, :H, :W]
    return ((along * towards).sum(-1) / towards.norm(dim=-1))[None, None].float().nan_to_num()
