import importlib.util
import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import pytest

from pat.lab.synthesis.blender import render_here


class BlenderProcess:
    """A process that renders one scene after another."""

    def __init__(self, pool):
        self.pool = pool

    def render(self, scene, rig, out, *, settings):
        return self.pool.submit(render_here, scene, rig, out, settings=settings).result()

    @property
    def pid(self):
        return self.pool.submit(os.getpid).result()


@pytest.fixture(scope="package")
def worker():
    """One process with Blender for all tests; they skip where it is not installed."""
    if importlib.util.find_spec("bpy") is None or importlib.util.find_spec("OpenEXR") is None:
        pytest.skip("Blender is not installed: pip install '.[synthesis]'")
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        yield BlenderProcess(pool)
