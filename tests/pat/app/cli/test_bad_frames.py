"""`pat batch` of several frames, one of which cannot be read: it stops there or skips it, and is resumed."""

import pytest

from pat.app.cli.main import main
from pat.app.sample_array import load_sample
from pat.media.images import write_image

HW = (96, 128)


@pytest.fixture
def frames(tmp_path):
    """A folder of three frames of each camera."""
    sample = load_sample()
    rig = sample.rig
    for name in rig.names:
        rig = rig.crop(name, 0, 0, HW)
        image = sample.images[name][:, : HW[0], : HW[1]]
        for i in range(3):
            write_image(tmp_path / name / f"{i}.png", image * (1 - 0.1 * i))
    rig.save(tmp_path / "rig.yaml")
    return tmp_path


def cut_in_half(path):
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    return whole


def fuse(folder, *options):
    """The status that the command ends with, and the numbers of the frames in its folder."""
    images = [a for name in ("mono", "colour") for a in ("--image", f"{name}={folder / name}")]
    given = ["--rig", str(folder / "rig.yaml"), "--alpha", "mono", *images, "--out", str(folder / "out")]
    status = 0
    try:
        main(["batch", *given, *options])
    except SystemExit as ended:
        status = ended.code
    return status, sorted(p.name.partition("_")[0] for p in (folder / "out").glob("*_fused.png"))


def test_a_frame_that_cannot_be_read_is_skipped_and_made_when_it_is_put_right(frames, capsys):
    bad = frames / "mono" / "1.png"
    whole = cut_in_half(bad)
    assert fuse(frames, "--on-error", "skip") == (1, ["0", "2"])
    assert "1_fused.png: mono: " in " ".join(capsys.readouterr().err.split())
    bad.write_bytes(whole)
    kept = {p: p.stat().st_mtime_ns for p in (frames / "out").glob("*_fused.png")}
    assert fuse(frames, "--resume") == (0, ["0", "1", "2"])
    assert {p: p.stat().st_mtime_ns for p in kept} == kept


def test_a_frame_that_cannot_be_read_stops_the_command(frames):
    cut_in_half(frames / "mono" / "1.png")
    status, made = fuse(frames, "--on-error", "stop")
    assert status != 0
    assert made == ["0"]
