"""Damaged files, and the calls that read them: rigs of all formats, images, weights, checkpoints,
covariance."""

from __future__ import annotations

import io
import itertools
import os
import random
import shutil
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import tifffile
import torch
from PIL import Image
from torch import nn

from arraygeom import Distortion, Rig
from arraygeom.io import read_rig, write_rig
from calib.boards.uncertainty import RigCovariance
from pat.app.cli.main import main
from pat.lab.synthesis.photos import read_photographs
from pat.lab.training.checkpoints import collect, newest_checkpoint, restore, write_checkpoint
from pat.media.images import read_image, write_image
from pat.media.video import Video, read_video
from pat.networks.configs import PATConfig
from pat.networks.paper import PAT
from pat.networks.weights import load_weights, save_weights
from tests.arraygeom.test_damaged_files import matlab_pair

from .mutations import mutated
from .pieces import pixels_damaged

FIXTURES = Path(__file__).parents[1] / "arraygeom" / "fixtures"


class Seed(NamedTuple):
    """A good file: its kind and format, where it is, and what is read, the file itself or its folder."""

    kind: str
    format: str
    file: Path
    whole_folder: bool = False


NO_FILE = 0.03
"""The share of cases in which something else is in the file's place: a pipe, links in a circle, a folder."""

Check = Callable[[Path, random.Random], str]


def placed(seed: Seed, home: Path) -> tuple[Path, Path]:
    """A folder with nothing but a copy of a seed's file, or of its folder: the file there, what is read."""
    shutil.rmtree(home, ignore_errors=True)
    if seed.whole_folder:
        shutil.copytree(seed.file.parent, home)
    else:
        home.mkdir(parents=True)
        shutil.copy(seed.file, home)
    path = home / seed.file.name
    return path, home if seed.whole_folder and seed.kind == "rig" else path


def damaged(seed: Seed, number: int, folder: Path) -> Path:
    """A copy of a seed's file (with its folder, where files belong together) with damage of this number."""
    source = random.Random(f"{seed.kind} {seed.format} {seed.file.name} {number}")
    path, read = placed(seed, folder / "case")
    if seed.kind == "pixels":
        path.write_bytes(pixels_damaged(source, seed.file.read_bytes(), seed.file.suffix))
        return read
    binary = seed.file.suffix in (".bin", ".mat", ".safetensors", ".npz") or seed.kind in ("image", "video")
    if source.random() < NO_FILE:
        path.unlink()
        source.choice((os.mkfifo, _linked_in_a_circle, os.mkdir))(path)
    else:
        content = seed.file.read_bytes()
        path.write_bytes(mutated(content, source, text=not binary, suffix=seed.file.suffix))
    return read


def answered(read: Callable[[Path], Any], fault: Callable[[Any], str] = lambda found: "") -> Check:
    """A file is read, or refused in a line that names it; `fault` says what is wrong with what was read."""

    def check(path: Path, _: random.Random) -> str:
        try:
            found = read(path)
        except (ValueError, FileNotFoundError) as error:
            return refused(error, path)
        return fault(found) or "read"

    return check


def refused(error: Exception, path: Path | None = None) -> str:
    """A refusal is one line, and names the file."""
    one_line = "\n" not in str(error) and (path is None or str(path) in str(error))
    return "refused" if one_line else f"message: {error}"


def _linked_in_a_circle(path: Path) -> None:
    """A link to a folder that leads back to the one it is in, and a link to itself in place of the file."""
    (path.parent / "round").symlink_to(path.parent)
    path.symlink_to(path)


# Rigs -------------------------------------------------------------------------------------------------------


def rig_seeds(folder: Path) -> Iterator[Seed]:
    """The fixtures of the tests, and what the writers write, binary COLMAP and .mat files among it."""
    for file in sorted(FIXTURES.rglob("*")):
        if file.is_file() and file.suffix != ".md":
            own = file.parent != FIXTURES
            yield Seed("rig", file.parent.name if own else file.stem, file, own)
    rich = Rig.load(Path(__file__).parent / "native.yaml")
    plain, wide = (read_rig(FIXTURES / name) for name in ("kalibr.yaml", "kalibr_wide.yaml"))
    lens = Distortion("kannala-brandt", torch.tensor([0.05, -0.01, 0.003, -5e-4], dtype=torch.float64))
    fisheyes = plain.replace(cameras={n: c.replace(distortion=lens) for n, c in plain.cameras.items()})
    for label, rig, name in (
        ("native", rich, "rig.yaml"),
        ("native, wide", wide, "rig.yaml"),
        ("colmap", plain, ""),
        ("kalibr", plain, "c.yaml"),
        ("nerfstudio", plain, "t.json"),
        ("nerfstudio, fisheye", fisheyes, "t.json"),
        ("opencv", plain, ""),
    ):
        target = folder / f"written_{label}" / name if name else folder / f"written_{label}"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            write_rig(rig, target, format=label.partition(",")[0])
        files = sorted(target.glob("[!.]*")) if target.is_dir() else [target]
        for file in files:
            yield Seed("rig", f"{label} (written)", file, target.is_dir())
    yield from _matlab(folder / "matlab")
    yield from _colmap_binary(folder / "colmap_binary")


def _matlab(folder: Path) -> Iterator[Seed]:
    from scipy.io import savemat

    folder.mkdir(parents=True, exist_ok=True)
    fisheye = {"MappingCoefficients": [300.0, -9e-4, 4e-7, -6e-10], "ImageSize": [480.0, 640.0]}
    fisheye |= {"DistortionCenter": [321.5, 239.25], "StretchMatrix": np.eye(2)}
    bouguet = {"om": [0.01, 0.1, -0.02], "T": [-100.0, 2, 1], "nx": 640.0, "ny": 480.0}
    for side in ("left", "right"):
        bouguet |= {
            f"fc_{side}": [800.0, 802],
            f"cc_{side}": [320.5, 238],
            f"kc_{side}": [-0.2, 0.1, 0, 0, 0.01],
        }
    for name, variables in (
        ("pair", {"s": matlab_pair()}),
        ("fisheye", {"s": fisheye}),
        ("bouguet", bouguet),
    ):
        savemat(folder / f"{name}.mat", variables)
        yield Seed("rig", f"{name} .mat", folder / f"{name}.mat")


def _colmap_binary(folder: Path) -> Iterator[Seed]:
    import struct

    q = [0.9486832980505138, 0, 0.31622776601683794, 0, -0.1, 0.02, 0.03]
    cameras = struct.pack("<QIiQQ4d", 2, 1, 1, 640, 480, 500, 510, 320, 240)
    cameras += struct.pack("<IiQQ8d", 7, 4, 640, 480, 400, 404, 310.75, 245.25, -0.2, 0.1, 0.001, -0.002)
    images = (
        struct.pack("<QI7dI", 2, 1, 1, 0, 0, 0, 0, 0, 0, 1)
        + b"a/0001.png\0"
        + struct.pack("<QddQ", 1, 111.5, 180.2, 1)
    )
    images += struct.pack("<I7dI", 2, *q, 7) + b"b/0001.png\0" + struct.pack("<Q", 0)
    folder.mkdir(parents=True, exist_ok=True)
    rigs = struct.pack("<QIIiIiIB7d", 1, 1, 2, 0, 1, 0, 7, 1, *q)
    for name, content in (("cameras.bin", cameras), ("images.bin", images), ("rigs.bin", rigs)):
        (folder / name).write_bytes(content)
        yield Seed("rig", "colmap binary", folder / name, whole_folder=True)


def convert_and_inspect(path: Path, source: random.Random) -> str:
    """`pat rig convert` to the native format, and of some `pat rig info`."""
    target = path.parent / "out.yaml"
    target.unlink(missing_ok=True)
    converted = command("rig", "convert", str(path), str(target))
    left = [p.name for p in target.parent.glob(".*")]
    if left:
        return f"left behind: {left}"
    if target.exists():
        Rig.load(target)  # a file that is there is whole
    if (converted == "read") != target.exists():
        return f"{converted}, and the file is {'there' if target.exists() else 'missing'}"
    further = source.choice([["info"], ["info", "--json"], ["info", "--depth", "1", "inf"], *[[]] * 21])
    if converted not in ("read", "refused") or not further:
        return converted
    found = command("rig", further[0], str(path), *further[1:])
    return converted if found in ("read", "refused") else found


def command(*arguments: str) -> str:
    """Run a command; it must read with status 0, or refuse in one line with status 2."""
    try:
        main(list(arguments))
    except SystemExit as ended:
        return {0: "read", None: "read", 2: "refused"}.get(ended.code, f"status {ended.code}")  # type: ignore[call-overload]
    return "read"


# Images -----------------------------------------------------------------------------------------------------


def image_seeds(folder: Path) -> Iterator[Seed]:
    """Small images of every format that is read, 8 and 16 bits and floats, grey and colour."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    smooth = cv2.resize(rng.integers(0, 256, (6, 8, 3), dtype=np.uint8), (80, 60))
    kinds = {"png": ".png", "jpeg": ".jpg", "tiff": ".tif", "webp": ".webp", "bmp": ".bmp", "pnm": ".ppm"}
    for name, suffix in kinds.items():
        for label, values in (("colour", smooth), ("grey", smooth[..., 0])):
            file = folder / f"{label}{suffix if label == 'colour' else suffix.replace('ppm', 'pgm')}"
            cv2.imwrite(str(file), values)
            yield Seed("image", name, file)
    for name, values in (
        ("16.png", smooth.astype(np.uint16) * 257),
        ("32.tif", (smooth / 255).astype(np.float32)),
    ):
        cv2.imwrite(str(folder / name), values)
        yield Seed("image", "png 16" if name.endswith("png") else "tiff 32", folder / name)
    for name, content in more_images(smooth).items():
        (folder / name.replace(" ", "_")).write_bytes(content)
        yield Seed("image", name.partition(".")[0], folder / name.replace(" ", "_"))


def more_images(values: np.ndarray) -> dict[str, bytes]:
    """Files that OpenCV does not write: an animated PNG, planar and tiled TIFFs, a photograph with EXIF."""
    frames = [Image.fromarray(frame) for frame in (values, values[::-1], values[:, ::-1])]
    exif = Image.Exif()
    exif[0x0112] = 6  # the orientation
    files: dict[str, bytes] = {}
    for name, options in {
        "png animated.png": {"save_all": True, "append_images": frames[1:]},
        "jpeg exif.jpg": {"exif": exif},
        "png exif.png": {"exif": exif},
    }.items():
        file = io.BytesIO()
        frames[0].save(file, name.rpartition(".")[2].replace("jpg", "jpeg"), **options)
        files[name] = file.getvalue()
    planes = values.transpose(2, 0, 1)
    for name, image, options in (
        ("tiff planar.tif", planes, {"planarconfig": "separate", "rowsperstrip": 7}),
        ("tiff tiled.tif", values[..., 0].astype(np.float32) / 255, {"tile": (16, 16)}),
        ("tiff zlib.tif", values, {"compression": "zlib", "rowsperstrip": 7}),
    ):
        file = io.BytesIO()
        tifffile.imwrite(file, image, photometric="rgb" if image.ndim == 3 else "minisblack", **options)
        files[name] = file.getvalue()
    return files


def read_and_write(path: Path, source: random.Random) -> str:
    """`read_image`, what it gives written again, and the bank of photographs of a folder that holds it."""
    try:
        image = read_image(path, hw=source.choice([None, None, (60, 80)]))
    except (ValueError, FileNotFoundError) as error:
        return refused(error, path)
    if not (image.isfinite().all() and image.min() >= 0 and image.max() <= 1):
        return "values outside 0..1"
    write_image(path.with_name("again.png"), image)
    with_photos(path.parent)
    return "read"


def with_photos(folder: Path) -> None:
    """The bank of a folder's photographs: files that are none are passed over."""
    try:
        read_photographs((folder,), max_edge=64)
    except ValueError as error:
        if "no image" not in str(error):
            raise


# Pixels -----------------------------------------------------------------------------------------------------


UNDAMAGED: dict[str, torch.Tensor] = {}
"""The pixels of good files, by their names."""
COMPRESSIONS: dict[str, dict[str, Any]] = {
    "png.png": {},
    "jpeg baseline.jpg": {"quality": 90},
    "jpeg optimised.jpg": {"quality": 90, "optimize": True},
    "jpeg progressive.jpg": {"quality": 90, "progressive": True},
    "tiff deflate.tif": {"compression": "tiff_adobe_deflate"},
    "tiff LZW.tif": {"compression": "tiff_lzw"},
    "tiff PackBits.tif": {"compression": "packbits"},
    "tiff JPEG.tif": {"compression": "jpeg"},
    "webp lossy.webp": {"quality": 90},
    "webp lossless.webp": {"lossless": True},
}
"""Formats of compressed pixels, with Pillow's options."""
UNKNOWABLE = ("jpeg baseline", "jpeg optimised", "tiff JPEG", "tiff PackBits", "webp lossy", "webp lossless")
"""Formats in which nearly all bytes are a code of some pixels, and no checksum says of which."""


def pixel_seeds(folder: Path) -> Iterator[Seed]:
    """Images of each compression, smooth ones with a little noise."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    values = cv2.resize(rng.integers(0, 256, (12, 16, 3), dtype=np.uint8), (320, 240)).astype(int)
    values = (values + rng.integers(0, 8, values.shape)).clip(0, 255).astype(np.uint8)
    for name, options in COMPRESSIONS.items():
        file = folder / name.replace(" ", "_")
        Image.fromarray(values).save(file, **options)
        UNDAMAGED[file.name] = read_image(file)
        yield Seed("pixels", name.partition(".")[0], file)


def same_pixels(path: Path, _: random.Random) -> str:
    """A damaged file is refused, or read as the good one; else it is a fault."""
    try:
        image = read_image(path)
    except ValueError as error:
        return refused(error, path)
    right = UNDAMAGED[path.name]
    if image.shape != right.shape:
        return f"read as {tuple(image.shape)}"
    wrong = float(((image - right).abs().amax(0) > 1 / 64).double().mean())
    return "read" if torch.equal(image, right) else f"read with {wrong:.1%} of the pixels wrong"


# Videos -----------------------------------------------------------------------------------------------------


def video_seeds(folder: Path) -> Iterator[Seed]:
    """A short video; written by OpenCV, which has a codec of its own."""
    folder.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(folder / "video.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 25, (80, 60))
    for i in range(6):
        writer.write(np.full((60, 80, 3), 40 * i, np.uint8))
    writer.release()
    yield Seed("video", "mp4", folder / "video.mp4")


def faults_of_video(video: Video) -> str:
    """Return the faults of a video's first frames and its rate."""
    whole = all(frame.isfinite().all() for frame in itertools.islice(video.frames, 100))
    return "" if whole and 0 < video.rate < float("inf") else f"{video.rate} frames a second"


# Weights, checkpoints, documents ----------------------------------------------------------------------------


def small_network() -> PAT:
    torch.manual_seed(0)
    return PAT(PATConfig(dim=4))


def weight_seeds(folder: Path) -> Iterator[Seed]:
    save_weights(small_network(), folder / "weights" / "small.safetensors")
    yield Seed("weights", "PAT", folder / "weights" / "small.safetensors")


def training() -> tuple[nn.Module, torch.optim.Optimizer, torch.optim.swa_utils.AveragedModel]:
    """A run of a small network: itself, its optimiser after one step, its average."""
    network = nn.Sequential(nn.Linear(4, 4), nn.Linear(4, 2))
    optimiser = torch.optim.Adam(network.parameters())
    network(torch.ones(1, 4)).sum().backward()
    optimiser.step()
    return network, optimiser, torch.optim.swa_utils.AveragedModel(network)


def checkpoint_seeds(folder: Path) -> Iterator[Seed]:
    facts = {"step": 7, "best": 30.0, "minutes": 1.5, "done": False, "recipe": "steps: 10"}
    (folder / "run").mkdir(parents=True, exist_ok=True)
    path = write_checkpoint(folder / "run", collect(*training(), facts))
    yield Seed("checkpoint", "training", path)


def use_checkpoint(path: Path, _: random.Random) -> str:
    try:
        found = newest_checkpoint(path.parent)
        if found is None:
            return "no checkpoint, and none was named"
        restore(found, *training())
    except ValueError as error:
        return refused(error)
    facts = found.facts
    whole = (
        isinstance(facts["step"], int)
        and isinstance(facts["minutes"], float | int)
        and isinstance(facts["done"], bool)
    )
    return "read" if whole else f"facts of other types: {facts}"


def covariance_seeds(folder: Path) -> Iterator[Seed]:
    folder.mkdir(parents=True, exist_ok=True)
    RigCovariance(("a.focal.0", "a.focal.1"), np.eye(2)).save(folder / "covariance.json", Rig({}))
    yield Seed("covariance", "json", folder / "covariance.json")


def faults_of_covariance(found: RigCovariance) -> str:
    whole = np.isfinite(found.matrix).all() and all(isinstance(name, str) for name in found.names)
    return "" if whole else f"{found.names} {found.matrix}"


KINDS: dict[str, tuple[Callable[[Path], Iterator[Seed]], Check, int]] = {
    "rig": (rig_seeds, convert_and_inspect, 5000),
    "image": (image_seeds, read_and_write, 1000),
    "pixels": (pixel_seeds, same_pixels, 1000),
    "video": (video_seeds, answered(read_video, faults_of_video), 100),
    "weights": (weight_seeds, answered(load_weights), 200),
    "checkpoint": (checkpoint_seeds, use_checkpoint, 150),
    "covariance": (covariance_seeds, answered(RigCovariance.load, faults_of_covariance), 150),
}
"""Good files, the question asked of a damaged one, and how many are made."""
