"""Training on scenes made while training.

Every batch has its own rigs, fields and degradations: layered scenes from photographs, seen by random cameras
through `arraygeom`. The loss is on the fused picture, and, for networks that say where they looked, on that.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import NamedTuple, cast

import torch
from safetensors.torch import load_file
from torch import Generator, Tensor
from torch.nn.functional import avg_pool2d, binary_cross_entropy_with_logits, interpolate
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from arraygeom import Epipolar, Pair, ReceptiveField, pixel_grid, sample
from arraygeom.fields import pinhole_track

from .guided import GuidedPAT, GuidedPATConfig, Seen
from .images import luminance
from .model import Fused, Look
from .sensors import Clip, GaussianBlur, Jitter, Noise, Quantise, Step, augment, paper_cases, record
from .synthesis.layered import ArrayBatch, LayeredScenes
from .synthesis.photos import PhotoBank
from .synthesis.rigs import RigDistribution
from .weights import save_weights

PAPER = 0.3
"""In this share of the batches, one of the paper's four degradations on top."""


KEPT = 48
"""Batches of scenes that wait to be recorded again."""


@dataclass(frozen=True)
class TrainConfig:
    """A recipe. Photographs are read from the folders; `start`, if given, is a file of weights to go on from.

    `steps` of `batch` scenes whose alpha is `hw`, or as many as fit into `minutes`; Adam at `rate`, down to nothing
    along a half cosine. Each batch of scenes is recorded `reuse` times, at random moments, differently. The
    average of the weights over about `average` steps is validated every `validate` steps on scenes from
    photographs held out (every `held_out`-th), and the best is kept. In the share `filtered` of the batches beta
    is three cameras, one a band; in the share `rectified`, rigs are rectified.
    """

    photos: tuple[Path, ...]
    out: Path = Path("runs/mono-colour")
    start: Path | None = None
    network: GuidedPATConfig = field(default_factory=GuidedPATConfig)
    steps: int = 4000
    minutes: float = float("inf")
    batch: int = 4
    hw: tuple[int, int] = (96, 192)
    rate: float = 8e-4
    reuse: float = 2.0
    average: int = 300
    validate: int = 250
    filtered: float = 0.15
    rectified: float = 0.5
    held_out: int = 12
    seed: int = 0
    cache: Path | None = None


class Sample(NamedTuple):
    """What a network is given, what it should answer, and where in each beta it should have looked."""

    alpha: Tensor
    betas: list[Tensor]
    looks: list[Look]
    truth: Tensor
    position: list[Tensor]
    visible: list[Tensor]


def train(config: TrainConfig, *, field: ReceptiveField = Epipolar()) -> Path:  # noqa: B008
    """Train, looking where `field` says; returns the file of the best weights (and writes log.jsonl beside it).

    Raises FloatingPointError if a gradient is not finite; the best weights so far stay.
    """
    torch.manual_seed(config.seed)
    config.out.mkdir(parents=True, exist_ok=True)
    network = GuidedPAT(config.network)
    if config.start is not None:
        own, old = network.state_dict(), load_file(config.start)
        network.load_state_dict(own | {k: v for k, v in old.items() if k in own and own[k].shape == v.shape})
    average = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(1 - 1 / config.average))
    averaged = cast(GuidedPAT, average.module)
    adam = torch.optim.Adam(network.parameters(), lr=config.rate, betas=(0.9, 0.99))
    learn, examine = scenes(config, field=field)
    examination = list(examine(8))
    best, started = -torch.inf, time.monotonic()
    for step, given in enumerate(learn(config.steps), 1):
        done = max(step / config.steps, (time.monotonic() - started) / 60 / config.minutes)
        for group in adam.param_groups:
            group["lr"] = config.rate * min(step / 100, 0.5 + 0.5 * math.cos(math.pi * min(done, 1)))
        fused, seen = network.explain(given.alpha, given.betas, given.looks)
        loss = picture_loss(fused.image, given.truth) + structure_loss(fused.image, given.truth) + match_loss(fused, seen, given)
        adam.zero_grad()
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        if not torch.isfinite(norm):
            raise FloatingPointError(f"the gradient of step {step} is not finite: lower `rate` (now {config.rate})")
        adam.step()
        average.update_parameters(network)
        if step % config.validate == 0 or done >= 1:
            facts = validation(averaged, examination)
            facts |= {"step": step, "loss": float(loss.detach()), "minutes": (time.monotonic() - started) / 60}
            _log(config, facts)
            if facts["psnr"] > best:
                best = facts["psnr"]
                recipe = {"recipe": json.dumps(asdict(config), default=str), "validation": json.dumps(facts)}
                save_weights(averaged, config.out / "best.safetensors", facts=recipe)
        if done >= 1:
            break
    return config.out / "best.safetensors"


def scenes(
    config: TrainConfig,
    *,
    field: ReceptiveField = Epipolar(),  # noqa: B008
) -> tuple[Callable[[int], Iterator[Sample]], Callable[[int], Iterator[Sample]]]:
    """Sources of samples to learn from and to validate on, from different photographs."""
    bank, unseen = photographs(config)
    kinds = {
        "rectified": RigDistribution(mode="rectified", parallax=(6.0, 110.0)),
        "general": RigDistribution(mode="general", parallax=(6.0, 90.0), focal_ratio=(0.8, 1.25)),
    }

    def source(photos: PhotoBank, seed: int) -> Callable[[int], Iterator[Sample]]:
        makers = {
            (kind, betas): LayeredScenes(photos, _with_betas(rigs, betas), hw=config.hw, seed=seed)
            for kind, rigs in kinds.items()
            for betas in (1, 3)
        }

        def samples(count: int) -> Iterator[Sample]:
            g = Generator().manual_seed(seed)
            kept: list[ArrayBatch] = []
            for _ in range(count):
                if len(kept) < 8 or _chance(1 / config.reuse, g):
                    kind = "rectified" if _chance(config.rectified, g) else "general"
                    betas = 3 if _chance(config.filtered, g) else 1
                    kept = [makers[kind, betas].sample(config.batch, g), *kept[:KEPT]]
                    yield degraded(kept[0], g, field=field)
                else:
                    yield degraded(kept[int(torch.randint(len(kept), (), generator=g))], g, field=field)

        return samples

    return source(bank, config.seed + 1), source(unseen, config.seed + 2)


def photographs(config: TrainConfig) -> tuple[PhotoBank, PhotoBank]:
    """Photographs to learn from, and every `held_out`-th for validation."""
    n = config.held_out

    def bank(choose: Callable[[int], bool]) -> PhotoBank:
        return PhotoBank.load(*config.photos, cache=config.cache, seed=config.seed, choose=choose)

    return bank(lambda i: i % n != 0), bank(lambda i: i % n == 0)


def degraded(scene: ArrayBatch, g: Generator, *, field: ReceptiveField = Epipolar()) -> Sample:  # noqa: B008
    """What cameras record of a scene: alpha grey, betas in colour (or a band each), enlarged to alpha's pitch."""
    ideal = scene.images[0]
    alpha = record(luminance(ideal), recording(g), g).image
    betas, looks, position, visible = [], [], [], []
    for i, picture in enumerate(scene.images[1:], 1):
        band = picture if len(scene.images) == 2 else picture[:, i - 1 : i]
        betas.append(_enlarged(record(band, recording(g), g).image, scene.hw[0]))
        if len(scene.images) == 2 and _chance(PAPER, g):
            alpha, betas[0], _ = augment(alpha, betas[0], paper_cases(), g)
        pair = pair_of(scene, i, g)
        looks.append(Look.along(field, pair))
        where, seen = truth_in(pair, scene.depth[0], scene.depth[i])
        position.append(where)
        visible.append(seen)
    truth = ideal + (alpha - luminance(ideal))
    return Sample(alpha, betas, looks, truth, position, visible)


def recording(g: Generator) -> list[Step]:
    """Gain, blur and noise of one camera; each with its own chance."""
    steps: list[Step] = []
    if _chance(0.3, g):
        steps.append(Jitter(0.04, 0.04, 0.01))
    if _chance(0.25, g):
        steps.append(GaussianBlur(0.3 + float(torch.rand((), generator=g))))
    if _chance(0.6, g):
        steps.append(Noise(10 ** (3 + 1.5 * float(torch.rand((), generator=g))), 4.0))
    return [*steps, Clip(), Quantise(8)]


def pair_of(scene: ArrayBatch, beta: int, g: Generator) -> Pair:
    """The batch of pairs (alpha, beta), beta at alpha's pitch, with bounds looser than the scenes' own."""
    near, far = scene.depth_range.double().unbind(-1)
    loose = torch.rand(2, len(near), generator=g, dtype=torch.float64)
    depth = near / (1 + 0.6 * loose[0]), torch.where(loose[1] < 0.5, torch.inf, far * (1 + 2 * loose[1]))
    cameras = [c.to(torch.float64) for c in scene.cameras]
    return Pair(cameras[0], cameras[beta].resize(scene.hw[0]), depth)


def truth_in(pair: Pair, depth: Tensor, beta_depth: Tensor) -> tuple[Tensor, Tensor]:
    """Where alpha's pixels are in beta (B, h, w, 2), and whether beta sees the same surface there (B, h, w)."""
    hw = pair.alpha.hw
    track = pinhole_track(pair, pixel_grid(hw).reshape(1, -1, 2))
    z = depth.reshape(len(depth), -1)
    x = track.at(1 / z)
    expected = (track.a[..., 2] + track.b[..., 2] / z) * z
    native = beta_depth[:, None].reciprocal()
    scale = x.new_tensor([beta_depth.shape[-1] / pair.beta.hw[1], beta_depth.shape[-2] / pair.beta.hw[0]])
    found = sample(native, (x + 0.5) * scale - 0.5, interpolation="nearest")
    visible = found.valid & ((found.values[:, 0] * expected - 1).abs() < 0.02)
    return x.reshape(-1, *hw, 2), visible.reshape(-1, *hw)


def picture_loss(image: Tensor, truth: Tensor) -> Tensor:
    """Minus the mean PSNR over 10, but for a floor under the error: every sample pulls alike."""
    return ((image - truth).square().flatten(1).mean(1) + 1e-5).log10().mean()


def structure_loss(image: Tensor, truth: Tensor) -> Tensor:
    """One minus the mean structural similarity in windows of 7x7 pixels (Wang et al. 2004)."""

    def mean(x: Tensor) -> Tensor:
        return avg_pool2d(x, 7, 1)

    a, b = mean(image), mean(truth)
    spread = mean(image * image) - a * a + mean(truth * truth) - b * b
    common = mean(image * truth) - a * b
    likeness = (2 * a * b + 1e-4) * (2 * common + 9e-4) / ((a * a + b * b + 1e-4) * (spread + 9e-4))
    return 1 - likeness.mean()


def match_loss(fused: Fused, seen: list[Seen], given: Sample) -> Tensor:
    """How far off the looks were where beta sees the point, pixels, and how wrong the confidence."""
    total = fused.image.new_zeros(())
    for told, truth, visible in zip(seen, given.position, given.visible):
        off = (told.attended.position - truth.movedim(-1, 1)).abs().sum(1)
        total = total + 0.02 * (off.clamp(max=6.0) * visible).sum() / visible.sum().clamp(min=1)
        good = (visible & (off.detach() < 1.5)).to(off)
        total = total + 0.05 * binary_cross_entropy_with_logits(told.logit[:, 0], good)
    return total / len(seen)


@torch.no_grad()
def validation(network: GuidedPAT, samples: list[Sample]) -> dict[str, float]:
    """Mean PSNR, and the share of visible pixels matched within a pixel and a half."""
    psnr, near = [], []
    for given in samples:
        fused = network(given.alpha, given.betas, given.looks)
        error = (fused.image.clamp(0, 1) - given.truth).square().flatten(1).mean(1)
        psnr.append(-10 * error.clamp(min=1e-8).log10().mean())
        off = (fused.position[0] - given.position[0].movedim(-1, 1)).norm(dim=1)
        near.append((off[given.visible[0]] < 1.5).float().mean())
    return {"psnr": float(torch.stack(psnr).mean()), "matched": float(torch.stack(near).mean())}


def _enlarged(picture: Tensor, hw: tuple[int, int]) -> Tensor:
    if picture.shape[-2:] == hw:
        return picture
    return interpolate(picture, size=hw, mode="bicubic", align_corners=False).clamp(0, 1)


def _chance(p: float, g: Generator) -> bool:
    return bool(torch.rand((), generator=g) < p)


def _with_betas(rigs: RigDistribution, betas: int) -> RigDistribution:
    return replace(rigs, betas=betas)


def _log(config: TrainConfig, facts: dict[str, float]) -> None:
    line = json.dumps({k: round(v, 4) for k, v in facts.items()})
    print(line, flush=True)
    with (config.out / "log.jsonl").open("a", encoding="utf-8") as file:
        file.write(line + "\n")
