"""The command line: it does the main job, and what is wrong is one line and exit status 2."""

import json
import shutil

import pytest
import torch
import yaml

from arraygeom import Rig
from pat.cli.main import main
from pat.data.sample_array import SAMPLE, load_sample
from pat.evaluation.metrics import score
from pat.media.images import read_image, write_image


@pytest.fixture
def small(tmp_path):
    """The sample array, its rig and images cut small so that fusing takes a moment."""
    sample = load_sample()
    rig = sample.rig
    for name in rig.names:
        image = sample.images[name][:, :96, :128]
        rig = rig.crop(name, 0, 0, (96, 128))
        write_image(tmp_path / f"{name}.png", image)
    rig.save(tmp_path / "rig.yaml")
    return tmp_path


def arguments(folder, **changes):
    given = {"rig": folder / "rig.yaml", "alpha": "mono", "mono": folder / "mono.png", "colour": folder / "colour.png"}
    given |= changes
    images = [a for name in ("mono", "colour") for a in ("--image", f"{name}={given[name]}")]
    extra = given.get("extra", [])
    rig = ["--rig", str(given["rig"]), "--alpha", given["alpha"], "--out", str(folder / "out")]
    return ["fuse", *rig, *map(str, images), *extra]


def fails(arguments, capsys) -> str:
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
    return " ".join(capsys.readouterr().err.split())


def test_fuse_writes_everything(small):
    main(arguments(small))
    assert sorted(p.name for p in (small / "out").iterdir()) == [
        "confidence.png",
        "depth.png",
        "depth.tif",
        "fused.png",
        "view.yaml",
    ]
    view = Rig.load(small / "out" / "view.yaml")
    assert view.names == ("mono",)
    assert view["mono"].hw == (96, 128)
    assert read_image(small / "out" / "fused.png").shape == (3, 96, 128)


def test_demo_beats_alpha_alone(tmp_path, capsys):
    main(["demo", "--out", str(tmp_path)])
    sample = load_sample()
    alone = score(sample.images["mono"].expand(3, -1, -1), sample.ground_truth)
    fused = score(read_image(tmp_path / "fused.png"), sample.ground_truth)
    assert fused.psnr > alone.psnr + 5
    assert fused.ssim > alone.ssim
    assert "classical" in capsys.readouterr().out
    assert (tmp_path / "demo.png").is_file()


def test_help_names_the_commands(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert all(command in text for command in ("demo", "fuse", "show"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mono": "/none.png"}, "mono: /none.png"),
        ({"alpha": "momo"}, "no camera 'momo'; did you mean 'mono'"),
        ({"rig": "/none.yaml"}, "/none.yaml: no such rig file"),
        ({"extra": ["--depth", "20", "2"]}, "0 < near <= far"),
        ({"extra": ["--depth", "-1", "2"]}, "0 < near <= far"),
        ({"extra": ["--max-memory", "lots"]}, "max_memory is 'lots'"),
        ({"extra": ["--image", "tele=x.png"]}, "no camera 'tele'"),
        ({"extra": ["--weights", "mono-color"]}, "no weights 'mono-color'"),
        ({"mono": SAMPLE / "mono.png"}, "mono.png: is 640x400, the rig says 128x96"),
    ],
)
def test_mistakes_are_one_line_and_leave_nothing(changes, message, small, capsys):
    assert message in fails(arguments(small, **changes), capsys)
    assert not (small / "out").exists()


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda rig: rig["cameras"]["mono"].update(focl=3), "cameras.mono.focl: unknown key; did you mean 'focal'"),
        (lambda rig: rig["cameras"]["mono"].update(rotation=[[2, 0, 0], [0, 1, 0], [0, 0, 1]]), "not a rotation"),
        (lambda rig: rig.update(depth=[20, 2]), "depth: is [20, 2] m; wanted [near, far]"),
        (lambda rig: rig["cameras"]["mono"].pop("size"), "cameras.mono.size"),
        (lambda rig: rig["cameras"]["colour"].update(position=[100, 0, 0], translation=[0, 0, 0]), "keep one"),
    ],
)
def test_rig_mistakes_name_the_entry(edit, message, small, capsys):
    rig = yaml.safe_load((small / "rig.yaml").read_text())
    edit(rig)
    (small / "rig.yaml").write_text(yaml.safe_dump(rig))
    error = fails(arguments(small), capsys)
    assert message in error
    assert "rig.yaml" in error


def test_views_that_do_not_overlap(small, capsys):
    rig = yaml.safe_load((small / "rig.yaml").read_text())
    rig["cameras"]["colour"] |= {"rotation": [0, 180, 0]}
    (small / "rig.yaml").write_text(yaml.safe_dump(rig))
    assert "'colour's views do not overlap" in fails(arguments(small), capsys)


def test_images_with_an_alpha_channel_or_nan(small, capsys):
    transparent = torch.rand(4, 96, 128)
    import cv2

    cv2.imwrite(str(small / "mono.png"), (transparent.movedim(0, -1).numpy() * 255).astype("uint8"))
    assert "mono.png" in fails(arguments(small), capsys)
    shutil.copy(small / "colour.png", small / "mono.tif")
    cv2.imwrite(str(small / "mono.tif"), torch.full((96, 128), torch.nan).numpy())
    assert "NaN" in fails(arguments(small, mono=small / "mono.tif"), capsys)


def test_show_draws_the_rig_and_its_fields(small):
    main(["show", str(small / "rig.yaml"), "--image", f"mono={small / 'mono.png'}", "--out", str(small / "out")])
    assert sorted(p.name for p in (small / "out").iterdir()) == ["fields.png", "rig.png"]
    main(["rig", "show", str(small / "rig.yaml"), "--alpha", "colour", "--out", str(small / "again")])
    assert (small / "again" / "fields.png").is_file()


def test_rig_info_tells_the_numbers(small, capsys):
    main(["rig", "info", str(small / "rig.yaml"), "--depth", "2", "8"])
    text = " ".join(capsys.readouterr().out.split())
    assert "128x96" in text
    assert "820, 820" in text
    assert "2.439 - 9.756" in text
    assert "0.1241" in text


def test_rig_convert_and_back(small, capsys):
    main(["rig", "convert", str(small / "rig.yaml"), str(small / "chain.yaml"), "--write-as", "kalibr"])
    main(["rig", "convert", str(small / "chain.yaml"), str(small / "back.yaml")])
    first, again = Rig.load(small / "rig.yaml"), Rig.load(small / "back.yaml")
    for a, b in zip(first.cameras.values(), again.cameras.values()):
        assert torch.allclose(a.K, b.K)
        assert torch.allclose(a.cam_from_world.t, b.cam_from_world.t, atol=1e-9)
    assert "known" in fails(["rig", "convert", str(small / "rig.yaml"), "x", "--write-as", "word"], capsys)


def test_rig_info_as_json(small, capsys):
    main(["rig", "info", str(small / "rig.yaml"), "--json"])
    told = json.loads(capsys.readouterr().out)
    assert [camera["name"] for camera in told["cameras"]] == ["mono", "colour"]
    assert told["pairs"][0]["baseline"] == pytest.approx(0.1241, abs=1e-3)


def test_an_interruption_is_one_line_and_status_130(monkeypatch, capsys):
    def interrupted(self):
        raise KeyboardInterrupt

    monkeypatch.setattr("pat.cli.fusing.Demo.run", interrupted)
    with pytest.raises(SystemExit) as stop:
        main(["demo"])
    assert stop.value.code == 130
    assert "interrupted" in capsys.readouterr().err


def test_explore_says_what_is_missing(small, capsys):
    pytest.importorskip("panel")
    told = fails(["explore", str(small / "rig.yaml"), "--image", f"mono={small / 'mono.png'}", "--no-browser"], capsys)
    assert "two cameras or more" in told


def test_warnings_are_one_line(small, capsys):
    text = (small / "rig.yaml").read_text().replace("translation: [-0.12", "translation: [-120.12")
    assert "-120.12" in text
    (small / "rig.yaml").write_text(text)
    main(["rig", "info", str(small / "rig.yaml")])
    told = capsys.readouterr().err
    assert told.startswith("pat: warning: ")
    assert "millimetres" in told
    assert ".py" not in told.replace(str(small), "")
