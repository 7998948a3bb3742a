"""Semi-global matching: true depths of a scene found again, the same bits by any road."""

import threading
import time
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch

import arraygeom.runtime.threads
import pat.matching.semi_global
import pat.matching.subpixel
from arraygeom import (
    Camera,
    Dense,
    Epipolar,
    Local,
    NearestVoxels,
    Pair,
    Pose,
    Positions,
    Segments,
    intrinsics,
    lazily,
    pixel_grid,
    rotation_from_vector,
)
from arraygeom.fields.grid import FieldOnGrid
from pat import FuseSettings, fuse, load_weights
from pat.matching import cost
from pat.matching import kernels as kernels
from pat.matching.cost import planes_of
from pat.matching.inputs import BetaMatches, Colours, Comparison, match_positions
from pat.matching.normalisation import Normalisation, equalising_blurs
from pat.matching.semi_global import along_tangents, matched_at_half_size
from pat.media.colour import luminance
from pat.support.memory import limited
from pat.support.metrics import score
from tests.pat.layered_array import ALPHA, middle_of_sample
from tests.pat.matching.matched_scenes import beside, blurred, faint, semi_global_matching

HW = (64, 96)


def parts_of(found: BetaMatches) -> list[torch.Tensor]:
    """All planes that matching and carrying colour over give."""
    return [found.disparity, found.facts, *found.carried]


def test_lengths_of_plain_numbers_are_those_with_gradients():
    start, end = 100 * torch.rand(2, 1, 50, 60, 2, generator=torch.Generator().manual_seed(0))
    end[0, 0] = start[0, 0]
    segments = Segments(start, end, torch.ones(1, 50, 60, dtype=torch.bool))
    plain = segments.length
    freed = Segments(start.requires_grad_(), end, segments.valid)
    assert torch.equal(plain, freed.length.detach())
    (gradient,) = torch.autograd.grad(freed.length.sum(), start)
    assert bool(gradient.isfinite().all())


def pair_of(turn: float) -> Pair:
    """Two cameras, the second beside the first, turned about the axis and smaller in field."""
    camera = Camera(K=intrinsics(80.0, HW), cam_from_world=Pose.identity(), hw=HW)
    R = rotation_from_vector(torch.tensor([0.01, -0.02, turn], dtype=torch.float64))
    beta = Camera(
        K=intrinsics(85.0, (80, 112)),
        cam_from_world=Pose(R, torch.tensor([-0.25, 0.05, 0.0], dtype=torch.float64)),
        hw=(80, 112),
    )
    return Pair(camera, beta, (torch.tensor(1.0).double(), torch.tensor(10.0).double()))


def sampled_at(pair: Pair, step: int) -> Segments:
    hw = HW[0] // step, HW[1] // step
    x = (pixel_grid(hw, dtype=torch.float64) + 0.5) * step - 0.5
    found = lazily(Epipolar(), pair)(x.reshape(-1, 2))
    return Segments(found.start.reshape(1, *hw, 2), found.end.reshape(1, *hw, 2), found.valid.reshape(1, *hw))


def plane_seen(pair: Pair, depth: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Alpha and beta images (1, 1, H, W) of a textured plane facing alpha, its pixels' places in beta."""
    rough = torch.rand(1, 1, 40, 60, generator=torch.Generator().manual_seed(3), dtype=torch.float64)

    def texture(X):
        at = (X[..., :2] / depth * torch.tensor([0.6, 0.9]))[None]
        return torch.nn.functional.grid_sample(
            rough, at, mode="bicubic", padding_mode="reflection", align_corners=True
        )

    x = pixel_grid(HW, dtype=torch.float64).reshape(-1, 2)
    X = pair.alpha.unproject(x, torch.full((len(x),), depth, dtype=torch.float64))
    where = pair.beta.project(X)[0]
    alpha = texture(X.reshape(*HW, 3))
    beta_hw = pair.beta.hw
    y = pixel_grid(beta_hw, dtype=torch.float64).reshape(-1, 2)
    ray = pair.beta.unproject(y, torch.ones(len(y), dtype=torch.float64))
    centre = pair.beta.cam_from_world.inverse().t
    along = ray - centre
    beta = texture((centre + along * ((depth - centre[2]) / along[:, 2])[:, None]).reshape(*beta_hw, 3))
    return alpha, beta, where.reshape(*HW, 2)


@pytest.mark.parametrize("turn", [0.0, 0.3, -0.6])
def test_a_plane_is_found_again_by_unrectified_cameras(turn):
    """To half a pixel where beta sees it, though every segment has its own direction; colours too."""
    pair = pair_of(turn)
    alpha, beta, where = plane_seen(pair, 2.0)
    tint = torch.tensor([1.3, 1.0, 0.2]).double().view(1, 3, 1, 1)
    tint = tint / luminance(tint)  # alpha sees luma
    colours = beta * tint
    segments = sampled_at(pair, 1)
    found = semi_global_matching(alpha, colours, segments, sampled_at(pair, 2))
    position = match_positions(segments, found.disparity)[0]
    inner = torch.zeros(HW, dtype=torch.bool)
    inner[8:-8, 8:-8] = True
    seen = inner & (where > 4).all(-1) & (where < torch.tensor([107.0, 75.0])).all(-1)
    off = (position - where).norm(dim=-1)[seen]
    assert seen.float().mean() > 0.3
    assert off.median() < 0.5
    assert (off < 1.5).float().mean() > 0.95
    wanted = (alpha * tint - alpha)[0]
    for colour in (found.carried.bands[0], *found.carried.fills[0]):
        assert (colour - wanted)[:, seen].abs().mean() < 0.03


def in_blocks_of(monkeypatch, **sizes: int) -> None:
    """Cut every image into small blocks, at half and at full size."""
    for module, name in ((pat.matching.semi_global, "HALF_SIZE"), (pat.matching.subpixel, "FULL_SIZE")):
        monkeypatch.setattr(module, name, replace(getattr(module, name), most_costs=0, **sizes))


def test_threads_and_blocks_change_nothing(monkeypatch):
    pair = pair_of(0.1)
    alpha, beta, _ = plane_seen(pair, 2.0)
    call = alpha, beta, sampled_at(pair, 1), sampled_at(pair, 2)
    whole = semi_global_matching(*call)
    with arraygeom.runtime.threads.limited_to(1 if torch.get_num_threads() > 1 else 3):
        again = semi_global_matching(*call)
    assert all(torch.equal(*parts) for parts in zip(parts_of(whole), parts_of(again), strict=True))
    in_blocks_of(monkeypatch, block=16)
    pieces = semi_global_matching(*call)
    assert (pieces.disparity - whole.disparity).abs().median() < 1e-3


@pytest.mark.parametrize(("limit", "at_once"), [(None, {2, 3, 4}), (1.0, {1})])
def test_no_more_blocks_at_once_than_memory_holds(monkeypatch, limit, at_once):
    running, most, lock = [], [], threading.Lock()

    def block(image, box, windows, settings):
        with lock:
            running.append(box)
            most.append(len(running))
        image.claims.append(np.zeros(1, np.int32))
        image.results[2][:] = 0
        time.sleep(0.05)
        running.remove(box)

    pair = pair_of(0.1)
    alpha, beta, _ = plane_seen(pair, 2.0)
    views = Comparison.from_images(alpha, beta).half_views(alpha, beta)
    monkeypatch.setattr(pat.matching.semi_global, "_block", block)
    in_blocks_of(monkeypatch, block=8, long_block=8)
    monkeypatch.setattr(arraygeom.runtime.threads, "threads", lambda: 4)
    with limited(limit):
        matched_at_half_size(views, sampled_at(pair, 2))
    assert max(most) in at_once
    assert len(most) == 4 * 6


@pytest.mark.parametrize("threads", [1, 3])
def test_blocks_know_what_others_claim(monkeypatch, threads):
    """Blocks whose margins hold the whole image find what a single one does."""
    pair = pair_of(0.1)
    alpha, beta, _ = plane_seen(pair, 2.0)
    given = Comparison.from_images(alpha, beta).half_views(alpha, beta), sampled_at(pair, 2)
    whole = matched_at_half_size(*given)
    in_blocks_of(monkeypatch, block=12, long_block=20, margin=1000)
    monkeypatch.setattr(arraygeom.runtime.threads, "threads", lambda: threads)
    blocks = matched_at_half_size(*given)
    assert (whole.facts[:, 0] > pat.matching.semi_global.CONSISTENT).any()
    for one, other in zip(whole, blocks):
        assert torch.equal(one, other)


def test_a_batch_is_its_images_one_by_one():
    pair = pair_of(0.1)
    alpha, beta, _ = plane_seen(pair, 2.0)
    fine, coarse = sampled_at(pair, 1), sampled_at(pair, 2)
    one = semi_global_matching(alpha, beta, fine, coarse)
    other = semi_global_matching(alpha.flip(-1), beta.flip(-1), fine, coarse)
    both = semi_global_matching(*(torch.cat([p, p.flip(-1)]) for p in (alpha, beta)), fine, coarse)
    for first, second, together in zip(*map(parts_of, (one, other, both)), strict=True):
        assert torch.equal(torch.cat([first, second]), together)


def test_no_segment_is_nothing_found():
    x = torch.zeros(1, 32, 48, 2)
    nowhere = [Segments(v, v, torch.zeros(v.shape[:-1], dtype=torch.bool)) for v in (x, x[:, ::2, ::2])]
    found = semi_global_matching(torch.rand(1, 1, 32, 48), torch.rand(1, 3, 32, 48), *nowhere)
    assert found.disparity.abs().max() == 0
    assert found.carried.weight.max() == 0
    assert all(plane.isfinite().all() for plane in found.carried)


def test_a_cut_is_where_it_says():
    half, whole = torch.arange(48.0).view(1, 1, 6, 8), torch.arange(192.0).view(1, 1, 12, 16)
    colours = Colours(whole + 1, whole + 2, whole + 3, whole[None])
    made = BetaMatches(whole - 1, half, Comparison.from_images(whole, whole), colours=colours)
    cut = made.cut((4, 10, 2, 16))
    assert torch.equal(cut.disparity, whole[..., 4:10, 2:16] - 1)
    assert torch.equal(cut.facts, half[..., 2:5, 1:8])
    assert torch.equal(cut.carried.fills, whole[None, ..., 4:10, 2:16])
    for plane, added in zip(cut.carried[:3], (1, 2, 3)):
        assert torch.equal(plane, whole[..., 4:10, 2:16] + added)


def test_the_sharper_of_two_images_is_blurred_whichever_it_is():
    sharp = torch.rand(1, 1, 60, 80, generator=torch.Generator().manual_seed(0))
    soft = blurred(sharp, 1.1)
    own, its = equalising_blurs(sharp, soft)
    assert its == [0.0]
    as_it_is = torch.tensor([0.0, 1.0, 0.0]).view(3, 1, 1, 1, 1)
    one, other, *_ = Normalisation(as_it_is, (own, its)).views(sharp, soft)
    assert torch.equal(other, soft)
    assert (one - soft).abs().mean() < 0.05 * (sharp - soft).abs().mean()
    assert equalising_blurs(soft, sharp) == (its, own)
    assert max(*equalising_blurs(sharp, sharp.flip(-1))) == [pytest.approx(0.0, abs=1e-3)]
    assert own == [pytest.approx(1.1, abs=0.02)]


def test_parts_are_balanced_as_the_whole_is():
    """The right half is darker and softer than the left: alone the halves would be treated otherwise."""
    alpha = torch.rand(1, 1, 60, 80, generator=torch.Generator().manual_seed(0))
    alpha[..., 40:] = 0.3 * blurred(alpha, 2.0)[..., 40:]
    beta = 0.5 * blurred(alpha, 1.0) + 0.2
    normalisation = Normalisation.from_images(alpha, beta)
    level = normalisation.normalised(beta)
    assert abs(float(level.mean() - alpha.mean())) < 1e-5
    assert abs(float(level.std() - alpha.std())) < 1e-5
    assert normalisation.blurs[0] != [0.0]
    assert torch.equal(normalisation.normalised(beta[..., 40:]), level[..., 40:])
    sharp, part = (normalisation.views(alpha[..., n:], beta[..., n:]).alpha for n in (0, 40))
    assert torch.allclose(part[..., 20:], sharp[..., 60:], atol=1e-6)
    assert Normalisation.from_images(alpha[..., 40:], beta[..., 40:]).blurs != normalisation.blurs


def test_what_lies_beyond_the_edge_of_beta_is_not_sought_within_it():
    """Beta ends, 40 columns of alpha are unseen: most are known as such, and matches beside are right."""
    alpha, beta, segments = beside(faint(0, contrast=0.03, blur=4.0), 40)
    noise = 0.01 * torch.randn(2, *alpha.shape, generator=torch.Generator().manual_seed(9))
    found = semi_global_matching(alpha + noise[0], beta + noise[1], *segments)
    assert ((found.disparity[..., 48:72] - 40).abs() < 2).float().mean() > 0.98
    assert (found.facts[:, 0, :, :17] > pat.matching.semi_global.CONSISTENT).float().mean() > 0.845


def along_the_segment(pair, x):
    """A field of one's own: the calibrated segment as explicit positions."""
    return Epipolar()(pair, x).positions(64)


def arc(pair, x):
    """Positions on a parabola through (x - 12, y), which cameras have for each other through a lens."""
    step = torch.linspace(-8, 8, 33, dtype=x.dtype)
    offset = torch.stack([step - 12, 0.05 * step.square()], -1)
    return Positions(x[..., None, :] + offset, torch.ones(*x.shape[:-1], 33, dtype=torch.bool))


def test_tangents_touch_their_curve_at_the_match():
    """Beta is alpha moved by 14 pixels: along the arc that is the label 12, which is 0.2 pixels down."""
    g = torch.Generator().manual_seed(0)
    alpha = torch.nn.functional.avg_pool2d(torch.rand(1, 1, 68, 132, generator=g), 5, 1)
    alpha = (alpha - alpha.min()) / (alpha.max() - alpha.min())
    beta = alpha.roll(-14, -1)
    field = FieldOnGrid(lambda x: arc(None, x[None]), 33, None)
    found = along_tangents(alpha, beta, field)
    assert isinstance(found.pixels, Segments)
    h, w = alpha.shape[-2:]
    y, x = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
    s = Segments(*(t[0, 8:-8, 24:-8] for t in vars(found.pixels).values()))
    match = torch.stack([x - 14.0, y + 0.2], -1)[8:-8, 24:-8].double()
    foot = s.at(s.fraction(match))
    near = (foot - match).norm(dim=-1)
    assert float(near.quantile(0.9)) < 0.25
    slope = (s.start - s.end)[..., 1] / (s.start - s.end)[..., 0]
    assert float((slope - 2 * 0.05 * -2).abs().quantile(0.9)) < 0.06


@pytest.mark.parametrize(
    "field", [NearestVoxels(), Local(9), Dense(stride=24)], ids=lambda f: type(f).__name__
)
def test_sets_are_fused_and_said_to_have_no_order(field):
    s = middle_of_sample()
    with pytest.warns(UserWarning, match="order"):
        frame = fuse(
            s.images,
            s.rig,
            alpha=ALPHA,
            network=load_weights("mono-colour"),
            settings=FuseSettings(field=field, response="rec601"),
        )
    assert bool(frame.image.isfinite().all())


def test_a_curve_of_ones_own_is_fused_as_well_as_the_segment():
    s, network = middle_of_sample(), load_weights("mono-colour")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        frames = [
            fuse(s.images, s.rig, alpha=ALPHA, network=network, settings=FuseSettings(field=f))
            for f in (None, along_the_segment)
        ]
    straight, own = (score(f.image.clamp(0, 1), s.ground_truth).psnr for f in frames)
    assert own > straight - 0.4


def test_costs_of_positions_are_those_of_labels():
    rng = np.random.default_rng(0)
    own, other = rng.random((2, 6, 9)).astype(np.float32)
    (a, a_bits), (b, b_bits) = planes_of(own), planes_of(other)
    places = rng.integers(-1, b.size, (6, 9, 5)).astype(np.int32)
    found = np.empty((6, 9, 1, 16), np.uint8)
    kernels.costs_at((a.ravel(), a_bits.ravel()), (b.ravel(), b_bits.ravel()), places, found)
    assert (found[..., 5:] == kernels.NO_LABEL).all()
    for y, x, label in np.ndindex(places.shape):
        at = divmod(int(places[y, x, label]), 9)
        bright = int(min(abs(a[y, x] - b[at]) * cost.BRIGHTNESS, cost.TRUNCATED))
        expected = bin(int(a_bits[y, x] ^ b_bits[at])).count("1") + bright
        assert found[y, x, 0, label] == (expected if places[y, x, label] >= 0 else cost.NOWHERE)
