"""The explorer's computation agrees with the fields, with attention and with the true image."""

import math
import time

import pytest
import torch
from torch.nn.functional import interpolate

from arraygeom import Curved, Distortion, Epipolar, Link, Rig, View, depth_of, epipolar_distance
from pat.app.explore import FAMILIES, ExplorerScene, ExplorerState, inspect_pixel
from pat.app.explore import pixel as core
from pat.app.explore.pixel import sampled
from pat.app.sample_array import load_sample
from pat.attention import attend_with_statistics
from pat.media.colour import luminance
from pat.networks.paper import PAT, PATConfig


@pytest.fixture(scope="module")
def sample():
    return load_sample()


@pytest.fixture(scope="module")
def scene(sample):
    return ExplorerScene(sample.rig, sample.images)


X = torch.tensor([[320.0, 200.0]], dtype=torch.float64)
"""The pixel of `state`."""


def state(**changes):
    return ExplorerState("mono", (320.0, 200.0), **changes)


def test_the_segment_is_the_fields_own(scene, sample):
    report = inspect_pixel(scene, state()).betas["colour"]
    field = Epipolar()(sample.rig.pair("mono", "colour"), X)
    torch.testing.assert_close(report.ends, torch.cat([field.start, field.end]))
    torch.testing.assert_close(report.xy[[0, -1]], report.ends)


def test_weights_are_those_of_attention(scene, sample):
    """The same windows as keys of `pat.attention`, one at each sample, give the same answer."""
    report = inspect_pixel(scene, state()).betas["colour"]
    pair = sample.rig.pair("mono", "colour")
    scores = core.correlations(scene.guides["mono"], scene.guides["colour"], pair, X, report.xy)
    key, query = core.SHARPNESS * scores[None, None, None], torch.ones(1, 1, 1, 1, dtype=torch.float64)
    row = torch.stack([torch.arange(len(scores), dtype=torch.float64), torch.zeros(len(scores))], -1)
    look = core.Positions(row[None, None], report.valid[None, None])
    found = attend_with_statistics(query, key, report.xy.T[None, :, None], look, backend="reference")
    torch.testing.assert_close(found.value[0, :, 0, 0], report.weight @ report.xy)
    assert float(found.peak) == pytest.approx(float(report.weight.max()))


def test_windows_of_beta_are_of_its_scale(sample):
    """A step in alpha is one of 460 / 820 in beta, whichever way, and is turned as the cameras are."""
    J = core.jacobian(sample.rig.pair("mono", "colour"), X)
    assert float(J.det().sqrt()) == pytest.approx(460 / 820, rel=0.05)
    turn = math.degrees(torch.atan2(J[1, 0], J[0, 0]))
    assert turn == pytest.approx(math.degrees(math.asin(0.0349)), abs=0.3)


def test_the_windows_find_the_colour_and_the_depth(scene, sample):
    """At most places of the sample array the colour found is near the true one, nearer than grey is."""
    errors = []
    for x in range(60, 600, 90):
        for y in range(50, 380, 90):
            report = inspect_pixel(scene, state().replace(x=(float(x), float(y))))
            ground_truth = sample.ground_truth[:, y, x].double()
            beta = report.betas["colour"]
            colour = sampled(scene.images["colour"][None], beta.xy) @ beta.weight
            found = (
                scene.guides["mono"][0, :, y, x].double()
                + colour
                - luminance(colour[:, None, None]).reshape(1)
            )
            colours = found, ground_truth.mean().expand(3)
            errors.append([float((colour - ground_truth).abs().max()) for colour in colours])
    found, grey = torch.tensor(errors).median(0).values
    assert found < 0.5 * grey


def test_depths_are_those_of_the_samples(scene, sample):
    report = inspect_pixel(scene, state()).betas["colour"]
    near, far = (float(d) for d in sample.rig.depth)
    assert float(report.depth[0]) == pytest.approx(near, rel=1e-6)
    assert float(report.depth[-1]) == pytest.approx(far, rel=1e-6)
    again = depth_of(sample.rig.pair("mono", "colour"), X, report.xy[5:6])
    assert float(report.depth[5]) == pytest.approx(float(again.depth))


@pytest.mark.parametrize("family", FAMILIES)
def test_every_family_answers(scene, family):
    report = inspect_pixel(scene, state(family=family))
    assert not report.problems
    assert float(report.betas["colour"].weight.sum()) == pytest.approx(1)


def test_near_and_far_are_the_fields(scene, sample):
    pair = sample.rig.pair("mono", "colour")
    for changes, field in (({"near": 3.0}, Epipolar(near=3.0)), ({"far": 5.0}, Epipolar(far=5.0))):
        found = field(pair, X)
        ends = inspect_pixel(scene, state(**changes)).betas["colour"].ends
        torch.testing.assert_close(ends, torch.cat([found.start, found.end]))


def test_a_rotated_camera_moves_the_segment_as_the_rig_says(scene, sample):
    step = (0.0, math.radians(0.3), 0.0)
    turned = sample.rig.perturbed({"colour.rotation": torch.tensor(step, dtype=torch.float64)})
    report = inspect_pixel(scene.with_rig(turned), state())
    found = Epipolar()(turned.pair("mono", "colour"), X)
    torch.testing.assert_close(report.betas["colour"].ends[0], found.start[0])
    moved = report.betas["colour"].ends - inspect_pixel(scene, state()).betas["colour"].ends
    assert moved.norm(dim=-1).tolist() == pytest.approx([460 * math.radians(0.3)] * 2, rel=0.15)


def test_lenses_are_followed(scene, sample):
    lens = Distortion("brown-conrady", torch.tensor([-0.2, 0.05, 0.0, 0.0, 0.0], dtype=torch.float64))
    camera = sample.rig["colour"].replace(distortion=lens)
    has_lens = ExplorerScene(sample.rig.with_camera("colour", camera), sample.images)
    report = inspect_pixel(has_lens, state()).betas["colour"]
    assert report.ends is None
    found = Curved(256)(has_lens.rig.pair("mono", "colour"), X)
    torch.testing.assert_close(report.xy, found.xy[0])


def test_cameras_known_by_F_or_by_size_alone(sample):
    pair = sample.rig.pair("mono", "colour")
    views = {name: View(hw=sample.rig[name].hw) for name in sample.rig.names}
    linked = Rig(views, links={("mono", "colour"): Link(pair.fundamental, pair.homography)})
    for rig in (linked, Rig(views)):
        report = inspect_pixel(ExplorerScene(rig, sample.images), state())
        assert not report.problems
        assert report.betas["colour"].depth.isnan().all()
        assert math.isnan(report.depth)
    report = inspect_pixel(ExplorerScene(Rig(views), sample.images), state(family="epipolar"))
    assert "calibrat" in report.problems["colour"]


def test_an_answer_for_images_of_megapixels_takes_milliseconds(sample):
    """The time of the processor, 1280x1024 against two colour betas of the same size."""
    rig, images = sample.rig, dict(sample.images)
    for name in rig.names:
        rig = rig.resize(name, (1024, 1280))
        images[name] = interpolate(images[name][None], size=(1024, 1280), mode="bilinear")[0]
    rig, images = rig.with_camera("second", rig["colour"]), images | {"second": images["colour"]}
    scene = ExplorerScene(rig, images)
    inspect_pixel(scene, state())
    times = []
    for i in range(9):
        start = time.process_time()
        inspect_pixel(scene, state().replace(x=(400.0 + 50 * i, 500.0)))
        times.append(time.process_time() - start)
    assert min(times) < 0.1


def test_of_an_exact_rig_hardly_any_match_is_said_to_be_off_the_line(scene):
    draw, (h, w), off = torch.Generator().manual_seed(5), scene.rig["mono"].hw, []
    for u, v in torch.rand(60, 2, generator=draw).tolist():
        x = (round(10 + u * (w - 20)), round(10 + v * (h - 20)))
        offset = inspect_pixel(scene, ExplorerState("mono", x)).betas["colour"].offset
        off += [] if offset is None else [offset]
    assert len(off) > 30
    assert sum(distance > 1 for distance in off) < 0.2 * len(off)


def test_a_moved_rig_puts_the_match_off_the_line_by_as_much_as_it_says(scene, sample):
    state = ExplorerState("mono", (334.0, 133.0))
    here = inspect_pixel(scene, state).betas["colour"]
    assert here.offset is not None
    assert here.offset < 0.3
    match = here.xy[int(here.weight.argmax())]
    for angle in (0.003, -0.006):
        moved = sample.rig.perturbed({"colour.rotation": torch.tensor([angle, 0, 0], dtype=torch.float64)})
        off = inspect_pixel(scene.with_rig(moved), state).betas["colour"].offset
        assert off is not None
        x = torch.tensor([state.x], dtype=torch.float64)
        F = moved.pair("mono", "colour").fundamental
        true = float(epipolar_distance(F, x, match[None]).abs())
        assert true > 1
        assert abs(off - true) < 0.3
    # without texture
    assert inspect_pixel(scene, state.replace(x=(560.0, 60.0))).betas["colour"].offset is None


def test_a_networks_features_are_those_of_the_pair(sample):
    """They are cached by pair: alpha's resolution and beta's key differ between pairs."""
    rig = sample.rig.with_camera("third", sample.rig["colour"])
    rig = rig.replace(cameras={name: rig[name] for name in ("mono", "colour", "third")})
    images = {name: interpolate(image[None], scale_factor=0.25)[0] for name, image in sample.images.items()}
    images["third"] = images["colour"]
    for name, image in images.items():
        rig = rig.resize(name, tuple(image.shape[1:]))
    network = PAT(PATConfig(betas=2, dim=4, in_channels=3, equal_resolution=True))
    network.engine.key[1].requires_grad_(False).weight.mul_(2)
    scene = ExplorerScene(rig, images, networks={"own": network})

    def key(alpha, beta, rig=rig):
        return scene.with_rig(rig).key("own", alpha, beta, rig.pair(alpha, beta))

    assert key("mono", "colour").shape[-2] > 1.5 * rig["colour"].hw[0]
    assert key("third", "colour").shape[-2:] == rig["colour"].hw
    assert not torch.allclose(key("mono", "colour"), key("mono", "third"))
    colour = rig["colour"]
    longer = rig.with_camera("colour", colour.replace(K=colour.K * colour.K.new_tensor([[2], [2], [1]])))
    assert key("mono", "colour", longer).shape[-2] < 1.5 * rig["colour"].hw[0]
