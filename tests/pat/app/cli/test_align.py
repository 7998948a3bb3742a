"""Alignment by `pat align`: its files and options on a wall with a post before it, and refusals, one line
each."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
import torch
from PIL import Image
from torch.nn.functional import avg_pool2d

from arraygeom import Rig
from arraygeom.runtime.text import REGISTERED
from pat.app.from_images import _tagged_rig, array_from_images, camera_names
from pat.app.sample_array import load_sample
from pat.media.images import srgb_profile, write_image
from tests.arraygeom.test_xmp import FISHEYE, PERSPECTIVE, image_of
from tests.calib.scenes import texture
from tests.pat.app.cli.test_known import FAR, NEAR, ON_POST, H, W, folder  # noqa: F401
from tests.pat.commands import images, pat

HIDDEN = slice(ON_POST.start - (NEAR - FAR), ON_POST.start)
"""Columns of the wall that the post hides from the second camera."""


@pytest.fixture
def counts(folder, tmp_path):  # noqa: F811
    """The images as counts of 16 bits."""
    for name in ("mono", "colour"):
        image = cv2.imread(str(folder / f"{name}.png"), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(tmp_path / f"{name}.png"), image.astype(np.uint16) * 201 + 1000)
    return tmp_path


def align(folder, recorded, options="", alpha="mono"):  # noqa: F811
    files = images(recorded, "mono", "colour")
    pat(f"align {folder / 'rig.yaml'} --alpha {alpha} {files} -o {recorded / 'out'} {options}")
    return recorded / "out"


def test_files(folder, counts, capsys):  # noqa: F811
    out = align(folder, counts, "--misfit warn --response rec601")
    bands = tifffile.imread(out / "aligned.tif")
    assert bands.shape == (4, H, W)
    assert bands.dtype == np.uint16
    recorded = cv2.imread(str(counts / "mono.png"), cv2.IMREAD_UNCHANGED)
    assert (bands[0] == recorded).all()
    visibility = cv2.imread(str(out / "colour_visibility.png"), cv2.IMREAD_UNCHANGED)
    seen = visibility == 255
    assert (bands[1:, ~seen] == 0).all()
    assert (bands[1:, seen] >= 1000).all()
    assert (visibility[4:-4, HIDDEN] == 128).mean() > 0.8
    assert (visibility[:, : FAR - 2] == 0).mean() > 0.8
    positions = np.load(out / "colour_positions.npy")
    assert positions.dtype == np.float32
    assert abs(np.nanmedian(positions[:, 100:, 0] - np.arange(100, W)) + FAR) < 0.1
    expected = {"aligned.tif", "colour_confidence.png", "depth.tif", "visibility.txt", "index.html"}
    assert expected <= {path.name for path in out.iterdir()}
    assert "colour: sees " in capsys.readouterr().out


def test_what_is_put_right_is_said_and_on_the_page(folder, counts, capsys):  # noqa: F811
    colour = cv2.imread(str(counts / "colour.png"), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(counts / "colour.png"), np.roll(colour, 1, axis=0))
    page = (align(folder, counts) / "index.html").read_text()
    said = capsys.readouterr().err
    assert "plan: 1 piece, " in said
    for words in (
        "network: mono-colour",
        "alpha is 0.33 R + 0.33 G + 0.33 B",
        "px off its search segments: put right",
    ):
        assert words in said
        assert words in page.replace("&#x27;", "'")


def test_warnings_are_said_once_and_are_on_the_page(folder, tmp_path, capsys):  # noqa: F811
    """Reading an image with a colour profile resets Python's record of what was warned of."""
    orientation = Image.Exif()
    orientation[274] = 3
    for name in ("mono", "colour"):
        turned = Image.open(folder / f"{name}.png").rotate(180)
        turned.save(tmp_path / f"{name}.png", exif=orientation, icc_profile=srgb_profile())
    out = align(folder, tmp_path, "--misfit warn --response rec601")
    said = capsys.readouterr().err.split("pat: warning: ")[1:]
    assert len(said) == len(set(said)) == 2
    assert (out / "index.html").read_text().count("orientation tag 3 is applied") == 2


def test_options(folder, counts):  # noqa: F811
    """Filled, nearest, a file of each camera, positions as TIFF; no page."""
    options = "--fill propagate --interpolation nearest --extras separate,tif"
    out = align(folder, counts, f"{options} --misfit warn --response rec601")
    values = tifffile.imread(out / "colour.tif")
    recorded = cv2.imread(str(counts / "colour.png"), cv2.IMREAD_UNCHANGED)[..., ::-1].transpose(2, 0, 1)
    for band, own in zip(values, recorded):
        assert np.isin(band, own).all()
    assert values.min() >= 1000
    assert tifffile.imread(out / "colour_positions.tif").shape == (2, H, W)
    assert not (out / "aligned.tif").exists()
    assert not (out / "index.html").exists()


def test_images_are_not_overwritten_by_what_is_made_of_them(folder, tmp_path, refusal):  # noqa: F811
    """The cameras' own files, as deep as recorded, may have the names of the images themselves."""
    for name in ("mono", "colour"):
        tifffile.imwrite(tmp_path / f"{name}.tif", cv2.imread(str(folder / f"{name}.png"))[..., ::-1])
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    files = " ".join(f"--image {path.stem}={path}" for path in before)
    how = "--misfit warn --response rec601"
    command = f"align {folder / 'rig.yaml'} --alpha mono {files} -o {tmp_path} {how}"
    said = refusal(*command.split(), "--extras", "separate")
    assert "mono.tif" in said
    assert {path: path.read_bytes() for path in tmp_path.glob("*.*")} == before
    pat(command)
    assert (tmp_path / "aligned.tif").is_file()


def test_to_the_other_camera(folder, counts):  # noqa: F811
    out = align(folder, counts, "--misfit warn", alpha="colour")
    bands = tifffile.imread(out / "aligned.tif")
    recorded = cv2.imread(str(counts / "colour.png"), cv2.IMREAD_UNCHANGED)
    assert (bands[:3].transpose(1, 2, 0) == recorded[..., ::-1]).all()
    positions = np.load(out / "mono_positions.npy")
    on_post = slice(ON_POST.start - NEAR + 3, ON_POST.stop - NEAR - 3)
    assert abs(np.nanmedian(positions[:, on_post, 0] - np.arange(W)[on_post]) - NEAR) < 0.2


@pytest.fixture
def capture(tmp_path):
    """Two images of a capture with tags of their cameras, and what they show."""
    texture = torch.rand(1, 1, 60, 80, generator=torch.Generator().manual_seed(0))
    image = (torch.nn.functional.interpolate(texture, (960, 1280), mode="bicubic")[0, 0] * 40000).numpy()

    def made(*, second=FISHEYE, **options):
        for name, tags, more in (("1", {**FISHEYE, "BandName": "Green"}, {}), ("2", second, options)):
            path = image_of(tmp_path / f"IMG_{name}.tif", tags, **more)
            if path.is_file() and options.get("hw") is None:
                with tifffile.TiffFile(path) as file:
                    offset = file.pages[0].dataoffsets[0]
                with path.open("r+b") as file:
                    file.seek(offset)
                    file.write(image.clip(0, 65535).astype("<u2").tobytes())
        return [str(tmp_path / f"IMG_{name}.tif") for name in ("1", "2")]

    return made


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"serial": "B2"}, "serial number than the image of 'green' (B2, A1): give images of one capture"),
        ({"taken": "2018:04:13 09:00:00"}, "is of another time than the image of 'green'"),
        ({"second": {**FISHEYE, "RigTranslations": "12.5,0,0"}}, "s: is [12.5, 0.0, 0.0], and metres"),
        ({"second": {**PERSPECTIVE, "PrincipalPoint": "24,18"}}, "was it cropped or resized?"),
        ({"hw": (300, 400)}, "was it cropped or resized?"),
        (
            {"second": {k: v for k, v in FISHEYE.items() if k != "FisheyeAffineMatrix"}},
            "FisheyeAffineMatrix: is not",
        ),
    ],
)
@pytest.mark.filterwarnings("ignore::arraygeom.io.RigFileWarning")
def test_captures_that_do_not_go_together(capture, tmp_path, refusal, options, message):
    assert message in refusal("align", *capture(**options), "-o", tmp_path / "out")
    assert not (tmp_path / "out" / "aligned.tif").exists()


K = np.array([[1466.667, 0, 180], [0, 1466.667, 140], [0, 0, 1]])
MOVED = K @ cv2.Rodrigues(np.array([0.003, -0.004, 0.02]))[0] @ np.linalg.inv(K)
"""Captures of far ground: tags state lenses, no poses; one homography is the map, here of a rotation."""


def captures_of_ground(place, seeds):
    """Captures in green and near infrared, whose bands see the same ground."""
    tags = {**PERSPECTIVE, "PrincipalPoint": "0.6,0.45", "PerspectiveDistortion": "-0.01,0,0,0,0"}
    for seed in seeds:
        ground = (texture((300, 400), seed=seed)[0].numpy() * 60000).astype(np.uint16)
        moved = cv2.warpPerspective(ground, MOVED, (400, 300), flags=cv2.INTER_CUBIC)
        for i, (band, image) in enumerate({"Green": ground, "NIR": moved}.items()):
            path = place / f"IMG_{seed:04d}_{i}.tif"
            image_of(path, {**tags, "BandName": band}, hw=(240, 320), taken=f"2018:04:13 08:06:{seed:02d}")
            with tifffile.TiffFile(path) as file:
                offset = file.pages[0].dataoffsets[0]
            with path.open("r+b") as file:
                file.seek(offset)
                file.write(image[20:260, 20:340].astype("<u2").tobytes())
    return sorted(place.glob("*.tif"))


def off_ground(rig):
    """Distance in pixels of two points of green, mapped to near infrared, from where they are."""
    H = rig.links["green", "nir"].H
    x = torch.tensor([[100.0, 80, 1], [200, 150, 1]], dtype=torch.float64) @ H.T
    wanted = torch.from_numpy(np.array([[120.0, 100, 1], [220, 170, 1]]) @ MOVED.T)
    return float((x[:, :2] / x[:, 2:] - (wanted[:, :2] / wanted[:, 2:] - 20)).norm(dim=-1).max())


def test_a_flights_bands_have_no_parallax(tmp_path):
    found = array_from_images(captures_of_ground(tmp_path, [1]), alpha="green")
    assert off_ground(found.rig) < 0.5
    assert found.rig["nir"].distortion is not None
    assert found.rig.pair("green", "nir").at_one_place
    assert found.lasting is None


@pytest.mark.parametrize("listed", [True, False])
def test_a_flight_has_one_rig(tmp_path, capsys, listed):
    """A folder, or its files in the shell's order; an image alone is left out, and named."""
    (tmp_path / "flight").mkdir()
    files = captures_of_ground(tmp_path / "flight", range(1, 5))
    files.pop(6).unlink()
    given = " ".join(map(str, files)) if listed else tmp_path / "flight"
    pat(f"align {given} --alpha green -o {tmp_path / 'out'} --extras none")
    written = {path.name for path in (tmp_path / "out").glob("*_aligned.tif")}
    assert written == {f"IMG_{i:04d}_0_aligned.tif" for i in (1, 2, 3)}
    rig = Rig.load(tmp_path / "out" / "found_rig.yaml")
    assert off_ground(rig) < 0.2
    assert rig.name == REGISTERED
    assert "1 images are left out" in capsys.readouterr().err
    bands = tifffile.imread(tmp_path / "out" / "IMG_0002_0_aligned.tif").astype(float)
    seen = bands[1] > 0
    assert seen.mean() > 0.7
    assert np.corrcoef(bands[0][seen], bands[1][seen])[0, 1] > 0.98


def test_translations_that_will_be_found_are_not_asked_for(capture):
    said = []
    _tagged_rig(camera_names([Path(file) for file in capture()]), said.append)
    assert any("tags" in line for line in said)
    assert not any("RigTranslations" in line for line in said)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--around {}/small.tif", "small.tif: is 80x48, alpha's image is 160x96"),
        ("--around {}/depth.png,scale=1", "state its unit with --around"),
        ("--around {}/far.csv", "outside"),
        ("--confidence 2", "--confidence"),
        ("--alpha nir", "no camera 'nir'"),
    ],
)
def test_bad_input_is_one_line(folder, tmp_path, refusal, options, message):  # noqa: F811
    tifffile.imwrite(folder / "small.tif", np.full((48, 80), 4, np.float32))
    np.savetxt(folder / "far.csv", np.array([[900.0, 20, 890, 20]] * 30), delimiter=",")
    options += "" if "--alpha" in options else " --alpha mono"
    command = f"align {folder / 'rig.yaml'} {images(folder, 'mono', 'colour')} -o {tmp_path / 'out'}"
    assert message in refusal(*command.split(), *options.format(folder).split())


def test_without_a_rig_the_files_rig_is_written(tmp_path, capsys):
    """Its sensors are those of the files: it serves for the next frame."""
    files = {name: tmp_path / f"{name}.png" for name in ("mono", "colour")}
    for name, path in files.items():
        write_image(path, avg_pool2d(load_sample().images[name], 2))
    pat(f"align {files['mono']} {files['colour']} -o {tmp_path / 'found'} --extras npy")
    assert "network: mono-colour" in capsys.readouterr().err
    rig = Rig.load(tmp_path / "found" / "found_rig.yaml")
    assert {name: rig[name].sensor.response for name in rig.names} == {"mono": "mono", "colour": "rgb"}


def test_a_rig_whose_lines_are_open_is_not_written(folder, counts):  # noqa: F811
    """On the post are too few points: the wall's plane explains the others."""
    out = counts / "found"
    pat(f"align {counts / 'mono.png'} {counts / 'colour.png'} -o {out} --extras npy")
    assert (out / "aligned.tif").exists()
    assert not (out / "found_rig.yaml").exists()


def test_frames_are_matched_by_their_names(folder, counts):  # noqa: F811
    """Another frame of each camera is missing: in order, the middle ones would be taken for one frame."""
    for name, frames in {"mono": "012", "colour": "023"}.items():
        (counts / name).mkdir()
        for i in frames:
            shutil.copy(counts / f"{name}.png", counts / name / f"{i}.png")
    folders = f"--image mono={counts / 'mono'} --image colour={counts / 'colour'}"
    pat(f"align {folder / 'rig.yaml'} --alpha mono {folders} -o {counts / 'out'} --misfit warn")
    assert {p.name for p in (counts / "out").glob("*_aligned.tif")} == {"0_aligned.tif", "2_aligned.tif"}
