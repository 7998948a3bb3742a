import pytest

from tests.pat.lab.synthesis.scenes import needs_blender


@pytest.fixture(scope="package")
def installed():
    """Tests skip where Blender is not installed."""
    needs_blender()
