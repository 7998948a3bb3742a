"""Corrections that fuse estimates and makes by itself: another response, a beta off its search segments."""

import math
from dataclasses import replace

import pytest
import torch

from arraygeom import Sensor
from pat import FuseSettings, fuse
from pat.fusion import corrections
from pat.fusion.corrections import Corrections, find_corrections
from pat.fusion.epipolar_offset import Misalignment, fit_misalignment
from pat.fusion.fuse import corrections_of
from pat.fusion.inputs import clipped_in, prepared
from pat.fusion.sequence import SequenceFusion
from pat.fusion.views import Views
from pat.matching.band_mix import Response
from pat.matching.colour_transfer import with_clipped_light
from pat.media.colour import luminance
from pat.networks.weights import load_weights
from pat.support.metrics import score
from tests.pat.layered_array import ALPHA, BETA, load_sample, middle_of_sample


@pytest.fixture(scope="module")
def sample():
    return load_sample()


@pytest.fixture(scope="module")
def network():
    return load_weights("mono-colour")


def as_expected(sample):
    """Images with the response that the network expects."""
    return {ALPHA: luminance(sample.ground_truth), BETA: sample.images[BETA]}


@pytest.fixture(scope="module")
def images(sample):
    return as_expected(sample)


@pytest.fixture(scope="module")
def ideal(network, sample, images):
    """PSNR of the whole sample as its rig says."""
    return psnr(network, sample, images)


@pytest.fixture(scope="module")
def middle(network):
    """The middle of the sample, its images, and PSNR with them."""
    sample = middle_of_sample()
    return sample, as_expected(sample), psnr(network, sample, as_expected(sample))


def combined(image, weights):
    return (image * torch.tensor(weights)[:, None, None]).sum(0, keepdim=True)


def psnr(network, sample, images, *, rig=None, explain=None, **options):
    given = {"alpha": ALPHA, "network": network, "settings": FuseSettings(**options)}
    frame = fuse(images, rig or sample.rig, explain=explain, **given)
    return score(frame.image.clamp(0, 1), sample.ground_truth).psnr


def with_beta_rotated(rig, degrees):
    """The rig, beta's stated rotation off about its x axis: every point is off by about as many pixels."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    wrong = torch.tensor([[1, 0, 0], [0, c, -s], [0, s, c]], dtype=rig[BETA].R.dtype)
    pose = rig[BETA].cam_from_world
    return rig.with_camera(BETA, rig[BETA].replace(cam_from_world=type(pose)(wrong @ pose.R, wrong @ pose.t)))


@pytest.mark.parametrize("weights", [(1 / 3, 1 / 3, 1 / 3), (0.2, 0.4, 0.4), (0.6, 0.3, 0.1)])
def test_a_response_is_fitted_by_itself(network, middle, weights):
    sample, images, ideal = middle
    other = images | {ALPHA: combined(sample.ground_truth, weights)}
    fitted = psnr(network, sample, other)
    assert fitted > ideal - 1.5
    assert fitted > psnr(network, sample, other, response="rec601") + 1.0


def test_gain_and_gamma_are_fitted_by_themselves(network, middle):
    sample, images, ideal = middle
    other = images | {BETA: 0.6 * images[BETA] ** 1.3}
    assert psnr(network, sample, other) > ideal - 1.0


@pytest.mark.parametrize("gain", [0.6, 0.9])
def test_another_exposure_is_not_taken_for_another_response(network, middle, gain):
    sample, images, ideal = middle
    other = images | {BETA: gain * images[BETA]}
    assert psnr(network, sample, other) > ideal - 0.5


def test_vignetting_is_found_by_itself(network, middle):
    sample, images, ideal = middle
    h, w = images[BETA].shape[-2:]
    y, x = torch.meshgrid(torch.linspace(-1, 1, h) * h / w, torch.linspace(-1, 1, w), indexing="ij")
    other = images | {BETA: images[BETA] * (1 + 0.5 * (x.square() + y.square())) ** -0.9}
    lines: list[str] = []
    found = psnr(network, sample, other, explain=lines.append)
    assert found > ideal - 0.7
    assert "vignetting" in lines[0]
    assert psnr(network, sample, other, response="rec601") < found - 0.1


def test_nothing_is_changed_where_the_cameras_are_as_the_rig_says(sample, network, images):
    lines: list[str] = []
    given = fuse(images, sample.rig, alpha=ALPHA, network=network, explain=lines.append)
    plain = fuse(
        images,
        sample.rig,
        alpha=ALPHA,
        network=network,
        settings=FuseSettings(response="rec601", align=False),
    )
    assert lines == []
    assert torch.equal(given.image, plain.image)
    assert torch.equal(given.confidence, plain.confidence)


@pytest.mark.parametrize("degrees", [0.3, -0.3])
def test_a_rotated_camera_is_put_right(sample, network, images, ideal, degrees):
    rig, lines = with_beta_rotated(sample.rig, degrees), []
    assert psnr(network, sample, images, rig=rig, explain=lines.append) > ideal - 0.5
    assert psnr(network, sample, images, rig=rig, align=False) < ideal - 1.0
    assert "off its search segments" in lines[0]


def test_found_corrections_serve_other_frames(sample, network, images):
    rig = with_beta_rotated(sample.rig, 0.3)
    found = corrections_of(images, rig, alpha=ALPHA, network=network)
    one = fuse(images, rig, alpha=ALPHA, network=network)
    assert torch.equal(fuse(images, rig, alpha=ALPHA, network=network, corrections=found).image, one.image)


def test_corrections_of_other_betas_are_refused(sample, network, images):
    found = Corrections(Response.rec601(), {"a": Misalignment(), "b": Misalignment()})
    message = "corrections are of 'a', 'b', this frame has '.*': take those of a frame of the same cameras"
    with pytest.raises(ValueError, match=message):
        fuse(images, sample.rig, alpha=ALPHA, network=network, corrections=found)


def test_betas_without_names_are_corrected_too(middle, network):
    """Corrections are kept by number, and can be given."""
    sample, images, _ = middle
    frame, _ = prepared(network, Views.of(with_beta_rotated(sample.rig, 0.3), images, alpha=ALPHA), [])
    named = find_corrections(network, frame, "fit", align=True)
    (beta,) = frame.inputs.betas
    unnamed = frame._replace(inputs=replace(frame.inputs, betas=(replace(beta, cameras=()),)))
    found = find_corrections(network, unnamed, "fit", align=True)
    assert found.misalignments == {"1": named.misalignments[BETA]} != {"1": Misalignment()}
    for given in (found, Corrections(found.response)):
        assert len(given.applied(unnamed.inputs, unnamed.hw).betas) == 1


@pytest.mark.parametrize("response", ["fit", "rec601", (0.2, 0.4, 0.4)])
def test_whether_alpha_sees_luma_is_found_whatever_response_is_stated(middle, network, response):
    sample, images, _ = middle
    for alpha, alike in ((images[ALPHA], True), (1 - images[ALPHA], False)):
        views = Views.of(sample.rig, images | {ALPHA: alpha}, alpha=ALPHA)
        frame, _ = prepared(network, views, [])
        assert find_corrections(network, frame, response, align=True).response.explains == alike


def test_few_matches_judge_neither_the_spectrum_nor_vignetting(middle, network, monkeypatch):
    """Few textures give few matches, which need not explain much of alpha."""
    sample, images, _ = middle
    w = images[BETA].shape[-1]
    shade = 1 - 0.4 * torch.linspace(-1, 1, w).square()
    views = Views.of(sample.rig, images | {BETA: images[BETA] * shade}, alpha=ALPHA)
    frame, _ = prepared(network, views, [])
    assert find_corrections(network, frame, "fit", align=False).response.shading
    monkeypatch.setattr(corrections, "SETTINGS", replace(corrections.SETTINGS, matched=10.0))
    found = find_corrections(network, frame, "fit", align=False).response
    assert found.explained == 1
    assert not found.shading


def test_a_sequence_finds_corrections_once(middle, network, monkeypatch):
    from pat.fusion import sequence

    sample, images, _ = middle
    calls = []
    found = sequence.corrections_of
    monkeypatch.setattr(sequence, "corrections_of", lambda *a, **k: calls.append(1) or found(*a, **k))
    rig = sample.rig
    for name in (ALPHA, BETA):
        rig = rig.with_camera(name, rig[name].replace(sensor=replace(rig[name].sensor, frame_rate=10.0)))
    frames = {name: [image] * 3 for name, image in images.items()}
    job = SequenceFusion(network, rig, frames, ALPHA)
    for key in job.timeline.key_frames():
        job.colour(key)
    assert calls == [1]


def test_a_misalignment_is_recovered():
    """Along rows, beta one pixel lower on the left and two on the right."""
    g = torch.Generator().manual_seed(0)
    h, w = 120, 160
    texture = torch.nn.functional.interpolate(
        torch.rand(1, 1, 40, 50, generator=g), size=(h, w), mode="bicubic"
    )[0, 0]
    y, x = torch.meshgrid(torch.arange(h).float(), torch.arange(w).float(), indexing="ij")
    true = Misalignment(1.5 / w, 1.0 / w, 0.0)
    position = torch.stack([x, y], -1)
    grid = torch.stack([(2 * x + 1) / w - 1, (2 * (y + true.at(position, (h, w))) + 1) / h - 1], -1)
    alpha = torch.nn.functional.grid_sample(texture[None, None], grid[None], align_corners=False)[0, 0]
    normal = torch.stack([torch.zeros_like(x), torch.ones_like(x)], -1)
    found = fit_misalignment(alpha, texture, position, normal, torch.ones(h, w))
    corners = torch.tensor([[0.0, 0.0], [w - 1.0, 0.0], [0.0, h - 1.0], [w - 1.0, h - 1.0]])
    torch.testing.assert_close(found.at(corners, (h, w)), true.at(corners, (h, w)), atol=0.1, rtol=0)
    assert fit_misalignment(texture, texture, position, normal, torch.ones(h, w)) == Misalignment()
    assert fit_misalignment(0 * alpha, texture, position, normal, torch.ones(h, w)) == Misalignment()


def test_a_clipped_band_gets_the_light_that_alpha_shows(network, middle, monkeypatch):
    """Beta is exposed twice as long: where one of its bands is at its largest value, alpha tells the rest."""
    sample, images, _ = middle
    bright = images | {BETA: (2 * images[BETA]).clamp(max=1)}
    assert float((bright[BETA] == 1).any(0).float().mean()) > 0.2
    aware = psnr(network, sample, bright)
    monkeypatch.setattr("pat.fusion.inputs.clipped_in", lambda image, sensor: None)
    assert aware > psnr(network, sample, bright) + 1


def test_clipped_points_say_nothing_of_the_response(network, middle):
    sample, images, _ = middle
    bright = images | {BETA: (3 * images[BETA]).clamp(max=1)}
    found = corrections_of(bright, sample.rig, alpha=ALPHA, network=network).response
    assert found.gain == pytest.approx(1 / 3, abs=0.03)
    assert found.gamma == pytest.approx(1.0, abs=0.05)
    assert not found.is_unlike


@pytest.mark.parametrize(
    ("most", "exposure", "expected"),
    [(1.0, None, True), (0.5, None, False), (0.5, 0.01, True), (3.0, None, False)],
)
def test_a_band_is_clipped_at_the_largest_value_that_it_can_have(most, exposure, expected):
    """The largest is 1, the image's own where its exposure scaled it; highlights leave 1 unclipped."""
    image = torch.full((1, 3, 8, 9), 0.2)
    image[0, 0, 4, 4], image[0, 1, 0, 0] = min(most, 1.0), most
    clipped = clipped_in(image, Sensor(exposure=exposure))
    assert (clipped is not None and bool(clipped[0, 0, 4, 4])) is expected


def test_the_memory_of_inputs_includes_masks_of_clipped_bands(sample):
    network = load_weights("mono-colour")
    views = Views.of(sample.rig, sample.images, alpha=ALPHA)
    inputs = prepared(network, views, [])[0].inputs
    (beta,) = inputs.betas
    masked = replace(inputs, betas=(replace(beta, clipped=beta.image > 1),))
    bare = replace(inputs, betas=(replace(beta, clipped=None),))
    assert masked.nbytes - bare.nbytes == beta.image.numel()


def test_clipped_bands_share_light_and_others_keep_theirs():
    values = torch.tensor([1.0, 1.0, 0.4])[None, :, None, None]
    clipped = (values == 1).to(values)
    luma, alpha = luminance(values), torch.full((1, 1, 1, 1), 0.97)
    bands, brighter = with_clipped_light(values, luma, alpha, clipped)
    assert bands[0, 2] == values[0, 2]
    assert bands[0, 0] == bands[0, 1] > 1
    assert luma < brighter < alpha
    assert luminance(bands).item() == pytest.approx(brighter.item())
    same, _ = with_clipped_light(values, luma, luma - 0.1, clipped)
    assert same.equal(values)
