"""Cameras as Agisoft Metashape exports them in XML: every aligned image is a camera, named by its label.

Source convention: pixels with the first centre at 0.5 (shift -0.5), the principal point cx, cy off the
image's middle; OpenCV axes; `transform` is camera->chunk, inverted; the world is the chunk's frame, in the
scale that the chunk or its component states, taken as metres (its rotation and translation into geographic
coordinates are left out). In Brown's polynomials p1 and p2 change places; b1 adds to the first focal length
and b2 is the skew. Frame and fisheye sensors. Of a multi-camera system's slaves, `rotation` and `location`
of the sensor take its points into the master's, in the chunk's unit.

Written by: Agisoft Metashape 1 and 2, cameras as XML, multi-camera systems and equal labels among them.
Refused: p3, p4, a frame's k4, types other than frame and fisheye; several chunks; cameras that are not
aligned are left out.
Sample: hand-written: metashape.xml, by Agisoft's manual.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import Counter

from ..camera import Camera, LensView
from ..distortion import Distortion
from ..lenses.central import THIN_PRISM_FISHEYE
from ..pose import Pose
from ..rig import Rig
from .source import Entry, RigSource, pose_of

LENS_NUMBERS = ("k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")


HEAD = "<chunk"


def read(source: RigSource) -> Rig:
    """Read all aligned cameras of the file's one chunk, by label; others are left out with a warning.

    Of equal labels the file of the image, or the camera's number with the label, is the name. Lengths are in
    metres by the stated scale; without one they are in the chunk's own unit.

    Raises:
        RigFileError: for a damaged file, several chunks, no aligned camera, or lens terms that are not read.
    """
    chunks = list(source.xml().iter("chunk"))
    if len(chunks) != 1:
        raise source.fail("chunk", f"occurs {len(chunks)} times: export one chunk's cameras")
    sensors = {sensor.get("id"): sensor for sensor in chunks[0].iter("sensor")}
    scales = {component.get("id"): _scale(source, component) for component in chunks[0].iter("component")}
    scale = _scale(source, chunks[0])
    views: dict[str, LensView] = {}
    cameras, left_out = [], []
    images = {camera.get("id"): camera for camera in chunks[0].iter("camera")}
    labels = Counter(camera.get("label") for camera in images.values())
    for camera in images.values():
        name, sensor = _name(camera, labels), camera.get("sensor_id") or ""
        master = images.get(camera.get("master_id"))
        transform = (camera if master is None else master).findtext("transform")
        offset = None if master is None or sensor not in sensors else _offset(source, sensors[sensor])
        if transform is None or (master is not None and offset is None):
            left_out.append(name)
            continue
        if sensor not in sensors:
            raise source.fail(name, f"is of sensor '{sensor}', which is not defined")
        if sensor not in views:
            views[sensor] = _sensor(source, sensors[sensor], f"sensor {sensor}")
        view, entry = views[sensor], f"{name}.transform"
        pose = source.at(transform, entry).pose_matrix().inverse()
        pose = pose if offset is None else offset.inverse() @ pose
        component_scale = scales.get(camera.get("component_id"))
        metres = component_scale if component_scale is not None else scale if scale is not None else 1.0
        pose = Pose(pose.R, pose.t * metres)
        cameras.append((name, Camera(K=view.K, cam_from_world=pose, hw=view.hw, distortion=view.distortion)))
    if left_out:
        source.warn(
            f"holds {len(left_out)} cameras that are not aligned, or of a multi-camera system whose sensors "
            f"state no place (such as {left_out[0]}); they are left out"
        )
    return source.rig(cameras)


def _name(camera: ET.Element, labels: Counter[str | None]) -> str:
    """Return an image's label; of several with one label its file, where that is stated, else its number."""
    label, photo = camera.get("label"), camera.find(".//photo")
    if label is None or labels[label] == 1:
        return label or f"camera{camera.get('id')}"
    return f"{label}_{camera.get('id')}" if photo is None else str(photo.get("path"))


def _offset(source: RigSource, sensor: ET.Element) -> Pose | None:
    """Return the pose that takes a slave's points into the master's; None if the sensor does not state it."""
    R, t = sensor.findtext("rotation"), sensor.findtext("location")
    if R is None and t is None:
        return None
    return pose_of(source.at(R or "1 0 0 0 1 0 0 0 1", "rotation"), source.at(t or "0 0 0", "location"))


def _sensor(source: RigSource, sensor: ET.Element, entry: str) -> LensView:
    """Read a sensor's last calibration (the adjusted one, where there are two)."""
    calibrations = sensor.findall("calibration")
    if not calibrations:
        raise source.fail(entry, "has no calibration: optimise the cameras, and export again")
    calibration = next((c for c in calibrations if c.get("class") == "adjusted"), calibrations[-1])
    resolution = calibration.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    if resolution is None:
        raise source.fail(entry, "has no resolution")
    sides = [resolution.get(side) or "" for side in ("width", "height")]
    h, w = source.at(sides, f"{entry} resolution").size()
    fields = source.at({child.tag: child.text for child in calibration if child.text}, entry)
    f, cx, cy, b1, b2 = (_number(fields, name) for name in ("f", "cx", "cy", "b1", "b2"))
    numbers = source.at([f + b1, f, w / 2 + cx, h / 2 + cy], f"{entry} f")
    K = numbers.focal_and_centre(first_pixel=0.5, skew=b2)
    return LensView(hw=(h, w), K=K, distortion=_lens(fields, calibration.get("type", "frame")))


def _lens(fields: Entry, kind: str) -> Distortion | None:
    k1, k2, k3, k4, p1, p2, p3, p4 = (_number(fields, name) for name in LENS_NUMBERS)
    if kind not in ("frame", "fisheye"):
        raise fields.fail(f"is of type '{kind}'; frame and fisheye are read: undistort the images first")
    if p3 or p4 or (k4 and kind == "frame"):
        raise fields.fail(
            "has p3, p4, or for a frame k4, which are not read: optimise the cameras without them"
        )
    if kind == "frame":
        return fields.at([k1, k2, p2, p1, k3], "k1").brown_conrady()
    return fields.at([k1, k2, p2, p1, k3, k4, 0.0, 0.0], "k1").lens(THIN_PRISM_FISHEYE)


def _scale(source: RigSource, element: ET.Element) -> float | None:
    """Return metres per unit of a chunk or a component; None if not stated."""
    text = element.findtext("transform/scale")
    return None if text is None else source.at(text, "scale").number()


def _number(fields: Entry, name: str) -> float:
    """Return a number of a calibration; 0 where it is not stated, except for f."""
    return (fields[name] if name == "f" else fields.get(name, "0")).number()
