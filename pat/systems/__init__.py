"""The paper's four demonstrations, each a folder: the rig (`rig.yaml`), how it records, and the expected figures.

`pat systems list` names them, `pat systems run NAME` renders a scene for the rig, records it, fuses it and compares
with the ground truth.
"""

from .system import NAMES, ArraySystem, SystemResult, load_system, run_system

__all__ = ["NAMES", "ArraySystem", "SystemResult", "load_system", "run_system"]
