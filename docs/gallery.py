"""The gallery's pairs and their fused images: python -m docs.gallery [NAME ...].

Each pair is a folder of `docs/gallery`, images and `rig.yaml`, and beside it a figure, two in and one out, by
the line that is printed. A pair whose folder is there is only fused again; to make the
garden and the room takes Blender.
"""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from PIL import Image
from skimage import data
from torch import Generator, Tensor
from torch.nn.functional import pad

from arraygeom import Camera, Pose, Rig, Sensor, intrinsics, plane_homography, rotation_from_vector
from arraygeom.runtime.atomic import write_atomically
from docs.drawings import two_in_one_out
from experiments import load_system
from experiments.stage import RenderedScene
from pat.lab.evaluation.rectified import warped
from pat.media.colour import linear_from_srgb, luminance, srgb_from_linear
from pat.media.images import read_image, write_image
from pat.sensors import NoiseLevel

OUT = Path(__file__).parent / "gallery"
WALL = 4.0
"""Metres to the wall on which photographs hang."""

DISPARITY = 24
"""Pixels between the images of the cat."""
PLASTER = 0.6
"""Grey of the wall."""

Pair = tuple[Rig, dict[str, Tensor]]
"""A rig of two cameras, and their images."""


def hung(photograph: Tensor, *, focal: float, hw: tuple[int, int], alpha: str, beta: str) -> Pair:
    """Hang a photograph before two cameras: the first sees all of it, the second is rotated and beside it.

    Args:
        focal: the second camera's focal length in pixels; the first one's is its image's width.
        hw: size of the second camera's image.

    Returns:
        The rig, and both images in colour.
    """
    size = (photograph.shape[-2], photograph.shape[-1])
    first = Camera(K=intrinsics(float(size[1]), size).double(), cam_from_world=Pose.identity(), hw=size)
    turn = rotation_from_vector(torch.tensor([0.5, -1.0, 1.5]).double() * math.pi / 180)
    pose = Pose.from_centre(turn, torch.tensor([0.1, -0.01, 0.0]).double())
    second = Camera(K=intrinsics(focal, hw).double(), cam_from_world=pose, hw=hw)
    normal = torch.tensor([0.0, 0, 1]).double()
    d = torch.tensor(-WALL).double()
    H = plane_homography(first.K, second.K, pose.R, pose.t, normal=normal, d=d)
    framed = pad(photograph, (1, 1, 1, 1), value=PLASTER)
    outwards = torch.tensor([[1.0, 0, 1], [0, 1, 1], [0, 0, 1]]).double()
    second_image = warped(framed, outwards @ torch.linalg.inv(H), hw).clamp(0, 1)
    rig = Rig({alpha: first, beta: second}, depth=(2.0, 8.0))
    return rig, {alpha: photograph, beta: second_image}


def photograph(name: str) -> Tensor:
    """Load one of scikit-image's photographs, values 0..1."""
    return torch.from_numpy(getattr(data, name)().copy()).movedim(-1, 0) / 255


def noisy(image: Tensor, electrons: float, seed: int) -> Tensor:
    """Record an image with noise."""
    generator = Generator().manual_seed(seed)
    return NoiseLevel.from_electrons(electrons, 3.0).recorded(image[None], generator)[0].clamp(0, 1)


def coffee() -> Pair:
    """A mono camera with detail, a colour camera with a third of its pixels across."""
    rig, images = hung(photograph("coffee"), focal=220.0, hw=(160, 240), alpha="mono", beta="colour")
    return rig, {
        "mono": noisy(luminance(images["mono"]), 8000, 1),
        "colour": noisy(images["colour"], 8000, 2),
    }


def astronaut() -> Pair:
    """A mono camera that is blind to blue, a colour camera three times darker."""
    rig, images = hung(photograph("astronaut"), focal=450.0, hw=(448, 448), alpha="mono", beta="colour")
    light = {name: linear_from_srgb(image) for name, image in images.items()}
    mono = srgb_from_linear(luminance(light["mono"], (0.6, 0.4, 0.0)))
    dark = srgb_from_linear(light["colour"] / 3)
    return rig, {"mono": noisy(mono, 8000, 1), "colour": noisy(dark, 8000, 2)}


def cat() -> Pair:
    """A mono camera with an eighth of the light, and a colour camera that looks the same way beside it."""
    photo = photograph("chelsea")
    generator, hw = Generator().manual_seed(0), (photo.shape[1], photo.shape[2])
    dark = srgb_from_linear(luminance(linear_from_srgb(photo)) / 8)
    shifted = torch.cat([photo[..., DISPARITY:], photo[..., -1:].expand(-1, -1, DISPARITY)], -1)
    images = {
        "mono": NoiseLevel.from_electrons(1000, 2.0).recorded(dark[None], generator)[0],
        "colour": NoiseLevel.from_electrons(8000, 2.0).recorded(shifted[None], generator)[0],
    }
    mono = Camera(K=intrinsics(600.0, hw).double(), cam_from_world=Pose.identity(), hw=hw)
    beside = Pose(mono.R, torch.tensor([-0.08, 0, 0]).double())
    return Rig({"mono": mono, "colour": mono.replace(cam_from_world=beside)}, depth=(1, 8)), images


def rendered(name: str) -> Pair:
    """Record a scene rendered before one of the paper's arrays, in 8 bits and without a mosaic."""
    system = load_system(name)
    rig, module = system.sized(full=False), system.module
    infrared = "nir" in rig.names
    stage = RenderedScene(rig, module.GENERATOR, module.SEED, infrared=infrared, moving=0.0, duration=0.0)
    first, second = rig.names
    seen = stage.infrared(first)[0] if infrared else luminance(stage.light(first)[0])
    images = {
        first: noisy(srgb_from_linear(seen.clamp(0, 1)), 8000, 1),
        second: noisy(srgb_from_linear(stage.light(second)[0].clamp(0, 1)), 6000, 2),
    }
    plain = {n: rig[n].replace(sensor=Sensor(response="rgb" if n == second else None)) for n in rig.names}
    return rig.replace(cameras=plain), images


PAIRS: dict[str, Callable[[], Pair]] = {
    "cat": cat,
    "coffee": coffee,
    "astronaut": astronaut,
    "garden": lambda: rendered("visible-nir"),
    "room": lambda: rendered("wide-narrow"),
}
"""Pairs by name; the table is the package's own sample."""
WORDS = {
    "table": ("in: a mono camera", "in: a wide colour camera; no rig"),
    "cat": ("in: a mono camera with 1/8 of the light", "in: a colour camera beside it"),
    "coffee": ("in: a mono camera", "in: a colour camera with few pixels"),
    "astronaut": ("in: a mono camera blind to blue", "in: a colour camera, three times darker"),
    "garden": ("in: a near infrared camera", "in: a colour camera"),
    "room": ("in: a mono telephoto", "in: a wide colour camera"),
}


WITHOUT_RIG = {"table": "pat/app/sample"}
"""Pairs whose rig is found, and the folders of their images."""
OPTIONS = {"cat": "--noise estimate --exposure auto"}
"""Options in a pair's line, beside its images."""


def images_of(name: str) -> list[Path]:
    """List the two images of a pair, alpha's first."""
    folder = Path(WITHOUT_RIG.get(name, f"docs/gallery/{name}"))
    return [folder / f"{camera}.png" for camera in Rig.load(folder / "rig.yaml").names]


def line(name: str) -> str:
    """Return the line that fuses a pair, for a shell that expands braces."""
    alpha, beta = images_of(name)
    if name in WITHOUT_RIG:
        return f"pat fuse {alpha.parent}/{{{alpha.name},{beta.name}}}"
    files = f"{alpha.parent}/{{rig.yaml,{alpha.name},{beta.name}}}"
    return f"pat fuse {files} --alpha {alpha.stem} {OPTIONS.get(name, '')}".strip()


def write_pair(name: str) -> None:
    """Write the images and the rig of a pair."""
    rig, images = PAIRS[name]()
    for camera, image in images.items():
        write_image(OUT / name / f"{camera}.png", image)
    rig.save(OUT / name / "rig.yaml")


def draw_pair(name: str) -> None:
    """Fuse a pair by its line, and write two in, one out."""
    images = [read_image(path) for path in images_of(name)]
    with TemporaryDirectory() as folder:
        words = f"{sys.executable} -m {line(name)} --out {folder} --extras none"
        subprocess.run(["bash", "-c", words], check=True, cwd=OUT.parents[1])
        fused = read_image(Path(folder) / "fused.png")
        depth = None if name in ("cat", "coffee", "astronaut") else read_image(Path(folder) / "depth.png")
    drawn = two_in_one_out({**dict(zip(WORDS[name], images)), "out: fused": fused}, depth=depth)
    save(drawn, OUT / f"{name}.jpg")


def save(image: Image.Image, path: Path) -> None:
    """Write an image as JPEG, atomically."""
    with write_atomically(path) as temporary:
        image.save(temporary, "JPEG", quality=90, subsampling=0)


if __name__ == "__main__":
    for chosen in sys.argv[1:] or WORDS:
        if chosen in PAIRS and not (OUT / chosen / "rig.yaml").exists():
            write_pair(chosen)
        draw_pair(chosen)
        print(line(chosen))
