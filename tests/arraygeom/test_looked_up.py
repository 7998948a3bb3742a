"""Many positions are looked up in pieces, on all threads: the values are those of all at once."""

import pytest
import torch
from torch.nn.functional import grid_sample

from arraygeom.sampling import PIECE, sample, to_grid

N = 2 * PIECE + 7


@pytest.fixture
def given():
    g = torch.Generator().manual_seed(0)
    image, x = torch.rand(2, 3, 20, 30, generator=g), torch.rand(2, N, 2, generator=g)
    return image, x * torch.tensor([29.0, 19.0])


@pytest.mark.parametrize("interpolation", ["bilinear", "bicubic"])
def test_pieces_are_what_all_at_once_is(given, interpolation, monkeypatch):
    image, x = given
    asked = []
    monkeypatch.setattr(
        "arraygeom.sampling.grid_sample", lambda *a, **k: asked.append(a) or grid_sample(*a, **k)
    )
    found = sample(image, x, interpolation=interpolation)
    whole = grid_sample(
        image, to_grid(x, (20, 30))[:, None], mode=interpolation, padding_mode="border", align_corners=False
    )
    assert len(asked) == 3
    assert found.valid.all()
    assert torch.equal(found.values, whole[:, :, 0])


def test_in_inference_mode_pieces_are_looked_up_on_all_threads(given, monkeypatch):
    monkeypatch.setattr("arraygeom.runtime.threads.threads", lambda: 2)
    with torch.inference_mode():
        found = sample(*given)
    assert torch.equal(found.values, sample(*given).values)


def test_gradients_are_of_all(given):
    image, x = given
    image.requires_grad_()
    with torch.no_grad():
        assert not sample(image, x).values.requires_grad
    sample(image, x).values.sum().backward()
    assert image.grad.sum() == pytest.approx(2 * 3 * N, rel=1e-4)
