"""Warnings stand at the caller's line."""

import inspect
import warnings

import pytest

from arraygeom import Rig
from arraygeom.io import RigFileWarning
from pat import fuse
from pat.app.sample_array import ALPHA, load_sample
from pat.networks.weights import load_weights
from tests.arraygeom.test_io import FIXTURES


def line_after(found: warnings.WarningMessage, frame) -> int:
    assert found.filename == __file__
    return found.lineno - frame.f_lineno


def test_a_rig_files_warning_stands_where_it_was_read():
    """It stood at a line of this software."""
    with pytest.warns(RigFileWarning) as found:
        Rig.load(FIXTURES / "pycalib.json")
    assert line_after(found[0], inspect.currentframe()) == -1


def test_warnings_from_beneath_torchs_wrappers_stand_at_the_call():
    array = load_sample()
    grey = {name: image.mean(0, keepdim=True).expand_as(image) for name, image in array.images.items()}
    with pytest.warns(UserWarning, match="bands") as found:
        fuse(grey, array.rig, alpha=ALPHA, network=load_weights("mono-colour"))
    line = next(w for w in found if "three equal bands" in str(w.message))
    assert line_after(line, inspect.currentframe()) == -2
