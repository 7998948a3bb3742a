"""Convolutions in 8 bits, where that is wanted and the range of what they are given is known.

A processor that multiplies 8-bit integers (AVX-512 VNNI) does so faster than floats. The weights of each
output channel are rounded to 255 steps, and so is the input, within a range that was measured once: were
it found in each image, a part of an image would differ from the whole.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import torch
from jaxtyping import Float
from torch import Tensor, nn

from arraygeom.fields.protocol import compilable
from arraygeom.runtime.chunks import spans
from arraygeom.runtime.threads import STRIPS, WORTH_STRIPS, in_parallel, threads

from . import eight_bits_numba as kernels
from .settings import size, tuned

RANGE = "input_range"


@dataclass(frozen=True)
class EightBitSettings:
    """Of ranges that are measured."""

    beyond: float = tuned(1e-4, "Middlebury, tune half: the share of values beyond a range, at each end")
    samples: int = size(10**6, "Values of an image by which its range is measured")


SETTINGS = EightBitSettings()


class Conv2d(nn.Conv2d):
    """A convolution that computes in 8 bits if it is to be `rounded`.

    Not for gradients or of other numbers than float32: then it is torch's. Weights that are trained lose the
    range, which was another network's. Raises ValueError on a GPU.
    """

    input_range: Tensor | None
    rounded = measuring = False

    def __init__(self, *shape: Any, **how: Any) -> None:
        super().__init__(*shape, **how)
        self.register_buffer(RANGE, None)

    def forward(self, x: Float[Tensor, "b i h w"]) -> Float[Tensor, "b o h2 w2"]:
        """As of `torch.nn.Conv2d`."""
        if self.rounded and x.device.type not in ("cpu", "meta"):
            raise ValueError(f"int8 is for the CPU: leave the precision at float32 on {x.device.type}")
        if self.weight.requires_grad:
            self.input_range = None
        elif self.measuring:
            values = x.detach().flatten()[:: max(1, x.numel() // SETTINGS.samples)]
            ends = values.quantile(values.new_tensor([SETTINGS.beyond, 1 - SETTINGS.beyond]))
            extremes = ends if self.input_range is None else torch.cat([ends, self.input_range])
            self.input_range = torch.stack(extremes.aminmax())
        elif self.rounded and self.input_range is not None and plain(x) and self.weight.dtype == x.dtype:
            return in_eight_bits(x, self, packed(self))
        return super().forward(x)

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *others: Any) -> None:
        stored = state_dict.get(prefix + RANGE)
        self.input_range = None if stored is None else torch.zeros(2, device=self.weight.device)
        super()._load_from_state_dict(state_dict, prefix, *others)


def plain(x: Tensor) -> bool:
    """Whether compiled loops of float32 can take a tensor: nothing asks for its gradient."""
    return x.dtype == torch.float32 and compilable(x) and not x.requires_grad


@contextmanager
def measured(network: nn.Module) -> Iterator[None]:
    """Within this, convolutions compute as they are and keep the range of all that they are given."""
    convolutions = [convolution for convolution in network.modules() if isinstance(convolution, Conv2d)]
    for convolution in convolutions:
        convolution.input_range, convolution.measuring = None, True
    try:
        yield
    finally:
        for convolution in convolutions:
            convolution.measuring = False


def names(network: nn.Module) -> list[str]:
    """Of the ranges that its convolutions may have."""
    return [f"{name}.{RANGE}" for name, module in network.named_modules() if isinstance(module, Conv2d)]


def round_to_eight_bits(network: nn.Module) -> None:
    """Let convolutions compute in 8 bits. Raises ValueError if the processor cannot or a range is missing."""
    if not available():
        raise ValueError("this processor does not multiply 8-bit integers: leave the precision at float32")
    convolutions = [convolution for convolution in network.modules() if isinstance(convolution, Conv2d)]
    if not convolutions or any(convolution.input_range is None for convolution in convolutions):
        raise ValueError("these weights state no ranges for 8 bits: leave the precision at float32")
    for convolution in convolutions:
        convolution.rounded = True


class Packed(NamedTuple):
    """A convolution's weights as the processor wants them, and the steps of them and of its input."""

    weights: Tensor
    steps: Float[Tensor, " outputs"]
    zeros: Tensor
    step: float
    zero: int


_PACKED: WeakKeyDictionary[Conv2d, tuple[object, Packed]] = WeakKeyDictionary()


def packed(of: Conv2d) -> Packed:
    """Of these weights and this range; kept until they are others."""
    tensors = of.weight, of.input_range
    now = [(x.data_ptr(), 0 if x.is_inference() else x._version) for x in tensors if x is not None]
    before, made = _PACKED.get(of, (None, None))
    if made is None or before != now:
        made = _made(of)
        _PACKED[of] = now, made
    return made


def _made(of: Conv2d) -> Packed:
    assert of.input_range is not None
    least, most = of.input_range.tolist()
    step = max(max(most, 0.0) - min(least, 0.0), 1e-6) / 255
    zero = round(-min(least, 0.0) / step)
    weight = of.weight.detach()
    steps = weight.abs().amax((1, 2, 3)).clamp(min=1e-12) / 127
    rounded = (weight / steps[:, None, None, None]).round().to(torch.int8)
    shape = list(of.stride), [0, 0], list(of.dilation), of.groups
    weights = torch.ops.onednn.qconv_prepack(rounded, steps, step, zero, *shape, None)
    return Packed(weights, steps, torch.zeros_like(steps, dtype=torch.long), step, zero)


def in_eight_bits(x: Float[Tensor, "b i h w"], of: Conv2d, by: Packed) -> Float[Tensor, "b o h2 w2"]:
    """The convolution of images, of a large one in strips of rows on all threads."""
    assert isinstance(of.padding, tuple)
    (above, left), (down, across) = of.padding, of.stride
    tall, wide = ((k - 1) * d + 1 for k, d in zip(of.kernel_size, of.dilation))
    columns = x.shape[3] + 2 * left
    height, width = (x.shape[2] + 2 * above - tall) // down + 1, (columns - wide) // across + 1
    large = of.weight.numel() * height * width >= WORTH_STRIPS
    rows = math.ceil(height / (STRIPS * threads())) if large and threads() > 1 else height
    how = list(of.stride), [0, 0], list(of.dilation), of.groups, 1.0, 0, torch.float32, "none", (), ""
    parts = [
        (image, *span) for image in x.movedim(1, -1).contiguous().numpy() for span in spans(height, rows)
    ]

    def strip(image: Any, first: int, last: int) -> Tensor:
        shape = 1, (last - first - 1) * down + tall, columns, x.shape[1]
        rounded = torch.empty(shape, dtype=torch.uint8, device=x.device)
        kernels.rounded(image, first * down - above, left, 1 / by.step, by.zero, rounded.numpy()[0])
        inputs = rounded.movedim(-1, 1), by.step, by.zero
        weights = by.weights, by.steps, by.zeros, of.bias
        return torch.ops.onednn.qconv2d_pointwise(*inputs, *weights, *how)

    if len(parts) == 1:
        return strip(*parts[0])
    outputs = in_parallel([partial(strip, *arguments) for arguments in parts])
    each = len(parts) // len(x)
    return torch.cat([torch.cat(outputs[i : i + each], 2) for i in range(0, len(parts), each)])


@cache
def available() -> bool:
    """Whether this processor and this torch multiply the largest numbers of 8 bits exactly."""
    where: dict[str, Any] = {"dtype": torch.float32, "device": "cpu"}
    network = Conv2d(64, 8, 3, bias=False, **where).requires_grad_(False)
    network.weight.fill_(127.0)
    network.input_range = torch.tensor([0.0, 255.0], **where)
    largest = torch.full((1, 64, 3, 3), 255.0, **where)
    try:
        answer = in_eight_bits(largest, network, _made(network))
    except (AttributeError, RuntimeError):  # another torch, or one without oneDNN
        return False
    return bool(torch.allclose(answer, nn.functional.conv2d(largest, network.weight)))
