import csv
import math

import pytest
import torch

from pat.data import StereoPair
from pat.evaluate import (
    BASELINES,
    Row,
    evaluate_pairs,
    evaluate_sets,
    markdown,
    rectified_fusion,
    sets_markdown,
    structure_kept,
    summarise,
    write_csv,
    write_markdown,
)
from pat.images import read_image, write_image
from pat.metrics import score
from pat.model import Fused


def pairs(count=2):
    generator = torch.Generator().manual_seed(0)
    return [StereoPair(f"set/{k}", *torch.rand(2, 3, 16, 24, generator=generator)) for k in range(count)]


def test_rows_are_the_scores_of_what_the_method_returns():
    first, second = pairs()
    rows = evaluate_pairs([first, second], {"grey": lambda alpha, beta, d: alpha.expand(3, -1, -1) + 2}, [2])
    assert [(row.pair, row.rate, row.method) for row in rows] == [("set/0", 2, "grey"), ("set/1", 2, "grey")]
    white = torch.ones(3, 16, 24)
    assert rows[0][3:] == score(white, first.left)


def test_a_method_gets_the_protocols_inputs():
    def look(alpha, beta, max_disparity):
        seen.append((tuple(alpha.shape), tuple(beta.shape), max_disparity))
        return alpha.expand(3, -1, -1)

    seen = []
    evaluate_pairs(pairs(1), {"look": look}, [2, 4])
    assert seen == [((1, 16, 24), (3, 8, 12), 120), ((1, 16, 24), (3, 4, 6), 120)]


def test_baselines_run_and_pictures_lie_side_by_side(tmp_path):
    (pair,) = pairs(1)
    rows = evaluate_pairs([pair], BASELINES, [2], pictures=tmp_path)
    assert [row.method for row in rows] == ["alpha", "beta", "classical"]
    strip = read_image(tmp_path / "set-0_x2.png")
    assert strip.shape == (3, 16, 24 * 5)
    torch.testing.assert_close(strip[..., -24:], pair.left, atol=0.002, rtol=0)
    torch.testing.assert_close(strip[..., :24], strip[..., 48:72])


@pytest.mark.parametrize(
    ("result", "complaint"),
    [(torch.zeros(1, 16, 24), "wanted a picture"), (torch.full((3, 16, 24), math.nan), "NaN")],
)
def test_a_result_that_cannot_be_scored_names_method_and_pair(result, complaint):
    with pytest.raises(ValueError, match=f"ours on set/0: .*{complaint}"):
        evaluate_pairs(pairs(1), {"ours": lambda *_: result}, [2])


ROWS = [Row("a", 2, "ours", 30.0, 0.9), Row("a", 4, "ours", 28.0, 0.8), Row("b", 2, "ours", 34.0, 0.96)]


def test_summaries_are_means_by_rate_and_method():
    two, four = summarise(ROWS)
    assert (two.rate, two.method, two.pairs, two.psnr) == (2, "ours", 2, 32)
    assert two.ssim == pytest.approx(0.93)
    assert two.psnr_interval == (30, 34)
    assert (four.psnr, four.pairs) == (28, 1)


def test_tables_hold_every_row(tmp_path):
    write_csv(tmp_path / "t.csv", ROWS)
    with (tmp_path / "t.csv").open() as file:
        again = [
            Row(r["pair"], int(r["rate"]), r["method"], float(r["psnr"]), float(r["ssim"]))
            for r in csv.DictReader(file)
        ]
    assert again == ROWS
    write_markdown(tmp_path / "t.md", ROWS)
    assert (tmp_path / "t.md").read_text() == markdown(ROWS)
    assert markdown(ROWS).splitlines() == [
        "| beta reduced 2x | ours |",
        "| --- | ---: |",
        "| a | 30.00 / 0.9000 |",
        "| b | 34.00 / 0.9600 |",
        "| **mean** | **32.00** (30.00 to 34.00) / **0.9300** |",
        "",
        "| beta reduced 4x | ours |",
        "| --- | ---: |",
        "| a | 28.00 / 0.8000 |",
        "| **mean** | **28.00** / **0.8000** |",
    ]


class Onlooker:
    """A network that notes where it is told to look, and gives alpha back."""

    halo, beta_halo, multiple, bytes_per_pixel, equal_pitch = 0, 2, 1, 1.0, True

    def __call__(self, alpha, betas, looks):
        found = looks[0].at(torch.tensor([[20.0, 7.0]]))
        self.start, self.end = found.start[0].tolist(), found.end[0].tolist()
        self.beta = tuple(betas[0].shape)
        none = alpha[:, 0] * 0
        return Fused(alpha.expand(-1, 3, -1, -1), [torch.stack([none, none], 1)], [none], [none])


def test_fusion_looks_along_the_row_in_alphas_pixels():
    network, (pair,) = Onlooker(), pairs(1)
    rows = evaluate_pairs(
        [pair], {"fusion": rectified_fusion(network), "alpha": BASELINES["alpha"]}, [2], max_disparity=9
    )
    assert (network.start, network.end, network.beta) == ([11.0, 7.0], [20.0, 7.0], (1, 3, 16, 24))
    assert rows[0][3:] == rows[1][3:]


def test_sets_are_read_by_their_own_rules_and_shown_apart(tmp_path):
    (pair,) = pairs(1)
    for name in ("left", "right"):
        write_image(tmp_path / "k" / f"{name}.png", getattr(pair, name))
    rows = evaluate_sets({"kitti": tmp_path / "k", "folder": tmp_path / "k"}, BASELINES, [2], out=tmp_path / "out")
    assert list(rows) == ["kitti", "folder"]
    assert rows["kitti"] == rows["folder"]
    assert (tmp_path / "out" / "folder").is_dir()
    with pytest.raises(FileNotFoundError, match="nowhere"):
        evaluate_sets({"kitti": tmp_path / "k", "folder": tmp_path / "nowhere"}, {}, [2], out=tmp_path)
    assert sets_markdown({"a": ROWS}).startswith(f"#### a\n\n{markdown(ROWS)}\n")


def test_lost_structure_is_named():
    rows = [Row("p", 2, "alpha", 20, 0.9), Row("p", 2, "fusion", 30, 0.9), Row("q", 2, "alpha", 20, 0.9)]
    rows.append(Row("q", 2, "fusion", 30, 0.91))
    assert structure_kept(rows) == "SSIM of fusion is at least that of alpha in 2 of 2 cases."
    rows[1] = rows[1]._replace(ssim=0.8999)
    assert structure_kept(rows).endswith("1 of 2 cases; **below it**: p 2x.")


def test_beta_as_it_is_has_its_own_header():
    assert markdown([Row("a", 1, "ours", 30.0, 0.9)]).startswith("| beta as it is | ours |")
