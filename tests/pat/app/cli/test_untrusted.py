"""Files of strangers: no code of theirs runs, and their texts reach neither terminal nor page unescaped."""

import sqlite3
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from arraygeom import Rig, View
from pat.app.cli.options import say
from pat.app.report import Facts, filled_page
from pat.app.sample_array import SAMPLE

EVIL = "open('ran', 'w')\nfield = scene = None\n"


@pytest.mark.parametrize(
    ("entries", "command"),
    [
        ({"field": "evilmod:field"}, ["lab", "train", "recipe.yaml"]),
        (
            {"rig": "rig.yaml", "backend": "blender", "blender": {"generator": "evilmod:scene"}},
            ["lab", "render", "recipe.yaml", "--scenes", "1", "--out", "out"],
        ),
    ],
)
def test_a_recipe_alone_runs_no_code(entries, command, tmp_path, monkeypatch, refusal):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "evilmod.py").write_text(EVIL)
    (tmp_path / "recipe.yaml").write_text(yaml.safe_dump(entries))
    Rig({"a": View(hw=(4, 4))}).save(tmp_path / "rig.yaml")
    said = refusal(*command)
    assert "evilmod:" in said
    assert not (tmp_path / "ran").exists()


def fuse_with(*options: str) -> list[str]:
    images = [f"{name}={SAMPLE / name}.png" for name in ("mono", "colour")]
    named = [word for image in images for word in ("--image", image)]
    return ["fuse", str(SAMPLE / "rig.yaml"), "--alpha", "mono", *named, *options]


@pytest.mark.parametrize("text", ["0", "x", "nan", "1e400"])
def test_a_depth_map_with_a_scale_that_is_none_is_named(text, tmp_path, refusal):
    said = PngInfo()
    said.add_text("Description", f"depth: {text} counts a metre")
    depth = Image.fromarray(np.full((400, 640), 3000, np.uint16))
    depth.save(tmp_path / "d.png", pnginfo=said)
    assert "d.png" in refusal(*fuse_with("--around", f"{tmp_path}/d.png", "--out", f"{tmp_path}/out"))


def test_a_damaged_database_is_named(tmp_path, refusal):
    database = sqlite3.connect(tmp_path / "m.db")
    database.execute("create table images(image_id, name)")
    database.execute("create table two_view_geometries(pair_id, rows, data)")
    database.execute("create table matches(pair_id, rows, data)")
    database.execute("insert into images values (1, 'mono.png'), (2, 'colour.png')")
    database.execute("insert into two_view_geometries values (2147483649, 3, x'00')")
    database.commit()
    assert "m.db" in refusal(*fuse_with("--around", f"{tmp_path}/m.db", "--out", f"{tmp_path}/out"))


@pytest.mark.parametrize("entries", ["seed: 1e40", "seed: 99999999999999999999999", "network: {kind: [x]}"])
def test_a_recipe_that_is_none_is_named(entries, tmp_path, refusal):
    (tmp_path / "r.yaml").write_text(entries)
    assert "r.yaml" in refusal("lab", "train", tmp_path / "r.yaml")


@pytest.mark.parametrize(
    "option", ["--max-memory 1e400", "--max-memory 0", "--max-memory=-5", "--depth 1e400 inf"]
)
def test_numbers_without_end_are_named(option, tmp_path, refusal):
    said = refusal(*fuse_with(*option.split(), "--out", f"{tmp_path}/out"))
    assert option[2:5] in said


def test_texts_do_not_steer_a_terminal(capsys):
    say("a\x1b[31mred\nb\u202e[bold]" + 10_000 * "x" + "end")
    said = capsys.readouterr().err
    assert said.startswith(r"a\x1b[31mred\nb\u202e[bold]")
    assert said.endswith("xend\n")
    assert len(said) < 3000


@pytest.mark.parametrize("name", ["a\x1b[31m", "a\nb", "\u202e"])
def test_names_that_cannot_be_printed_are_no_cameras(name):
    with pytest.raises(ValueError, match="name"):
        Rig({name: View(hw=(4, 4))})


def test_names_are_no_parts_of_a_page():
    """A camera named `{{WARNINGS}}` is not replaced in turn."""
    names = ["{{WARNINGS}}", "<script>", "{{LAYERS}}"]
    page = filled_page(
        "{{NOTES}}", (1, 1), dict.fromkeys(names, "x"), {}, {"{{RATIO}}": "1"}, Facts(["note"]), RIG=""
    )
    assert "{{WARNINGS}}" in page
    assert page.count('class="layer"') == len(names)
    assert page.count("<li>note") == 1
    assert '<script>"' not in page


@pytest.mark.skipif(sys.platform != "linux", reason="/dev/full is Linux's")
@pytest.mark.parametrize("streams", [">&-", "2>&-", "<&- >&- 2>&-", "2>/dev/full"])
def test_work_is_done_where_nothing_can_be_said(streams, tmp_path):
    Rig({"a": View(hw=(4, 4))}).save(tmp_path / "rig.yaml")
    command = f"{sys.executable} -m pat rig convert {tmp_path}/rig.yaml {tmp_path}/new.yaml {streams}"
    assert subprocess.run(command, shell=True, cwd=Path(__file__).parents[4]).returncode == 0
    assert Rig.load(tmp_path / "new.yaml").names == ("a",)


@pytest.mark.skipif(sys.platform != "linux", reason="/dev/full is Linux's")
def test_a_full_disk_for_what_is_printed_is_one_line(tmp_path):
    Rig({"a": View(hw=(4, 4))}).save(tmp_path / "rig.yaml")
    command = f"{sys.executable} -m pat rig info {tmp_path}/rig.yaml > /dev/full"
    ended = subprocess.run(command, shell=True, cwd=Path(__file__).parents[4], capture_output=True, text=True)
    assert ended.returncode == 2
    assert ended.stderr.count("No space left") == 1
    assert "Traceback" not in ended.stderr
