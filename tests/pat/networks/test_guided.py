"""GuidedPAT: colour is added and never luminance, bands and betas in any order, gradients reach the rig."""

from dataclasses import replace

import pytest
import torch

from arraygeom import Camera, Epipolar, Pair, Pose, Rectified, Rig, Segments, View, intrinsics
from arraygeom.fields.grid import FieldOnGrid
from pat import FuseSettings, fuse
from pat.app.sample_array import load_sample
from pat.fusion.steps import co_located
from pat.matching.colour_transfer import transferred
from pat.matching.inputs import Inputs, Matches, at_matches
from pat.media.colour import luminance
from pat.networks import guided
from pat.networks.configs import GuidedPATConfig
from pat.networks.guided import GuidedPAT
from pat.networks.protocol import fused_at_once, matched_for
from pat.networks.weights import load_weights
from tests.arraygeom.rigs import parallel_rig
from tests.pat.matching.test_band_mix import texture

HW = (32, 48)


def rectified(beta_hw: tuple[int, int] = HW) -> FieldOnGrid:
    return FieldOnGrid.from_field(Rectified(10.0), Pair(View(hw=HW), View(hw=beta_hw)))


@pytest.mark.parametrize("learned", [True, False])
def test_luminance_is_alphas(learned):
    torch.manual_seed(0)
    network = GuidedPAT(GuidedPATConfig(learned=learned))
    alpha, beta = torch.rand(2, 1, *HW), torch.rand(2, 3, 32, 64)
    fused = fused_at_once(network, Inputs.from_images(alpha, [beta], [rectified((32, 64))]))
    assert (luminance(fused.image) - alpha).abs().max() < 1e-5
    assert (fused.image - alpha).abs().max() > 1e-2


def test_three_filtered_cameras_serve_as_one():
    """The same colours from three cameras in one place, up to what their guides (bands, not luma) say."""
    torch.manual_seed(0)
    network = GuidedPAT()
    alpha, grey = torch.rand(1, 1, *HW), torch.rand(1, 1, *HW)
    one = fused_at_once(network, Inputs.from_images(alpha, [grey.expand(-1, 3, -1, -1)], [rectified()]))
    three = fused_at_once(network, Inputs.from_images(alpha, [grey] * 3, [rectified()] * 3))
    assert (one.image - three.image).abs().max() < 1e-5
    assert len(three.confidence) == 3


def test_the_image_is_as_certain_as_the_betas_it_is_of():
    """A mono beta beside a colour one, of which depth alone is known, says nothing of colours."""
    torch.manual_seed(0)
    alpha = torch.rand(1, 1, *HW)
    betas = [torch.rand(1, 3, *HW), alpha.clone()]
    fused = fused_at_once(GuidedPAT(), Inputs.from_images(alpha, betas, [rectified()] * 2))
    colour, mono = fused.confidence
    assert (mono > colour).any()
    assert fused.overall.equal(colour)


def test_bands_must_add_up():
    network = GuidedPAT()
    with pytest.raises(ValueError, match=r"2 bands .* 3"):
        fused_at_once(
            network, Inputs.from_images(torch.rand(1, 1, *HW), [torch.rand(1, 2, *HW)], [rectified()])
        )


@pytest.mark.parametrize("change", [{}, {"learned": False}, {"bands": None}], ids=str)
def test_gradients_reach_the_rig(change):
    torch.manual_seed(0)
    network = GuidedPAT(GuidedPATConfig(**change))
    translation = torch.tensor([-0.2, 0.0, 0.0], dtype=torch.float64, requires_grad=True)
    camera = Camera(K=intrinsics(60.0, HW), cam_from_world=Pose.identity(), hw=HW)
    beta = camera.replace(cam_from_world=Pose(torch.eye(3, dtype=torch.float64), translation))
    depth = tuple(torch.tensor(d, dtype=torch.float64) for d in (1.0, 8.0))
    fused = fused_at_once(
        network,
        Inputs.from_images(
            torch.rand(1, 1, *HW),
            [torch.rand(1, 3, *HW)],
            [FieldOnGrid.from_field(Epipolar(), Pair(camera, beta, depth))],
        ),
    )
    fused.image.square().sum().backward()
    assert translation.grad is not None
    assert translation.grad.isfinite().all()
    assert translation.grad.abs().max() > 0


def test_no_valid_segment_is_no_confidence():
    torch.manual_seed(0)
    network = GuidedPAT()
    pair = Pair(View(hw=HW), View(hw=HW))
    nowhere = FieldOnGrid.from_field(
        lambda _, x: Segments(x, x, torch.zeros_like(x[..., 0], dtype=torch.bool)), pair
    )
    fused = fused_at_once(
        network, Inputs.from_images(torch.rand(1, 1, *HW), [torch.rand(1, 3, *HW)], [nowhere])
    )
    assert fused.confidence[0].max() == 0
    assert fused.image.isfinite().all()


def changed_to(matches: Matches, **planes: float | torch.Tensor) -> Matches:
    """Matches whose colours have other planes, or planes of one value."""
    betas = []
    for one in matches.betas:
        new = {name: torch.zeros_like(getattr(one.carried, name)) + given for name, given in planes.items()}
        betas.append(replace(one, colours=one.carried._replace(**new)))
    return Matches(tuple(betas))


def test_where_it_is_sure_the_image_is_what_was_matched():
    torch.manual_seed(0)
    network = GuidedPAT(GuidedPATConfig(keep_luminance=False))
    inputs = Inputs.from_images(torch.rand(1, 1, *HW), [torch.rand(1, 3, *HW)], [rectified()])
    matches = changed_to(matched_for(network, inputs), weight=1.0)
    fused = network(inputs, matches)
    assert torch.allclose(fused.image - inputs.alpha, matches.betas[0].carried.bands, atol=1e-5)


def test_what_no_beta_sees_is_half_by_attention_and_half_by_nearest_examples(monkeypatch):
    torch.manual_seed(0)
    network = GuidedPAT(GuidedPATConfig(keep_luminance=False))
    inputs = Inputs.from_images(torch.rand(1, 1, *HW), [torch.rand(1, 3, *HW)], [rectified()])
    found = matched_for(network, inputs)
    images = {}
    for recalled, nearest in ((0.0, 0.0), (0.2, 0.0), (0.0, 0.2)):
        monkeypatch.setattr(guided, "by_example", lambda _, colour, __, v=recalled: colour * 0 + v)
        fills = found.betas[0].carried.fills.clone()
        fills[:, -1] = nearest
        images[recalled, nearest] = network(inputs, changed_to(found, weight=0.0, fills=fills)).image
    for other in ((0.2, 0.0), (0.0, 0.2)):
        assert torch.allclose(images[other] - images[0.0, 0.0], torch.tensor(0.1), atol=1e-5)


def test_what_is_doubtful_lies_between_matched_and_filled():
    """The more certain, the nearer to the match."""
    torch.manual_seed(0)
    network = GuidedPAT(GuidedPATConfig(keep_luminance=False))
    inputs = Inputs.from_images(torch.full((1, 1, *HW), 0.5), [torch.rand(1, 3, *HW)], [rectified()])
    found = changed_to(matched_for(network, inputs), bands=1.0, fills=0.0)
    means = [
        float((network(inputs, changed_to(found, weight=weight)).image - inputs.alpha).mean())
        for weight in (0.2, 0.5, 0.8, 1.0)
    ]
    assert means == sorted(means)
    assert means[-1] == pytest.approx(1.0)


def test_brightness_tells_of_a_match_unless_alpha_sees_something_else():
    """Near infrared is nearly always of another brightness: certain matches keep their colours there."""
    beta = torch.full((1, 3, *HW), 0.5)
    alpha = beta[:, :1].clone()
    alpha[..., 20:28] = 0.9
    inputs = Inputs.from_images(alpha, [beta], [rectified()])
    network = GuidedPAT()
    alike, ignored = (
        matched_for(network, replace(inputs, sees_luma=sees)).betas[0].carried.likeness
        for sees in (True, False)
    )
    assert alike[..., 22:26].max() < 0.01
    assert alike[..., 34:].min() > 0.2
    assert (ignored == 1).all()


def test_certain_colours_are_those_at_the_chosen_position_if_alpha_sees_something_else():
    torch.manual_seed(0)
    network = GuidedPAT()
    inputs = Inputs.from_images(torch.rand(1, 1, *HW), [torch.rand(1, 3, *HW)], [rectified()])
    (matched,) = matched_for(network, inputs).betas
    sure = torch.ones(1, 2, HW[0] // 2, HW[1] // 2)
    elsewhere = {"chosen": torch.full((1, 1, *HW), 4.0), "disparity": torch.full((1, 1, *HW), 7.0)}
    matches = Matches((replace(matched, **elsewhere, certainty=sure),))
    there, valid = at_matches(inputs.betas[0].image, inputs.betas[0].field.straight, matches.betas[0].surface)
    assert valid[..., 16:].all()
    for sees_luma in (True, False):
        coloured = transferred(replace(inputs, sees_luma=sees_luma), matches)
        image = network(replace(inputs, sees_luma=sees_luma), coloured).image
        off = (image - luminance(image) - (there - luminance(there)))[..., 16:].abs().max()
        assert (float(off) > 0.01) == sees_luma


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


# Any bands of any betas -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def banded():
    return GuidedPAT(GuidedPATConfig(bands=None)).eval()


def field(disparity):
    return FieldOnGrid.from_field(Rectified(disparity), Pair(View(hw=HW), View(hw=HW)))


def test_permuting_betas_of_one_band_permutes_the_output_bands(banded):
    alpha, bands = torch.rand(2, 1, *HW), list(torch.rand(4, 2, 1, *HW))
    fields, order = [field(d) for d in (6.0, 9.0, 12.0, 4.0)], [2, 0, 1, 3]
    with torch.no_grad():
        first, second = (
            fused_at_once(
                banded, Inputs.from_images(alpha, [bands[i] for i in which], [fields[i] for i in which])
            )
            for which in (range(4), order)
        )
    assert first.image.shape == (2, 4, *HW)
    assert torch.equal(second.image, first.image[:, order])
    assert all(torch.equal(second.confidence[k], first.confidence[i]) for k, i in enumerate(order))
    assert (first.image[:, 0] - first.image[:, 1]).abs().max() > 1e-3


@pytest.mark.parametrize("count", [2, 3, 5])
def test_permuting_the_bands_of_a_beta_permutes_the_output_bands(banded, count):
    hw, order = (64, 96), torch.randperm(count, generator=torch.Generator().manual_seed(count)).tolist()
    scene = torch.cat([texture(count, (64, 104), seed=i) for i in range(2)])
    alpha, beta = scene[:, :1, :, :-8] * 0.4 + scene[:, 1:2, :, :-8] * 0.6, scene[..., 8:]
    there = [FieldOnGrid.from_field(Rectified(16.0, alpha_is="left"), Pair(View(hw=hw), View(hw=hw)))]
    with torch.no_grad():
        first, second = (
            fused_at_once(banded, Inputs.from_images(alpha, [b], there)) for b in (beta, beta[:, order])
        )
    assert torch.equal(second.image, first.image[:, order])
    assert torch.equal(second.position[0], first.position[0])
    assert len(first.confidence) == 1


def rig_of(names, places):
    """Alpha, and betas 10 cm times their place to the right of it."""
    betas = {name: (0.1 * place,) for name, place in zip(names, places)}
    return parallel_rig(100.0, (64, 96), {"alpha": (), **betas}, (1.0, 8.0))


def test_co_located_cameras_are_one_with_several_bands(banded):
    bands, alpha = texture(3, (64, 96))[0], texture(3, (64, 96))[0, :1]
    images = {"alpha": alpha, **dict(zip("rgb", bands.split(1)))}
    apart = fuse(images, rig_of("rgb", [1, 1, 1]), alpha="alpha", network=banded)
    whole = fuse({"alpha": alpha, "c": bands}, rig_of("c", [1]), alpha="alpha", network=banded)
    assert torch.equal(apart.image, whole.image)
    assert torch.equal(apart.confidence, whole.confidence)


def test_bands_come_out_in_the_order_of_their_cameras(banded):
    """The second camera is elsewhere, the first and the third at one place."""
    bands, alpha = texture(3, (64, 96))[0], texture(3, (64, 96))[0, :1]
    images = dict(zip("rgb", bands.split(1)))
    mixed = fuse({"alpha": alpha, **images}, rig_of("rgb", [1, 2, 1]), alpha="alpha", network=banded)
    sorted_ = fuse({"alpha": alpha, **images}, rig_of("rbg", [1, 1, 2]), alpha="alpha", network=banded)
    assert torch.equal(mixed.image, sorted_.image[[0, 2, 1]])
    assert mixed.image.shape[0] == 3


def test_which_cameras_are_put_together():
    rig, fields = rig_of("abcd", [1, 2, 1, 1]), dict.fromkeys("abcd")
    assert co_located(rig, "abcd", fields, "all") == [["a", "c", "d"], ["b"]]
    assert co_located(rig, "abcd", fields, "neighbours") == [["a"], ["b"], ["c", "d"]]
    assert co_located(rig, "abcd", fields, "no") == [["a"], ["b"], ["c"], ["d"]]
    assert co_located(rig, "abcd", fields | {"c": Rectified(5.0)}, "all") == [["a", "d"], ["b"], ["c"]]
    smaller = Rig({**rig.cameras, "c": rig["c"].resize((32, 48))}, depth=rig.depth)
    assert co_located(smaller, "abcd", fields, "all") == [["a", "d"], ["b"], ["c"]]


def test_bands_unlike_alpha_keep_their_own_brightness(banded):
    """Not alpha's: one is half as bright, one is inverted; either is right where it is seen."""
    hw = (64, 96)
    scene = texture(1, (64, 104), seed=3)
    alpha, beta = scene[..., :-8], torch.cat([0.5 * scene, 1 - scene], 1)[..., 8:]
    there = FieldOnGrid.from_field(Rectified(16.0, alpha_is="left"), Pair(View(hw=hw), View(hw=hw)))
    fused = fused_at_once(banded, Inputs.from_images(alpha, [beta], [there])).image
    wanted = torch.cat([0.5 * alpha, 1 - alpha], 1)
    off, unlike = ((image - wanted)[..., 12:-4].abs().mean() for image in (fused, alpha))
    assert off < 0.15 * unlike
    assert not banded.keeps_luminance
