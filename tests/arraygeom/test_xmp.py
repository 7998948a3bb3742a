"""Rigs from the tags of images: units, lenses, rotations, orientation, and what is refused."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from arraygeom import Band, Rig
from arraygeom.io import RigFileError, RigFileWarning, recognise
from arraygeom.io.xmp import ImageTags, image_tags, named_by_band

tifffile = pytest.importorskip("tifffile")

FISHEYE = {
    "ModelType": "fisheye",
    "PrincipalPoint": "2.4,1.8",
    "FisheyeAffineMatrix": "1660,0,0,1660",
    "FisheyePolynomial": "0,1,0.0096,-0.1455",
    "CentralWavelength": "660",
    "WavelengthFWHM": "40",
    "BandName": "Red",
}
PERSPECTIVE = {
    "ModelType": "perspective",
    "PrincipalPoint": "2.4,1.8",
    "PerspectiveFocalLength": "5.5",
    "PerspectiveDistortion": "-0.1,0.14,-0.017,-0.0006,-0.0003",
    "BandName": "NIR",
}
PER_MM = 266.666667


def image_of(
    path: Path,
    tags,
    *,
    dji=None,
    orientation=1,
    serial="A1",
    hw=(960, 1280),
    taken="2018:04:13 08:06:58",
    exposure=(3, 1000),
    black=True,
) -> Path:
    """A TIFF file of zeros with these Camera: tags, half of them as elements."""
    parts = [f'Camera:{k}="{v}"' for k, v in list(tags.items())[::2]]
    parts += [f'drone-dji:{k}="{v}"' for k, v in (dji or {}).items()]
    lists = [
        f"<Camera:{k}><rdf:Seq><rdf:li>{v.replace(',', '</rdf:li><rdf:li>')}</rdf:li></rdf:Seq></Camera:{k}>"
        for k, v in list(tags.items())[1::2]
    ]
    xmp = (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF '
        'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        '<rdf:Description xmlns:Camera="http://pix4d.com/camera/1.0/" '
        f'xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" {" ".join(parts)}>{"".join(lists)}'
        "</rdf:Description></rdf:RDF></x:xmpmeta>"
    ).encode()
    fields = [
        (700, "B", len(xmp), xmp, True),
        (274, "H", 1, orientation, True),
        (0xA20E, "2I", 1, (266666667, 1000000), True),
        (0xA20F, "2I", 1, (266666667, 1000000), True),
        (0xA210, "H", 1, 4, True),
        (0xA431, "s", 0, serial, True),
        (0x9003, "s", 0, taken, True),
        (0x829A, "2I", 1, exposure, True),
        (50714, "H", 4, (4000, 4002, 4000, 4002), True),
    ]
    fields = fields if black else fields[:-1]
    tifffile.imwrite(path, np.zeros(hw, np.uint16), extratags=fields, metadata=None)
    return path


def pair(tmp_path, second, **options) -> Path:
    image_of(tmp_path / "IMG_1.tif", {**FISHEYE, "BandName": "Green"})
    return image_of(tmp_path / "IMG_2.tif", second, **options)


def test_a_fisheye_is_the_makers_formula(tmp_path):
    path = image_of(tmp_path / "IMG_1.tif", FISHEYE)
    assert recognise(path) == "xmp"
    camera = Rig.load(path)["red"]
    X = torch.tensor([[0.3, -0.2, 1.0], [-0.5, 0.4, 0.8]], dtype=torch.float64)
    r = X[:, :2].norm(dim=-1)
    theta = 2 / math.pi * torch.atan2(r, X[:, 2])
    rho = theta + 0.0096 * theta**2 - 0.1455 * theta**3
    expected = 1660 * rho[:, None] * X[:, :2] / r[:, None] + PER_MM * torch.tensor(
        [2.4, 1.8], dtype=torch.float64
    )
    assert (camera.project(X).x - expected).abs().max() < 1e-9
    assert camera.sensor.response == Band(660.0, 40.0)
    assert camera.sensor.black_level == 4001
    assert camera.sensor.exposure == pytest.approx(0.003)


def test_an_empty_tag_is_not_stated(tmp_path):
    path = image_of(tmp_path / "IMG_1.tif", {**FISHEYE, "CentralWavelength": ""})
    assert Rig.load(path)["red"].sensor.response is None


@pytest.mark.parametrize(
    "focal", [{"PerspectiveFocalLength": "5.5"}, {"PerspectiveFocalLength": str(5.5 * PER_MM)}]
)
def test_focal_lengths_are_in_millimetres_or_pixels(tmp_path, focal):
    camera = Rig.load(image_of(tmp_path / "IMG_1.tif", {**PERSPECTIVE, **focal}))["nir"]
    assert float(camera.K[0, 0]) == pytest.approx(5.5 * PER_MM)
    assert camera.distortion.coefficients.tolist() == [-0.1, 0.14, -0.0006, -0.0003, -0.017]


def test_rig_relatives_are_from_the_camera_to_the_rig_and_translations_its_centre(tmp_path):
    further = {"RigRelatives": "0,0,90", "RigTranslations": "0.01,-0.02,0"}
    rig = Rig.load(pair(tmp_path, {**PERSPECTIVE, **further}))
    X = rig["nir"].cam_from_world.inverse().apply(torch.tensor([1.0, 0, 0], dtype=torch.float64))
    assert torch.allclose(X, torch.tensor([0.01, 0.98, 0], dtype=torch.float64))
    assert torch.equal(rig["green"].R, torch.eye(3, dtype=torch.float64))


def test_an_exposure_of_nothing_by_nothing_is_not_stated(tmp_path):
    camera = Rig.load(image_of(tmp_path / "IMG_1.tif", FISHEYE, exposure=(0, 0)))["red"]
    assert camera.sensor.exposure is None


def test_damaged_images_have_tags_or_none(tmp_path):
    path = image_of(tmp_path / "IMG_1.tif", FISHEYE, hw=(4, 6))
    content, random = path.read_bytes(), np.random.default_rng(0)
    for _ in range(300):
        damaged = np.frombuffer(content, np.uint8).copy()
        damaged[random.integers(0, 400, 3)] = random.integers(0, 256, 3)
        path.write_bytes(damaged.tobytes())
        tags = image_tags(path)
        assert tags is None or isinstance(tags, ImageTags)


def test_tags_are_of_the_stored_pixels_and_the_rig_of_upright_ones(tmp_path):
    stored, rotated = (
        Rig.load(image_of(tmp_path / f"{name}.tif", FISHEYE, orientation=n))["red"]
        for name, n in (("a", 1), ("b", 3))
    )
    X = torch.tensor([0.3, -0.2, 1.0], dtype=torch.float64)
    last = torch.tensor([1279.0, 959.0], dtype=torch.float64)
    assert torch.allclose(rotated.project(X).x, last - stored.project(X).x)


def test_missing_translations_are_said(tmp_path):
    path = pair(tmp_path, PERSPECTIVE)
    with pytest.warns(RigFileWarning, match="RigTranslations"):
        assert set(Rig.load(path).names) == {"green", "nir"}


@pytest.mark.parametrize("flag", [0, 1])
def test_djis_other_tags(flag, tmp_path):
    """DewarpFlag 1: dewarped already, so that no lens is left; black level, gain and band."""
    data = {
        "DewarpFlag": str(flag),
        "DewarpData": "2022-01-01;2200,2201,10,-5,-0.1,0.05,0.001,-0.002,0.01",
        "BandName": "NIR",
        "CentralWavelength": "860",
        "BlackCurrent": "3200",
        "SensorGain": "2.0",
    }
    camera = Rig.load(image_of(tmp_path / "DJI_1.tif", {}, dji=data, black=False))["nir"]
    assert (camera.distortion is None) == bool(flag)
    assert (camera.sensor.black_level, camera.sensor.gain) == (3200, 2)
    assert camera.sensor.response == Band(860, 20)


def test_what_tags_do_not_state_is_said(tmp_path):
    """No black level is not one of 0, no ISO speed not a gain of 1, no DewarpFlag not one of 0."""
    data = {
        "DewarpData": "2022-01-01;2200,2201,10,-5,-0.1,0.05,0.001,-0.002,0.01",
        "CalibratedHMatrix": "1,0,0",
    }
    path = image_of(tmp_path / "DJI_1.tif", {}, dji=data, black=False)
    with pytest.warns(RigFileWarning) as caught:
        Rig.load(path)
    said = " ".join(str(w.message) for w in caught)
    assert all(name in said for name in ("black level", "gain", "DewarpFlag", "CalibratedHMatrix"))


def test_dewarp_data(tmp_path):
    data = {
        "DewarpData": "2022-01-01;2200,2201,10,-5,0.01,-0.02,0.001,-0.002,0.03",
        "CalibratedOpticalCenterX": "640",
    }
    camera = Rig.load(image_of(tmp_path / "DJI_1.tif", {}, dji=data))["1"]
    assert camera.K[:2].tolist() == [[2200, 0, 650], [0, 2201, 475]]
    assert camera.distortion.coefficients.tolist() == [0.01, -0.02, 0.001, -0.002, 0.03]


@pytest.mark.parametrize(
    ("changed", "options", "message"),
    [
        ({"PrincipalPoint": "24,18"}, {}, "PrincipalPoint.*6400"),
        ({"ModelType": "spherical"}, {}, "ModelType.*'spherical'"),
        ({"FisheyePolynomial": "0.1,1,0"}, {}, "FisheyePolynomial: "),
        ({"FisheyeAffineMatrix": "1660,0"}, {}, "FisheyeAffineMatrix: "),
        ({"RigTranslations": "12.5,0,0"}, {}, "RigTranslations: "),
        ({}, {"serial": "B2"}, "serial"),
        ({"CaptureUUID": "two"}, {}, "capture"),
        ({}, {"taken": "2018:04:13 08:07:01"}, "'green'"),
        ({}, {"orientation": 2}, "mirrored"),
        ({}, {"hw": (300, 400)}, "cropped"),
    ],
)
def test_mistakes_are_named(tmp_path, changed, options, message):
    image_of(tmp_path / "IMG_1.tif", {**FISHEYE, "BandName": "Green", "CaptureUUID": "one"})
    path = image_of(tmp_path / "IMG_2.tif", {**FISHEYE, **changed}, **options)
    with pytest.raises(RigFileError, match=message) as refused:
        Rig.load(path)
    assert "\n" not in str(refused.value)


def test_images_of_two_places_are_named(tmp_path, monkeypatch):
    """The GPS directory by its tags: 48 degrees 30' north, and the same south."""
    path = pair(tmp_path, FISHEYE)
    places = {"IMG_1.tif": "N", "IMG_2.tif": "S"}

    def tags(path):
        found = image_tags(path)
        gps = {1: (places[path.name],), 2: (48.0, 30.0, 0.0), 3: ("E",), 4: (2.0, 0.0, 0.0)}
        return found._replace(fields=found.fields | gps)

    monkeypatch.setattr("arraygeom.io.xmp.image_tags", tags)
    with pytest.raises(RigFileError, match=r"'green' .-48.5000, 2.0000; 48"):
        Rig.load(path)
    places["IMG_2.tif"] = "N"
    assert len(Rig.load(path).names) == 2


def test_stated_vignetting_is_said_to_be_left(tmp_path):
    with pytest.warns(RigFileWarning, match=r"vignetting[^/]*$"):
        Rig.load(pair(tmp_path, {**FISHEYE, "VignettingPolynomial": "1e-5,2e-7"}))


@pytest.mark.parametrize(("folder", "bands"), [("sequoia", 5), ("rededge", 5)])
@pytest.mark.filterwarnings("ignore::arraygeom.io.RigFileWarning")
def test_real_captures_round_trip(shared_data, tmp_path, folder, bands):
    files = sorted((shared_data / "multispectral" / folder).glob("IMG*"))
    rig = Rig.load(files[0])
    assert len(rig.names) == bands == len(named_by_band(files))
    rig.save(tmp_path / "rig.yaml")
    assert Rig.load(tmp_path / "rig.yaml") == rig
