"""The front door imports nothing before its time."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_front_door_is_light():
    code = (
        "import sys, pat; print({'torch', 'numpy', 'arraygeom', 'yaml'} & set(sys.modules)); print(dir(pat))"
    )
    printed = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True).stdout
    assert printed.startswith("set()")
    assert "load_weights" in printed
