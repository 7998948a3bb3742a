"""Depth stays within the bounds that were searched, wherever a network puts its positions."""

from dataclasses import dataclass

import pytest
import torch

from arraygeom import Curved, Distortion, Epipolar, Segments, pixel_grid
from arraygeom.fields.grid import FieldOnGrid
from arraygeom.lenses import Equirectangular
from pat.fusion.depth import measured_depth
from pat.fusion.depth_filling import background_filled, without_outliers
from pat.fusion.frame import Frame
from pat.fusion.inputs import FrameInputs, Placement, frame_inputs, measured_along
from pat.fusion.steps import quarter_turns
from pat.fusion.views import Views
from pat.matching.inputs import Beta, Inputs
from pat.networks.configs import PATConfig
from pat.networks.paper import PAT
from pat.networks.protocol import FusionOutput
from tests.arraygeom.rigs import parallel_rig

NEAR, FAR, HW = 1.4, 20.0, (12, 40)


def pair():
    return parallel_rig(300.0, HW, {"a": (), "b": (0.1, -0.02, -0.01)}, (NEAR, FAR)).pair("a", "b")


@pytest.mark.parametrize("share", [-0.5, -1e-3, 0.0, 0.3, 1.0, 1.001, 1.2])
def test_positions_beyond_a_segment_are_its_ends(share):
    p = pair()
    field = FieldOnGrid.from_field(Epipolar(), p)
    whole = Inputs.from_images(torch.zeros(1, 1, *HW), [torch.zeros(1, 3, *HW)], [field])
    for box in ((0, 12, 0, 40), (4, 12, 8, 32)):
        part = whole.cut(box)
        hw = box[1] - box[0], box[3] - box[2]
        found = part.betas[0].field.pixels
        position = (found.start + share * (found.end - found.start)).movedim(-1, 1).float()
        ones = torch.ones(1, *hw)
        output = FusionOutput(torch.zeros(1, 3, *hw), [position], [ones], [ones])
        depth, *_ = measured_depth(output, part, [Placement(p, lambda x: x)], hw, (box[2], box[0]))
        seen = found.valid[0]
        assert seen.any()
        assert depth[seen].isfinite().all()
        assert (depth[seen] > NEAR * 0.999).all()
        assert (depth[seen] < FAR * 1.001).all()


LENSES = {
    "none": None,
    "brown-conrady": Distortion("brown-conrady", torch.tensor([-0.05, 0.0, 0.0, 0.0], dtype=torch.float64)),
    "fisheye": Distortion("kannala-brandt", torch.zeros(4, dtype=torch.float64)),
}


@pytest.mark.parametrize("depth", [(NEAR, FAR), None])
@pytest.mark.parametrize("true", [0.2, 1.0, 60.0, -60.0])
@pytest.mark.parametrize("lens", LENSES)
def test_bounds_are_those_of_the_field_where_it_has_some(lens, true, depth):
    """Through lenses too, and distances of a wide fisheye."""
    wide = lens == "fisheye"
    hw, near, far = (24, 64), 0.5, 30.0
    places = {"a": (), "b": (0.02, -0.01, -0.005)}
    rig = parallel_rig(20.0 if wide else 60.0, hw, places, depth, distortion=LENSES[lens])
    field = Epipolar(near, far) if lens == "none" else Curved(near=near, far=far, bounds=BOUNDS[wide])
    images = {"a": torch.zeros(1, *hw), "b": torch.zeros(3, *hw)}
    views = Views.of(rig, images, alpha="a", field=field)
    found = frame_inputs(PAT(PATConfig(dim=4)), views)
    rays, _ = rig["a"].rays(pixel_grid(hw, dtype=torch.float64))
    rays = rays / (rays.norm(dim=-1, keepdim=True) if wide else rays[..., 2:])
    x_beta = rig["b"].project_local(rays + rig["b"].t / true).x
    position, ones = x_beta.movedim(-1, 0)[None], torch.ones(1, *hw, dtype=torch.float64)
    output = FusionOutput(torch.zeros(1, 3, *hw).double(), [position], [ones], [ones])
    inner = (slice(4, 20), slice(16, 48))  # whose segments are not cut by the edge of the image
    depth = measured_depth(output, found.inputs, found.placements, hw, (0, 0))[0][inner]
    wanted = min(max(true, near), far) if true > 0 else far
    torch.testing.assert_close(depth, torch.full_like(depth, wanted), rtol=1e-3, atol=0)


BOUNDS = {False: "depth", True: "distance"}


def test_a_field_with_bounds_needs_none_of_the_rig_in_cameras_of_any_model():
    """No step asks for the rig's depth range."""
    rig = parallel_rig(10.0, HW, {"a": (), "b": ()}, distortion=Equirectangular())
    images = {"a": torch.zeros(1, *HW), "b": torch.zeros(3, *HW)}
    views = Views.of(rig, images, alpha="a", field=Curved(near=1.0, far=3.0))
    assert quarter_turns(views.pair("b")) == 0


@dataclass(frozen=True)
class OwnField:
    bounds: str

    def __call__(self, pair, x):
        return Curved(bounds=self.bounds)(pair, x)


@pytest.mark.parametrize(
    ("lens", "field", "along"),
    [
        (None, None, "depth"),
        (LENSES["fisheye"], None, "depth"),  # undistorted
        (LENSES["fisheye"], Curved(bounds="distance"), "distance"),
        (Equirectangular(), None, "distance"),
        (Equirectangular(), Curved(), "depth"),
        (Equirectangular(), OwnField("depth"), "depth"),
        (Equirectangular(), OwnField("distance"), "distance"),
        (LENSES["fisheye"], OwnField("distance"), "distance"),
    ],
)
def test_what_depth_is_measured_along(lens, field, along):
    rig = parallel_rig(10.0, HW, {"a": (), "b": ()}, (NEAR, FAR), distortion=lens)
    images = {"a": torch.zeros(1, *HW), "b": torch.zeros(3, *HW)}
    assert measured_along(Views.of(rig, images, alpha="a", field=field)) == along


def fields_along(*steps, alpha=None, pairs=()):
    alpha = torch.zeros(6, 6) if alpha is None else alpha
    inputs = Inputs(alpha[None, None], tuple(beta_along(step) for step in steps))
    return FrameInputs(inputs, [Placement(p, lambda x: x) for p in pairs], tuple(alpha.shape))


def beta_along(step):
    end = torch.zeros(1, 6, 6, 2)
    segments = Segments(end + torch.tensor(step), end, torch.ones(1, 6, 6, dtype=torch.bool))
    return Beta(torch.zeros(1, 1, 6, 6), FieldOnGrid(lambda x: segments, 2, segments))


def frame_of(depth, confidence):
    return Frame(torch.zeros(1, *depth.shape), depth, confidence, torch.full_like(depth, 0.01))


@pytest.mark.parametrize("step", [[4.0, 0.0], [0.0, 4.0]])
def test_depth_of_low_confidence_is_that_of_the_background_beside_it(step):
    depth = torch.full((6, 6), 5.0)
    depth[:, :2] = 2.0
    depth[:, 2:4] = 1.0  # wrong, and not confident
    depth[0, 2] = torch.nan
    confidence = torch.ones(6, 6)
    confidence[:, 2:4] = 0.1
    wanted = depth.clone()
    wanted[:, 2:4] = 5.0
    wanted[0, 2] = torch.nan
    if step[1]:
        depth, confidence, wanted = depth.mT, confidence.mT, wanted.mT
    found = background_filled(frame_of(depth, confidence), fields_along(step))
    torch.testing.assert_close(found, wanted, equal_nan=True, rtol=1e-3, atol=0)


def test_planes_end_at_the_bounds_that_were_searched():
    """Planes of a floor that runs into the distance end at the far bound."""
    inverse = torch.linspace(1 / 2, 1 / 18, 100).repeat(40, 1)
    depth = torch.cat([1 / inverse, torch.full((40, 30), 10.0)], 1)  # the last ones wrong, and not confident
    confidence = torch.where(torch.arange(130) < 100, 1.0, 0.1).repeat(40, 1)
    frame, alpha = frame_of(depth, confidence), torch.zeros(40, 130)
    anywhere = background_filled(frame, fields_along([4.0, 0.0], alpha=alpha))
    assert anywhere[:, 100:].max() > 1.1 * FAR
    found = background_filled(frame, fields_along([4.0, 0.0], alpha=alpha, pairs=[pair()]))
    assert found[:, 100:].max() == pytest.approx(FAR)
    within = (anywhere < 0.99 * FAR) & (anywhere != 10)  # beyond infinity depth is as it was
    torch.testing.assert_close(found[within], anywhere[within], rtol=1e-3, atol=0)


def two_planes():
    """Inverse depth of two slanted planes, one above the other, and alpha, in which an edge parts them."""
    y, x = torch.meshgrid(torch.arange(120.0), torch.arange(160.0), indexing="ij")
    upper = y < 60
    inverse = torch.where(upper, 0.4 + 5e-4 * x - 1e-3 * y, 0.9 - 4e-3 * x + 1e-3 * (y - 60))
    return inverse, torch.where(upper, 0.1, 0.9)


@pytest.mark.parametrize("step", [[4.0, 0.0], [0.0, 4.0]])
def test_depth_beyond_the_border_is_that_of_the_slanted_plane_beside_it(step):
    """And of the right one of two; a plane's inverse depth is linear. Nearest ones are far off."""
    inverse, alpha = two_planes()
    confidence = torch.full_like(inverse, 0.9)
    confidence[:, :20] = 0.2
    depth = torch.where(confidence < 0.5, 1.3, 1 / inverse)
    if step[1]:
        depth, confidence, alpha = (t.mT for t in (depth, confidence, alpha))
    found = background_filled(frame_of(depth, confidence), fields_along(step, alpha=alpha))
    assert torch.equal(found[confidence > 0.5], depth[confidence > 0.5])
    error = (1 / (found.mT if step[1] else found) - inverse)[:, :20].abs()
    assert error.mean() < (inverse[:, 20:21] - inverse[:, :20]).abs().mean() / 7
    inside = error[torch.arange(120) != 60]  # a row of the lower plane, of a pair whose first is of the upper
    assert (inside[:, 1::2].mean() / inside[:, ::2].mean() - 1).abs() < 0.1


def test_a_match_is_left_if_those_around_it_are_far_more_certain():
    """Thrice as certain as half of the frame is not enough."""
    inverse, alpha = two_planes()
    confidence = torch.where(alpha > 0.5, 0.9, 0.1)
    confidence[90, 80] = 0.3
    depth = 1 / inverse
    depth[90, 80] = 1 / (inverse[90, 80] + 0.015)
    found = background_filled(frame_of(depth, confidence), fields_along([4.0, 0.0], alpha=alpha))
    assert abs(1 / float(found[90, 80]) - float(inverse[90, 80])) < 0.003


def test_depth_in_parts_is_that_of_the_whole(monkeypatch):
    inverse, alpha = (torch.cat([t, t.flip(0), t]) for t in two_planes())
    confidence = torch.full_like(inverse, 0.9)
    confidence[:, :20] = 0.2
    confidence[::7] = 0.2
    frame, inputs = frame_of(1 / inverse, confidence), fields_along([4.0, 0.0], alpha=alpha)
    whole = background_filled(frame, inputs)
    monkeypatch.setattr("pat.fusion.depth_filling.ROWS", 64)
    assert (1 / background_filled(frame, inputs) - 1 / whole).abs().max() < 0.1 * 0.01


def test_gradients_pass_where_depth_is_that_of_a_match():
    depth = torch.full((6, 6), 5.0, requires_grad=True)
    confidence = torch.ones(6, 6)
    confidence[:, 2:4] = 0.1
    background_filled(frame_of(depth, confidence), fields_along([4.0, 0.0])).sum().backward()
    assert torch.equal(depth.grad, (confidence == 1).to(depth))


def wrong_in_the_middle():
    """A frame that is not confident there."""
    depth = torch.full((6, 6), 5.0)
    depth[:, 2:4] = 1.0
    return frame_of(depth, torch.where(depth < 2, 0.1, 1.0))


@pytest.mark.parametrize("other", [[-4.0, 0.0], [0.0, 4.0]])
def test_depth_stays_where_betas_are_on_several_sides(other):
    frame = wrong_in_the_middle()
    assert torch.equal(background_filled(frame, fields_along([4.0, 0.0], other)), frame.depth)
    beside = background_filled(frame, fields_along([4.0, 0.0], [3.0, 0.5]))
    torch.testing.assert_close(beside, torch.full((6, 6), 5.0))


@pytest.mark.parametrize("half_width", [0.0, torch.nan])
def test_depth_stays_where_its_interval_is_not_known(half_width):
    frame = wrong_in_the_middle()
    frame = frame._replace(half_width=torch.full_like(frame.depth, half_width))
    assert torch.equal(background_filled(frame, fields_along([4.0, 0.0])), frame.depth)


def test_outliers_go_edges_stay_and_unknown_depth_stays_unknown():
    wanted = torch.full((20, 30), 5.0)
    wanted[:, 12:20] = 2.0
    depth = wanted.clone()
    depth[4, 5], depth[9, 15], depth[15, 25] = 1.0, 1e9, torch.nan
    wanted[15, 25] = torch.nan
    torch.testing.assert_close(without_outliers(depth), wanted, equal_nan=True)


def test_unknown_depth_around_it_leaves_a_pixel_as_it_is():
    depth = torch.full((9, 9), torch.nan)
    depth[4, 4] = 3.0
    torch.testing.assert_close(without_outliers(depth), depth, equal_nan=True)


def test_gradients_of_a_median_are_those_of_the_pixel():
    depth = torch.rand(8, 9) + 1
    depth[2, 3] = torch.inf
    depth.requires_grad_()
    found = without_outliers(depth)
    (1 / found).sum().backward()
    torch.testing.assert_close(depth.grad, -1 / depth.detach().square())
