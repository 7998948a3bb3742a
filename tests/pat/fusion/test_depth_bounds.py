"""Depth stays within the bounds that were searched, wherever a network puts its positions."""

import pytest
import torch

from arraygeom import Camera, Epipolar, Pose, Rig, Segments, intrinsics
from arraygeom.fields.grid import FieldOnGrid
from pat.fusion.depth import background_filled, measured_depth
from pat.fusion.inputs import Placement
from pat.matching.inputs import Beta, Inputs
from pat.networks.protocol import FusionOutput

NEAR, FAR, HW = 1.4, 20.0, (12, 40)


def pair():
    K = intrinsics((300.0, 300.0), HW)
    cameras = {"a": Camera(K=K, hw=HW, cam_from_world=Pose.identity())}
    t = torch.tensor([-0.1, 0.02, 0.01], dtype=torch.float64)
    cameras["b"] = Camera(K=K, hw=HW, cam_from_world=Pose(torch.eye(3, dtype=torch.float64), t))
    return Rig(cameras, depth=(NEAR, FAR)).pair("a", "b")


@pytest.mark.parametrize("share", [-0.5, -1e-3, 0.0, 0.3, 1.0, 1.001, 1.2])
def test_positions_beyond_a_segment_are_its_ends(share):
    p = pair()
    field = FieldOnGrid.of(Epipolar(), p)
    whole = Inputs.of(torch.zeros(1, 1, *HW), [torch.zeros(1, 3, *HW)], [field])
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


def fields_along(*steps):
    return Inputs(torch.zeros(1, 1, 6, 6), tuple(beta_along(step) for step in steps))


def beta_along(step):
    end = torch.zeros(1, 6, 6, 2)
    segments = Segments(end + torch.tensor(step), end, torch.ones(1, 6, 6, dtype=torch.bool))
    return Beta(torch.zeros(1, 1, 6, 6), FieldOnGrid(lambda x: segments, 2, segments))


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
    torch.testing.assert_close(
        background_filled(depth, confidence, fields_along(step)), wanted, equal_nan=True
    )


@pytest.mark.parametrize("other", [[-4.0, 0.0], [0.0, 4.0]])
def test_depth_stays_where_betas_are_on_several_sides(other):
    depth = torch.full((6, 6), 5.0)
    depth[:, 2:4] = 1.0
    confidence = torch.where(depth < 2, 0.1, 1.0)
    assert torch.equal(background_filled(depth, confidence, fields_along([4.0, 0.0], other)), depth)
    beside = background_filled(depth, confidence, fields_along([4.0, 0.0], [3.0, 0.5]))
    assert torch.equal(beside, torch.full((6, 6), 5.0))
