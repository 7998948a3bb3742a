"""The paper's network as a function of the rig: gradients through fields and attention."""

from __future__ import annotations

from functools import cache

import pytest
import torch

from arraygeom import (
    Camera,
    Curved,
    Epipolar,
    EpipolarLine,
    HomographyDisplacement,
    Local,
    Pair,
    Pose,
    Widened,
    intrinsics,
    rotation_from_vector,
)
from arraygeom.distortion import Distortion
from arraygeom.fields.grid import FieldOnGrid
from pat import FuseSettings, fuse, load_weights
from pat.matching.inputs import Inputs
from pat.networks.configs import PATConfig
from pat.networks.paper import PAT
from tests.pat.fusion.recovering import rotated, rotation_left
from tests.pat.layered_array import middle_of_sample

HW = (7, 9)
FIELDS = {
    "epipolar": Epipolar(),
    "line": EpipolarLine(),
    "homography + displacement": HomographyDisplacement(2.5),
    "local": Local(3),
    "widened": Widened(Epipolar(), across=0.7),
    "curved": Curved(5, nodes=8),
}


@cache
def network() -> PAT:
    torch.manual_seed(5)
    made = PAT(PATConfig(dim=4, residual=True, interpolation="bilinear")).double()
    return made.requires_grad_(False)


def camera(w, t, K, k=None) -> Camera:
    lens = None if k is None else Distortion("brown-conrady", k)
    return Camera(K=K, cam_from_world=Pose(rotation_from_vector(w), t), hw=HW, distortion=lens)


def numbers(lens: bool) -> list[torch.Tensor]:
    """Rotation, translation, K and lens of beta."""
    given = [
        torch.tensor([0.02, -0.03, 0.05]),
        torch.tensor([-0.31, 0.07, 0.02]),
        intrinsics(10.3, HW),
        *([torch.tensor([-0.1, 0.03, 0.001, -0.002])] if lens else []),
    ]
    return [v.double().requires_grad_() for v in given]


@pytest.mark.parametrize("name", [*FIELDS])
def test_the_loss_is_differentiable_in_rotation_translation_K_and_lens(name):
    g = torch.Generator().manual_seed(2)
    alpha, beta, truth = (torch.rand(1, 3, *HW, generator=g, dtype=torch.float64) for _ in range(3))
    zero = torch.zeros(3, dtype=torch.float64)
    first = camera(zero, zero, intrinsics(9.0, HW).double())

    def loss(*given):
        pair = Pair(first, camera(*given), (torch.tensor(1.5).double(), torch.tensor(6.0).double()))
        field = FieldOnGrid.from_field(FIELDS[name], pair, blocks=False)
        fused = network()(Inputs.from_images(alpha, [beta], [field]))
        return (fused.image - truth).square().mean() + 1e-2 * fused.position[0].mean()

    given = numbers(lens=name == "curved")
    gradients = torch.autograd.grad(loss(*given), given)
    assert all(gradient.abs().max() > 1e-8 for gradient in gradients)
    assert torch.autograd.gradcheck(loss, given, eps=1e-7, atol=1e-6, rtol=1e-3, fast_mode=True)


def test_a_rotation_is_recovered_by_optimising_through_attention_alone():
    """The shipped weights: no matching but attention's, its only way to beta the field of the rig."""
    sample, window = middle_of_sample(), (slice(None), slice(48, 144), slice(64, 192))
    rig, images = sample.rig.crop("mono", 48, 64, (96, 128)), dict(sample.images)
    images["mono"] = images["mono"][window]
    supervised = load_weights("pat-supervised")
    assert not supervised.uses_matches

    def error_of(angle):
        turned = rotated(rig, angle)
        frame = fuse(
            images,
            turned,
            alpha="mono",
            network=supervised,
            settings=FuseSettings(align=False),
            differentiable=True,
        )
        return (frame.image - sample.ground_truth[window]).square().mean()

    assert abs(rotation_left(error_of)) < 0.02
