"""The command line: it does the main job, and what is wrong is one line and exit status 2."""

import contextlib
import dataclasses
import functools
import json
import re
import shutil
import typing
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml

from arraygeom import Camera, Pose, Rig, Sensor, intrinsics
from arraygeom.io import write_rig
from arraygeom.lenses import Equirectangular
from arraygeom.runtime.text import UNSCALED
from pat.app.cli.align import Align
from pat.app.cli.fuse import Fuse
from pat.app.cli.fusing import named_images
from pat.app.cli.main import Pat, command_named, command_paths, main
from pat.app.cli.options import read_frames, read_images, rig_first
from pat.app.cli.parser import _entries, parse
from pat.app.cli.sequence import FuseSequence
from pat.app.sample_array import SAMPLE, load_motorcycle, load_sample
from pat.media.colour import linear_from_srgb
from pat.media.depth_maps import VERTEX, read_depth
from pat.media.images import read_image, write_image
from pat.support.metrics import score
from tests.arraygeom.test_io import FIXTURES
from tests.pat.any_camera import recorded
from tests.pat.commands import images, pat


@pytest.fixture
def small(tmp_path):
    """The sample array, its rig and images cut small so that fusing takes a moment."""
    return cut_sample(tmp_path, (96, 128))


def cut_sample(folder, hw):
    """The folder, with the upper left part of the sample array of so many rows and columns."""
    sample = load_sample()
    rig = sample.rig
    for name in rig.names:
        rig = rig.crop(name, 0, 0, hw)
        write_image(folder / f"{name}.png", sample.images[name][:, : hw[0], : hw[1]])
    rig.save(folder / "rig.yaml")
    return folder


def arguments(folder, **changes):
    """The words of `pat fuse` of a rig's two images in a folder."""
    given = {name: folder / f"{name}.png" for name in ("mono", "colour")}
    given |= {"rig": folder / "rig.yaml", "alpha": "mono", "extra": []} | changes
    line = "fuse --rig {rig} --alpha {alpha} --out {out} --image mono={mono} --image colour={colour}"
    return [*line.format(out=folder / "out", **given).split(), *given["extra"]]


def test_fuse_writes_everything(small):
    main(arguments(small))
    depths = {"depth.png", "depth.tif", "depth_16.png", "depth_farthest.tif", "depth_nearest.tif"}
    others = {"confidence.png", "fused.png", "index.html", "view.yaml"}
    assert {p.name for p in (small / "out").iterdir() if p.is_file()} == depths | others
    view = Rig.load(small / "out" / "view.yaml")
    assert view.names == ("mono",)
    assert view["mono"].hw == (96, 128)
    assert read_image(small / "out" / "fused.png").shape == (3, 96, 128)


@pytest.mark.slow
def test_points_of_a_whole_sphere_are_on_its_rays(tmp_path):
    """Its depth is the distance along them, not z."""
    hw = (64, 128)
    poses = Pose.identity(), Pose(torch.eye(3).double(), torch.tensor([-0.25, 0.01, 0.0]).double())
    here = {"K": intrinsics(hw[1] / (2 * torch.pi), hw), "hw": hw, "distortion": Equirectangular()}
    cameras = {n: Camera(**here, cam_from_world=p) for n, p in zip(("mono", "colour"), poses)}
    rig = Rig(cameras, depth=(1.3, 5.3))
    rig.save(tmp_path / "rig.yaml")
    for name, image in recorded(rig)[0].items():
        write_image(tmp_path / f"{name}.png", image)
    main(arguments(tmp_path, extra=["--extras", "points,page"]))
    depth = read_depth(tmp_path / "out" / "depth.tif")
    assert "along the ray" in (tmp_path / "out" / "index.html").read_text()
    cloud = (tmp_path / "out" / "points.ply").read_bytes().partition(b"end_header\n")[2]
    X = torch.from_numpy(np.frombuffer(cloud, VERTEX)["X"].copy())
    torch.testing.assert_close(X.norm(dim=-1), depth[depth.isfinite()])
    assert (X[:, 2] < -1).sum() > 1000


def test_demo_beats_alpha_and_every_classical_fusion_of_the_photograph(tmp_path, capsys):
    main(["demo", "--out", str(tmp_path)])
    truth = load_motorcycle().ground_truth
    fused = score(read_image(tmp_path / "fused.png"), truth)
    table, said = capsys.readouterr()
    cells = [[cell.strip() for cell in line.split("|")[1:3]] for line in table.splitlines()[2:]]
    rows = {name: scores.split(" / ") for name, scores in cells}
    assert float(rows["fusion"][0]) == pytest.approx(fused.psnr, abs=0.05)
    others = [numbers for name, numbers in rows.items() if name != "fusion"]
    assert len(others) == 5
    assert all(float(psnr) < fused.psnr and float(ssim) < fused.ssim for psnr, ssim in others)
    listed = said.replace("\n", "").rpartition("written: ")[2].split(", ")
    assert set(listed) == {str(path) for path in tmp_path.iterdir() if path.is_file()}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mono": "/none.png"}, "mono: /none.png"),
        ({"alpha": "momo"}, "no camera 'momo'; did you mean 'mono'"),
        ({"rig": "/none.yaml"}, "/none.yaml: no such rig file"),
        ({"extra": ["--depth", "20", "2"]}, "0 < near <= far"),
        ({"extra": ["--depth", "-1", "2"]}, "0 < near <= far"),
        ({"extra": ["--max-memory", "lots"]}, "--max-memory"),
        ({"extra": ["--max-memory", "4"]}, "4GiB"),
        ({"extra": ["--image", "tele=x.png"]}, "no camera 'tele'"),
        ({"extra": ["--network", "mono-color"]}, "no weights 'mono-color'"),
        ({"mono": SAMPLE / "mono.png"}, "mono.png: is 640x400, the rig says 128x96"),
    ],
)
def test_mistakes_are_one_line_and_leave_nothing(changes, message, small, refusal):
    assert message in refusal(*arguments(small, **changes))
    assert not (small / "out").exists()


@pytest.mark.parametrize(
    ("entry", "value", "message"),
    [
        ("cameras.mono.focl", 3, "cameras.mono.focl: unknown key; did you mean 'focal'"),
        ("cameras.mono.rotation", [[2, 0, 0], [0, 1, 0], [0, 0, 1]], "not a rotation"),
        ("depth", [20, 2], "depth: is [20, 2] m; wanted [near, far]"),
        ("cameras.mono", {"focal": 100}, "cameras.mono.size"),
        ("cameras.colour.position", [100, 0, 0], "keep one"),
    ],
)
def test_rig_mistakes_name_the_entry(entry, value, message, small, refusal):
    rig = part = yaml.safe_load((small / "rig.yaml").read_text())
    *above, last = entry.split(".")
    for key in above:
        part = part[key]
    part[last] = value
    (small / "rig.yaml").write_text(yaml.safe_dump(rig))
    error = refusal(*arguments(small))
    assert message in error
    assert "rig.yaml" in error


def test_a_rig_without_depth_range_is_answered_with_the_option_that_gives_one(small, refusal):
    """Other tools' files have no depth range; the message names --depth."""
    Rig.load(small / "rig.yaml").replace(depth=None).save(small / "rig.yaml")
    assert "`--depth NEAR FAR`" in refusal(*arguments(small))


def test_views_that_do_not_overlap(small, refusal):
    rig = yaml.safe_load((small / "rig.yaml").read_text())
    rig["cameras"]["colour"] |= {"rotation": [0, 180, 0]}
    (small / "rig.yaml").write_text(yaml.safe_dump(rig))
    said = refusal(*arguments(small))
    assert "'colour's views do not overlap" in said
    assert said.endswith("check the poses and the depth range")


def test_images_with_an_alpha_channel_or_nan(small, refusal):
    cv2.imwrite(str(small / "mono.png"), (torch.rand(96, 128, 4).numpy() * 255).astype("uint8"))
    assert "mono.png" in refusal(*arguments(small))
    shutil.copy(small / "colour.png", small / "mono.tif")
    cv2.imwrite(str(small / "mono.tif"), torch.full((96, 128), torch.nan).numpy())
    assert "NaN" in refusal(*arguments(small, mono=small / "mono.tif"))


def test_show_draws_the_rig_and_its_fields(small):
    pat(f"show {small / 'rig.yaml'} {images(small, 'mono')} --out {small / 'out'}")
    assert sorted(p.name for p in (small / "out").iterdir() if p.is_file()) == ["fields.png", "rig.png"]
    pat(f"rig show {small / 'rig.yaml'} --alpha colour --out {small / 'again'}")
    assert (small / "again" / "fields.png").is_file()


def test_show_refuses_images_of_other_sizes_than_the_rigs(small, refusal):
    write_image(small / "larger.png", torch.zeros(1, 100, 130))
    said = refusal("show", small / "rig.yaml", "--image", f"mono={small / 'larger.png'}")
    assert "larger.png: is 130x100" in said


def test_rig_info_prints_the_numbers(small, capsys):
    pat(f"rig info {small / 'rig.yaml'} --depth 2 8")
    text = " ".join(capsys.readouterr().out.split())
    assert "128x96" in text
    assert "820, 820" in text
    assert "2.439 - 9.756" in text
    assert "0.1241" in text


def test_rig_convert_and_back(small, refusal):
    pat(f"rig convert {small / 'rig.yaml'} {small / 'chain.yaml'} --write-as kalibr")
    pat(f"rig convert {small / 'chain.yaml'} {small / 'back.yaml'}")
    first, again = Rig.load(small / "rig.yaml"), Rig.load(small / "back.yaml")
    for a, b in zip(first.cameras.values(), again.cameras.values()):
        assert torch.allclose(a.K, b.K)
        assert torch.allclose(a.cam_from_world.t, b.cam_from_world.t, atol=1e-9)
    assert "known" in refusal("rig", "convert", small / "rig.yaml", "x", "--write-as", "word")
    rig = str(small / "rig.yaml")
    for words in (["rig", "convert", rig, str(small)], ["explore", rig, "--save", str(small)]):
        assert f"{small} is a folder: name a file in it" in refusal(*words)


def test_the_size_of_files_that_state_none_or_several(small, tmp_path, refusal):
    """--size states the size, as for a ZED's file with images of 672x376."""
    zed, rig = str(FIXTURES / "zed.conf"), str(tmp_path / "rig.yaml")
    main(["rig", "convert", zed, rig, "--size", "672", "376"])
    assert Rig.load(rig)["left"].hw == (376, 672)
    assert "it has 1280x720, 672x376" in refusal("rig", "convert", zed, rig, "--size", "640", "480")
    stated = refusal("rig", "convert", small / "rig.yaml", rig, "--size", "9", "9")
    assert "--size: the file states" in stated
    assert "--size: wanted" in refusal("rig", "convert", zed, rig, "--size", "0", "9")


def test_rig_info_of_one_camera_has_no_pairs(small, tmp_path, capsys):
    """It printed a table of pairs with nothing in it."""
    rig = Rig.load(small / "rig.yaml")
    Rig({"mono": rig["mono"]}).save(tmp_path / "one.yaml")
    main(["rig", "info", str(tmp_path / "one.yaml")])
    assert "alpha" not in capsys.readouterr().out


def test_rig_info_says_a_mistaken_unit_once(small, tmp_path, capsys):
    Rig.load(small / "rig.yaml").scaled(1e3).save(tmp_path / "large.yaml")
    main(["rig", "info", str(tmp_path / "large.yaml")])
    assert capsys.readouterr().err.count("is this file in millimetres?") == 1


def test_rig_info_says_no_metres_of_a_rig_of_unknown_scale(small, tmp_path, capsys):
    Rig.load(small / "rig.yaml").replace(name=UNSCALED, depth=(2.0, 8.0)).save(tmp_path / "rig.yaml")
    main(["rig", "info", str(tmp_path / "rig.yaml")])
    text = " ".join(capsys.readouterr().out.split())
    assert text.count("baselines") == 2
    assert not re.search(r"\bm?m\b", text)


@pytest.mark.parametrize("kind", ["colmap", "nerfstudio"])
def test_rig_info_says_no_metres_of_a_file_that_states_no_unit(small, tmp_path, capsys, kind):
    """COLMAP's lengths are arbitrary."""
    path = tmp_path / ("transforms.json" if kind == "nerfstudio" else "sparse")
    cameras = Rig.load(small / "rig.yaml").cameras.items()
    write_rig(Rig({name: camera.replace(sensor=Sensor()) for name, camera in cameras}), path, format=kind)
    main(["rig", "info", str(path), "--depth", "2", "8"])
    printed = capsys.readouterr()
    text = " ".join(printed.out.split())
    assert text.count("units") == 2
    assert not re.search(r"\bm?m\b", text)
    assert f"{kind} files state none" in printed.err


@pytest.mark.parametrize("read", [read_images, lambda *given: read_frames(*given)[0]])
def test_images_are_read_as_the_rig_describes_them_outside_of_fuse_too(small, recwarn, read):
    """Counts of 12 bits are developed for `pat show` and `pat rig` as well."""
    rig, image = Rig.load(small / "rig.yaml"), read_image(small / "mono.png")
    write_image(small / "raw.png", linear_from_srgb(image) * 4095 / 65535, bits=16)
    sensor = dataclasses.replace(rig["mono"].sensor, bits=12, coding="linear")
    rig = rig.with_camera("mono", rig["mono"].replace(sensor=sensor))
    found = read(rig, [f"mono={small / 'raw.png'}"])["mono"]
    assert float((found - image).abs().max()) < 0.01
    assert not recwarn


def test_rig_info_as_json(small, capsys):
    main(["rig", "info", str(small / "rig.yaml"), "--json"])
    told = json.loads(capsys.readouterr().out)
    assert [camera["name"] for camera in told["cameras"]] == ["mono", "colour"]
    assert told["pairs"][0]["baseline"] == pytest.approx(0.1241, abs=1e-3)
    main(["rig", "info", str(small / "rig.yaml"), "--json", "--alpha", "colour"])
    (pair,) = json.loads(capsys.readouterr().out)["pairs"]
    assert (pair["alpha"], pair["beta"]) == ("colour", "mono")


def test_rig_info_of_many_cameras_describes_the_pairs_of_one(tmp_path, capsys):
    cameras = "\n".join(f"  c{i}: {{size: [64, 48], focal: 50, translation: [{i}, 0, 0]}}" for i in range(60))
    (tmp_path / "rig.yaml").write_text(f"format: arraygeom-rig 1\ncameras:\n{cameras}\n")
    main(["rig", "info", str(tmp_path / "rig.yaml"), "--json"])
    out, error = capsys.readouterr()
    pairs = [(pair["alpha"], pair["beta"]) for pair in json.loads(out)["pairs"]]
    assert pairs == [("c0", f"c{i}") for i in range(1, 51)]
    assert "pairs with alpha 'c0' and its nearest cameras, of 60: --alpha NAME for others" in error


def test_an_interruption_is_one_line_and_status_130(monkeypatch, capsys):
    def interrupted(self):
        raise KeyboardInterrupt

    monkeypatch.setattr("pat.app.cli.demo.Demo.run", interrupted)
    with pytest.raises(SystemExit) as stop:
        main(["demo"])
    assert stop.value.code == 130
    assert "interrupted" in capsys.readouterr().err


def test_explore_says_what_is_missing(small, refusal):
    told = refusal("explore", small / "rig.yaml", "--image", f"mono={small / 'mono.png'}", "--no-browser")
    assert "at least one beta" in told


def test_warnings_are_one_line(small, capsys):
    text = (small / "rig.yaml").read_text().replace("translation: [-0.12", "translation: [-120.12")
    assert "-120.12" in text
    (small / "rig.yaml").write_text(text)
    main(["rig", "info", str(small / "rig.yaml")])
    told = capsys.readouterr().err
    assert told.startswith("pat: warning: ")
    assert "millimetres" in told
    assert ".py" not in told.replace(str(small), "")


@pytest.mark.parametrize(
    "command",
    [
        ["fuse", "RIG", "--alpha", "mono"],
        ["show", "RIG"],
        ["explore", "RIG", "--no-browser"],
        ["rig", "show", "RIG"],
        ["rig", "doctor", "RIG"],
    ],
)
def test_a_camera_given_twice_is_refused_everywhere(command, small, refusal):
    twice = [a for name in ("mono", "colour", "mono") for a in ("--image", f"{name}={small / 'mono.png'}")]
    command = [str(small / "rig.yaml") if word == "RIG" else word for word in command]
    assert refusal(*command, *twice) == "pat: --image: 'mono' is given twice; give it once"


def test_other_names_given_twice(small, refusal):
    twice = ["--frame-rate", "mono=30", "--frame-rate", "mono=25"]
    sequence = ["sequence", *arguments(small)[1:]]
    assert "--frame-rate: 'mono' is given twice" in refusal(*sequence, *twice)
    sigma = "rig refine --rig {} -o x.yaml --image a=b --sigma focal=1 focal=2"
    assert "no such rig file" in refusal(*sigma.format("r.yaml").split())
    assert "--sigma: 'focal' is given twice" in refusal(*sigma.format(small / "rig.yaml").split())
    assert "NAME=NUMBER" in refusal(*sequence, "--time-offset", "mono")
    assert "NAME=FILE" in refusal(*arguments(small), "--image", "mono=")


def test_what_train_refuses_is_one_line_too(refusal):
    said = refusal("lab", "train", "pat-supervised", "--steps", "0")
    assert said == "pat: steps must be at least 1, got 0"
    assert "'--steps'" in refusal("lab", "train", "--stepps", "5")


@pytest.mark.parametrize("kind", ["tif32", "exr"])
def test_a_video_of_frames_of_32_bits_is_said_to_be_none(small, capsys, monkeypatch, kind):
    monkeypatch.setattr("pat.media.images.exr_writer", lambda path: None)
    monkeypatch.setattr(FuseSequence, "_many", lambda *_: None)
    main(["sequence", *arguments(small)[1:], "--video", "10", "--format", kind])
    assert "--video: of frames of 32 bits there is none" in " ".join(capsys.readouterr().err.split())


def test_several_frames_are_refused_before_a_rig_is_looked_for(small, refusal, monkeypatch):
    monkeypatch.setattr("pat.app.from_images.array_from_images", None)
    for name in ("mono", "colour"):
        (small / f"{name}s").mkdir()
        for i in range(2):
            shutil.copy(small / f"{name}.png", small / f"{name}s" / f"{i}.png")
    folders = {name: small / f"{name}s" for name in ("mono", "colour")}
    for several in (arguments(small, **folders), ["fuse", *map(str, folders.values())]):
        assert "`pat batch`" in refusal(*several)


def test_images_with_a_name_and_a_path_are_images(small, refusal, monkeypatch):
    """NAME=FOLDER is a camera's images, whatever the folder's own name."""
    (small / "folder").mkdir(exist_ok=True)
    said = refusal("fuse", f"mono={small / 'folder'}", f"colour={small / 'folder'}")
    assert f"give {small / 'folder'} alone" in said
    named = [f"mono={small / 'mono.png'}", f"colour={small / 'colour.png'}"]
    images, with_rig = named_images([small / "rig.yaml", *map(Path, named)], (), "fuse")
    assert (images, with_rig) == (tuple(named), True)


def test_a_file_that_is_missing_or_a_video_is_named(small, refusal):
    (small / "several").mkdir()
    for name in ("several/0.png", "several/1.png", "clip.mp4"):
        shutil.copy(small / "mono.png", small / name)
    for name, said in (("none", "no image there"), ("clip.mp4", "is a video")):
        given = arguments(small, mono=small / "several", colour=small / name)
        assert f"colour: {small}/{name}: {said}" in refusal(*given)


def test_a_rig_is_an_argument_or_an_option_and_o_is_out_everywhere(small, capsys, refusal):
    rig = str(small / "rig.yaml")
    main(["rig", "info", rig])
    as_argument = capsys.readouterr().out
    for given in (["--rig", rig], [f"--rig={rig}"]):
        main(["rig", "info", *given])
        assert capsys.readouterr().out == as_argument
    assert "--rig" in refusal("rig", "info", "--rig")
    main(["rig", "convert", "--rig", rig, str(small / "chain.yaml"), "--write-as", "kalibr"])
    assert (small / "chain.yaml").is_file()
    main(["show", "--rig", rig, "-o", str(small / "drawn")])
    assert (small / "drawn" / "rig.png").is_file()


def test_images_stand_anywhere_among_the_options_of_fuse():
    given = ["rig.yaml", "--alpha", "mono", "a.png", "--depth", "1", "9", "b.tif", "--image", "c=c.png"]
    made = parse(Fuse, [*given, "-o", "out.png"])
    assert list(map(str, made.given)) == ["rig.yaml", "a.png", "b.tif"]
    assert (made.alpha, made.depth, made.image) == ("mono", (1.0, 9.0), ("c=c.png",))
    of_colmap = ["sparse", "--alpha", "DSC_0001.JPG", "--image", "DSC_0001.JPG=a.jpg"]
    assert list(map(str, parse(Fuse, of_colmap).given)) == ["sparse"]  # cameras called as images
    assert rig_first(["a.png", "--rig", "r.yaml", "b.png"], Fuse) == ["r.yaml", "a.png", "b.png"]


@dataclasses.dataclass
class Inner:
    steps: int = 1
    rate: float = 0.5


@dataclasses.dataclass
class Outer:
    name: str
    inner: Inner = dataclasses.field(default_factory=Inner)


@pytest.mark.parametrize("base", [None, Outer("n")])
def test_options_of_a_dataclass_within_another_change_its_default(base):
    made = parse(Outer, ["--name", "n", "--inner.steps", "2"], base=base)
    assert made == Outer("n", Inner(2))


def test_writers_take_o_and_out():
    """Every command but those that write nothing has an option --out, also called -o."""
    nothing = {("explore",), ("rig", "info"), ("warm-up",), ("rig", "convert")}
    nothing |= {("lab", "settings"), ("lab", "data", "info"), ("lab", "train")}
    for path in command_paths():
        command = functools.reduce(command_named, path, Pat)
        hint = typing.get_type_hints(command, include_extras=True).get("out")
        assert path in nothing or typing.get_args(hint)[-1].short == "-o", path


@pytest.mark.parametrize(("command", "most"), [(Fuse, 18), (Align, 14)])
def test_a_command_has_few_options(command, most):
    options = [entry for entry in _entries(command, None) if not entry.option.positional]
    assert len(options) <= most
    known = {name for names in command.headings.values() for name in names.split()}
    assert known <= {entry.name for entry in options}
    assert len(options) - len(known) <= 5, "those that matter stand first"


def test_json_is_valid_where_the_rig_sees_to_infinity(small, capsys):
    main(["rig", "info", str(small / "rig.yaml"), "--depth", "2", "inf", "--json"])
    document = json.loads(capsys.readouterr().out, parse_constant=lambda name: pytest.fail(name))
    assert document["pairs"][0]["depth_step"][1] is None


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (ValueError("two\n  lines"), "pat: two lines"),
        (
            OSError(28, "No space left on device", "out/fused.png"),
            "pat: out/fused.png: No space left on device",
        ),
        (MemoryError(), "pat: out of memory"),
        (ImportError("drawing needs it: pip install plots"), "pat: drawing needs it: pip install plots"),
        (
            ImportError("No module named 'dask'"),
            "No module named 'dask': in a checkout, pip install '.[all]'",
        ),
        (KeyError("mono"), "pat: KeyError: 'mono' (--debug shows where)"),
        (RuntimeError("CUDA\nout"), "pat: RuntimeError: CUDA out (--debug shows where)"),
        (OverflowError("big"), "pat: OverflowError: big (--debug shows where)"),
        (RecursionError("deep"), "pat: RecursionError: deep (--debug shows where)"),
    ],
)
def test_errors_are_one_line_and_a_traceback_for_debugging(error, words, monkeypatch, refusal):
    def failing(self):
        raise error

    monkeypatch.setattr("pat.app.cli.demo.Demo.run", failing)
    assert words in refusal("demo")
    with pytest.raises(type(error)):
        main(["demo", "--debug"])


def wrong(small) -> None:
    """The rig with the sign of its baseline changed."""
    rig = Rig.load(small / "rig.yaml")
    colour = rig["colour"]
    colour = colour.replace(cam_from_world=Pose(colour.R, -colour.t))
    rig.with_camera("colour", colour).save(small / "rig.yaml")


def test_a_rig_that_does_not_fit_ends_with_status_3_and_strict_writes_nothing(tmp_path, capsys):
    small = cut_sample(tmp_path, (240, 320))
    wrong(small)
    for extra, written in ((["--extras", "none"], True), (["--misfit", "refuse"], False)):
        shutil.rmtree(small / "out", ignore_errors=True)
        with pytest.raises(SystemExit) as stop:
            main(arguments(small, extra=extra))
        assert stop.value.code == 3
        text = " ".join(capsys.readouterr().err.split())
        assert "`pat rig doctor` says: likely mistake: translation of all cameras with the wrong sign" in text
        assert written == bool(re.search(r"mean confidence 0\.[01]\d where the views overlap", text))
        assert (small / "out" / "fused.png").exists() == written
        assert not (small / "out" / "index.html").exists()
    assert not (small / "out").exists()


def test_one_image_for_two_cameras_is_refused(small, refusal):
    shutil.copy(small / "mono.png", small / "copy.png")
    for name in ("mono.png", "copy.png"):
        error = refusal(*arguments(small, colour=small / name))
        assert "'mono' and 'colour'" in error
        assert f"{small / name}" in error
        assert not (small / "out").exists()


def test_bands_are_listed_with_their_files(small, capsys):
    rig = Rig.load(small / "rig.yaml")
    band = rig["colour"].replace(sensor=Sensor())
    cameras = {"mono": rig["mono"], "nir": band, "red": band}
    Rig(cameras, depth=rig.depth).save(small / "rig.yaml")
    for name, band in zip(("red", "nir"), read_image(small / "colour.png")):
        write_image(small / f"{name}.png", band[None] * (0.5 if name == "nir" else 1))
    given = f"{images(small, *cameras)} --alpha mono --extras none"
    pat(f"fuse {small / 'rig.yaml'} {given} -o {small / 'out'}")
    said = " ".join(capsys.readouterr().err.split())
    assert "network: mono-spectral" in said
    assert "fused_nir.png, fused_red.png" in said
    for name, other in (("nir", "red"), ("red", "nir")):
        files = f"out/fused_{name}.png", f"{name}.png", f"{other}.png"
        fused, own, wrong = (read_image(small / path) for path in files)
        assert (small / "out" / f"confidence_{name}.png").is_file()
        assert (fused.mean() - own.mean()).abs() < (fused.mean() - wrong.mean()).abs()


def test_bands_that_the_weights_do_not_make_are_refused_with_which_to_take(small, refusal):
    write_image(small / "grey.png", read_image(small / "mono.png").flip(-1))
    error = refusal(*arguments(small, colour=small / "grey.png"))
    assert "the betas have 1 band in all ('colour' 1), these weights make 3: its image is grey" in error
    assert "mono-spectral" in error
    assert not (small / "out").exists()


def test_an_alpha_in_colour_and_a_beta_without_are_said(small, capsys):
    shutil.copy(small / "colour.png", small / "mono.png")
    write_image(
        small / "colour.png", read_image(small / "colour.png").mean(0, keepdim=True).expand(3, -1, -1)
    )
    with contextlib.suppress(SystemExit):
        main(arguments(small))
    text = " ".join(capsys.readouterr().err.split())
    assert "alpha, 'mono'" in text
    assert "image of 'colour'" in text


def test_a_bad_out_is_found_before_the_fusion(small, refusal, monkeypatch):
    monkeypatch.setattr("pat.app.front.fuse", lambda *_, **__: pytest.fail("fused"))
    (small / "out").write_text("a file")
    assert "out: cannot write there (" in refusal(*arguments(small))
    folders = arguments(small, mono=f"{small}/mon*.png", extra=["--out", "/proc/out"])
    assert "/proc/out: cannot write there (/proc/out: " in refusal("batch", *folders[1:])
    assert (small / "out").read_text() == "a file"


@pytest.mark.parametrize("name", ["fused.png", "depth.png", "1_fused.png", "fused_red.png"])
def test_images_that_results_would_replace_are_refused(small, name, refusal, monkeypatch):
    """An image named fused.png is not overwritten by the result."""
    monkeypatch.setattr("pat.app.front.fuse", lambda *_, **__: pytest.fail("fused"))
    (small / "out").mkdir()
    given = (small / "colour.png").rename(small / "out" / name)
    assert f"{name}: is called as a result" in refusal(*arguments(small, colour=given))
    assert f"{name}: is called as a result" in refusal("fuse", small / "mono.png", given, "-o", small / "out")


@pytest.mark.parametrize(
    ("command", "out", "text"),
    [
        (["rig", "refine", "rig.yaml", "--image", "mono=a.png"], "folder", "is a folder: name a file"),
        (["rig", "start", "--image", "mono=a.png"], "folder", "is a folder: name a file"),
        (["calibrate", "photos", "--board", "charuco:8x6:30mm"], "file/rig.yaml", "file is a file, so"),
        (["calibrate", "photos", "--board", "charuco:8x6:30mm"], "/proc/rig.yaml", "/proc cannot be written"),
        (["lab", "evaluate", "--kitti", "kitti"], "file", "is a file: name a folder"),
        (["rig", "doctor", "rig.yaml", "--image", "mono=a.png"], "folder", "is a folder: name a file"),
        (["rig", "show", "rig.yaml"], "file", "is a file: name a folder"),
        (["demo"], "file", "is a file: name a folder"),
        (["lab", "ablate", "--scenes", "1"], "file", "is a file: name a folder"),
        (["board", "charuco:8x6:30mm"], "folder", "is a folder: name a file"),
        (["rig", "diff", "rig.yaml", "rig.yaml"], "picture.foo", "end its name in .png, .pdf or .svg"),
        (["lab", "ablate", "--rendered", "scenes", "--scenes", "1"], "new", "--scenes: of layered scenes"),
    ],
)
def test_a_bad_out_is_found_before_the_work(command, out, text, tmp_path, monkeypatch, refusal):
    """Neither images nor folders of them exist, and the rig is empty: they are not read before."""
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("")
    (tmp_path / "rig.yaml").write_text("")  # that it is there is looked for first, which is as quick
    monkeypatch.chdir(tmp_path)
    assert text in refusal(*command, "--out", out)


@pytest.mark.parametrize(
    ("command", "text"),
    [
        (["refine", "rig.yaml", "-o", "new.yaml"], "--image"),
        (["doctor", "rig.yaml"], "--image"),
        (["start", "-o", "new.yaml"], "--image"),
        (["diff", "rig.yaml", "rig.yaml", "--matches", "none.csv"], "--matches needs --image"),
        (["start", "--image", "a=mono.png", "--image", "b=colour.png", "--focal", "a=nan"], "a=nan"),
    ],
)
def test_images_that_are_missing_are_asked_for(small, command, text, monkeypatch, refusal):
    """Without any image the message asks for some; matches do not replace them."""
    monkeypatch.chdir(small)
    out = ["-o", "new.yaml"] if "--focal" in command else []
    said = refusal("rig", *command, *out)
    assert text in said
    assert "Error" not in said
    assert not (small / "new.yaml").exists()


@pytest.mark.parametrize(
    "line",
    [
        "batch rig.yaml --alpha mono --image mono=mono.png --image colour=colour.png --out .",
        "align . . --out .",
        "lab ablate --photos . --out figures/today",
        "lab train pat-supervised --photos . --out run",
        "lab evaluate --folder . --out out",
        "lab render scenes.yaml --scenes 1 --out rendered",
    ],
)
def test_results_among_the_images_that_are_read_are_refused(small, line, monkeypatch, refusal):
    monkeypatch.chdir(small)
    layered = "rig: rig.yaml\nseed: 1\nbackend: layered\nlayered: {photos: [.]}\n"
    (small / "scenes.yaml").write_text(layered)
    before = {*small.iterdir()}
    assert "--out" in refusal(*line.split())
    assert {*small.iterdir()} == before
