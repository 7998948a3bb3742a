"""The documentation's samples run, its links lead somewhere, and the site builds without a warning."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from pkgutil import resolve_name

import pytest
import torch

from arraygeom import Camera, Pose, Rig, intrinsics
from arraygeom.io import opencv, write_rig
from docs import formats
from docs.hooks import help_of, on_page_markdown
from docs.update_readme import QUOTE, quoting
from experiments.__main__ import Experiments
from pat.app.cli.main import command_paths
from pat.media.images import write_image

ROOT = Path(__file__).parents[1]
GUIDES = sorted((ROOT / "docs").glob("*.md"))
PAGES = sorted((ROOT / "docs").rglob("*.md"))
REPORTS = sorted((ROOT / "docs" / "reports").glob("*.md"))
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


ELSEWHERE = {"dask_jobqueue"}
"""Packages of which a page tells but that no extra of ours installs: their samples are not run."""


def words_of(path: Path) -> str:
    """The text of a page; of a notebook, its cells of words."""
    if path.suffix != ".ipynb":
        return path.read_text()
    cells = json.loads(path.read_text())["cells"]
    return "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")


def blocks(path: Path, language: str) -> list[str]:
    """Blocks of code, also those indented in lists."""
    found = re.findall(rf"^( *)```{language}\n(.*?)^\1```$", words_of(path), re.M | re.S)
    return [re.sub(rf"^{indent}", "", text, flags=re.M) for indent, text in found]


def those_with(language: str):
    pages = [p for p in PAGES if blocks(p, language)]
    return pytest.mark.parametrize("page", pages, ids=lambda p: p.stem)


def test_the_table_of_formats_is_what_the_readers_state():
    rows = formats.table().splitlines()
    assert {len(re.findall(r"(?<!\\)\|", row)) for row in rows} == {7}
    assert "\n".join(rows) in formats.PAGE.read_text(), "`make formats` prints it anew"


@those_with("yaml")
def test_rig_files_in_the_pages_are_read(page, tmp_path):
    for text in blocks(page, "yaml"):
        (tmp_path / "rig.yaml").write_text(text)
        assert Rig.load(tmp_path / "rig.yaml").names


def write_an_array(folder: Path) -> None:
    """Pairs in OpenCV's files, and a COLMAP model of images."""
    camera = Camera(K=intrinsics(500.0, (480, 640)), cam_from_world=Pose.identity(), hw=(480, 640))
    beta = camera.replace(cam_from_world=Pose(camera.R, camera.t + 0.1))
    intrinsic, extrinsic = opencv.write(Rig({"left": camera, "right": beta})).values()
    for name in ("red", "nir"):
        (folder / f"green_{name}.yml").write_text(intrinsic + extrinsic.split("---\n")[1])
    cameras = {"green": camera, "red": beta, "nir": beta}
    model = Rig({f"{name}/0001.tif": camera for name, camera in cameras.items()})
    write_rig(model, folder / "sparse" / "0", format="colmap")


@those_with("python")
def test_samples_in_the_pages_run(page, tmp_path, monkeypatch):
    if page.stem == "exploring":
        pytest.importorskip("anywidget")
    (tmp_path / "rig.yaml").write_text(blocks(ROOT / "docs" / "index.md", "yaml")[0])
    for name, channels in (("a", 1), ("b", 3)):
        write_image(tmp_path / f"{name}.png", torch.rand(channels, 400, 640))
    if page.stem == "rigs":
        write_an_array(tmp_path)
    monkeypatch.chdir(tmp_path)
    scope: dict = {}
    for text in blocks(page, "python"):
        if not any(f"from {name} " in text for name in ELSEWHERE):
            exec(text, scope)


@pytest.mark.parametrize("page", [*PAGES, *ROOT.glob("*.md")], ids=lambda p: p.stem)
def test_links_lead_somewhere(page):
    links = re.findall(r"\]\(([^)]+)\)", page.read_text())
    local = [link.partition(" ")[0].partition("#")[0] for link in links if "://" not in link]
    assert [link for link in local if link and not (page.parent / link).exists()] == []


def test_pages_are_filled_in_on_the_site_and_are_links_on_a_code_host():
    page = (ROOT / "docs" / "rigs.md").read_text() + (ROOT / "docs" / "api" / "conventions.md").read_text()
    assert "{{" not in page
    filled = on_page_markdown(page)
    assert "| `colmap` |" in filled
    assert (ROOT / "arraygeom" / "conventions.md").read_text().splitlines()[-1] in filled
    assert on_page_markdown('[1](../../notebooks/1_ten_minutes.ipynb "included")').count("```python") > 2


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda p: p.stem)
def test_a_notebook_is_a_page_and_is_found_from_the_readme(notebook):
    links = [link for link in re.findall(r"\]\(([^)]+)\)", words_of(notebook)) if "://" not in link]
    assert [link for link in links if not (notebook.parent / link).exists()] == []
    page = ROOT / "docs" / "notebooks" / f"{notebook.stem}.md"
    assert page.read_text() == f'[{notebook.stem}](../../notebooks/{notebook.name} "included")\n'
    assert f"]({page.name})" in (page.parent / "index.md").read_text()
    assert f"](notebooks/{notebook.name})" in (ROOT / "README.md").read_text()


def test_commands_in_the_pages_exist():
    """Every `pat ...` that a page shows parses: its --help is printed."""
    known = {" ".join(path) for path in command_paths()}
    shown = {
        re.match(r"pat ((?:rig |lab data |lab weights |lab )?[a-z-]+)", line)[1]
        for page in [*PAGES, ROOT / "README.md", *NOTEBOOKS]
        for text in [*blocks(page, "text"), *blocks(page, "")]
        for line in text.splitlines()
        if re.match(r"pat (?!help)[a-z]", line)
    }
    assert shown
    assert shown <= known


OF_ALL = {"--help", "--version", "--plugin"}
"""Options of every command, which `pat --help` states."""


def test_options_in_the_pages_exist():
    """Every option that a page shows with a `pat` command is in its --help; not a recipe's parts."""
    unknown = []
    for page in [*PAGES, ROOT / "README.md", *NOTEBOOKS]:
        shown = [*blocks(page, "text"), *blocks(page, ""), *re.findall(r"`(pat [^`]+)`", words_of(page))]
        for line in re.split(r"\n(?! )", "\n".join(text.replace("\\\n", " ") for text in shown)):
            words = line.split(" #")[0].split()
            paths = [p for p in command_paths() if words[:1] == ["pat"] and tuple(words[1 : 1 + len(p)]) == p]
            if paths:
                known = set(re.findall(r"--[a-z][\w-]*|-\w\b", help_of(max(paths, key=len))))
                options = {word.partition("=")[0] for word in words if re.match("--?[a-z][^.]*$", word)}
                unknown += [(page.name, line, name) for name in options - known - OF_ALL]
    assert unknown == []


def test_commands_of_the_experiments_in_the_pages_exist():
    known = {path[0] for path in command_paths(Experiments)}
    texts = [page.read_text() for page in [*PAGES, ROOT / "README.md", ROOT / "Makefile"]]
    shown = {name for text in texts for name in re.findall(r"python\s-m\sexperiments\s([a-z-]+)", text)}
    assert len(shown) > 6
    assert shown <= known


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path):
    pytest.importorskip("material")
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
    )
    assert built.stderr.count("WARNING") == 0
    assert built.returncode == 0, built.stderr
    assert "Epipolar" in (tmp_path / "api" / "arraygeom.html").read_text()
    assert "--alpha" in (tmp_path / "api" / "commands.html").read_text()
    story = (tmp_path / "notebooks" / "1_ten_minutes.html").read_text()
    assert 'src="data:image/png;base64,' in story
    assert 'src="data:image/svg+xml;base64,' in story
    assert 'href="2_receptive_fields.html"' in story


@pytest.mark.parametrize("page", [*PAGES, ROOT / "README.md"], ids=lambda p: p.stem)
def test_names_of_the_packages_in_the_pages_are_there(page):
    for name in re.findall(r"`((?:arraygeom|calib|pat)(?:\.\w+)+)", page.read_text()):
        assert resolve_name(name) is not None


FIGURE = re.compile(
    r"(?<![\w./-])[.\d][\d.,]*\s*(%|dB|ms|s|seconds?|minutes?|hours?|[kMG]i?B|GiB|px|fps|points?|pixels?)(?![\w-])"
)
"""A number with a unit of what is measured. Metres, degrees and millimetres are of cameras and scenes."""
BLOCK = re.compile(r"<!-- ([\w-]+):begin -->.*?<!-- \1:end -->", re.S)


def prose(text: str) -> str:
    """A page without blocks that commands fill, code, links' targets and comments."""
    for kind in (BLOCK, QUOTE, re.compile(r"^( *)```.*?^\1```", re.M | re.S)):
        text = kind.sub("", text)
    return re.sub(r"`[^`]*`|\]\([^)]*\)|<!--.*?-->", "", text, flags=re.S)


@pytest.mark.parametrize("page", [*PAGES, ROOT / "README.md"], ids=lambda p: p.stem)
def test_figures_with_units_stand_in_blocks_that_commands_fill(page):
    assert [found[0] for found in FIGURE.finditer(prose(page.read_text()))] == []


@pytest.mark.parametrize("page", GUIDES, ids=lambda p: p.stem)
def test_rows_that_a_page_quotes_are_the_report_s(page):
    assert quoting(page) == page.read_text()


def test_results_are_short_and_each_table_is_followed_by_what_it_says():
    text = (ROOT / "docs" / "results.md").read_text()
    assert len(text.splitlines()) <= 80
    assert len(re.findall(r"<!-- end -->\nSo: ", text)) == text.count("<!-- end -->") > 5


def test_pages_for_users_are_at_most_twelve_and_reports_stay_out_of_the_navigation():
    assert len(GUIDES) <= 12
    assert (
        "reports/" not in (ROOT / "mkdocs.yml").read_text().partition("nav:")[2].partition("not_in_nav:")[0]
    )


@pytest.mark.parametrize("report", REPORTS, ids=lambda p: p.stem)
def test_a_report_names_its_commands_and_dates_its_blocks(report):
    text = report.read_text()
    assert re.search(r"`(make|python -m) ", text)
    assert all(
        re.match(r"\s*\*Printed on \d{4}-\d\d-\d\d", found[0].split("-->", 1)[1])
        for found in BLOCK.finditer(text)
    )
    if report.stem != "index":
        assert f"]({report.name})" in (report.parent / "index.md").read_text()
