"""Frames and sequences on disk: resumed to the same bits, whole files only, one bad image costs one frame."""

import errno
import json
import math
import os
import pickle
import shutil
from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch

import arraygeom.runtime.atomic
from arraygeom import Epipolar, EpipolarLine, HomographyDisplacement, Rectified, Rig, ThroughLenses, Widened
from arraygeom.io.native import write as rig_text
from arraygeom.runtime.together import LISTS
from pat.app.batch import KEYS, PLAN, Batch, find_images, fuse_one
from pat.app.from_images import video_frames
from pat.fusion.checks import LowConfidenceWarning
from pat.fusion.frame import Frame
from pat.fusion.fuse import FuseSettings
from pat.media.images import read_image, write_image
from pat.media.raw import LIGHT
from pat.media.video import write_video
from pat.networks.guided import GuidedPAT
from pat.networks.weights import save_weights
from pat.sensors import NoiseLevel
from pat.support.jobs import JobError
from tests.pat.commands import pat
from tests.pat.fusion import moving


@pytest.fixture(scope="module")
def material(tmp_path_factory) -> Path:
    """A folder with weights of a tiny network, a rig, and seven fast and two slow images."""
    folder = tmp_path_factory.mktemp("material")
    torch.manual_seed(0)
    network = GuidedPAT()
    save_weights(network, folder / "tiny.safetensors")
    frames, _ = moving.recording(7, 0.003)
    for name, images in frames.items():
        for i, image in enumerate(images):
            write_image(folder / name / f"{name}_{i + 8}.png", image)
    moving.rig(0.003).save(folder / "rig.yaml")
    return folder


def batch(material, out, **options) -> Batch:
    files = {name: find_images(material / name) for name in ("fast", "slow")}
    if not options.get("sequence"):
        files["slow"] = [files["slow"][0]] * len(files["fast"])
    names = {entry.name for entry in fields(FuseSettings)} & set(options)
    settings = FuseSettings(**{name: options.pop(name) for name in names})
    options = {"weights": str(material / "tiny.safetensors"), "files": files, "settings": settings, **options}
    return Batch(**{"rig": Rig.load(material / "rig.yaml"), "alpha": "fast", "out": out, **options})


def contents(out: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in sorted(out.iterdir()) if p.suffix in (".png", ".tif")}


def test_images_are_found_in_the_order_of_their_numbers(material, tmp_path):
    assert [p.name for p in find_images(material / "fast")] == [f"fast_{i}.png" for i in range(8, 15)]
    found = [p.name for p in find_images(f"{material}/fast/*_1?.png")]
    assert found == [f"fast_{i}.png" for i in range(10, 15)]
    with pytest.raises(FileNotFoundError, match="mono: "):
        find_images(tmp_path, name="mono")


def test_digits_that_are_no_numbers_are_letters_in_names(tmp_path):
    """A superscript between numbers is a letter."""
    for name in ("1²10.png", "1²9.png"):
        (tmp_path / name).touch()
    assert [path.name for path in find_images(tmp_path)] == ["1²9.png", "1²10.png"]


def test_files_of_the_system_are_no_frames_and_two_of_one_are_refused(tmp_path):
    """Neither a folder nor a pattern takes hidden files; a folder with a raw file and its PNG is
    ambiguous."""
    for name in ("1.png", "._1.png", "2.png"):
        (tmp_path / name).touch()
    for given in (tmp_path, tmp_path / "*.png"):
        assert [path.name for path in find_images(given)] == ["1.png", "2.png"]
    (tmp_path / "2.dng").touch()
    with pytest.raises(ValueError, match=r"2\.dng"):
        find_images(tmp_path, name="mono")
    assert len(find_images(tmp_path / "*.png")) == 2


def test_a_file_whose_name_looks_like_a_pattern_is_that_file(tmp_path):
    for name in ("b[o]x.png", "st*r.png", "star.png"):
        (tmp_path / name).touch()
    for name in ("b[o]x.png", "st*r.png"):
        assert find_images(tmp_path / name) == [tmp_path / name]


def test_folders_are_no_frames_and_those_that_hold_images_are_named(tmp_path):
    for name in ("day/thumbnails/1.png", "day/2.png/x", "day/3.png"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    for given in (tmp_path / "day", tmp_path / "day" / "*"):
        assert [path.name for path in find_images(given)] == ["3.png"]
    with pytest.raises(FileNotFoundError, match="day"):
        find_images(tmp_path)


@pytest.mark.parametrize("alone", [False, True])
def test_bands_of_a_sequence_are_called_as_their_cameras(material, tmp_path, alone):
    """Propagated bands have files named by camera, three of them too."""
    rig, files = Rig.load(material / "rig.yaml"), {"fast": find_images(material / "fast")[:2]}
    slow = read_image(find_images(material / "slow")[0])
    for i, name in enumerate(("nir", "green", "blue")):
        rig = rig.with_camera(name, rig["slow"].replace(K=rig["slow"].K * (1 + i * 1e-6)))
        write_image(tmp_path / name / "1.png", slow[i : i + 1])
        files[name] = find_images(tmp_path / name)
    how = {"sequence": True, "alone": alone, "weights": "mono-spectral"}
    for cameras in (list(files)[:3], list(files)):
        out = tmp_path / f"of_{len(cameras)}"
        batch(material, out, rig=rig, files={name: files[name] for name in cameras}, **how).run()
        written = {path.name for path in out.glob("fast_8_fused_*.png")}
        assert written == {f"fast_8_fused_{name}.png" for name in cameras[1:]}


def test_a_stopped_sequence_is_resumed_to_the_same_bits(material, tmp_path, monkeypatch):
    whole = batch(material, tmp_path / "whole", sequence=True)
    assert len(whole.run(video=25.0).made) == 7
    assert (tmp_path / "whole" / "fused.mp4").is_file()
    assert not (tmp_path / "whole" / KEYS).exists()
    part, fuse_one = batch(material, tmp_path / "part", sequence=True), Batch.fuse_one

    def stop_at_4(self, i, inputs):
        if i == 4:
            raise KeyboardInterrupt
        fuse_one(self, i, inputs)

    with monkeypatch.context() as patched:
        patched.setattr(Batch, "fuse_one", stop_at_4)
        with pytest.raises(KeyboardInterrupt):
            part.run()
    report = part.run(resume=True)
    assert (len(report.kept), len(report.made)) == (4, 3)
    assert contents(tmp_path / "part") == contents(tmp_path / "whole")
    (tmp_path / "part" / "fast_9_fused.png").unlink()
    assert len(part.run(resume=True).made) == 1
    assert contents(tmp_path / "part") == contents(tmp_path / "whole")


def test_other_settings_are_not_mixed_in(material, tmp_path):
    files = {name: find_images(material / name)[:1] for name in ("fast", "slow")}
    batch(material, tmp_path / "out", files=files).run()
    with pytest.raises(ValueError, match=r"settings.yaml: "):
        batch(material, tmp_path / "out", match_levels=True).run(resume=True)


def test_frames_that_came_later_are_made_and_what_differs_is_named(material, tmp_path):
    """A folder that has grown has the same settings."""
    whole = batch(material, tmp_path / "out")
    part = replace(whole, files={name: files[:2] for name, files in whole.files.items()})
    assert len(part.run().made) == 2
    more = replace(whole, files={name: files[:3] for name, files in whole.files.items()})
    report = more.run(resume=True)
    assert (len(report.made), len(report.kept)) == (1, 2)
    with pytest.raises(ValueError, match="alpha"):
        replace(more, alpha="slow").run(resume=True)
    with pytest.raises(ValueError, match="keep_alpha"):
        replace(more, settings=FuseSettings(keep_alpha=True)).run(resume=True)
    (tmp_path / "out" / "settings.yaml").write_text("[")
    with pytest.raises(ValueError, match="unreadable"):
        more.run(resume=True)


def spoiled(material, tmp_path, i) -> dict[str, list[Path]]:
    """The files, one of alpha's cut in half."""
    files = {"fast": find_images(material / "fast"), "slow": [find_images(material / "slow")[0]] * 7}
    half = tmp_path / files["fast"][i].name
    half.write_bytes(files["fast"][i].read_bytes()[:900])
    return files | {"fast": [half if k == i else f for k, f in enumerate(files["fast"])]}


def test_a_corrupt_image_costs_its_frame_or_stops_the_job(material, tmp_path):
    bad = batch(material, tmp_path / "bad", files=spoiled(material, tmp_path, 2))
    with pytest.raises(JobError, match=r"fast_10_fused.png.*fast_10.png"):
        bad.run()
    report = bad.run(resume=True, on_error="skip")
    assert [p.name for p in report.failed] == ["fast_10_fused.json"]
    good = batch(material, tmp_path / "good")
    good.run()
    wanted = {name: content for name, content in contents(tmp_path / "good").items() if "_10_" not in name}
    assert contents(tmp_path / "bad") == wanted


def test_a_file_of_a_sequence_that_cannot_be_read_is_named_once(material, tmp_path):
    """The message has the file's name once."""
    files = spoiled(material, tmp_path, 0) | {"slow": find_images(material / "slow")}
    with pytest.raises(JobError, match=r"fast_8.*fast_8\.png") as stopped:
        batch(material, tmp_path / "out", sequence=True, files=files).run()
    assert str(stopped.value).count("fast_8.png") == 1


def test_a_missing_beta_of_a_key_frame_leaves_the_other_key_frames(material, tmp_path):
    files = {name: find_images(material / name) for name in ("fast", "slow")}
    gone = tmp_path / "gone.png"
    job = batch(material, tmp_path / "out", sequence=True, files=files | {"slow": [files["slow"][0], gone]})
    report = job.run(on_error="skip")
    assert len(report.made) == 7
    with pytest.raises(JobError, match=r"slow.*gone.png"):
        job.run()


def test_a_video_that_cannot_be_is_refused_before_frames_are_made(material, tmp_path):
    with pytest.raises(ValueError, match="-3"):
        batch(material, tmp_path / "out", sequence=True).run(video=-3.0)
    assert not (tmp_path / "out").exists()


def test_a_full_disk_leaves_whole_files_only(material, tmp_path, monkeypatch):
    """The third file to be flushed does not fit."""
    flush, count = arraygeom.runtime.atomic.flush, iter(range(100))

    def full(path):
        if "fused" in path.name and next(count) == 2:
            raise OSError(errno.ENOSPC, "No space left on device")
        flush(path)

    monkeypatch.setattr(arraygeom.runtime.atomic, "flush", full)
    job = batch(material, tmp_path / "out")
    with pytest.raises(JobError, match=r"fused\.png: "):
        job.run()
    images = [p for p in (tmp_path / "out").iterdir() if p.name.endswith("fused.png")]
    assert len(images) == 2
    assert [p for p in os.listdir(tmp_path / "out") if p.startswith(".")] == [LISTS]
    assert len(job.run(resume=True).made) == 5


def test_the_command_line_fuses_a_sequence(material, tmp_path, capsys, refusal):
    images = " ".join(f"--image {name}={material / name}" for name in ("fast", "slow"))
    given = f"sequence --rig {material / 'rig.yaml'} --alpha fast {images} --out {tmp_path / 'out'}"
    given += f" --network {material / 'tiny.safetensors'} --format png16"
    pat(given)
    assert read_image(tmp_path / "out" / "fast_14_fused.png").shape == (3, *moving.HW)
    assert (tmp_path / "out" / "fused.mp4").stat().st_size > 1000
    assert Rig.load(tmp_path / "out" / "view.yaml").names == ("fast",)
    capsys.readouterr()
    pat(f"{given} --resume")
    assert "0 made, 7 there already" in " ".join(capsys.readouterr().err.split())
    assert "near one of alpha in time" in refusal(*given.split(), "--time-offset", "slow=9")
    assert "as many images of each camera" in refusal("batch", *given.split()[1:])


def test_the_light_that_alpha_measured_is_known_of_sequences_too(material, tmp_path):
    job = batch(material, tmp_path, sequence=True)
    sensor = replace(job.rig["fast"].sensor, response="mono", coding="linear")
    job = replace(job, rig=job.rig.with_camera("fast", job.rig["fast"].replace(sensor=sensor)))
    known = job.fusion.rig["fast"].sensor
    assert (known.response, known.coding) == (LIGHT, "srgb")
    assert known.frame_rate == sensor.frame_rate


@pytest.mark.parametrize("sequence", [False, True])
def test_frames_whose_images_changed_are_made_again(sequence, material, tmp_path):
    files = {name: list(find_images(material / name)) for name in ("fast", "slow")}
    changed = files["fast"][3] = Path(shutil.copy(files["fast"][3], tmp_path))
    if not sequence:
        files = {"fast": files["fast"][2:5], "slow": [files["slow"][0]] * 3}
    count = len(files["fast"])
    job = batch(material, tmp_path / "out", sequence=sequence, files=files)
    job.run()
    assert len(job.run(resume=True).kept) == count
    before = contents(tmp_path / "out")
    write_image(changed, 1 - read_image(changed))
    report = job.run(resume=True)
    assert len(report.made) == (count if sequence else 1)
    assert contents(tmp_path / "out")["fast_11_fused.png"] != before["fast_11_fused.png"]
    os.utime(changed, (0, 0))
    assert len(job.run(resume=True).kept) == count
    copy = shutil.copytree(tmp_path / "out", tmp_path / "copy", copy_function=shutil.copyfile)
    assert len(replace(job, out=copy).run(resume=True).kept) == count


def test_a_torn_empty_or_missing_file_of_a_frame_is_made_again(material, tmp_path):
    """They counted as there."""
    job = batch(material, tmp_path / "out")
    job.run()
    before = contents(tmp_path / "out")
    (tmp_path / "out" / "fast_8_fused.png").write_bytes(before["fast_8_fused.png"][:500])
    (tmp_path / "out" / "fast_9_confidence.png").write_bytes(b"")
    (tmp_path / "out" / "fast_10_confidence.png").unlink()
    report = job.run(resume=True)
    assert (len(report.made), len(report.kept)) == (3, 4)
    assert contents(tmp_path / "out") == before


def test_a_job_of_videos_is_resumed(material, tmp_path):
    """Their frames are in another folder each time."""
    videos = {name: tmp_path / f"{name}.mp4" for name in ("fast", "slow")}
    for name, path in videos.items():
        write_video(path, map(read_image, find_images(material / name)[:2]))

    def job(folder):
        files, _ = video_frames(videos, tmp_path / folder)
        return batch(material, tmp_path / "out", sequence=True, files=files)

    assert len(job("once").run().made) == 2
    assert len(job("again").run(resume=True).kept) == 2


def test_one_command_at_a_time_writes_to_a_folder(material, tmp_path, monkeypatch):
    first, second = batch(material, tmp_path / "out"), batch(material, tmp_path / "out", match_levels=True)
    fuse_one = Batch.fuse_one

    def meanwhile(self, i, inputs):
        if i == 2:
            with pytest.raises(ValueError, match=r"command[^/]*$"):
                second.run()
        fuse_one(self, i, inputs)

    monkeypatch.setattr(Batch, "fuse_one", meanwhile)
    assert len(first.run().made) == 7
    assert "match_levels: false" in (tmp_path / "out" / "settings.yaml").read_text()


def test_a_colour_file_of_a_raw_camera_is_refused_in_sequences_too(material, tmp_path):
    job = batch(material, tmp_path, sequence=True)
    slow = job.rig["slow"]
    raw = job.rig.with_camera("slow", slow.replace(sensor=replace(slow.sensor, bayer="RGGB")))
    with pytest.raises(JobError, match=r"slow: .*slow_8.png: .*RGGB"):
        replace(job, rig=raw).run()


def test_frames_that_hardly_match_are_warned_of_once_and_fail_if_strict(material, tmp_path, monkeypatch):
    for bound in ("LOW_CONFIDENCE", "UNFIT_CONFIDENCE"):
        monkeypatch.setattr(f"pat.fusion.checks.{bound}", 1.0)
    files = {"fast": find_images(material / "fast")[:2], "slow": find_images(material / "slow")[:1] * 2}
    job = batch(material, tmp_path / "out", files=files)
    with pytest.warns(LowConfidenceWarning, match="fast_8_fused.png: ") as caught:
        report = job.run()
    assert len([w for w in caught if w.category is LowConfidenceWarning]) == 1
    assert str(report) == "2 made, 2 with warnings"
    with pytest.raises(JobError, match="confidence") as stopped:
        replace(job, strict=True).run()
    assert isinstance(stopped.value.__cause__, LowConfidenceWarning)
    assert len(list((tmp_path / "out").glob("*_fused.png"))) == 2  # of before
    assert len(job.run(resume=True).made) == 2


class Payload:
    """Unpickled, it would write a file."""

    def __reduce__(self):
        return os.system, ("touch unpickled",)


def test_a_plan_in_the_output_folder_cannot_run_code(material, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for plan in ("plan.pickle", PLAN):
        (tmp_path / plan).write_bytes(pickle.dumps(Payload()))
        with pytest.raises(ValueError, match=plan):
            fuse_one(tmp_path / plan, 0)
    assert not (tmp_path / "unpickled").exists()
    batch(material, tmp_path / "out")._begin(resume=False)
    assert json.loads((tmp_path / "out" / KEYS / PLAN).read_text())["alpha"] == "fast"


@pytest.mark.parametrize(
    "field",
    [
        None,
        Epipolar(near=2.0, far=math.inf),
        HomographyDisplacement(12.5),
        Rectified(7.0, alpha_is="either"),
        Widened(ThroughLenses(EpipolarLine(), 64), across=1.5),
        {"slow": Widened(Epipolar(), along=2.0)},
    ],
)
def test_a_plan_comes_back_exactly(material, tmp_path, field):
    job = batch(material, tmp_path, field=field, match_levels=True, max_memory="2GiB", bits=16)
    again = Batch.from_json(job.to_json())
    assert rig_text(again.rig) == rig_text(job.rig)
    for name in job.rig.names:
        for part in ("K", "R", "t"):
            assert torch.equal(getattr(again.rig[name], part), getattr(job.rig[name], part))
    assert replace(again, rig=job.rig) == job


@pytest.mark.parametrize("noise", ["estimate", {"fast": NoiseLevel.from_electrons(200.0, 2.0, "values")}])
def test_noise_and_luminance_are_planned_and_among_the_settings(material, tmp_path, noise):
    job = batch(material, tmp_path, noise=noise, keep_alpha=True)
    again = Batch.from_json(job.to_json())
    assert (again.settings.noise, again.settings.keep_alpha) == (noise, True)
    others = [batch(material, tmp_path, **how) for how in ({}, {"noise": noise}, {"luminance": "mix"})]
    assert len({job.dependencies, *(other.dependencies for other in others)}) == 4


def test_settings_reach_the_fusion_of_frames_and_of_sequences(material, tmp_path, monkeypatch):
    given = []

    def fuse(*_, **further):
        given.append(further)
        return Frame(torch.zeros(3, 1, 1), *torch.zeros(3, 1, 1))

    monkeypatch.setattr("pat.app.batch.fuse_frame", fuse)
    job = batch(material, tmp_path, field=Epipolar(), keep_alpha=True, luminance="mix", max_memory="2GiB")
    job._frame(0)
    assert [(how["alpha"], how["settings"]) for how in given] == [("fast", job.settings)]
    assert replace(job, sequence=True).fusion.settings == job.settings


def test_a_field_that_is_a_function_is_refused_before_anything_is_fused(material, tmp_path):
    with pytest.raises(ValueError, match="Rectified"):
        batch(material, tmp_path / "out", field=lambda pair, x: None).run()


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"format": "pat-batch 1"}', "[" * 100_000, '{"format": "pat-batch 9"}']
)
def test_damaged_plans_are_named(text):
    with pytest.raises(ValueError, match=r"plan.json"):
        Batch.from_json(text)
