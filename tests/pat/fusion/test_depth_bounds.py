"""Depth stays within the bounds that were searched, wherever a network puts its positions."""

import pytest
import torch

from arraygeom import Camera, Epipolar, Pose, Rig, intrinsics
from arraygeom.fields.grid import FieldOnGrid
from pat.fusion.inputs import Placement, depth_and_confidence
from pat.networks.protocol import FusionOutput, Inputs

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
        depth, _ = depth_and_confidence(output, part, [Placement(p, lambda x: x)], hw, (box[2], box[0]))
        seen = found.valid[0]
        assert seen.any()
        assert depth[seen].isfinite().all()
        assert (depth[seen] > NEAR * 0.999).all()
        assert (depth[seen] < FAR * 1.001).all()
