"""`--around` of fuse, align and the rig commands, on a wall with a post before it."""

import re
from contextlib import suppress

import cv2
import numpy as np
import pytest
import tifffile
import torch
from torch.nn.functional import interpolate

from arraygeom import Rig, epipolar_distance
from pat import FuseSettings
from pat import align as aligned
from pat.app.cli.known import Around
from pat.fusion.align import OCCLUDED
from pat.media.images import read_image, write_image
from tests.arraygeom.rigs import parallel_rig
from tests.pat.commands import images, pat

H, W = 96, 160
WALL, POST, BASELINE = 4.0, 2.0, 0.25
FAR, NEAR = 10, 20
"""Disparities of wall and post, pixels."""
ON_POST = slice(70, 90)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Rig, images and what is known of them; beta's image has nothing to do with alpha's in `blind.png`."""
    folder = tmp_path_factory.mktemp("known")
    rig = parallel_rig(float(W), (H, W), {"mono": (), "colour": (BASELINE,)}, (1.0, 50.0))
    rig.save(folder / "rig.yaml")
    noise = torch.rand(2, 3, H // 2, W // 2 + 10, generator=torch.Generator().manual_seed(0))
    wall, post = interpolate(noise, size=(H, W + 20), mode="bicubic", align_corners=False).clamp(0, 1)
    mono, colour, depth = wall[..., :W].clone(), wall[..., FAR : FAR + W].clone(), torch.full((H, W), WALL)
    mono[..., ON_POST] = post[..., ON_POST]
    colour[..., ON_POST.start - NEAR : ON_POST.stop - NEAR] = post[..., ON_POST]
    depth[:, ON_POST] = POST
    write_image(folder / "mono.png", mono.mean(0, keepdim=True))
    write_image(folder / "colour.png", colour)
    write_image(folder / "blind.png", noise[1, :, :48, :80].repeat(1, 2, 2).rot90(2, (1, 2)))
    tifffile.imwrite(folder / "depth.tif", depth.numpy())
    cv2.imwrite(str(folder / "depth.png"), (depth.numpy() * 5000).astype(np.uint16))
    y, x = np.mgrid[4:H:8, 24:W:8]
    d = np.where(depth.numpy()[y, x] == WALL, FAR, NEAR)
    for file, columns in (("matches.csv", [x, y, x - d, y]), ("exchanged.csv", [x - d, y, x, y])):
        np.savetxt(folder / file, np.stack(columns, -1).reshape(-1, 4), delimiter=",")
    return folder


def run(folder, command, options="", colour="colour.png"):
    """`{}` in the options stands for the folder."""
    files = f"--image mono={folder / 'mono.png'} --image colour={folder / colour}"
    rest = options.replace("{}", str(folder))
    pat(f"{command} {folder / 'rig.yaml'} --alpha mono {files} -o {folder / 'out'} {rest}")


def depth_of(folder):
    return tifffile.imread(folder / "out" / "depth.tif")[:, 40:]


@pytest.mark.parametrize("file", ["depth.tif", "depth.png,scale=0.0002"])
def test_a_depth_map_is_taken_as_it_is(folder, file):
    """Whatever the images show: beta's is of something else."""
    options = f"--around {{}}/{file},tolerance=0 --misfit warn --response rec601"
    run(folder, "fuse", options, colour="blind.png")
    found, true = depth_of(folder), tifffile.imread(folder / "depth.tif")[:, 40:]
    known = np.isfinite(found)
    assert known.mean() > 0.8
    assert np.abs(found - true)[known].max() < 1e-2


def test_a_depth_map_that_matched_points_contradict_is_said(folder, capsys):
    depth = tifffile.imread(folder / "depth.tif")
    tifffile.imwrite(folder / "other.tif", np.where(depth == WALL, POST, WALL).astype(np.float32))
    for file, contradicted in (("depth.tif", False), ("other.tif", True)):
        with suppress(SystemExit):  # status 3: the images do not match there
            run(folder, "align", f"--around {{}}/{file}")
        assert bool(re.search(rf"{file}: \d+% of the points", capsys.readouterr().err)) == contradicted


def test_what_the_post_hides_is_occluded(folder):
    from arraygeom.fields import AroundDepth

    rig = Rig.load(folder / "rig.yaml")
    given = {name: read_image(folder / f"{name}.png") for name in rig.names}
    depth = torch.from_numpy(tifffile.imread(folder / "depth.tif"))
    field = AroundDepth(depth, 0.02, rig["mono"])
    view = aligned(given, rig, alpha="mono", settings=FuseSettings(align=False, field=field))["colour"]
    hidden = slice(ON_POST.start - (NEAR - FAR), ON_POST.start)
    assert (view.visibility[:, hidden][:, 2:-2] == OCCLUDED).mean() > 0.9
    assert view.valid[:, ON_POST].mean() > 0.9
    assert view.valid[:, ON_POST.stop + 4 : -4].mean() > 0.9


def test_what_a_field_of_ones_own_raises_is_a_line(folder, tmp_path, monkeypatch, capsys):
    (tmp_path / "fields_of_mine.py").write_text("def slanted(pair, x):\n    return x + 'pixels'\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(SystemExit):
        run(folder, "fuse", "--field fields_of_mine:slanted")
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("pat: TypeError: ")
    assert last.endswith("'str', raised by the field slanted (--debug shows where)")
    with pytest.raises(TypeError, match="str"):
        run(folder, "fuse", "--field fields_of_mine:slanted --debug")


def test_matches_guide_the_search(folder):
    run(folder, "align", "--around {}/matches.csv")
    inner = depth_of(folder)
    assert np.nanmedian(np.abs(inner - tifffile.imread(folder / "depth.tif")[:, 40:])) < 0.05


def test_rig_commands_take_matches(folder, capsys):
    given = f"{images(folder, 'mono', 'colour')} --matches {folder / 'matches.csv'}"
    pat(f"rig doctor {folder / 'rig.yaml'} {given}")
    assert "204 points" in capsys.readouterr().out
    pat(f"rig start {given} -o {folder / 'started.yaml'}")
    assert "points" in capsys.readouterr().out
    assert Rig.load(folder / "started.yaml").links
    pat(f"rig refine {folder / 'rig.yaml'} {given} -o {folder / 'refined.yaml'}")


@pytest.mark.parametrize("alpha", ["mono", "blind"])
def test_matches_find_the_rig_of_images_that_do_not_match(folder, tmp_path, alpha, capsys):
    """Matches that are given are enough, where none can be found."""
    files = f"{folder / 'mono.png'} {folder / 'blind.png'}"
    with suppress(SystemExit):  # as confidence is low
        pat(f"align {files} --matches {folder / 'matches.csv'} --alpha {alpha} -o {tmp_path} --extras npy")
    assert "204 " in capsys.readouterr().err
    x = torch.from_numpy(np.loadtxt(folder / "matches.csv", delimiter=","))
    rig = Rig.load(tmp_path / "found_rig.yaml")
    assert rig.names[0] == alpha
    F = rig.pair("mono", "blind").fundamental.to(x)
    assert float(epipolar_distance(F, x[:, :2], x[:, 2:]).abs().median()) < 0.5


def test_ten_matches_lay_one_image_on_the_other(folder, tmp_path, capsys):
    rows = np.loadtxt(folder / "matches.csv", delimiter=",")
    np.savetxt(tmp_path / "ten.csv", rows[rows[:, 0] - rows[:, 2] == FAR][::19], delimiter=",")
    files = f"{folder / 'mono.png'} {folder / 'blind.png'}"
    pat(f"fuse {files} --matches {tmp_path / 'ten.csv'} --alpha mono -o {tmp_path / 'out'} --extras none")
    assert not (tmp_path / "out" / "depth.tif").exists()
    assert "homography" in capsys.readouterr().err
    assert not (tmp_path / "out" / "found_rig.yaml").exists()
    pat(
        f"rig start --image mono={folder / 'mono.png'} --image blind={folder / 'blind.png'} "
        f"--matches {tmp_path / 'ten.csv'} -o {tmp_path / 'rig.yaml'}"
    )
    assert Rig.load(tmp_path / "rig.yaml").pair("mono", "blind").at_one_place


def test_a_depth_map_without_a_rig_is_refused_before_the_work(folder, tmp_path, refusal, monkeypatch):
    monkeypatch.setattr("pat.app.from_images.array_from_images", None)
    files = folder / "mono.png", folder / "colour.png"
    assert "--around" in refusal("align", *files, "--depth-map", folder / "depth.tif", "-o", tmp_path)


def test_matches_off_the_lines_of_the_rig_are_said(folder, capsys):
    """Beta's rows are counted from below, as for another image."""
    rows = np.loadtxt(folder / "matches.csv", delimiter=",")
    rows[:, 3] = H - 1 - rows[:, 3]
    np.savetxt(folder / "rows.csv", rows, delimiter=",")
    run(folder, "align", "--around {}/rows.csv")
    assert re.search(
        r"rows.csv: matches of 'mono' and 'colour' lie \d+ px .*x before y", capsys.readouterr().err
    )
    run(folder, "align", "--around {}/matches.csv")
    assert "matches of" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ("--around {}/depth.tif --field line", "--field"),
        ("--around {}/depth.png,scale=1", "holds 1e+04 to 2e+04 m, the rig's"),
        ("--around {}/mono.png", "8 bits, too few"),
        ("--around {}/none.png", "none.png"),
        ("--around {}/depth.tif,unit=1", "--around"),
        ("--around {}/depth.tif,scale=one", "--around"),
        ("--around {}/depth.tif,scale=-1", "--around"),
        ("--around {}/rig.yaml", "rig.yaml"),
        ("--around {}/depth.tif,tolerance=-1", "--around"),
        ("--around {}/exchanged.csv", "behind the cameras by the rig: are its columns in the order"),
        ("--extras pages", "--extras"),
    ],
)
def test_bad_input_is_one_line(folder, options, expected, capsys):
    with pytest.raises(SystemExit) as stop:
        run(folder, "fuse", options)
    assert stop.value.code == 2
    assert expected in capsys.readouterr().err.splitlines()[-1]


def test_a_large_depth_map_in_another_unit_is_told_what_it_holds(folder, monkeypatch):
    """Torch's quantiles are of 2^24 numbers at most: larger maps are sampled."""
    monkeypatch.setattr("pat.media.depth_maps.read_depth", lambda *_, **__: torch.full((4097, 4097), 1e4))
    rig, large = Rig.load(folder / "rig.yaml"), folder / "large.tif"
    large.touch()
    with pytest.raises(ValueError, match=r"1e\+04 m"):
        Around(around=str(large)).with_known({}, rig, rig.names[0], {}, None)
