"""Files of a fusion: bands that no image holds together are written one by one."""

import re
from io import BytesIO

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image, ImageCms

from arraygeom import Camera, Pose
from pat.app.results import depth_scale, refuse_to_replace, save_frame, write_depth
from pat.fusion.frame import Frame
from pat.media.images import read_image
from tests.processes import room_for


def frame_of(bands: int) -> Frame:
    return Frame(torch.rand(bands, 6, 8), torch.full((6, 8), torch.nan), *torch.rand(2, 6, 8))


@pytest.mark.parametrize("bands", [1, 3])
def test_one_band_and_three_are_one_image(bands, tmp_path):
    frame = frame_of(bands)
    written = save_frame(frame, tmp_path, bits=16)
    assert [p.name for p in written] == ["fused.png", "confidence.png"]
    assert torch.allclose(read_image(written[0]), frame.image, atol=1e-4)


@pytest.mark.parametrize("bands", [2, 4])
def test_other_bands_are_written_one_by_one_and_their_mean(bands, tmp_path):
    frame = frame_of(bands)
    points = Camera(K=torch.eye(3).double(), cam_from_world=Pose.identity(), hw=(6, 8))
    assert "points.ply" in [p.name for p in save_frame(frame, tmp_path / "points", points=points)]
    written = save_frame(frame, tmp_path, bits=16, name="7")
    each = [f"7_fused_{i + 1}.png" for i in range(bands)]
    assert [p.name for p in written] == ["7_fused.png", *each, "7_confidence.png"]
    assert torch.allclose(torch.cat([read_image(p) for p in written[1 : 1 + bands]]), frame.image, atol=1e-4)
    assert torch.allclose(read_image(written[0])[0], frame.image.mean(0), atol=1e-4)


def test_a_full_disk_leaves_the_former_files_all_of_one_frame(tmp_path):
    """The depth fits and the fused image does not, as on a full disk."""
    former = Frame(torch.full((3, 60, 80), 0.5), *torch.ones(3, 60, 80))
    save_frame(former, tmp_path, kind="tif", bits=16)
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir() if p.is_file()}
    with room_for(25_000), pytest.raises(OSError, match=r"/fused\.tif") as caught:
        save_frame(Frame(torch.rand(3, 60, 80), *torch.rand(3, 60, 80)), tmp_path, kind="tif", bits=16)
    assert caught.value.filename == str(tmp_path / "fused.tif")
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir() if p.is_file()} == before


def test_depth_in_16_bits_says_its_scale(tmp_path):
    depth = torch.tensor([[1.2343, 7.0, torch.nan, 1e9]])
    assert write_depth(tmp_path / "d.png", depth, near=1.0) == 1000
    assert write_depth(tmp_path / "none.png", torch.full((2, 2), -1.0), along="distance") == 1000
    with Image.open(tmp_path / "none.png") as image:
        assert "along the ray" in image.text["Description"]
    with Image.open(tmp_path / "d.png") as image:
        assert image.text["Description"].startswith("depth: 1000 counts a metre; 0 is unknown")
        assert np.asarray(image).astype(int).tolist() == [[1234, 7000, 0, 65535]]
    assert (depth_scale(0.3), depth_scale(5.0), depth_scale(50.0)) == (10000, 100, 10)
    for near in (-1.0, 0.0, float("inf"), float("nan")):
        with pytest.raises(ValueError, match="near"):
            write_depth(tmp_path / "d.png", depth, near=near)


def test_an_image_that_is_none_is_named_as_it_would_be_called(tmp_path):
    """Not by the temporary file."""
    frame = frame_of(1)
    frame.confidence[0, 0] = torch.nan
    with pytest.raises(ValueError, match=re.escape(str(tmp_path / "confidence.png"))):
        save_frame(frame, tmp_path)


def test_fused_images_say_that_they_are_srgb(tmp_path):
    save_frame(frame_of(3), tmp_path)
    with Image.open(tmp_path / "fused.png") as image:
        profile = ImageCms.ImageCmsProfile(BytesIO(image.info["icc_profile"]))
    assert "sRGB" in ImageCms.getProfileDescription(profile)
    read_image(tmp_path / "fused.png")  # without a warning


def test_depth_and_image_of_a_former_frame_do_not_stay_beside_one_without(tmp_path):
    """An image in another format would look like that of the new depth and confidence."""
    save_frame(Frame(torch.rand(3, 6, 8), torch.ones(6, 8), *torch.rand(2, 6, 8)), tmp_path, kind="tif")
    save_frame(frame_of(3), tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir() if p.is_file()) == ["confidence.png", "fused.png"]


def test_bands_of_any_name_stay_in_the_folder(tmp_path):
    written = save_frame(frame_of(2), tmp_path / "out", bands=["cam0/1", "../../evil"])
    assert len(written) == 4
    assert {path.parent for path in written} == {tmp_path / "out"}


def test_files_of_the_user_stop_a_fusion_before_it_begins(tmp_path):
    """`-o .` deleted and replaced them."""
    for name in ("points.ply", "index.html", "depth.tif", "mine.txt", "7_fused.png"):
        (tmp_path / name).write_text("mine")
    for act in (lambda: refuse_to_replace(tmp_path), lambda: save_frame(frame_of(1), tmp_path, name="7")):
        with pytest.raises(FileExistsError, match=r"depth\.tif|7_fused\.png"):
            act()
    assert {path.read_text() for path in tmp_path.iterdir() if path.is_file()} == {"mine"}
    out = tmp_path / "out"
    save_frame(frame_of(1), out, pages={"index.html": "page"})
    refuse_to_replace(out)
    (out / "index.html").write_text("retouched")
    with pytest.raises(FileExistsError, match=r"index\.html"):
        refuse_to_replace(out)
    refuse_to_replace(out, ["7"])


def test_a_page_links_every_file_beside_it(tmp_path):
    written = save_frame(frame_of(1), tmp_path, pages={"index.html": "<p>before</p><!-- files -->"})
    linked = re.findall('href="([^"]+)"', (tmp_path / "index.html").read_text())
    assert sorted(linked) == sorted(path.name for path in written if path.name != "index.html")


def test_unknown_depth_is_nan_in_the_file_as_in_memory(tmp_path):
    depth = torch.tensor([[1.5, torch.nan, 3.0], [torch.nan, 2.0, 0.5]])
    frame = Frame(torch.rand(3, 2, 3), depth, *torch.rand(2, 2, 3))
    assert tmp_path / "depth.tif" in save_frame(frame, tmp_path)
    found = torch.from_numpy(tifffile.imread(tmp_path / "depth.tif"))
    torch.testing.assert_close(found, depth, equal_nan=True)


def test_a_frame_that_wants_gradients_is_shown_and_saved(tmp_path):
    """The frame of `fuse(..., differentiable=True)`, in a notebook too."""
    hw = (4, 5)
    parts = torch.rand(3, *hw), torch.full(hw, 2.0), torch.rand(hw), torch.full(hw, 0.1)
    frame, wanting = Frame(*parts), Frame(*(part.clone().requires_grad_() for part in parts))
    assert wanting._repr_png_() == frame._repr_png_()
    for name, one in (("plain", frame), ("wanting", wanting)):
        save_frame(one, tmp_path / name)
    for path in (tmp_path / "plain").glob("*.*g"):
        assert (tmp_path / "wanting" / path.name).read_bytes() == path.read_bytes(), path.name
