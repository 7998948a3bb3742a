"""BoofCV's stereo.yaml and intrinsic.yaml.

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes; `rightToLeft` takes points of the
right camera into the left one, so it is inverted here; the world is the left camera. Lengths are in the
board's unit, which the file does not state: they are taken as metres (use `scale=0.001` for a board measured
in millimetres).

Written by: BoofCV: pinhole, with radial and tangential terms.
Refused: other models; more than three radial coefficients.
Sample: real: a Bumblebee2's stereo.yaml.
"""

from __future__ import annotations

from ..camera import Camera
from ..distortion import Distortion
from ..pose import Pose
from ..rig import Rig
from .source import Entry, RigSource, pose_of

MODELS = ("pinhole_radial_tangential", "pinhole")


HEAD = r"pinhole_radial_tangential|rightToLeft"


def read(source: RigSource) -> Rig:
    """Read the pair "left" (the world) and "right", or a single "camera" at the origin.

    Lengths are in the board's unit, taken as metres. A size that is not stated is the requested one, else
    guessed, with a warning.

    Raises:
        RigFileError: for a damaged file, another camera model, or more than three radial coefficients.
    """
    document = source.yaml()
    if "pinhole" in document:
        return source.rig([("camera", _camera(document, Pose.identity()))])
    relative = document["rightToLeft"]
    left_from_right = pose_of(relative["rotation"], relative.listed(*"xyz"))
    poses = {"left": Pose.identity(), "right": left_from_right.inverse()}
    return source.rig((side, _camera(document[side], pose)) for side, pose in poses.items())


def _camera(fields: Entry, pose: Pose) -> Camera:
    model = fields.get("model", MODELS[0])
    if model.value not in MODELS:
        raise model.fail(f"is '{model.value}'; supported: {', '.join(MODELS)}")
    pinhole, lens = fields["pinhole"], fields.get("radial_tangential")
    K = pinhole.listed("fx", "fy", "cx", "cy").focal_and_centre(skew=pinhole.get("skew", 0.0).number())
    return pinhole.camera(pose, K=K, distortion=None if lens.value is None else _lens(lens))


def _lens(lens: Entry) -> Distortion | None:
    """Read k1 k2 p1 p2 k3 from `radial` (up to three numbers), t1 and t2."""
    radial = lens.get("radial")
    k = radial.numbers().tolist() if radial.value else []
    if len(k) > 3:
        raise radial.fail(f"has {len(k)} coefficients; at most 3 are supported")
    k1, k2, k3 = (*k, 0.0, 0.0, 0.0)[:3]
    p = [lens.get(name, 0.0).number() for name in ("t1", "t2")]
    return lens.at([k1, k2, *p, k3], "radial").brown_conrady()
