"""Alpha's spectral response and tone curve relative to a colour beta, fitted to matches.

The network compares alpha with Rec. 601 luma of beta and keeps alpha as the result's luma. A real mono sensor weighs
red, green and blue otherwise, and another exposure or tone curve makes beta darker or flatter. Here alpha is explained
as gain * weights . beta^gamma over points that match, and beta is mapped so that its luma is that: scaled, raised to
the power, and sheared along grey, so that neutral stays neutral. The fused image is sheared back.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from ..media.colour import REC601, luminance
from ..networks.protocol import Inputs
from ..networks.semi_global import FINE, Normalisations, at_matches, is_consistent, matched_at_half_size
from ..networks.spectral_mix import reduced
from .inputs import FrameInputs
from .results import Frame

GAMMAS = (0.4, 0.5, 0.6, 0.7, 0.77, 0.85, 0.92, 1.0, 1.08, 1.18, 1.3, 1.45, 1.6, 1.8, 2.0, 2.3, 2.6)


class ResponseSettings(NamedTuple):
    """Constants of the fit, chosen on Middlebury's Bowling1, Cloth1, Flowerpots, Midd1, Plastic and Wood1.

    prior: standard deviation of the weights (their sum is 1) about Rec. 601's, before anything is fitted.
    correlated: pixels that count as one independent observation.
    points: pixels used at most.
    floor: residual of alpha at which a pixel counts half, at least.
    least_change: root mean square change of the luma below which the weights are left at Rec. 601's: wrong matches and
        light that differs between the views make as much.
    least_gain: logarithm of the gain below which beta's scale is left as it is.
    better: the error of another gamma than 1, over that of 1, up to which it is taken.
    """

    prior: float = 0.15
    correlated: float = 40.0
    points: int = 8000
    floor: float = 0.04
    least_change: float = 0.0205
    least_gain: float = 0.1
    better: float = 0.97


SETTINGS = ResponseSettings()


class Response(NamedTuple):
    """alpha = gain * weights . beta^gamma, where the three weights add up to 1.

    explained: the share of alpha's variance at the matches that this explains, 0 to 1.
    """

    weights: Float[Tensor, "3"]
    gain: float = 1.0
    gamma: float = 1.0
    explained: float = 0.0

    @classmethod
    def rec601(cls) -> Response:
        """Alpha is the luma of beta."""
        return cls(torch.tensor(REC601, dtype=torch.float64))

    @property
    def is_rec601(self) -> bool:
        """Whether images need not be changed."""
        return self.gain == self.gamma == 1.0 and self.weights.tolist() == list(REC601)

    def applied(self, beta: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 h w"]:
        """Beta on alpha's scale, sheared along grey so that its Rec. 601 luma is what alpha sees."""
        scaled = self.gain * (beta if self.gamma == 1 else beta.clamp(min=0) ** self.gamma)
        return scaled + self._shear(scaled)

    def undone(self, image: Float[Tensor, "*b 3 h w"]) -> Float[Tensor, "*b 3 h w"]:
        """The fused image sheared back: the weights' combination of its colours is what its luma was."""
        return image - self._shear(image)

    def _shear(self, image: Tensor) -> Tensor:
        change = (self.weights - self.weights.new_tensor(REC601)).to(image)
        return (image * change[:, None, None]).sum(-3, keepdim=True)


Given = Literal["fit"] | tuple[float, float, float]
"""What is known of alpha's response: its weights of red, green and blue, or that it is to be fitted."""


def with_response(frame: FrameInputs, given: Given | None) -> tuple[FrameInputs, Callable[[Frame], Frame]]:
    """The inputs with beta as alpha's response sees it, and how the fused frame is taken back.

    Raises ValueError for a response that is not three weights, none negative, or where there is not one RGB beta.
    """
    if given is None:
        return frame, lambda fused: fused
    if [beta.image.shape[1] for beta in frame.inputs.betas] != [3]:
        raise ValueError("a response is of one RGB beta: leave it out for several betas, or for bands of another kind")
    response = fitted_response(frame.inputs) if given == "fit" else stated_response(given)
    (beta,) = frame.inputs.betas
    inputs = replace(frame.inputs, betas=(replace(beta, image=response.applied(beta.image)),))
    return frame._replace(inputs=inputs), lambda fused: fused._replace(image=response.undone(fused.image))


def stated_response(weights: Sequence[float]) -> Response:
    """The response of an alpha that is weights . beta. Raises ValueError unless these are three, none negative."""
    values = torch.tensor([float(w) for w in weights], dtype=torch.float64)
    if values.shape != (3,) or not bool((values >= 0).all() & (values.sum() > 0) & values.isfinite().all()):
        raise ValueError(f"a response is three weights, of red, green and blue, none negative; got {tuple(weights)}")
    return Response(values / values.sum(), gain=float(values.sum()))


@torch.no_grad()
def fitted_response(inputs: Inputs) -> Response:
    """The response of alpha (1, 1, H, W) in the bands of the one beta (1, 3, Hb, Wb), from matches at half size."""
    alpha, (beta,) = inputs.alpha, inputs.betas
    segments, blocks = (reduced(beta.field.of_blocks(side), FINE) for side in (FINE, FINE * FINE))
    own, bands = avg_pool2d(alpha, FINE), avg_pool2d(beta.image, FINE)
    normalisations = Normalisations.of(own, luminance(bands))
    disparity, facts = matched_at_half_size(own, luminance(bands), blocks, normalisations.half)
    values, valid = at_matches(bands, segments, disparity)
    matched = (valid * is_consistent(facts))[0, 0] > 0
    return fit(values[0][:, matched], normalisations.whole.softened(own)[0, 0][matched])


def fit(bands: Float[Tensor, "3 n"], alpha: Float[Tensor, " n"], settings: ResponseSettings = SETTINGS) -> Response:
    """The response by robust least squares over points, drawn towards Rec. 601 as far as the scene is grey."""
    step = max(alpha.numel() // settings.points, 1)
    x, y = bands[:, ::step].double(), alpha[::step].double()
    unclipped = (y > 0.02) & (y < 0.98) & (x > 0.01).all(0) & (x < 0.98).all(0)
    x, y = x[:, unclipped], y[unclipped]
    if len(y) < 300:
        return Response.rec601()
    trials = {gamma: _weighted_fit(x**gamma, y, settings) for gamma in GAMMAS}
    gamma = min(trials, key=lambda g: trials[g].error)
    if trials[gamma].error > settings.better * trials[1.0].error:
        gamma = 1.0
    found, x = trials[gamma], x**gamma
    gain = float((found.share @ y.square() / (found.share @ (found.weights @ x).square())).sqrt())
    gain = gain if abs(math.log(gain)) > settings.least_gain or gamma != 1 else 1.0
    rec601 = Response.rec601().weights
    change = float(gain * ((found.weights - rec601) @ x).square().mean().sqrt())
    weights = found.weights if change > settings.least_change else rec601
    return Response(weights, gain, gamma, found.explained)


class _Fit(NamedTuple):
    weights: Tensor
    share: Tensor
    error: float
    explained: float


def _weighted_fit(x: Tensor, y: Tensor, settings: ResponseSettings) -> _Fit:
    """Weights that sum to 1, by iteratively reweighted least squares about the means, with Cauchy's weights.

    Both sides are noisy: the gain is the ratio of the deviations, not a slope. The error is robust, and grows with an
    offset, which exposure and tone curve do not have.
    """
    rec601 = Response.rec601().weights
    free = torch.tensor([[1.0, 0.0], [0.0, 1.0], [-1.0, -1.0]], dtype=torch.float64)
    prior = free.T @ free / settings.prior**2
    weights, share, variance = rec601, torch.ones_like(y), 0.05**2
    for _ in range(6):
        total = share.sum()
        middle, centre = x @ share / total, y @ share / total
        dx, dy = x - middle[:, None], y - centre
        gain = ((share @ dy.square()) / (share @ (weights @ dx).square()).clamp(min=1e-12)).sqrt()
        chroma, rest = free.T @ dx, dy / gain - rec601 @ dx
        noise = settings.correlated * variance
        normal = (share * chroma) @ chroma.T / noise + prior
        weights = rec601 + free @ torch.linalg.solve(normal, (share * chroma) @ rest / noise)
        rest = dy - gain * (weights @ dx)
        scale = max(3 * float(rest.abs().median()), settings.floor)
        share = 1 / (1 + (rest / scale).square())
        variance = float(share @ rest.square() / share.sum() / gain**2) + 1e-9
    offset = float(centre - gain * (weights @ middle))
    error = float(torch.log1p((rest / settings.floor).square()).mean()) + 2 * offset**2
    explained = 1 - float(share @ rest.square() / (share @ dy.square()).clamp(min=1e-12))
    return _Fit(weights, share, error, max(explained, 0.0))
