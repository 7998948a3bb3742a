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

    usual: weights of a usual sensor, when it is not Rec. 601's; prior: their standard deviation about these.
    independent: how many independent observations all points count as: about as many as there are materials.
    error: standard deviation of one of those, at least: light and surfaces differ between the views.
    outlier: residuals of this many robust deviations count half.
    points: pixels used at most, and the fewest that are enough.
    unlikely: by how much another gain, other weights, and both together must lower the misfit (a sum of squares over
        independent observations, in standard deviations) to be taken. In a scene of one hue several explain alpha.
    negative: standard deviation of negative weights.
    sensor: weights of an unfiltered sensor, which sees more blue than Rec. 601.
    light: logarithm of a gain up to which light that differs between the views may be its cause: where a sensor might,
        and where none would.
    greenest: share of green beyond which weights are of no sensor, if they have less blue than Rec. 601's, and alpha is
        brighter than luma where an unfiltered sensor would be darker, or the other way round: that is light too.
    alike: a gain explains alpha as well as weights do if its misfit is up to this much larger.
    equal_weights: by how much the misfit of 1/3, 1/3, 1/3 may be larger than that of other weights, to be taken in
        their place: a sensor without filters. Light may differ between the views by a gain of this standard deviation.
    least_change: root mean square change of luma up to which the weights are left at Rec. 601's.
    equal: the error over the least one up to which a gamma explains alpha as well.
    better: the error with another gamma than 1, or with vignetting, over that without, up to which it is taken.
    shading: logarithm of vignetting below which, at the points, there is none; above which, in a corner, there is none.
    explained: share of alpha's variance that must be explained.
    """

    usual: tuple[float, float, float] = (0.32, 0.48, 0.20)
    prior: float = 0.2
    independent: float = 20.0
    error: float = 0.012
    outlier: float = 2.0
    points: tuple[int, int] = (6000, 300)
    unlikely: tuple[float, float, float] = (22.0, 12.0, 45.0)
    negative: float = 0.05
    sensor: tuple[float, float, float] = (0.33, 0.39, 0.28)
    light: tuple[float, float] = (0.035, 0.12)
    greenest: float = 0.62
    alike: float = 2.0
    equal_weights: tuple[float, float] = (8.0, 0.006)
    least_change: float = 0.01
    equal: float = 1.1
    better: float = 0.8
    shading: tuple[float, float] = (0.08, 0.7)
    explained: float = 0.5


SETTINGS = ResponseSettings()


class Response(NamedTuple):
    """alpha = weights . (gain * shaded beta^gamma).

    The weights' sum is 1, where they are not stated otherwise.
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
    """The response by robust least squares over points: the most plausible of those that explain alpha.

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
    return _decided(x**gamma, y, gamma, found, settings)[1]._replace(shading=shading)


def _best_gamma(x: Tensor, y: Tensor, settings: ResponseSettings) -> tuple[float, _Fit]:
    """1, or the gamma that explains alpha clearly better; of several the one with the most plausible response."""
    trials = {gamma: _weighted_fit(x**gamma, y, settings) for gamma in GAMMAS}
    least = min(trial.error for trial in trials.values())
    if least > settings.better * trials[1.0].error:
        return 1.0, trials[1.0]
    equal = {gamma: trial for gamma, trial in trials.items() if trial.error <= settings.equal * least}
    equal[1.0] = trials[1.0]._replace(deviation=min(trial.deviation for trial in equal.values()))
    gamma = min(equal, key=lambda g: _decided(x**g, y, g, equal[g], settings)[0])
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
    """`share` is what each point counts, 0 to 1; `deviation` the robust standard deviation of what is not explained."""

    weights: Tensor
    share: Tensor
    deviation: float
    error: float
    explained: float


def _decided(x: Tensor, y: Tensor, gamma: float, found: _Fit, settings: ResponseSettings) -> tuple[float, Response]:
    """The most plausible of four explanations of alpha, and its misfit.

    They are luma as it is, another gain, other weights of sum 1, or both. In a scene of one hue several fit, and what
    each must gain to be taken decides.
    """
    rec601, usual, sensor = Response.rec601().weights, x.new_tensor(settings.usual), x.new_tensor(settings.sensor)
    luma, grey, hues = rec601 @ x, usual @ x, CHANGES.T @ x
    counts = found.share * _importance(found.share, found.deviation, settings)
    precision = CHANGES.T @ CHANGES / settings.prior**2
    scale = float(found.weights.sum())

    def explained(rest: Tensor, design: Tensor, *precisions: Tensor) -> tuple[float, Tensor]:
        prior = torch.block_diag(*precisions)
        values = torch.linalg.solve((design * counts) @ design.T + prior, (design * counts) @ rest)
        return float(counts @ (rest - values @ design).square() + values @ prior @ values), values

    def or_equal(weights: Tensor, gain: float) -> tuple[Tensor, float]:
        """1/3 of each band with the gain that fits best, if they explain alpha about as well as these weights."""
        more, deviation = settings.equal_weights
        precision = x.new_full((1, 1), deviation**-2 if gain == 1 else 0.0)
        equal = torch.full_like(weights, 1 / 3)
        shades = [gain * (w @ x) for w in (weights, equal)]
        (misfit, _), (of_equal, (light,)) = (explained(y - shade, shade[None], precision) for shade in shades)
        if of_equal > misfit + more:
            return weights, gain
        return equal, gain if gain == 1 else gain * (1 + float(light))

    def negative(weights: Tensor) -> float:
        return float((weights.clamp(max=0) / settings.negative).square().sum())

    only_gain, (gain,) = explained(y, luma[None], x.new_zeros(1, 1))
    only_weights, change = explained(y - grey, hues, precision)
    both, (total, *rest) = explained(y, torch.stack([grey, *hues]), x.new_zeros(1, 1), precision / scale**2)
    weights, further = usual + CHANGES @ change, usual + CHANGES @ torch.stack(rest) / total
    trials = [
        (only_gain + settings.unlikely[0], rec601, float(gain)),
        (both + settings.unlikely[2] + negative(further), further, float(total)),
    ]
    if gamma == 1:
        trials.append((only_weights + settings.unlikely[1] + negative(weights), weights, 1.0))
        trials.append((float(counts @ (y - luma).square()), rec601, 1.0))
    misfit, chosen, exposure = min(trials, key=lambda trial: trial[0])
    differing = float(((chosen - rec601) @ x).square().mean().sqrt())
    unlike_sensors = float(gain - 1) * float((sensor @ x - luma) @ counts) < 0
    light = settings.light[unlike_sensors]
    by_light = only_gain < only_weights + settings.alike and abs(math.log(float(gain))) < light
    no_sensor = any(bool((w[1] > settings.greenest) & (w[2] < rec601[2])) for w in (weights, further))
    by_light = by_light or (unlike_sensors and no_sensor)
    if exposure == 1 and (differing < settings.least_change or by_light):
        chosen = rec601
    elif chosen is not rec601:
        chosen, exposure = or_equal(chosen, exposure)
    return misfit, Response(chosen, exposure, gamma, found.explained)


CHANGES = torch.tensor([[1.0, 0.0], [0.0, 1.0], [-1.0, -1.0]], dtype=torch.float64)
"""What weights may change by while their sum stays."""


def _importance(share: Tensor, deviation: float, settings: ResponseSettings) -> Tensor:
    """What the square of a point's residual counts where its share is 1."""
    return settings.independent / share.sum() / max(deviation, settings.error) ** 2


def _weighted_fit(x: Tensor, y: Tensor, settings: ResponseSettings) -> _Fit:
    """Weights s (usual ones + d), d's sum 0, by iteratively reweighted least squares with Cauchy's weights.

    Nothing is assumed of s; d is drawn to 0.
    """
    usual = x.new_tensor(settings.usual)
    design = torch.stack([usual @ x, *(CHANGES.T @ x)])
    weights, share, deviation = usual * (y.median() / (usual @ x).median()), torch.ones_like(y), 1.0
    for _ in range(8):
        rest = y - weights @ x
        deviation = max(1.4826 * float(rest.abs().median()), 1e-3)
        share = 1 / (1 + (rest / (settings.outlier * max(deviation, settings.error / 3))).square())
        counts = share * _importance(share, deviation, settings)
        prior = x.new_zeros(3, 3)
        prior[1:, 1:] = CHANGES.T @ CHANGES / (settings.prior * float(weights.sum())) ** 2
        scale, *change = torch.linalg.solve((design * counts) @ design.T + prior, (design * counts) @ y)
        weights = scale * usual + CHANGES @ torch.stack(change)
    rest = y - weights @ x
    centred = y - share @ y / share.sum()
    explained = 1 - float(share @ rest.square() / (share @ centred.square()).clamp(min=1e-12))
    error = float(torch.log1p((rest / 0.02).square()).mean())
    return _Fit(weights, share, deviation, error, max(explained, 0.0))
