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

A camera that is not calibrated may have a lens all the same, which says itself how many pixels count as 1 and
where its centre is: `distortion: {model: ..., coefficients: [...], scale: 320, centre: [319.5, 199.5]}`. F
and H of its links are between undistorted pixels.

Numbers in pixels are converted to ours (first centre at 0) when read; files are written in our convention.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Callable, Mapping
from dataclasses import MISSING
from pathlib import Path
from typing import Any, TypeVar

import torch
import yaml
from torch import Tensor

from ..camera import Camera, LensView, View, intrinsics
from ..distortion import COEFFICIENT_COUNTS, Distortion
from ..epipolar import shift_origin
from ..lenses.model import CAMERA_MODELS, CameraModel, LensModel
from ..pixels import shift_matrix
from ..pose import Pose, rotation_from_vector
from ..rig import Link, Rig
from ..sensor import CODINGS, PATTERNS, Band, Curve, Sensor
from ..text import short
from .source import RigSource, float64_of

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
    return "arraygeom-rig" in head or (path.suffix in {".yaml", ".yml"} and "\ncameras:" in "\n" + head)


def read(source: RigSource) -> Rig:
    """The rig of a native file. Raises RigFileError naming the file, the entry and what to do."""
    return _Document(source.path).read(source.yaml())


def read_text(text: str, path: str | Path) -> Rig:
    """The rig of a native file's text; `path` names it in errors."""
    source = _Document(Path(path))
    return source.read(source.yaml(text))


def write(rig: Rig) -> str:
    """The text of a native file. Raises ValueError for a batch of rigs."""
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


class _Document(RigSource):
    """A native file being read; knows its units and pixel origin for the conversions."""

    metre, origin = 1.0, 0.0

    def read(self, document: Any) -> Rig:
        """The rig of the whole document."""
        self.keys(document, TOP, None)
        if not str(document.get("format", FORMAT)).startswith("arraygeom-rig"):
            raise self.fail("format", f"is {short(document['format'])}, wanted '{FORMAT}'")
        self.metre = self.choice(document.get("units", "metres"), UNITS, "units")
        self.origin = self.choice(
            document.get("first_pixel_centre", 0), {0: 0.0, 0.5: 0.5, 1: 1.0}, "first_pixel_centre"
        )
        entries = document.get("cameras")
        if not isinstance(entries, dict) or not entries:
            raise self.fail("cameras", "missing or empty: name at least one camera")
        cameras = {str(name): self.camera(f"cameras.{name}", entry) for name, entry in entries.items()}
        depth = None
        if document.get("depth") is not None:
            near, far = self.numbers(document["depth"], (2,), "depth", infinite=True) * self.metre
            if not 0 < near <= far:
                raise self.fail("depth", f"is [{near:g}, {far:g}] m; wanted [near, far] with 0 < near <= far")
            depth = (near, far)
        return Rig(
            cameras, depth=depth, links=self.links(document, cameras), name=str(document.get("name", ""))
        )

    def links(self, document: dict[str, Any], cameras: Mapping[str, View]) -> dict[tuple[str, str], Link]:
        links: dict[tuple[str, str], Link] = {}
        for i, fields in enumerate(document.get("links") or []):
            names, link = self.link(f"links[{i}]", fields, cameras)
            if names in links:
                first = list(links).index(names)
                raise self.fail(
                    f"links[{i}]", f"is between '{names[0]}' and '{names[1]}', as links[{first}]: keep one"
                )
            links[names] = link
        return links

    def camera(self, entry: str, fields: Any) -> View:
        """A calibrated camera, a view with a lens alone, or one of which only the size is known."""
        self.keys(fields, CAMERA, entry)
        width, height = (
            self.whole(n, f"{entry}.size") for n in self.pair(fields.get("size"), f"{entry}.size")
        )
        view = View(hw=self.bounded((height, width), f"{entry}.size"), sensor=self.sensor(entry, fields))
        stated = fields.keys() & CALIBRATION
        if not stated:
            return view
        if stated == {"distortion"}:
            return self.lens_view(f"{entry}.distortion", fields["distortion"], view)
        lens = self.distortion(f"{entry}.distortion", fields.get("distortion"))
        return Camera(
            K=self.K(entry, fields, view.hw),
            cam_from_world=self.stated_pose(entry, fields),
            hw=view.hw,
            distortion=None if isinstance(lens, Distortion) and lens.is_identity else lens,
            sensor=view.sensor,
        )

    def lens_view(self, entry: str, fields: Any, view: View) -> View:
        """An uncalibrated view whose lens states its own scale and centre."""
        self.keys(fields, ("model", "coefficients", "scale", "centre", "K"), entry)
        if not ("scale" in fields or "K" in fields):
            raise self.fail(
                entry,
                "is of a camera without 'focal': "
                "add that, or `scale` (the pixels that count as 1 in the lens model)",
            )
        K = self.K(entry, fields, view.hw, scale="scale")
        lens = self.distortion(entry, {key: fields.get(key) for key in ("model", "coefficients")})
        return LensView(hw=view.hw, sensor=view.sensor, K=K, distortion=lens)

    def K(self, entry: str, fields: Mapping[str, Any], hw: tuple[int, int], scale: str = "focal") -> Tensor:
        """The intrinsic matrix as stated, or by `scale` (a calibrated camera's focal lengths) and centre."""
        if "K" in fields:
            K = self.numbers(fields["K"], (3, 3), f"{entry}.K")
            if K[2].tolist() != [0, 0, 1] or K[:2, :2].det().abs() < 1e-9:
                raise self.fail(
                    f"{entry}.K", "is not an intrinsic matrix: wanted [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
                )
            return shift_matrix(self.origin, self.origin) @ K
        if scale not in fields:
            raise self.fail(
                entry, "has a pose or a centre but no 'focal' (pixels): add it, or leave only 'size'"
            )
        focal = self.pair(fields[scale], f"{entry}.{scale}")
        if min(focal) <= 0:
            raise self.fail(f"{entry}.{scale}", f"is {min(focal):g}; a {NAMED[scale]} is positive, in pixels")
        K = intrinsics(focal, hw)
        if fields.get("centre") is not None:
            K[:2, 2] = self.numbers(fields["centre"], (2,), f"{entry}.centre") - self.origin
        return K

    def stated_pose(self, entry: str, fields: Mapping[str, Any]) -> Pose:
        R = self.stated_rotation(f"{entry}.rotation", fields.get("rotation", [0, 0, 0]))
        if "translation" in fields and "position" in fields:
            raise self.fail(entry, "has both 'translation' (t) and 'position' (-R^T t): keep one")
        if "position" in fields:
            return Pose.from_centre(
                R, self.numbers(fields["position"], (3,), f"{entry}.position") * self.metre
            )
        return Pose(
            R, self.numbers(fields.get("translation", [0, 0, 0]), (3,), f"{entry}.translation") * self.metre
        )

    def stated_rotation(self, entry: str, value: Any) -> Tensor:
        """From a matrix, or a rotation vector in degrees."""
        if isinstance(value, list) and value and isinstance(value[0], list):
            return self.rotation(self.numbers(value, (3, 3), entry), entry)
        return rotation_from_vector(torch.deg2rad(self.numbers(value, (3,), entry)))

    def distortion(self, entry: str, value: Any) -> LensModel | None:
        if value is None:
            return None
        kind = CAMERA_MODELS.get(str(value.get("model"))) if isinstance(value, dict) else None
        if kind is not None:
            return self.model(entry, kind, value)
        if isinstance(value, dict) and "model" in value and value["model"] not in COEFFICIENT_COUNTS:
            known = ", ".join([*COEFFICIENT_COUNTS, *CAMERA_MODELS])
            raise self.fail(
                f"{entry}.model",
                f"is '{value['model']}', not one of {known}: "
                "import the module that defines a model of your own first",
            )
        self.keys(value, ("model", "coefficients"), entry)
        coefficients = self.numbers(value.get("coefficients"), None, f"{entry}.coefficients")
        return self.made(entry, Distortion, str(value.get("model")), coefficients)

    def model(self, entry: str, kind: type[CameraModel], value: dict[str, Any]) -> CameraModel:
        """A camera model with its own numbers: tensors, models within it, and what is neither as it is."""
        known = {f.name: f for f in dataclasses.fields(kind)}  # type: ignore[arg-type]
        self.keys(value, ("model", *known), entry)
        numbers: dict[str, Any] = {}
        for name, given in value.items():
            if isinstance(given, dict):
                numbers[name] = self.distortion(f"{entry}.{name}", given)
            elif name != "model" and "Tensor" in str(known[name].type):
                several = isinstance(given, list)
                numbers[name] = self.numbers(given, None if several else (), f"{entry}.{name}")
            elif name != "model":
                numbers[name] = given
        missing = [
            n for n, f in known.items() if n not in numbers and f.default is f.default_factory is MISSING
        ]
        if missing:
            raise self.fail(entry, f"has no {' or '.join(missing)}, which a {value['model']} camera has")
        return self.made(entry, lambda: kind(**numbers))

    def sensor(self, entry: str, fields: Mapping[str, Any]) -> Sensor:
        response = fields.get("response")
        if isinstance(response, dict):
            response = self.response(f"{entry}.response", response)
        known: dict[str, Any] = {}
        for key, choices in (("coding", CODINGS), ("bayer", PATTERNS)):
            if fields.get(key) is not None:
                known[key] = self.one_of(fields[key], choices, f"{entry}.{key}")
        for key, above in (("frame_rate", 0.0), ("time_offset", -math.inf), ("exposure", 0.0)):
            if fields.get(key) is not None:
                known[key] = self.number(fields[key], f"{entry}.{key}", above=above)
        return Sensor(response=response, **known, **self.counts(entry, fields))

    def counts(self, entry: str, fields: Mapping[str, Any]) -> dict[str, Any]:
        """What makes light of a file's values: bits, black level and gain."""
        known: dict[str, Any] = {}
        if fields.get("bits") is not None:
            known["bits"] = bits = self.number(fields["bits"], f"{entry}.bits", above=0)
            if bits not in range(1, 17):
                raise self.fail(f"{entry}.bits", f"is {bits:g}; wanted a whole number from 1 to 16")
            known["bits"] = int(bits)
        if fields.get("black_level") is not None:
            known["black_level"] = black = self.number(fields["black_level"], f"{entry}.black_level")
            if black and "bits" not in known:
                raise self.fail(f"{entry}.black_level", "needs 'bits', the number of bits of a count: add it")
            if black < 0 or (black and black >= 2 ** known["bits"] - 1):
                raise self.fail(f"{entry}.black_level", f"is {black:g}, which is not between 0 and white")
        if fields.get("gain") is not None:
            several = isinstance(fields["gain"], list)
            gain = self.numbers(fields["gain"], (3,) if several else (), f"{entry}.gain")
            if not (gain > 0).all():
                raise self.fail(f"{entry}.gain", f"is {short(fields['gain'])}; gains are positive")
            known["gain"] = tuple(gain.tolist()) if several else float(gain)
        return known

    def number(self, value: Any, entry: str, *, above: float = -math.inf) -> float:
        number = float(self.numbers(value, (), entry))
        if not number > above:
            raise self.fail(entry, f"is {number:g}; wanted a number above {above:g}")
        return number

    def one_of(self, value: Any, choices: tuple[str, ...], entry: str) -> str:
        if value not in choices:
            raise self.fail(entry, f"is '{value}'; wanted {' or '.join(map(repr, choices))}")
        return str(value)

    def response(self, entry: str, fields: dict[str, Any]) -> Band | Curve:
        if "centre" in fields:
            self.keys(fields, ("centre", "width"), entry)
            centre, width = self.numbers([fields["centre"], fields.get("width")], (2,), entry).tolist()
            return self.made(entry, Band, centre, width)
        self.keys(fields, ("wavelength", "response"), entry)
        curve = self.numbers([fields.get("wavelength"), fields.get("response")], None, entry)
        return self.made(entry, Curve, *(tuple(row) for row in curve.reshape(2, -1).tolist()))

    def made(self, entry: str, kind: Callable[..., T], *numbers: Any) -> T:
        """What a constructor makes, its refusals with the entry's name."""
        try:
            return kind(*numbers)
        except ValueError as error:
            raise self.fail(entry, str(error)) from None

    def link(self, entry: str, fields: Any, cameras: Mapping[str, View]) -> tuple[tuple[str, str], Link]:
        self.keys(fields, ("alpha", "beta", "F", "H"), entry)
        names = [str(fields.get(key)) for key in ("alpha", "beta")]
        for key, name in zip(("alpha", "beta"), names):
            if name not in cameras:
                raise self.fail(
                    f"{entry}.{key}", f"is '{name}', which is no camera of this rig ({', '.join(cameras)})"
                )
        F = shift_origin(self.numbers(fields.get("F"), (3, 3), f"{entry}.F"), self.origin)
        H = None
        if fields.get("H") is not None:
            shift = shift_matrix(self.origin, self.origin)
            H = shift @ self.numbers(fields["H"], (3, 3), f"{entry}.H") @ torch.linalg.inv(shift)
        return (names[0], names[1]), Link(F, H)

    def keys(self, value: Any, allowed: tuple[str, ...], entry: str | None) -> None:
        if not isinstance(value, dict):
            raise self.fail(entry, f"wanted a mapping with keys {', '.join(allowed)}")
        for key in value:
            if key not in allowed:
                near = difflib.get_close_matches(str(key), allowed, 1)
                hint = f"did you mean '{near[0]}'?" if near else f"known here: {', '.join(allowed)}"
                raise self.fail(f"{entry}.{key}" if entry else str(key), f"unknown key; {hint}")

    def numbers(
        self, value: Any, shape: tuple[int, ...] | None, entry: str, *, infinite: bool = False
    ) -> Tensor:
        lengths = " x ".join(map(str, shape or ()))
        wanted = "a list of numbers" if shape is None else f"{lengths} numbers" if shape else "a number"
        tensor = float64_of(value)
        if tensor is None:
            raise self.fail(entry, f"is {short(value)}; wanted {wanted}")
        if shape is not None and tensor.shape != shape:
            raise self.fail(entry, f"has shape {tuple(tensor.shape)}; wanted {wanted}")
        if tensor.isnan().any() or (tensor.isinf().any() and not infinite):
            raise self.fail(entry, "holds NaN or infinite numbers")
        return tensor

    def pair(self, value: Any, entry: str) -> tuple[float, float]:
        """Two numbers; a single one counts for both."""
        if value is None:
            raise self.fail(entry, "is missing; wanted two numbers, in pixels")
        a, b = self.numbers(value if isinstance(value, list) else [value, value], (2,), entry).tolist()
        return a, b

    def whole(self, value: float, entry: str) -> int:
        if value < 1 or value != math.floor(value):
            raise self.fail(entry, f"is {value:g}; wanted [width, height] in whole pixels")
        return int(value)

    def choice(self, value: Any, choices: Mapping[Any, float], entry: str) -> float:
        if isinstance(value, str | int | float) and not isinstance(value, bool) and value in choices:
            return choices[value]
        raise self.fail(entry, f"is {short(value)}; wanted one of {', '.join(map(str, choices))}")


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
    """A lens or a camera model with its numbers. Raises ValueError for one without a name."""
    if isinstance(lens, Distortion):
        return {"model": lens.model, "coefficients": lens.coefficients.tolist()}
    if not isinstance(lens, CameraModel) or not lens.registered:
        kind = type(lens).__name__
        raise ValueError(
            f"the camera model {kind} has no name for rig files: class {kind}(CameraModel, name=...)"
        )
    held = {f.name: getattr(lens, f.name) for f in dataclasses.fields(lens)}  # type: ignore[arg-type]
    entry: dict[str, Any] = {"model": lens.model}
    for name, value in held.items():
        if isinstance(value, LensModel):
            entry[name] = _model_entry(value)
        elif value is not None:
            entry[name] = value.tolist() if isinstance(value, Tensor) else value
    return entry


def _K_entry(K: Tensor, scale: str) -> dict[str, Any]:
    plain = not bool(K[0, 1] or K[1, 0]) and bool((K.diagonal() > 0).all())
    return {scale: K.diagonal()[:2].tolist(), "centre": K[:2, 2].tolist()} if plain else {"K": K.tolist()}


def _sensor_entry(sensor: Sensor) -> dict[str, Any]:
    default = Sensor()
    entry = {k: v for k, v in vars(sensor).items() if v != getattr(default, k)}
    if isinstance(sensor.gain, tuple):
        entry["gain"] = list(sensor.gain)
    if isinstance(sensor.response, Band | Curve):
        entry["response"] = {
            k: list(v) if isinstance(v, tuple) else v for k, v in vars(sensor.response).items()
        }
    return entry


def _link_entry(alpha: str, beta: str, link: Link) -> dict[str, Any]:
    H = {} if link.H is None else {"H": link.H.tolist()}
    return {"alpha": alpha, "beta": beta, "F": link.F.tolist()} | H


class _Dumper(yaml.SafeDumper):
    """Lists of numbers on one line."""


def _represent_list(dumper: yaml.SafeDumper, items: list[Any]) -> yaml.Node:
    flow = all(isinstance(i, int | float | list) for i in items)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", items, flow_style=flow)


_represent: Callable[..., None] = _Dumper.add_representer
_represent(list, _represent_list)
