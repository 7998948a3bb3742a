"""Pairs that the choice between disparities learns from, and their recording and fusion at random."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Generator, Tensor

from experiments.evaluation.halves import of_half
from experiments.fit import Recipe
from pat.fusion.fuse import FuseSettings
from pat.lab.data.pairs import StereoPair, folder_pairs, middlebury_pairs
from pat.lab.evaluation.protocols import mono_colour_task, rectified_fusion
from pat.lab.synthesis.rigs import below
from pat.matching.match import Matcher, match
from pat.networks.guided import GuidedPAT
from pat.networks.weights import load_weights
from pat.sensors import generator_for
from pat.sensors.noise_level import NoiseLevel
from pat.support.folders import files_below
from pat.support.tensor_files import read_tensors, write_tensors

from .pairs import mirrored, photo_pair, varied_pair
from .shapes import shape_pair

S, W = TypeVar("S"), TypeVar("W")
Made = partial[StereoPair]
"""A pair that is made when it is called."""
RATES = (1, 2, 2, 2, 4, 4, 8)
"""Factors by which beta is reduced, one of them at random."""
NOISY = 0.15
"""Share of recordings in low light, 50 to 2,000 electrons at white."""
READ_NOISE = 2.0
KINDS = ("pairs", "shapes", "photos")
"""Real pairs, real shapes in other textures, photographs cut into surfaces."""


@dataclass(frozen=True, kw_only=True)
class PairTraining(Recipe):
    """Options of training on pairs."""

    photos: tuple[Path, ...] = ()
    """Folders of photographs."""
    stereo: Path | None = None
    """Folder of Middlebury's pairs; those of the tune half are used."""
    others: tuple[Path, ...] = ()
    """Folders of other pairs, of the tune half too."""
    captured: int = 700
    """Photographs' pairs that are fused."""
    shaped: int = 540
    """Real shapes in other textures."""
    varied: int = 520
    """And real pairs, in other colours and sizes."""
    fusion: str = "mono-colour"
    """Weights of the fusion that what is learned is for."""

    def network(self) -> GuidedPAT:
        """Return the network that fuses the pairs."""
        network = load_weights(self.fusion)
        assert isinstance(network, GuidedPAT)
        return network

    def pairs(self, kind: str) -> Iterator[Made]:
        """Yield the pairs of one of the `KINDS`.

        Raises:
            ValueError: where there are no photographs.
        """
        return {"pairs": self._real_pairs, "shapes": self._shape_pairs, "photos": self._photo_pairs}[kind]()

    def kept(
        self, kind: str, make: Callable[[StereoPair, int], Mapping[str, Tensor] | None]
    ) -> list[dict[str, Tensor]]:
        """Return the results of `make` for each pair of a kind and its number.

        Results that the run's folder does not hold yet are computed; None leaves a pair out.
        """
        samples = []
        for i, pair in enumerate(self.pairs(kind)):
            file = self.out / kind / f"{i:05}.safetensors"
            if not file.exists():
                made = make(pair(), i)
                if made is None:
                    continue
                write_tensors(file, made)
            samples.append(read_tensors(file)[0])
        return samples

    def windows(
        self,
        samples: Sequence[Sequence[S]],
        purpose: str,
        start: int,
        window: Callable[[S, int, Generator], W],
    ) -> Iterator[tuple[Generator, list[W]]]:
        """Yield for each step from one on the randomness, and windows of samples, as many of each kind."""
        kinds = [some for some in samples if some]
        for step in itertools.count(start):
            g = generator_for(self.seed, purpose, step)
            of = (kinds[i % len(kinds)] for i in range(self.batch))
            yield g, [window(some[below(len(some), g)], self.side, g) for some in of]

    def _photo_pairs(self) -> Iterator[Made]:
        files = self._photographs()
        for i in range(self.captured):
            other = int(np.random.default_rng(i).integers(len(files)))
            yield partial(photo_pair, files[i % len(files)], files[other], i)

    def _shape_pairs(self) -> Iterator[Made]:
        files, pairs = self._photographs(), self._middlebury()
        for i in range(self.shaped if pairs else 0):
            yield partial(shape_pair, pairs[i % len(pairs)], files, i)

    def _real_pairs(self) -> Iterator[Made]:
        """Each side as alpha, in turns."""
        both = self._middlebury()
        for root in self.others:
            both += [p for one in of_half(folder_pairs(root), "tune") for p in (one, mirrored(one))]
        for i in range(self.varied if both else 0):
            yield partial(varied_pair, both[i % len(both)], i)

    def _photographs(self) -> list[Path]:
        suffixes = {".jpg", ".jpeg", ".png"}
        files = [f for root in self.photos for f in files_below(root) if f.suffix.lower() in suffixes]
        if not files:
            given = ", ".join(map(str, self.photos)) or "no folder"
            raise ValueError(f"no photograph in {given}: check --photos")
        return files

    def _middlebury(self) -> list[StereoPair]:
        pairs = [*of_half(middlebury_pairs(self.stereo), "tune")] if self.stereo else []
        return [pair for one in pairs for pair in (one, mirrored(one, self.stereo))]


def fused_at_random(network: GuidedPAT, pair: StereoPair, seed: int, matcher: Matcher = match) -> Tensor:
    """Fuse a pair recorded at random, left as alpha, its largest disparity known; returns left as it is."""
    assert pair.max_disparity is not None
    rng, g = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    alpha, beta, truth, _ = mono_colour_task(pair, int(rng.choice(RATES)))
    settings = FuseSettings(response="rec601", align=False)
    if rng.random() < NOISY:
        level = NoiseLevel.from_electrons(float(np.exp(rng.uniform(np.log(50), np.log(2000)))), READ_NOISE)
        alpha, beta = (level.recorded(image[None], g)[0] for image in (alpha, beta))
        settings = replace(settings, noise={"alpha": level, "beta": level})
    rectified_fusion(network, settings=settings, matcher=matcher)(alpha, beta, pair.max_disparity)
    return truth
