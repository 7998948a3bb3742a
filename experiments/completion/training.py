"""Training of the completion: `python -m experiments.completion.training --photos DIR --stereo DIR`.

First frames are fused and what the completion is given is kept, of each kind of pairs (`samples.KINDS`);
then it is trained on random windows of those. The weights are the fusion's with it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from experiments.evaluation.certainty import unseeing
from experiments.fit import command, recipe_text
from pat.lab.data.pairs import StereoPair
from pat.lab.synthesis.rigs import below
from pat.lab.training.losses import image_loss
from pat.matching.match import match
from pat.media.colour import from_luma_chroma
from pat.networks.completion import CANDIDATES, Completion, features
from pat.networks.guided import GuidedPAT
from pat.networks.weights import save_weights

from .capture import captured, levels, values
from .samples import KINDS, PairTraining


@dataclass(frozen=True, kw_only=True)
class CompletionTraining(PairTraining):
    """A recipe; as many windows are of each kind of pairs that there are."""

    out: Path = Path("runs/completion")
    widths: tuple[int, int, int] = (64, 96, 128)
    """Channels at 1/2, 1/4 and 1/8 of the size."""
    choices: tuple[Path, ...] = ()
    """Files of choices between disparities trained without some pairs (`--without`): of a pair, what the one
    that has not seen it gives is learned."""
    steps: int = 8000
    batch: int = 16
    side: int = 256


def train_completion(config: CompletionTraining) -> Path:
    """Capture what is not yet, and train; returns the file of the weights.

    Raises ValueError where there are no photographs, or the folder holds a run of another recipe.
    """
    with config.folder():
        network = config.network()
        frames = [
            [sample["planes"] for sample in config.kept(kind, partial(planes_of, config, network, kind))]
            for kind in KINDS
        ]
        completion = Completion(config.widths).to(config.device)
        config.train(completion, partial(losses, config, frames, completion))
        made = GuidedPAT(replace(network.config, completion=config.widths))
        network.completion = completion
        made.load_state_dict(network.state_dict())
        assert made.completion is not None
        made.completion.half()
        save_weights(made, config.out / "best.safetensors", facts={"recipe": recipe_text(config)})
    return config.out / "best.safetensors"


def planes_of(
    config: CompletionTraining, network: GuidedPAT, kind: str, pair: StereoPair, seed: int
) -> dict[str, Tensor]:
    """What is kept of a pair of a kind."""
    learned = config.choices and kind in ("pairs", "shapes") and pair.disparity is not None
    best = unseeing(config.choices, pair.name) if learned else None
    return {"planes": levels(captured(network, pair, seed, partial(match, choice=best)))}


def losses(
    config: CompletionTraining,
    frames: Sequence[Sequence[Tensor]],
    network: Completion,
    start: int,
) -> Iterator[Tensor]:
    """Of each step from one on: minus the mean PSNR of windows, as `image_loss`."""
    for g, parts in config.windows(frames, "completion", start, window):
        planes = varied(torch.stack(parts), g).to(config.device)
        facts, truth = torch.cat([planes[:, :2], planes[:, 4:]], 1), planes[:, 2:4]
        inputs = features(facts[:, :1], facts[:, 1:2], [facts[:, 2:]])
        with config.autocast():
            answer = network.answer(inputs).float()
        added, shares = answer.split([2, CANDIDATES], 1)
        _, confidence, mixed, apart = facts.split([1, 1, 2, 2 * CANDIDATES], 1)
        change = (shares[:, :, None] * apart.unflatten(1, (-1, 2))).sum(1) + (1 - confidence) * added
        yield image_loss(*(from_luma_chroma(0 * confidence, c) for c in (mixed + change, truth)))


def window(frame: Tensor, side: int, g: Generator) -> Float[Tensor, "p n n"]:
    """A random part of a frame; in three of ten cases at alpha's left, which no beta sees."""
    y, x = (below(n - side + 1, g) for n in frame.shape[1:])
    x = 0 if below(10, g) < 3 else x
    return values(frame[:, y : y + side, x : x + side])


def varied(planes: Float[Tensor, "b p n n"], g: Generator) -> Float[Tensor, "b p n n"]:
    """Flipped and transposed; colours of half of them of another hue, and all more or less saturated."""
    for axes in ((-1,), (-2,)):
        planes = planes.flip(axes) if below(2, g) else planes
    planes = planes.mT if below(2, g) else planes
    light, chroma = planes.split([2, planes.shape[1] - 2], 1)
    b = len(planes)
    angle = 2 * math.pi * torch.rand(b, generator=g) * torch.randint(2, (b,), generator=g)
    size = (0.8 * torch.rand(b, generator=g) - 0.4).exp()
    c, s = size * angle.cos(), size * angle.sin()
    root = hue_axes()
    turned = root.T @ torch.stack([torch.stack([c, -s], -1), torch.stack([s, c], -1)], -2) @ root.T.inverse()
    turned_chroma = torch.einsum("bij,bkjyx->bkiyx", turned, chroma.unflatten(1, (-1, 2))).flatten(1, 2)
    return torch.cat([light, turned_chroma], 1)


def hue_axes() -> Float[Tensor, "2 2"]:
    """Axes of chroma whose squares add up to those of red, green and blue: the inverse of that root."""
    rgb = from_luma_chroma(torch.zeros(1, 1, 2), torch.eye(2)[:, None])[:, 0]
    return torch.linalg.cholesky(rgb.T @ rgb).inverse()


if __name__ == "__main__":
    command(train_completion, CompletionTraining, "python -m experiments.completion.training")
