"""Wrong inputs as owners bring them: each is one line that names what is wrong, before anything is done."""

import json
import time

import cv2
import numpy as np
import pytest
import tifffile

import pat.app.from_images  # noqa: F401  what it imports takes time, once
from tests.arraygeom.rigs import parallel_rig
from tests.arraygeom.test_io import FIXTURES
from tests.arraygeom.test_io_owners import ZED, metashape, opencv
from tests.arraygeom.test_xmp import FISHEYE, PERSPECTIVE, image_of

H, W = 48, 64


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two images of noise, their rig, and matches and a depth map that do not belong to them."""
    folder = tmp_path_factory.mktemp("owners")
    parallel_rig(80.0, (H, W), {"a": (), "b": (0.1,)}, (1.0, 50.0)).save(folder / "rig.yaml")
    for seed, name in enumerate("ab"):
        values = np.random.default_rng(seed).integers(0, 255, (H, W)).astype(np.uint8)
        cv2.imwrite(str(folder / f"{name}.png"), values)
    np.savetxt(folder / "far.csv", np.array([[900.0, 20, 890, 20]] * 30), delimiter=",")
    (folder / "words.csv").write_text("x0,y0,x1,y1\nleft,top,right,bottom\n")
    (folder / "three.csv").write_text("1,2,3\n4,5,6\n")
    tifffile.imwrite(folder / "small.tif", np.full((8, 8), 4, np.float32))
    image_of(folder / "IMG_1.tif", {**FISHEYE, "BandName": "Green"})
    image_of(folder / "IMG_2.tif", {**PERSPECTIVE}, taken="2018:04:13 09:00:00")
    image_of(folder / "DJI_1.tif", {}, dji={"DewarpData": "2020-01-01;1,2,3"})
    return folder


def fixture(name: str, old: str, new: str) -> str:
    text = (FIXTURES / name).read_text()
    assert old in text
    return text.replace(old, new)


def luxonis_of_zeros() -> str:
    document = json.loads((FIXTURES / "luxonis.json").read_text())
    for _, camera in document["cameraData"]:
        camera["intrinsicMatrix"] = [[0] * 3] * 3
    return json.dumps(document)


NERF = {"camera_angle_x": 0.69, "frames": [{"file_path": "a", "transform_matrix": np.eye(4).tolist()}]}
FILES = [
    ("a.yml", opencv(("K1", "E1"), [0.1] * 5, "fisheye: 1\n"), "fisheye"),
    ("a.yml", opencv(("K1", "D1"), [0.1] * 5).partition("R: ")[0], "extrinsics.yml"),
    ("a.yml", opencv(("K1", "D1"), [0.1] * 5, 'distortion_model: "thin"\n'), "thin"),
    ("transforms.json", json.dumps(NERF), "--size"),
    ("transforms.json", fixture("transforms.json", '"OPENCV"', '"EQUIRECTANGULAR"'), "EQUIRECTANGULAR"),
    ("kalibr.yaml", fixture("kalibr.yaml", "camera_model: pinhole", "camera_model: tele"), "camera_model"),
    ("calib.json", luxonis_of_zeros(), "calibrated"),
    ("a.xml", metashape(("1", "2", "3", "4")).replace("<f>", "<p3>0.1</p3><f>"), "p3"),
    ("SN1.conf", ZED.replace("_DISTO", "_OTHER"), "k1"),
    ("azure.json", fixture("azure.json", "BrownConrady", "Other"), "ModelType"),
    ("info.yaml", fixture("ros/left.yaml", "plumb_bob", "omni"), "distortion_model"),
    ("intri.yml", (FIXTURES / "easymocap" / "intri.yml").read_text(), "extri.yml"),
    ("cams.yml", fixture("mccalib.yml", "camera_group: 0", "camera_group: 1"), "camera_group"),
    (
        "cams.json",
        '{"a": {"K": [[5, 0, 3], [0, 5, 2], [0, 0, 1]]}, "b": {"K": [[5, 0, 3], [0, 5, 2], [0, 0, 1]]}}',
        "a",
    ),
    ("rig.dat", "hello", "focal"),
    ("rig.dat", '%YAML:1.0\nCamera.type: "PinHole"\nCamera.fx: 435.2\n', "ORB-SLAM"),
    ("rig.yaml", "cameras:\n  a: {size: [6, 4], distorsion: {}}\n", "distorsion"),
    ("a.json", '{"K": "see the other file"}', "K"),
]
COMMANDS = [
    ("rig info {}/DJI_1.tif", "DewarpData"),
    ("rig convert {}/rig.yaml {}/out.yaml --lens wide", "wide"),
    ("rig convert {}/rig.yaml {}/out.yaml --lens kannala-brandt", "kannala-brandt"),
    ("rig convert {}/rig.yaml {}/out.yaml --size 0 48", "--size"),
    ("rig convert {}/rig.yaml {}/out.yaml --read-as zed", "INI"),
    ("align {}/a.png {}/b.png -o {}/out --matches {}/none.csv", "none.csv"),
    ("align {}/a.png {}/b.png -o {}/out --matches {}/words.csv", "words.csv"),
    ("fuse {}/a.png {}/b.png -o {}/out --matches {}/three.csv", "three.csv"),
    ("align {}/a.png {}/b.png -o {}/out --matches {}/far.csv", "far.csv"),
    ("align {}/a.png {}/b.png -o {}/out --confidence 80", "--confidence"),
    ("fuse {}/a.png {}/b.png -o {}/out --max-memory 4", "--max-memory"),
    ("align {}/IMG_1.tif {}/IMG_2.tif -o {}/out", "time"),
    ("align {}/a.png {}/gone/b.png -o {}/out", "gone"),
    ("fuse {}/rig.yaml --alpha a {}/a.png {}/b.png -o {}/out --depth-map {}/small.tif", "small.tif"),
    ("fuse {}/a.png {}/b.png -o {}/out --focal c=900", "c"),
    ("fuse {}/a.png {}/b.png -o {}/out --depth-map {}/small.tif", "rig"),
]


def refused_at_once(refusal, *words: object) -> str:
    """The line of a refusal that takes no second of the processor's time."""
    before = time.process_time()
    said = refusal(*words)
    assert time.process_time() - before < 1
    return said


@pytest.mark.parametrize(("name", "text", "entry"), FILES)
@pytest.mark.filterwarnings("ignore::arraygeom.io.RigFileWarning")
def test_a_file_that_is_wrong_is_one_line(name, text, entry, tmp_path, refusal):
    (tmp_path / name).write_text(text)
    assert entry in refused_at_once(refusal, "rig", "info", tmp_path / name).replace(str(tmp_path), "")


@pytest.mark.parametrize(("line", "entry"), COMMANDS)
@pytest.mark.filterwarnings("ignore::arraygeom.io.RigFileWarning")
def test_a_command_that_is_wrong_is_one_line(line, entry, folder, refusal):
    said = refused_at_once(refusal, *line.replace("{}", str(folder)).split())
    assert entry in said.replace(str(folder), "")
    assert not (folder / "out").exists()
