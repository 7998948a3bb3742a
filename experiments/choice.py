"""Training of the choice between disparities: `python -m experiments.choice --photos DIR --stereo DIR`.

First pairs with true disparity are matched, made of photographs and real ones, and what the choice is by is
kept; then it is trained on random windows of those. Everything is exact: the score of a candidate
is to be high if it is near the true disparity.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Generator, Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, pixel_shuffle

from arraygeom import Segments, pixel_grid
from experiments.fit import command, recipe_text
from experiments.training_pairs.samples import KINDS, PairTraining, fused_at_random
from pat.lab.data.pairs import Disparity, StereoPair
from pat.lab.synthesis.rigs import below
from pat.matching.choice import CANDIDATES, SETTINGS, Choice, candidates, features, typical_facts
from pat.matching.inputs import FINE, BetaMatches, Comparison, Inputs, Matches
from pat.matching.match import located_in_one, match
from pat.matching.normalisation import ComparedViews, Normalisation
from pat.media.colour import to_bytes
from pat.networks.guided import GuidedPAT
from pat.support.tensor_files import write_tensors

NEAR = 0.8
"""A candidate so many pixels from the true disparity scores half."""
FAR = 0.05
"""Weight in the score for which all candidates compete, however far off."""
OTHER = 0.35
"""Share of windows whose alpha is of another response than beta, so that brightness tells less."""


@dataclass(frozen=True, kw_only=True)
class ChoiceTraining(PairTraining):
    """A recipe; as many windows are of each kind of pairs that there are."""

    out: Path = Path("runs/choice")
    without: tuple[str, ...] = ()
    """Parts of the names of pairs to leave out, which then say what its certainty is worth."""
    steps: int = 8000
    batch: int = 16
    side: int = 256
    rate: float = 1.5e-3


class Kept(NamedTuple):
    """Samples of a pair for training.

    Attributes:
        alpha: alpha as it was compared, (1, h, w).
        beta: beta as it was compared, (1, h, w).
        disparity: disparity by matching.
        facts: facts of the matches.
        truth: true disparity, 0 where it is not known.
        seen: mask of the pixels whose point beta sees, (1, h, w).
        blurs: blurs of both views, (2,).
    """

    alpha: Tensor
    beta: Tensor
    disparity: Tensor
    facts: Tensor
    truth: Tensor
    seen: Tensor
    blurs: Tensor

    def rows(self, top: int, count: int) -> Kept:
        """Some of all rows; the blurs are the same."""
        half = slice(top // FINE, (top + count) // FINE)
        names = ("alpha", "beta", "disparity", "truth", "seen")
        cut = {n: getattr(self, n)[:, top : top + count] for n in names}
        return Kept(**cut, facts=self.facts[:, half], blurs=self.blurs)

    def upside_down(self) -> Kept:
        """The mirror image."""
        return self._replace(**{n: plane.flip(-2) for n, plane in self._asdict().items() if n != "blurs"})


def train_choice(config: ChoiceTraining) -> Path:
    """Match what is not yet, and train; returns the file of the weights.

    Raises ValueError where there are no photographs, or the folder holds a run of another recipe.
    """
    with config.folder():
        keep = partial(matched, config.network(), without=config.without)
        samples = [[Kept(**sample) for sample in config.kept(kind, keep)] for kind in KINDS]
        choice = Choice().to(config.device)
        config.train(choice, partial(losses, config, samples, choice))
        state = choice.half().state_dict()
        write_tensors(config.out / "best.safetensors", state, {"recipe": recipe_text(config)})
    return config.out / "best.safetensors"


def matched(
    network: GuidedPAT, pair: StereoPair, seed: int, *, without: Sequence[str]
) -> dict[str, Tensor] | None:
    """Match a pair recorded at random, with left as alpha, before anything is chosen.

    Args:
        without: parts of names of pairs to leave out.

    Returns:
        The fields of a `Kept`; None without true disparity, and for pairs that are left out.
    """
    if pair.disparity is None or any(fragment in pair.name for fragment in without):
        return None
    given: list[tuple[ComparedViews, BetaMatches]] = []

    def matcher(inputs: Inputs) -> Matches:
        matches = located_in_one(inputs)
        given.append((matches.comparison.views(inputs.alpha, inputs.betas[0].image), matches))
        return match(inputs)

    truth = fused_at_random(network, pair, seed, matcher=matcher)
    ((views, matches),) = given
    h, w = (n // FINE * FINE for n in truth.shape[1:])
    whole = (views.alpha, views.beta, matches.disparity)
    alpha, beta, disparity = (plane[0, :, :h, :w].half() for plane in whole)
    true_disparity = Disparity(*(plane[:h, :w] for plane in pair.disparity))
    facts = matches.facts[0, :, : h // FINE, : w // FINE].half()
    blurs = torch.tensor(matches.comparison.whole.blurs)[:, 0]
    truth = (true_disparity.value * true_disparity.valid)[None].half()
    visible = true_disparity.regions().seen[None]
    planes = alpha, beta, disparity, facts, truth, visible, blurs
    return Kept(*(plane.contiguous() for plane in planes))._asdict()


def losses(
    config: ChoiceTraining, samples: Sequence[Sequence[Kept]], network: Choice, start: int
) -> Iterator[Tensor]:
    """Yield the loss of each step from one on.

    It has the cross-entropy of the candidates' nearness to the true disparity, that of the statement that the
    best one is right, and the excess or lack of the stated error.
    """
    for _, windows in config.windows(samples, "choice", start, window):
        inputs, options, truth, visible = (torch.cat(parts).to(config.device) for parts in zip(*windows))
        with config.autocast():
            answer = pixel_shuffle(network(inputs).float().flatten(1, 2), FINE)
            scores, logit, width = answer.split([CANDIDATES, 1, 1], 1)
        apart = (options - truth).abs()
        near = (1 - FAR) / (1 + (apart / NEAR) ** 4) + FAR / (1 + apart)
        wrong = -(scores.log_softmax(1) + near.log()).logsumexp(1, keepdim=True)
        off = apart.gather(1, scores.argmax(1, keepdim=True))
        stated = binary_cross_entropy_with_logits(logit, (visible & (off <= 1)).to(logit), reduction="none")
        beyond = off.clamp(min=0.02).log() - width
        interval = torch.maximum(SETTINGS.covered * beyond, (SETTINGS.covered - 1) * beyond)
        yield (wrong + 0.5 * (stated + interval))[truth > 0].mean()


def window(one: Kept, side: int, g: Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Features, candidates, true disparities and what beta sees of a random square; in three of ten cases at
    alpha's left."""
    h, w = one.alpha.shape[-2:]
    one = one.rows(FINE * below((h - side) // FINE + 1, g), side)
    one = one.upside_down() if below(2, g) else one
    alpha, beta, disparity, facts, truth = (plane.float()[None] for plane in one[:-2])
    visible = one.seen[None]
    level = Normalisation(torch.zeros(3, 1, 1, 1, 1), ([float(one.blurs[0])], [float(one.blurs[1])]))
    matches = BetaMatches(disparity, facts, Comparison(None, level, level))
    views = ComparedViews(another_response(alpha, g), beta, to_bytes(alpha[:, 0]), level.blurs[0])
    options = candidates(matches)
    inputs = features(views, rows_of((side, w)), matches, options, typical_facts(matches))
    x = 0 if below(10, g) < 3 else FINE * below((w - side) // FINE + 1, g)
    half = inputs[..., x // FINE : (x + side) // FINE]
    columns = slice(x, x + side)
    return half, options[..., columns], truth[..., columns], visible[..., columns]


def rows_of(hw: tuple[int, int]) -> Segments:
    """Segments of rectified pixels, alpha on the left."""
    end = pixel_grid(hw)[None]
    start = end - end.new_tensor([float(hw[1]), 0.0])
    return Segments(start, end, torch.ones(end.shape[:-1], dtype=torch.bool))


def another_response(alpha: Float[Tensor, "b 1 h w"], g: Generator) -> Float[Tensor, "b 1 h w"]:
    """Some images with other curves, not even rising."""
    share, often, phase, other = torch.rand(4, generator=g).tolist()
    if other > OTHER:
        return alpha
    curved = alpha + 0.35 * torch.sin(2 * math.pi * ((0.4 + 1.6 * often) * alpha + phase))
    return torch.lerp(alpha, curved, share)


if __name__ == "__main__":
    command(train_choice, ChoiceTraining, "python -m experiments.choice")
