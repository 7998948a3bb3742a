"""Old names of modules work, name the new ones in a warning, and the front door imports nothing before its time."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import arraygeom
import calib
import calib.boards
from arraygeom.moved import OldModule
from pat.support.moved import MOVED, RENAMED

ROOT = Path(__file__).parents[3]

TYPED = """
from pat.fuse import FusedFrame, default_field, fuse
from pat.weights import load_weights, save_weights
from pat.images import from_luma_chroma, luminance, read_image, to_luma_chroma, write_image
from pat.model import PAT, FusionNetwork, PATConfig
from pat.guided import GuidedPAT
from pat.sequence import PictureFiles, fuse_sequence
from pat.batch import Batch, find_pictures
from pat.evaluate import evaluate_pairs
from pat.train import TrainConfig, load_config, train
from pat.cli import main
from pat.metrics import score
from pat.classical import classical
from pat.results import save_frame
from pat.demo import load_sample, report_figure
from pat.develop import read_views, ViewFiles
from calib.boards import Charuco, draw_board, parse_board
from calib.calibrate import calibrate
from calib.detect import detect
from calib.doctor import diagnose
from calib.refine import refine
from calib.start import start
from arraygeom.io.whole import write_text
from arraygeom import retaken
"""
"""What users have written."""


def new_name(name: str):
    module, _, attribute = name.rpartition(".")
    return getattr(importlib.import_module(module), attribute)


@pytest.mark.parametrize("line", TYPED.strip().splitlines())
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_what_users_have_written_still_runs(line):
    scope: dict = {}
    exec(line, scope)
    (statement,) = ast.parse(line).body
    assert all(callable(scope[alias.name]) for alias in statement.names)


@pytest.mark.parametrize("old", [*MOVED, *calib._MOVED])
def test_every_old_module_leads_to_the_new_one_and_warns(old):
    new = importlib.import_module((MOVED | calib._MOVED)[old])
    sys.modules.pop(old, None)
    with pytest.warns(DeprecationWarning, match=rf"^{old} is now {new.__name__}$") as caught:
        module = importlib.import_module(old)
    assert isinstance(module, OldModule)
    assert not caught[0].filename.startswith("<frozen")
    name = next(name for name in vars(new) if not name.startswith("_"))
    assert getattr(module, name) is getattr(new, name)
    with pytest.raises(AttributeError):
        module.no_such_name  # noqa: B018


@pytest.mark.parametrize("old", RENAMED)
def test_every_renamed_function_leads_to_the_new_one(old):
    sys.modules.pop(old.rpartition(".")[0], None)
    with pytest.warns(DeprecationWarning, match="is now"):
        assert new_name(old) is new_name(RENAMED[old])


def test_names_of_a_package_that_was_a_module():
    with pytest.warns(DeprecationWarning, match=r"^calib.boards.Charuco is now calib.boards.target.Charuco$"):
        assert calib.boards.Charuco.__module__ == "calib.boards.target"
    with pytest.warns(DeprecationWarning, match=r"^arraygeom.retaken is now arraygeom.resampled$"):
        assert arraygeom.retaken is arraygeom.resampled
    for package in (arraygeom, calib.boards, importlib.import_module("pat")):
        with pytest.raises(AttributeError, match="no attribute 'no_such_name'"):
            package.no_such_name  # noqa: B018


def run(code: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)


def test_fuse_is_a_function_and_was_a_module():
    code = """
import warnings; warnings.simplefilter("ignore")
import pat
from pat import Frame, fuse
assert fuse.__module__ == "pat.fusion.fuse", fuse
from pat.fuse import fuse as same
assert same is fuse
import pat.fuse
from pat import fuse as called
for f in (pat.fuse, called):
    try: f()
    except TypeError as error: assert "fuse()" in str(error), error
    else: raise AssertionError
"""
    assert run(code).stderr == ""


def test_the_front_door_is_light():
    code = "import sys, pat; print({'torch', 'numpy', 'arraygeom', 'yaml'} & set(sys.modules)); print(dir(pat))"
    printed = run(code).stdout
    assert printed.startswith("set()")
    assert "load_weights" in printed


def test_a_script_sees_the_warning():
    done = run("from pat.weights import load_weights")
    assert "<string>:1: DeprecationWarning: pat.weights is now pat.networks.weights" in done.stderr
    assert done.returncode == 0
