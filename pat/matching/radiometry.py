"""The combination of an RGB beta's bands that alpha sees; of any bands: `spectral_mix`.

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
from operator import itemgetter
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from arraygeom import pixel_grid
from arraygeom.robust import cauchy, normal_deviation, robust_least_squares

from ..media.colour import OPPONENT, REC601
from ..support.settings import physics, size, tuned


@dataclass(frozen=True)
class ResponseSettings:
    """Settings of the fit of alpha's response: priors of cameras, and of how light differs between two views.

    Priors of cameras' properties are standard deviations, not chosen on images.

    `pat lab settings` prints the value of each with its meaning and reason.
    """

    sensor: tuple[float, float, float] = physics(
        (0.33, 0.39, 0.28), "Weights of an unfiltered sensor, which sees more blue than Rec. 601's luma"
    )
    prior: float = tuned(0.2, "Middlebury: standard deviation of weights about these")
    negative: float = physics(0.05, "Of negative weights, which no sensor has")
    exposure: float = physics(0.5, "Of a gain, a share of it: of a stop to either side")
    exchanged: float = physics(0.06, "Of a luma's weights, as of a fit on few colours")
    bend: float = physics(0.35, "Of a gamma's logarithm: from 1 / 2.2 to 2.2 are 2.2 of it to either side")
    vignetting: float = physics(
        0.3, "Of the coefficients of its logarithm: cos^4 of 30 degrees in the corners is .6"
    )
    rare: float = tuned(0.05, "Middlebury: the probability of anything that is not as usual")
    light: float = tuned(0.03, "Middlebury: standard deviation of light between the views, a share of it")
    near: float = tuned(
        0.2, "Middlebury: difference in colour, or in place in widths of beta, where light differs"
    )
    least: float = tuned(0.005, "Middlebury: standard deviation of a point, at least")
    independent: float = tuned(3.0, "Middlebury: a group counts as so many independent points")
    groups: int = size(256, "Groups of alike points, at most; half or twice as many do as well")
    points_of_group: int = size(8, "Points of a group, at least")
    points: tuple[int, int] = size((6000, 300), "Pixels used at most, and the fewest that are enough")
    outlier: float = physics(2.385, "Deviations that count half: 95 % efficient if errors are normal")
    gammas: tuple[float, ...] = size(
        (0.4, 0.5, 0.6, 0.7, 0.77, 0.85, 0.92, 1.0, 1.08, 1.18, 1.3, 1.45, 1.6, 1.8, 2.0, 2.3, 2.6),
        "Gammas that are tried",
    )
    closer: tuple[float, ...] = size(
        (0.08, 0.04, 0.02), "By how much the logarithms of further ones differ from that of the best, in turn"
    )
    steps: int = size(2, "How often vignetting is taken out and looked for again")
    explained: float = tuned(
        0.8,
        "Share of alpha's variance that must be explained: of Middlebury's tune half at least .88 is, "
        "of near infrared at most .73",
    )


SETTINGS = ResponseSettings()
HUES = torch.tensor(OPPONENT[1:], dtype=torch.float64).T
"""Directions in which weights may change while their sum stays, (3, 2), of unit length."""


class Response(NamedTuple):
    """Response of alpha: alpha = weights . (gain * shaded beta^gamma).

    Attributes:
        weights: weights of red, green and blue (3), float64; their sum is 1.
        gain: factor of beta's brightness.
        gamma: power of beta's brightness.
        explained: share of alpha's variance at the matches that any combination of bands explains, 0 to 1,
            also where Rec. 601's was kept; 1 if none was fitted.
        shading: coefficients of u, v, u^2, u v and v^2, the place in beta's width and height from its middle,
            in the logarithm of a gain that corrects beta's vignetting; empty without.
    """

    weights: Float[Tensor, "3"]
    gain: float = 1.0
    gamma: float = 1.0
    explained: float = 1.0
    shading: tuple[float, ...] = ()

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
        """True if this is about the combination that alpha sees."""
        return self.explained >= SETTINGS.explained

    @property
    def exchanged(self) -> bool:
        """True if alpha is the luma of beta with red and blue exchanged, and not that of beta as it is."""
        luma = self.weights.new_tensor(REC601)
        off, other = ((luma - weights).abs().max() for weights in (self.weights, self.weights.flip(0)))
        return self.explains and bool(other < SETTINGS.exchanged < off / 2)

    def __str__(self) -> str:
        red, green, blue = self.weights.tolist()
        gain = "" if self.gain == 1 else f" x {self.gain:.2f}"
        gamma = "" if self.gamma == 1 else f" of beta to the power {self.gamma:.2f}"
        shading = ", of beta freed of vignetting" if self.shading else ""
        return f"alpha is {red:.2f} R + {green:.2f} G + {blue:.2f} B{gain}{gamma}{shading}"

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
        """Return the fused image sheared back: the weights' combination of its colours is alpha."""
        return image - self._shear(image)

    def _shear(self, image: Tensor) -> Tensor:
        change = (self.weights / self.weights.sum() - self.weights.new_tensor(REC601)).to(image)
        return (image * change[:, None, None]).sum(-3, keepdim=True)


ResponseSpec = Literal["fit", "rec601"] | tuple[float, float, float] | Response
"""Statement on alpha's response: its weights of red, green and blue, or that it is to be fitted."""


def stated_response(weights: Sequence[float]) -> Response:
    """Make the response of an alpha that is a known combination of beta's bands.

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

    Luma's weights and others each explain alpha as well as they can, judged by their evidence, the
    probability of alpha under all responses that an explanation allows (MacKay 1992): one that allows more
    must explain more. Light differs between the views as a smooth function of colour and place, and with
    brightness (a Gaussian process, by which Kennedy and O'Hagan 2001 model the lack of a model).

    Args:
        bands: red, green and blue of beta at the points, 0..1; points near black or clipped do not count.
        alpha: alpha at the points.
        where: positions of the points in beta, in its width and height, from its middle, with which
            vignetting is estimated; None without.
        enough: matched pixels as a share of those wanted, 0 to 1. Below 1 wrong ones among them
            could explain anything: only gain and gamma are fitted, and `explained` is divided by it.

    Returns:
        The response, on the CPU; Rec. 601's if that is likeliest, for too few points (`SETTINGS.points`;
        `explained` is 1 then), and where no bands' combination explains alpha (`explains` is False).

    Raises:
        ValueError: for another `enough`.
    """
    if not 0 <= enough <= 1:
        raise ValueError(f"enough is {enough}: give a share of the matches wanted, 0 to 1")
    most, fewest = SETTINGS.points
    step = max(alpha.numel() // most, 1)
    x, y = bands[:, ::step].double().cpu(), alpha[::step].double().cpu()
    place = y.new_zeros(len(y), 2) if where is None else where[::step].double().cpu()
    unclipped = (y > 0.02) & (y < 0.98) & (x > 0.01).all(0) & (x < 0.98).all(0)
    if not enough or int(unclipped.sum()) < fewest:
        return Response.rec601()
    groups = _Groups.from_points(x[:, unclipped], y[unclipped], place[unclipped])
    luma, unlike = groups.most_probable(LUMA), groups.most_probable(UNLIKE)
    best = unlike if enough == 1 and unlike.evidence > luma.evidence else luma
    explanations = [luma, unlike]
    if enough == 1 and where is not None:
        shaded = groups.most_probable(LUMA + UNLIKE, vignetted=True)
        best = shaded if shaded.evidence > best.evidence else best
        explanations.append(shaded)
    explained = min(max(one.response.explained for one in explanations) / enough, 1.0)
    response = best.response if explained >= SETTINGS.explained else Response.rec601()
    return response._replace(explained=explained)


def _shading_terms(where: Float[Tensor, "n 2"]) -> Float[Tensor, "5 n"]:
    """Return the terms of vignetting, off its centre too: 0 in the middle of the image."""
    u, v = where.unbind(-1)
    return torch.stack([u, v, u * u, u * v, v * v])


class _Kind(NamedTuple):
    """A kind of response.

    Attributes:
        weights: weights of the bands.
        others: True if the weights may differ from these.
        gain: True if the gain is free.
    """

    weights: tuple[float, float, float]
    others: bool
    gain: bool

    def evidence(
        self, gram: Float[Tensor, "g m m"], further: Float[Tensor, " s"]
    ) -> tuple[Float[Tensor, " g"], Float[Tensor, "g m-1"]]:
        """Return log-probabilities of alpha by gamma, up to a constant, and the best coefficients.

        `gram`: the inner products of bands, shading and alpha, whitened; `further`: the expected shading.
        """
        bands_and_shades = gram.shape[-1] - 1
        grey = gram.new_zeros(bands_and_shades)
        grey[:3] = gram.new_tensor(self.weights)
        products, with_alpha = gram[:, :-1].split([bands_and_shades, 1], -1)
        gain = gram.new_ones(len(gram))
        if self.gain:
            gain = (grey @ with_alpha)[:, 0] / (grey @ products @ grey)
        mean = gain[:, None] * grey
        mean[:, 3:] = further
        free = [SETTINGS.exposure * grey[:3, None]] * self.gain + [SETTINGS.prior * HUES] * self.others
        width = torch.cat([grey.new_zeros(3, 0), *free], 1)
        shades = SETTINGS.vignetting * torch.eye(len(further)).to(grey)
        root = torch.stack([torch.block_diag(g * width, shades) for g in gain])
        rest = torch.cat([-mean, torch.ones_like(mean[:, :1])], 1)[..., None]
        towards = root.mT @ (gram @ rest)[:, :-1]
        information = torch.eye(root.shape[-1]).to(grey) + root.mT @ products @ root
        change = torch.linalg.solve(information, towards)
        coefficients = mean + (root @ change)[..., 0]
        negative = (coefficients[:, :3] / coefficients[:, :3].sum(-1, keepdim=True)).clamp(max=0)
        misfit = (rest.mT @ gram @ rest - towards.mT @ change)[:, 0, 0]
        misfit = misfit + (negative / SETTINGS.negative).square().sum(-1) + torch.logdet(information)
        return -misfit / 2, coefficients

    def prior(self, gammas: Float[Tensor, " g"]) -> Float[Tensor, " g"]:
        """Return the logarithm of the probability of this kind, by each gamma: 1 where the gain is."""
        unusual = (self.weights != REC601) + self.gain
        others = torch.exp(-(gammas.log() / SETTINGS.bend).square() / 2) * (gammas != 1)
        share = SETTINGS.rare * others / others.sum() * self.gain
        return torch.where(gammas == 1, 1 - SETTINGS.rare, share).log() + unusual * math.log(SETTINGS.rare)

    def response(self, coefficients: Tensor, gamma: float, explained: float) -> Response:
        """Return the response of this kind that has these coefficients of the bands."""
        gain = float(coefficients.sum()) if self.gain else 1.0
        weights = coefficients / gain if self.others else coefficients.new_tensor(self.weights)
        return Response(weights, gain, gamma, explained)


LUMA = tuple(_Kind(REC601, False, gain) for gain in (False, True))
"""Luma; beta exposed as alpha, or otherwise."""
UNLIKE = tuple(
    _Kind(weights, others, gain)
    for weights, others in (((1 / 3, 1 / 3, 1 / 3), False), (SETTINGS.sensor, True))
    for gain in (False, True)
)
"""A sensor without filters, or any other; beta exposed as alpha, or otherwise."""


class _Explanation(NamedTuple):
    """A response, the logarithm of its probability, and the remaining shading."""

    evidence: float
    response: Response
    further: Float[Tensor, "5"]


class _Groups(NamedTuple):
    """Means of points that are similar in colour and place.

    Attributes:
        points: bands and `_shading_terms` of each point, (8, p).
        share: share of each point of its group's weight.
        group: number of each point's group.
        y: alpha of each group.
        level: alpha as a smooth function of colour and place.
        terms: `_shading_terms` of each group.
        counts: number of points, wrong ones too.
        variance: variance of a group's points about the smooth function.
        spread: covariance of y's errors, which are differing light and noise, as its Cholesky factor.
    """

    points: Float[Tensor, "8 p"]
    share: Float[Tensor, " p"]
    group: Int[Tensor, " p"]
    y: Float[Tensor, " n"]
    level: Float[Tensor, " n"]
    terms: Float[Tensor, "5 n"]
    counts: Float[Tensor, " n"]
    variance: Float[Tensor, " n"]
    spread: Float[Tensor, "n n"]

    @classmethod
    def from_points(cls, x: Tensor, y: Tensor, where: Tensor) -> _Groups:
        """Group points alike in colour and place; those that no smooth function explains count little.

        Args:
            x: bands (3, n) of beta.
            y: alpha (n).
            where: places (n, 2) in beta, in its width and height from its middle.
        """
        grey, least = x.mean(0), SETTINGS.least
        design = torch.cat([x, x * grey, x * grey.square(), _shading_terms(where) * grey])
        ridge = 1e-6 * len(y) * torch.eye(len(design)).to(y)
        start = y.new_zeros(len(design))
        start[:3] = y.median() / grey.median() / 3

        def weigh(rest: Tensor) -> Tensor:
            return cauchy(rest, SETTINGS.outlier * normal_deviation(rest, least))

        _, rest, weight = robust_least_squares(design, y, start, weigh, precision=ridge)
        group = _grouped(torch.cat([x, where.T]), SETTINGS.groups)
        weights = torch.bincount(group, weight)
        planes = torch.cat([x, where.T, y[None], (y - rest).clamp(min=0.02)[None]])
        means = torch.stack([torch.bincount(group, weight * plane) for plane in planes]) / weights
        centres, level = means[:5].T / SETTINGS.near, means[6]
        brighter = (level / level.mean()).log()
        alike = torch.exp(-torch.cdist(centres, centres).square() / 2) + brighter[:, None] * brighter
        light = SETTINGS.light**2 * level[:, None] * level * alike
        variance = torch.bincount(group, weight * rest.square()) / weights
        noise = (variance + least**2) / SETTINGS.independent
        spread = torch.linalg.cholesky(light + torch.diag(noise))
        points, terms = torch.cat([x, _shading_terms(where)]), _shading_terms(means[3:5].T)
        counts, share = torch.bincount(group).to(y), weight / weights[group]
        return cls(points, share, group, means[5], level, terms, counts, variance, spread)

    def most_probable(self, kinds: Sequence[_Kind], *, vignetted: bool = False) -> _Explanation:
        """Return the most probable explanation of these kinds, with vignetting or without."""
        shading = self.y.new_zeros(len(self.terms))
        for _ in range(SETTINGS.steps if vignetted else 0):
            shading = shading + self.explained_by(shading, kinds, vignetted=True).further
        return self.explained_by(shading, kinds, vignetted=vignetted)

    def explained_by(self, shading: Tensor, kinds: Sequence[_Kind], *, vignetted: bool) -> _Explanation:
        """Return the most probable `_Explanation` of these kinds after this shading is removed from beta.

        `shading` has the coefficients (s) of `_shading_terms`. Tried without a gamma, and with one if the
        kind's gain is free; if vignetted, also fits what shading is left (`further`, else empty).
        """
        gammas = self.y.new_tensor(SETTINGS.gammas)
        _, gram = self._modelled(gammas, shading, vignetted)
        drawn = -shading if vignetted else shading[:0]
        rare = math.log(SETTINGS.rare if vignetted else 1 - SETTINGS.rare)
        fits = []
        for kind in kinds:
            evidence = kind.evidence(gram, drawn)[0] + kind.prior(gammas) + rare
            for some in (gammas == 1, gammas != 1)[: 1 + kind.gain]:
                best = gammas[some][evidence[some].argmax()]
                fits.append((float(evidence[some].logsumexp(0)), kind, best, int(some.sum()) > 1))
        most, kind, gamma, bent = max(fits, key=itemgetter(0))
        if bent:
            gamma = self._most_probable(gamma, kind, shading, vignetted)
        (model,), there = self._modelled(gamma[None], shading, vignetted)
        (coefficients,) = kind.evidence(there, drawn)[1]
        explained = self._explained_by(coefficients @ model)
        response = kind.response(coefficients[:3], float(gamma), explained)
        response = response._replace(shading=tuple(shading.tolist()) if vignetted else ())
        return _Explanation(most, response, coefficients[3:])

    def _most_probable(
        self, gamma: Float[Tensor, ""], kind: _Kind, shading: Tensor, vignetted: bool
    ) -> Float[Tensor, ""]:
        """Return the gamma of most evidence near this one, by parabolas through the logarithms of three."""
        drawn = -shading if vignetted else shading[:0]
        for step in SETTINGS.closer:
            x = gamma.log() + step * torch.arange(-1.0, 2.0).to(gamma)
            _, gram = self._modelled(x.exp(), shading, vignetted)
            low, middle, high = kind.evidence(gram, drawn)[0] - (x / SETTINGS.bend).square() / 2
            bend = (low + high - 2 * middle).clamp(max=-1e-6)
            gamma = (x[1] + step * ((low - high) / (2 * bend)).clamp(-1, 1)).exp()
        return gamma

    def _modelled(
        self, gammas: Float[Tensor, " g"], shading: Tensor, vignetted: bool
    ) -> tuple[Float[Tensor, "g k n"], Float[Tensor, "g m m"]]:
        """Return the terms of alpha for each gamma, and the inner products of these and alpha, whitened.

        The terms are bands and, if vignetted, further shading.
        """
        gammas, (bands, terms) = gammas[:, None, None], self.points.split([3, 5])
        bands = self.share * (bands * (shading @ terms).exp()) ** gammas
        bands = bands.new_zeros(*bands.shape[:2], len(self.y)).index_add_(-1, self.group, bands)
        model = torch.cat([bands, gammas * self.level * self.terms] if vignetted else [bands], 1)
        both = torch.cat([model, self.y.expand(len(gammas), 1, -1)], 1)
        white = torch.linalg.solve_triangular(self.spread, both.mT, upper=False)
        return model, white.mT @ white

    def _explained_by(self, model: Float[Tensor, " n"]) -> float:
        """Return the share of alpha's variance that a model of the groups explains.

        Wrong matches among a group's points hardly count, but a group of none but unlikely ones is a material
        that alpha sees otherwise.
        """
        unlike = self.y - self.counts @ self.y / self.counts.sum()
        parts = (self.counts @ (residual.square() + self.variance) for residual in (self.y - model, unlike))
        left, whole = map(float, parts)
        return max(1 - left / whole, 0.0)


def _grouped(points: Float[Tensor, "k n"], most: int) -> Int[Tensor, " n"]:
    """Return the number of each point's group, of at most `most`, of points near each other.

    Groups are halves of halves, each cut across where it is widest.
    """
    parts = [torch.arange(points.shape[1])]
    for _ in range(int(math.log2(min(most, points.shape[1] // SETTINGS.points_of_group)))):
        ordered = [
            members[points[points[:, members].std(1).argmax(), members].argsort()] for members in parts
        ]
        parts = [half for members in ordered for half in members.tensor_split(2)]
    group = torch.empty(points.shape[1], dtype=torch.long)
    for label, members in enumerate(parts):
        group[members] = label
    return group
