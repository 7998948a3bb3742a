"""Learned features of pixels: 64 bits each, at full size and at half of it.

Two pixels cost what their words differ in (the Hamming distance), so that semi-global matching takes them in
the place of census, from which training begins. Alpha and beta have encoders of their own, because they are
not the same kind of camera.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, cast

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, pad, relu

from pat.support.schema import from_document
from pat.support.tensor_files import undamaged, write_tensors

FORMAT = "pat-features 1"
BITS = 64
"""Bits of a pixel: one word."""
CENSUS = 7
"""Side of the window in which pixels are compared, as that of census is."""
CONTRASTS = (2, 0.01), (7, 0.01)
"""Radius in pixels of the windows of local contrast, and the deviation that counts as noise there."""
View = Literal["alpha", "beta"]
Size = Literal["full", "half"]


@dataclass(frozen=True)
class FeatureConfig:
    """Channels of what is added to the comparisons."""

    width: int = 16


class SizeEncoder(nn.Module):
    """Features of images of one size: comparisons of pixels around, and what three convolutions add to them.

    Before training the first 48 bits are those of census, 16 compare means of 3 x 3 pixels; nothing is added.
    """

    halo = 11
    """How far around a pixel the image can matter: 7 of contrast, 4 of convolutions."""

    def __init__(self, config: FeatureConfig) -> None:
        super().__init__()
        planes, width = 2 + len(CONTRASTS), config.width
        self.compare = nn.Conv2d(1, BITS, CENSUS)
        with torch.no_grad():
            self.compare.weight.copy_(comparisons()[:, None])
            nn.init.zeros_(cast(Tensor, self.compare.bias))
        self.first = nn.Conv2d(planes, width, 3, padding=1)
        self.second = nn.Conv2d(width, width, 3, padding=1)
        self.third = nn.Conv2d(width, width, 3, padding=2, dilation=2)
        self.add = nn.Conv2d(width, BITS, 1)
        nn.init.zeros_(self.add.weight)
        nn.init.zeros_(cast(Tensor, self.add.bias))

    def forward(
        self,
        image: Float[Tensor, "b 1 h w"],
        blur: Float[Tensor, " b"],
    ) -> Float[Tensor, "b 64 h w"]:
        """Before their signs are taken. `blur` is that of the view which was sharper, pixels."""
        planes = torch.cat([contrasts(image), blur[:, None, None, None].expand_as(image)], 1)
        planes = planes.contiguous(memory_format=torch.channels_last)
        hidden = relu(self.second(relu(self.first(planes))))
        # Differences of a level of 8 bits are lost at less than full precision.
        with torch.autocast(image.device.type, enabled=False):
            compared = self.compare(pad(image, (CENSUS // 2,) * 4, mode="replicate"))
        return compared / _deviation(image, *CONTRASTS[0]) + self.add(hidden + relu(self.third(hidden)))


class MatchingEncoder(nn.Module):
    """Encoders of alpha and of a beta's brightness (0..1, at one level), at full size and at half of it.

    `sharpness` and `unseen`, of full and of half size, are of training: how many logits a bit counts, and how
    many bits that are unlike mean that beta does not see the point.
    """

    def __init__(self, config: FeatureConfig = FeatureConfig()) -> None:
        super().__init__()
        self.config = config
        self.at_full, self.at_half = _both_views(config), _both_views(config)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.sharpness = nn.Parameter(torch.full((2,), -1.9))
        self.unseen = nn.Parameter(torch.full((2,), 24.0))

    def forward(
        self, image: Float[Tensor, "b 1 h w"], view: View, size: Size, blur: Float[Tensor, " b"]
    ) -> Float[Tensor, "b 64 h w"]:
        """Features of a view, of images at full or at half size that were made equally sharp.

        `blur` says by how much the sharper one was blurred, pixels of that size: the more, the less do fine
        differences mean.
        """
        return (self.at_full if size == "full" else self.at_half)[view](image, blur)


def _both_views(config: FeatureConfig) -> nn.ModuleDict:
    """The encoders of alpha and of beta at one size: before training they are the same."""
    both = nn.ModuleDict({"alpha": SizeEncoder(config), "beta": SizeEncoder(config)})
    both["beta"].load_state_dict(both["alpha"].state_dict())
    return both


def comparisons() -> Float[Tensor, "64 7 7"]:
    """The filters before training: the centre minus each of the 48 pixels around; then means of 3 x 3 pixels
    around it that are compared with that at the centre (8), with the opposite one (4), and with the one at a
    right angle (4)."""
    middle = CENSUS // 2
    found = torch.zeros(BITS, CENSUS, CENSUS)
    around = [(y, x) for y in range(CENSUS) for x in range(CENSUS) if (y, x) != (middle, middle)]
    for i, (y, x) in enumerate(around):
        found[i, middle, middle], found[i, y, x] = 1.0, -1.0

    def block(dy: int, dx: int) -> Tensor:
        mean = torch.zeros(CENSUS, CENSUS)
        mean[middle + dy - 1 : middle + dy + 2, middle + dx - 1 : middle + dx + 2] = 1 / 9
        return mean

    sides = [(-2, 0), (-2, 2), (0, 2), (2, 2), (2, 0), (2, -2), (0, -2), (-2, -2)]
    blocks = [block(*side) for side in sides]
    pairs = [(block(0, 0), b) for b in blocks] + [(blocks[i], blocks[i + 4]) for i in range(4)]
    pairs += [(blocks[i], blocks[(i + 2) % 8]) for i in (0, 2, 4, 6)]
    found[len(around) :] = torch.stack([a - b for a, b in pairs])
    return found


def contrasts(image: Float[Tensor, "b 1 h w"]) -> Float[Tensor, "b c h w"]:
    """Brightness about its middle, and its difference from the mean of a window over the deviation there."""
    found = [image - 0.5]
    for radius, noise in CONTRASTS:
        found.append((image - _box_mean(image, radius)) / _deviation(image, radius, noise))
    return torch.cat(found, 1)


def _deviation(image: Float[Tensor, "b 1 h w"], radius: int, noise: float) -> Float[Tensor, "b 1 h w"]:
    """The standard deviation in a window around each pixel, and noise."""
    mean, square = _box_mean(torch.cat([image, image * image], 1), radius).split(1, 1)
    return ((square - mean * mean).clamp(min=0) + noise**2).sqrt()


def _box_mean(x: Tensor, radius: int) -> Tensor:
    """Over squares around each pixel, as far as these are on the image."""
    side = 2 * radius + 1
    rows = avg_pool2d(x, (side, 1), 1, (radius, 0), count_include_pad=False)
    return avg_pool2d(rows, (1, side), 1, (0, radius), count_include_pad=False)


def words(features: Float[Tensor, "b 64 h w"]) -> NDArray[np.uint64]:
    """The signs of features as words (B, H, W): bit i is set where feature i is positive."""
    positive = (features.detach() > 0).movedim(1, -1).contiguous().cpu().numpy()
    return np.packbits(positive, axis=-1, bitorder="little").view("<u8")[..., 0].astype(np.uint64)


def save_features(encoder: MatchingEncoder, path: Path, facts: Mapping[str, str]) -> None:
    """Write an encoder's weights and configuration, atomically, with `facts` (recipe, step) as text."""
    metadata = {"format": FORMAT, "config": json.dumps(asdict(encoder.config)), **facts}
    write_tensors(path, encoder.state_dict(), metadata)


def load_features(path: Path) -> MatchingEncoder:
    """The encoder of a file, ready for use.

    Raises FileNotFoundError, and ValueError for a file of anything else.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file of features: train them, or match by census")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            state = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        if metadata.get("format") != FORMAT or not undamaged(state, metadata):
            raise ValueError(f"wanted {FORMAT}, undamaged")
        encoder = MatchingEncoder(from_document(FeatureConfig, json.loads(metadata["config"])))
        encoder.load_state_dict(state)
    except (SafetensorError, ValueError, KeyError, RuntimeError) as error:
        raise ValueError(f"{path}: no features for matching ({error}): copy or train it again") from None
    return encoder.eval().requires_grad_(False)
