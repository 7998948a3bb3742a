"""Modules that Windows lacks (fcntl, resource, a process's pwd) are not needed to import the packages or to
fuse."""

import os
import subprocess
import sys
from pathlib import Path

from arraygeom.runtime.atomic import alone

ROOT = Path(__file__).parents[1]
WITHOUT = """
import sys, warnings
sys.modules |= dict.fromkeys(("fcntl", "resource", "pwd", "grp", "termios"))
warnings.filterwarnings("ignore", "only soft file lock")
"""
IMPORT_ALL = """
import importlib, pkgutil
import arraygeom, calib, pat
for package in (arraygeom, calib, pat):
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        if not module.name.startswith(("pat.lab.synthesis.blender", "pat.attention.gpu")):
            importlib.import_module(module.name)
"""
WAIT = """
from pathlib import Path
from arraygeom.runtime.atomic import alone
with alone(Path(sys.argv[1]), 1e6):
    pass
"""
FUSE = "from pat.app.cli.main import main; main(sys.argv[1:])"


def run(code, *words):
    command = [sys.executable, "-c", WITHOUT + code, *map(str, words)]
    done = subprocess.run(command, cwd=ROOT, env=os.environ, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr[-3000:]


def test_every_module_is_imported_without_what_only_posix_has():
    run(IMPORT_ALL)


def test_what_a_lock_of_the_system_left_is_not_waited_for(tmp_path):
    """Locks of each compiled kernel, in a folder that another system's or Python's processes use."""
    with alone(tmp_path / "kernel.lock", 1):
        pass
    (tmp_path / "kernel.lock").touch()
    run(WAIT, tmp_path / "kernel.lock")


def test_images_are_fused_without_what_only_posix_has(tmp_path):
    sample = ROOT / "pat/app/sample"
    images = [word for name in ("mono", "colour") for word in ("--image", f"{name}={sample / name}.png")]
    run(FUSE, "fuse", "--rig", sample / "rig.yaml", "--alpha", "mono", *images, "--out", tmp_path / "out")
    assert (tmp_path / "out" / "fused.png").is_file()
    assert not [*(tmp_path / "out").glob(".lock*")]
