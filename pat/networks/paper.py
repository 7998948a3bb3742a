"""PAT, the physics-aware transformer of the paper, for any number of betas of any sizes.

Huang, Hu and Brady, "Array Camera Image Fusion using Physics-Aware Transformers" (2022). The default
configuration is the paper's; variants are configuration.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import interpolate

from arraygeom.fields.grid import FieldOnGrid

from ..attention.scores import Compared
from ..matching.inputs import Inputs, Matches
from ..media.filters import box_mean
from ..support.blocks import ResidualASPP, ResidualBlock
from .configs import PATConfig
from .protocol import FusionOutput, JoinsBands

SURROUNDINGS, FLOOR = 9, 0.01
"""Side in pixels of `normalised`'s windows, and the contrast below which it amplifies no more."""


class QueryAndKey(NamedTuple):
    """Features of one image that attention compares.

    Attributes:
        query: features (B, D, H, W) of the image as alpha.
        key: features (B, D, H, W) of the image as a beta.
    """

    query: Tensor
    key: Tensor


class PAT(nn.Module):
    """The paper's network: features shared by all views, attention to each beta, fusion by convolutions.

    Made of its configuration, with random weights.

    >>> PAT(PATConfig(betas=2, dim=8)).config.betas
    2
    """

    halo = 80
    """Pixels: features reach 59 and post-fusion 10; the sum, rounded up."""
    beta_halo = 64
    multiple = 1
    joins_bands: JoinsBands = "no"
    bands: int | None = None
    uses_matches = learned = keeps_luminance = False

    def __init__(self, config: PATConfig = PATConfig()) -> None:
        super().__init__()
        self.config, self.equal_resolution = config, config.equal_resolution
        self.betas = config.betas
        self.features = Features(config)
        self.engine = AttentionEngine(config)
        self.post = PostFusion(config)

    def forward(self, inputs: Inputs, matches: Matches | None = None) -> FusionOutput:
        """Fuse alpha with the betas, in the order for which the network was made; matches are not used.

        Returns:
            The image (B, `config.out_channels`, s H, s W), enlarged by s = `config.scale`, not clipped, with
            position, deviation and confidence (the largest weight of attention) in each beta, all 0 where no
            sample counts; `overall` None.

        Raises:
            ValueError: for another number of betas than configured, unfit channels; and as `attend`.
            RuntimeError: by torch, with `config.residual`, for an alpha of neither one channel nor
                `config.out_channels`.
        """
        return self.compare(inputs)[0]

    def compare(self, inputs: Inputs) -> tuple[FusionOutput, list[Compared]]:
        """Fuse as `forward`, and keep the features that attention compares in each beta.

        Returns:
            The output of `forward`, and the compared features of each beta.

        Raises:
            ValueError: as `forward`.
        """
        if len(inputs.betas) != self.config.betas:
            asked = f"this PAT is made for {self.config.betas} betas, got {len(inputs.betas)}"
            raise ValueError(f"{asked}: give as many cameras beside alpha, or another network")
        alpha_features = self.features(self._channels(inputs.alpha))
        beta_features = [self.features(self._channels(beta.image)) for beta in inputs.betas]
        compared = self.engine.compare(alpha_features, beta_features, [beta.field for beta in inputs.betas])
        attended = [c.attended() for c in compared]
        image = self.post(torch.cat([alpha_features, *(a.value for a in attended)], 1))
        if self.config.residual:
            alpha, s = inputs.alpha.expand(-1, self.config.out_channels, -1, -1), self.config.scale
            if s > 1:
                alpha = interpolate(alpha, scale_factor=s, mode="bicubic", align_corners=False)
            image = image + alpha
        position, deviation, confidence = (list(tensors) for tensors in list(zip(*attended))[1:])
        return FusionOutput(image, position, deviation, confidence), compared

    def with_border(self, pixels: float) -> PAT:
        """Copy the network, with attention that fades within so many pixels of beta's border (0 for none).

        With bilinear interpolation the fused image then changes smoothly when a rig moves, and its gradient
        by the rig is whole at the border too.

        Returns:
            The copy, with weights of its own.
        """
        faded = copy.deepcopy(self)
        faded.engine.border = pixels
        return faded

    def query_and_key(self, image: Float[Tensor, "b c h w"], beta: int = 0) -> QueryAndKey:
        """Compute an image's query as alpha's, and its key as that of the `beta`-th beta.

        Raises:
            ValueError: for channels that do not fit.
        """
        after = self.engine.before(self.features(self._channels(image)))
        return QueryAndKey(self.engine.query(after), self.engine.key[beta](after))

    def working_bytes(self, alpha: int, betas: Sequence[int]) -> float:
        """Return the measured bytes of features of all views."""
        return 1600.0 * (alpha + sum(betas))

    def _channels(self, image: Tensor) -> Tensor:
        wanted = self.config.in_channels
        if image.shape[1] not in (1, wanted):
            raise ValueError(
                f"images must have 1 or {wanted} channels for this network, got {image.shape[1]}"
            )
        image = image.expand(-1, wanted, -1, -1)
        if not self.config.normalised:
            return image
        return torch.cat([image, normalised(image.mean(1, keepdim=True))], 1)


def normalised(image: Float[Tensor, "b 1 h w"]) -> Float[Tensor, "b 1 h w"]:
    """Return an image less its mean in 9x9 pixels, over its standard deviation there, with a
    floor of 0.01."""
    mean, squares = (box_mean(x, SURROUNDINGS // 2) for x in (image, image * image))
    return (image - mean) / ((squares - mean * mean).clamp(min=0) + FLOOR**2).sqrt()


class Features(nn.Sequential):
    """Residual-ASPP features, with the same weights for every view (paper, section 3.1).

    Called with images (b, c, h, w), c = `config.in_channels` and one more if `config.normalised`, it returns
    features (b, `config.dim`, h, w).
    """

    def __init__(self, config: PATConfig) -> None:
        dim, bias = config.dim, config.block_bias
        super().__init__(
            nn.Conv2d(config.in_channels + config.normalised, dim, 3, padding=1, bias=False),
            nn.LeakyReLU(0.1, inplace=True),
            ResidualBlock(dim, bias=bias),
            ResidualASPP(dim),
            ResidualBlock(dim, bias=bias),
            ResidualASPP(dim),
            ResidualBlock(dim, bias=bias),
        )


class AttentionEngine(nn.Module):
    """Layers that make alpha's queries and each beta's keys and values, for attention along the segments.

    Args:
        config: configuration of the network, for `betas`, `dim`, `interpolation`, `block_bias` and
            `values_after_block`.
    """

    def __init__(self, config: PATConfig) -> None:
        super().__init__()
        betas, dim = config.betas, config.dim
        self.interpolation, self.values_after_block = config.interpolation, config.values_after_block
        self.border = 0.0
        self.before = ResidualBlock(dim, bias=config.block_bias)
        self.query = nn.Conv2d(dim, dim, 1)
        self.key = nn.ModuleList(nn.Conv2d(dim, dim, 1) for _ in range(betas))
        self.value = nn.ModuleList(nn.Conv2d(dim, dim, 1) for _ in range(betas))
        for key in self.key:
            # Equal features score high from the first step on: drawn apart, keys and queries have to find
            # each other.
            key.load_state_dict(self.query.state_dict())

    def compare(
        self, alpha_features: Tensor, beta_features: Sequence[Tensor], fields: Sequence[FieldOnGrid]
    ) -> list[Compared]:
        """Compute alpha's query, each beta's key and value, and the locations at which they are compared.

        Args:
            alpha_features: features (b, d, h, w).
            beta_features: features (b, d, h, w) of each beta, of a size of its own.
            fields: field of alpha's pixels in each beta.

        Returns:
            The compared features of each beta, for `Compared.attended`; of the first ones only, where the
            network or one of the lists has fewer betas.
        """
        query, how = self.query(self.before(alpha_features)), self.interpolation
        scores = []
        for f, to_key, to_value, field in zip(beta_features, self.key, self.value, fields):
            after = self.before(f)
            value = to_value(after if self.values_after_block else f)
            locations = field.at if field.pixels is None else field.pixels.to(query)
            scores.append(Compared(query, to_key(after), value, locations, field.samples, how, self.border))
        return scores


class PostFusion(nn.Sequential):
    """Fusion of alpha's and the attended features: 1x1 convolution, four residual blocks, pixel shuffle.

    Called with features (b, (betas + 1) dim, h, w), alpha's first, it returns an image (b, out_channels,
    scale h, scale w).

    Args:
        config: configuration of the network, for these numbers and whether layers have biases.
    """

    def __init__(self, config: PATConfig) -> None:
        dim, outputs, scale = config.dim, config.out_channels, config.scale
        super().__init__(
            nn.Conv2d((config.betas + 1) * dim, dim, 1, bias=config.fusion_bias),
            *(ResidualBlock(dim, bias=config.block_bias) for _ in range(4)),
            nn.Conv2d(dim, dim * scale**2, 1, bias=False),
            nn.PixelShuffle(scale),
            nn.Conv2d(dim, outputs, 3, padding=1, bias=False),
            nn.Conv2d(outputs, outputs, 3, padding=1, bias=False),
        )
