"""GuidedPAT: colour is added and never luminance, betas in any split, gradients reach the geometry."""

from dataclasses import replace

import pytest
import torch

from arraygeom import Camera, Epipolar, Pair, Pose, Rectified, Segments, View, intrinsics
from arraygeom.fields.grid import FieldOnGrid
from pat import FuseSettings, fuse
from pat.app.sample_array import load_sample
from pat.matching.inputs import Inputs
from pat.matching.matches import Matches
from pat.matching.positions import at_matches
from pat.media.colour import luminance
from pat.networks import guided, recall
from pat.networks.configs import GuidedPATConfig
from pat.networks.guided import GuidedPAT, window_around
from pat.networks.protocol import fused_at_once, matched_for
from pat.networks.weights import load_weights

SMALL = GuidedPATConfig(widths=(8, 8, 8, 8))
HW = (32, 48)


def rectified(beta_hw: tuple[int, int] = HW) -> FieldOnGrid:
    return FieldOnGrid.of(Rectified(10.0), Pair(View(hw=HW), View(hw=beta_hw)))


def test_luminance_is_alphas():
    torch.manual_seed(0)
    network = GuidedPAT(SMALL)
    alpha, beta = torch.rand(2, 1, *HW), torch.rand(2, 3, 32, 64)
    fused = fused_at_once(network, Inputs.of(alpha, [beta], [rectified((32, 64))]))
    assert (luminance(fused.image) - alpha).abs().max() < 1e-5
    assert (fused.image - alpha).abs().max() > 1e-2


def test_three_filtered_cameras_serve_as_one():
    """The same colours from three cameras in one place, up to what their guides (bands, not luma) say."""
    torch.manual_seed(0)
    network = GuidedPAT(SMALL)
    alpha, grey = torch.rand(1, 1, *HW), torch.rand(1, 1, *HW)
    one = fused_at_once(network, Inputs.of(alpha, [grey.expand(-1, 3, -1, -1)], [rectified()]))
    three = fused_at_once(network, Inputs.of(alpha, [grey] * 3, [rectified()] * 3))
    assert (one.image - three.image).abs().max() < 1e-5
    assert len(three.confidence) == 3


def test_bands_must_add_up():
    network = GuidedPAT(SMALL)
    with pytest.raises(ValueError, match=r"2 bands .* 3"):
        fused_at_once(network, Inputs.of(torch.rand(1, 1, *HW), [torch.rand(1, 2, *HW)], [rectified()]))


def test_the_window_stays_around_the_match():
    end = torch.tensor([20.0, 3.0]).expand(1, 8, 8, 2)
    segments = Segments(end - torch.tensor([12.0, 0.0]), end, torch.ones(1, 8, 8, dtype=torch.bool))
    for disparity, middle in ((5.0, 15.0), (-3.0, 20.0), (50.0, 8.0)):
        window = window_around(torch.full((1, 1, 4, 4), disparity), segments, 4.0)
        assert torch.allclose(window.start[..., 0], torch.tensor(middle - 4))
        assert torch.allclose(window.end[..., 0], torch.tensor(middle + 4))


def test_gradients_reach_the_rig():
    torch.manual_seed(0)
    network = GuidedPAT(SMALL)
    translation = torch.tensor([-0.2, 0.0, 0.0], dtype=torch.float64, requires_grad=True)
    camera = Camera(K=intrinsics(60.0, HW), cam_from_world=Pose.identity(), hw=HW)
    beta = camera.replace(cam_from_world=Pose(torch.eye(3, dtype=torch.float64), translation))
    depth = tuple(torch.tensor(d, dtype=torch.float64) for d in (1.0, 8.0))
    fused = fused_at_once(
        network,
        Inputs.of(
            torch.rand(1, 1, *HW),
            [torch.rand(1, 3, *HW)],
            [FieldOnGrid.of(Epipolar(), Pair(camera, beta, depth))],
        ),
    )
    fused.image.square().sum().backward()
    assert translation.grad is not None
    assert translation.grad.isfinite().all()
    assert translation.grad.abs().max() > 0


def test_no_valid_segment_is_no_confidence():
    torch.manual_seed(0)
    network = GuidedPAT(SMALL)
    pair = Pair(View(hw=HW), View(hw=HW))
    nowhere = FieldOnGrid.of(lambda _, x: Segments(x, x, torch.zeros_like(x[..., 0], dtype=torch.bool)), pair)
    fused = fused_at_once(network, Inputs.of(torch.rand(1, 1, *HW), [torch.rand(1, 3, *HW)], [nowhere]))
    assert fused.confidence[0].max() == 0
    assert fused.image.isfinite().all()


def test_where_it_is_sure_the_image_is_what_was_matched():
    torch.manual_seed(0)
    network = GuidedPAT(GuidedPATConfig(widths=(8, 8, 8, 8), keep_luminance=False))
    alpha, beta = torch.rand(1, 1, *HW), torch.rand(1, 3, *HW)
    torch.nn.init.constant_(network.confidence[2].bias, 20.0)
    inputs = Inputs.of(alpha, [beta], [rectified()])
    fused, (seen,) = network.explain(inputs, matched_for(network, inputs))
    assert seen.logit.max() > 15
    assert torch.allclose(fused.image - alpha, seen.colour, atol=1e-3)


def test_what_no_beta_sees_is_by_example_in_part(monkeypatch):
    torch.manual_seed(0)
    network = GuidedPAT(GuidedPATConfig(widths=(8, 8, 8, 8), keep_luminance=False))
    torch.nn.init.constant_(network.confidence[2].bias, -30.0)
    inputs = Inputs.of(torch.rand(1, 1, *HW), [torch.rand(1, 3, *HW)], [rectified()])
    images = []
    for found in (0.0, 0.2):
        by_example = torch.full((1, 3, HW[0] // 2, HW[1] // 2), found)
        monkeypatch.setattr(recall, "recalled", lambda *_, same=by_example: same)
        images.append(fused_at_once(network, inputs).image)
    assert torch.allclose(images[1] - images[0], torch.tensor(0.2 * recall.SETTINGS.share), atol=1e-4)


def test_colour_counts_more_where_brightness_is_alike():
    """At the same confidence."""
    torch.manual_seed(0)
    network = GuidedPAT(SMALL)
    beta = torch.full((1, 3, *HW), 0.5)
    alike, unlike = (
        network.explain(inputs, matched_for(network, inputs))[1][0]
        for inputs in (
            Inputs.of(torch.full((1, 1, *HW), value), [beta], [rectified()]) for value in (0.5, 0.9)
        )
    )
    inside = (..., slice(16, 40))
    assert (alike.likeness[inside] > 0.99).all()
    assert (unlike.likeness[inside] < 0.01).all()
    same = unlike._replace(logit=alike.logit)
    assert ((alike.blending - same.blending)[inside] > 0.05).all()


def test_brightness_tells_nothing_of_a_match_if_alpha_sees_something_else():
    """As near infrared, nearly always of another brightness: colours of certain matches gave way to what was
    filled in."""
    torch.manual_seed(0)
    network = GuidedPAT(SMALL)
    alpha, beta = torch.full((1, 1, *HW), 0.9), torch.full((1, 3, *HW), 0.5)
    inputs = replace(Inputs.of(alpha, [beta], [rectified()]), sees_luma=False)
    (found,) = network.explain(inputs, matched_for(network, inputs))[1]
    assert (found.likeness == 1).all()


def test_certain_colours_are_those_at_the_chosen_position_if_alpha_sees_something_else():
    torch.manual_seed(0)
    network = GuidedPAT(SMALL)
    inputs = Inputs.of(torch.rand(1, 1, *HW), [torch.rand(1, 3, *HW)], [rectified()])
    (matched,) = matched_for(network, inputs).betas
    sure = torch.ones(1, 2, HW[0] // 2, HW[1] // 2)
    elsewhere = {"chosen": torch.full((1, 1, *HW), 4.0), "disparity": torch.full((1, 1, *HW), 7.0)}
    matches = Matches((replace(matched, **elsewhere, certainty=sure),))
    there, valid = at_matches(inputs.betas[0].image, inputs.betas[0].field.straight, matches.betas[0].surface)
    assert valid[..., 16:].all()
    for sees_luma in (True, False):
        image = network.explain(replace(inputs, sees_luma=sees_luma), matches)[0].image.detach()
        off = (image - luminance(image) - (there - luminance(there)))[..., 16:].abs().max()
        assert (float(off) > 0.01) == sees_luma


def test_features_are_as_exact_as_the_image_and_positions_more(monkeypatch):
    """Features in float64 took a sixth of a tile's time, and of its memory, for 2e-6 of the image."""
    asked, attend = [], guided.attend_with_statistics

    def noted(query, key, value, window, **options):
        asked.append({t.dtype for t in (query, key, value)} | {window.start.dtype})
        return attend(query, key, value, window, **options)

    monkeypatch.setattr(guided, "attend_with_statistics", noted)
    images = torch.rand(1, 1, *HW), [torch.rand(1, 3, *HW)]
    found = fused_at_once(GuidedPAT(SMALL).eval(), Inputs.of(*images, [rectified()]))
    assert asked == [{torch.float32, torch.float64}]
    assert found.position[0].dtype == torch.float64


def test_confidence_shows_no_grid_of_the_pixels_that_are_made_of_one():
    """The four pixels of each at half the size differed by up to .02 in the mean."""
    sample = load_sample()
    found = fuse(
        sample.images,
        sample.rig,
        alpha="mono",
        network=load_weights("mono-colour"),
        settings=FuseSettings(align=False),
    ).confidence
    apart = found.unflatten(0, (-1, 2)).unflatten(2, (-1, 2)).mean((0, 2))
    assert float(apart.max() - apart.min()) < 0.002
