"""The paper's four demonstrations, a folder each: the rig (`rig.yaml`), how it records, expected figures.

`python -m experiments systems list` names them, `... systems run NAME` renders a scene for the rig, records
it, fuses it and compares with the ground truth. Beside the package, not in it.
"""

from .system import NAMES, ArraySystem, SystemResult, load_system, run_system

__all__ = ["NAMES", "ArraySystem", "SystemResult", "load_system", "run_system"]
