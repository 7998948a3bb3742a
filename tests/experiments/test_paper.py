"""The paper's protocols, fields and controls, and the commands that measure tables."""

from dataclasses import replace

import pytest
import torch
from torch.nn.functional import interpolate, pad

from arraygeom import pixel_grid
from experiments.evaluation.paper import AuthorsRows, controls, falls, halved
from pat.lab.data import StereoPair, middlebury_pairs
from pat.lab.data.pairs import Disparity
from pat.lab.evaluation.protocols import rectified_fusion, rectified_rig
from pat.lab.evaluation.stereo import StereoRow, evaluate_pairs
from pat.networks.weights import load_weights
from tests.pat.lab.evaluation.test_stereo import Matcher, pairs


def test_authors_rows_are_those_of_their_loader():
    """`arange(j - 80, j)` from column 80 on, columns 0 to 79 before: zero disparity is never among them."""
    hw = (4, 200)
    pair = rectified_rig(hw, {"beta": hw}, 80.0).pair("alpha", "beta")
    x = torch.tensor([[90.0, 2.0], [80.0, 0.0], [13.0, 3.0]])
    found = AuthorsRows()(pair, x)
    for (j, i), columns, rows in zip(x.tolist(), found.xy[..., 0], found.xy[..., 1]):
        wanted = torch.arange(j - 80, j) if j >= 80 else torch.arange(80.0)
        torch.testing.assert_close(columns, wanted)
        assert (rows == i).all()
    assert found.mask.all()
    with pytest.raises(ValueError, match="resize"):
        AuthorsRows()(rectified_rig(hw, {"beta": (2, 100)}, 80.0).pair("alpha", "beta"), x)


def test_halved_pairs_keep_the_point_at_its_disparity():
    """A smooth picture shifted by 6: at half the size by 3, with the same truth."""
    g = torch.Generator().manual_seed(0)
    wide = interpolate(torch.rand(1, 3, 6, 12, generator=g), size=(40, 86), mode="bicubic")[0]
    wide = wide.clamp(0, 1)
    truth = Disparity(torch.full((41, 81), 6.0), torch.ones(41, 81, dtype=torch.bool))
    whole = StereoPair("made", *(pad(v, (0, 1, 0, 1)) for v in (wide[..., :80], wide[..., 6:])))
    small = halved(replace(whole, disparity=truth))
    assert small.left.shape == small.right.shape == (3, 20, 40)
    assert small.disparity.value.shape == (20, 40)
    assert (small.disparity.value == 3).all()
    torch.testing.assert_close(small.left[..., 5:35], small.right[..., 2:32], atol=0.02, rtol=0)


def test_controls_take_the_reference_away():
    (pair,) = pairs(1)
    network = Matcher(3.0)
    evaluate_pairs([pair], {"fusion": rectified_fusion(network), **controls(network)}, [2], max_disparity=9)
    right, none, foreign, shuffled = (mean for ((_, mean),) in network.betas)
    assert none == 0
    assert abs(foreign - right) > 0.02
    assert shuffled == right
    x = pixel_grid((16, 24)).reshape(-1, 2)
    looked = network.field.at(x)
    assert sorted(looked.end.round().tolist()) == sorted(x.tolist())
    assert (looked.end - x).norm(dim=-1).mean() > 5


def test_falls_are_means_and_extremes():
    rows = [
        StereoRow(p, 2, m, v, 0.9)
        for p, m, v in (("a", "fusion", 30), ("a", "no", 25), ("b", "fusion", 30), ("b", "no", 27))
    ]
    assert falls(rows, names=["no"]) == "- no: -4.00 dB against fusion, -5.00 to -3.00\n"


def without_reference(pairs):
    """Return the cost of each control, by the weights of the package, at the least of some pairs; dB."""
    network = load_weights("mono-colour")
    rows = evaluate_pairs(
        pairs, {"fusion": rectified_fusion(network), **controls(network)}, [2], max_disparity=80
    )
    psnr = {(row.pair, row.method): row.psnr for row in rows}
    return {
        name: min(psnr[p.name, "fusion"] - psnr[p.name, name] for p in pairs) for name in controls(network)
    }


def test_controls_fall_on_a_real_pair(shared_data):
    pair = next(p for p in middlebury_pairs(shared_data / "middlebury") if p.name.endswith("Flowerpots"))
    crop = replace(
        pair, left=pair.left[:, 80:240, 100:340], right=pair.right[:, 80:240, 100:340], disparity=None
    )
    assert min(without_reference([crop]).values()) > 2


@pytest.mark.slow
def test_controls_fall_on_real_pairs(shared_data):
    wanted = ("Bowling1", "Midd1", "teddy", "Cloth1")
    pairs = [p for p in middlebury_pairs(shared_data / "middlebury") if p.name.endswith(wanted)]
    assert min(without_reference(pairs).values()) > 2
