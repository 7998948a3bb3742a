"""The paper's four demonstrations, each a folder: how its cameras stand (`rig.yaml`) and record, and what is expected.

`pat systems list` names them, `pat systems run NAME` renders a scene for the rig, records it, fuses it and compares
with the truth.
"""

from .system import NAMES, Result, System, load_system, run_system

__all__ = ["NAMES", "Result", "System", "load_system", "run_system"]
