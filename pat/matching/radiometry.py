"""Which combination of an RGB beta's bands alpha sees; of any bands: `spectral_mix`.

The network compares alpha with Rec. 601 luma of an RGB beta and keeps alpha as the result's luma. A real mono
sensor weighs red, green and blue otherwise, and another exposure or tone curve makes beta darker or flatter.
There alpha is explained as weights . (gain * beta^gamma) over points that match, and beta is mapped so that
its luma is that: scaled, raised to the power, and sheared along grey, so that neutral stays neutral. The
fused image is sheared back.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import pixel_grid
from arraygeom.robust import cauchy, least_squares, normal_deviation, robust_least_squares

from ..media.colour import REC601
from ..support.settings import physics, size, tuned


@dataclass(frozen=True)
class ResponseSettings:
    """Middlebury is the nine pairs of its tune half.

    A misfit is a sum of squares over independent observations, in standard deviations. In a scene of one hue
    several responses explain alpha.
    """

    usual: tuple[float, float, float] = tuned(
        (0.32, 0.48, 0.20), "Middlebury: weights of a usual sensor that is not Rec. 601's: it sees more blue"
    )
    prior: float = tuned(0.2, "Middlebury: standard deviation of weights about these")
    independent: float = tuned(
        20.0, "Middlebury: as how many independent observations, or materials, all points count"
    )
    error: float = tuned(
        0.012, "Middlebury: standard deviation of one of those, at least: light differs between views"
    )
    outlier: float = tuned(2.0, "Middlebury: residuals of this many robust deviations count half")
    points: tuple[int, int] = size((6000, 300), "Pixels used at most, and the fewest that are enough")
    gammas: tuple[float, ...] = size(
        (0.4, 0.5, 0.6, 0.7, 0.77, 0.85, 0.92, 1.0, 1.08, 1.18, 1.3, 1.45, 1.6, 1.8, 2.0, 2.3, 2.6),
        "Gammas that are tried",
    )
    unlikely: tuple[float, float, float] = tuned(
        (22.0, 12.0, 45.0),
        "Middlebury: by how much another gain, other weights, and both must lower the misfit to be taken",
    )
    light: tuple[float, float] = tuned(
        (0.035, 0.12),
        "Middlebury: logarithm of a gain up to which light that differs between the views may be its cause: "
        "where a sensor might, and where none would",
    )
    greenest: float = tuned(
        0.62,
        "Middlebury: share of green beyond which weights are of no sensor, if they have less blue than Rec. "
        "601's, and alpha is brighter than luma where an unfiltered sensor would be darker, or the other "
        "way round: that is light too",
    )
    negative: float = physics(0.05, "Standard deviation of negative weights, which no sensor has")
    sensor: tuple[float, float, float] = physics(
        (0.33, 0.39, 0.28), "Weights of an unfiltered sensor, which sees more blue than Rec. 601"
    )
    alike: float = tuned(
        2.0, "Middlebury: a gain explains alpha as well as weights do if its misfit is up to this much larger"
    )
    equal_weights: tuple[float, float] = tuned(
        (8.0, 0.006),
        "Middlebury: by how much the misfit of 1/3, 1/3, 1/3 may be larger than that of other weights, "
        "to be taken in their place: a sensor without filters; light may differ by a gain of this standard "
        "deviation",
    )
    least_change: float = physics(
        0.01, "Root mean square change of luma up to which the weights are left at Rec. 601's"
    )
    equal: float = tuned(
        1.1, "Middlebury: the error over the least one up to which a gamma explains alpha as well"
    )
    better: float = tuned(
        0.8,
        "Middlebury: the error with another gamma than 1, or with vignetting, over that without, to be taken",
    )
    shading: tuple[float, float] = tuned(
        (0.08, 0.7),
        "Middlebury: logarithm of vignetting below which, at the points, there is none; "
        "above which, in a corner, no lens is",
    )
    explained: float = tuned(0.5, "Middlebury: share of alpha's variance that must be explained")


SETTINGS = ResponseSettings()


class Response(NamedTuple):
    """alpha = weights . (gain * shaded beta^gamma).

    The weights' sum is 1, where they are not stated otherwise.
    explained: the share of alpha's variance at the matches that this explains, 0 to 1.
    shading: coefficients of `_shading_terms` in the logarithm of a gain that beta's vignetting asks for; none
        without.
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
        scaled = self.exposed(beta)
        return scaled + self._shear(scaled)

    def exposed(self, beta: Float[Tensor, "*b 3 h w"]) -> Float[Tensor, "*b 3 h w"]:
        """Beta at alpha's exposure, in its own colours."""
        even = beta * self._brightening(beta) if self.shading else beta
        return self.gain * (even if self.gamma == 1 else even.clamp(min=0) ** self.gamma)

    def _brightening(self, beta: Tensor) -> Float[Tensor, "h w"]:
        h, w = beta.shape[-2:]
        grid = pixel_grid((h, w), dtype=torch.float64, device=beta.device) + 0.5
        terms = _shading_terms((grid / grid.new_tensor([w, h]) - 0.5).reshape(-1, 2))
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
    """The response of an alpha that is weights . beta. Raises ValueError unless three, none negative."""
    values = torch.tensor([float(w) for w in weights], dtype=torch.float64)
    if values.shape != (3,) or not bool((values >= 0).all() & (values.sum() > 0) & values.isfinite().all()):
        given = tuple(weights)
        raise ValueError(f"a response is three weights, of red, green and blue, none negative; got {given}")
    return Response(values / values.sum(), gain=float(values.sum()))


def fit(
    bands: Float[Tensor, "3 n"],
    alpha: Float[Tensor, " n"],
    where: Float[Tensor, "n 2"] | None = None,
) -> Response:
    """The response by robust least squares over points: the most plausible of those that explain alpha.

    `where` are the points in beta, in its width and height, from its middle: with them vignetting is found
    too. Rec. 601's where there are too few points, or where a combination of bands does not explain alpha.
    """
    most, fewest = SETTINGS.points
    step = max(alpha.numel() // most, 1)
    x, y = bands[:, ::step].double().cpu(), alpha[::step].double().cpu()
    unclipped = (y > 0.02) & (y < 0.98) & (x > 0.01).all(0) & (x < 0.98).all(0)
    x, y = x[:, unclipped], y[unclipped]
    if len(y) < fewest:
        return Response.rec601()
    gamma, found = _best_gamma(x, y)
    shading: tuple[float, ...] = ()
    if where is not None:
        terms = _shading_terms(where[::step].double().cpu()[unclipped])
        slopes = _shading(x, y, terms)
        even = x * (slopes @ terms).exp()
        other_gamma, other = _best_gamma(even, y)
        if other.error < SETTINGS.better * found.error and _plausible(slopes, terms):
            x, gamma, found, shading = even, other_gamma, other, tuple(slopes.tolist())
    if found.explained < SETTINGS.explained:
        return Response.rec601()
    return _decided(x**gamma, y, gamma, found)[1]._replace(shading=shading)


class _Fit(NamedTuple):
    """`counts`: what the square of each point's residual counts, 1 / variance of independent observations."""

    weights: Float[Tensor, "3"]
    counts: Float[Tensor, " n"]
    error: float
    explained: float


def _best_gamma(x: Tensor, y: Tensor) -> tuple[float, _Fit]:
    """1, or the gamma that explains alpha clearly better; of several, that of the most plausible response."""
    trials = {gamma: _weighted_fit(x**gamma, y) for gamma in SETTINGS.gammas}
    least = min(trial.error for trial in trials.values())
    if least > SETTINGS.better * trials[1.0].error:
        return 1.0, trials[1.0]
    equal = {gamma: trial for gamma, trial in trials.items() if trial.error <= SETTINGS.equal * least}
    linear, most = trials[1.0], max(float(trial.counts.sum()) for trial in equal.values())
    equal[1.0] = linear._replace(counts=linear.counts * (most / linear.counts.sum()))
    gamma = min(equal, key=lambda g: _decided(x**g, y, g, equal[g])[0])
    return gamma, trials[gamma]


def _shading_terms(where: Float[Tensor, "n 2"]) -> Float[Tensor, "5 n"]:
    """What vignetting, off its centre too, is made of: 0 in the middle of the image."""
    u, v = where.unbind(-1)
    return torch.stack([u, v, u * u, u * v, v * v])


def _plausible(slopes: Tensor, terms: Tensor) -> bool:
    """Whether a lens may shade its image so: noticeably at the points, not absurdly in the corners."""
    corners = _shading_terms(torch.tensor([[u, v] for u in (-0.5, 0.5) for v in (-0.5, 0.5)]).to(terms))
    seen, extreme = (float((slopes @ t).abs().max()) for t in (terms, corners))
    least, most = SETTINGS.shading
    return seen > least and extreme < most


def _shading(x: Tensor, y: Tensor, terms: Tensor) -> Float[Tensor, "5"]:
    """Coefficients of alpha's logarithm over what explains it, by least squares with the fit's weights."""
    slopes = terms.new_zeros(len(terms))
    design = torch.cat([terms, torch.ones_like(terms[:1])])
    for _ in range(3):
        even = x * (slopes @ terms).exp()
        found = _weighted_fit(even, y)
        ratio = (y / (found.weights @ even).clamp(min=0.01)).log()
        counts = found.counts * y.square()
        ridge = 1e-4 * counts.sum() * torch.eye(len(design)).to(y)
        slopes = slopes + least_squares(design, ratio, counts, ridge)[:-1]
    return slopes


CHANGES = torch.tensor([[1.0, 0.0], [0.0, 1.0], [-1.0, -1.0]], dtype=torch.float64)
"""What weights may change by while their sum stays."""


def _weighted_fit(x: Tensor, y: Tensor) -> _Fit:
    """Weights s (usual ones + d), d's sum 0, robustly. Nothing is assumed of s; d is drawn to 0."""
    usual = x.new_tensor(SETTINGS.usual)
    terms = torch.stack([usual @ x, *(CHANGES.T @ x)])
    start = x.new_tensor([float(y.median() / terms[0].median()), 0.0, 0.0])

    def weigh(rest: Tensor) -> Tensor:
        deviation = normal_deviation(rest, SETTINGS.error / 3)
        share = cauchy(rest, SETTINGS.outlier * deviation)
        return share * (SETTINGS.independent / share.sum() / max(deviation, SETTINGS.error) ** 2)

    drawn = torch.block_diag(x.new_zeros(1, 1), CHANGES.T @ CHANGES)

    def precision(found: Tensor) -> Tensor:
        return drawn / (SETTINGS.prior * float(found[0])) ** 2

    (scale, *change), rest, counts = robust_least_squares(terms, y, start, weigh, precision=precision)
    centred = y - counts @ y / counts.sum()
    explained = 1 - float(counts @ rest.square() / (counts @ centred.square()).clamp(min=1e-12))
    error = float(torch.log1p((rest / 0.02).square()).mean())
    return _Fit(scale * usual + CHANGES @ torch.stack(change), counts, error, max(explained, 0.0))


class _Points(NamedTuple):
    """Bands (raised to a power) and alpha at points, and what the squares of their residuals count."""

    x: Float[Tensor, "3 n"]
    y: Float[Tensor, " n"]
    counts: Float[Tensor, " n"]

    def explained(self, rest: Tensor, terms: Tensor, precision: Tensor) -> tuple[float, Tensor]:
        """The misfit of the terms that explain a rest of alpha best, and their coefficients."""
        found = least_squares(terms, rest, self.counts, precision)
        return float(self.counts @ (rest - found @ terms).square() + found @ precision @ found), found


def _decided(x: Tensor, y: Tensor, gamma: float, found: _Fit) -> tuple[float, Response]:
    """The most plausible of four explanations of alpha, and its misfit.

    They are luma as it is, another gain, other weights of sum 1, or both. In a scene of one hue several fit,
    and what each must gain to be taken decides.
    """
    points, rec601 = _Points(x, y, found.counts), Response.rec601().weights
    usual = x.new_tensor(SETTINGS.usual)
    grey, hues, free = usual @ x, CHANGES.T @ x, x.new_zeros(1, 1)
    precision = CHANGES.T @ CHANGES / SETTINGS.prior**2
    scale = float(found.weights.sum())
    only_gain, (gain,) = points.explained(y, (rec601 @ x)[None], free)
    only_weights, change = points.explained(y - grey, hues, precision)
    scaled = torch.block_diag(free, precision / scale**2)
    both, (total, *rest) = points.explained(y, torch.stack([grey, *hues]), scaled)
    weights, further = usual + CHANGES @ change, usual + CHANGES @ torch.stack(rest) / total
    trials = [
        (only_gain + SETTINGS.unlikely[0], rec601, float(gain)),
        (both + SETTINGS.unlikely[2] + _negative(further), further, float(total)),
    ]
    if gamma == 1:
        trials.append((only_weights + SETTINGS.unlikely[1] + _negative(weights), weights, 1.0))
        trials.append((float(points.counts @ (y - rec601 @ x).square()), rec601, 1.0))
    misfit, chosen, exposure = min(trials, key=lambda trial: trial[0])
    as_well = only_gain < only_weights + SETTINGS.alike
    unchanged = float(((chosen - rec601) @ x).square().mean().sqrt()) < SETTINGS.least_change
    if exposure == 1 and (unchanged or _is_light(points, float(gain), as_well, (weights, further))):
        chosen = rec601
    elif chosen is not rec601:
        chosen, exposure = _or_equal(points, chosen, exposure)
    return misfit, Response(chosen, exposure, gamma, found.explained)


def _is_light(points: _Points, gain: float, as_well: bool, weights: Sequence[Tensor]) -> bool:
    """Whether light that differs between the views may be why other weights explain alpha better: a small
    gain explains it as well, or no sensor has such weights."""
    rec601, sensor = Response.rec601().weights, points.x.new_tensor(SETTINGS.sensor)
    unlike_sensors = (gain - 1) * float(((sensor - rec601) @ points.x) @ points.counts) < 0
    no_sensor = any(bool((w[1] > SETTINGS.greenest) & (w[2] < rec601[2])) for w in weights)
    small = as_well and abs(math.log(gain)) < SETTINGS.light[unlike_sensors]
    return small or (unlike_sensors and no_sensor)


def _negative(weights: Tensor) -> float:
    """How unlikely negative weights are, as a misfit."""
    return float((weights.clamp(max=0) / SETTINGS.negative).square().sum())


def _or_equal(points: _Points, weights: Tensor, gain: float) -> tuple[Tensor, float]:
    """1/3 of each band if they explain alpha about as well, with the gain that fits best unless that is 1."""
    more, deviation = SETTINGS.equal_weights
    precision = points.x.new_full((1, 1), deviation**-2 if gain == 1 else 0.0)
    equal = torch.full_like(weights, 1 / 3)
    shades = [gain * (w @ points.x) for w in (weights, equal)]
    (misfit, _), (of_equal, (light,)) = (points.explained(points.y - s, s[None], precision) for s in shades)
    if of_equal > misfit + more:
        return weights, gain
    return equal, gain if gain == 1 else gain * (1 + float(light))
