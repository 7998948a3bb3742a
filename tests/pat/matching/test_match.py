"""The door of the room: matches of several sources, and what is refused."""

import logging
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from arraygeom import Epipolar, Local, pixel_grid
from arraygeom.fields.grid import FieldOnGrid
from pat import FuseSettings, fuse
from pat.fusion.inputs import frame_inputs
from pat.fusion.views import Views
from pat.matching.colour_transfer import transferred
from pat.matching.inputs import Colours, Inputs, Matches, box_around, enlarged
from pat.matching.match import in_each_beta, located, match
from pat.media.colour import luminance
from pat.networks.protocol import FusionOutput, fused_at_once
from pat.networks.weights import load_weights
from tests.arraygeom.rigs import parallel_rig

H, W = 64, 96
DEPTH, BASELINE = 4.0, 0.25


@pytest.fixture(scope="module")
def network():
    return load_weights("mono-colour")


@pytest.fixture(scope="module")
def flat():
    """A wall at 4 m: every disparity is 6 pixels."""
    noise = torch.rand(1, 3, H // 2, (W + 16) // 2, generator=torch.Generator().manual_seed(0))
    wall = torch.nn.functional.interpolate(noise, size=(H, W + 16), mode="bicubic", align_corners=False)[
        0
    ].clamp(0, 1)
    images = {"mono": luminance(wall[..., :W]), "colour": wall[..., 6 : 6 + W]}
    return parallel_rig(float(W), (H, W), {"mono": (), "colour": (BASELINE,)}, (2.0, 50.0)), images


@pytest.fixture(scope="module")
def inputs(network, flat):
    rig, images = flat
    return frame_inputs(network, Views.of(rig, images, alpha="mono")).inputs


@pytest.mark.parametrize("off", [-500.0, 500.0])
def test_a_part_whose_segments_are_off_beta_has_some_of_beta(network, inputs, off):
    """Fields of one's own need not clip them: what is off the image does not count."""
    field = inputs.betas[0].field.displaced(lambda _, x: x.new_tensor([off, 0.0]).expand_as(x))
    (beta,) = inputs.betas
    part = replace(inputs, betas=(replace(beta, field=field),)).cut((0, 32, 32, 64))
    assert min(part.betas[0].image.shape) > 0
    assert part.betas[0].field.straight.valid.any()
    assert fused_at_once(network, part).confidence[0].max() == 0


def test_explicit_positions_of_a_part_are_never_all_held(flat):
    """A part of alpha comes with what its positions, here a window a pixel, touch of beta."""
    rig, images = flat
    window, asked = Local(11), []

    def field(pair, x):
        asked.append(len(x))
        return window(pair, x)

    alpha, beta = images["mono"][None], images["colour"][None]
    inputs = Inputs.from_images(alpha, [beta], [FieldOnGrid.from_field(field, rig.pair("mono", "colour"))])
    box = inputs.touched(inputs.betas[0], (16, 48, 32, 64))
    positions = window(rig.pair("mono", "colour"), pixel_grid((H, W))[16:48:2, 32:64:2].reshape(-1, 2))
    assert box == box_around(positions.xy[positions.mask], (H, W), inputs.beta_halo, inputs.multiple)
    assert max(asked) <= W
    with pytest.raises(ValueError, match="NaN"):
        box_around(torch.tensor([[3.0, 4.0], [torch.nan, 5.0]]), (H, W), 2, 2)


def test_positions_are_where_the_wall_is(inputs):
    (found,) = match(inputs).betas
    where, valid = found.positions(inputs.betas[0].field.straight, (H, W))
    columns = torch.arange(W).to(where)
    inside = valid[0, :, 10:]
    assert inside.float().mean() > 0.99
    assert (where[0, :, 10:, 0] - (columns[10:] - 6))[inside].median().abs() < 0.1


def test_matches_are_located_first_and_coloured_then(inputs):
    whole, (bare,) = match(inputs), located(inputs).betas
    assert bare.colours is None
    with pytest.raises(ValueError, match="colours"):
        bare.carried  # noqa: B018
    (again,) = transferred(inputs, Matches((bare,))).betas
    assert all(torch.equal(*planes) for planes in zip(again.carried, whole.betas[0].carried))


def test_which_beta_is_matched_is_said(inputs, caplog):
    """The nine-band array shows progress by beta."""
    with caplog.at_level(logging.INFO, "pat.matching.match"):
        located(replace(inputs, betas=inputs.betas[:1] * 2))
    said = [record.getMessage() for record in caplog.records if record.name == "pat.matching.match"]
    assert said == ["matching beta 1 of 2", "matching beta 2 of 2"]


def test_matches_from_a_file_take_the_place_of_those_found(network, flat, tmp_path):
    """Disparities that are known are used as they are: depth is theirs, whatever the images show."""
    rig, images = flat
    other = {**images, "colour": torch.rand(3, H, W, generator=torch.Generator().manual_seed(1))}
    path = tmp_path / "disparity.pt"
    wanted = BASELINE * W / DEPTH
    torch.save(torch.full((1, 1, H, W), wanted - BASELINE * W / 50.0), path)

    def from_file(inputs):
        (one,) = in_each_beta(inputs).betas
        disparity = torch.load(path, weights_only=True).to(one.disparity)
        sure = torch.tensor([0.0, 1.0, 0.0])[:, None, None].expand_as(one.facts[0])[None]
        return transferred(inputs, Matches((replace(one, disparity=disparity, facts=sure.to(one.facts)),)))

    frame = fuse(
        other,
        rig,
        alpha="mono",
        network=network,
        settings=FuseSettings(align=False, response="rec601"),
        matcher=from_file,
    )
    assert float((frame.depth[:, 10:] - DEPTH).abs().nanmedian()) < 1e-3


def test_matches_of_other_inputs_are_refused(network, inputs):
    found = match(inputs)
    with pytest.raises(ValueError, match=r"48x64 .* 1 betas, .* 96x64 with 1"):
        network(inputs, found.cut((0, H, 0, 48)))
    with pytest.raises(ValueError, match="in 2 betas"):
        network(inputs, Matches(found.betas * 2))
    with pytest.raises(ValueError, match="in 2 betas"):
        transferred(inputs, Matches(found.betas * 2))


@pytest.mark.parametrize("learned", [True, False])
@pytest.mark.parametrize(
    ("hw", "beta_hw", "bands"),
    [
        ((2, 2), (2, 2), 1),
        ((6, 40), (6, 40), 3),
        ((16, 16), (4, 4), 3),
        ((16, 16), (1, 1), 1),
        ((10, 10), (10, 10), 3),
    ],
)
def test_images_too_small_to_match_or_not_padded_are_refused(hw, beta_hw, bands, learned):
    rig = parallel_rig(8.0, hw, {"mono": (), "beta": (BASELINE,)}, (2.0, 50.0)).resize("beta", beta_hw)
    field = FieldOnGrid.from_field(Epipolar(), rig.pair("mono", "beta"))
    inputs = Inputs.from_images(torch.rand(1, 1, *hw), [torch.rand(1, bands, *beta_hw)], [field])
    with pytest.raises(ValueError, match=r"pixels"):
        match(replace(inputs, learned=learned))


def test_an_alpha_in_colour_is_refused(inputs):
    with pytest.raises(ValueError, match="3 channels"):
        match(replace(inputs, alpha=inputs.alpha.expand(-1, 3, -1, -1)))


def test_a_network_that_needs_matches_says_so(network, inputs):
    with pytest.raises(ValueError, match="matches"):
        network(inputs)


class Plain:
    """A network without matches: beta's colours at the middle of each segment."""

    halo, beta_halo, multiple, equal_resolution, joins_bands = 0, 2, 2, True, "no"
    bands, uses_matches, learned, keeps_luminance = None, False, False, False

    def working_bytes(self, alpha, betas):
        return 8.0 * alpha

    def __call__(self, inputs, matches=None):
        assert matches is None
        segments = inputs.betas[0].field.straight
        middle = ((segments.start + segments.end) / 2).movedim(-1, 1)
        none = inputs.alpha[:, 0] * 0
        return FusionOutput(inputs.alpha.expand(-1, 3, -1, -1), [middle], [none], [none + 0.5])


def test_a_network_without_matches_is_not_matched_for(flat):
    def never(inputs):
        raise AssertionError("no matches were asked for")

    rig, images = flat
    frame = fuse(images, rig, alpha="mono", network=Plain(), matcher=never)
    assert frame.image.shape == (3, H, W)
    assert float(frame.depth.nanmedian()) == pytest.approx(2 / (1 / 2 + 1 / 50), rel=0.01)


def holed(plane):
    plane = plane.clone()
    plane[..., 10:20, 10:20] = torch.nan
    return plane


@pytest.mark.parametrize(
    ("plane", "change", "problem"),
    [
        ("disparity", holed, "disparity.*NaN"),
        ("facts", holed, "facts.*NaN"),
        ("bands", holed, "bands.*NaN"),
        ("weight", holed, "weight.*NaN"),
        ("certainty", holed, "certainty.*NaN"),
        ("certainty", lambda plane: plane + 7, "certainty"),
        ("disparity", Tensor.double, "float64.*float32"),
        ("disparity", Tensor.long, "disparity.*int64"),
        ("facts", lambda plane: enlarged(plane), "facts.*float32"),
        ("bands", lambda plane: plane[:, :1], "bands.*float32"),
        ("fills", lambda plane: plane[:, :, :1], "fills.*float32"),
        (
            "likeness",
            lambda plane: plane.expand(-1, 3, -1, -1),
            r"likeness.*\(1, 1, 64, 96\)",
        ),
        ("chosen", lambda plane: plane[..., ::2, ::2], "chosen.*float32"),
    ],
)
def test_matches_of_ones_own_are_checked(network, flat, plane, change, problem):
    """NaN and other shapes are refused with a sentence."""
    rig, images = flat

    def matcher(inputs):
        (found,) = match(inputs).betas
        if plane in Colours._fields:
            changed = change(getattr(found.carried, plane))
            return Matches((replace(found, colours=found.carried._replace(**{plane: changed})),))
        return Matches((replace(found, **{plane: change(getattr(found, plane))}),))

    with pytest.raises(ValueError, match=problem):
        fuse(
            images,
            rig,
            alpha="mono",
            network=network,
            settings=FuseSettings(align=False, response="rec601"),
            matcher=matcher,
        )
