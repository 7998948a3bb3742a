"""An Azure Kinect's factory calibration, the JSON in its memory and its recordings.

Source convention: K in shares of the calibrated sensor's size, pixels with the first centre at 0.5 (shift
-0.5) as in the maker's own code (`k4a_calibration`); OpenCV axes; `Rt` takes points of the depth camera into
the camera's, in metres. ModelParameters are cx cy fx fy k1..k6, the distortion's centre, p2 p1. The colour
camera is of the whole sensor, or of the requested mode: scaled in width, as much cut off above as below.

Written by: an Azure Kinect's memory and recordings: depth, and colour in any mode by --size.
Refused: other lens models; a distortion's centre.
Sample: hand-written: azure.json, by the maker's [code](https://github.com/microsoft/Azure-Kinect-Sensor-SDK).
"""

from __future__ import annotations

from ..camera import Camera
from ..rig import Rig
from .source import Entry, RigSource, pose_of

NAMES = {"D0": "depth", "PV0": "color"}
MODEL = "CALIBRATION_LensDistortionModelBrownConrady"


HEAD = '"CalibrationInformation"'


def read(source: RigSource) -> Rig:
    """Read the cameras "depth" and "color".

    Raises:
        RigFileError: for a damaged file, another lens model, or a requested size that is no part of the
            sensor.
    """
    cameras = source.json()["CalibrationInformation"]["Cameras"].each()
    return source.rig(_camera(fields) for fields in cameras)


def _camera(fields: Entry) -> tuple[str, Camera]:
    place = str(fields["Location"].value).rpartition("Location")[2]
    name, intrinsics = NAMES.get(place, place), fields["Intrinsics"]
    if (model := intrinsics["ModelType"]).value != MODEL:
        raise model.fail(f"is '{model.value}'; {MODEL} is read")
    listed = intrinsics["ModelParameters"]
    cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, x, y, p2, p1 = listed.numbers().tolist()[:14]
    if x or y:
        raise listed.fail("has a centre of distortion beside the principal point, which is not read")
    h, w = fields.listed("SensorWidth", "SensorHeight").size()
    size = fields.source.hw if name == "color" and fields.source.hw else (h, w)
    scale = size[1] / w
    cut = (h * scale - size[0]) / 2
    if cut < 0:
        raise fields.fail(f"is {w}x{h}, which {size[1]}x{size[0]} is no part of")
    K = fields.at([fx * w * scale, fy * h * scale, cx * w * scale, cy * h * scale - cut], f"{name} K")
    pose = pose_of(fields["Rt"]["Rotation"], fields["Rt"]["Translation"])
    lens = fields.at([k1, k2, p1, p2, k3, k4, k5, k6], "ModelParameters").brown_conrady()
    return name, Camera(K=K.focal_and_centre(first_pixel=0.5), cam_from_world=pose, hw=size, distortion=lens)
