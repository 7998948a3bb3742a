"""Sixty inputs that are wrong without looking so, and what `pat fuse` says of each: `make mistakes`.

All are the sample array at half its size with one thing wrong. Each is fused by the command; the table has
its exit status and what it said, without what it says of every frame. An input that passes without a word
stands there as such, with the reason. Exit status 1 if more than three do.
"""

from __future__ import annotations

import contextlib
import io
import re
import sys
import tempfile
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
import yaml

from pat.app.cli.main import main as pat
from pat.app.cli.parser import script
from pat.app.sample_array import SAMPLE
from pat.lab.evaluation.tables import markdown_row
from pat.support.folders import printable

from .printed import head

Image = Any
Change = Callable[["Array"], object]
USUAL = re.compile(
    r"plan: |weights: |network: |written to |to see|compiling|fusing: |finding |comparing |no depth"
)
"""Lines that a command prints for right inputs too."""
LONGEST = 230
"""Characters of what is said that the table has."""
BEGIN, END = "<!-- mistakes:begin -->\n", "<!-- mistakes:end -->\n"


class Array:
    """The sample array's images and rig at half their size, to be made wrong; `words` are the command's."""

    def __init__(self) -> None:
        self.images = {
            n: cv2.imread(str(SAMPLE / f"{n}.png"), -1)[::2, ::2].copy() for n in ("mono", "colour")
        }
        self.rig = yaml.safe_load((SAMPLE / "rig.yaml").read_text())
        self.words: list[str] = []
        self.files: dict[str, bytes] = {}
        for name, camera in self.rig["cameras"].items():
            camera["size"] = [*self.images[name].shape[1::-1]]
            camera["focal"] = [f / 2 for f in camera["focal"]]
            camera["centre"] = [c / 2 for c in camera["centre"]]

    def camera(self, name: str = "colour") -> dict[str, Any]:
        """Entries of a camera in the rig file."""
        return self.rig["cameras"][name]

    def image(self, name: str, change: Callable[[Image], Image]) -> Image:
        """Change an image's values, 0 to 255, or to 65535 if they have 16 bits; return it."""
        self.images[name] = change(self.images[name])
        return self.images[name]

    def arguments(self, folder: Path) -> list[str]:
        """The command's, once all files are written."""
        (folder / "rig.yaml").write_text(yaml.safe_dump(self.rig))
        for name, image in self.images.items():
            if f"{name}.png" not in self.files:
                cv2.imwrite(str(folder / f"{name}.png"), image)
        for name, content in self.files.items():
            (folder / name).write_bytes(content)
        images = [str(folder / f"{name}.png") for name in self.images]
        words = [word.replace("{}", str(folder)) for word in self.words]
        return [
            "fuse",
            str(folder / "rig.yaml"),
            "--alpha",
            "mono",
            *images,
            "--out",
            str(folder / "out"),
            *words,
        ]


def entry(name: str = "colour", **values: Any) -> Change:
    """Entries of a camera that are other ones."""
    return lambda a: a.camera(name).update(values)


def scaled(key: str, factor: float, *names: str) -> Change:
    """Numbers of cameras times a factor."""
    return lambda a: [
        a.camera(n).update({key: [v * factor for v in a.camera(n)[key]]}) for n in names or ("colour",)
    ]


def turned(degrees: float, axis: int = 1) -> Change:
    """The colour camera turned about an axis."""

    def change(a: Array) -> None:
        turn = cv2.Rodrigues(np.eye(3)[axis] * np.radians(degrees))[0]
        a.camera()["rotation"] = (turn @ np.array(a.camera()["rotation"])).tolist()

    return change


def shown(name: str, change: Callable[[Image], Image]) -> Change:
    """Another image of a camera."""
    return lambda a: a.image(name, change)


def words(*given: str, depth: Callable[[Image], Image] | None = None) -> Change:
    """Further words of the command; a depth map beside the images, changed."""

    def change(a: Array) -> None:
        a.words += given
        if depth is not None:
            rows = np.linspace(8, 2, 200, dtype=np.float32)[:, None]
            file = io.BytesIO()
            tifffile.imwrite(file, np.ascontiguousarray(depth(np.tile(rows, (1, 320)))))
            a.files["depth.tif"] = file.getvalue()

    return change


def rolled(image: Image) -> Image:
    """Every other row from elsewhere, as of an interlaced video."""
    image = image.copy()
    image[1::2] = np.roll(image, 8, 1)[1::2]
    return image


def covered(image: Image) -> Image:
    """A third that something is before."""
    image = image.copy()
    image[:, : image.shape[1] // 3] = 0
    return image


def lit(image: Image) -> Image:
    """Light from elsewhere: bright and dark by place."""
    light = cv2.resize(
        np.random.default_rng(0).random((5, 6)) ** 2 * 3, image.shape[1::-1], interpolation=cv2.INTER_CUBIC
    )
    return np.clip(image * (light if image.ndim == 2 else light[..., None]), 0, 255).astype(np.uint8)


def noisy(image: Image) -> Image:
    """Noise of 20 counts."""
    return np.clip(image + np.random.default_rng(0).normal(0, 20, image.shape), 0, 255).astype(np.uint8)


def deep(bits: int, gain: float = 1.0) -> Callable[[Image], Image]:
    """Counts of so many bits, stored in 16."""
    return lambda image: np.clip(image * gain / 255 * (2**bits - 1), 0, 2**bits - 1).astype(np.uint16)


def stored(name: str, suffix: str, damage: int = 0, *options: int) -> Change:
    """An image in another format under its own name, with bytes of its middle changed."""

    def change(a: Array) -> None:
        content = bytearray(cv2.imencode(suffix, a.images[name], options)[1].tobytes())
        for place in np.random.default_rng(1).integers(len(content) // 4, len(content) * 3 // 4, damage):
            content[place] ^= 0x55
        a.files[f"{name}.png"] = bytes(content)

    return change


def exchanged(a: Array) -> None:
    """The two cameras' places."""
    a.camera("mono")["translation"], a.camera()["translation"] = (
        a.camera()["translation"],
        a.camera("mono")["translation"],
    )


MISTAKES: dict[str, Change] = {
    "colour image with red and blue exchanged": shown("colour", lambda i: i[..., ::-1]),
    "colour image with red and green exchanged": shown("colour", lambda i: i[..., [0, 2, 1]]),
    "colour image upside down": shown("colour", lambda i: i[::-1]),
    "colour image mirrored": shown("colour", lambda i: i[:, ::-1]),
    "colour image turned by half": shown("colour", lambda i: i[::-1, ::-1]),
    "colour image shifted by 12 pixels": shown("colour", lambda i: np.roll(i, 12, 0)),
    "alpha's image upside down": shown("mono", lambda i: i[::-1]),
    "negative colours": shown("colour", lambda i: 255 - i),
    "colour image of something else": shown("colour", lambda i: np.random.default_rng(0).permutation(i)),
    "colour image interlaced": shown("colour", rolled),
    "alpha's image interlaced": shown("mono", rolled),
    "a third of the colour image black": shown("colour", covered),
    "a third of alpha's image black": shown("mono", covered),
    "colour image in other light": shown("colour", lit),
    "colour image of one colour": shown("colour", lambda i: np.full_like(i, 128)),
    "alpha's image of one value": shown("mono", lambda i: np.full_like(i, 128)),
    "colour image in grey": shown("colour", lambda i: i[..., [1, 1, 1]]),
    "alpha saturated": shown("mono", lambda i: np.clip(i * 3.0, 0, 255).astype(np.uint8)),
    "colour saturated": shown("colour", lambda i: np.clip(i * 4.0, 0, 255).astype(np.uint8)),
    "alpha a twentieth as bright": shown("mono", lambda i: (i / 20).astype(np.uint8)),
    "noise of 20 counts in both": lambda a: [a.image(n, noisy) for n in a.images],
    "colour image blurred by 9 pixels": shown("colour", lambda i: cv2.blur(i, (9, 9))),
    "the same image twice": lambda a: a.images.update(colour=cv2.resize(a.images["mono"], (280, 180))),
    "12 bits in 16, unsaid": shown("mono", deep(12)),
    "14 bits in 16, unsaid": shown("mono", deep(14)),
    "12 bits in 16, `bits: 14`": lambda a: (a.image("mono", deep(12, 1.5)), a.camera("mono").update(bits=14)),
    "12 bits in 16, `bits: 10`": lambda a: (a.image("mono", deep(12)), a.camera("mono").update(bits=10)),
    "8 bits, `bits: 12`": entry("mono", bits=12),
    "`response: RGB`": entry(response="RGB"),
    "`response: blue` of a colour camera": entry(response="blue"),
    "`bayer: BGGR` of a finished image": entry(bayer="BGGR"),
    "`coding: linear` of an ordinary image": entry("mono", coding="linear"),
    "exposures in milliseconds and seconds": lambda a: (
        entry("mono", exposure=10.0)(a),
        entry(exposure=0.01)(a),
    ),
    "exposures in seconds and milliseconds": lambda a: (
        entry("mono", exposure=0.01)(a),
        entry(exposure=10.0)(a),
    ),
    "`--response` that adds up to 3": words("--response", "1,1,1"),
    "focal lengths of both halved": scaled("focal", 0.5, "mono", "colour"),
    "focal length of colour doubled": scaled("focal", 2.0),
    "focal length of colour 20 % long": scaled("focal", 1.2),
    "baseline's sign changed": scaled("translation", -1.0),
    "translation in millimetres": scaled("translation", 1000.0),
    "translation in kilometres": scaled("translation", 0.001),
    "cameras' places exchanged": exchanged,
    "colour turned by 5 degrees": turned(5.0),
    "colour turned by 1 degree up": turned(1.0, 0),
    "rotation transposed": lambda a: a.camera().update(rotation=np.array(a.camera()["rotation"]).T.tolist()),
    "principal point 30 pixels off": lambda a: a.camera().update(
        centre=[c + 30 for c in a.camera()["centre"]]
    ),
    "principal point counted from the corner": lambda a: a.camera().update(centre=[0.0, 0.0]),
    "strong distortion that is not there": entry(
        distortion={"model": "brown", "coefficients": [-0.6, 0.3, 0, 0, 0]}
    ),
    "depth range in millimetres": lambda a: a.rig.update(depth=[1400.0, 20000.0]),
    "depth range too near": lambda a: a.rig.update(depth=[0.2, 0.6]),
    "depth range backwards": lambda a: a.rig.update(depth=[20.0, 1.4]),
    "image of another size than the rig's": shown("colour", lambda i: i[:, 20:]),
    "depth map of something else": words("--around", "{}/depth.tif", depth=lambda d: d[::-1]),
    "depth map in millimetres": words("--around", "{}/depth.tif", depth=lambda d: d * 1000),
    "depth map of another size": words("--around", "{}/depth.tif", depth=lambda d: d[:-7]),
    "JPEG, four bytes damaged": stored("colour", ".jpg", 4),
    "LZW TIFF, four bytes damaged": stored("colour", ".tif", 4, cv2.IMWRITE_TIFF_COMPRESSION, 5),
    "deflated TIFF, four bytes damaged": stored("colour", ".tif", 4, cv2.IMWRITE_TIFF_COMPRESSION, 8),
    "PNG, four bytes damaged": stored("colour", ".png", 4),
    "WebP, four bytes damaged": stored("colour", ".webp", 4, cv2.IMWRITE_WEBP_QUALITY, 90),
}
REASONS = {
    "WebP, four bytes damaged": "its compressed data have no checksum, and its decoder reports nothing",
    "JPEG, four bytes damaged": "as WebP, where the decoder finds its way again",
    "`coding: linear` of an ordinary image": "looks like another exposure, which is fitted",
}


def what_is_said(change: Change, folder: Path) -> tuple[int, str]:
    """Exit status of fusing an array that is changed, and what is said beside the usual."""
    array = Array()
    change(array)
    said, status = io.StringIO(), 0
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
        try:
            pat(array.arguments(folder))
        except SystemExit as ended:
            status = int(ended.code or 0)
    lines = [
        line.strip()
        for line in said.getvalue().splitlines()
        if line.strip() and not USUAL.match(line.strip())
    ]
    text = " / ".join(line.replace(f"{folder}/", "").removeprefix("pat: ") for line in lines)
    return status, printable(text[:LONGEST] + "..." * (len(text) > LONGEST)).replace("|", "\\|")


def main(only: str = "", out: Path | None = None) -> None:
    """Print the table of all mistakes, or of those with a word in their name; `out` is a page for it."""
    rows, silent = [head("what is wrong | status | what is said", align="lrl")], 0
    for name, change in MISTAKES.items():
        if only not in name:
            continue
        with tempfile.TemporaryDirectory() as folder:
            status, text = what_is_said(change, Path(folder))
        if not text and not status:
            silent += 1
            text = f"**nothing**: {REASONS.get(name, 'no reason')}"
        rows.append(markdown_row([name, str(status), text]))
        print(rows[-1], flush=True)
    print(f"{silent} of {len(rows) - 1} pass without a word")
    if out is not None and not only:
        before, _, rest = out.read_text().partition(BEGIN)
        count = f"{silent} of {len(rows) - 1} pass without a word."
        table = "\n\n".join([f"*Printed on {date.today()}.*", "\n".join(rows), count, ""])
        out.write_text(f"{before}{BEGIN}\n{table}{END}{rest.partition(END)[2]}")
    sys.exit(silent > 3)


if __name__ == "__main__":
    script(main)
