"""Depth maps of every kind of file: the same metres; and what is refused."""

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image

from pat.app.results import write_depth
from pat.media.depth_maps import read_depth

DEPTH = torch.linspace(0.5, 6.0, 20 * 30).reshape(20, 30)


def pfm(path, values, order):
    scale = -1.0 if order == "<" else 1.0
    head = f"Pf\n{values.shape[1]} {values.shape[0]}\n{scale}\n".encode()
    path.write_bytes(head + np.ascontiguousarray(values[::-1]).astype(f"{order}f4").tobytes())


@pytest.mark.parametrize("order", "<>")
def test_pfm_of_either_order(tmp_path, order):
    values = DEPTH.numpy().copy()
    values[3, 4] = np.inf
    pfm(tmp_path / "depth.pfm", values, order)
    found = read_depth(tmp_path / "depth.pfm", hw=(20, 30))
    assert found[3, 4].isnan()
    assert torch.equal(found[5:], DEPTH[5:])


@pytest.mark.parametrize(("end", "plus"), [("\r\n", ""), ("\n", "+"), (" ", "")])
def test_pfm_heads_as_other_programs_write_them(tmp_path, end, plus):
    """Lines may end as on Windows, a scale above 0 may have its sign; a value may begin with a line's end."""
    values = np.frombuffer(b"\x0a\x0d\x0a\x40" * 600, "<f4").reshape(20, 30)
    for order, scale in (("<", "-1.0"), (">", f"{plus}1.0")):
        head = end.join(["Pf", "30 20", scale, ""]).encode()
        (tmp_path / "depth.pfm").write_bytes(head + values.astype(f"{order}f4").tobytes())
        assert np.array_equal(read_depth(tmp_path / "depth.pfm").numpy(), values)


def test_tiff_and_png(tmp_path):
    tifffile.imwrite(tmp_path / "float.tif", DEPTH.numpy())
    assert torch.equal(read_depth(tmp_path / "float.tif"), DEPTH)
    counts = (DEPTH * 1000).round().numpy().astype(np.uint16)
    counts[0, 0] = 0
    Image.fromarray(counts).save(tmp_path / "mm.png")
    found = read_depth(tmp_path / "mm.png")
    assert found[0, 0].isnan()
    assert float((found - DEPTH)[1:].abs().max()) < 6e-4
    assert float((read_depth(tmp_path / "mm.png", scale=0.002) - 2 * DEPTH)[1:].abs().max()) < 2e-3


def test_the_scale_that_our_own_file_states_is_taken(tmp_path):
    assert write_depth(tmp_path / "depth_16.png", 8 * DEPTH) != 1000
    assert float((read_depth(tmp_path / "depth_16.png") - 8 * DEPTH).abs().max()) < 6e-3


def test_maps_that_pillow_takes_for_an_attack_are_read(tmp_path, monkeypatch):
    write_depth(tmp_path / "depth_16.png", 8 * DEPTH)
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 100)
    assert float((read_depth(tmp_path / "depth_16.png") - 8 * DEPTH).abs().max()) < 6e-3


def test_what_is_no_depth_map_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.tif"):
        read_depth(tmp_path / "none.tif")
    tifffile.imwrite(tmp_path / "float.tif", DEPTH.numpy())
    with pytest.raises(ValueError, match=r"30x20, .*30x21"):
        read_depth(tmp_path / "float.tif", hw=(21, 30))
    Image.fromarray(np.zeros((20, 30), np.uint8)).save(tmp_path / "eight.png")
    with pytest.raises(ValueError, match="8 bits"):
        read_depth(tmp_path / "eight.png")
    Image.fromarray(np.zeros((20, 30, 3), np.uint8)).save(tmp_path / "colour.png")
    with pytest.raises(ValueError, match="has 3 channels"):
        read_depth(tmp_path / "colour.png")
    tifffile.imwrite(tmp_path / "nothing.tif", np.zeros((20, 30), np.float32))
    with pytest.raises(ValueError, match="positive"):
        read_depth(tmp_path / "nothing.tif")
    for name, content, said in (
        ("short", b"Pf\n30 20\n-1\n" + bytes(100), "whole"),
        ("cut", b"Pf\n30 20\n-1\n" + bytes(101), "whole"),
        ("scale", b"Pf\n30 20\n-1.0.2\n" + bytes(2400), "PFM"),
        ("colour", b"PF\n30 20\n-1\n" + bytes(7200), "PFM"),
    ):
        (tmp_path / f"{name}.pfm").write_bytes(content)
        with pytest.raises(ValueError, match=rf"{name}\.pfm: .*{said}"):
            read_depth(tmp_path / f"{name}.pfm")
