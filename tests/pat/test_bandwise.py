"""BandwisePAT: the order of the betas cannot matter, nor how many there are."""

import pytest
import torch

from arraygeom import Pair, Rectified, View
from pat import from_pretrained
from pat.bandwise import BandwisePAT, BandwisePATConfig
from pat.model import Look
from pat.weights import save_weights

HW = (32, 48)


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    made = BandwisePAT(BandwisePATConfig(widths=(8, 8, 8, 8)))
    torch.nn.init.normal_(made.single.head.last.weight, std=0.1)
    return made.eval()


def look(disparity):
    return Look.along(Rectified(disparity), Pair(View(hw=HW), View(hw=HW)))


def test_permuting_the_input_bands_permutes_the_output_bands(network):
    alpha, bands, looks = (
        torch.rand(2, 1, *HW),
        list(torch.rand(4, 2, 1, *HW)),
        [look(d) for d in (6.0, 9.0, 12.0, 4.0)],
    )
    order = [2, 0, 3, 1]
    with torch.no_grad():
        first = network(alpha, bands, looks)
        second = network(alpha, [bands[i] for i in order], [looks[i] for i in order])
    assert first.image.shape == (2, 4, *HW)
    assert torch.equal(second.image, first.image[:, order])
    assert all(torch.equal(second.confidence[k], first.confidence[i]) for k, i in enumerate(order))
    assert (first.image[:, 0] - first.image[:, 1]).abs().max() > 1e-3


def test_a_colour_camera_is_three_bands_in_one_place(network):
    alpha, colour = torch.rand(1, 1, *HW), torch.rand(1, 3, *HW)
    with torch.no_grad():
        together = network(alpha, [colour], [look(8.0)])
        apart = network(alpha, list(colour.split(1, 1)), [look(8.0)] * 3)
    assert torch.equal(together.image, apart.image)


def test_only_single_bands():
    with pytest.raises(ValueError, match="one band at a time"):
        BandwisePATConfig(bands=3)


def test_written_and_read_back(network, tmp_path):
    save_weights(network, tmp_path / "w.safetensors")
    again = from_pretrained(tmp_path / "w.safetensors")
    assert again.config == network.config
    assert all(torch.equal(v, network.state_dict()[k]) for k, v in again.state_dict().items())
