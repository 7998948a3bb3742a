"""Some sixty kinds of input of `pat fuse`, made of real images at small size: what `bench_inputs` measures.

The images are of a folder of data that is not in this repository (its README names them); each kind writes
its files to a folder of its own and gives the command's arguments.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from PIL import Image

from arraygeom import Camera, Pose, Rig, intrinsics
from arraygeom.io import read_rig
from arraygeom.pose import rotation_from_vector
from experiments.showcase import syntim_scene
from pat.media.video import write_video

SIDE = 320
"""The longer side of the images, pixels."""


class Kind(NamedTuple):
    """A kind of input: the arguments that `make` gives in a folder, and what is to come of it.

    status: exit status. depth: whether depth is to be there.
    """

    name: str
    make: Callable[[Path], Sequence[str | Path]]
    status: int = 0
    depth: bool = True


def small(source: Path, target: Path, *, grey: bool = False, side: int = SIDE, deep: bool = False) -> Path:
    """The image reduced to its longer side, in grey and with 16 bits if asked; its format is the target's."""
    image = cv2.imread(
        str(source), cv2.IMREAD_ANYDEPTH | (cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_ANYCOLOR)
    )
    factor = min(side / max(image.shape[:2]), 1.0)
    hw = [max(round(n * factor), 16) for n in image.shape[:2]]
    image = cv2.resize(image, hw[::-1], interpolation=cv2.INTER_AREA)
    target.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(target), image.astype(np.uint16) * 257 if deep and image.dtype == np.uint8 else image)
    return target


def pair(
    alpha: Path, beta: Path, folder: Path, *, suffix: str = ".png", more: Sequence[str] = (), **how: int
) -> list:
    """Two images, alpha in grey unless `colour`."""
    grey = not how.pop("colour", False)
    side = {"alpha": how.pop("alpha_side", SIDE), "beta": how.pop("beta_side", SIDE)}
    own = small(alpha, folder / f"alpha{suffix}", grey=grey, side=side["alpha"], **how)
    return [own, small(beta, folder / f"beta{suffix}", side=side["beta"], **how), *more]


def found_pairs(data: Path) -> Iterator[tuple[str, Path, Path]]:
    """Real pairs by name: alpha's file and beta's."""
    middlebury = data / "middlebury"
    for name in ("Bowling2", "Cloth4", "Flowerpots", "Midd1", "Plastic", "Wood1"):
        yield name, middlebury / f"2006_third/{name}/view1.png", middlebury / f"2006_third/{name}/view5.png"
    yield "teddy", middlebury / "2003_quarter/teddy/im2.png", middlebury / "2003_quarter/teddy/im6.png"
    for name in ("0001", "0002", "0026"):
        yield f"flickr {name}", *(data / f"flickr1024/train/{name}_{side}.png" for side in "LR")
    for name in ("Color", "Poly", "Tordu"):
        yield f"syntim {name}", *(data / f"syntim/{name}{i}_OG0.png" for i in (0, 1))
    for name in ("chair01", "stones01", "thing01"):
        yield (
            f"bumblebee {name}",
            *(data / f"bumblebee2_scenes/{name}_{side}.jpg" for side in ("left", "right")),
        )
    for name in ("00001", "00053"):
        yield (
            f"mono and colour {name}",
            *(data / f"real_mono_colour/{side}/{name}.png" for side in ("mono", "colour")),
        )
    yield "street (KITTI)", *(data / f"kitti/object_StereoRCNN/{side}.png" for side in ("left", "right"))
    yield "table (2014)", *(data / f"pairs/PlaytableP/im{i}.png" for i in (0, 1))
    yield "in the wild", *(data / f"pairs/wild/{side}.png" for side in ("left", "right"))


def kinds(data: Path) -> Iterator[Kind]:
    """All of them."""
    table, beside = (data / f"pairs/PlaytableP/im{i}.png" for i in (0, 1))
    cloth, cloth_beside = (data / f"middlebury/2006_third/Cloth4/view{i}.png" for i in (1, 5))
    for name, alpha, beta in found_pairs(data):
        refused = name == "syntim Tordu"  # points of its pattern agree nowhere: one line
        yield Kind(f"no rig, {name}", partial(pair, alpha, beta), 2 if refused else 0, not refused)
    yield Kind("no rig, both in colour", partial(pair, table, beside, colour=1))
    for suffix in (".jpg", ".tif", ".webp", ".bmp"):
        yield Kind(f"no rig, {suffix[1:]}", partial(pair, table, beside, suffix=suffix))
    yield Kind("no rig, ppm in colour", partial(pair, table, beside, suffix=".ppm", colour=1))
    yield Kind("no rig, 16 bits", partial(pair, table, beside, deep=1))
    yield Kind("no rig, small beta", partial(pair, table, beside, beta_side=160))
    yield Kind("no rig, small alpha", partial(pair, table, beside, alpha_side=200))
    yield Kind("no rig, --focal", partial(pair, cloth, cloth_beside, more=["--focal", "alpha=900"]))
    yield Kind("no rig, --max-memory", partial(pair, table, beside, more=["--max-memory", "900MiB"]))
    yield Kind("no rig, points", partial(pair, cloth, cloth_beside, more=["--extras", "page,points"]))
    yield Kind("no rig, turned by EXIF", partial(turned, cloth, cloth_beside))
    yield Kind("no rig, noise", partial(noisy, table, beside, ["--noise", "estimate"]))
    yield Kind("no rig, dark", partial(dark, table, beside))
    yield Kind("no rig, videos", partial(videos, table, beside))
    yield Kind("no rig, folders, frames missing", partial(folders, table, beside))
    yield Kind("no rig, folders behind links", partial(links, table, beside))
    yield Kind("no rig, its rig.yaml beside", partial(beside_rig, table, beside))
    yield Kind("no rig, red, green, blue", partial(single_bands, table, beside, ("red", "green", "blue")))
    yield Kind("no rig, three bands", partial(single_bands, table, beside, ("red_edge", "red", "green")))
    yield Kind("no rig, two bands", partial(single_bands, table, beside, ("one", "two")))
    yield Kind("no rig, nine bands", partial(nine_bands, data))
    yield Kind("no rig, Sequoia", partial(tagged, data / "multispectral/sequoia", "*.TIF"))
    yield Kind("no rig, RedEdge", partial(tagged, data / "multispectral/rededge", "*.tif"))
    yield Kind("no rig, same picture twice", partial(pair, table, table), 2, False)
    yield Kind("no rig, near infrared of one view", partial(same_view, data), depth=False)
    yield Kind("no rig, other scenes", partial(pair, table, cloth), 2, False)
    for name in ("Color", "Poly", "Serfaty"):
        yield Kind(f"rig, syntim {name}", partial(syntim, data, name))
    yield Kind("rig, lenses (bumblebee)", partial(with_lenses, data))
    yield Kind("rig, street (KITTI)", partial(kitti, data, 0.0, 1.0))
    yield Kind("rig turned by a degree", partial(kitti, data, 1.0, 1.0))
    yield Kind("rig, baseline's sign wrong", partial(kitti, data, 0.0, -1.0), 3)
    yield Kind("rig, light field of nine", partial(light_field, data, ()))
    yield Kind("rig, light field, bits and tif", partial(light_field, data, ["--format", "tif16"]))
    yield Kind("rig of another size", partial(other_size, data), 2, False)


def turned(alpha: Path, beta: Path, folder: Path) -> list:
    """Alpha stored lying, with an orientation tag."""
    files = pair(alpha, beta, folder, suffix=".jpg")
    exif = Image.Exif()
    exif[0x0112] = 6
    with Image.open(files[0]) as image:
        lying = image.transpose(Image.Transpose.ROTATE_90)
    lying.save(files[0], exif=exif, quality=95)
    return files


def noisy(alpha: Path, beta: Path, more: Sequence[str], folder: Path) -> list:
    """Both with the noise of few electrons."""
    files, source = pair(alpha, beta, folder), np.random.default_rng(0)
    for file in files:
        image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED).astype(float)
        cv2.imwrite(str(file), np.clip(image + source.normal(0, 12, image.shape), 0, 255).astype(np.uint8))
    return [*files, *more]


def dark(alpha: Path, beta: Path, folder: Path) -> list:
    """A tenth of the values."""
    files = pair(alpha, beta, folder)
    for file in files:
        cv2.imwrite(str(file), cv2.imread(str(file), cv2.IMREAD_UNCHANGED) // 6)
    return files


def frames(alpha: Path, beta: Path, folder: Path) -> Iterator[tuple[int, list[np.ndarray]]]:
    """Four frames that move by some pixels."""
    images = [cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for file in pair(alpha, beta, folder / "one")]
    for i in range(4):
        yield i, [image[:, 4 * i : image.shape[1] - 16 + 4 * i] for image in images]


def videos(alpha: Path, beta: Path, folder: Path) -> list:
    """Both as videos."""
    both = [[], []]
    for _, images in frames(alpha, beta, folder):
        for i, image in enumerate(images):
            colours = cv2.cvtColor(image, cv2.COLOR_GRAY2RGB if image.ndim == 2 else cv2.COLOR_BGR2RGB)
            both[i].append(torch.from_numpy(colours).movedim(-1, 0) / 255)
    for name, images in zip(("mono", "colour"), both):
        write_video(folder / f"{name}.mp4", images, rate=5)
    return [folder / "mono.mp4", folder / "colour.mp4", "--video", "0"]


def folders(alpha: Path, beta: Path, folder: Path) -> list:
    """Frame 1 missing of one camera and 3 of the other."""
    for i, images in frames(alpha, beta, folder):
        for name, image, missing in zip(("mono", "colour"), images, (1, 3)):
            (folder / name).mkdir(exist_ok=True)
            if i != missing:
                cv2.imwrite(str(folder / name / f"{name}_{i:03d}.png"), image)
    return [folder / "mono", folder / "colour"]


def links(alpha: Path, beta: Path, folder: Path) -> list:
    """Folders that are symbolic links."""
    given = []
    for file, name in zip(pair(alpha, beta, folder / "files"), ("mono", "colour")):
        (folder / f"real_{name}").mkdir()
        file.rename(folder / f"real_{name}" / "0.png")
        (folder / name).symlink_to(folder / f"real_{name}")
        given.append(folder / name)
    return given


def beside_rig(alpha: Path, beta: Path, folder: Path) -> list:
    """Where somebody's rig.yaml is."""
    (folder / "out").mkdir()
    (folder / "out" / "rig.yaml").write_text("mine")
    return pair(alpha, beta, folder)


def single_bands(alpha: Path, beta: Path, names: Sequence[str], folder: Path) -> list:
    """Alpha in grey, and beta's bands as files of their own."""
    own, colours = pair(alpha, beta, folder)
    for i, name in enumerate(names):
        cv2.imwrite(str(folder / f"{name}.png"), cv2.imread(str(colours))[..., 2 - i])
    return [own, *(folder / f"{name}.png" for name in names)]


def nine_bands(data: Path, folder: Path) -> list:
    """Nine cameras of a band each."""
    return [
        small(file, folder / file.name) for file in sorted((data / "nine_band_array/scene").glob("*.png"))
    ]


def tagged(source: Path, pattern: str, folder: Path) -> list:
    """One capture with all its tags, at full size: they are of that."""
    return sorted(source.glob(pattern))


def same_view(data: Path, folder: Path) -> list:
    """Colour and near infrared of one view: no parallax."""
    return pair(data / "rgb_nir_aligned/nir/101.png", data / "rgb_nir_aligned/rgb/101.png", folder)


def with_rig(rig: Rig, images: dict[str, Path], alpha: str, folder: Path) -> list:
    """A rig resized to the images, and these."""
    for name, file in images.items():
        rig = rig.resize(name, cv2.imread(str(file), cv2.IMREAD_UNCHANGED).shape[:2])
    rig.save(folder / "given.yaml")
    given = [word for name, file in images.items() for word in ("--image", f"{name}={file}")]
    return [folder / "given.yaml", "--alpha", alpha, *given]


def syntim(data: Path, name: str, folder: Path) -> list:
    """An unrectified pair with its published rig, its depths those of matched points."""
    rig = syntim_scene(data / "syntim", name).rig
    return _two(rig, [next((data / "syntim").glob(f"{name}{i}_OG*.png")) for i in (0, 1)], folder)


def _two(rig: Rig, files: Sequence[Path], folder: Path, depth: tuple[float, float] | None = None) -> list:
    alpha, beta = rig.names
    images = {alpha: small(files[0], folder / "a.png", grey=True), beta: small(files[1], folder / "b.png")}
    return with_rig(rig if depth is None else rig.replace(depth=depth), images, alpha, folder)


def with_lenses(data: Path, folder: Path) -> list:
    """A rig with lens distortion."""
    rig = read_rig(data / "bumblebee2_scenes/stereo.yaml", scale=1e-3)
    files = [data / f"bumblebee2_scenes/chair01_{side}.jpg" for side in ("left", "right")]
    return _two(rig, files, folder, (0.4, 10.0))


def kitti_rig(degrees: float, sign: float) -> Rig:
    """The published rig of the two colour cameras, turned by so much, its baseline times a sign."""
    K = intrinsics(721.5377, (375, 1242), (609.5593, 172.854))
    turn = rotation_from_vector(torch.tensor([0.3, 1.0, 0.3], dtype=torch.float64) * degrees * np.pi / 180)
    one = Camera(K=K, cam_from_world=Pose.identity(), hw=(375, 1242))
    other = Camera(
        K=K, cam_from_world=Pose(turn, torch.tensor([-0.5327 * sign, 0, 0]).double()), hw=(375, 1242)
    )
    return Rig({"left": one, "right": other}, depth=(4.0, 80.0))


def kitti(data: Path, degrees: float, sign: float, folder: Path) -> list:
    """The street with that rig, twice the usual size: it is wide."""
    files = {side: data / f"kitti/object_StereoRCNN/{side}.png" for side in ("left", "right")}
    images = {
        side: small(file, folder / f"{side}.png", grey=side == "left", side=640)
        for side, file in files.items()
    }
    return with_rig(kitti_rig(degrees, sign), images, "left", folder)


def light_field(data: Path, more: Sequence[str], folder: Path) -> list:
    """Nine parallel cameras on a grid, betas on all sides."""
    source, cameras, images = data / "light_field/antinous", {}, {}
    for row in (4, 0, 8):
        for column in (4, 0, 8):
            t = torch.tensor([-0.01 * (column - 4), -0.01 * (row - 4), 0]).double()
            name = f"row{row}_col{column}"
            cameras[name] = Camera(
                K=intrinsics(500, (512, 512)), cam_from_world=Pose(Pose.identity().R, t), hw=(512, 512)
            )
            images[name] = small(
                source / f"{name}.png", folder / f"{name}.png", grey=name == "row4_col4", side=256
            )
    return [*with_rig(Rig(cameras, depth=(1.2, 60.0)), images, "row4_col4", folder), *more]


def other_size(data: Path, folder: Path) -> list:
    """A rig whose images have another size than it says."""
    words = kitti(data, 0.0, 1.0, folder)
    kitti_rig(0.0, 1.0).save(folder / "given.yaml")
    return words
