"""BandwisePAT: the order of the bands and betas cannot matter, nor how many there are."""

import pytest
import torch

from arraygeom import Pair, Rectified, Rig, View
from arraygeom.fields.grid import FieldOnGrid
from pat import fuse
from pat.fusion.steps import co_located
from pat.matching.inputs import Inputs
from pat.networks.bandwise import BandwisePAT
from pat.networks.configs import BandwisePATConfig
from pat.networks.protocol import fused_at_once
from tests.arraygeom.rigs import parallel_rig
from tests.pat.matching.test_spectral_mix import texture

HW = (32, 48)


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return BandwisePAT(BandwisePATConfig(widths=(8, 8, 8, 8))).eval()


def field(disparity):
    return FieldOnGrid.of(Rectified(disparity), Pair(View(hw=HW), View(hw=HW)))


def test_permuting_betas_of_one_band_permutes_the_output_bands(network):
    alpha, bands = torch.rand(2, 1, *HW), list(torch.rand(4, 2, 1, *HW))
    fields, order = [field(d) for d in (6.0, 9.0, 12.0, 4.0)], [2, 0, 1, 3]
    with torch.no_grad():
        first, second = (
            fused_at_once(network, Inputs.of(alpha, [bands[i] for i in which], [fields[i] for i in which]))
            for which in (range(4), order)
        )
    assert first.image.shape == (2, 4, *HW)
    assert torch.equal(second.image, first.image[:, order])
    assert all(torch.equal(second.confidence[k], first.confidence[i]) for k, i in enumerate(order))
    assert (first.image[:, 0] - first.image[:, 1]).abs().max() > 1e-3


@pytest.mark.parametrize("count", [2, 3, 5])
def test_permuting_the_bands_of_a_beta_permutes_the_output_bands(network, count):
    hw, order = (64, 96), torch.randperm(count, generator=torch.Generator().manual_seed(count)).tolist()
    scene = torch.cat([texture(count, (64, 104), seed=i) for i in range(2)])
    alpha, beta = scene[:, :1, :, :-8] * 0.4 + scene[:, 1:2, :, :-8] * 0.6, scene[..., 8:]
    there = [FieldOnGrid.of(Rectified(16.0, alpha_is="left"), Pair(View(hw=hw), View(hw=hw)))]
    with torch.no_grad():
        first, second = (fused_at_once(network, Inputs.of(alpha, [b], there)) for b in (beta, beta[:, order]))
    assert torch.equal(second.image, first.image[:, order])
    assert torch.equal(second.position[0], first.position[0])
    assert len(first.confidence) == 1


def rig_of(names, places):
    """Alpha, and betas 10 cm times their place to the right of it."""
    betas = {name: (0.1 * place,) for name, place in zip(names, places)}
    return parallel_rig(100.0, (64, 96), {"alpha": (), **betas}, (1.0, 8.0))


def test_co_located_cameras_are_one_with_several_bands(network):
    bands, alpha = texture(3, (64, 96))[0], texture(3, (64, 96))[0, :1]
    images = {"alpha": alpha, **dict(zip("rgb", bands.split(1)))}
    apart = fuse(images, rig_of("rgb", [1, 1, 1]), alpha="alpha", network=network)
    whole = fuse({"alpha": alpha, "c": bands}, rig_of("c", [1]), alpha="alpha", network=network)
    assert torch.equal(apart.image, whole.image)
    assert torch.equal(apart.confidence, whole.confidence)


def test_bands_come_out_in_the_order_of_their_cameras(network):
    """The second camera is elsewhere, the first and the third at one place."""
    bands, alpha = texture(3, (64, 96))[0], texture(3, (64, 96))[0, :1]
    images = dict(zip("rgb", bands.split(1)))
    mixed = fuse({"alpha": alpha, **images}, rig_of("rgb", [1, 2, 1]), alpha="alpha", network=network)
    sorted_ = fuse({"alpha": alpha, **images}, rig_of("rbg", [1, 1, 2]), alpha="alpha", network=network)
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


def test_only_single_bands():
    with pytest.raises(ValueError, match="one band at a time"):
        BandwisePATConfig(bands=3)
