"""The parameters that get no gradient are named before the work."""

import torch

from arraygeom import NearestVoxels, Rig
from pat import FuseSettings
from pat.fusion.gradients import without_gradient
from pat.networks.configs import PATConfig
from pat.networks.paper import PAT
from tests.arraygeom.rigs import two_cameras


def named(rig: Rig, network: PAT, **settings) -> dict[str, tuple[str, ...]]:
    g = torch.Generator().manual_seed(0)
    images = {n: torch.rand(1, *rig[n].hw, generator=g) for n in rig.names}
    alpha = rig.names[0]
    given = FuseSettings(align=False, response="rec601", **settings)
    return without_gradient(images, rig, alpha=alpha, network=network, settings=given)


def paper(**changes) -> PAT:
    torch.manual_seed(0)
    return PAT(PATConfig(betas=1, in_channels=1, out_channels=1, dim=8, **changes))


def test_what_moves_nothing_is_named():
    rig = two_cameras(centre=(0.3, 0.0, 0.0), depth=(1.0, 8.0))
    first, second = rig.names
    whole = named(rig, paper(interpolation="bilinear"))
    assert whole["image"] == ()
    every = tuple(rig.parameters(free=["*"]))
    assert named(rig, paper(interpolation="bilinear"), field=NearestVoxels(16, 8))["image"] == every
    at_whole_pixels = named(rig, paper(interpolation="nearest"))
    assert f"{second}.rotation" in at_whole_pixels["image"]
    assert first != second
