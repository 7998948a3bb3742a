"""Files that crash the parsers underneath (OpenCV's, scipy's): refused before these see them."""

import contextlib
import json
import os
import random
import shutil
import struct
import time
import zlib
from pathlib import Path

import numpy as np
import pytest

from arraygeom import Rig
from arraygeom.io import RigFileError, read_rig
from arraygeom.io.matfile import readable_variables
from arraygeom.io.source import RigSource

FIXTURES = Path(__file__).parent / "fixtures"
DEEP = 100_000
YAML = "%YAML:1.0\n---\na: "
XML = '<?xml version="1.0"?>\n<opencv_storage>'


@pytest.mark.parametrize(
    "text",
    [
        XML + "<a>" * DEEP + "</a>" * DEEP + "</opencv_storage>",
        XML + "<a>" * DEEP,
        '{"a": ' + "[" * DEEP + "]" * DEEP + "}",
        '{"a":' * DEEP + "1" + "}" * DEEP,
        YAML + "[" * DEEP + "]" * DEEP,
        YAML + "{a: " * DEEP + "}" * DEEP,
        YAML + "\n  " + "- " * DEEP + "1",
        "%YAML:1.0\n---\n" + "a: " * DEEP + "1",
    ],
)
def test_deep_nesting_is_one_line(text, tmp_path):
    (tmp_path / "a.yml").write_text(text)
    with pytest.raises(RigFileError, match=r"nested|is not (XML|YAML)"):
        read_rig(tmp_path / "a.yml", format="opencv")


def test_deep_nesting_of_toml_is_refused(tmp_path):
    (tmp_path / "a.toml").write_text("a = " + "[" * DEEP + "]" * DEEP)
    with pytest.raises(RigFileError, match="TOML"):
        RigSource(tmp_path / "a.toml").document()


def test_a_matrix_that_claims_a_size_takes_no_memory(tmp_path):
    pytest.importorskip("cv2")
    text = (
        "%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n   rows: 20000\n   cols: 20000\n   dt: d\n   "
        "data: [1]\n"
    )
    (tmp_path / "a.yml").write_text(text)
    with pytest.raises(RigFileError, match="camera_matrix"):
        read_rig(tmp_path / "a.yml", format="opencv")


def matlab_pair() -> dict[str, object]:
    """Two cameras as MATLAB's stereo parameters, and their relation."""
    camera = {
        "IntrinsicMatrix": np.array([[800.0, 0, 0], [0, 800, 0], [320, 200, 1]]),
        "ImageSize": [400.0, 640.0],
        "RadialDistortion": np.array([0.1, 0.01]),
    }
    pair = {"CameraParameters1": camera, "CameraParameters2": camera, "WorldUnits": "mm"}
    return pair | {"RotationOfCamera2": np.eye(3), "TranslationOfCamera2": np.array([-100.0, 0, 0])}


@pytest.mark.parametrize("compressed", [False, True])
def test_damaged_mat_files_are_read_or_refused(compressed, tmp_path):
    """SciPy alone crashes the process on some of these, such as seed 50."""
    path = tmp_path / "pair.mat"
    others = {"empty": np.zeros((0, 3)), "cells": np.array([1, "b"], object), "z": np.array([1 + 2j])}
    variables = {"s": matlab_pair(), **others, "t": ["a", "bc"]}
    pytest.importorskip("scipy.io").savemat(path, variables, do_compression=compressed)
    whole = path.read_bytes()
    assert readable_variables(whole) == ["s", "empty", "cells", "z", "t"]
    assert Rig.load(path).names == ("camera1", "camera2")
    refused = 0
    for seed in range(200):
        source, content = random.Random(seed), bytearray(whole)
        for _ in range(source.choice([1, 1, 2, 4, 8])):
            content[source.randrange(128, len(content))] = source.choice(
                [0, 255, 127, 1, source.randrange(256)]
            )
        path.write_bytes(content[: source.choice([len(content), source.randrange(len(content))])])
        try:
            Rig.load(path)
        except RigFileError:
            refused += 1
    assert refused > 100


def test_an_empty_variable_of_a_mat_file_is_refused():
    packed = zlib.compress(b"")
    content = b"MATLAB 5.0".ljust(124) + b"\0\1IM" + struct.pack("<II", 15, len(packed)) + packed
    with pytest.raises(ValueError, match="matrix"):
        readable_variables(content)


def test_mat_files_of_other_versions_are_refused(tmp_path):
    pytest.importorskip("scipy.io").savemat(tmp_path / "a.mat", {"K": np.eye(3)}, format="4")
    with pytest.raises(RigFileError, match="version"):
        Rig.load(tmp_path / "a.mat")


FRAME = {"file_path": "a", "w": 640, "h": 480, "fl_x": 500.0, "transform_matrix": np.eye(4).tolist()}


def nerfstudio(folder: Path, frame: dict, **top: object) -> Path:
    (folder / "transforms.json").write_text(json.dumps({**top, "frames": [frame]}))
    return folder / "transforms.json"


def native(folder: Path, camera: str) -> Path:
    (folder / "rig.yaml").write_text(f"format: arraygeom-rig 1\ncameras:\n  a: {{{camera}}}\n")
    return folder / "rig.yaml"


@pytest.mark.parametrize("entry", ["w", "fl_x"])
def test_true_is_no_number_in_json(entry, tmp_path):
    assert read_rig(nerfstudio(tmp_path, FRAME)).names == ("a",)
    with pytest.raises(RigFileError, match="True"):
        read_rig(nerfstudio(tmp_path, FRAME | {entry: True}))


def test_half_a_character_is_refused(tmp_path):
    """A name with one cannot be printed."""
    with pytest.raises(RigFileError, match=r"character[^/]*$") as caught:
        read_rig(nerfstudio(tmp_path, FRAME | {"file_path": "a\ud800"}))
    str(caught.value).encode()
    assert read_rig(nerfstudio(tmp_path, FRAME | {"file_path": "\U0001f4f7"})).names == ("\U0001f4f7",)


def test_a_megabyte_of_repeated_entries_is_refused_at_once(tmp_path):
    """The time is linear in the number of names."""
    names = ", ".join(f'"{i:05d}": 1' for i in range(70_000))
    (tmp_path / "t.json").write_text(f'{{{names}, {names}, "frames": [{{"transform_matrix": 1}}]}}')
    begin = time.process_time()
    with pytest.raises(RigFileError, match="'00000'"):
        read_rig(tmp_path / "t.json", format="nerfstudio")
    assert time.process_time() - begin < 5


@pytest.mark.parametrize(
    "camera",
    [f"size: [640, 480], K: {[[1 / 3] * 3, [2 / 3] * 3, ['x'] * 3]}", f"size: {[1 / 3] * 3 + ['x'] * 900}"],
)
def test_a_message_shows_a_value_in_short(camera, tmp_path):
    with pytest.raises(RigFileError) as caught:
        Rig.load(native(tmp_path, camera))
    message = str(caught.value).replace(str(tmp_path), "")
    assert "0.3333, 0.3333" in message
    assert len(message) < 200


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no pipes in folders")
def test_a_pipe_is_no_rig(tmp_path):
    """Reading one waits for ever."""
    os.mkfifo(tmp_path / "rig.yaml")
    with pytest.raises(RigFileError, match="folder"):
        read_rig(tmp_path / "rig.yaml", format="native")


PARTS = [path for path in sorted(FIXTURES.rglob("*")) if path.is_file() and path.parent != FIXTURES]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no pipes in folders")
@pytest.mark.timeout(60)
@pytest.mark.parametrize("part", PARTS, ids=lambda path: f"{path.parent.name}/{path.name}")
def test_a_pipe_in_place_of_a_part_is_read_by_no_reader(part, tmp_path):
    """A pipe as `extrinsics.yml` is not opened; parts that a format can do without are not looked at."""
    if part.suffix == ".yml":
        pytest.importorskip("cv2")
    home = tmp_path / "rig"
    shutil.copytree(part.parent, home)
    (home / part.name).unlink()
    os.mkfifo(home / part.name)
    with contextlib.suppress(RigFileError, FileNotFoundError):
        read_rig(home)
