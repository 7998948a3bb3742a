"""Alpha's spectral response and tone curve relative to a colour beta, fitted to matches.

The network compares alpha with Rec. 601 luma of beta and keeps alpha as the result's luma. A real mono sensor weighs
red, green and blue otherwise, and another exposure or tone curve makes beta darker or flatter. Here alpha is explained
as weights . (gain * beta^gamma) over points that match, and beta is mapped so that its luma is that: scaled, raised to
the power, and sheared along grey, so that neutral stays neutral. The fused image is sheared back.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import pixel_grid

from ..media.colour import REC601

GAMMAS = (0.4, 0.5, 0.6, 0.7, 0.77, 0.85, 0.92, 1.0, 1.08, 1.18, 1.3, 1.45, 1.6, 1.8, 2.0, 2.3, 2.6)


class ResponseSettings(NamedTuple):
    """Constants of the fit, chosen on Middlebury's Bowling1 and 2, Cloth1, 2 and 4, Flowerpots, Midd1, Plastic, Wood1.

    prior: standard deviation of the weights about Rec. 601's (where their sum is 1), before anything is fitted.
    independent: how many independent observations all points count as: as many as there are materials, about.
    error: standard deviation of one of those, at least: light and surfaces differ between the views.
    outlier: residuals of this many robust deviations count half.
    points: pixels used at most, and the fewest that are enough.
    least_change: root mean square change of luma below which the weights are left at Rec. 601's, usually, and where
        there is a gamma or a gain that is poorly known: wrong matches and light that differs between the views make
        as much.
    known: relative standard deviation of the weights' sum up to which it is well known. In a scene of one hue it is
        not: there another exposure is as good an explanation as another response.
    least_gain: logarithm of the weights' sum below which it is not taken for another exposure, where the sum is well
        known and where not.
    near_one: logarithm of a gain up to which it is left alone, where it explains alpha as well as other weights do.
    better: the error with another gamma than 1, or with vignetting, over that without, up to which it is taken.
    shading: logarithm of vignetting below which, at the points, there is none; above which, in a corner, there is none.
    explained: share of alpha's variance that must be explained.
    sensor: weights of a usual unfiltered sensor, which sees more blue than Rec. 601.
    greenest: share of green beyond which weights are of no sensor, where they have less blue than Rec. 601's and alpha
        is brighter than luma where a sensor would be darker, or the other way round.
    light: logarithm of the brightness over luma up to which light that differs between the views may be its cause.
    """

    prior: float = 0.15
    independent: float = 30.0
    error: float = 0.012
    outlier: float = 2.0
    points: tuple[int, int] = (6000, 300)
    least_change: tuple[float, float] = (0.0125, 0.033)
    known: float = 0.015
    least_gain: tuple[float, float] = (0.04, 0.18)
    near_one: float = 0.06
    better: float = 0.8
    shading: tuple[float, float] = (0.08, 0.7)
    explained: float = 0.5
    sensor: tuple[float, float, float] = (0.33, 0.39, 0.28)
    greenest: float = 0.62
    light: float = 0.12


SETTINGS = ResponseSettings()


class Response(NamedTuple):
    """alpha = weights . (gain * shaded beta^gamma).

    The weights' sum is near 1; where it is not 1, light differs between the views.
    explained: the share of alpha's variance at the matches that this explains, 0 to 1.
    shading: coefficients of `_shading_terms` in the logarithm of a gain that beta's vignetting asks for; none without.
    """

    weights: Float[Tensor, "3"]
    gain: float = 1.0
    gamma: float = 1.0
    explained: float = 1.0
    shading: tuple[float, ...] = ()

    @classmethod
    def rec601(cls) -> Response:
        """Alpha is the luma of beta."""
        return cls(torch.tensor(REC601, dtype=torch.float64))

    @property
    def is_rec601(self) -> bool:
        """Whether images need not be changed."""
        return self.gain == self.gamma == 1.0 and not self.shading and self.weights.tolist() == list(REC601)

    def __str__(self) -> str:
        red, green, blue = self.weights.tolist()
        gain = "" if self.gain == 1 else f" x {self.gain:.2f}"
        gamma = "" if self.gamma == 1 else f" of beta to the power {self.gamma:g}"
        shading = ", of beta freed of vignetting" if self.shading else ""
        return f"alpha is {red:.2f} R + {green:.2f} G + {blue:.2f} B{gain}{gamma}{shading}"

    def of_alpha(self, alpha: Float[Tensor, "*b 1 h w"]) -> Float[Tensor, "*b 1 h w"]:
        """Alpha on the scale of `of_beta`'s luma."""
        total = float(self.weights.sum())
        return alpha if total == 1 else alpha / total

    def of_beta(self, beta: Float[Tensor, "*b 3 h w"]) -> Float[Tensor, "*b 3 h w"]:
        """Beta at alpha's exposure, sheared along grey so that its Rec. 601 luma is what alpha sees."""
        even = beta * self._brightening(beta) if self.shading else beta
        scaled = self.gain * (even if self.gamma == 1 else even.clamp(min=0) ** self.gamma)
        return scaled + self._shear(scaled)

    def _brightening(self, beta: Tensor) -> Float[Tensor, "h w"]:
        h, w = beta.shape[-2:]
        grid = pixel_grid((h, w), dtype=torch.float64, device=beta.device) + 0.5
        where = (grid / grid.new_tensor([w, h]) - 0.5).reshape(-1, 2)
        terms = _shading_terms(where)
        return (terms.new_tensor(self.shading) @ terms).exp().reshape(h, w).to(beta)

    def undone(self, image: Float[Tensor, "*b 3 h w"]) -> Float[Tensor, "*b 3 h w"]:
        """The fused image sheared back: the weights' combination of its colours is alpha."""
        return image - self._shear(image)

    def _shear(self, image: Tensor) -> Tensor:
        change = (self.weights / self.weights.sum() - self.weights.new_tensor(REC601)).to(image)
        return (image * change[:, None, None]).sum(-3, keepdim=True)


Given = Literal["fit", "rec601"] | tuple[float, float, float] | Response
"""What is known of alpha's response: its weights of red, green and blue, or that it is to be fitted."""


def stated_response(weights: Sequence[float]) -> Response:
    """The response of an alpha that is weights . beta. Raises ValueError unless these are three, none negative."""
    values = torch.tensor([float(w) for w in weights], dtype=torch.float64)
    if values.shape != (3,) or not bool((values >= 0).all() & (values.sum() > 0) & values.isfinite().all()):
        raise ValueError(f"a response is three weights, of red, green and blue, none negative; got {tuple(weights)}")
    return Response(values / values.sum(), gain=float(values.sum()))


def fit(
    bands: Float[Tensor, "3 n"],
    alpha: Float[Tensor, " n"],
    where: Float[Tensor, "n 2"] | None = None,
    settings: ResponseSettings = SETTINGS,
) -> Response:
    """The response by robust least squares over points, drawn towards Rec. 601 as far as the scene is grey.

    `where` are the points in beta, in its width and height, from its middle: with them vignetting is found too. Rec.
    601's where there are too few points, or where a combination of bands does not explain alpha.
    """
    most, fewest = settings.points
    step = max(alpha.numel() // most, 1)
    x, y = bands[:, ::step].double().cpu(), alpha[::step].double().cpu()
    unclipped = (y > 0.02) & (y < 0.98) & (x > 0.01).all(0) & (x < 0.98).all(0)
    x, y = x[:, unclipped], y[unclipped]
    if len(y) < fewest:
        return Response.rec601()
    gamma, found = _best_gamma(x, y, settings)
    shading: tuple[float, ...] = ()
    if where is not None:
        terms = _shading_terms(where[::step].double().cpu()[unclipped])
        slopes = _shading(x, y, terms, settings)
        even = x * (slopes @ terms).exp()
        other_gamma, other = _best_gamma(even, y, settings)
        if other.error < settings.better * found.error and _plausible(slopes, terms, settings):
            x, gamma, found, shading = even, other_gamma, other, tuple(slopes.tolist())
    if found.explained < settings.explained:
        return Response.rec601()
    return _decided(x**gamma, y, gamma, found, settings)._replace(shading=shading)


def _best_gamma(x: Tensor, y: Tensor, settings: ResponseSettings) -> tuple[float, _Fit]:
    """1, or the gamma that explains alpha clearly better."""
    trials = {gamma: _weighted_fit(x**gamma, y, settings) for gamma in GAMMAS}
    gamma = min(trials, key=lambda g: trials[g].error)
    gamma = gamma if trials[gamma].error <= settings.better * trials[1.0].error else 1.0
    return gamma, trials[gamma]


def _shading_terms(where: Float[Tensor, "n 2"]) -> Float[Tensor, "5 n"]:
    """What vignetting, off its centre too, is made of: 0 in the middle of the image."""
    u, v = where.unbind(-1)
    return torch.stack([u, v, u * u, u * v, v * v])


def _plausible(slopes: Tensor, terms: Tensor, settings: ResponseSettings) -> bool:
    """Whether a lens may shade its image so: noticeably at the points, not absurdly in the corners."""
    corners = _shading_terms(torch.tensor([[u, v] for u in (-0.5, 0.5) for v in (-0.5, 0.5)]).to(terms))
    seen, extreme = (float((slopes @ t).abs().max()) for t in (terms, corners))
    least, most = settings.shading
    return seen > least and extreme < most


def _shading(x: Tensor, y: Tensor, terms: Tensor, settings: ResponseSettings) -> Float[Tensor, "5"]:
    """Coefficients of the logarithm of alpha over what explains it, by least squares with the fit's weights."""
    slopes = terms.new_zeros(len(terms))
    design = torch.cat([terms, torch.ones_like(terms[:1])])
    for _ in range(3):
        even = x * (slopes @ terms).exp()
        found = _weighted_fit(even, y, settings)
        ratio = (y / (found.weights @ even).clamp(min=0.01)).log()
        counts = found.share * y.square()
        ridge = 1e-4 * counts.sum() * torch.eye(len(design)).to(y)
        slopes = slopes + torch.linalg.solve((design * counts) @ design.T + ridge, (design * counts) @ ratio)[:-1]
    return slopes


class _Fit(NamedTuple):
    """`deviation` is the relative standard deviation of the weights' sum."""

    weights: Tensor
    share: Tensor
    error: float
    explained: float
    deviation: float


def _decided(x: Tensor, y: Tensor, gamma: float, found: _Fit, settings: ResponseSettings) -> Response:
    """The response of a fit: its gain apart if it is one, and Rec. 601's weights if hardly anything changes."""
    rec601, gain = Response.rec601().weights, float(found.weights.sum())
    unknown = found.deviation > settings.known
    exposed = gamma != 1 or abs(math.log(gain)) > settings.least_gain[unknown]
    gain = gain if exposed else 1.0
    if not exposed and _only_a_gain(x, y, found, settings):
        return Response(rec601, explained=found.explained)
    weights = found.weights / gain
    change = gain * float(((weights - rec601) @ x).square().mean().sqrt())
    unlike, share = _unlike_sensors(x, y, found, settings), weights / weights.sum()
    no_sensor = unlike and bool((share[1] > settings.greenest) & (share[2] < rec601[2]))
    if no_sensor or change < settings.least_change[gamma != 1 or (exposed and unknown)]:
        return Response(rec601, _ratio(y, rec601 @ x, found) if exposed else 1.0, gamma, found.explained)
    brighter = _ratio(y, rec601 @ x, found)
    if unknown and not exposed and unlike and abs(math.log(brighter)) < settings.light:
        return Response((weights / weights.sum() + rec601) / 2, math.sqrt(brighter), gamma, found.explained)
    return Response(weights, gain, gamma, found.explained)


def _only_a_gain(x: Tensor, y: Tensor, found: _Fit, settings: ResponseSettings) -> bool:
    """Whether Rec. 601's luma times a gain near 1 explains alpha as well: light differs a little, or exposure."""
    luma = Response.rec601().weights @ x
    gain = _ratio(y, luma, found)
    change = float((found.weights @ x - gain * luma).square().mean().sqrt())
    apart = abs(math.log(float(found.weights.sum()) / gain))
    same = apart < 2 * max(found.deviation, 0.005) and change < settings.least_change[0]
    return same and abs(math.log(gain)) < settings.near_one


def _unlike_sensors(x: Tensor, y: Tensor, found: _Fit, settings: ResponseSettings) -> bool:
    """Whether alpha is brighter than luma where a usual sensor would be darker, or the other way round.

    In a scene of one hue light or exposure explain that as well as a response does, and are as likely if it is little.
    """
    luma = Response.rec601().weights @ x
    sensor = luma.new_tensor(settings.sensor) @ x
    return (_ratio(y, luma, found) - 1) * (_ratio(sensor, luma, found) - 1) < 0


def _ratio(y: Tensor, luma: Tensor, found: _Fit) -> float:
    """The factor by which luma is y, by least squares with the fit's weights."""
    return float((found.share * luma) @ y / ((found.share * luma) @ luma))


def _weighted_fit(x: Tensor, y: Tensor, settings: ResponseSettings) -> _Fit:
    """Weights s (Rec. 601's + d), d's sum 0, by iteratively reweighted least squares with Cauchy's weights.

    Nothing is assumed of s; d is drawn to 0.
    """
    rec601 = Response.rec601().weights
    free = torch.tensor([[1.0, 0.0], [0.0, 1.0], [-1.0, -1.0]], dtype=torch.float64)
    design = torch.stack([rec601 @ x, *(free.T @ x)])
    weights, share = rec601 * (y.median() / (rec601 @ x).median()), torch.ones_like(y)
    for _ in range(8):
        rest = y - weights @ x
        deviation = max(1.4826 * float(rest.abs().median()), 1e-3)
        share = 1 / (1 + (rest / (settings.outlier * max(deviation, settings.error / 3))).square())
        counts = share * (settings.independent / share.sum() / max(deviation, settings.error) ** 2)
        prior = torch.zeros(3, 3, dtype=torch.float64)
        prior[1:, 1:] = free.T @ free / (settings.prior * float(weights.sum())) ** 2
        covariance = torch.linalg.inv((design * counts) @ design.T + prior)
        scale, *change = covariance @ ((design * counts) @ y)
        weights = scale * rec601 + free @ torch.stack(change)
    rest = y - weights @ x
    centred = y - share @ y / share.sum()
    explained = 1 - float(share @ rest.square() / (share @ centred.square()).clamp(min=1e-12))
    error = float(torch.log1p((rest / 0.02).square()).mean())
    return _Fit(weights, share, error, max(explained, 0.0), float(covariance[0, 0].sqrt() / scale))
