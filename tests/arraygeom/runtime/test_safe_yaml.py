"""Malicious YAML files, and files with repeated keys, are refused at once, with the line."""

import re
import time
from pathlib import Path

import pytest
import yaml

from arraygeom import Rig
from arraygeom.io import RigFileError
from arraygeom.runtime.safe_yaml import dump_yaml, load_yaml

ROOT = Path(__file__).parents[3]


def bomb(levels: int = 12) -> str:
    """A text of some 400 characters that stands for 9^levels values."""
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, levels)]
    return "\n".join(lines)


CAMERA = "{size: [64, 40], focal: 80}"
NATIVE = f"format: arraygeom-rig 1\ncameras: {{a: {CAMERA}}}\n"
KALIBR = "cam0:\n  camera_model: pinhole\n"
ROS = "camera_matrix:\n  data: 1\ndistortion_model: none\n"


@pytest.mark.parametrize("head", [NATIVE, KALIBR, ROS])
@pytest.mark.parametrize(
    "attack",
    [
        bomb(),
        "deep: " + "[" * 100_000,
        "deep: " + "{a: " * 100_000,
        "self: &a [*a]",
        "long: [" + "1," * 3_000_000,
    ],
)
def test_rig_files_that_would_grow_are_refused_at_once(head, attack, tmp_path):
    (tmp_path / "rig.yaml").write_text(head + attack)
    start = time.process_time()
    with pytest.raises(RigFileError, match=r"line \d+.*(aliases repeat|nest|more than 2,000,000|alias \*a)"):
        Rig.load(tmp_path / "rig.yaml")
    assert time.process_time() - start < 4


@pytest.mark.parametrize("attack", [bomb(), "[" * 100_000, "seed: 1\nsteps: 5\nseed: 2"])
def test_recipes_and_other_documents_too(attack, tmp_path):
    pytest.importorskip("rich", reason="pat needs more than arraygeom does")
    from pat.lab.training.config import parse_config
    from pat.support.schema import read_yaml

    (tmp_path / "a.yaml").write_text(attack)
    for read in (parse_config, lambda _: read_yaml(tmp_path / "a.yaml")):
        with pytest.raises(ValueError, match="YAML"):
            read(attack)


@pytest.mark.parametrize(
    ("text", "key", "lines"),
    [
        ("a: 1\nb: 2\na: 3\n", "a", (1, 3)),
        ("1: a\n'1': b\n", "1", (1, 2)),
        ("x:\n  1.0: a\n  1: b\n", "1", (2, 3)),
        ("- {a: 1, b: 2,\n   a: 3}\n", "a", (1, 2)),
    ],
)
def test_repeated_keys_are_refused_with_both_lines(text, key, lines):
    with pytest.raises(yaml.YAMLError, match=f"'{key}'.*{lines[0]}.*{lines[1]}"):
        load_yaml(text)


def test_what_people_write_is_read():
    text = "a: &x {b: 1, c: [1, 2]}\nd: {<<: *x, b: 2}\ne: [*x, *x]\n"
    assert load_yaml(text) == yaml.safe_load(text)
    for path in [*ROOT.glob("pat/lab/training/recipes/*.yaml"), *ROOT.glob("experiments/*/*.yaml")]:
        dotted = re.sub(r"(?<![\d.])(\d+)e-", r"\1.0e-", path.read_text())
        assert load_yaml(path.read_text()) == yaml.safe_load(dotted)


def test_numbers_with_an_exponent_are_numbers():
    """PyYAML takes 1e-05 for text, as other libraries write small numbers."""
    text = "[1e-05, -1e3, 1.2E7, +.5e2, 8.e-1, '1e3', 1e, e3, 0x1e3, 2.0]"
    assert load_yaml(text) == [1e-5, -1e3, 1.2e7, 50.0, 0.8, "1e3", "1e", "e3", 0x1E3, 2.0]


@pytest.mark.parametrize("value", ["2001-99-99", "!!int foo", "9" * 6000, "!!python/name:os.system ''"])
def test_values_that_cannot_be_read_are_yaml_errors(value):
    with pytest.raises(yaml.YAMLError):
        load_yaml(f"a: {value}")


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (
            f"depth: [1, 2]\ncameras: {{a: {CAMERA}}}\ndepth: [1, 20]\n",
            "'depth'",
        ),
        (
            f"cameras: {{a: {CAMERA}, b: {CAMERA}}}\nlinks:\n"
            + 2 * "  - {alpha: a, beta: b, F: [[0, 0, 0], [0, 0, 1], [0, -1, 0]]}\n",
            r"links\[1\].*'a'",
        ),
    ],
)
def test_native_files_say_nothing_twice(text, problem, tmp_path):
    (tmp_path / "rig.yaml").write_text(text)
    with pytest.raises(RigFileError, match=problem):
        Rig.load(tmp_path / "rig.yaml")


def test_there_is_one_loader_of_yaml():
    texts = {
        path: path.read_text()
        for room in ("arraygeom", "pat", "calib")
        for path in (ROOT / room).rglob("*.py")
    }
    users = [p.name for p, text in texts.items() if "safe_load(" in text or "yaml.load(" in text]
    assert users == ["safe_yaml.py"]


@pytest.mark.parametrize(
    "text", ["1e3", "12E5", "-4e-1", ".5e1", "1_000", "null", "yes", "12:30:45", "#", "a: b", ""]
)
def test_a_text_that_looks_like_something_else_stays_a_text(text):
    document = {text: [text, 1e3, 1e-7, True, None]}
    assert load_yaml(dump_yaml(document)) == document
