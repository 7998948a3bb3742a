"""Calib_Results.mat and Calib_Results_stereo.mat of Bouguet's Camera Calibration Toolbox for MATLAB.

Source convention: pixels with the first centre at 0 (shift 0), although of MATLAB; OpenCV's lens;
X_right = R X_left + T with R from the rotation vector `om` where it is not stated; millimetres. The world is
the left camera. K has the skew `alpha_c` times the first focal length.

Written by: Bouguet's Camera Calibration Toolbox for MATLAB, .mat of version 5 to 7.
Refused: version 7.3.
Sample: made by the tests in the layout of its
[documentation](http://robots.stanford.edu/cs223b04/JeanYvesCalib/).
"""

from __future__ import annotations

from pathlib import Path

from ..camera import Camera
from ..pose import Pose
from ..rig import Rig
from .matfile import load_variables, readable_variables
from .source import Entry, RigSource, pose_of

SIDES = ("left", "right")


def recognises(path: Path, head: str) -> bool:
    """Return True for a MAT-file with the toolbox's variables."""
    if not (path.is_file() and (path.suffix == ".mat" or head.startswith("MATLAB "))):
        return False
    try:
        names = readable_variables(path.read_bytes())
    except (OSError, ValueError):
        return False
    return "fc_left" in names or {"fc", "cc"} <= set(names)


def read(source: RigSource) -> Rig:
    """Read the pair "left" (the world) and "right" in metres, or one camera "camera" at the origin.

    A size that is not stated is the requested one, else guessed, with a warning.

    Raises:
        RigFileError: for a damaged file, or missing variables.
        ImportError: without scipy.
    """
    fields = source.at(load_variables(source))
    if "fc_left" not in fields:
        return source.rig([("camera", _camera(fields, "", Pose.identity()))])
    right = pose_of(fields["R", "om"], fields["T"], metres=1e-3)
    poses = Pose.identity(), right
    return source.rig((side, _camera(fields, f"_{side}", pose)) for side, pose in zip(SIDES, poses))


def _camera(fields: Entry, which: str, pose: Pose) -> Camera:
    focal, centre = fields[f"fc{which}"], fields[f"cc{which}"].numbers((2,))
    f = focal.numbers()
    f = f.expand(2) if len(f) == 1 else focal.numbers((2,))
    skew = fields.get(f"alpha_c{which}", 0.0).number() * float(f[0])
    K = fields.at([*f, *centre], f"fc{which}, cc{which}").focal_and_centre(skew=skew)
    lens = fields[f"kc{which}"].brown_conrady()
    return fields.camera(pose, K=K, hw=fields.sized("nx", "ny", K=K), distortion=lens)
