"""Sequences: clocks, motion, colour that stays on what moves and does not flicker, confidence that knows."""

import warnings
from dataclasses import replace

import pytest
import torch

from arraygeom import Distortion, Epipolar, Moved, Rectified, Rig, Sensor, View, Widened, pixel_grid
from experiments.system import flicker
from pat import fuse
from pat.fusion.fuse import FuseSettings
from pat.fusion.optical_flow import Flow, flow_between, warped
from pat.fusion.sequence import KeyColour, SequenceFusion, fuse_sequence, mixed
from pat.fusion.timeline import KeyFrame, Timeline
from pat.media.colour import luminance
from pat.networks.weights import load_weights
from pat.sensors import NoiseLevel, generator_for
from tests.pat.fusion import moving


def clocks(alpha_rate, beta_rate, offset, *counts):
    views = {
        "a": View(hw=(4, 4), sensor=Sensor(frame_rate=alpha_rate)),
        "b": View(hw=(4, 4), sensor=Sensor(frame_rate=beta_rate, time_offset=offset)),
    }
    return Timeline(Rig(views), dict(zip("ab", counts)), "a")


def test_key_frames_are_alphas_nearest_to_betas():
    line = clocks(227.0, 30.0, 0.010, 20, 3)
    assert [k.alpha for k in line.key_frames()] == [round((0.010 + j / 30) * 227) for j in range(3)]
    assert [k.betas["b"] for k in line.key_frames()] == [0, 1, 2]
    assert line.interval == pytest.approx(1 / 30)
    slow_alpha = clocks(10.0, 30.0, 0.0, 4, 12)
    assert [(k.alpha, k.betas["b"]) for k in slow_alpha.key_frames()] == [(0, 0), (1, 3), (2, 6), (3, 9)]
    assert slow_alpha.interval == pytest.approx(0.1)
    assert [k.alpha for k in clocks(10.0, 10.0, 0.24, 3, 1).key_frames()] == [2]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (lambda: clocks(None, 30.0, 0.0, 5, 5), "'a'"),
        (lambda: clocks(30.0, 30.0, 5.0, 5, 5).key_frames(), "alpha"),
        (lambda: clocks(10.0, 10.0, 0.26, 3, 1).key_frames(), "alpha"),
        (lambda: clocks(30.0, 30.0, 0.0, 5), "beta"),
        (lambda: clocks(30.0, 30.0, 0.0, 5, 0), "'b'"),
    ],
)
def test_clocks_that_do_not_fit_are_named(line, message):
    with pytest.raises(ValueError, match=message):
        line()


def test_a_beta_that_recorded_at_another_time_is_named():
    """Its first or last frame is not used for all of the sequence, even if another beta's times fit."""
    line = clocks(30.0, 30.0, 0.0, 9, 9)
    for offset, count in ((0.0, 1), (0.12, 3), (5.0, 3), (-5.0, 3)):
        sensor = Sensor(frame_rate=10.0, time_offset=offset)
        rig = line.rig.with_camera("c", View(hw=(4, 4), sensor=sensor))
        three = Timeline(rig, {**line.counts, "c": count}, "a")
        if abs(offset) < 1:
            assert len(three.key_frames()) == 9
        else:
            with pytest.raises(ValueError, match="'c'"):
                three.key_frames()


def test_a_beta_that_recorded_a_part_of_the_time_is_said():
    """Its first or last frame is used for the rest of the sequence, with a warning."""
    with pytest.warns(UserWarning, match="'b'.*'a'"):
        clocks(10.0, 10.0, 0.2, 10, 3).warn_of_ends()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        clocks(10.0, 10.0, 0.0, 10, 10).warn_of_ends()
        clocks(60.0, 10.0, 0.05, 15, 2).warn_of_ends()


def test_moved_samples_where_points_will_be():
    pair = moving.rig().pair("fast", "slow")
    x = pixel_grid(moving.HW)[10:20, 30:40].reshape(-1, 2)
    step = torch.stack([torch.full(moving.HW, 7.0), torch.full(moving.HW, -3.0)])
    there = Moved(Epipolar(), step)(pair, x)
    wanted = Epipolar()(pair, x + torch.tensor([7.0, -3.0]))
    torch.testing.assert_close(there.start, wanted.start)
    torch.testing.assert_close(there.end, wanted.end)
    wide = Moved(Widened(Epipolar(), along=4.0), step)(pair, x)
    assert torch.allclose(wide.length[wide.valid], wanted.length[wide.valid] + 8.0, atol=1e-4)


@pytest.mark.parametrize(
    "distortion", [None, Distortion("brown-conrady", torch.tensor([-0.1, 0, 0, 0]).double())]
)
def test_a_displacement_of_another_size_is_refused(distortion):
    rig = moving.rig()
    rig = rig.with_camera("fast", rig["fast"].replace(distortion=distortion))
    images = {"fast": torch.rand(1, *moving.HW), "slow": torch.rand(3, *moving.HW)}
    field = Moved(Epipolar(), torch.zeros(2, 48, 80))
    with pytest.raises(ValueError, match=r"displacement.*80x48"):
        fuse(
            images, rig, alpha="fast", network=load_weights("mono-colour"), settings=FuseSettings(field=field)
        )


def test_flow_finds_a_shift_and_its_weight_the_border():
    a = moving.WALL[1:2, :96, 20:180]
    b = moving.WALL[1:2, 2:98, 25:185]
    flow = flow_between(a, b * 0.97)
    inside = flow.step[:, 10:-10, 10:-10]
    assert (inside - torch.tensor([-5.0, -2.0])[:, None, None]).abs().median() < 0.1
    assert flow.weight[10:-10, 10:-10].median() > 0.9
    assert flow.weight[:, :4].max() == 0
    assert (warped(b, flow.step) - a)[:, 10:-10, 10:-10].abs().mean() < 0.01


@pytest.mark.parametrize("hw", [(8, 8), (1, 40), (15, 40), (40, 5)])
def test_frames_too_small_for_the_flow_have_one(hw):
    h, w = hw
    a, b = moving.WALL[1:2, :h, 20 : 20 + w], moving.WALL[1:2, :h, 21 : 21 + w]
    flow = flow_between(a, b)
    assert flow.step.shape == (2, h, w)
    assert flow.weight.shape == hw
    x, y = flow.step.flatten(1).median(dim=1).values
    assert abs(x + 1) < 0.3
    assert abs(y) < 0.3


def test_colours_mix_by_confidence_which_disagreement_lowers():
    own = torch.full((1, 1, 2), 0.5)
    red, blue = (torch.tensor(c)[:, None, None].expand(3, 1, 2) for c in ((0.2, 0.0, 0.0), (0.0, 0.0, 0.2)))
    sure = torch.tensor([[0.9, 0.9]])
    sources = [
        (1.0, KeyColour(red, sure, torch.stack([sure, 0.1 * sure]))),
        (1.0, KeyColour(blue, torch.tensor([[0.9, 0.0]]), torch.zeros(2, 1, 2))),
    ]
    frame = mixed(own, sources)
    torch.testing.assert_close(frame.image[:, 0, 1], torch.tensor([0.7, 0.5, 0.5]), atol=1e-3, rtol=0)
    torch.testing.assert_close(frame.image[:, 0, 0], torch.tensor([0.6, 0.5, 0.6]), atol=1e-3, rtol=0)
    assert frame.confidence[0, 0] < 0.5 * frame.confidence[0, 1]
    torch.testing.assert_close(frame.depth, 1 / sure)
    torch.testing.assert_close(frame.half_width, 0.1 * sure)


@pytest.mark.parametrize("i", [-1, 2])
def test_a_frame_that_alpha_lacks_is_refused(i):
    """Frame -1 was the last one at a wrong time."""
    frames, _ = moving.recording(2)
    job = SequenceFusion(load_weights("mono-colour"), moving.rig(), frames, "fast")
    keys = job.timeline.key_frames()
    for act in (lambda: job.frame(i, keys, lambda key: None), lambda: job.alone(i), lambda: job.keys_of([i])):
        with pytest.raises(IndexError, match="'fast'"):
            act()


def test_a_speed_that_is_none_is_refused_at_once():
    frames, _ = moving.recording(2)
    for speed in (-3.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="speed"):
            SequenceFusion(load_weights("mono-colour"), moving.rig(), frames, "fast", speed)


def test_an_image_that_cannot_be_read_costs_its_own_key_frame_alone():
    """Levels are matched over the frames around it that can be read."""

    class Damaged(list):
        def __getitem__(self, i):
            if i == 1:
                raise OSError("slow_1.png is damaged")
            return super().__getitem__(i)

    frames, _ = moving.recording(13, 0.003)
    frames = frames | {"slow": Damaged(frames["slow"])}
    settings = FuseSettings(match_levels=True, align=False, response="rec601")
    job = SequenceFusion(load_weights("mono-colour"), moving.rig(0.003), frames, "fast", settings=settings)
    first, second, *_ = job.timeline.key_frames()
    assert job.colour(first).added.isfinite().all()
    with pytest.raises(OSError, match="slow_1"):
        job.colour(second)


def test_bands_keep_their_own_level_where_levels_are_matched():
    """Bands of a sequence have the levels of single frames."""
    frames, _ = moving.recording(2)
    band = [0.3 * image[1:2] + 0.05 for image in frames["slow"]]
    settings = FuseSettings(align=False, match_levels=True)
    network, frames = load_weights("mono-spectral"), {"fast": frames["fast"], "slow": band}
    given = {"alpha": "fast", "network": network, "settings": settings}
    first = next(fuse_sequence(frames, moving.rig(), **given))
    alone = fuse({name: some[0] for name, some in frames.items()}, moving.rig(), **given)
    assert (first.image - alone.image).abs().mean() < 0.01


@pytest.mark.parametrize("align", [True, False])
def test_cameras_behind_filters_at_one_place_are_fused_between_key_frames_too(align):
    """At key frames they are one beta of several bands; between, each one's points move by themselves."""
    frames, ground_truth = moving.recording(13)
    rig = moving.rig()
    names = ["red", "green", "blue"]
    views = {name: rig["slow"].replace(sensor=Sensor(frame_rate=moving.SLOW)) for name in names}
    filtered = Rig({"fast": rig["fast"], **views}, depth=rig.depth)
    bands = {name: [image[i : i + 1] for image in frames["slow"]] for i, name in enumerate(names)}
    job = fuse_sequence(
        {"fast": frames["fast"], **bands},
        filtered,
        alpha="fast",
        network=load_weights("mono-colour"),
        settings=FuseSettings(align=align),
    )
    errors = [(frame.image - truth).abs().mean() for frame, truth in zip(job, ground_truth)]
    assert len(errors) == 13
    assert max(errors) < 0.05


def test_a_response_that_is_none_is_refused_before_a_sequence_is_fused():
    """It is not taken for an image that cannot be read."""
    with pytest.raises(ValueError, match="weights"):
        FuseSettings(response=(-1.0, 0.0, 0.0))


def test_a_field_may_be_given_for_each_beta():
    frames, _ = moving.recording(2)
    settings, network = FuseSettings(align=False, response="rec601"), load_weights("mono-colour")
    rows, *of_all = (
        next(
            fuse_sequence(
                frames,
                moving.rig(),
                alpha="fast",
                network=network,
                settings=replace(settings, field=field),
            )
        )
        for field in ({"slow": Rectified(20, alpha_is="left")}, Rectified(20, alpha_is="left"), None)
    )
    assert torch.equal(rows.image, of_all[0].image)
    assert not torch.equal(rows.image, of_all[1].image)


@pytest.fixture(scope="module")
def fused():
    """Seven frames, two of them key frames, and four fused alone; beta is 3 ms off alpha's clock."""
    offset = 0.003
    frames, ground_truth = moving.recording(7, offset)
    network = load_weights("mono-colour")
    rig = moving.rig(offset)
    job = SequenceFusion(network, rig, frames, "fast")
    carried_frames = list(fuse_sequence(frames, rig, alpha="fast", network=network))
    return frames, ground_truth, carried_frames, {i: job.alone(i) for i in (1, 2, 3, 4)}


def error(frame, ground_truth):
    return (frame.image - ground_truth).square().mean(0)


def square(i):
    """Where the moving square is, a few pixels inside its border."""
    x = pixel_grid(moving.HW)
    left = 25 + moving.SPEED * i / moving.RATE
    return (x[..., 0] > left + 3) & (x[..., 0] < left + 44) & (x[..., 1] > 27) & (x[..., 1] < 68)


def test_what_moves_keeps_its_colour(fused):
    _, ground_truth, frames, alone = fused
    ours = torch.stack([error(f, t)[square(i)].mean() for i, (f, t) in enumerate(zip(frames, ground_truth))])
    single = torch.stack([error(f, ground_truth[i])[square(i)].mean() for i, f in alone.items()])
    assert ours[1:5].mean() < 0.7 * single.mean()
    assert ours.max() < 0.4 * single.max()


def test_colour_flickers_less_than_frame_by_frame(fused):
    frames, _, ours, alone = fused
    calm = flicker([f.image for f in ours[1:5]], frames["fast"][1:5])
    restless = flicker([f.image for f in alone.values()], frames["fast"][1:5])
    assert calm < 0.5 * restless


def test_confidence_knows_where_colour_is_wrong(fused):
    """Also about what moves: of pixels around the square the sure ones are right, the wrong ones unsure."""
    _, ground_truth, ours, _ = fused
    x = pixel_grid(moving.HW)
    around = [(x[..., 0] > 15 + 2.5 * i) & (x[..., 0] < 85 + 2.5 * i) for i in range(7)]
    off = torch.cat([error(f, t)[m].sqrt() for f, t, m in zip(ours, ground_truth, around)])
    sure = torch.cat([f.confidence[m] for f, m in zip(ours, around)])
    third = len(sure) // 3
    order = sure.argsort()
    assert off[order[-third:]].mean() < 0.65 * off[order[:third]].mean()
    assert sure[off > 0.15].mean() < 0.75 * sure[off < 0.05].mean()


def test_alphas_own_detail_stays(fused):
    frames, _, ours, _ = fused
    weights = torch.tensor([0.299, 0.587, 0.114])[:, None, None]
    for frame, grey in zip(ours, frames["fast"]):
        assert ((frame.image * weights).sum(0) - grey[0]).abs().max() < 1e-5


def noisy(frames, level):
    return {
        name: [level.recorded(image[None], generator_for(0, name, i))[0] for i, image in enumerate(images)]
        for name, images in frames.items()
    }


def psnr(frames, ground_truth):
    pairs = zip(frames, ground_truth, strict=True)
    return -10 * torch.stack([error(f, t).mean() for f, t in pairs]).mean().log10()


def test_a_noisy_sequence_is_denoised(fused):
    """One level for all frames, stated or estimated; alpha's values stay where that is asked for."""
    frames, ground_truth, _, _ = fused
    level = NoiseLevel.from_electrons(60, 2)
    recorded, network, rig = noisy(frames, level), load_weights("mono-colour"), moving.rig(0.003)

    def fusion(**settings):
        how = FuseSettings(**settings)
        return fuse_sequence(recorded, rig, alpha="fast", network=network, settings=how)

    plain = psnr(fusion(), ground_truth)
    stated = dict.fromkeys(recorded, level)
    assert psnr(fusion(noise=stated), ground_truth) > plain + 2.0
    alone = [
        SequenceFusion(network, rig, recorded, "fast", settings=FuseSettings(noise=noise)).alone(3)
        for noise in (None, stated)
    ]
    assert psnr(alone[1:], ground_truth[3:4]) > psnr(alone[:1], ground_truth[3:4]) + 2.0
    estimated = SequenceFusion(network, rig, recorded, "fast", settings=FuseSettings(noise="estimate"))._noise
    assert estimated is not None
    assert set(estimated) == {"fast", "slow"}
    assert estimated["fast"].deviation(recorded["fast"][0][None]).mean() == pytest.approx(
        float(level.deviation(recorded["fast"][0][None]).mean()), rel=0.3
    )
    kept = list(fusion(noise=stated, keep_alpha=True))
    for frame, grey in zip(kept, recorded["fast"]):
        torch.testing.assert_close(luminance(frame.image), grey, atol=1e-4, rtol=0)


def test_of_several_betas_the_lowest_weight_of_motion_counts(fused, monkeypatch):
    """Each beta has its own time: the least certain motion counts."""
    frames, _, _, _ = fused
    rig = moving.rig()
    rig = rig.with_camera("other", rig["slow"])
    job = SequenceFusion(load_weights("mono-colour"), rig, {**frames, "other": frames["slow"]}, "fast")
    field = SequenceFusion._field

    def doubtful(self, name, index, time):
        found, weight = field(self, name, index, time)
        return found, weight * (0.25 if name == "slow" else 1.0)

    key = job.timeline.key_frames()[0]
    sure = job.colour(key).confidence
    monkeypatch.setattr(SequenceFusion, "_field", doubtful)
    torch.testing.assert_close(job.colour(key).confidence, sure * 0.25)


@pytest.mark.parametrize("step", [0.3, 0.7])
def test_depth_beside_what_is_unknown_is_not_mixed_with_it(monkeypatch, step):
    """An unknown neighbour is no inverse depth of 0."""
    frames, _ = moving.recording(3)
    job = SequenceFusion(load_weights("mono-colour"), moving.rig(), frames, "fast")
    flow = Flow(torch.tensor([step, 0.0])[:, None, None].expand(2, *moving.HW), torch.ones(moving.HW))
    monkeypatch.setattr("pat.fusion.sequence.flow_between", lambda a, b: flow)
    inverse = torch.full((2, *moving.HW), 0.5)
    inverse[:, 30:60, 40:80] = 0.0
    colour = KeyColour(torch.zeros(3, *moving.HW), torch.ones(moving.HW), inverse)
    depth = job.frame(1, [KeyFrame(0, {"slow": 0})], lambda key: colour).depth
    known = depth.isfinite()
    assert depth[known].allclose(torch.tensor(2.0))
    assert abs(int((~known).sum()) - 30 * 40) == 0
