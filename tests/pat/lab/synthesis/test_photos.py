import errno
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from pat.lab.synthesis.photos import PhotoBank


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [
        rng.integers(0, 256, (64, 96, 3), dtype=np.uint8),
        rng.integers(0, 256, (70, 32, 3), dtype=np.uint8),
    ]


def seen_values(bank: PhotoBank, texture: int, xy: list[list[float]], level: float) -> np.ndarray:
    n = len(xy)
    return bank.lookup(
        torch.full((n,), texture), torch.tensor(xy, dtype=torch.float32), torch.full((n,), level)
    ).T.numpy()


def test_texel_centres_return_the_texels(images):
    bank = PhotoBank(images)
    found = seen_values(bank, 1, [[0, 0], [31, 63], [5, 7]], 0.0)
    wanted = images[1][[0, 63, 7], [0, 31, 5]] / 255
    np.testing.assert_allclose(found, wanted, atol=1e-6)


def test_mirrored_beyond_the_edges(images):
    bank = PhotoBank(images)
    found = seen_values(bank, 0, [[-1, -3], [96, 64], [-96.0, 0], [95.0 + 192 * 3, 0]], 0.0)
    wanted = images[0][[2, 63, 0, 0], [0, 95, 95, 95]] / 255
    np.testing.assert_allclose(found, wanted, atol=1e-6)


def test_levels_are_area_averages_without_shift(images):
    bank = PhotoBank(images)
    reduced = cv2.resize(images[0].astype(np.float32) / 255, (24, 16), interpolation=cv2.INTER_AREA)
    centre = [[4 * (3 + 0.5) - 0.5, 4 * (2 + 0.5) - 0.5]]
    np.testing.assert_allclose(seen_values(bank, 0, centre, 2.0)[0], reduced[2, 3], atol=1 / 255)


def test_between_pixels_it_is_bilinear(images):
    bank = PhotoBank(images)
    xy = np.random.default_rng(1).uniform(1, 60, (50, 2)).astype(np.float32)
    image = torch.from_numpy(images[0] / np.float32(255)).movedim(-1, 0)[None]
    grid = torch.from_numpy((2 * xy + 1) / np.float32([96, 64]) - 1)[None, None]
    wanted = torch.nn.functional.grid_sample(image, grid, align_corners=False)[0, :, 0].T.numpy()
    np.testing.assert_allclose(seen_values(bank, 0, xy.tolist(), 0.0), wanted, atol=1e-4)


def test_a_folder_of_colour_and_grey_with_its_cache(tmp_path, images):
    (tmp_path / "deep").mkdir()
    cv2.imwrite(str(tmp_path / "deep" / "colour.png"), images[0])
    cv2.imwrite(str(tmp_path / "grey.png"), images[1][..., 0])
    (tmp_path / "notes.txt").write_text("no image")
    bank = PhotoBank.load(tmp_path, max_edge=48, cache=tmp_path / "cache.npz")
    assert bank.photos == 2
    assert bank.wh[0, 0].tolist() == [32, 32]
    grey = seen_values(bank, 1, [[3, 4]], 0.0)[0]
    assert grey.max() == grey.min()
    again = PhotoBank.load(tmp_path, max_edge=48, cache=tmp_path / "cache.npz")
    assert torch.equal(again.texels, bank.texels)


def test_an_empty_folder_is_an_error(tmp_path):
    with pytest.raises(ValueError, match="image"):
        PhotoBank.load(tmp_path)


def test_too_few_photographs_to_hold_some_out_are_said_to_be(tmp_path, images):
    """The message counts photographs."""
    cv2.imwrite(str(tmp_path / "only.png"), images[0])
    assert PhotoBank.load(tmp_path, choose=lambda i: i % 20 == 0).photos == 1
    with pytest.raises(ValueError, match=r"photographs[^/]*$"):
        PhotoBank.load(tmp_path, choose=lambda i: i % 20 != 0)


def test_a_cache_is_whole_or_not_there_and_another_file_is_named(tmp_path, images, monkeypatch):
    cv2.imwrite(str(tmp_path / "a.png"), images[0])
    cache = tmp_path / "cache.npz"

    def full(file, *arrays):
        (Path(file) if isinstance(file, str | Path) else Path(file.name)).write_bytes(b"PK")
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(np, "savez", full)
        with pytest.raises(OSError, match="No space"):
            PhotoBank.load(tmp_path, cache=cache)
    assert not cache.exists()
    for content in (b"PK", b"PK\x03\x04 cut short", b"text", b""):
        cache.write_bytes(content)
        with pytest.raises(ValueError, match=r"cache.npz: "):
            PhotoBank.load(tmp_path, cache=cache)
