"""What the choices of the small network's recipe are worth: loss, parts and numbers, each changed alone.

    python -m tests.benchmarks.bench_recipe --photos ~/images

Every variant is trained from nothing on the same samples, for the same few steps, and validated on the same
held-out scenes. The base is trained with several seeds (of its weights and of its samples): a difference
within their range says nothing. Seconds are of the processor, on one thread, making the samples included.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple
from unittest.mock import patch

import torch
import tyro

from arraygeom.fields import named_field
from pat.evaluation.tables import markdown_header, markdown_row
from pat.networks.weights import load_weights
from pat.synthesis.photos import PhotoBank
from pat.training import loop, losses
from pat.training.config import TrainConfig, load_config
from pat.training.losses import validation
from pat.training.samples import Sample, SampleSource, photographs, source_of
from tests.benchmarks.printed import print_tables, reproducible

NOTHING: Mapping[str, Any] = MappingProxyType({})


class Variant(NamedTuple):
    """Changes to the recipe and to its network; `matching` False leaves the loss on where it looks out."""

    name: str
    recipe: Mapping[str, Any] = NOTHING
    network: Mapping[str, Any] = NOTHING
    matching: bool = True

    def of(self, base: TrainConfig) -> TrainConfig:
        """The recipe."""
        return replace(base, network=replace(base.network, **self.network), **self.recipe)


VARIANTS = (
    Variant("as shipped"),
    Variant("as shipped, seed 1", {"seed": 1}),
    Variant("as shipped, seed 2", {"seed": 2}),
    Variant("loss: PSNR alone", {"loss": "psnr"}),
    Variant("loss: mean square", {"loss": "mse"}),
    Variant("no loss on the match", matching=False),
    Variant("nothing carried within alpha", network={"propagation_steps": ()}),
    Variant("carried once, spacing 3", network={"propagation_steps": (3,)}),
    Variant("luminance free", network={"keep_luminance": False}),
    Variant("window 3 px, 13 taps", network={"window": 3.0, "taps": 13}),
    Variant("half the rate", {"rate": 1e-3}),
    Variant("twice the rate", {"rate": 4e-3}),
    Variant("every scene recorded once", {"reuse": 1.0}),
)
SEEDS = 3
"""How many of the variants, the first, differ in their seed alone."""


@dataclass
class Args:
    photos: tuple[Path, ...]
    """Folders of photographs."""
    cache: Path | None = None
    """File of photographs read before."""
    steps: int = 250
    hw: tuple[int, int] = (96, 192)
    batch: int = 2
    examined: int = 32
    """Batches of held-out scenes."""
    out: Path | None = None
    """Markdown file for the table."""


class Found(NamedTuple):
    """What a variant came to."""

    psnr: float
    matched: float
    seconds: float


class Bench:
    """The photographs and the held-out scenes, which all variants share."""

    def __init__(self, args: Args) -> None:
        names = ("photos", "cache", "steps", "hw", "batch")
        changes: dict[str, Any] = {name: getattr(args, name) for name in names}
        every: dict[str, Any] = {"validate": args.steps, "save": args.steps}
        every |= {"average": args.steps // 5, "warmup": args.steps // 8}
        self.base = replace(load_config("mono-colour-small"), **changes, **every, device="cpu")
        self.bank, unseen = photographs(self.base)
        self.held_out = list(self._source(self.base, unseen, 7)(args.examined))
        self.trained(Variant("kernels compiled", {"steps": 2, "validate": 2}))

    def trained(self, variant: Variant) -> Found:
        """Train and validate one."""
        config = variant.of(self.base)
        sources = self._source(config, self.bank, config.seed + 1), lambda count: self.held_out[:1]
        alone = nullcontext() if variant.matching else patch.object(losses, "match_loss", unmatched)
        with (
            tempfile.TemporaryDirectory() as folder,
            patch.object(loop, "scenes", lambda *_, **__: sources),
            alone,
        ):
            began = time.process_time()
            best = loop.train(replace(config, out=Path(folder)))
            seconds = (time.process_time() - began) / config.steps
            facts = validation(load_weights(best), self.held_out)
        return Found(facts["psnr"], facts["matched"], seconds)

    def _source(self, config: TrainConfig, bank: PhotoBank, seed: int) -> SampleSource:
        return source_of(config, bank, seed, named_field(config.field))


def unmatched(seen: object, given: Sample) -> torch.Tensor:
    """No loss on the match."""
    return given.ground_truth.new_zeros(())


def lines(args: Args) -> Iterator[str]:
    bench = Bench(args)
    h, w = args.hw
    yield (
        f"mono-colour-small, {args.steps} steps of {args.batch} scenes "
        f"of {h} x {w}, from nothing; one thread."
    )
    yield f"Validated on {args.examined * args.batch} scenes of photographs held out.\n"
    yield markdown_header(["variant", "PSNR, dB", "to the base", "matched within 1.5 px", "seconds a step"])
    seeds: list[float] = []
    for number, variant in enumerate(VARIANTS):
        found = bench.trained(variant)
        if number < SEEDS:
            seeds.append(found.psnr)
        gain = f"{found.psnr - seeds[0]:+.2f}"
        yield markdown_row(
            [variant.name, f"{found.psnr:.2f}", gain, f"{found.matched:.1%}", f"{found.seconds:.2f}"]
        )
    span = f"{min(seeds):.2f} to {max(seeds):.2f} dB"
    yield f"\nThe base with {SEEDS} seeds: {span}: differences of that size say nothing."


def main(args: Args) -> None:
    reproducible()
    print_tables("Choices of the small network's recipe", [lines(args)], args.out)


if __name__ == "__main__":
    main(tyro.cli(Args))
