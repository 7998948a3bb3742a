"""Real pairs whose cameras are known, from the folder of real images."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from arraygeom import Camera, Pose, Rig
from arraygeom.io import read_rig
from pat.media.images import read_image
from tests.arraygeom.rigs import parallel_rig

SYNTIM = (
    *("Color", "Serfaty", "Poly", "BatInria", "BatSynt", "Billet", "Cube", "Jallut", "LaMire", "Money"),
    *("Sigraph", "TableSTV", "Tordu", "Aout", "BalMouss", "SmRub", "CubeR", "Lego"),
)
BUMBLEBEE = ("chair01", "chair02", "stones01", "thing01")
MIDDLEBURY = {"2006_third/Cloth1": 3, "2006_third/Midd1": 3, "2006_half/Wood2": 2, "2005_half/Reindeer": 2}


class RealPair(NamedTuple):
    """A rig of two cameras and an image of each."""

    name: str
    rig: Rig
    images: dict[str, Tensor]


def named(name: str, rig: Rig, files: dict[str, Path]) -> RealPair:
    """A pair of images in files, by camera."""
    images = {camera: read_image(file) for camera, file in files.items()}
    cameras = {c: rig[c].replace(hw=tuple(images[c].shape[1:])) for c in files}
    return RealPair(name, rig.replace(cameras=cameras), images)


def syntim(data: Path, names: tuple[str, ...] = SYNTIM) -> Iterator[RealPair]:
    """INRIA's pairs, not rectified, published K, R and t."""
    for name in names:
        files = [sorted((data / "syntim").glob(f"{name}{i}_O*.png"))[0] for i in (0, 1)]
        rig = read_rig(data / "syntim" / f"cam_{name}_g")
        yield named(f"SYNTIM {name}", rig, dict(zip(("left", "right"), files)))


def bumblebee(data: Path, names: tuple[str, ...] = BUMBLEBEE) -> Iterator[RealPair]:
    """Pairs of one stereo head with strong lenses."""
    folder = data / "bumblebee2_scenes"
    rig = read_rig(folder / "stereo.yaml", scale=1e-3)
    for name in names:
        yield named(f"Bumblebee2 {name}", rig, {s: folder / f"{name}_{s}.jpg" for s in ("left", "right")})
    folder = data / "calibration" / "bumblebee2_chess"
    rig = read_rig(folder / "stereo.yaml", scale=1e-3)
    for name in ("01", "06"):
        yield named(f"Bumblebee2 chess{name}", rig, {s: folder / f"{s}{name}.jpg" for s in ("left", "right")})


def kitti(data: Path) -> Iterator[RealPair]:
    """Rectified pairs of a car."""
    folder = data / "kitti" / "odometry_03_gray_stereo" / "sequences" / "03"
    rig = read_rig(folder / "calib.txt")
    for frame in ("000000", "000003"):
        yield named(
            f"KITTI 03/{frame}", rig, {f"cam{i}": folder / f"image_{i}" / f"{frame}.png" for i in (0, 1)}
        )
    folder = data / "kitti" / "object_StereoRCNN"
    files = {"cam2": folder / "left.png", "cam3": folder / "right.png"}
    yield named("KITTI object", read_rig(folder / "calib.txt"), files)


def middlebury(data: Path) -> Iterator[RealPair]:
    """Rectified pairs of 2005 and 2006: focal length 3740 px at full size, baseline 160 mm."""
    for name, factor in MIDDLEBURY.items():
        files = {side: data / "middlebury" / name / f"view{i}.png" for side, i in (("left", 1), ("right", 5))}
        hw = tuple(read_image(files["left"]).shape[1:])
        rig = parallel_rig(3740.0 / factor, hw, {"left": (), "right": (0.16,)})
        yield named(f"Middlebury {name}", rig, files)


def hilti(data: Path) -> Iterator[RealPair]:
    """Two overlapping fisheye cameras."""
    folder = data / "rigs" / "kalibr_hilti_5cam"
    rig = read_rig(folder / "calibration" / "calib_3_cam0-1-camchain-imucam.yaml")
    for i in (0, 2):
        yield named(f"Hilti {i}", rig, {f"cam{k}": folder / "rig_frames" / f"{i}_{k}.png" for k in (0, 1)})


def lund(data: Path) -> Iterator[RealPair]:
    """Photographs of a door, cameras by COLMAP; its unit is arbitrary."""
    folder = data / "rigs" / "colmap_lund_door"
    rig = read_rig(folder / "colmap_ground_truth")
    for a, b in ((1, 3), (4, 6), (8, 11)):
        yield named(
            f"Lund {a}-{b}", rig, {f"DSC_{i:04d}.JPG": folder / "images" / f"DSC_{i:04d}.JPG" for i in (a, b)}
        )


def fox(data: Path) -> Iterator[RealPair]:
    """Photographs by a telephone; the unit is arbitrary."""
    folder = data / "rigs" / "nerf_fox"
    rig = read_rig(folder / "transforms.json")
    for a, b in (("0001", "0009"), ("0073", "0077"), ("0089", "0097")):
        yield named(f"fox {a}-{b}", rig, {f"images/{i}.jpg": folder / "images" / f"{i}.jpg" for i in (a, b)})


def ball(data: Path) -> Iterator[RealPair]:
    """Rendered views with exact cameras; one is rotated by 90 degrees."""
    folder = data / "rigs" / "pycalib_gopro15" / "mvs"
    cameras, files = {}, {f"cam{i}": folder / f"cam{i}.png" for i in (0, 1, 2, 3)}
    for name, file in files.items():
        numbers = {
            k: torch.tensor(v).double() for k, v in json.loads(file.with_suffix(".json").read_text()).items()
        }
        hw = tuple(read_image(file).shape[1:])
        cameras[name] = Camera(K=numbers["K"], cam_from_world=Pose(numbers["R"], numbers["t"]), hw=hw)
    for a, b in (("cam1", "cam2"), ("cam2", "cam3")):
        yield named(f"rendered {a}-{b}", Rig(cameras), {c: files[c] for c in (a, b)})


def every_pair(data: Path) -> Iterator[RealPair]:
    """All of them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for source in (syntim, bumblebee, kitti, middlebury, hilti, lund, fox, ball):
            yield from source(data)
