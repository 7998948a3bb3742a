"""The notebooks run from a fresh kernel, claim something at their end, and say what is committed."""

import importlib.util
from pathlib import Path

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


def executed(path, tmp_path):
    kept = read(path)
    fresh = run().execute(read(path), tmp_path)
    assert kinds(fresh) == kinds(kept), "run `make notebooks`: what is committed is not what comes out"


def each(paths):
    return pytest.mark.parametrize("path", paths, ids=lambda p: p.stem)


@each([p for p in NOTEBOOKS if p.stem == QUICK])
def test_a_notebook_runs(path, tmp_path):
    executed(path, tmp_path)


@pytest.mark.slow
@each([p for p in NOTEBOOKS if p.stem != QUICK])
def test_the_other_notebooks_run(path, tmp_path):
    executed(path, tmp_path)


@each(NOTEBOOKS)
def test_notebooks_are_short_stories_with_a_claim(path):
    cells = read(path).cells
    code = [c for c in cells if c.cell_type == "code"]
    assert len(cells) <= 40
    assert max(len(c.source.splitlines()) for c in code) <= 25
    assert any(c.source.lstrip().startswith("assert") or "\nassert" in c.source for c in code[-1:])
    assert path.stat().st_size < 1_500_000


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
    scope = {}
    source = next(c for c in cells if "class AroundDepth" in c).replace("field = AroundDepth(depth)", "")
    imports = (
        "import torch\nfrom dataclasses import dataclass\nfrom arraygeom import ReceptiveField, sample\n"
    )
    imports += "from arraygeom.fields import pinhole_track\nfrom arraygeom.segments import clip_to_image\n"
    exec(imports + source.replace("isinstance(field, ReceptiveField)", ""), scope)
    rig = load_sample().rig
    step = rig.parameters(free=["colour.rotation"])
    x = torch.tensor([[40.0, 30.0], [40.0, 402.0], [645.0, 30.0]])
    found = scope["AroundDepth"](torch.full((400, 640), 3.0))(rig.perturbed(step).pair("mono", "colour"), x)
    (found.start.sum() + found.end.sum()).backward()
    assert step["colour.rotation"].grad.isfinite().all()
