"""A network that holds a rig moves it, saves it and keeps its precision."""

import torch
from torch import nn

from pat.networks.rig_buffers import RigBuffers
from tests.arraygeom.rigs import random_rig


class Reprojecting(nn.Module):
    """The least network that uses a rig."""

    def __init__(self, seed: int) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.ones(()))
        self.geometry = RigBuffers(random_rig(seed))

    def forward(self, X: torch.Tensor) -> torch.Tensor:
        return self.scale * self.geometry()["beta"].project(X).x


def test_a_rig_moves_with_its_network():
    rig, network = random_rig(1), Reprojecting(1)
    assert network.geometry() == rig
    assert network.float().geometry() == rig.to(torch.float32)
    assert network.to("meta").geometry()["alpha"].K.device.type == "meta"


def test_half_precision_is_not_for_geometry():
    network = Reprojecting(1).half()
    assert network.scale.dtype == torch.float16
    assert network.geometry() == random_rig(1).to(torch.float32)


def test_a_rig_is_in_the_state():
    one, other = Reprojecting(1), Reprojecting(2)
    other.load_state_dict(one.state_dict())
    assert other.geometry() == random_rig(1)
    assert "geometry.cameras['alpha']/K" in one.state_dict()
