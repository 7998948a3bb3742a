"""From photographs of a target to a rig, and from a rig to a better rig."""

import sys

from arraygeom.moved import OldModules

_BOARDS = ["bundle", "calibrate", "collect", "corners", "covariance", "coverage", "detect", "intrinsics"]
_BOARDS += ["observability", "photos", "poses", "rehearsal", "report", "run"]
_IMAGES = ("doctor", "lenses", "matches", "mistakes", "photometric", "refine", "residuals")
_MOVED = {f"calib.{name}": f"calib.boards.{name}" for name in _BOARDS}
_MOVED |= {f"calib.{name}": f"calib.images.{name}" for name in _IMAGES}
_MOVED |= {"calib.start": "calib.images.from_images", "calib.unknowns": "calib.images.parameters"}
_MOVED |= {"calib.patches": "calib.images.patch_matching"}

sys.meta_path.insert(0, OldModules(_MOVED, {"calib.report.draw_by_picture": "calib.boards.report.draw_by_image"}))
