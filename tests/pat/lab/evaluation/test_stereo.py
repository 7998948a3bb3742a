import csv
from dataclasses import replace

import pytest
import torch

from arraygeom import pixel_grid
from pat.lab.data import Disparity, StereoPair
from pat.lab.evaluation.protocols import BASELINES, StereoResult, rectified_fusion
from pat.lab.evaluation.stereo import (
    DATA_SETS,
    StereoRow,
    depth_markdown,
    evaluate_pairs,
    evaluate_sets,
    markdown,
    sets_markdown,
    structure_kept,
)
from pat.lab.evaluation.tables import write_csv
from pat.media.images import read_image, write_image
from pat.networks.protocol import FusionOutput
from pat.support.metrics import score


def pairs(count=2):
    generator = torch.Generator().manual_seed(0)
    return [StereoPair(f"set/{k}", *torch.rand(2, 3, 16, 24, generator=generator)) for k in range(count)]


def test_rows_are_the_scores_of_what_the_method_returns():
    first, second = pairs()
    rows = evaluate_pairs(
        [first, second], {"grey": lambda alpha, beta, d: StereoResult(alpha.expand(3, -1, -1) + 2)}, [2]
    )
    assert [(row.pair, row.rate, row.method) for row in rows] == [("set/0", 2, "grey"), ("set/1", 2, "grey")]
    white = torch.ones(3, 16, 24)
    assert rows[0][3:5] == score(white, first.left)
    assert rows[0][5:] == (None, None)


def test_a_method_gets_the_protocols_inputs():
    def noted(alpha, beta, max_disparity):
        seen.append((tuple(alpha.shape), tuple(beta.shape), max_disparity))
        return StereoResult(alpha.expand(3, -1, -1))

    seen = []
    evaluate_pairs(pairs(1), {"noted": noted}, [2, 4])
    assert seen == [((1, 16, 24), (3, 8, 12), 120), ((1, 16, 24), (3, 4, 6), 120)]


def test_baselines_run_and_images_lie_side_by_side(tmp_path):
    (pair,) = pairs(1)
    rows = evaluate_pairs([pair], BASELINES, [2], images=tmp_path)
    assert [row.method for row in rows] == ["alpha", "beta", "classical"]
    strip = read_image(tmp_path / "set-0_x2.png")
    assert strip.shape == (3, 16, 24 * 5)
    torch.testing.assert_close(strip[..., -24:], pair.left, atol=0.002, rtol=0)
    torch.testing.assert_close(strip[..., :24], strip[..., 48:72])


ROWS = [
    StereoRow("a", 2, "ours", 30.0, 0.9),
    StereoRow("a", 4, "ours", 28.0, 0.8),
    StereoRow("b", 2, "ours", 34.0, 0.96),
]


def depth_errors(cells):
    return [float(cells[name]) if cells[name] else None for name in ("end_point_error", "within_one")]


def test_tables_hold_every_row(tmp_path):
    write_csv(tmp_path / "t.csv", StereoRow._fields, ROWS)
    with (tmp_path / "t.csv").open() as file:
        again = [
            StereoRow(
                r["pair"], int(r["rate"]), r["method"], float(r["psnr"]), float(r["ssim"]), *depth_errors(r)
            )
            for r in csv.DictReader(file)
        ]
    assert again == ROWS
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


class Simple:
    """A network that needs no matches and no margins."""

    halo, beta_halo, multiple, equal_resolution, joins_bands = 0, 2, 1, True, "no"
    bands, uses_matches, learned, keeps_luminance = None, False, False, False

    def working_bytes(self, alpha, betas):
        return 0.0


class Matcher(Simple):
    """A network that finds each pixel `disparity` to the left; the mean of beta's bands is its confidence."""

    def __init__(self, disparity):
        self.disparity, self.betas = disparity, []

    def __call__(self, inputs, matches=None):
        alpha, betas = inputs.alpha, inputs.betas
        self.betas.append([(b.image.shape[1], float(b.image.mean())) for b in betas])
        self.field = betas[0].field
        grid = (
            pixel_grid(tuple(alpha.shape[-2:])).movedim(-1, 0)[None]
            - torch.tensor([self.disparity, 0.0])[:, None, None]
        )
        sure = torch.ones_like(alpha[:, 0])
        return FusionOutput(
            alpha.expand(-1, 3, -1, -1), [grid] * len(betas), [sure] * len(betas), [sure] * len(betas)
        )


def test_depth_is_compared_where_it_is_known():
    """Constant disparity of 5, truth 5 on the left half, 8 on the right, unknown in the first row."""
    (pair,) = pairs(1)
    value = torch.full((16, 24), 5.0)
    value[:, 12:] = 8
    valid = torch.ones(16, 24, dtype=torch.bool)
    valid[0] = False
    pair = replace(pair, disparity=Disparity(value, valid))
    (row,) = evaluate_pairs([pair], {"fusion": rectified_fusion(Matcher(5.0))}, [2], max_disparity=9)
    assert row.end_point_error == pytest.approx(1.5, abs=1e-4)
    assert row.within_one == pytest.approx(0.5)
    assert "| set/0 | 1.50 px / 50.0% |" in depth_markdown([row])
    assert depth_markdown(ROWS) == ""


def test_three_bands_are_three_cameras():
    network, (pair,) = Matcher(3.0), pairs(1)
    evaluate_pairs([pair], {"fusion": rectified_fusion(network, bands=True)}, [2], max_disparity=9)
    (given,) = network.betas
    assert [channels for channels, _ in given] == [1, 1, 1]
    assert [mean for _, mean in given] == pytest.approx(pair.right.mean((1, 2)).tolist(), abs=0.01)


class Onlooker(Simple):
    """A network that notes where it is told to look, and gives alpha back."""

    def __call__(self, inputs, matches=None):
        alpha, (beta,) = inputs.alpha, inputs.betas
        found = beta.field.at(torch.tensor([[20.0, 7.0]]))
        self.start, self.end = found.start[0].tolist(), found.end[0].tolist()
        self.beta = tuple(beta.image.shape)
        none = alpha[:, 0] * 0
        return FusionOutput(alpha.expand(-1, 3, -1, -1), [torch.stack([none, none], 1)], [none], [none])


def test_fusion_samples_along_the_row_in_alphas_pixels():
    network, (pair,) = Onlooker(), pairs(1)
    rows = evaluate_pairs(
        [pair], {"fusion": rectified_fusion(network), "alpha": BASELINES["alpha"]}, [2], max_disparity=9
    )
    assert (network.start, network.end, network.beta) == ([11.0, 7.0], [20.0, 7.0], (1, 3, 16, 24))
    assert rows[0][3:5] == rows[1][3:5]


def test_sets_are_read_by_their_own_rules_and_shown_apart(tmp_path):
    (pair,) = pairs(1)
    for name in ("left", "right"):
        write_image(tmp_path / "k" / f"{name}.png", getattr(pair, name))
    sets = {name: DATA_SETS[name](tmp_path / "k") for name in ("kitti", "folder")}
    rows = evaluate_sets(sets, BASELINES, [2], out=tmp_path / "out")
    assert list(rows) == ["kitti", "folder"]
    assert rows["kitti"] == rows["folder"]
    assert (tmp_path / "out" / "folder").is_dir()
    with pytest.raises(FileNotFoundError, match="nowhere"):
        DATA_SETS["folder"](tmp_path / "nowhere")
    assert sets_markdown({"a": ROWS}).startswith(f"#### a\n\n{markdown(ROWS)}\n")


def test_published_figures_stand_beside_the_mean():
    text = sets_markdown({"kitti": ROWS}, printed={"kitti": {2: (28.77, 0.8955)}})
    assert "| beta reduced 2x | ours | the paper, printed, on its own data |" in text
    assert "| **mean** | **32.00** (30.00 to 34.00) / **0.9300** | 28.77 / 0.8955 |" in text
    assert "printed" not in sets_markdown({"middlebury": ROWS}, printed={"kitti": {2: (28.77, 0.8955)}})


def test_lost_structure_is_named():
    rows = [
        StereoRow("p", 2, "alpha", 20, 0.9),
        StereoRow("p", 2, "fusion", 30, 0.9),
        StereoRow("q", 2, "alpha", 20, 0.9),
    ]
    rows.append(StereoRow("q", 2, "fusion", 30, 0.91))
    assert structure_kept(rows) == "SSIM of fusion is at least that of alpha in 2 of 2 cases."
    rows[1] = rows[1]._replace(ssim=0.8999)
    assert structure_kept(rows).endswith("1 of 2 cases; **below it**: p 2x.")


def test_beta_as_it_is_has_its_own_header():
    assert markdown([StereoRow("a", 1, "ours", 30.0, 0.9)]).startswith("| beta as it is | ours |")
