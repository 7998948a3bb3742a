"""Counts to images: black level, bits, filter mosaic, coding and exposure undo the camera's processing."""

import cv2
import numpy as np
import pytest
import torch

from arraygeom import Band, Rig, Sensor, View
from experiments.sensors import Mosaic
from pat.app.aligned_files import RecordedFiles
from pat.fusion.views import ViewFiles
from pat.media.colour import linear_from_srgb, luminance, srgb_from_linear
from pat.media.depth_maps import read_depth
from pat.media.images import write_image
from pat.media.raw import demosaiced, develop, developed, match_luminance

HW = (48, 64)


def light(*, channels=3, white=1.0):
    """Smooth linear light, up to `white`."""
    rough = torch.rand(1, channels, 6, 8, generator=torch.Generator().manual_seed(0))
    fine = torch.nn.functional.interpolate(rough, HW, mode="bicubic", align_corners=False)[0]
    return (0.1 + 0.8 * fine).clamp(0.02, 1) * white


def counts(linear, *, bits, black, shift=0):
    full = 2**bits - 1
    values = black + linear.numpy().astype(np.float64) * (full - black)
    return np.rint(values).clip(0, full).astype(np.uint16) << shift


def mosaic(rgb, pattern):
    return Mosaic(pattern).apply(rgb[None], torch.Generator())[0]


def save(path, values):
    planes = values[0] if len(values) == 1 else values.transpose(1, 2, 0)[..., ::-1]
    assert cv2.imwrite(str(path), planes)


def rig(**sensors):
    return Rig({name: View(hw=HW, sensor=sensor) for name, sensor in sensors.items()})


@pytest.mark.parametrize(("bits", "suffix"), [(10, "png"), (12, "tif"), (14, "tif"), (16, "png")])
def test_counts_of_any_depth_become_the_light_they_stood_for(tmp_path, bits, suffix):
    save(tmp_path / f"a.{suffix}", counts(light(), bits=bits, black=64))
    sensor = Sensor(coding="linear", bits=bits, black_level=64)
    read = ViewFiles(rig(a=sensor), {"a": tmp_path / f"a.{suffix}"}, alpha="a")
    assert (linear_from_srgb(read["a"]) - light()).abs().max() < 0.6 / (2**bits - 65)
    assert read.developed["a"].sensor == Sensor()


@pytest.mark.parametrize(("response", "bands"), [("mono", 1), (Band(850, 40), 1), ("rgb", 3), (None, 3)])
def test_three_equal_bands_of_a_camera_in_grey_are_one(tmp_path, response, bands):
    """In many frames and with a rig too: three such cameras make three bands, not nine."""
    write_image(tmp_path / "a.png", light(channels=1).expand(3, -1, -1))
    cameras, files = rig(a=Sensor(response)), {"a": tmp_path / "a.png"}
    for images in (ViewFiles(cameras, files, alpha="a"), RecordedFiles(cameras, files)):
        assert images["a"].shape == (bands, *HW)


@pytest.mark.parametrize("bits", [12, 32])
def test_recorded_values_behind_a_mosaic_are_colours_in_their_own_counts(tmp_path, bits):
    """Floats are demosaiced too."""
    raw = mosaic(light(), "RGGB")
    values = counts(raw, bits=12, black=0) if bits == 12 else raw.numpy()
    save(tmp_path / "a.tif", values)
    sensor = Sensor(bits=12 if bits == 12 else None, bayer="RGGB")
    found = RecordedFiles(rig(a=sensor), {"a": tmp_path / "a.tif"})
    assert found["a"].dtype == values.dtype
    assert np.abs(found["a"] / (4095 if bits == 12 else 1) - demosaiced(raw, "RGGB").numpy()).mean() < 3e-4


@pytest.mark.parametrize("bits", [12, 10])
def test_packed_tiffs_need_no_bits_and_follow_them(tmp_path, bits):
    """A TIFF with 12 bits a value, two values in three bytes, or 10, written here by hand."""
    values = counts(light(channels=1), bits=bits, black=0)[0]
    digits = "".join(f"{v:0{bits}b}" for v in values.ravel())
    data = int(digits, 2).to_bytes(len(digits) // 8, "big")
    h, w = HW
    tags = [
        (256, w),
        (257, h),
        (258, bits),
        (259, 1),
        (262, 1),
        (273, 8),
        (277, 1),
        (278, h),
        (279, len(data)),
    ]
    entry = b"".join(np.array([t, 4], "<u2").tobytes() + np.array([1, v], "<u4").tobytes() for t, v in tags)
    head = b"II*\0" + np.array([8 + len(data)], "<u4").tobytes()
    (tmp_path / "a.tif").write_bytes(head + data + np.array([len(tags)], "<u2").tobytes() + entry + bytes(4))
    for given in (None, bits):
        read = ViewFiles(rig(a=Sensor(coding="linear", bits=given)), {"a": tmp_path / "a.tif"}, alpha="a")
        assert (linear_from_srgb(read["a"]) - light(channels=1)).abs().max() < 0.6 / (2**bits - 1)
    assert torch.equal(
        read_depth(tmp_path / "a.tif").nan_to_num(), torch.from_numpy(values * np.float32(0.001))
    )


@pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_colours_come_back_from_behind_each_filter_pattern(tmp_path, pattern):
    save(tmp_path / "a.png", counts(mosaic(light(), pattern), bits=12, black=100))
    sensor = Sensor(coding="linear", bits=12, black_level=100, bayer=pattern)
    read = ViewFiles(rig(a=sensor), {"a": tmp_path / "a.png"}, alpha="a")["a"]
    off = (linear_from_srgb(read) - light()).abs()[:, 2:-2, 2:-2]
    assert off.mean() < 0.006  # the bands vary independently here, for which the median costs a quarter
    assert off.max() < 0.08


@pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_developing_a_mosaic_moves_nothing(pattern):
    """A ramp has no curvature: inside the border it is reproduced exactly."""
    y, x = torch.meshgrid(torch.linspace(0.1, 0.4, 40), torch.linspace(0.1, 0.5, 60), indexing="ij")
    ramp = torch.stack([x, y, x + y])
    back = demosaiced(mosaic(ramp, pattern), pattern)
    torch.testing.assert_close(back[:, 2:-2, 2:-2], ramp[:, 2:-2, 2:-2], atol=2e-3, rtol=0)


def test_exposures_and_gains_are_brought_to_alphas():
    """The same light through four times the exposure, twice the gain and a white balance."""
    alpha, scene = Sensor(exposure=0.01), light(channels=3, white=0.2)
    wide = Sensor(exposure=0.04, gain=(0.5, 1.0, 0.8), coding="linear")
    recorded = scene * 4 * torch.tensor([0.5, 1.0, 0.8])[:, None, None]
    for values, sensor in (
        (recorded, wide),
        (srgb_from_linear(4 * scene), Sensor(exposure=0.02, gain=2.0)),
        (2 * scene, Sensor(gain=2.0, coding="linear")),
    ):
        found = develop(values, sensor, like=alpha)
        torch.testing.assert_close(found, srgb_from_linear(scene), atol=1e-5, rtol=0)


def test_ordinary_images_pass_unchanged():
    image = light()
    assert develop(image, Sensor()) is image


@pytest.mark.parametrize(
    ("sensor", "values", "message"),
    [
        (Sensor(bits=10), np.full((1, *HW), 1024, np.uint16), "a.*1024"),
        (Sensor(bits=12), np.zeros((1, *HW), np.uint8), "value"),
        (Sensor(bayer="RGGB"), np.zeros((3, *HW), np.uint8), "RGGB"),
        (Sensor(), np.zeros((1, 48, 60), np.uint8), "60x48.*64x48"),
    ],
)
def test_what_does_not_fit_the_rig_is_named(tmp_path, sensor, values, message):
    save(tmp_path / "a.png", values)
    with pytest.raises(ValueError, match=message):
        ViewFiles(rig(a=sensor), {"a": tmp_path / "a.png"}, alpha="a")["a"]


def test_exr_is_written_and_holds_the_floats(tmp_path):
    OpenEXR = pytest.importorskip("OpenEXR")
    image = torch.rand(3, *HW) * 3 - 1
    write_image(tmp_path / "a.exr", image, bits=32)
    planes = OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True).channels()
    for name, plane in zip("RGB", image):
        assert np.array_equal(planes[name].pixels, plane.numpy())
    with pytest.raises(ValueError, match="32-bit"):
        write_image(tmp_path / "b.exr", image, bits=16)
    assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]


def test_a_image_is_as_bright_as_the_light_that_alpha_measured():
    """The right chroma on alpha's values is too bright where colours are strong; then it is true again."""
    linear = light() ** torch.tensor([1.0, 3.0, 0.5]).view(3, 1, 1)
    ground_truth, alpha = srgb_from_linear(linear), srgb_from_linear(luminance(linear))
    fused = ground_truth - luminance(ground_truth) + alpha
    assert (fused - ground_truth).abs().max() > 0.02
    measured = developed(Sensor(response="mono", coding="linear"))
    assert (match_luminance(fused, alpha, measured) - ground_truth).abs().max() < 1e-4
    for unknown in (Sensor("mono"), Sensor("nir", coding="linear"), Sensor(coding="linear")):
        assert match_luminance(fused, alpha, developed(unknown)) is fused


def test_a_mosaic_makes_little_false_colour():
    """A grey image with detail of two pixels: 30 % less colour than by interpolation alone."""
    grey = torch.rand(1, 1, 24, 32, generator=torch.Generator().manual_seed(1))
    image = torch.nn.functional.interpolate(grey, HW, mode="bicubic", align_corners=False)[0].clamp(0, 1)
    raw = mosaic(image.expand(3, -1, -1), "RGGB")
    whole = (raw[0].numpy() * 65535).round().astype(np.uint16)
    plain = cv2.demosaicing(whole, cv2.COLOR_BayerRGGB2RGB_EA).transpose(2, 0, 1) / 65535
    of_plain, ours = (np.abs(rgb - rgb[1:2]).mean() for rgb in (plain, demosaiced(raw, "RGGB").numpy()))
    assert ours < 0.7 * of_plain


def test_a_pattern_by_opencvs_two_letters_and_mosaics_without_neighbours_are_refused():
    with pytest.raises(ValueError, match="'BG'"):
        demosaiced(light(channels=1), "BG")
    for hw in ((2, 6), (6, 2), (1, 1)):
        with pytest.raises(ValueError, match=f"{hw[1]}x{hw[0]}"):
            demosaiced(torch.rand(1, *hw), "RGGB")
    assert demosaiced(torch.full((1, 3, 3), 0.5), "RGGB").min() > 0.4
