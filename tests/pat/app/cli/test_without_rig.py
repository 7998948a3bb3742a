"""`pat fuse` of images alone: which is alpha, the rig, the page, and one line for what cannot be fused."""

import io
import re
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from torch.nn.functional import avg_pool2d

from arraygeom import Camera, Pose, Rig, Sensor, View
from experiments.evaluation.paper import with_found_rig
from pat import FuseSettings, fuse, load_weights
from pat.app.cli.sequence import FuseSequence
from pat.app.from_images import ImageArray, array_from_images, camera_names, found_rig
from pat.app.results import save_frame
from pat.app.sample_array import load_sample
from pat.fusion.frame import Frame
from pat.media.images import read_image, write_image
from pat.media.tags import focal_length
from pat.media.video import read_video, write_video
from pat.support.jobs import JobReport
from pat.support.metrics import score
from tests.pat.commands import images, pat

DEPTHS = {"depth.png", "depth.tif", "depth_16.png", "depth_farthest.tif", "depth_nearest.tif"}
ALL = {"confidence.png", *DEPTHS, "fused.png", "index.html", "found_rig.yaml", "view.yaml"}


@pytest.fixture(scope="module")
def halved():
    """The sample array at half its size, and its ground truth."""
    sample = load_sample()
    rig = sample.rig.resize("mono", (200, 320)).resize("colour", (180, 280))
    return (
        rig,
        {name: avg_pool2d(image, 2) for name, image in sample.images.items()},
        avg_pool2d(sample.ground_truth, 2),
    )


@pytest.fixture(scope="module")
def folder(halved, tmp_path_factory):
    """The images as files, and what `pat fuse mono.png colour.png` makes of them."""
    folder = tmp_path_factory.mktemp("without_rig")
    for name, image in halved[1].items():
        write_image(folder / f"{name}.png", image)
    with pytest.MonkeyPatch.context() as patched:
        # the images are larger, as photographs are than 1600
        patched.setattr("pat.app.from_images.MATCHED", 300)
        pat(f"fuse {folder / 'colour.png'} {folder / 'mono.png'} -o {folder / 'out'}")
    return folder


def test_images_alone_are_fused_about_as_well_as_with_the_rig(halved, folder):
    rig, images, ground_truth = halved
    bounds = {"depth_nearest.tif", "depth_farthest.tif"}  # not by focal lengths that are assumed
    assert {path.name for path in (folder / "out").glob("*.*")} - {".arraygeom"} == ALL - bounds
    known = fuse(images, rig, alpha="mono", network=load_weights("mono-colour"))
    with_rig = score(known.image.clamp(0, 1), ground_truth).psnr
    assert score(read_image(folder / "out" / "fused.png"), ground_truth).psnr > with_rig - 0.5


def test_fuse_of_images_alone_is_that_of_the_command(folder, monkeypatch):
    monkeypatch.setattr("pat.app.from_images.MATCHED", 300)
    said = []
    frame = fuse([folder / "colour.png", folder / "mono.png"], explain=said.append)
    assert float((frame.image.clamp(0, 1) - read_image(folder / "out" / "fused.png")).abs().max()) < 2 / 255
    assert any(line.startswith("alpha, whose view and detail the result has: mono") for line in said)
    with pytest.raises(TypeError, match="images"):
        fuse(load_weights("mono-colour"), alpha="mono")
    with pytest.raises(ValueError, match=r"tele=900.*mono, colour"):
        array_from_images({name: folder / f"{name}.png" for name in ("mono", "colour")}, focal={"tele": 900})
    assert repr(frame) == str(frame)
    assert re.fullmatch(r"Frame\(320x200, 3 bands, depth .* to .*, mean confidence 0\.\d+\)", repr(frame))
    with Image.open(io.BytesIO(frame._repr_png_())) as picture:
        assert picture.size == (3 * 320, 200)


def test_the_evaluation_without_a_rig_is_that_of_the_command(folder, monkeypatch):
    monkeypatch.setattr("pat.app.from_images.MATCHED", 300)
    mono, colour = (read_image(folder / f"{name}.png") for name in ("mono", "colour"))
    found = with_found_rig(load_weights("mono-colour"))(mono, colour, 0.0).image
    written = read_image(folder / "out" / "fused.png")
    assert float((found.clamp(0, 1) - written).abs().max()) < 2 / 255


def test_the_rig_that_was_found_serves_the_next_command(folder):
    rig = Rig.load(folder / "out" / "found_rig.yaml")
    assert rig.names == ("mono", "colour")
    assert all(isinstance(camera, Camera) for camera in rig.cameras.values())
    files = f"{folder / 'mono.png'} {folder / 'colour.png'}"
    pat(f"fuse {folder / 'out' / 'found_rig.yaml'} {files} --alpha mono -o {folder / 'next'}")
    again, first = (read_image(folder / out / "fused.png") for out in ("next", "out"))
    assert float((again - first).abs().max()) <= 2 / 255
    assert all(" baselines" in (folder / out / "index.html").read_text() for out in ("next", "out"))
    assert not (folder / "next" / "found_rig.yaml").exists()


def test_the_rig_that_is_written_is_of_the_files_as_they_were_recorded(folder, tmp_path, monkeypatch):
    """For tagged raw images it has their black level and linear light."""
    rig = Rig.load(folder / "out" / "found_rig.yaml")
    raw = rig.with_camera(
        "colour", rig["colour"].replace(sensor=Sensor(coding="linear", bits=16, black_level=64.0))
    )
    given = {name: read_image(folder / f"{name}.png") for name in rig.names}
    found = ImageArray(rig, raw, given, "mono", "mono-colour", False, ())
    monkeypatch.setattr("pat.app.from_images.array_from_images", lambda *a, **k: found)
    pat(f"fuse {folder / 'mono.png'} {folder / 'colour.png'} --extras none -o {tmp_path}")
    assert Rig.load(tmp_path / "found_rig.yaml")["colour"].sensor == raw["colour"].sensor


def test_weights_are_for_the_cameras_that_are_fused(halved, monkeypatch):
    """With one of red, green and blue left out, two bands get the weights for bands."""
    _, images, _ = halved
    names = ["mono", "cam_red", "cam_green", "cam_blue"]
    bands = dict(zip(names, [images["mono"], *images["colour"].split(1)]))
    cameras = {name: View(hw=image.shape[-2:]) for name, image in bands.items()}
    for kept, weights in ((4, "mono-colour"), (3, "mono-spectral")):
        found = Rig(cameras), names[:kept]
        monkeypatch.setattr("pat.app.from_images.found_rig", lambda *_, found=found: found)
        array = array_from_images(bands, alpha="mono")
        assert array.weights == weights
        assert {array.rig[name].sensor.response for name in array.images} == {"mono"}


def test_a_beta_of_four_bands_is_matched_by_their_mean(halved):
    """The first band alone is dark where others are bright, and matches nothing."""
    colour = halved[1]["colour"]
    array = array_from_images({**halved[1], "colour": torch.cat([1 - colour[1:2], colour])})
    assert (array.weights, array.rig.names) == ("mono-spectral", ("mono", "colour"))


def test_a_rig_of_ones_own_beside_the_result_is_kept(folder, tmp_path):
    """The estimated rig is written under another name."""
    (tmp_path / "rig.yaml").write_text("my own")
    frame = Frame(torch.rand(3, 8, 8), torch.full((8, 8), 2.0), *torch.ones(2, 8, 8))
    save_frame(frame, tmp_path, rig=Rig.load(folder / "out" / "found_rig.yaml"))
    assert (tmp_path / "rig.yaml").read_text() == "my own"
    assert (tmp_path / "found_rig.yaml").is_file()


def test_exr_is_refused_before_anything_is_read(monkeypatch, refusal, tmp_path):
    """No work is lost."""
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    given = ["fuse", "no.png", "nothing.png", "--format", "exr", "-o", str(tmp_path / "out")]
    assert "writing EXR needs" in refusal(*given)


def test_what_cannot_be_fused_is_one_line_and_leaves_nothing(folder, tmp_path, refusal):
    mono, colour = folder / "mono.png", folder / "colour.png"
    noise = np.random.default_rng(0).integers(0, 255, (200, 320, 3), np.uint8)
    ramp = np.tile(np.linspace(0, 255, 320, dtype=np.uint8), (200, 1))
    files = {"other": cv2.GaussianBlur(noise, (0, 0), 2), "flat": np.full_like(noise, 90), "ramp": ramp}
    for name, values in files.items():
        cv2.imwrite(str(tmp_path / f"{name}.png"), values)
    write_video(tmp_path / "clip.mp4", [torch.rand(3, 32, 32)])
    (tmp_path / "x.heic").write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic")
    shutil.copy(mono, tmp_path / "copy.png")
    for name in ("again.png", "again_copy.png"):
        shutil.copy(colour, tmp_path / name)
    out = ["-o", tmp_path / "out"]
    cases = {
        "other.png": "points seen in both 'mono' and 'other' agree",
        "flat.png": "flat.png: is of one colour",
        "ramp.png": "hardly any texture",
        "copy.png": "'mono' and 'copy'",
        "again.png other.png again_copy.png": "'again' and 'again_copy'",
        "clip.mp4": "clip.mp4 is a video and",
        "x.heic": "x.heic: ",
        "none.png": "none.png: no such image",
        "": "give two images or more",
    }
    for names, message in cases.items():
        assert message in refusal("fuse", mono, *(tmp_path / name for name in names.split()), *out)
        assert not (tmp_path / "out").exists()
    for options, said in {
        "--alpha tele": "no camera 'tele'; the images' names are mono, colour",
        "--noise mono=-5": "must be 1 or more, such as 200, got -5",
        "--noise tele=100": "--noise",
        "--depth 1 2": "--depth",
    }.items():
        assert said in refusal("fuse", mono, colour, *options.split(), *out)
    assert not (tmp_path / "out").exists()
    named = f"mono={mono}"
    assert f"give {mono} alone" in refusal("fuse", named, colour, *out)
    said = refusal("fuse", "--image", named, *out)
    assert f"--image needs a rig: give --rig RIG, or the images alone: `pat fuse {mono}`" in said
    unwritable = ["-o", folder / "mono.png" / "out"]
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("pat.app.from_images.array_from_images", None)  # the rig is not looked for
        assert "mono.png" in refusal("fuse", mono, colour, *unwritable)


def test_what_does_not_go_with_a_rig_or_with_many_frames_is_refused(folder, tmp_path, refusal):
    in_folders = two_frames_each(folder, tmp_path)
    given = [folder / "out" / "found_rig.yaml", "--alpha", "mono", "-o", tmp_path / "out"]
    stray = tmp_path / "mono" / "0.png", folder / "colour.png"
    assert "0.png: no camera of the rig has its name: give --image NAME=" in refusal("fuse", *given, *stray)
    named = [word for path in in_folders for word in ("--image", f"{path.name}={path}")]
    for names in (named, in_folders):
        assert "`pat batch`" in refusal("fuse", *(given if names is named else given[3:]), *names)
    assert not (tmp_path / "out").exists()


def two_frames_each(folder, into):
    """A folder for each camera with its image twice."""
    for name in ("mono", "colour"):
        (into / name).mkdir()
        for i in range(2):
            shutil.copy(folder / f"{name}.png", into / name / f"{i}.png")
    return into / "mono", into / "colour"


def test_a_found_rig_is_written_for_a_sequence_that_needs_more(folder, tmp_path, refusal):
    given = ["sequence", *two_frames_each(folder, tmp_path), "-o", tmp_path / "out"]
    assert "the frame rate of 'mono' is not known" in refusal(*given)
    assert set(Rig.load(tmp_path / "out" / "found_rig.yaml").names) == {"mono", "colour"}
    (tmp_path / "out" / "found_rig.yaml").write_text("another job's")
    with pytest.raises(SystemExit):
        pat("", *given)
    assert (tmp_path / "out" / "found_rig.yaml").read_text() == "another job's"


def test_names_of_cameras_are_those_of_files_or_folders(tmp_path):
    names = [tmp_path / "a" / "1.png", tmp_path / "b" / "1.png"]
    assert list(camera_names(names)) == ["a", "b"]
    assert list(camera_names([tmp_path / "left eye.png", tmp_path / "b.png"])) == ["left_eye", "b"]
    assert list(camera_names([names[0], names[0]])) == ["camera1", "camera2"]


def test_videos_are_read_as_they_were_written(tmp_path):
    frames = [torch.full((3, 32, 48), value) for value in (0.2, 0.6)]
    write_video(tmp_path / "clip.mp4", frames, rate=10)
    video = read_video(tmp_path / "clip.mp4")
    found = list(video.frames)
    assert video.rate == pytest.approx(10)
    assert [float(frame.mean()) for frame in found] == pytest.approx([0.2, 0.6], abs=0.02)
    (tmp_path / "no.mp4").write_text("no video")
    with pytest.raises(ValueError, match=r"video[^/]*$"):
        read_video(tmp_path / "no.mp4")


@pytest.mark.parametrize(("options", "rate"), [({}, 12.0), ({"video": 0.0}, None), ({"video": 30.0}, 30.0)])
def test_the_rate_that_is_asked_for_is_that_of_the_video(
    halved, tmp_path, monkeypatch, capsys, options, rate
):
    """--video decides, not alpha's rate; without it no video is written."""
    array = SimpleNamespace(recorded=halved[0], alpha="mono", weights="mono-colour", match_levels=False)
    array.rig, rates = array.recorded, []
    monkeypatch.setattr("pat.app.from_images.array_from_images", lambda *_, **__: array)
    monkeypatch.setattr("pat.app.batch.Batch.run", lambda *_, video, **__: rates.append(video) or JobReport())
    files = {name: [tmp_path / f"{name}{i}.png" for i in range(2)] for name in ("mono", "colour")}
    for name, paths in files.items():
        for path in paths:
            write_image(path, halved[1][name])
    (tmp_path / "fused.mp4").write_bytes(b"of a former sequence")
    monkeypatch.setattr(
        "pat.app.from_images.video_frames", lambda *_: (files, {"mono": 12.0, "colour": 24.0})
    )
    monkeypatch.setattr("pat.media.images.has_many_bits", lambda path: False)
    command = FuseSequence(given=(Path("mono.mp4"), Path("colour.mp4")), out=tmp_path, **options)
    with monkeypatch.context() as patched:
        patched.setattr("pat.app.cli.fusing.named_images", lambda *_: ((), False))
        command.run()
    assert rates == [rate]
    assert ("fused.mp4" in capsys.readouterr().err) == (rate is not None)


def test_focal_lengths_come_from_exif(tmp_path):
    def saved(width=400, height=300, **tags):
        image, exif = Image.new("L", (width, height)), Image.Exif()
        exif.get_ifd(0x8769).update({int(tag[1:], 16): value for tag, value in tags.items()})
        image.save(tmp_path / "x.jpg", exif=exif)
        return focal_length(tmp_path / "x.jpg", (300, 400))

    assert saved() is None
    assert saved(xA405=43) == pytest.approx(43 * 500 / 43.267)
    sensor = {"x920A": 4.0, "xA20E": 500.0, "xA210": 4}
    assert saved(**sensor) == pytest.approx(2000)
    assert saved(**sensor, xA002=800) == pytest.approx(1000)
    assert saved(**sensor, xA002=600, xA003=800) == pytest.approx(1000)
    (tmp_path / "x.jpg").write_text("no image")
    assert focal_length(tmp_path / "x.jpg", (300, 400)) is None


def test_the_focal_length_of_a_raw_file_is_not_of_its_thumbnail(tmp_path):
    """Pillow opens a raw file as its first image, whose size is that of a thumbnail."""
    tags = Image.Exif()
    tags.get_ifd(0x8769)[0xA405] = 43
    Image.new("L", (40, 30)).save(tmp_path / "x.jpg", exif=tags)
    assert focal_length(tmp_path / "x.jpg", (3000, 4000)) == pytest.approx(43 * 5000 / 43.267)


def test_a_dark_image_is_brought_to_an_ordinary_brightness():
    from pat.media.colour import exposed, exposure_gain, linear_from_srgb, srgb_from_linear

    light = torch.linspace(0, 1, 400).reshape(1, 20, 20).expand(3, -1, -1)
    ordinary, dark, bright = (srgb_from_linear(factor * light) for factor in (0.9, 0.05, 3.0))
    assert exposure_gain(ordinary) == 1
    assert exposure_gain(torch.zeros(3, 8, 8)) == 1
    for image in (dark, bright):
        corrected = linear_from_srgb(exposed(image, exposure_gain(image)))
        assert float(corrected.quantile(0.99)) == pytest.approx(0.8, abs=0.02)


@pytest.mark.parametrize(
    ("factor", "said"), [(-1.0, "translation of all cameras with the wrong sign"), (1e3, "millim")]
)
def test_a_wrong_rig_is_refused_before_the_work_with_the_doctors_verdict(
    factor, said, halved, folder, tmp_path, capsys
):
    rig = halved[0]
    wrong = {n: c.replace(cam_from_world=Pose(c.R, factor * c.t)) for n, c in rig.cameras.items()}
    rig.replace(cameras=wrong).save(tmp_path / "wrong.yaml")
    files = images(folder, *rig.names)
    with pytest.raises(SystemExit) as stop:
        pat(f"fuse {tmp_path / 'wrong.yaml'} --alpha mono {files} --misfit refuse -o {tmp_path / 'out'}")
    assert stop.value.code == 3
    text = " ".join(capsys.readouterr().err.split())
    assert "behind the cameras or outside the depth range" in text
    assert said in text
    assert not (tmp_path / "out").exists()


def test_why_there_is_no_depth_is_said(halved, monkeypatch):
    """Images for which no pose fits give no depth, with a sentence."""
    monkeypatch.setattr("pat.app.from_images.self_calibrated", lambda *given, **options: None)
    monkeypatch.setattr("pat.app.from_images.MATCHED", 300)
    lines = []
    rig, _ = found_rig(halved[1], "mono", {}, 3, lines.append)
    assert not isinstance(rig["mono"], Camera)
    assert any(line.startswith("no depth by colour") for line in lines)


def test_depth_is_rough_where_no_poses_fit_as_well_as_lines_alone(halved, monkeypatch):
    """There is depth all the same."""
    monkeypatch.setattr("pat.app.from_images.MATCHED", 300)
    monkeypatch.setattr("calib.images.self_calibration.AS_GOOD", 0.0)
    monkeypatch.setattr("calib.images.self_calibration.SLACK", 0.0)
    known, images, _ = halved
    focal, lines = {name: float(known[name].K[0, 0]) for name in known.names}, []
    rig, _ = found_rig(images, "mono", focal, 3, lines.append)
    assert rig.links
    assert any("lines by F; depths are rough" in line for line in lines)
    network = load_weights("mono-colour")
    frames = [
        fuse(images, r, alpha="mono", network=network, settings=FuseSettings(align=False))
        for r in (rig, known)
    ]
    sure = (frames[0].confidence > 0.7) & (frames[1].confidence > 0.7)
    ratio = (frames[0].depth / frames[1].depth)[sure]
    assert ratio.isfinite().double().mean() > 0.95
    assert float((ratio / ratio.nanmedian() - 1).abs().nanmedian()) < 0.1


def test_focal_lengths_are_of_the_images_as_given(halved, monkeypatch):
    """Images that are reduced to estimate their rig keep their focal lengths."""
    monkeypatch.setattr("pat.app.from_images.MATCHED", 240)
    known, images, _ = halved
    focal = {name: float(known[name].K[0, 0]) for name in known.names}
    rig, _ = found_rig(images, "mono", focal, 3, lambda line: None)
    assert float(rig["mono"].K[0, 0]) == pytest.approx(focal["mono"], rel=1e-3)


def test_a_focal_length_that_points_determine_is_used_and_said(halved, monkeypatch):
    """An assumed one can be wrong by 146 %."""
    _, images, _ = halved
    images = {name: image[..., :360, :480] for name, image in images.items()}
    monkeypatch.setattr("pat.app.from_images.MATCHED", 300)
    same = {
        name: image[..., : images["mono"].shape[-2], : images["mono"].shape[-1]]
        for name, image in images.items()
    }
    fit = SimpleNamespace(length=250.0, deviation=0.07)
    monkeypatch.setattr("pat.app.from_images.common_focal_length", lambda *given: fit)
    lines = []
    found_rig(same, "mono", {}, 3, lines.append)
    assert any("mono: focal length" in line and "+- 7%, by matched points" in line for line in lines)
    assert not any("focal lengths of mono" in line for line in lines)
    given = []
    monkeypatch.setattr("pat.app.from_images._calibrated", lambda found, *_: found.rig)
    found_rig(same, "mono", {"mono": 300.0}, 3, given.append)
    assert not any("by matched points" in line for line in given)
