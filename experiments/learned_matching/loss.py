"""The loss of features for matching: cross-entropy of the true position along the segment, or "not seen"."""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Generator, Tensor
from torch.nn.functional import max_pool2d

from pat.matching.cost import BRIGHTNESS as LEVELS
from pat.matching.cost import TRUNCATED

from .features import BITS, MatchingEncoder, Size
from .samples import MatchingSample, TrueMatches

QUERIES = 256
"""Pixels of a view that a step asks for, at either size."""
AROUND, ELSEWHERE = 24, 24
"""At full size: consecutive labels among which the true one is, and labels anywhere on the segment."""
NEAR_EDGES = 0.5
"""Share of the pixels that are drawn near depth's edges, within `EDGE` pixels."""
EDGE, STEP = 4, 2.0
NEVER = -1e4
SIZES: tuple[Size, Size] = ("full", "half")
Precision = Literal["float32", "bfloat16"]


class Queries(NamedTuple):
    """Some of alpha's pixels, (B, n), and where they may be.

    pixel: row by row. label: the true one. seen: whether it is on the segment and seen. labels: (B, n, L) to
    compare; position: (B, n, L), of those in beta, row by row; there: which are on the segment and on beta.
    """

    pixel: Tensor
    label: Tensor
    seen: Tensor
    labels: Tensor
    position: Tensor
    there: Tensor


class MatchingScores(NamedTuple):
    """The loss, and the share of pixels seen whose best label is within a pixel of the same size."""

    loss: Tensor
    within_one: Tensor


def matching_loss(
    encoder: MatchingEncoder, given: MatchingSample, g: Generator, *, precision: Precision = "float32"
) -> tuple[MatchingScores, MatchingScores]:
    """At full size and at half of it. `precision` is that of the encoder's convolutions."""
    queries = {
        "full": drawn_queries(given.matches, g, (AROUND, ELSEWHERE)),
        "half": drawn_queries(given.matches.halved(), g, None),
    }
    found = []
    for i, size in enumerate(SIZES):
        images = getattr(given, size)
        with torch.autocast("cpu", torch.bfloat16, enabled=precision == "bfloat16"):
            alpha = encoder(images.alpha, "alpha", size, images.blur)
            beta = encoder(images.beta, "beta", size, images.blur)
        unlike = unlike_bits(alpha, beta, queries[size])
        unlike = unlike + unlike_brightness(images.alpha, images.beta, queries[size])
        found.append(scores(unlike, queries[size], encoder.sharpness[i], encoder.unseen[i]))
    return found[0], found[1]


def drawn_queries(matches: TrueMatches, g: Generator, window: tuple[int, int] | None) -> Queries:
    """Random pixels whose matches are known, many of them near depth's edges, with all their labels; with a
    `window`, so many around the true label and so many drawn from the segment."""
    b, h, w = matches.label.shape
    pixel = torch.multinomial(_weights(matches), QUERIES, replacement=True, generator=g)
    end, along, length, label, seen, _ = (x.flatten(1, 2) for x in matches)
    rows = torch.arange(b)[:, None]
    end, along, length, label, seen = (x[rows, pixel] for x in (end, along, length, label, seen))
    labels, new = _labels(label, length, g, window)
    at = (end[..., None, :] + labels[..., None] * along[..., None, :] + 0.5).floor().long()
    x, y = at.unbind(-1)
    there = new & (labels <= length[..., None] + 0.5) & (x >= 0) & (y >= 0) & (x < w) & (y < h)
    position = torch.where(there, y * w + x, 0)
    return Queries(pixel, label, seen & (label > -0.5) & (label < length + 0.5), labels, position, there)


def _labels(
    label: Tensor,
    length: Tensor,
    g: Generator,
    window: tuple[int, int] | None,
) -> tuple[Tensor, Tensor]:
    """Labels (B, n, L), and which of them are not there twice, nor negative."""
    if window is None:
        labels = torch.arange(int(max(float(length.max()), 0)) + 2.0).expand(*label.shape, -1)
        return labels, torch.ones_like(labels, dtype=torch.bool)
    around, elsewhere = window
    first = label.floor() - torch.randint(1, around - 2, label.shape, generator=g)
    near = first[..., None] + torch.arange(around)
    far = (torch.rand(*label.shape, elsewhere, generator=g) * (length.clamp(min=0)[..., None] + 1)).floor()
    new = (far < near[..., :1]) | (far > near[..., -1:])
    return torch.cat([near, far], -1), torch.cat([near >= 0, new], -1)


def _weights(matches: TrueMatches) -> Float[Tensor, "b n"]:
    """How likely each pixel is drawn: half of the draws are near depth's edges."""
    known = (matches.known & (matches.length > 2)).float()
    label = matches.label[:, None]
    spread = max_pool2d(label, 2 * EDGE + 1, 1, EDGE) + max_pool2d(-label, 2 * EDGE + 1, 1, EDGE)
    edge = known * (spread[:, 0] > STEP)

    def share(x: Tensor) -> Tensor:
        return x.flatten(1) / x.flatten(1).sum(1, keepdim=True).clamp(min=1)

    return share(known) + NEAR_EDGES / (1 - NEAR_EDGES) * share(edge) + 1e-9


def unlike_bits(alpha: Tensor, beta: Tensor, queries: Queries) -> Float[Tensor, "b n l"]:
    """In how many bits alpha's pixels and beta's at each label differ, by features (B, 64, h, w)."""
    rows = torch.arange(len(alpha))[:, None]
    query = signs(alpha.flatten(2).mT[rows, queries.pixel].float())
    key = signs(beta.flatten(2).mT.float())[rows[..., None], queries.position]
    return (BITS - torch.einsum("bnd,bnld->bnl", query, key)) / 2


def unlike_brightness(alpha: Tensor, beta: Tensor, queries: Queries) -> Float[Tensor, "b n l"]:
    """What a difference of brightness (B, 1, h, w) costs, in bits, as in matching."""
    rows = torch.arange(len(alpha))[:, None]
    own, other = alpha.flatten(1)[rows, queries.pixel], beta.flatten(1)[rows[..., None], queries.position]
    return (float(LEVELS) * (own[..., None] - other).abs()).clamp(max=float(TRUNCATED))


def scores(
    unlike: Float[Tensor, "b n l"],
    queries: Queries,
    sharpness: Tensor,
    unseen: Tensor,
) -> MatchingScores:
    """The loss of these queries by how unlike the pixels at each label are, in bits."""
    scale = sharpness.exp()
    logits = torch.where(queries.there, -scale * unlike, NEVER)
    nowhere = (-scale * unseen).expand(*logits.shape[:2], 1)
    target = _target(queries)
    loss = -(target * torch.cat([logits, nowhere], -1).log_softmax(-1)).sum(-1).mean()
    best = queries.labels.gather(-1, logits.argmax(-1, keepdim=True))[..., 0]
    seen = target[..., -1] < 1
    return MatchingScores(loss, ((best - queries.label).abs() <= 1)[seen].float().mean().detach())


def _target(queries: Queries) -> Float[Tensor, "b n l"]:
    """What the distribution should be: true positions shared by labels beside them; the last for unseen."""
    share = (1 - (queries.labels - queries.label[..., None]).abs()).clamp(min=0)
    share = share * queries.there * queries.seen[..., None]
    total = share.sum(-1, keepdim=True)
    share = share / total.clamp(min=1e-6)
    return torch.cat([share, (total <= 1e-6).to(share)], -1)


def signs(x: Tensor) -> Tensor:
    """1 or -1, with the gradient of tanh."""
    smooth = x.tanh()
    return smooth + (torch.where(x > 0, 1.0, -1.0) - smooth).detach()
