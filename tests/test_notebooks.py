"""The notebooks run from a fresh kernel, show what is committed, and what they say is true."""

import importlib.util
import re
from pathlib import Path
from textwrap import dedent

import pytest
import torch

from pat.app.sample_array import load_sample

nbformat = pytest.importorskip("nbformat")
ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
QUICK = "3_your_own_rig"
"""The one that runs in the normal tests: it needs no network."""


def read(path):
    return nbformat.read(path, as_version=4)


def run():
    spec = importlib.util.spec_from_file_location("notebooks_run", ROOT / "notebooks" / "run.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def kinds(notebook):
    """For each cell of code, the kinds of what it puts out."""
    return [
        sorted({o.output_type if o.output_type != "stream" else o.name for o in cell.outputs})
        for cell in notebook.cells
        if cell.cell_type == "code"
    ]


CLAIMS = {
    "1_ten_minutes": """
        assert score(frame.image.clamp(0, 1), ground_truth).psnr > 30
        assert score(seen.image.clamp(0, 1), real.ground_truth).psnr > 30
        """,
    "2_receptive_fields": """
        slopes = [length / (1 / near - 1 / 20) for near, length in zip(nears.tolist(), lengths)]
        assert max(slopes[2:]) < 1.15 * min(slopes[2:])  # proportional to the range of inverse depth
        assert 1 < off_the_line(0, 0.3) < 5
        """,
    "3_your_own_rig": """
        assert abs(length.item() - 48) < 0.1
        assert loss().sqrt() < 0.4
        """,
    "4_your_own_field": """
        from pat.support.metrics import score
        whole, short = (f(rig.pair("mono", "colour"), x) for f in (Epipolar(), around))
        assert short.length.mean() < 0.7 * whole.length.mean()
        found = [score(f.image.clamp(0, 1), real.ground_truth).psnr for f in (near, far)]
        assert found[0] > found[1] - 1
        """,
    "5_calibrated_against_rectified": """
        assert right["calibrated"].psnr > right["pretended"].psnr + 2
        assert abs(right["calibrated"].psnr - right["rectified"].psnr) < 1
        assert kept["calibrated"] > kept["rectified"]
        of_pair = [score(f.image.clamp(0, 1), real.ground_truth).psnr for f in (segments, rows)]
        assert abs(of_pair[0] - of_pair[1]) < 0.5
        """,
    "6_calibrate_and_refine": """
        assert calibration.rms < 0.2
        assert refined.accepted
        off_lines = epipolar_distance(refined.rig.pair(*names).fundamental, *points).abs().median()
        assert off_lines < 0.3
        from pat.support.metrics import score
        found = [score(f.image.clamp(0, 1), ground_truth).psnr for f in (before, after, true)]
        assert found[1] > found[2] - 0.2 > found[0] + 0.5
        """,
    "7_synthesise_and_train": """
        assert loss[-1] < loss[0] - 0.1
        assert found["after a minute"]["psnr"] > found["untrained"]["psnr"] + 0.2
        """,
    "8_four_arrays": """
        found = {name: psnr_column(result.table) for name, result in results.items()}
        assert all(of["fusion"] > of["alpha alone"] + 2 for of in found.values())
        assert all(of["fusion"] > of["classical"] for name, of in found.items() if name != "wide-narrow")
        """,
}
"""Lines that hold what a notebook says, run after its cells."""


def executed(path):
    kept = read(path)
    fresh = read(path)
    fresh.cells.append(nbformat.v4.new_code_cell(dedent(CLAIMS[path.stem])))
    fresh = run().execute(fresh, path.parent)
    fresh.cells.pop()
    assert kinds(fresh) == kinds(kept), "run `make notebooks`: what is committed is not what comes out"


def each(paths):
    return pytest.mark.parametrize("path", paths, ids=lambda p: p.stem)


@each([p for p in NOTEBOOKS if p.stem == QUICK])
def test_a_notebook_runs_and_its_claims_hold(path):
    executed(path)


@pytest.mark.slow
@each([p for p in NOTEBOOKS if p.stem != QUICK])
def test_the_other_notebooks_run_and_their_claims_hold(path):
    executed(path)


@each(NOTEBOOKS)
def test_cells_have_one_idea_each_and_nothing_that_is_for_tests(path):
    code = [c.source for c in read(path).cells if c.cell_type == "code"]
    imports = [re.findall(r"^(?:from|import) ", source, re.M) for source in code]
    assert sum(map(len, imports)) <= 8
    longest = max((s for s, i in zip(code, imports) if not i), key=lambda s: len(lines(s)))
    assert len(lines(longest)) <= 6, longest
    assert not [source for source in code if "assert" in source or source.startswith("%")]
    assert path.stat().st_size < 4_000_000


def lines(source):
    """Return the lines of code of a cell; a bracket that the formatter put alone on a line is none."""
    return [line for line in source.splitlines() if line.strip(" )]}")]


@each(NOTEBOOKS)
def test_pictures_are_drawings_or_sharp_and_show_no_rings(path):
    shown = [o.data for c in read(path).cells if c.cell_type == "code" for o in c.outputs if "data" in o]
    kinds = {kind for data in shown for kind in data if kind.startswith("image/")}
    assert kinds <= {"image/svg+xml", "image/png"}
    assert kinds


@each(NOTEBOOKS)
def test_outputs_are_kept_and_none_is_an_error(path):
    notebook = read(path)
    assert any("display_data" in k or "execute_result" in k for k in kinds(notebook))
    assert not any("error" in k or "stderr" in k for k in kinds(notebook))


@pytest.mark.slow
def test_the_explorer_is_shown_by_a_cell(tmp_path):
    pytest.importorskip("anywidget")
    imports = "from pat.app.sample_array import load_sample\nfrom pat.app.explore import explore\n"
    source = f"{imports}explore(*load_sample()[:2])"
    cells = [nbformat.v4.new_code_cell(source)]
    fresh = run().execute(nbformat.v4.new_notebook(cells=cells), tmp_path)
    shown = [kind for output in fresh.cells[0].outputs for kind in output.get("data", {})]
    assert "application/vnd.jupyter.widget-view+json" in shown
    assert not [o for o in fresh.cells[0].outputs if o.output_type == "error"]


def test_the_field_of_notebook_4_has_gradients_all_over():
    """Also beyond alpha's image, where fusion pads: no depth is 0 there."""
    cells = [c.source for c in read(ROOT / "notebooks" / "4_your_own_field.ipynb").cells]
    scope = {"depth": torch.full((400, 640), 3.0)}
    exec("from arraygeom import sample\nfrom arraygeom.fields import pinhole_track", scope)
    exec("from arraygeom.segments import clip_to_image", scope)
    exec(next(source for source in cells if "def around" in source), scope)
    rig = load_sample().rig
    step = rig.parameters(free=["colour.rotation"])
    x = torch.tensor([[40.0, 30.0], [40.0, 402.0], [645.0, 30.0]])
    found = scope["around"](rig.perturbed(step).pair("mono", "colour"), x)
    (found.start.sum() + found.end.sum()).backward()
    assert step["colour.rotation"].grad.isfinite().all()
