"""Files of strangers: no code of theirs runs, and their texts reach neither terminal nor page unescaped."""

import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from arraygeom import Rig, View
from pat.app.cli.options import say
from pat.app.report import Facts, filled_page

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
