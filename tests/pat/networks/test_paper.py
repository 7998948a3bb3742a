"""The paper's network: its parts, any number of betas of any sizes, and the rectified case written out."""

import pytest
import torch

from arraygeom import Pair, Rectified, Rig, View, sampling_locations
from arraygeom.fields.grid import FieldOnGrid
from pat import fuse, load_weights
from pat.attention import attend
from pat.matching.inputs import Inputs
from pat.networks.configs import PATConfig
from pat.networks.paper import PAT
from pat.support.metrics import score
from tests.pat.layered_array import middle_of_sample


def fields(network: PAT, alpha: torch.Tensor, betas: list[torch.Tensor]) -> list[FieldOnGrid]:
    hw = [tuple(p.shape[-2:]) for p in (alpha, *betas)]
    return [
        FieldOnGrid.from_field(Rectified(8, alpha_is="left"), Pair(View(hw=hw[0]), View(hw=b)))
        for b in hw[1:]
    ]


def test_the_rectified_field_is_parallax_attention():
    """Row by row: softmax over the whole row of beta (Wang et al. 2019, eq. 1)."""
    g = torch.Generator().manual_seed(0)
    query, key, value = (torch.randn(2, 6, 5, 9, generator=g, dtype=torch.float64) for _ in range(3))
    weights = torch.einsum("bdhw,bdhv->bhwv", query, key).softmax(-1)
    textbook = torch.einsum("bhwv,bdhv->bdhw", weights, value)
    field = sampling_locations(Rectified(), Pair(View(hw=(5, 9)), View(hw=(5, 9))))
    for interpolation in ("bilinear", "nearest"):
        for backend in ("cpu", "reference"):
            ours = attend(query, key, value, field, interpolation=interpolation, backend=backend)
            assert (ours - textbook).abs().max() < 1e-6


def test_the_default_is_the_papers():
    config = PATConfig()
    assert (config.dim, config.scale, config.residual, config.interpolation) == (64, 1, False, "nearest")
    network = PAT()
    layers = "Conv2d LeakyReLU ResidualBlock ResidualASPP ResidualBlock ResidualASPP ResidualBlock"
    assert [type(m).__name__ for m in network.features] == layers.split()
    assert sum(type(m).__name__ == "ResidualBlock" for m in network.post) == 4


@pytest.mark.parametrize("scale", [1, 2])
def test_any_number_of_betas_of_any_sizes(scale):
    torch.manual_seed(0)
    network = PAT(PATConfig(betas=3, dim=8, scale=scale))
    alpha = torch.rand(1, 1, 12, 20)
    betas = [torch.rand(1, 3, 12, 20), torch.rand(1, 1, 7, 11), torch.rand(1, 3, 24, 30)]
    fused = network(Inputs.from_images(alpha, betas, fields(network, alpha, betas)))
    assert fused.image.shape == (1, 3, 12 * scale, 20 * scale)
    assert [p.shape for p in fused.position] == [(1, 2, 12, 20)] * 3
    fused.image.sum().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in network.parameters())


def test_the_residual_path_keeps_alpha():
    """With the last convolution at zero the residual network returns alpha, and the paper's nothing."""
    alpha, betas = torch.rand(1, 1, 12, 20), [torch.rand(1, 3, 12, 20)]
    for residual, expected in ((True, alpha.expand(-1, 3, -1, -1)), (False, torch.zeros(1, 3, 12, 20))):
        network = PAT(PATConfig(dim=8, residual=residual))
        torch.nn.init.zeros_(network.post[-1].weight)
        assert torch.equal(
            network(Inputs.from_images(alpha, betas, fields(network, alpha, betas))).image, expected
        )


def test_wrong_numbers_are_refused():
    network = PAT(PATConfig(betas=2, dim=8))
    alpha, beta = torch.rand(1, 1, 12, 20), torch.rand(1, 3, 12, 20)
    with pytest.raises(ValueError, match=r"2 betas.* 1"):
        network(Inputs.from_images(alpha, [beta], fields(network, alpha, [beta])))
    with pytest.raises(ValueError, match="1 or 3 channels"):
        network(Inputs.from_images(alpha, [beta, beta[:, :2]], fields(network, alpha, [beta, beta])))


def test_samples_follow_the_longest_segment():
    rig = Rig({"a": View(hw=(10, 40)), "b": View(hw=(10, 40))})
    assert FieldOnGrid.from_field(Rectified(12.0), rig.pair("a", "b")).samples == 13


def test_four_inputs_a_band_each_give_the_colours():
    """The shipped weights: alpha, red, green and blue, in this order."""
    rig, images, truth = middle_of_sample()
    depth = tuple(float(d) for d in rig.pair("mono", "colour").depth_range)
    four = Rig({"mono": rig["mono"]} | dict.fromkeys("rgb", rig["colour"]), depth=depth)
    mono = images["mono"]

    def psnr(bands: str) -> float:
        taken = {"mono": mono} | dict(zip(bands, images["colour"].split(1)))
        return score(
            fuse(taken, four, alpha="mono", network=load_weights("pat-supervised-4")).image.clamp(0, 1), truth
        ).psnr

    assert psnr("rgb") > score(mono.expand(3, -1, -1), truth).psnr + 5
    assert psnr("bgr") < psnr("rgb") - 5
