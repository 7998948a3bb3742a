"""A camera, a field and a rig format of one's own, in commands."""

import sys

import pytest

from arraygeom import Rig
from arraygeom.fields import FIELDS
from arraygeom.io import READERS
from arraygeom.lenses import CAMERA_MODELS
from arraygeom.runtime.extras import imported
from tests.pat.commands import pat

MINE = '''
from dataclasses import dataclass

import torch

from arraygeom import Camera, Epipolar, Pose, intrinsics
from arraygeom.fields import FIELDS
from arraygeom.io import READERS
from arraygeom.lenses import CameraModel


@dataclass(frozen=True, eq=False, repr=False)
class Half(CameraModel, name="tests-half"):
    def project(self, X):
        ahead = X[..., 2] > 0
        return X[..., :2] / torch.where(ahead, 2 * X[..., 2], 1.0)[..., None], ahead

    def unproject(self, xy):
        return torch.cat([2 * xy, torch.ones_like(xy[..., :1])], -1), xy.isfinite().all(-1)


class Reader:
    """Source convention: none."""

    @staticmethod
    def recognises(path, head):
        return head.startswith("MINE")

    @staticmethod
    def read(source):
        hw = (48, 64)
        poses = (Pose.identity(), Pose(torch.eye(3).double(), torch.tensor([-0.1, 0.0, 0.0]).double()))
        return source.rig(
            (name, Camera(K=intrinsics(50.0, hw), cam_from_world=pose, hw=hw, distortion=Half()))
            for name, pose in zip(source.text().split()[1:], poses)
        )


READERS["mine"] = Reader
FIELDS["mine"] = Epipolar
'''


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """A folder with a plugin and a rig of its format; what it registers is forgotten afterwards."""
    (tmp_path / "tests_mine.py").write_text(MINE)
    (tmp_path / "array.mine").write_text("MINE left right\n")
    for registry in (READERS, FIELDS, CAMERA_MODELS):
        for name in ("mine", "tests-half"):
            monkeypatch.setitem(registry, name, None)
            monkeypatch.delitem(registry, name)
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    sys.modules.pop("tests_mine", None)


@pytest.mark.parametrize("option", ["--plugin tests_mine", "--plugin=tests_mine"])
def test_a_plugin_is_imported_before_the_command(mine, option, capsys):
    pat(f"rig convert {option} array.mine native.yaml")
    assert "mine" in FIELDS
    rig = Rig.load(mine / "native.yaml")
    assert rig.names == ("left", "right")
    assert rig["left"].distortion.model == "tests-half"


def test_without_it_the_format_is_unknown(mine, capsys):
    with pytest.raises(SystemExit):
        pat("rig convert array.mine native.yaml")
    assert "array.mine" in capsys.readouterr().err


def test_one_that_cannot_be_imported_is_named(mine, capsys):
    with pytest.raises(SystemExit) as stopped:
        pat("rig info --plugin tests_nowhere array.mine")
    assert stopped.value.code == 2
    assert "tests_nowhere" in capsys.readouterr().err


def test_an_installed_plugin_needs_no_option(mine, monkeypatch, capsys):
    info = mine / "tests_mine-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: tests-mine\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[arraygeom.plugins]\nmine = tests_mine\n")
    monkeypatch.syspath_prepend(mine)
    pat("rig convert array.mine native.yaml")
    assert Rig.load(mine / "native.yaml").names == ("left", "right")


@pytest.mark.parametrize("name", ["./own.py:Field", "nowhere:Field", "math:nothing"])
def test_what_cannot_be_imported_is_named(name):
    with pytest.raises(ValueError, match="field"):
        imported(name, "field")
