"""A rig file's text, its numbers, and checks that name the entry they fail on, for every reader."""

from __future__ import annotations

import codecs
import re
import tomllib
import xml.etree.ElementTree as ET
from collections import ChainMap
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor

from ..camera import Camera, View
from ..checks import LARGEST_SIDE, MOST_PIXELS, ROUNDED
from ..distortion import BROWN_CONRADY, COEFFICIENT_COUNTS, KANNALA_BRANDT, Distortion
from ..pixels import HW, shift_matrix
from ..pose import Pose, rotation_error, rotation_from_vector
from ..rig import Rig
from ..runtime.safe_yaml import DEEPEST, LARGEST_TEXT, load_json, load_yaml, text_problem
from ..runtime.text import short
from ..runtime.warned import warn

# Of a rotation vector, in radians; it may go round a few times.
LARGEST_ANGLE = 1e3
K_NAME = r"(m|k|cm|(camera|cam|intrinsics?)?(matrix|mat|mtx)|intrinsics?|camerak)"
LENS_NAME = (
    r"(d|kc|((lens|camera|cam)?dist(ort(ion)?)?|d)(coef|coeff|coefficient|param|parameter|vec|vector|mat"
    r"|matrix|array|value)?s?|coef(f|ficient)?s?)"
)
R_NAME, T_NAME = "(r|rot|rotation)(vector|vec|matrix|mat)?", "(t|trans|translation)(vector|vec|matrix)?"
"""Patterns of the usual names of K, R, t and of a lens's coefficients, in small letters without signs."""
POSE_NAME = r"extrinsics?(matrix|mat)?|rt|w2c|world(to|2)cam(era)?|tcw|tcamworld|cam(era)?fromworld"
"""Pattern of the usual names of a matrix that takes points of the world into the camera's frame."""
PINHOLE_NAMES = tuple(
    rf"(camera|cam)?({name})"
    for name in ("fx|focalx", "fy|focaly", "cx|ppx|principalpointx", "cy|ppy|principalpointy")
)
SIZE_NAMES = tuple(rf"(image|img|im|camera|cam|frame)?({side})" for side in ("width|w", "height|h"))
SIZE_NAME = "(image|img|imager|camera|cam|frame|sensor)?(size|resolution)"
"""Patterns of the usual names of focal lengths and centre one by one, and of the image's size."""
MODEL_NAMES = (
    r"(lens|distortion|dist)(model|type)",
    r"(is)?fisheye(model|lens|camera)?",
    r"(camera|cam|projection)?(model|type)|projection|lens",
)
"""Patterns of the names of a lens's model; the last may be of another thing."""
SUSPECT = re.compile(
    rf"(left|right|[lr])?{LENS_NAME}(left|right|[lr]|\d*)|.*(distort|distcoef|coef|radial|tangential|fisheye"
    r"|dewarp|undist|thinprism|vignetting|hmatrix|blackl|blackc|units?$).*|xi|skew|alphac|is(omni|rectified)"
)
"""Pattern of the names of what may be a lens, a flag or a unit."""
SCALAR = re.compile(r"[kps][1-9]|t[12xy]")
"""Pattern of the names of a lens's numbers where each is an entry."""
HARMLESS = re.compile(
    r".*(err|std|sigma|cov|rms|noise|uncert|optim|name|path|initial|guess|squareunits|label|comment|frame|topic|title|serial).*"
)
BROWN_WORDS = (
    *("plumbbob", "radtan", "radialtangential", "brownconrady", "brown", "opencv", "fullopencv", "rational"),
    *("rationalpolynomial", "perspective", "pinhole", "standard", "radial", "simpleradial", "simplepinhole"),
)
FISHEYE_WORDS = (
    *("equidistant", "equi", "fisheye", "kannalabrandt", "kannalabrandt4", "kannalabrandt8"),
    *("kb4", "kb8", "kb", "opencvfisheye"),
)
LENS_WORD = re.compile(
    "|".join([*BROWN_WORDS[:3], *FISHEYE_WORDS, ".*(fisheye|omni|fov|mei|eucm|sphere|division).*"])
)
BROWN_KEYS, FISHEYE_KEYS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), ("k1", "k2", "k3", "k4")
LARGE_DATA = re.compile(r"\[[^\][]{300000,}\]")
"""Pattern of data that is no camera's, such as a map of a rectification."""
SMALL_TANGENTIAL = 0.01
"""Size above which the tangential coefficients of a lens are more likely a fisheye's third and fourth."""
NO_MAPPING = "is not a mapping of names to values, or an empty one; is the file whole?"


def decoded(content: bytes, errors: str = "replace") -> str:
    """Decode the bytes of a text file: UTF-8, or UTF-16 with a byte order mark, as PowerShell's `>` writes.

    Args:
        errors: treatment of bytes that are no text, as for `bytes.decode`: "strict", "replace", ...

    Returns:
        The text, without a byte order mark.

    Raises:
        UnicodeDecodeError: if `errors` is "strict", for bytes that are no such text.
    """
    utf16 = content[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    return content.decode("utf-16" if utf16 else "utf-8-sig", errors)


class RigFileError(ValueError):
    """Error of a rig file that cannot be read; its text is "file: entry: problem", in one line.

    Attributes:
        path: the file, a Path.
        entry: name of the entry; None for the file as a whole.
    """

    def __init__(self, path: str | Path, entry: str | None, message: str) -> None:
        super().__init__(f"{path}: {entry}: {message}" if entry else f"{path}: {message}")
        self.path, self.entry = Path(path), entry


class UnknownRigFormat(RigFileError):
    """A file that no reader of rig files recognises."""


class RigFileWarning(UserWarning):
    """A rig file that was read but has suspicious values."""


class RigSource:
    """One rig file while it is read; opened only by the methods that read it.

    Attributes:
        path: the file or folder.
        hw: height and width of the images as stated by the user; None if unstated.
        lens: name of the lens model as stated by the user; None if unstated.
        lookups: mappings of the file and of those `beside`, by `id`: (Entry, names looked up in it).
    """

    def __init__(self, path: Path, *, hw: HW | None = None, lens: str | None = None) -> None:
        self.path, self.hw, self.lens = path, hw, lens
        self.lookups: dict[int, tuple[Entry, set[str]]] = {}

    def beside(self, path: Path) -> RigSource:
        """Return another file of the same rig, with the user's statements and shared lookups."""
        source = RigSource(path, hw=self.hw, lens=self.lens)
        source.lookups = self.lookups
        return source

    def warn_of_unread(self) -> None:
        """Give a RigFileWarning for each file with `suspicious` entries that no reader has looked up, of
        mappings that one has looked into; files with the same such entries share one."""
        unread: dict[Path, list[str]] = {}
        for entry, used in self.lookups.values():
            left = [
                key for key, value in entry.value.items() if str(key) not in used and suspicious(key, value)
            ]
            unread.setdefault(entry.source.path, []).extend(entry.at(None, str(key)).name for key in left)
        for path, names in {tuple(names): (path, names) for path, names in reversed(unread.items())}.values():
            if names:
                listed = ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
                warn(
                    f"{path}: {listed}: not read, and may change what the cameras see: state the lens under "
                    "a name that is read, such as distortion_coefficients and distortion_model, or in a file "
                    "of ours (`pat rig convert`); without meaning here, remove it",
                    RigFileWarning,
                )

    def fail(self, entry: str | None, message: str) -> RigFileError:
        """Return the RigFileError to raise about an entry; None for the file as a whole."""
        return RigFileError(self.path, entry, message)

    def warn(self, message: str) -> None:
        """Give a RigFileWarning about the file as a whole."""
        warn(f"{self.path}: {message}", RigFileWarning)

    def at(self, value: Any, name: str = "") -> Entry:
        """Return a value of the file with its name there."""
        return Entry(self, value, name)

    def content(self) -> bytes:
        """Return the file's bytes.

        Raises:
            RigFileError: for a file that is missing or cannot be read, a folder, and a pipe, on which reading
                would wait for ever.
        """
        try:
            if not self.path.is_file() and self.path.exists():
                raise self.fail(None, "is not a file: put the rig's own file there")
            return self.path.read_bytes()
        except OSError as error:
            raise self.fail(None, f"cannot be read: {error.strerror}") from None

    def text(self, most: int | None = None) -> str:
        """Return the file's text.

        Args:
            most: largest number of characters; None for any.

        Raises:
            RigFileError: for a file that cannot be read, is empty or blank, too long, or no text in UTF-8 (or
                UTF-16 with a byte order mark).
        """
        try:
            text = decoded(self.content(), "strict")
        except UnicodeDecodeError:
            raise self.fail(None, "is not text in UTF-8: save it as such") from None
        if not text.strip():
            raise self.fail(None, "is empty")
        if most is not None and len(text) > most:
            raise self.fail(None, f"has {len(text):,} characters; at most {most:,} are read")
        return text

    def json(self) -> Entry:
        """Parse the file as a JSON object that is not empty and has no repeated keys.

        Returns:
            The entry of the whole document, whose value is a mapping.

        Raises:
            RigFileError: for any other file.
        """
        return self._parsed("JSON", load_json, self.text())

    def yaml(self, text: str | None = None) -> Entry:
        """Parse the file as a YAML mapping that is not empty and has no repeated keys.

        Args:
            text: text to parse in place of the file's; None for the file's.

        Returns:
            The entry of the whole document, whose value is a mapping.

        Raises:
            RigFileError: for any other file.
        """
        return self._parsed("YAML", load_yaml, self.text() if text is None else text)

    def xml(self) -> ET.Element:
        """Parse the file as XML; returns the root element.

        Raises:
            RigFileError: for a file that is too large, defines entities, or is no XML, and as `text`.
        """
        text = self.text(LARGEST_TEXT)
        if "<!DOCTYPE" in text or "<!ENTITY" in text:
            raise self.fail(None, "defines entities, which no tool for cameras writes")
        try:
            return ET.fromstring(text)
        except ET.ParseError as error:
            raise self.fail(f"line {error.position[0]}", "is not XML; is the file whole?") from None

    def document(self) -> Entry:
        """Parse a file in JSON, TOML (suffix .toml), XML or YAML, OpenCV's dialects and printed ROS messages
        included.

        Returns:
            The entry of the whole document, whose value is a mapping that is not empty; of several YAML
            documents the first that holds anything, with large pictures and maps emptied.

        Raises:
            RigFileError: for any other file.
        """
        text = self.text(LARGEST_TEXT)
        first = text.lstrip()[0]
        if first == "{":
            return self.json()
        if self.path.suffix == ".toml":
            return self._parsed("TOML", tomllib.loads, text)
        if first == "<":
            return self.at(_value_of_xml(self.at(self.xml()))).mapping()
        text = LARGE_DATA.sub("[]", re.sub(r"^%YAML.*|!!opencv[\w-]+", "", text, flags=re.M))
        documents = re.split(r"^(?:---|\.\.\.)", text, flags=re.M)
        return self.yaml(next((one for one in documents if re.search(r"^\s*[^#\s]", one, re.M)), ""))

    def _parsed(self, kind: str, load: Callable[[str], Any], text: str) -> Entry:
        try:
            document = load(text)
        except (ValueError, RecursionError, yaml.YAMLError) as error:
            line, problem = text_problem(error)
            raise self.fail(
                f"line {line}" if line else None, f"is not {kind} ({problem}); is the file whole?"
            ) from None
        return self.at(document).mapping()

    def files(self, pattern: str) -> list[RigSource]:
        """Return the files of a folder whose names match, in order; of a file itself."""
        inside = sorted(path for path in self.path.glob(pattern) if path.is_file())
        paths = inside if self.path.is_dir() else [self.path]
        return [self.beside(path) for path in paths]

    def lines(self, separator: str, pattern: str) -> Entry:
        """Parse a text of lines "name separator numbers", such as "P0: 721 0 609 ...".

        Args:
            separator: text between name and numbers, such as ":".
            pattern: regular expression of whole names whose values are numbers. Their values may be in
                brackets, with commas and semicolons.

        Returns:
            The entry of a mapping, empty for no such lines: for names that the pattern matches vectors of
            numbers, float64, for others the text of the last such line.

        Raises:
            RigFileError: for such a name that occurs twice, or whose values are no finite numbers, and as
                `text`.
        """
        entries: dict[str, Tensor | str] = {}
        for line in self.text().splitlines():
            name, separated, value = (text.strip() for text in line.partition(separator))
            if not separated or not re.fullmatch(pattern, name):
                entries |= {name: value} if separated else {}
                continue
            if name in entries:
                raise self.fail(name, "occurs twice; keep one")
            if value.startswith("[") and not value.endswith("]"):
                raise self.fail(name, "has no closing bracket; is the file whole?")
            if value.startswith("["):
                value = re.sub("[;,]", " ", value[1:-1])
            entries[name] = self.at(value, name).numbers()
        return self.at(entries)

    def size_unstated(self, K: Tensor | None) -> HW:
        """Return the image size for a file that states none: the user's, else twice the principal point, with
        a warning.

        Args:
            K: intrinsic matrix in our pixels; None if it depends on the size.

        Returns:
            Height and width in pixels.

        Raises:
            RigFileError: if the user states no size and K is None.
        """
        if self.hw is not None:
            return self.hw
        if K is None:
            raise self.fail(
                "w, h",
                "are not stated, the images' size: give it by `pat rig convert --size W H`, or read_rig's hw",
            )
        w, h = (max(1, round(2 * c + 1)) for c in K[:2, 2].tolist())
        self.warn(
            f"states no image size: took {w} x {h}, twice the principal point; give it by "
            "`pat rig convert --size W H`, or `arraygeom.io.read_rig(path, hw=(height, width))`"
        )
        return h, w

    def rig(self, cameras: Iterable[tuple[str, View]], **fields: Any) -> Rig:
        """Make the rig of named cameras.

        Args:
            cameras: names and cameras, in the rig's order.
            fields: further fields of the rig, such as `depth`.

        Raises:
            RigFileError: for no camera, a name that occurs twice, and what `Rig` refuses.
        """
        named: dict[str, View] = {}
        for name, camera in cameras:
            if name in named:
                raise self.fail(name, "occurs twice; give every camera its own name")
            named[name] = camera
        if not named:
            raise self.fail(None, "holds no camera; is the file whole?")
        try:
            return Rig(named, **fields)
        except ValueError as error:
            raise self.fail(None, str(error)) from None


class Entry:
    """Value in a rig file with its name there; its methods raise RigFileErrors that name file and entry.

    Attributes:
        source: the file.
        value: the value as parsed; None for an entry that is missing.
        name: name in the file, after the names of the mappings around it; empty for the whole document.
    """

    def __init__(self, source: RigSource, value: Any, name: str) -> None:
        self.source, self.value, self.name = source, value, name

    def fail(self, message: str) -> RigFileError:
        """Return the RigFileError to raise about the value."""
        return self.source.fail(self.name or None, message)

    def at(self, value: Any, name: str) -> Entry:
        """Return a value within this one, with its name there."""
        return Entry(self.source, value, f"{self.name}.{name}" if self.name else name)

    def mapping(self) -> Entry:
        """Return this entry; RigFileError unless it is a mapping that is not empty."""
        if not self._named():
            raise self.fail(NO_MAPPING)
        return self

    def _named(self) -> Mapping[Any, Any]:
        """Return the value; RigFileError unless it is a mapping."""
        if not isinstance(self.value, Mapping):
            raise self.fail(NO_MAPPING)
        return self.value

    def __contains__(self, key: str) -> bool:
        return key in self._named()

    def __getitem__(self, keys: str | tuple[str, ...]) -> Entry:
        """Return the entry under the first of the keys that is there and not None; RigFileError for none."""
        keys = (keys,) if isinstance(keys, str) else keys
        for key in keys:
            self.use(key)
            if (value := self._named().get(key)) is not None:
                return self.at(value, key)
        raise self.fail(f"has no {' or '.join(keys)}")

    def get(self, key: str, default: Any = None) -> Entry:
        """Return the entry under a key, or the default; RigFileError unless this is a mapping."""
        self.use(key)
        return self.at(self._named().get(key, default), key)

    def use(self, *keys: Any) -> None:
        """Note that keys (by default all) are read, or left out for a reason: see `warn_of_unread`."""
        keys = keys or tuple(self._named())
        for mapping in getattr(self._named(), "maps", [self.value]):
            entry = Entry(self.source, mapping, self.name)
            self.source.lookups.setdefault(id(mapping), (entry, set()))[1].update(map(str, keys))

    def items(self) -> list[tuple[str, Entry]]:
        """Return all names and entries of a mapping; RigFileError unless this is one."""
        self.use()
        return [(str(key), self.at(value, str(key))) for key, value in self._named().items()]

    def find(self, name: str, side: str = "") -> Entry:
        """Find the entry of a mapping whose name matches a pattern, and note it as read (`use`).

        Names are compared in lower case without punctuation, as `plain` returns them. Entries that are None
        do not count, nor single numbers named as one coefficient of a lens, such as k1.

        Args:
            name: regular expression of such a name.
            side: camera of a stereo pair that the name must state: "1" for the left one ("left", "l", "1"),
                "2" for the right one; another end of the name; "" for names that state none.

        Returns:
            The entry; its value is None if no name matches.

        Raises:
            RigFileError: if two names match whose values differ, and unless this is a mapping.
        """
        ends = {"1": ("left|l", "1"), "2": ("right|r", "2")}.get(side)
        name = f"({name})"
        one = f"({ends[0]}){name}|{name}({ends[0]}|{ends[1]})" if ends else name + re.escape(side)
        keys = [
            key
            for key, value in self._named().items()
            if re.fullmatch(one, plain(key))
            and value is not None
            and not (SCALAR.fullmatch(plain(key).removeprefix("camera")) and single(value))
        ]
        for key in keys[1:]:
            if str(self.value[key]) != str(self.value[keys[0]]):
                raise self.at(None, key).fail(f"and {keys[0]} are of the same camera, and differ: keep one")
        if keys:
            self.use(*keys)
        return self.at(self.value[keys[0]], keys[0]) if keys else self.at(None, "")

    def model(self, side: str = "") -> Entry:
        """Find the entry that names the lens model.

        Of names that may be of another thing, as "model", only the name of a lens model counts.

        Args:
            side: camera of a stereo pair, as for `find`; names without a side serve too.

        Returns:
            The entry, a word or a flag of fisheyes; its value is None if there is none.

        Raises:
            RigFileError: as `find`.
        """
        for name in MODEL_NAMES:
            for which in dict.fromkeys((side, "")):
                word, sure = self.find(name, which), name != MODEL_NAMES[-1]
                if word.value is not None and (sure or LENS_WORD.fullmatch(plain(word.value))):
                    return word
        return self.at(None, "")

    def sized(self, *keys: str, K: Tensor | None, side: str = "") -> HW:
        """Return the image size under two keys (width, height), or under one that holds both.

        Args:
            keys: the two keys, or the one; none for the usual names.
            K: intrinsic matrix in our pixels, for a file that states no size (`size_unstated`); None if K
                itself depends on the size.
            side: as of `find`, for the usual names; names without a side serve too.

        Returns:
            Height and width in pixels; by `size_unstated` if they are not both stated.

        Raises:
            RigFileError: for a size that is not positive and whole, or too large; as `find` and
                `size_unstated`.
        """
        usual = (
            [] if keys else [(names, which) for which in (side, "") for names in (SIZE_NAMES, [SIZE_NAME])]
        )
        choices = [[self.find(name, which) for name in names] for names, which in usual]
        for found in choices or [[self.get(key) for key in keys]]:
            if all(entry.value is not None for entry in found):
                return self.joined(found).size()
        return self.source.size_unstated(K)

    def K(self, side: str = "") -> Tensor:
        """Return the intrinsic matrix under a usual name: of a matrix, or of focal lengths and centre as four
        numbers or one by one.

        Args:
            side: as of `find`.

        Returns:
            K (3, 3), float64, of pixels as the file counts them.

        Raises:
            RigFileError: if there is none, and as `find` and `intrinsics`.
        """
        entry, parts = self.find(K_NAME, side), [self.find(name, side) for name in PINHOLE_NAMES]
        if entry.value is not None:
            return entry.focal_and_centre() if entry.numbers().numel() == 4 else entry.intrinsics()
        if any(part.value is None for part in parts):
            raise self.fail(f"has no matrix of intrinsics: wanted camera_matrix{side}, or fx, fy, cx, cy")
        return self.joined(parts).focal_and_centre()

    def usual_lens(self, side: str = "") -> Distortion | None:
        """Return the lens of coefficients under a usual name, or of k1, k2, p1, p2 ... one by one.

        One by one, if neither file nor user names a model, k4 without p1 and p2 means a Kannala-Brandt
        fisheye, else they are Brown-Conrady's.

        Args:
            side: as of `find`; one by one they are found for "" alone.

        Returns:
            The lens; None for a pinhole, with a warning if the file states no coefficients.

        Raises:
            RigFileError: as `find` and `of_model`.
        """
        entry, word = self.find(LENS_NAME, side), self.model(side)
        fields = entry if entry.is_table else self
        keys = {re.sub("^cam(era)?", "", plain(key)): key for key in fields.value} if not side else {}
        if "k1" not in keys or (entry.value is not None and not entry.is_table):
            return entry.of_model(word)
        said, wanted = _said(word), self.source.lens
        without_model = "k4" in keys and not {"p1", "p2"} & {*keys}
        fisheye = said in FISHEYE_WORDS or (
            said is None and (wanted == KANNALA_BRANDT if wanted else without_model)
        )
        names = FISHEYE_KEYS if fisheye else BROWN_KEYS
        c = [fields.get(keys[name]).number() if name in keys else 0.0 for name in names]
        listed = fields.at(c if any(c[5:]) else c[:5], ", ".join(name for name in names if name in keys))
        if said is not None or wanted:
            return listed.of_model(word)
        return listed.kannala_brandt() if fisheye else listed.brown_conrady()

    def camera(self, pose: Pose | None = None, *, side: str = "", **stated: Any) -> Camera:
        """Return a camera of the given parts; others (no sensor) are found under their usual names.

        Args:
            pose: pose in the world; None to find it.
            side: as of `find`.
            stated: K, hw, distortion or sensor as of `Camera`.

        Raises:
            RigFileError: for a camera without K, or without a pose, and as the methods that find its parts.
            ValueError: also as `Camera` raises it.
        """
        if "K" not in stated and (inner := self.find(K_NAME, side)).is_table:
            self.use()
            rest = {key: value for key, value in self.value.items() if value is not inner.value}
            return Entry(self.source, ChainMap(inner.value, rest), self.name).camera(pose, **stated)
        K = stated.pop("K") if "K" in stated else self.K(side)
        hw = stated.pop("hw") if "hw" in stated else self.sized(K=K, side=side)
        lens = stated.pop("distortion") if "distortion" in stated else self.usual_lens(side)
        pose = self.pose(side) if pose is None else pose
        if pose is None:
            raise self.fail("has no R and t, from the world into the camera: state them")
        return Camera(K=K, cam_from_world=pose, hw=hw, distortion=lens, **stated)

    def pose(self, side: str = "") -> Pose | None:
        """Return the pose by R and t, or by a matrix from the world into the camera, under usual names.

        Args:
            side: as of `find`.

        Returns:
            The pose X' = R X + t in the file's unit; None if neither is there.

        Raises:
            RigFileError: for one of R and t without the other, and as `find`, `pose_of` and `pose_matrix`.
        """
        R, t, both = (self.find(name, side) for name in (R_NAME, T_NAME, POSE_NAME))
        if both.value is not None and R.value is None:
            return both.pose() if both.is_table else both.pose_matrix()
        if (R.value is None) != (t.value is None):
            raise self.fail(f"has {R.name or t.name} and no {'R' if R.value is None else 't'}: state both")
        return None if R.value is None else pose_of(R, t)

    @property
    def has_K(self) -> bool:
        """True for a mapping with a usual name of K, or of a focal length."""
        return any(self.find(name).value is not None for name in (K_NAME, PINHOLE_NAMES[0]))

    @property
    def is_table(self) -> bool:
        """True for a mapping of names, which is no matrix of OpenCV's or ROS'."""
        return isinstance(self.value, Mapping) and "data" not in self.value

    def each(self) -> list[Entry]:
        """Return the parts of a list; RigFileError unless this is one that is not empty."""
        if not isinstance(self.value, list) or not self.value:
            raise self.fail("is no list, or an empty one; is the file whole?")
        return [Entry(self.source, value, f"{self.name}[{i}]") for i, value in enumerate(self.value)]

    def listed(self, *keys: str) -> Entry:
        """Return the values of a mapping under these keys, as one list; RigFileError if one is missing."""
        return self.joined([self[key] for key in keys])

    def joined(self, entries: Sequence[Entry]) -> Entry:
        """Return entries of this mapping as one list; one alone as it is."""
        names = ", ".join(entry.name.removeprefix(f"{self.name}.") for entry in entries)
        return entries[0] if len(entries) == 1 else self.at([entry.value for entry in entries], names)

    def tensor(self, *, infinite: bool = False, also: str = "") -> Tensor:
        """Return the numbers, nested in lists or not, as a float64 tensor.

        Args:
            infinite: True to accept infinite numbers.
            also: end of the message for other values.

        Returns:
            Tensor of the list's shape (`data`'s, of OpenCV's and ROS' matrices); of no axes for one number, a
            vector for text with numbers.

        Raises:
            RigFileError: for NaN, infinity unless accepted, and values that are no numbers.
        """
        value = self.value
        if isinstance(value, Mapping) and "data" in value:  # OpenCV's and ROS' matrices
            value = value["data"]
        if isinstance(value, str) or (isinstance(value, list) and any(isinstance(x, str) for x in value)):
            value = _spaced(value)
        tensor = float64_of(value)
        if tensor is None:
            raise self.fail(f"holds something other than numbers: {short(self.value)}{also}")
        if tensor.isnan().any() or (tensor.isinf().any() and not infinite):
            raise self.fail("holds NaN or infinity; did the calibration fail?")
        return tensor

    def numbers(self, shape: tuple[int, ...] | None = None, *, infinite: bool = False) -> Tensor:
        """Return the numbers, float64, as a tensor of a shape (from any nesting of as many), or as a vector.

        Args:
            shape: wanted shape; None for a vector of any length.
            infinite: True to accept infinite numbers.

        Raises:
            RigFileError: for another number of numbers, and as `tensor`.
        """
        wanted = "" if shape is None else f", wanted {' x '.join(map(str, shape))}"
        tensor = self.tensor(infinite=infinite, also=wanted)
        if shape is not None and tensor.numel() != torch.Size(shape).numel():
            raise self.fail(f"has {tensor.numel()} numbers{wanted}; is the file whole?")
        return tensor.reshape(shape or (-1,))

    def number(self) -> float:
        """Return one finite number; RigFileError for anything else."""
        return float(self.numbers((1,)))

    def transposed(self, side: int) -> Entry:
        """Return a square matrix column by column; RigFileError for another number of numbers."""
        return Entry(self.source, self.numbers((side, side)).T, self.name)

    def size(self) -> HW:
        """Return (height, width) from two numbers, width first, in pixels.

        Raises:
            RigFileError: for other numbers than two, not positive, not whole, or too large.
        """
        w, h = self.numbers((2,)).tolist()
        if min(w, h) < 1 or w != int(w) or h != int(h):
            raise self.fail(f"is {w:g} x {h:g}, wanted an image's width x height in whole pixels")
        if max(h, w) > LARGEST_SIDE or h * w > MOST_PIXELS:
            raise self.fail(
                f"is {w:.0f} x {h:.0f}; images of up to {LARGEST_SIDE} pixels a side and "
                f"{MOST_PIXELS / 1e6:.0f} million in all are supported: is it in pixels?"
            )
        return int(h), int(w)

    def intrinsics(self, first_pixel: float = 0.0) -> Tensor:
        """Return the intrinsic matrix K, converted to pixels whose first centre is (0, 0).

        Args:
            first_pixel: coordinate of the first pixel's centre in the file, such as 0.5 or 1.

        Returns:
            K (3, 3), float64.

        Raises:
            RigFileError: for another last row or focal lengths that are not positive, and as `numbers`.
        """
        K = self.numbers((3, 3))
        if K[2].tolist() != [0.0, 0.0, 1.0]:
            raise self.fail(f"has last row {short(K[2].tolist())}, wanted [0, 0, 1]; is it transposed?")
        if not (K[0, 0] > 0 and K[1, 1] > 0):
            raise self.fail(f"has focal lengths {K[0, 0]:g} and {K[1, 1]:g}; they are positive, in pixels")
        return shift_matrix(first_pixel, first_pixel) @ K

    def focal_and_centre(self, first_pixel: float = 0.0, skew: float = 0.0) -> Tensor:
        """Return K from [fx, fy, cx, cy], with the first pixel's centre moved from `first_pixel` to 0.

        Raises:
            RigFileError: as `intrinsics`.
        """
        fx, fy, cx, cy = self.numbers((4,)).tolist()
        K = [[fx, skew, cx], [0, fy, cy], [0, 0, 1]]
        return Entry(self.source, K, self.name).intrinsics(first_pixel)

    def rotation(self) -> Tensor:
        """Return a rotation matrix from nine numbers, or three (a rotation vector in radians).

        A deviation below 1e-3, as rounding in text files makes, is removed (nearest rotation).

        Returns:
            Matrix (3, 3), float64.

        Raises:
            RigFileError: for other matrices, vectors with a number above `LARGEST_ANGLE`, and another number
                of numbers.
        """
        numbers = self.numbers()
        if numbers.numel() == 3:
            if numbers.abs().max() > LARGEST_ANGLE:
                raise self.fail(f"is a rotation vector of {numbers.abs().max():.3g}; it is in radians")
            return rotation_from_vector(numbers)
        if numbers.numel() != 9:
            raise self.fail(f"has {numbers.numel()} numbers, wanted 3 x 3, or 3 of a rotation vector")
        R = numbers.reshape(3, 3)
        error = float(rotation_error(R))
        if torch.linalg.det(R) < 0:
            raise self.fail("is a reflection (determinant -1), not a rotation; was an axis flipped?")
        if error > ROUNDED:
            raise self.fail(f"is not a rotation (R R^T is off by {error:.2g}); were all rows copied?")
        U, _, Vh = torch.linalg.svd(R)
        return R if error < 1e-12 else U @ Vh

    def pose_matrix(self, metres: float = 1.0) -> Pose:
        """Return the pose of a 4 x 4 or 3 x 4 matrix (R, t).

        Args:
            metres: length of the file's unit, metres; 1 leaves t in that unit.

        Returns:
            The pose X' = R X + t, with t in metres.

        Raises:
            RigFileError: for another last row, a matrix that is no rotation, and another number of numbers.
        """
        M = self.numbers((3, 4) if self.numbers().numel() == 12 else (4, 4))
        if len(M) == 4 and (M[3] - M.new_tensor([0, 0, 0, 1])).abs().max() > 1e-9:
            raise self.fail(f"has last row {short(M[3].tolist())}, wanted [0, 0, 0, 1]; is it transposed?")
        return Pose(Entry(self.source, M[:3, :3], self.name).rotation(), M[:3, 3] * metres)

    def brown_conrady(self) -> Distortion | None:
        """Return a Brown-Conrady lens from OpenCV's coefficients, zero-padded to a number the model has.

        Returns:
            The lens; None if all coefficients are 0, or none are stated.

        Raises:
            RigFileError: for more than 14 that are not all 0, and as `numbers`.
        """
        c = torch.zeros(0) if self.value is None else self.numbers()
        if not c.any():
            return None
        if c.numel() > 14:
            raise self.fail(f"has {c.numel()} coefficients; OpenCV's model has at most 14")
        count = next(n for n in (4, 5, 8, 12, 14) if n >= c.numel())
        return Distortion(BROWN_CONRADY, torch.nn.functional.pad(c, (0, count - c.numel())))

    def kannala_brandt(self) -> Distortion:
        """Return a Kannala-Brandt fisheye (of zeros too) from one to four coefficients, zero-padded to four.

        Raises:
            RigFileError: for another number of them, and as `numbers`.
        """
        c = self.numbers()
        if not 1 <= c.numel() <= 4:
            raise self.fail(f"has {c.numel()} coefficients; the fisheye model has 4 (k1 k2 k3 k4)")
        return Distortion(KANNALA_BRANDT, torch.nn.functional.pad(c, (0, 4 - c.numel())))

    def of_model(self, word: Entry) -> Distortion | None:
        """Return the lens of this entry's coefficients and of the model that another one names.

        Where it names none, the model is the user's (which goes before "none", too), else Brown-Conrady, but
        for four numbers, which a fisheye has too, the one that fits, with a warning unless all are 0.

        Args:
            word: entry with the model's name or a flag of fisheyes; its value is None if there is none.

        Returns:
            The lens; None for a pinhole: the file's "none", an empty list, coefficients that are not stated
            (with a warning), and Brown-Conrady's that are all 0.

        Raises:
            RigFileError: for an unknown model, one that contradicts the user's, a fisheye whose coefficients
                are not stated, "none" with some that are not 0, and as `lens`.
        """
        said = _said(word)
        wanted, none = self.source.lens, said in ("", "none")
        model = BROWN_CONRADY if said in BROWN_WORDS else KANNALA_BRANDT if said in FISHEYE_WORDS else wanted
        if said and not none and said not in [*BROWN_WORDS, *FISHEYE_WORDS]:
            supported = "plumb_bob, radtan, rational_polynomial; equidistant, fisheye"
            raise word.fail(f"is '{word.value}', which is not read: {supported} are")
        if said and wanted not in (None, model):
            raise word.fail(f"is '{word.value}', which is not {wanted}: leave the model out of the command")
        c = None if self.value is None else self.numbers()
        if none and c is not None and c.any() and wanted is None:
            raise word.fail(f"is '{word.value}', and there are coefficients ({self.name}): state their model")
        if c is None and said and model == KANNALA_BRANDT:
            raise word.fail(
                f"is '{word.value}', and no coefficients are found, such as distortion_coefficients"
            )
        if (none and wanted is None) or (c is not None and not len(c)):
            return None
        if c is None:
            self.source.warn(
                "states no lens, such as distortion_coefficients: taken as a pinhole; if it is, state zeros"
            )
            return None
        if model is None:
            tangential = float(c[2:4].abs().max()) if len(c) == 4 else 0.0
            model = KANNALA_BRANDT if tangential > SMALL_TANGENTIAL else BROWN_CONRADY
            if len(c) == 4 and c.any():
                other = BROWN_CONRADY if model == KANNALA_BRANDT else KANNALA_BRANDT
                self.source.warn(
                    f"{self.name}: four coefficients whose model is not stated: took {model}"
                    f" (the third and fourth are up to {tangential:.2g}). If they are of the other kind, "
                    f"`pat rig convert --lens {other}`, or read_rig's lens='{other}'"
                )
        if model == KANNALA_BRANDT and len(c) > 4 and not c[4:].any():
            return Entry(self.source, c[:4], self.name).kannala_brandt()  # padded by some tools
        return self.lens(model)

    def lens(self, model: str) -> Distortion | None:
        """Return a lens of a named model from the entry's coefficients.

        Models other than Brown-Conrady and Kannala-Brandt need all of them, within their bounds.

        Args:
            model: name of a model of `Distortion`.

        Returns:
            The lens; None for a Brown-Conrady lens whose coefficients are all 0.

        Raises:
            RigFileError: for coefficients that the model cannot have, and as `numbers`.
            KeyError: for another model.
        """
        if model in (BROWN_CONRADY, KANNALA_BRANDT):
            return self.brown_conrady() if model == BROWN_CONRADY else self.kannala_brandt()
        c = self.numbers((COEFFICIENT_COUNTS[model][0],))
        lens = Distortion(model, c)
        if not lens.project(c.new_tensor([0.0, 0.0, 1.0]))[1]:
            raise self.fail(f"is {short(c.tolist())}, which no {model} lens has; was the calibration good?")
        return lens


def plain(key: Any) -> str:
    """Return a name in small letters without signs."""
    return re.sub(r"[\W_]", "", str(key).lower())


def single(value: Any) -> bool:
    """Return True if a value is a number by itself."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def suspicious(key: Any, value: Any) -> bool:
    """Return True if an entry that is not read may matter: a lens or a flag by its name that is not None, 0,
    False or empty, a text that names a lens model, or a unit that is not pixels.

    Names of errors, labels, files and the like never count.
    """
    name = plain(key)
    if value is None or HARMLESS.fullmatch(name):
        return False
    if isinstance(value, str) and not re.fullmatch(r"[-+\d.eE,\s]+", value):
        word = plain(value)
        return bool(LENS_WORD.fullmatch(word)) or (
            name.endswith(("unit", "units")) and word[:1] not in ("", "p")
        )
    if isinstance(value, Mapping):
        return bool(re.fullmatch(rf"(lens|{LENS_NAME}).?", name)) and bool(value)
    if isinstance(value, str):
        value = _spaced(value.replace(",", " "))
    if SCALAR.fullmatch(name):
        return value != 0 if single(value) else isinstance(value, list) and len(value) == 1 and value[0] != 0
    numbers = None if isinstance(value, bool) else float64_of(value)
    return bool(SUSPECT.fullmatch(name)) and bool(value if numbers is None else numbers.any())


def pose_of(R: Entry, t: Entry, metres: float = 1.0) -> Pose:
    """Return the pose X_to = R X_from + t with t given in units of `metres`.

    Raises:
        RigFileError: for a matrix that is no rotation, or another number of numbers.
    """
    return Pose(R.rotation(), t.numbers((3,)) * metres)


def float64_of(value: Any) -> Tensor | None:
    """Return numbers, nested in lists or not, as a float64 tensor; None for others, such as true or text."""
    if _has_truth(value):
        return None
    try:
        return torch.as_tensor(value, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError):
        return None


def _said(word: Entry) -> str | None:
    """Return the name of a lens model in small letters, also of a flag of fisheyes; None for none."""
    if word.value is None or isinstance(word.value, str):
        return None if word.value is None else plain(word.value)
    return "fisheye" if word.value else "brown"


def _spaced(value: str | list[Any]) -> list[float] | None:
    """Return the numbers of a text, or of several, between spaces; None for other words."""
    words = (value if isinstance(value, str) else " ".join(map(str, value))).split()
    try:
        return [float(re.sub(r"^([-+]?)\.(?=[a-zA-Z])", r"\1", word)) for word in words]  # YAML's .nan
    except ValueError:
        return None


def _value_of_xml(entry: Entry, depth: int = 0) -> Any:
    """Return what OpenCV's XML holds: mappings, lists, numbers, texts."""
    if depth > DEEPEST:
        raise entry.source.fail(None, f"is nested more than {DEEPEST} deep")
    parts = list(entry.value)
    if not parts:
        text = (entry.value.text or "").strip().strip('"')
        numbers = _spaced(text)
        return numbers[0] if numbers and len(numbers) == 1 else text
    if all(part.tag == "_" for part in parts):
        return [_value_of_xml(entry.at(part, str(i)), depth + 1) for i, part in enumerate(parts)]
    values: dict[str, Any] = {}
    for part in parts:
        if part.tag in values:
            raise entry.at(None, part.tag).fail("occurs twice; keep one")
        values[part.tag] = _value_of_xml(entry.at(part, part.tag), depth + 1)
    return values


def _has_truth(value: Any) -> bool:
    return isinstance(value, bool) or (isinstance(value, list | tuple) and any(map(_has_truth, value)))
