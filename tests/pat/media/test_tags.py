"""Tags of image files, carried to what is made of them."""

import re

import numpy as np
import pytest
import tifffile
from PIL import ExifTags, Image

from arraygeom.io.xmp import image_tags
from pat.app.aligned_files import write_bands
from pat.media.tags import EXIF, GPS, recorded_tags

XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description xmlns:Camera="http://pix4d.com/camera/1.0/" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"
 Camera:BandName="Green" Camera:ModelType="perspective" drone-dji:GimbalYawDegree="+12.3"
 Camera:RigCameraIndex="2">
<Camera:CentralWavelength>560</Camera:CentralWavelength><Camera:PrincipalPoint>2.4,1.8</Camera:PrincipalPoint>
<Camera:VignettingPolynomial><rdf:Seq><rdf:li>1</rdf:li></rdf:Seq></Camera:VignettingPolynomial>
</rdf:Description></rdf:RDF></x:xmpmeta>"""


@pytest.fixture
def recorded(tmp_path):
    """A photograph with a place, an exposure and tags of a drone's camera."""
    exif = Image.Exif()
    exif[ExifTags.Base.Make], exif[ExifTags.Base.Orientation] = "Maker", 6
    gps, photo = exif.get_ifd(GPS), exif.get_ifd(EXIF)
    gps |= {1: "N", 2: (36.0, 34.0, 33.8934), 3: "W", 4: (119.0, 26.0, 6.93744), 5: b"\0", 6: 174.5}
    photo |= {0x829A: 0.001395, 0x9003: "2017:10:19 20:42:10", 0x927C: b"the maker's own", 0x920A: 5.5}
    Image.new("L", (40, 30), 90).save(tmp_path / "a.jpg", exif=exif, xmp=XMP.encode())
    return tmp_path / "a.jpg"


@pytest.mark.parametrize("count", [1, 5])
def test_place_exposure_and_camera_go_into_the_file(recorded, tmp_path, count):
    tags, values = recorded_tags(recorded), np.arange(count * 1200, dtype=np.uint16).reshape(count, 30, 40)
    bands = ["green", "nir", "red", "blue", "red_edge"][:count]
    waves = [560.0, 840.0, 668.0, 475.0, 717.0][:count]
    write_bands(tmp_path / "out.tif", values, bands, waves, [{"BLACK_LEVEL": 4800.0}] * count, tags)
    with tifffile.TiffFile(tmp_path / "out.tif") as file:
        page = file.pages[0]
        assert (file.asarray() == np.squeeze(values)).all()
        place = page.tags[GPS].value
        assert place["GPSLatitudeRef"] == "N"
        assert np.divide(*np.reshape(place["GPSLongitude"], (3, 2)).T) == pytest.approx((119, 26, 6.93744))
        photo = page.tags[EXIF].value
        assert np.divide(*photo["ExposureTime"]) == pytest.approx(0.001395)
        assert photo["DateTimeOriginal"] == "2017:10:19 20:42:10"
        assert "MakerNote" not in photo
        assert page.tags["Make"].value == "Maker"
        assert 274 not in page.tags or page.tags[274].value == 1  # the pixels are upright
        packet = page.tags[700].value.decode()
        assert f'name="BLACK_LEVEL" sample="{count - 1}">4800<' in page.tags[42112].value
    assert re.findall(r"<rdf:li>([^<]*)", packet) == [*bands, *(f"{wave:g}" for wave in waves)]
    assert 'GimbalYawDegree="+12.3"' in packet
    assert "2.4,1.8" in packet
    assert "Vignetting" not in packet
    assert "RigCameraIndex" not in packet
    if count == 1:
        again = image_tags(tmp_path / "out.tif")  # by Pillow
        assert again.xmp["BandName"] == "green"
        assert tuple(map(float, again.fields[4])) == pytest.approx((119, 26, 6.93744))


def test_files_without_tags_and_damaged_ones_have_none(tmp_path):
    Image.new("L", (8, 8)).save(tmp_path / "bare.png")
    (tmp_path / "damaged.jpg").write_bytes(b"\xff\xd8\xff\xe1\0\x10Exif\0\0II*\0")
    assert recorded_tags(tmp_path / "bare.png") is None
    assert recorded_tags(tmp_path / "damaged.jpg") is None
