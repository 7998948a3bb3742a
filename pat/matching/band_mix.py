"""Mix of beta's bands that alpha sees, by weighted least squares on matched points.

A network compares alpha with one mix of beta's bands and keeps alpha as that mix of the result. A `Response`
is the mix of red, green and blue as cameras form it: of beta at another exposure, with another tone curve and
vignetting, by a sensor of other weights. A `SpectralMix` is a linear mix of any bands, relative to means
around each pixel.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import one_hot

from arraygeom import pixel_grid
from arraygeom.robust import (
    cauchy,
    gaussian,
    least_squares,
    normal_deviation,
    robust_least_squares,
)

from ..media.colour import OPPONENT, REC601
from ..media.filters import box_mean
from ..support.settings import physics, size, tuned
from .normalisation import UNLIKE


@dataclass(frozen=True)
class BandMixSettings:
    """Settings of the fit of bands to alpha; brightness is 0 to 1.

    Priors of cameras' properties are standard deviations, not chosen on images.

    `pat lab settings` prints the value of each with its meaning and reason.
    """

    prior: float = size(
        0.2, "Standard deviation of weights about equal ones; half or twice as much does as well"
    )
    exposure: float = physics(0.5, "Of the logarithms of gain and gamma: a stop, or 2.2, are .7 and .8")
    vignetting: float = physics(
        0.3, "Of the coefficients of its logarithm: cos^4 of 30 degrees in the corners is .6"
    )
    rare: float = tuned(0.05, "Middlebury: the probability of anything that is not as usual")
    light: float = tuned(0.03, "Middlebury: standard deviation of light between the views, a share of it")
    near: float = tuned(
        0.2, "Middlebury: difference in colour, or in place in widths of beta, where light differs"
    )
    least: float = tuned(0.005, "Middlebury: standard deviation of a group of points, at least")
    independent: float = tuned(
        2.0, "Middlebury, tune half, of 1 to 3: a group counts as so many independent points"
    )
    points: tuple[int, int] = size((6000, 300), "Pixels used at most, and the fewest that are enough")
    groups: int = size(256, "Groups of alike points; half as many cost .1 dB at most, on average")
    outlier: float = physics(2.385, "Deviations that count half: 95 % efficient if errors are normal")
    steps: int = size(3, "Gauss-Newton steps of an explanation")
    explained: float = tuned(
        0.8,
        "Share of alpha's variance that must be explained: of Middlebury's tune half at least .89 is, "
        "of two scenes in near infrared .76 and .86",
    )
    ridge: float = size(
        1e-4, "Share of the bands' mean variance by which bands that are alike get equal weights"
    )
    coarsely: int = size(400_000, "Alpha's pixels at most on which a linear mix is found")
    wide: int = size(4, "The image's longer side over the radius in which bands are compared")


SETTINGS = BandMixSettings()
HUES = torch.tensor(OPPONENT[1:], dtype=torch.float64).T
"""Directions in which weights may change while their sum stays, (3, 2), of unit length."""
EVEN = (1 / 3, 1 / 3, 1 / 3)
"""Weights of a sensor without a filter."""


class Response(NamedTuple):
    """Response of alpha: alpha = weights . (gain * shaded beta^gamma).

    Attributes:
        weights: weights of red, green and blue (3), float64; their sum is 1.
        gain: factor of beta's brightness.
        gamma: power of beta's brightness.
        explained: share of alpha's variance at the matches that any mix of bands explains, 0 to 1, also where
            Rec. 601's was kept; 1 if none was fitted.
        shading: coefficients of u, v, u^2, u v and v^2, the place in beta's width and height from its middle,
            in the logarithm of a gain that corrects beta's vignetting; empty without.
        deviations: standard deviations of the three weights, and of the logarithms of gain and gamma, over
            all explanations by their probability; 0 where none was fitted.
    """

    weights: Float[Tensor, "3"]
    gain: float = 1.0
    gamma: float = 1.0
    explained: float = 1.0
    shading: tuple[float, ...] = ()
    deviations: tuple[float, ...] = (0.0,) * 5

    @classmethod
    def rec601(cls) -> Response:
        """Return the response of an alpha that is the luma of beta."""
        return cls(torch.tensor(REC601, dtype=torch.float64))

    @property
    def is_rec601(self) -> bool:
        """True if images need not be changed."""
        return self.gain == self.gamma == 1.0 and not self.shading and not self.is_unlike

    @property
    def is_unlike(self) -> bool:
        """True if the weights are not Rec. 601's."""
        return self.weights.tolist() != list(REC601)

    @property
    def explains(self) -> bool:
        """True if this is about the mix that alpha sees."""
        return self.explained >= SETTINGS.explained

    @property
    def exchanged(self) -> bool:
        """True if alpha is the luma of beta with red and blue exchanged, and not that of beta as it is."""
        luma = self.weights.new_tensor(REC601)
        off, other = ((luma - weights).abs().max() for weights in (self.weights, self.weights.flip(0)))
        return self.explains and bool(other < off / 3)

    def __str__(self) -> str:
        red, green, blue = self.weights.tolist()
        gain = "" if self.gain == 1 else f" x {self.gain:.2f}{self._sure(self.gain * self.deviations[3])}"
        gamma = f" of beta to the power {self.gamma:.2f}{self._sure(self.gamma * self.deviations[4])}"
        shading = ", of beta freed of vignetting" if self.shading else ""
        weights = f"{red:.2f} R + {green:.2f} G + {blue:.2f} B{self._sure(*self.deviations[:3])}"
        return f"alpha is {weights}{gain}{gamma if self.gamma != 1 else ''}{shading}"

    def _sure(self, *deviations: float) -> str:
        return f" (± {', '.join(f'{d:.2f}' for d in deviations)})" if any(self.deviations) else ""

    def of_alpha(self, alpha: Float[Tensor, "*b 1 h w"]) -> Float[Tensor, "*b 1 h w"]:
        """Return alpha on the scale of `of_beta`'s luma."""
        total = float(self.weights.sum())
        return alpha if total == 1 else alpha / total

    def of_beta(self, beta: Float[Tensor, "*b 3 h w"]) -> Float[Tensor, "*b 3 h w"]:
        """Return beta at alpha's exposure, sheared along grey so that its luma is the mix that alpha sees."""
        scaled = self.exposed(beta)
        return scaled + self._shear(scaled)

    def exposed(self, beta: Float[Tensor, "*b 3 h w"]) -> Float[Tensor, "*b 3 h w"]:
        """Return beta at alpha's exposure, in its own colours."""
        even = beta * self._brightening(beta) if self.shading else beta
        return self.gain * (even if self.gamma == 1 else even.clamp(min=0) ** self.gamma)

    def _brightening(self, beta: Tensor) -> Float[Tensor, "h w"]:
        h, w = beta.shape[-2:]
        grid = pixel_grid((h, w), dtype=torch.float64, device=beta.device) + 0.5
        terms = _shading_terms((grid / grid.new_tensor([w, h]) - 0.5).reshape(-1, 2))
        return (terms.new_tensor(self.shading) @ terms).exp().reshape(h, w).to(beta)

    def undone(self, image: Float[Tensor, "*b 3 h w"]) -> Float[Tensor, "*b 3 h w"]:
        """Return the fused image sheared back: the weights' mix of its colours is alpha."""
        return image - self._shear(image)

    def _shear(self, image: Tensor) -> Tensor:
        change = (self.weights / self.weights.sum() - self.weights.new_tensor(REC601)).to(image)
        return (image * change[:, None, None]).sum(-3, keepdim=True)


ResponseSpec = Literal["fit", "rec601"] | tuple[float, float, float] | Response
"""Statement on alpha's response: its weights of red, green and blue, or that it is to be fitted."""


def stated_response(weights: Sequence[float]) -> Response:
    """Make the response of an alpha that is a known mix of beta's bands.

    Args:
        weights: weights of red, green and blue.

    Returns:
        The response, with weights that sum to 1 and their sum as the gain.

    Raises:
        ValueError: unless there are three numbers, none negative, infinite or NaN, not all 0.
    """
    try:
        values = torch.tensor([float(w + 0.0) for w in weights], dtype=torch.float64)  # no texts
    except (TypeError, ValueError):
        values = torch.zeros(0)
    if values.shape != (3,) or not bool((values >= 0).all() & (values.sum() > 0) & values.isfinite().all()):
        raise ValueError(f"a response is three weights, of red, green and blue, none negative; got {weights}")
    return Response(values / values.sum(), gain=float(values.sum()))


def given_response(response: ResponseSpec) -> Response:
    """Return the response that the user stated; Rec. 601's for "rec601", and for "fit" until it is fitted.

    Args:
        response: "fit", "rec601", three weights of red, green and blue, or a `Response`, returned as it is.

    Raises:
        ValueError: for a value of another kind, and weights that `stated_response` refuses.
    """
    if isinstance(response, Response):
        return response
    if not isinstance(response, str):
        return stated_response(response)
    if response not in ("fit", "rec601"):
        raise ValueError(f"response is 'fit', 'rec601' or three weights; got {response!r}")
    return Response.rec601()


def fit(
    bands: Float[Tensor, "3 n"],
    alpha: Float[Tensor, " n"],
    where: Float[Tensor, "n 2"] | None = None,
    *,
    enough: float = 1.0,
) -> Response:
    """Estimate alpha's most probable response from matched points: weights, gain, gamma and vignetting.

    Explanations of more or fewer free parameters are judged by their evidence, the probability of alpha under
    all responses that one allows (MacKay 1992): one that allows more must explain more. Light differs between
    the views as a smooth function of colour and place, and with brightness (a Gaussian process, by which
    Kennedy and O'Hagan 2001 model the lack of a model).

    Args:
        bands: red, green and blue of beta at the points, 0..1; points near black or clipped do not count.
        alpha: alpha at the points.
        where: positions of the points in beta, in its width and height, from its middle, with which
            vignetting is estimated; None without.
        enough: matched pixels as a share of those wanted, 0 to 1. Below 1 wrong ones among them
            could explain anything: only gain and gamma are fitted, and `explained` is divided by it.

    Returns:
        The response, on the CPU; Rec. 601's if that is likeliest, for too few points (`SETTINGS.points`;
        `explained` is 1 then), and where no mix of bands explains alpha (`explains` is False).

    Raises:
        ValueError: for another `enough`.
    """
    if not 0 <= enough <= 1:
        raise ValueError(f"enough is {enough}: give a share of the matches wanted, 0 to 1")
    most, fewest = SETTINGS.points
    place = torch.zeros_like(bands[:2].T) if where is None else where
    planes = torch.cat([bands, alpha[None], place.T])[:, :: max(alpha.numel() // most, 1)].double().cpu()
    planes = planes[:, (planes[:4] > 0.02).all(0) & (planes[:4] < 0.98).all(0)]
    if not enough or planes.shape[1] < fewest:
        return Response.rec601()
    groups = _Groups.from_points(planes[:3], planes[3], planes[4:])
    fits = [groups.fitted(*one) for one in EXPLANATIONS if where is not None or not one[1][-1]]
    best = max((one for one in fits if enough == 1 or one.is_exposure), key=lambda one: one.evidence)
    explained = min(max(one.explained for one in fits) / enough, 1.0)
    response = best.response() if explained >= SETTINGS.explained else Response.rec601()
    probability = torch.stack([one.evidence for one in fits]).softmax(0)
    spread = torch.stack([(one.numbers - best.numbers).square() + one.variances for one in fits])
    deviations = (probability @ spread).sqrt().tolist()
    return response._replace(explained=explained, deviations=tuple(deviations[:5]))


def _shading_terms(where: Float[Tensor, "n 2"]) -> Float[Tensor, "5 n"]:
    """Return the terms of vignetting, off its centre too: 0 in the middle of the image."""
    u, v = where.unbind(-1)
    return torch.stack([u, v, u * u, u * v, v * v])


EXPLANATIONS = tuple(
    (weights, (others, others, gain, gamma, *[shading] * 5))
    for (weights, others), (gain, gamma), shading in product(
        ((REC601, 0.0), (EVEN, 0.0), (EVEN, SETTINGS.prior)),
        ((0.0, 0.0), (SETTINGS.exposure, 0.0), (SETTINGS.exposure, SETTINGS.exposure)),
        (0.0, SETTINGS.vignetting),
    )
)
"""Weights, and the prior deviations, 0 where fixed, of nine parameters: changes of the weights along `HUES`,
logarithms of gain and gamma, shading."""


class _Fit(NamedTuple):
    """Most probable numbers of an explanation: three weights, logarithms of gain and gamma, shading.

    Attributes:
        evidence: logarithm of the explanation's probability, up to a constant.
        numbers: the numbers.
        variances: variances of the numbers.
        explained: share of alpha's variance that they explain.
    """

    evidence: Float[Tensor, ""]
    numbers: Float[Tensor, "10"]
    variances: Float[Tensor, "10"]
    explained: float

    @property
    def is_exposure(self) -> bool:
        """True for Rec. 601's weights without vignetting."""
        return self.numbers[:3].tolist() == list(REC601) and not self.numbers[5:].any()

    def response(self) -> Response:
        """Return the response of these numbers."""
        gain, gamma = self.numbers[3:5].exp().tolist()
        shading = tuple(self.numbers[5:].tolist()) if self.numbers[5:].any() else ()
        return Response(self.numbers[:3], gain, gamma, shading=shading)


class _Groups(NamedTuple):
    """Means of points that are similar in colour and place.

    Attributes:
        x: bands of the points.
        terms: `_shading_terms` of the points.
        share: share of each point in its group's mean.
        y: mean alpha of each group.
        counts: number of points, wrong ones too.
        variance: variance of a group's points about a smooth function of colour and place.
        root: covariance of y's errors, which are differing light and noise, as its Cholesky factor.
    """

    x: Float[Tensor, "3 p"]
    terms: Float[Tensor, "5 p"]
    share: Float[Tensor, "n p"]
    y: Float[Tensor, " n"]
    counts: Float[Tensor, " n"]
    variance: Float[Tensor, " n"]
    root: Float[Tensor, "n n"]

    @classmethod
    def from_points(cls, x: Tensor, y: Tensor, place: Tensor) -> _Groups:
        """Group points about some of them; points that no smooth function explains count little.

        Args:
            x: bands (3, p) of beta.
            y: alpha (p).
            place: places (2, p) in beta, in its width and height from its middle.
        """
        grey, terms = x.mean(0), _shading_terms(place.T)
        design = torch.cat([x, x * grey, terms * grey])
        start = torch.zeros_like(design[:, 0])
        start[:3] = y.median() / grey.median() / 3

        def weigh(rest: Tensor) -> Tensor:
            return cauchy(rest, SETTINGS.outlier * normal_deviation(rest, SETTINGS.least))

        ridge = 1e-6 * len(y) * torch.eye(len(design)).to(y)
        _, rest, weight = robust_least_squares(design, y, start, weigh, precision=ridge)
        points = torch.cat([x, place]).T / SETTINGS.near
        member = one_hot(torch.cdist(points, points[:: -(-len(y) // SETTINGS.groups)]).argmin(1)).T.to(y)
        share = (member * weight / (member @ weight)[:, None]).to_sparse()
        level, variance, centres = share @ (y - rest).clamp(min=0.02), share @ rest.square(), share @ points
        brighter = (level / level.mean()).log()
        alike = torch.exp(-torch.cdist(centres, centres).square() / 2) + torch.outer(brighter, brighter)
        light = SETTINGS.light**2 * torch.outer(level, level) * alike
        noise = (variance + SETTINGS.least**2) / SETTINGS.independent
        root = torch.linalg.cholesky(light + noise.diag())
        return cls(x, terms, share, share @ y, member.sum(1), variance, root)

    def seen(self, numbers: Float[Tensor, "10"]) -> Float[Tensor, "11 n"]:
        """Return alpha by the numbers of a response, and its derivatives by them."""
        weights, gamma = numbers[:3], numbers[4].exp()
        powers = gamma * (self.x.log() + numbers[5:] @ self.terms)
        bands = (numbers[3] + powers).exp()
        alpha, bent = weights @ torch.stack([bands, bands * powers])
        seen = torch.cat([alpha[None], bands, alpha[None], bent[None], gamma * alpha * self.terms])
        return (self.share @ seen.T).T

    def fitted(self, weights: tuple[float, ...], deviations: tuple[float, ...]) -> _Fit:
        """Fit the free parameters of an explanation (one of `EXPLANATIONS`) by Gauss-Newton steps."""
        mean = self.y.new_tensor((*weights, *[0] * 7))
        change = torch.block_diag(HUES, torch.eye(7).to(HUES)) * mean.new_tensor(deviations)
        scaled, prior, ones = mean.new_zeros(9), torch.eye(9).to(mean), torch.ones_like(self.y)
        if deviations[2]:
            scaled[2] = (self.y.median() / self.seen(mean)[0].median()).log() / deviations[2]
        for _ in range(SETTINGS.steps):
            seen = self.seen(mean + change @ scaled)
            off = self.y - seen[0]
            planes = torch.cat([off[None], change.T @ seen[1:]])
            rest, terms = torch.linalg.solve_triangular(self.root, planes.T, upper=False).T.split([1, 9])
            wanted = rest[0] + scaled @ terms
            scaled = least_squares(terms, wanted, ones, prior)
        information = prior + terms @ terms.T
        squares = (wanted - scaled @ terms).square().sum() + scaled.square().sum()
        unusual = (weights != REC601) + sum(deviations[i] > 0 for i in (2, 3, -1))
        evidence = unusual * math.log(SETTINGS.rare) - (squares + torch.logdet(information)) / 2
        variances = (change @ torch.linalg.inv(information) @ change.T).diagonal()
        # A group of none but unlikely matches is a material that alpha sees otherwise: it counts in full.
        unlike = self.y - self.counts @ self.y / self.counts.sum()
        left, whole = (float(self.counts @ (r.square() + self.variance)) for r in (off, unlike))
        return _Fit(evidence, mean + change @ scaled, variances, max(1 - left / whole, 0.0))


class SpectralMix(NamedTuple):
    """Linear mix of C bands that is most similar to alpha: offset + sum of weights times bands.

    All sums over bands are of sorted summands, so that their order cannot matter at all.

    Attributes:
        weights: weight of each band (B, C).
        offset: offset (B).
        slopes: change of each band (B, C) by a local one of 1 in the mix; less if that explains alpha badly.
        gain: share (B), 0 to 1, of alpha's difference from the mix that is an error of the bands, and not
            another spectrum: alpha's local variance that is explained, or 0 where that is not enough
            (`SETTINGS.explained`), and for the mean of bands (`equal`), of which it is not known.
    """

    weights: Float[Tensor, "b c"]
    offset: Float[Tensor, " b"]
    slopes: Float[Tensor, "b c"]
    gain: Float[Tensor, " b"]

    @classmethod
    def equal(cls, bands: Float[Tensor, "b c _ _"]) -> SpectralMix:
        """Return the mean of the bands."""
        ones = torch.ones(bands.shape[:2], dtype=torch.float64, device=bands.device)
        return cls(ones / bands.shape[1], 0 * ones[:, 0], ones, 0 * ones[:, 0])

    @classmethod
    def fitted(
        cls,
        bands: Float[Tensor, "b c h w"],
        alpha: Float[Tensor, "b 1 h w"],
        weight: Float[Tensor, "b 1 h w"],
    ) -> SpectralMix:
        """Fit the mix most similar to alpha by weighted least squares, relative to local means.

        It is fitted twice, the second time without outliers.

        Args:
            bands: beta's bands at alpha's pixels.
            alpha: alpha, no sharper than the bands.
            weight: weight of each pixel, at least 0.

        Returns:
            The mix for each of the batch, float64.
        """
        parts = [_mix(*tensors) for tensors in zip(bands.double(), alpha.double(), weight.double())]
        return cls(*(torch.stack(tensors) for tensors in zip(*parts)))

    def combined(self, bands: Float[Tensor, "b c h w"]) -> Float[Tensor, "b 1 h w"]:
        """Return the mix of these bands."""
        products = self.weights[:, :, None, None] * bands.double()
        total = products.sort(1).values.sum(1, keepdim=True) + self.offset[:, None, None, None]
        return total.to(bands)

    def rises(self, like: Tensor) -> Float[Tensor, "b c 1 1"]:
        """Return the slopes, in the type of `like`."""
        return self.slopes[:, :, None, None].to(like)

    def reconciled(
        self, bands: Float[Tensor, "b c h w"], alpha: Float[Tensor, "b 1 h w"]
    ) -> Float[Tensor, "b c h w"]:
        """Return the bands corrected so that their mix nears alpha, as far as that is reliable."""
        step = self.gain[:, None, None, None].to(bands) * self.rises(bands)
        return bands + step * (alpha - self.combined(bands))


def _mix(bands: Tensor, alpha: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return weights, offset, slopes and gain for bands (C, h, w) and alpha (1, h, w)."""
    order = bands.flatten(1).sum(1).argsort()
    weight = weight + 1e-6
    x, (y,) = (_beyond_local_mean(planes, weight).flatten(1) for planes in (bands[order], alpha))
    share = (weight / weight.sum()).flatten()
    precision = (SETTINGS.ridge * (share @ x.square().mean(0)) + 1e-12) * torch.eye(len(x)).to(x)
    weights, rest, robust = robust_least_squares(
        x,
        y,
        least_squares(x, y, share, precision),
        lambda rest: share * gaussian(rest, UNLIKE),
        precision=precision,
        steps=1,
    )
    explained = (1 - share @ rest.square() / (share @ y.square()).clamp(min=1e-12)).clamp(min=0)
    # Detail alone, pixels less the mean around them: differences between materials do not count.
    detail = (bands[order] - box_mean(bands[order], 1)).flatten(1)
    mixed = weights @ detail
    slopes = explained * (detail @ (robust * mixed)) / (robust @ mixed.square()).clamp(min=1e-12)
    offset = robust @ (alpha.flatten() - weights @ bands[order].flatten(1)) / robust.sum()
    back = order.argsort()
    return weights[back], offset, slopes[back], explained * (explained >= SETTINGS.explained)


def _beyond_local_mean(planes: Tensor, weight: Tensor) -> Tensor:
    """Return planes (c, h, w) less their weighted mean in wide squares: light of views differs slowly."""
    radius = max(planes.shape[-2:]) // SETTINGS.wide
    return planes - box_mean(planes * weight, radius) / box_mean(weight, radius)
