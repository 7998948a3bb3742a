"""Convolutions in 8 bits: what they round, where they are not used, and what becomes of their ranges."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy

import pytest
import torch
from torch import Tensor, nn

from arraygeom.runtime.threads import limited_to, torch_in_one_thread
from pat.networks.weights import misfit
from pat.support.eight_bits import Conv2d, available, measured, packed, round_to_eight_bits

CAN = torch.cpu._is_vnni_supported()
"""Not `available()`: were that wrong, nothing would be tested."""
needs_processor = pytest.mark.skipif(not CAN, reason="this processor does not multiply 8 bits")


def rand(*shape: int) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(len(shape) + sum(shape)))


def convolution(kernel: int = 3, **how: int) -> Conv2d:
    made = Conv2d(16, 24, kernel, **how).requires_grad_(False)
    for parameter in made.parameters():
        parameter.copy_(rand(*parameter.shape) - 0.5)
    return made


def ranged(kernel: int = 3, *, least: float = -1.0, most: float = 2.0, **how: int) -> Conv2d:
    made = convolution(kernel, **how)
    made.input_range = torch.tensor([least, most])
    made.rounded = True
    return made


def rounded(x: Tensor, step: float, zero: int = 0, least: int = -127, most: int = 127) -> Tensor:
    return ((x / step + zero).round().clamp(least, most) - zero) * step


@needs_processor
@pytest.mark.parametrize(
    ("kernel", "stride", "padding", "dilation"),
    [(3, 1, 1, 1), (3, 2, 1, 1), (3, 1, 2, 2), (3, 1, 0, 1), (1, 1, 0, 1), (5, 2, 2, 1)],
)
def test_it_is_the_convolution_of_rounded_numbers(
    kernel: int, stride: int, padding: int, dilation: int
) -> None:
    part = ranged(kernel, stride=stride, padding=padding, dilation=dilation)
    x = 3 * rand(2, 16, 21, 30) - 1
    by = packed(part)
    weight = torch.stack([rounded(w, float(step)) for w, step in zip(part.weight, by.steps)])
    given = rounded(x, by.step, by.zero, 0, 255)
    wanted = nn.functional.conv2d(given, weight, part.bias, stride, padding, dilation)
    assert wanted.shape == part(x).shape
    torch.testing.assert_close(part(x), wanted, atol=1e-4, rtol=1e-4)
    assert 1e-4 < float((part(x) - nn.Conv2d.forward(part, x)).abs().max()) < 0.2


@needs_processor
@pytest.mark.parametrize(("least", "most"), [(0.5, 2.0), (-2.0, -0.5), (0.0, 0.0)])
def test_zeros_around_an_image_are_zeros_whatever_the_range(least: float, most: float) -> None:
    part = ranged(padding=1, least=least, most=most)
    given = torch.full((1, 16, 5, 7), (least + most) / 2)
    torch.testing.assert_close(part(given), nn.Conv2d.forward(part, given), atol=0.1, rtol=0)


@needs_processor
def test_what_is_beyond_the_range_counts_as_its_end() -> None:
    part = ranged(padding=1)
    assert torch.equal(part(torch.full((1, 16, 5, 5), 9.0)), part(torch.full((1, 16, 5, 5), 2.0)))


@needs_processor
def test_strips_parts_and_batches_are_equal_to_the_whole() -> None:
    part = ranged(padding=1)
    images = rand(2, 16, 240, 200)
    whole = part(images)
    with limited_to(3), torch_in_one_thread():
        assert torch.equal(part(images), whole)
    assert torch.equal(torch.cat([part(image[None]) for image in images]), whole)
    assert torch.equal(part(images[:, :, 50:90])[:, :, 1:-1], whole[:, :, 51:89])
    assert torch.equal(part(images.contiguous(memory_format=torch.channels_last)), whole)


@needs_processor
def test_other_defaults_of_torch_change_nothing() -> None:
    part, x = ranged(padding=1), rand(1, 16, 8, 8)
    before = part(x)
    available.cache_clear()
    torch.set_default_dtype(torch.float64)
    try:
        with torch.device("meta"):
            assert available()
            again = deepcopy(part)(x)
    finally:
        torch.set_default_dtype(torch.float32)
    assert torch.equal(again, before)


@needs_processor
def test_a_change_of_weights_or_of_range_is_seen() -> None:
    part, x = ranged(padding=1), rand(1, 16, 8, 8)
    before = part(x)
    part.weight.mul_(2)
    assert not torch.allclose(part(x), before)
    part.weight.div_(2)
    assert torch.equal(part(x), before)
    part.input_range = torch.tensor([-1.0, 1.0])
    assert not torch.equal(part(x), before)
    assert torch.equal(deepcopy(part)(x), part(x))
    other = convolution(padding=1)
    other.load_state_dict(part.state_dict())
    assert not torch.equal(other(x), part(x)), "not unless it is to be"
    round_to_eight_bits(other)
    assert torch.equal(other(x), part(x))


def test_on_a_gpu_it_is_refused(monkeypatch: pytest.MonkeyPatch, refusal: Callable) -> None:
    """It was in float32 there, without a word."""

    class OnGPU(Tensor):
        device = torch.device("cuda")

    with pytest.raises(ValueError, match="int8 is for the CPU: leave the precision at float32 on cuda"):
        ranged(padding=1)(rand(1, 16, 8, 8).as_subclass(OnGPU))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert "--precision int8 is for the CPU: leave it out, or --device" in refusal(
        "fuse", __file__, "--image", f"mono={__file__}", "--device", "auto", "--precision", "int8"
    )


def test_without_a_range_for_gradients_and_in_other_precisions_it_is_torchs() -> None:
    x = rand(1, 16, 8, 8)
    plain, part = convolution(padding=1), ranged(padding=1)
    assert torch.equal(plain(x), nn.Conv2d.forward(plain, x))
    followed = x.clone().requires_grad_()
    assert torch.equal(part(followed), nn.Conv2d.forward(part, x))
    assert torch.equal(part.double()(x.double()), nn.Conv2d.forward(part, x.double()))
    part.float().requires_grad_(True)
    part(x)
    assert part.input_range is None, "of weights that are trained"


def test_ranges_are_those_of_all_images_but_of_single_values() -> None:
    part = ranged(padding=1, least=-50.0, most=50.0)
    with measured(part):
        for low, high in ((0.0, 1.0), (-0.5, 0.25)):
            x = torch.linspace(low, high, 16 * 10000).reshape(1, 16, 100, 100)
            x[0, 0, 0, :9], x[0, -1, -1, -9:] = -30.0, 30.0
            assert torch.equal(part(x), nn.Conv2d.forward(part, x)), "not rounded while measured"
    assert part.input_range is not None
    torch.testing.assert_close(part.input_range, torch.tensor([-0.5, 1.0]), atol=1e-3, rtol=0)


def test_states_with_and_without_ranges_load() -> None:
    one, other = nn.Sequential(ranged()), nn.Sequential(convolution())
    assert not misfit(other, one.state_dict())
    assert not misfit(one, one.state_dict())
    assert misfit(other, {**one.state_dict(), "0.input_range": torch.zeros(3)})
    assert misfit(other, {**one.state_dict(), "1.input_range": torch.zeros(2)})
    without = other.state_dict()
    other.load_state_dict(one.state_dict())
    assert other[0].input_range.tolist() == [-1.0, 2.0]
    other.load_state_dict(without)
    assert other[0].input_range is None
