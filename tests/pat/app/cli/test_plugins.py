"""A camera, a field and a rig format of one's own, in commands."""

import sys
from types import SimpleNamespace

import pytest
import torch

from arraygeom import Epipolar, EpipolarLine, Rig
from arraygeom.fields import FIELDS, named_field
from arraygeom.io import READERS, WRITERS, RigFileError, recognise, write_rig
from arraygeom.lenses import CAMERA_MODELS, CameraModel
from arraygeom.runtime.extras import imported
from pat.media.images import write_image
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


@dataclass(frozen=True)
class Near:
    near: float = 1.0

    def __call__(self, pair, x):
        return Epipolar(self.near, 9.0)(pair, x)


READERS["mine"] = Reader
FIELDS["mine"] = Epipolar
'''


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """A folder with a plugin and a rig of its format; what it registers is forgotten afterwards."""
    (tmp_path / "tests_mine.py").write_text(MINE)
    (tmp_path / "array.mine").write_text("MINE left right\n")
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    for entries in (READERS, WRITERS, FIELDS, CAMERA_MODELS, sys.modules):
        for name in ("mine", "tests-half", "tests_mine"):
            entries.pop(name, None)


@pytest.mark.parametrize("option", ["--plugin tests_mine", "--plugin=tests_mine"])
def test_a_plugin_is_imported_before_the_command(mine, option, capsys):
    pat(f"rig convert {option} array.mine native.yaml")
    assert "mine" in FIELDS
    rig = Rig.load(mine / "native.yaml")
    assert rig.names == ("left", "right")
    assert rig["left"].distortion.model == "tests-half"


@pytest.mark.parametrize("workers", [1, 2])
def test_the_processes_of_a_batch_know_plugins_and_fields_of_ones_own(mine, capsys, workers):
    for name, bands in (("left", 1), ("right", 3)):
        for frame in "12":
            write_image(mine / name / f"{frame}.png", torch.rand(bands, 48, 64))
    field = "--field tests_mine:Near --depth 1 9"
    files = "--image left=left --image right=right"
    pat(f"batch --plugin tests_mine array.mine --alpha left {field} {files} --out out --workers {workers}")
    assert {path.name for path in (mine / "out").glob("*_fused.png")} == {"1_fused.png", "2_fused.png"}


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


@pytest.mark.parametrize("name", ["./labrig", "labrig.py"])
def test_a_path_in_place_of_a_module_is_told_its_name(name):
    with pytest.raises(ValueError, match=r"as labrig$"):
        imported(name, "plugin")


@pytest.mark.parametrize("text", ["def f(:", "raise RuntimeError('no licence')", "{}['key']"])
def test_a_module_that_fails_is_named(mine, text):
    (mine / "tests_mine.py").write_text(text)
    with pytest.raises(ValueError, match="plugin 'tests_mine'"):
        imported("tests_mine", "plugin")


@pytest.mark.parametrize(
    ("registry", "name", "entry"),
    [
        (READERS, "native", SimpleNamespace(read=print)),
        (READERS, "native", READERS["usual"]),
        (READERS, "mine", SimpleNamespace(recognises=print)),
        (WRITERS, "mine", SimpleNamespace()),
        (FIELDS, "epipolar", EpipolarLine),
        (FIELDS, "mine", 3),
    ],
)
def test_what_cannot_serve_or_takes_a_name_of_the_package_is_not_registered(registry, name, entry):
    before = dict(registry)
    with pytest.raises(ValueError, match=f"'{name}'"):
        registry[name] = entry
    assert registry == before


def test_the_name_of_a_lens_is_refused():
    with pytest.raises(ValueError, match="brown-conrady"):
        type("Lens", (CameraModel,), {}, name="brown-conrady")
    assert "brown-conrady" not in CAMERA_MODELS


@pytest.mark.parametrize("field", [Epipolar, Epipolar(), lambda pair, x: Epipolar()(pair, x)])
def test_a_field_is_registered_as_a_class_an_object_or_a_function(mine, field):
    FIELDS["mine"] = field
    assert callable(named_field("mine"))
    assert not isinstance(named_field("mine"), type)


def test_a_format_that_is_registered_is_asked_before_the_others(mine):
    (mine / "array.mine").write_text('{"cameras": {}}')
    READERS["mine"] = SimpleNamespace(HEAD="cameras", read=print)
    assert recognise(mine / "array.mine") == "mine"


@pytest.mark.parametrize(
    "reader",
    [
        {"read": lambda source: "text"},
        {"read": lambda source: {}["focal"]},
        {"read": lambda source: torch.eye(2) @ torch.eye(3)},
        {"recognises": lambda path, head: {}["focal"]},
        {"recognises": lambda path, head: True, "HEAD": None, "read": lambda: None},
    ],
)
def test_a_reader_that_fails_is_named_with_the_file(mine, reader):
    READERS["mine"] = SimpleNamespace(**{"HEAD": "MINE", "read": print, **reader})
    with pytest.raises(RigFileError, match=r"array\.mine.* mine "):
        Rig.load(mine / "array.mine")


def test_a_writer_gives_text_and_is_not_doubted(mine, recwarn):
    pat("rig convert --plugin tests_mine array.mine native.yaml")
    rig = Rig.load(mine / "native.yaml")
    WRITERS["mine"] = SimpleNamespace(write=lambda rig: "MINE")
    recwarn.clear()
    write_rig(rig, mine / "again.mine", format="mine")
    assert (mine / "again.mine").read_text() == "MINE"
    assert not recwarn
    WRITERS["mine"] = SimpleNamespace(write=lambda rig: 5)
    with pytest.raises(ValueError, match="mine"):
        write_rig(rig, mine / "again.mine", format="mine")
