"""The native rig file: YAML that people write by hand.

Units and the pixel convention stand in the file. Example:

    format: arraygeom-rig 1
    units: metres               # or millimetres
    first_pixel_centre: 0       # 0 (OpenCV), 0.5 (COLMAP) or 1 (MATLAB)
    depth: [2, 20]              # near and far along the optical axis; far may be .inf
    cameras:
      mono:
        size: [640, 400]        # width, height
        focal: 800              # pixels; or [fx, fy]
        centre: [319.5, 199.5]  # principal point; left out: the image's middle
      colour:
        size: [640, 400]
        focal: [620, 622]
        rotation: [0.01, -0.02, 0.5]  # rotation vector in degrees; or a 3x3 matrix. X_camera = R X_world + t
        translation: [-0.1, 0, 0]     # t; or `position`, the optical centre in the world
        distortion: {model: brown-conrady, coefficients: [-0.1, 0.02, 0, 0]}
        response: rgb                 # a name, or {centre: 450, width: 80} in nm
        frame_rate: 30                # a second; `time_offset` in seconds after the rig's clock
        coding: linear                # or srgb, the default
        bayer: RGGB                   # raw images: the pattern from the top left
        bits: 12                      # counts run from 0 to 4095; by default as many as the file has
        black_level: 64               # counts without light
        exposure: 0.01                # seconds
        gain: [1.9, 1, 1.4]           # of red, green, blue; or one number
    links:                            # pairs of cameras that have only a size
      - {alpha: mono, beta: colour, F: [[...], [...], [...]], H: [[...], [...], [...]]}
        # of cameras at one place H alone, and `spread`, by how many pixels points are off it

A camera that is not calibrated may have a lens all the same, which says itself how many pixels count as 1 and
where its centre is: `distortion: {model: ..., coefficients: [...], scale: 320, centre: [319.5, 199.5]}`. F
and H of its links are between undistorted pixels.

Numbers in pixels are converted to ours (first centre at 0) when read; files are written in our convention.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING
from pathlib import Path
from typing import Any, TypeVar

import torch
import yaml
from torch import Tensor

from ..camera import Camera, LensView, View, intrinsics
from ..distortion import COEFFICIENT_COUNTS, Distortion
from ..lenses.model import CAMERA_MODELS, CameraModel, LensModel, check_model
from ..pair import Link
from ..pixels import HW, shift_matrix
from ..pose import Pose, rotation_from_vector
from ..rig import Rig
from ..runtime.safe_yaml import SafeDumper
from ..runtime.text import short
from ..sensor import Band, Curve, Sensor
from .source import Entry, RigSource

T = TypeVar("T")

FORMAT = "arraygeom-rig 1"
UNITS = {"metres": 1.0, "millimetres": 1e-3}
TOP = ("format", "name", "units", "first_pixel_centre", "depth", "cameras", "links")
CAMERA = (
    *("size", "focal", "centre", "K", "rotation", "translation", "position", "distortion"),
    *("response", "frame_rate", "time_offset", "coding", "bayer", "bits", "black_level", "exposure", "gain"),
)
NAMED = {"focal": "focal length", "scale": "scale"}
CALIBRATION = {"focal", "centre", "K", "rotation", "translation", "position", "distortion"}


def recognises(path: Path, head: str) -> bool:
    """Return True for a text with the format's name, or a YAML file with cameras."""
    return "arraygeom-rig" in head or (path.suffix in {".yaml", ".yml"} and "\ncameras:" in "\n" + head)


def read(source: RigSource) -> Rig:
    """Read the rig of a native file. Raises as `read_text`."""
    return _rig(source.yaml())


def read_text(text: str, path: str | Path) -> Rig:
    """Read the rig of a native file's text.

    Args:
        text: content of the file, YAML.
        path: name of the file in errors; nothing is read from it.

    Returns:
        The rig, in metres and our pixels, float64.

    Raises:
        RigFileError: for a damaged text; its message names file, entry and problem.
    """
    return _rig(RigSource(Path(path)).yaml(text))


def write(rig: Rig) -> str:
    """Format a rig as the text of a native file, in metres and our pixels.

    All of the rig is kept, but K of an uncalibrated view without a lens.

    Raises:
        ValueError: for a batch of rigs, or a camera model that has no name or holds values that no file can.
    """
    if rig.batch_shape:
        raise ValueError(
            "a rig file holds one rig and this is a batch of "
            f"{tuple(rig.batch_shape)}: write one each, rig[i]"
        )
    document: dict[str, Any] = {"format": FORMAT}
    if rig.name:
        document["name"] = rig.name
    document |= {"units": "metres", "first_pixel_centre": 0}
    if rig.depth is not None:
        document["depth"] = [float(d) for d in rig.depth]
    document["cameras"] = {name: _camera_entry(camera) for name, camera in rig.cameras.items()}
    if rig.links:
        document["links"] = [_link_entry(*names, link) for names, link in rig.links.items()]
    return yaml.dump(document, Dumper=_Dumper, sort_keys=False, width=120, allow_unicode=True)


def _rig(document: Entry) -> Rig:
    _check_keys(document, TOP)
    if document.get("format", FORMAT).value != FORMAT:
        raise document["format"].fail(
            f"is {short(document['format'].value)}, wanted '{FORMAT}'; of a later version? Update arraygeom"
        )
    metres = UNITS[_one_of(document.get("units", "metres"), UNITS)]
    origin = float(_one_of(document.get("first_pixel_centre", 0), (0, 0.5, 1)))
    if not document.get("cameras").value:
        raise document.get("cameras").fail("missing or empty: name at least one camera")
    cameras = {name: _camera(fields, origin) for name, fields in document["cameras"].items()}
    links: dict[tuple[str, str], Link] = {}
    for fields in document["links"].each() if document.get("links").value else []:
        names, link = _link(fields, cameras)
        if names in links:
            first = list(links).index(names)
            raise fields.fail(f"is between '{names[0]}' and '{names[1]}', as links[{first}]: keep one")
        links[names] = link.transformed(shift_matrix(origin, origin), shift_matrix(origin, origin))
    depth = None
    if document.get("depth").value is not None:
        near, far = depth = tuple(document["depth"].numbers((2,), infinite=True))
        if not 0 < near <= far:
            stated = f"[{near * metres:g}, {far * metres:g}] m"
            raise document["depth"].fail(f"is {stated}; wanted [near, far] with 0 < near <= far")
    name = str(document.get("name", "").value)
    rig = document.source.rig(cameras.items(), depth=depth, links=links, name=name)
    return rig if metres == 1.0 else _made(document, rig.scaled, metres)


def _camera(fields: Entry, origin: float) -> View:
    """Read a calibrated camera, a view with a lens alone, or one of which only the size is known."""
    _check_keys(fields, CAMERA)
    size, lens = fields.get("size"), fields.get("distortion")
    view = View(hw=Entry(size.source, _pair(size), size.name).size(), sensor=_sensor(fields))
    stated = fields.value.keys() & CALIBRATION
    if not stated:
        return view
    if stated == {"distortion"}:
        return _lens_view(lens, view, origin)
    model = _lens(lens)
    return Camera(
        K=_intrinsics(fields, view.hw, origin),
        cam_from_world=_pose(fields),
        hw=view.hw,
        distortion=None if isinstance(model, Distortion) and model.is_identity else model,
        sensor=view.sensor,
    )


def _lens_view(fields: Entry, view: View, origin: float) -> View:
    """Read an uncalibrated view whose lens states its own scale and centre."""
    kind = CAMERA_MODELS.get(str(fields.get("model").value))
    keys = ("coefficients",) if kind is None else tuple(f.name for f in dataclasses.fields(kind))  # type: ignore[arg-type]
    _check_keys(fields, ("model", *keys, "scale", "centre", "K"))
    if not ("scale" in fields or "K" in fields):
        raise fields.fail(
            "is of a camera without 'focal': "
            "add that, or `scale` (the pixels that count as 1 in the lens model)"
        )
    K = _intrinsics(fields, view.hw, origin, scale="scale")
    stated = {key: value for key, value in fields.value.items() if key in ("model", *keys)}
    return LensView(
        hw=view.hw, sensor=view.sensor, K=K, distortion=_lens(Entry(fields.source, stated, fields.name))
    )


def _intrinsics(fields: Entry, hw: HW, origin: float, scale: str = "focal") -> Tensor:
    """Read the intrinsic matrix as stated, or by `scale` (a calibrated camera's focal lengths) and centre."""
    if "K" in fields:
        K = fields.get("K").numbers((3, 3))
        if K[2].tolist() != [0, 0, 1] or K[:2, :2].det().abs() < 1e-9:
            raise fields["K"].fail("is not an intrinsic matrix: wanted [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
        return shift_matrix(origin, origin) @ K
    if scale not in fields:
        raise fields.fail("has a pose or a centre but no 'focal' (pixels): add it, or leave only 'size'")
    focal = _pair(fields.get(scale))
    if min(focal) <= 0:
        raise fields[scale].fail(f"is {min(focal):g}; a {NAMED[scale]} is positive, in pixels")
    centre = fields.get("centre")
    return intrinsics(focal, hw, None if centre.value is None else centre.numbers((2,)) - origin)


def _pose(fields: Entry) -> Pose:
    if "translation" in fields and "position" in fields:
        raise fields.fail("has both 'translation' (t) and 'position' (-R^T t): keep one")
    R = _rotation(fields.get("rotation", [0, 0, 0]))
    if "position" in fields:
        return Pose.from_centre(R, fields.get("position").numbers((3,)))
    return Pose(R, fields.get("translation", [0, 0, 0]).numbers((3,)))


def _rotation(entry: Entry) -> Tensor:
    """Read a matrix, or a rotation vector in degrees."""
    if isinstance(entry.value, list) and entry.value and isinstance(entry.value[0], list):
        entry.numbers((3, 3))
        return entry.rotation()
    return rotation_from_vector(torch.deg2rad(entry.numbers((3,))))


def _lens(entry: Entry) -> LensModel | None:
    if entry.value is None:
        return None
    name = entry.value.get("model") if isinstance(entry.value, dict) else None
    if (kind := CAMERA_MODELS.get(str(name))) is not None:
        return _model(entry, kind)
    if name is not None and str(name) not in COEFFICIENT_COUNTS:
        raise entry["model"].fail(
            f"is '{name}', not one of {', '.join([*COEFFICIENT_COUNTS, *CAMERA_MODELS])}: "
            "import the module that defines a model of your own first (commands of pat: --plugin MODULE)"
        )
    _check_keys(entry, ("model", "coefficients"))
    return _made(entry, Distortion, str(name), entry.get("coefficients").numbers())


def _model(entry: Entry, kind: type[CameraModel]) -> CameraModel:
    """Read a camera model from its own numbers: tensors, models within it, and other values as they are."""
    fields = {f.name: f for f in dataclasses.fields(kind)}  # type: ignore[arg-type]
    _check_keys(entry, ("model", *fields))
    numbers: dict[str, Any] = {}
    for name, value in entry.items():
        if isinstance(value.value, dict):
            numbers[name] = _lens(value)
        elif name != "model":
            numbers[name] = value.tensor() if "Tensor" in str(fields[name].type) else value.value
    missing = [n for n, f in fields.items() if n not in numbers and f.default is f.default_factory is MISSING]
    if missing:
        raise entry.fail(f"has no {' or '.join(missing)}, which a {entry['model'].value} camera has")
    model = _made(entry, kind, **numbers)
    _made(entry, check_model, model)
    return model


def _sensor(fields: Entry) -> Sensor:
    stated = {key: entry for key, entry in fields.items() if entry.value is not None}
    words = ("response", "coding", "bayer")
    arguments: dict[str, Any] = {key: stated[key].value for key in words if key in stated}
    if isinstance(arguments.get("response"), dict):
        arguments["response"] = _response(stated["response"])
    numbers = ("frame_rate", "time_offset", "exposure", "bits", "black_level")
    arguments |= {key: stated[key].number() for key in numbers if key in stated}
    bits, black = arguments.get("bits"), arguments.get("black_level", 0.0)
    if bits is not None:
        if bits not in range(1, 17):
            raise stated["bits"].fail(f"is {bits:g}; wanted a whole number from 1 to 16")
        arguments["bits"] = int(bits)
    if black and (bits is None or black >= 2**bits - 1):
        problem = "needs 'bits', the number of bits of a count: add it"
        raise stated["black_level"].fail(
            problem if bits is None else f"is {black:g}, which is not between 0 and white"
        )
    if "gain" in stated:
        gain = stated["gain"]
        several = isinstance(gain.value, list)
        arguments["gain"] = tuple(gain.numbers((3,)).tolist()) if several else gain.number()
    return _made(fields, Sensor, **arguments)


def _response(fields: Entry) -> Band | Curve:
    if "centre" in fields:
        _check_keys(fields, ("centre", "width"))
        return _made(fields, Band, *fields.listed("centre", "width").numbers((2,)).tolist())
    _check_keys(fields, ("wavelength", "response"))
    curve = (tuple(fields[key].numbers().tolist()) for key in ("wavelength", "response"))
    return _made(fields, Curve, *curve)


def _link(fields: Entry, cameras: Mapping[str, View]) -> tuple[tuple[str, str], Link]:
    _check_keys(fields, ("alpha", "beta", "F", "H", "spread"))
    alpha, beta = (_camera_named(fields.get(key), cameras) for key in ("alpha", "beta"))
    H, spread = fields.get("H"), fields.get("spread", 0.0)
    if not 0 <= spread.number() < math.inf:
        raise spread.fail(f"is {spread.number():g}; it is 0 or more, in pixels")
    if H.value is not None and "F" not in fields:
        return (alpha, beta), Link.from_homography(H.numbers((3, 3)), spread.number())
    F, rough = fields.get("F").numbers((3, 3)), None if H.value is None else H.numbers((3, 3))
    return (alpha, beta), Link(F, rough, spread.number())


def _camera_named(entry: Entry, cameras: Mapping[str, View]) -> str:
    if (name := str(entry.value)) not in cameras:
        raise entry.fail(f"is '{name}', which is no camera of this rig ({', '.join(cameras)})")
    return name


def _check_keys(entry: Entry, allowed: tuple[str, ...]) -> None:
    if not isinstance(entry.value, dict):
        raise entry.fail(f"wanted a mapping with keys {', '.join(allowed)}")
    entry.use()
    for key in entry.value:
        if key not in allowed:
            near = difflib.get_close_matches(str(key), allowed, 1)
            hint = f"did you mean '{near[0]}'?" if near else f"known here: {', '.join(allowed)}"
            raise entry.at(None, str(key)).fail(f"unknown key; {hint}")


def _one_of(entry: Entry, choices: Iterable[Any]) -> Any:
    if isinstance(entry.value, bool) or entry.value not in list(choices):
        raise entry.fail(f"is {short(entry.value)}; wanted {' or '.join(map(repr, choices))}")
    return entry.value


def _pair(entry: Entry) -> tuple[float, float]:
    """Return two numbers; a single one counts for both."""
    if entry.value is None:
        raise entry.fail("is missing; wanted two numbers, in pixels")
    if not isinstance(entry.value, list):
        return entry.number(), entry.number()
    a, b = entry.numbers((2,)).tolist()
    return a, b


def _made(entry: Entry, kind: Callable[..., T], *numbers: Any, **named: Any) -> T:
    """Call a constructor; its errors get the entry's name."""
    try:
        return kind(*numbers, **named)
    except (TypeError, ValueError) as error:
        raise entry.fail(str(error)) from None


def _camera_entry(camera: View) -> dict[str, Any]:
    h, w = camera.hw
    entry: dict[str, Any] = {"size": [w, h]}
    calibrated = isinstance(camera, Camera)
    if isinstance(camera, Camera):
        entry |= _K_entry(camera.K, "focal")
        entry |= {"rotation": camera.R.tolist(), "translation": camera.t.tolist()}
    if isinstance(camera, LensView) and (lens := camera.distortion) is not None:
        entry["distortion"] = _model_entry(lens)
        entry["distortion"] |= {} if calibrated else _K_entry(camera.K, "scale")
    return entry | _sensor_entry(camera.sensor)


def _model_entry(lens: LensModel) -> dict[str, Any]:
    """Return a lens or a camera model with its numbers; ValueError for one that no file can hold."""
    if isinstance(lens, Distortion):
        return {"model": lens.model, "coefficients": lens.coefficients.tolist()}
    if not isinstance(lens, CameraModel) or not lens.registered:
        kind = type(lens).__name__
        raise ValueError(
            f"the camera model {kind} has no name for rig files: class {kind}(CameraModel, name=...)"
        )
    entry: dict[str, Any] = {"model": lens.model}
    for f in dataclasses.fields(lens):  # type: ignore[arg-type]
        value = getattr(lens, f.name)
        if isinstance(value, LensModel):
            entry[f.name] = _model_entry(value)
        elif isinstance(value, Tensor):
            if "Tensor" not in str(f.type):
                raise ValueError(f"{f.name} of {lens.model} is a tensor: state it, {f.name}: torch.Tensor")
            entry[f.name] = value.tolist()
        elif isinstance(value, str | bool | int | float | list | tuple):
            entry[f.name] = value
        elif value is not None:
            kind = type(value).__name__
            raise ValueError(
                f"{f.name} of {lens.model} is a {kind}, which no rig file holds: make it a tensor"
            )
    return entry


def _K_entry(K: Tensor, scale: str) -> dict[str, Any]:
    plain = not bool(K[0, 1] or K[1, 0]) and bool((K.diagonal() > 0).all())
    return {scale: K.diagonal()[:2].tolist(), "centre": K[:2, 2].tolist()} if plain else {"K": K.tolist()}


def _sensor_entry(sensor: Sensor) -> dict[str, Any]:
    default = Sensor()
    entry = {k: v for k, v in vars(sensor).items() if v != getattr(default, k)}
    if isinstance(sensor.response, Band | Curve):
        entry["response"] = vars(sensor.response)
    return entry


def _link_entry(alpha: str, beta: str, link: Link) -> dict[str, Any]:
    H = {} if link.H is None else {"H": link.H.tolist()}
    F = {"F": link.F.tolist()} if link.F.any() or not H else {}
    return {"alpha": alpha, "beta": beta} | F | H | ({"spread": link.spread} if link.spread else {})


class _Dumper(SafeDumper):
    """YAML dumper that writes lists and tuples of numbers on one line."""


def _represent_list(dumper: yaml.SafeDumper, items: Sequence[Any]) -> yaml.Node:
    flow = all(isinstance(i, int | float | list) for i in items)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", items, flow_style=flow)


_represent: Callable[..., None] = _Dumper.add_representer
_represent(list, _represent_list)
_represent(tuple, _represent_list)
