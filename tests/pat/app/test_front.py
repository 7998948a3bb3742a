"""The front door: images first, files or tensors, with a rig or without; no wider than promised."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn.functional import avg_pool2d

import arraygeom
import calib
import pat
from pat import FuseSettings, align, fuse, load_weights
from pat.app.sample_array import load_sample
from pat.media.images import read_image, write_image
from tests.test_rooms import imports_of

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The sample array at a quarter of its size: images by name, and the rig's file."""
    folder, sample = tmp_path_factory.mktemp("array"), load_sample()
    rig = sample.rig.resize("mono", (100, 160)).resize("colour", (90, 140))
    rig.save(folder / "rig.yaml")
    for name, image in sample.images.items():
        write_image(folder / f"{name}.png", avg_pool2d(image, 4))
    return {name: folder / f"{name}.png" for name in rig.names}, folder / "rig.yaml"


def test_the_front_door_is_light():
    code = "import sys, pat; print({'torch', 'numpy', 'arraygeom', 'yaml'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout == "set()\n"


@pytest.mark.parametrize("package", [pat, calib, arraygeom, calib.boards, calib.images])
def test_a_package_shows_what_is_promised_and_nothing_else(package):
    assert dir(package) == sorted(package.__all__)
    assert all(getattr(package, name) is not None for name in package.__all__)


def test_files_and_a_rigs_file_are_what_they_hold(files):
    paths, rig_file = files
    images = {name: read_image(path) for name, path in paths.items()}
    rig, network = arraygeom.Rig.load(rig_file), load_weights("mono-colour")
    wanted = fuse(images, rig, alpha="mono", network=network)
    for given in (paths, list(paths.values())):
        found = fuse(given, rig_file, alpha="mono", network="mono-colour")
        assert torch.equal(found.image, wanted.image)
    said: list[str] = []
    found = fuse({**images, "colour": str(paths["colour"])}, rig, alpha="mono", explain=said.append)
    assert torch.equal(found.image, wanted.image)
    assert "network: mono-colour" in said


def test_alignment_takes_the_same(files):
    paths, rig_file = files
    one = align(paths, rig_file, alpha="mono", settings=FuseSettings(align=False))
    images = {name: read_image(path) for name, path in paths.items()}
    rig, network = arraygeom.Rig.load(rig_file), load_weights("mono-colour")
    other = align(images, rig, alpha="mono", network=network, settings=FuseSettings(align=False))
    assert np.array_equal(one.depth, other.depth, equal_nan=True)
    assert np.array_equal(one["colour"].values, other["colour"].values, equal_nan=True)


def test_the_old_order_says_how_it_is_written_now(files):
    rig, images, network = arraygeom.Rig.load(files[1]), {}, load_weights("mono-colour")
    for call in (
        lambda: fuse(network, rig, images, alpha="mono"),
        lambda: fuse(network, rig, images),
        lambda: fuse(network, rig=rig, alpha="mono"),
    ):
        with pytest.raises(TypeError, match=r"fuse\(images, rig, "):
            call()
    with pytest.raises(TypeError, match=r"align\(images, rig, "):
        align(rig, images, alpha="mono")


def test_what_is_no_array_is_refused(files):
    paths, rig_file = files
    with pytest.raises(ValueError, match="alpha"):
        fuse(paths, rig_file)
    with pytest.raises(TypeError, match="dict"):
        fuse(paths, {}, alpha="mono")
    with pytest.raises(TypeError, match="FuseSettings"):
        fuse(paths, rig_file, alpha="mono", settings={"noise": "estimate"})
    with pytest.raises(ValueError, match="'tele'"):
        fuse({**paths, "tele": paths["mono"]}, rig_file, alpha="mono")


def test_finding_a_rig_fuses_nothing():
    assert not imports_of(ROOT)["pat.app.from_images"] & {"pat.fusion.fuse", "pat.app.front"}
