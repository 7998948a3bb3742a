import csv
import math

import pytest
import torch

from pat.data import StereoPair
from pat.evaluate import BASELINES, Row, evaluate_pairs, markdown, summarise, write_csv, write_markdown
from pat.images import read_image
from pat.metrics import score


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
