"""Every field in one table: cases say where points are, unfit fields are named, others are scored."""

from __future__ import annotations

import pytest
import torch

from arraygeom import Dense, Epipolar, EpipolarLine, Rectified, sample
from arraygeom.fields.grid import FieldOnGrid
from experiments.evaluation.fields import (
    FieldRow,
    evaluate_fields,
    fields_markdown,
    fields_of,
    layered_cases,
    rectified_cases,
    row_link,
)
from experiments.evaluation.sweeps import ALPHA, BETA, fused
from pat.attention.scores import peak_position
from pat.lab.data.pairs import Disparity, StereoPair
from pat.lab.evaluation.ablation import sample_photographs
from pat.matching.inputs import Inputs
from pat.networks.configs import PATConfig
from pat.networks.paper import PAT
from pat.networks.weights import save_weights

HW, SHIFT = (32, 48), 5


@pytest.fixture(scope="module")
def pair() -> StereoPair:
    """A smooth picture and itself shifted: the disparity is 5 everywhere, not known in the first rows."""
    g = torch.Generator().manual_seed(0)
    wide = torch.nn.functional.interpolate(
        torch.rand(1, 3, 8, 14, generator=g), size=(32, 53), mode="bicubic"
    )[0]
    wide = wide.clamp(0, 1)
    valid = torch.ones(HW, dtype=torch.bool)
    valid[:2] = False
    return StereoPair("made", wide[..., :48], wide[..., 5:], 12.0, Disparity(torch.full(HW, 5.0), valid))


def test_true_positions_of_a_pair(pair):
    case = next(rectified_cases([pair]))
    seen = sample(case.scene.images[BETA][None], case.scene.position[None].float()).values[0]
    off = (seen - case.scene.ground_truth).abs().amax(0)
    assert off[case.scene.visible][20:].median() < 0.03  # reduced and enlarged
    assert not case.scene.visible[:2].any()
    assert not case.scene.visible[:, : SHIFT - 1].any()
    assert case.scene.visible[2:, SHIFT:].all()


def test_pairs_without_truth_are_left_out(pair):
    assert list(rectified_cases([StereoPair("none", pair.left, pair.right)])) == []


def test_F_alone_gives_the_rows():
    x = torch.tensor([[20.0, 7.0], [3.0, 30.0]])
    found = EpipolarLine()(row_link(HW), x)
    torch.testing.assert_close(found.start[:, 1].float(), x[:, 1])
    torch.testing.assert_close(found.end[:, 1].float(), x[:, 1])
    assert (found.length >= HW[1] - 1).all()


def test_every_family_is_scored_or_named(network):
    case = next(layered_cases(sample_photographs(count=2), 1, hw=(32, 48)))
    rows = {row.field: row for row in evaluate_fields(network, [case])}
    assert [*rows] == [*fields_of(1.0)]
    assert all(row.note == "" and 0 <= row.peaks <= 1 for row in rows.values())
    text = fields_markdown([*rows.values(), FieldRow("unrectified", "x", "dense", note="left out")])
    assert "| unrectified (2) | PSNR |" in text
    assert f"| epipolar | {rows['epipolar'].psnr:.2f} |" in text


def test_what_cannot_serve_is_named(network, pair):
    case = next(rectified_cases([pair], linked=True))
    fields = {"epipolar": Epipolar(), "rectified": Rectified(12.0, alpha_is="left")}
    epipolar, rectified = evaluate_fields(network, [case], fields=lambda max_displacement: fields)
    assert epipolar.note
    assert "| epipolar | " in fields_markdown([epipolar, rectified])
    images = {ALPHA: torch.rand(1, 200, 200), BETA: torch.rand(3, 200, 200)}
    large = case._replace(scene=case.scene._replace(images=images))
    (row,) = evaluate_fields(network, [large], fields=lambda max_displacement: {"dense": Dense()})
    assert "left out" in row.note


def test_a_network_of_several_betas_gets_a_band_each(pair):
    torch.manual_seed(0)
    four = PAT(PATConfig(betas=3, in_channels=1, dim=8)).eval().requires_grad_(False)
    case = next(rectified_cases([pair]))
    alpha, beta = case.scene.images[ALPHA], case.scene.images[BETA]
    found = fused(four, case.pair, alpha, beta, Epipolar())
    on_grid = FieldOnGrid.from_field(Epipolar(), case.pair)
    wanted, compared = four.compare(
        Inputs.from_images(alpha[None], [band[None, None] for band in beta], [on_grid] * 3)
    )
    torch.testing.assert_close(found.image, wanted.image[0])
    assert found.peak.shape == (3, *HW, 2)
    for band, one in enumerate(compared):
        torch.testing.assert_close(found.peak[band].float(), peak_position(one)[0].movedim(0, -1))
    two = PAT(PATConfig(betas=2, in_channels=1, dim=8))
    rows = evaluate_fields(two, [case], fields=lambda max_displacement: {"epipolar": Epipolar()})
    assert rows[0].note == "this PAT is made for 2 betas, got 3"


def test_weights_for_two_bands_are_refused_at_once(tmp_path, refusal):
    save_weights(PAT(PATConfig(betas=2, in_channels=1, dim=8)), tmp_path / "two.safetensors")
    said = refusal("fields", "--network", str(tmp_path / "two.safetensors"), "--out", str(tmp_path))
    assert "2 betas" in said
