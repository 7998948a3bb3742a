"""Convolutions on all threads: the same numbers, gradients and precision."""

import pytest
import torch

from arraygeom.runtime.threads import torch_in_one_thread
from pat.support import convolutions as module
from pat.support.convolutions import convolutions_in_parallel


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize(
    "of", [{}, {"dilation": 8, "padding": 8}, {"padding": 0}, {"stride": 2}, {"groups": 4}]
)
@pytest.mark.parametrize("channels_last", [False, True])
def test_convolutions_in_strips_are_the_same(two_threads, monkeypatch, of, channels_last):
    conv = torch.nn.Conv2d(16, 16, 3, **{"padding": 1, **of})
    x = torch.rand(1, 16, 301, 207)
    x = x.contiguous(memory_format=torch.channels_last) if channels_last else x
    strips = []
    monkeypatch.setattr(module, "in_parallel", lambda tasks: strips.extend(t() for t in tasks))
    monkeypatch.setattr(module, "WORTH_STRIPS", 0)
    with torch.no_grad(), torch_in_one_thread():
        whole = conv(x)
        with convolutions_in_parallel():
            made = conv(x)
    # To the bit where oneDNN computes any height in one way; on some processors of AMD it does not.
    torch.testing.assert_close(made, whole, rtol=0, atol=2e-6)
    assert made.stride() == whole.stride()
    assert len(strips) == (0 if "stride" in of else 4)


def test_convolutions_in_inference_mode(two_threads, monkeypatch):
    """Tensors made in it may be written in it alone, by whichever thread."""
    monkeypatch.setattr(module, "WORTH_STRIPS", 0)
    conv, x = torch.nn.Conv2d(16, 16, 3, padding=1), torch.rand(1, 16, 301, 207)
    with torch.inference_mode(), torch_in_one_thread():
        whole = conv(x)
        with convolutions_in_parallel():
            torch.testing.assert_close(conv(x), whole, rtol=0, atol=2e-6)


def test_convolutions_keep_gradients_and_precision(two_threads):
    conv, x = torch.nn.Conv2d(16, 16, 3, padding=1), torch.rand(1, 16, 301, 207)
    with torch_in_one_thread(), convolutions_in_parallel():
        assert conv(x).requires_grad
        with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
            assert conv(x).dtype == torch.bfloat16


def test_convolutions_are_torchs_own_where_its_threads_sleep(two_threads, monkeypatch):
    """Strips pay only where threads would spin."""
    monkeypatch.setattr(module, "_SLEEPING", True)
    monkeypatch.setattr(module, "_convolved", None)
    x, layer = torch.rand(1, 8, 300, 300), torch.nn.Conv2d(8, 8, 3, padding=1)
    with torch.no_grad(), torch_in_one_thread(), convolutions_in_parallel():
        found = layer(x)
    assert found.equal(layer(x))
