import importlib.util

import pytest

from pat.synthesis.blender import Worker


@pytest.fixture(scope="package")
def worker():
    """One process with Blender for all tests; they skip where it is not installed."""
    if importlib.util.find_spec("bpy") is None or importlib.util.find_spec("OpenEXR") is None:
        pytest.skip("Blender is not installed: pip install '.[synthesis]'")
    with Worker() as process:
        yield process
