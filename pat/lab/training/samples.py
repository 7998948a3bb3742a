"""Training samples: layered scenes from photographs, seen by random rigs, recorded by random cameras.

A share may come from rendered scenes, and from stereo pairs with true disparity.

The samples of a step are a pure function of the seed and the number of the step, so that a run continues
where it stopped, and processes share a step without communication.
"""

from __future__ import annotations

import dataclasses
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Generator, Tensor
from torch.nn.functional import interpolate

from arraygeom import Camera, Epipolar, Pair, Pose, ReceptiveField, pixel_grid, rotation_from_vector, sample
from arraygeom.fields import named_field, pinhole_track
from arraygeom.fields.grid import FieldOnGrid
from arraygeom.pixels import HW
from arraygeom.sampling import Sampled
from pat.lab.synthesis.layered import ArrayBatch, LayeredScenes
from pat.lab.synthesis.photos import PhotoBank
from pat.matching.inputs import Inputs
from pat.media.colour import luminance
from pat.sensors import Clip, GaussianBlur, Jitter, Noise, Quantise, Step, augment, record

from .config import RecordingConfig, TrainConfig
from .lenses import LOST, through_lenses
from .scenes import Crops, RenderedCrops
from .stereo import MeasuredPairs

CACHED = 48
"""Number of groups of scenes that are cached to be recorded again."""
FEW = 8
"""Number of cached groups below which a new one is always made."""
SCENE, RECORDING = 0, 1
"""Purposes of random generators, combined with the seed and a number."""


class Sample(NamedTuple):
    """Group of training samples of one batch.

    Attributes:
        alpha: recorded alpha (b, 1, h, w) in 0..1, slightly above 1 at most after a lens.
        betas: recorded betas (b, c, h, w), at alpha's size: three bands of one beta, one of each of several.
        fields: receptive field of each beta at that size.
        ground_truth: image (b, 3, h, w) to be learnt, may exceed 0..1.
        position: true positions (x, y) of alpha's pixels (b, h, w, 2) in each beta at that size; (0, 0) where
            unknown.
        visible: masks (b, h, w), True where that beta sees the point.
    """

    alpha: Tensor
    betas: list[Tensor]
    fields: list[FieldOnGrid]
    ground_truth: Tensor
    position: list[Tensor]
    visible: list[Tensor]

    @property
    def inputs(self) -> Inputs:
        """Inputs of a network."""
        return Inputs.from_images(self.alpha, self.betas, self.fields)


class Planned(NamedTuple):
    """Scenes that a step records.

    Attributes:
        scenes: number of the group of scenes, that of the step that first uses it.
        kind: "rectified" or "general" rigs of layered scenes, "rendered" or "measured".
        dropped: number of the group to drop from the cache; None for none.
    """

    scenes: int
    kind: str
    dropped: int | None


def plan(config: TrainConfig, seed: int) -> Iterator[Planned]:
    """Plan the scenes of each step: new ones, or one of the latest groups again.

    Args:
        config: recipe, for its shares of kinds and `reuse`.
        seed: random seed.

    Yields:
        The plan of each step, from step 0, without end.
    """
    draw = random.Random(seed)
    shares = {name: getattr(config, name) for name in ("rendered", "measured")}
    layered = max(1 - sum(shares.values()), 0.0)
    cached: list[Planned] = []
    for number in range(2**62):
        new = len(cached) < FEW or draw.random() < 1 / config.reuse
        if new:
            kind = "layered"
            if layered < 1:  # drawn only where there is a choice: what ships was trained on these sequences
                kind = draw.choices([*shares, kind], [*shares.values(), layered])[0]
            if kind == "layered":
                kind = "rectified" if draw.random() < config.rectified else "general"
            dropped = cached.pop() if len(cached) > CACHED else None
            cached.insert(0, Planned(number, kind, None))
            yield cached[0]._replace(dropped=dropped.scenes if dropped else None)
        else:
            yield cached[int(draw.random() * len(cached))]


@dataclass
class SampleSource:
    """Samples by number of the step; calling it with a count yields the first group of that many steps.

    A step has one group or more, each a `Sample`. Each call begins at step 0, and yields the same for the
    same seed.

    Attributes:
        config: recipe.
        layered: layered scenes by kind of their rigs, "rectified" and "general"; empty without photographs.
        folders: windows by kind: "rendered" scenes and "measured" pairs, if the recipe has such folders.
        seed: random seed.
        field: receptive field.
        cache: groups of scenes, by (number, group).
    """

    config: TrainConfig
    layered: Mapping[str, LayeredScenes]
    folders: Mapping[str, Crops]
    seed: int
    field: ReceptiveField
    cache: dict[tuple[int, int], ArrayBatch] = dataclasses.field(default_factory=dict)

    def __call__(self, count: int) -> Iterator[Sample]:
        """Yield the first group of the first `count` steps."""
        return (group[0] for group in islice(self.steps([0]), count))

    def steps(self, groups: list[int], *, start: int = 0) -> Iterator[list[Sample]]:
        """Make the samples of some groups, step by step, without end.

        Args:
            groups: numbers of the groups of a step.
            start: number of the first step, from 0.

        Yields:
            The samples of a step, one for each group.

        Raises:
            ValueError: for images that cannot be read, and as the field refuses a pair.
        """
        for step, planned in enumerate(plan(self.config, self.seed)):
            for key in [key for key in self.cache if key[0] == planned.dropped]:
                del self.cache[key]
            if step >= start:
                yield [self.sample(planned, step, group) for group in groups]

    def sample(self, planned: Planned, step: int, group: int) -> Sample:
        """Make one group of one step.

        Args:
            planned: plan of the step.
            step: number of the step, the seed of its degradations.
            group: number of the group within the step.

        Returns:
            The samples; the scenes stay in the cache.

        Raises:
            ValueError: as `steps`.
        """
        if (planned.scenes, group) not in self.cache:
            g = _generator(self.seed, SCENE, planned.scenes, group)
            self.cache[planned.scenes, group] = self._made(planned, g)
        g = _generator(self.seed, RECORDING, step, group)
        scenes = self.cache[planned.scenes, group]
        return degraded(scenes, g, field=self.field, recording=self.config.recording)

    def _made(self, planned: Planned, g: Generator) -> ArrayBatch:
        if planned.kind in self.folders:
            crops = self.folders[planned.kind]
            return crops.sample(self.config.batch, g, number=planned.scenes, betas=self.config.network.betas)
        return self.layered[planned.kind].sample(self.config.batch, g)


def made_ahead(samples: Iterator[list[Sample]]) -> Iterator[list[Sample]]:
    """Yield the same samples, while a thread makes the next step's.

    `samples` must be without end: at its end RuntimeError is raised. Its errors pass.
    """
    with ThreadPoolExecutor(1) as beside:
        coming = beside.submit(next, samples)
        while True:
            given = coming.result()
            coming = beside.submit(next, samples)
            yield given


def scenes(config: TrainConfig, *, device: str = "cpu") -> tuple[SampleSource, SampleSource]:
    """Open a recipe's data, split into training and validation by photographs, scenes and pairs.

    Args:
        device: device of the samples.

    Returns:
        Sources of training and of validation samples.

    Raises:
        ValueError: for no photographs, as in a missing folder, or too few to hold some out, an unknown field,
            and other data that cannot be used.
        OSError: as `photographs`; FileNotFoundError as `source_of`.
    """
    n, layered = config.held_out, config.rendered + config.measured < 1
    bank, unseen = photographs(config) if layered else (None, None)
    learn = source_of(config, bank, config.seed + 1, device, lambda i: i % n != 0)
    return learn, source_of(config, unseen, config.seed + 2, device, lambda i: i % n == 0)


def source_of(
    config: TrainConfig,
    photos: PhotoBank | None,
    seed: int,
    device: str = "cpu",
    choose: Callable[[int], bool] = lambda i: True,
) -> SampleSource:
    """Open a recipe's layered scenes, rendered scenes and measured pairs.

    Args:
        photos: textures of layered scenes; None if all batches come from the recipe's folders.
        seed: random seed of scenes, degradations and the order in which items are used.
        device: device of the samples.
        choose: called with the number of a rendered scene or a pair, returns True to take it.

    Returns:
        The source.

    Raises:
        ValueError: for folders that cannot be used, and an unknown field.
        FileNotFoundError: for a missing folder.
    """
    rectified, general = config.rectified_rigs, config.general_rigs
    how: dict[str, Any] = {"hw": config.hw, "seed": seed, "device": device}
    layered = {
        kind: LayeredScenes(photos, replace(rigs, betas=config.network.betas), **how)
        for kind, rigs in {"rectified": rectified, "general": general}.items()
        if photos is not None
    }
    folders: dict[str, Crops] = {}
    how["choose"] = choose
    if config.rendered_from:
        folders["rendered"] = RenderedCrops(config.rendered_from, resolutions=general.resolutions, **how)
    if config.measured_from:
        folders["measured"] = MeasuredPairs(config.measured_from, resolutions=rectified.resolutions, **how)
    return SampleSource(config, layered, folders, seed, named_field(config.field))


def photographs(config: TrainConfig) -> tuple[PhotoBank, PhotoBank]:
    """Load the recipe's photographs, every `held_out`-th, from the first, for validation.

    Returns:
        Textures for training and for validation, each with patterns and mixtures (`PhotoBank.load`).

    Raises:
        ValueError: if there are none, or too few to hold some out, and for a cache that is none.
        OSError: if an image cannot be read, or the cache not written.
    """
    if not config.photos and not (config.cache and config.cache.exists()):
        raise ValueError("photos: none are given: name folders with images, --photos FOLDER")
    n = config.held_out

    def bank(choose: Callable[[int], bool]) -> PhotoBank:
        return PhotoBank.load(*config.photos, cache=config.cache, seed=config.seed, choose=choose)

    return bank(lambda i: i % n != 0), bank(lambda i: i % n == 0)


def degraded(
    scene: ArrayBatch,
    g: Generator,
    *,
    field: ReceptiveField = Epipolar(),  # noqa: B008
    recording: RecordingConfig = RecordingConfig(),  # noqa: B008
) -> Sample:
    """Record a scene by random cameras: alpha grey, betas in colour (one band each if there are several).

    Args:
        scene: scenes with ground truth, of up to three betas, pinholes.
        g: random generator of the degradations.
        field: receptive field of all betas; one with a method `of_depth` is replaced by what that returns
            for alpha's true depth, (b, h, w) in metres, which no camera knows.
        recording: probabilities of degradations.

    Returns:
        The samples, betas at alpha's size, with the true positions of the cameras as they are, not perturbed.

    Raises:
        ValueError: as the field refuses a pair.
    """
    images, two_views = scene.images, len(scene.images) == 2
    ideal, grey, cameras = images[0], luminance(scene.images[0]), scene.cameras
    alpha = recorded(grey, cameras[0], g, recording).values
    betas, on_grid, position, visible = [], [], [], []
    for i, image in enumerate(images[1:], 1):
        band = image if two_views else image[:, i - 1 : i]
        beta = recorded(band, cameras[i], g, recording, lost=LOST)
        betas.append(enlarged(beta.values, scene.cameras[0].hw))
        if two_views and _chance(recording.paper, g):
            alpha, betas[0], _ = augment(alpha, betas[0], g)
        pair = pair_of(scene, i, g)
        known = getattr(field, "of_depth", lambda depth: field)(scene.depth[0])
        on_grid.append(FieldOnGrid.from_field(known, perturbed(pair, recording.miscalibrated, g)))
        where, seen = transfer(pair, scene.depth[0], scene.depth[i].masked_fill(~beta.valid, torch.nan))
        position.append(where)
        visible.append(seen)
    ground_truth = ideal if recording.ideal else ideal + (alpha - grey)
    return Sample(alpha, betas, on_grid, ground_truth, position, visible)


def recorded(
    image: Tensor, camera: Camera, g: Generator, recording: RecordingConfig, *, lost: float = 0.0
) -> Sampled:
    """Record images by one random camera, possibly through a lens and undistorted.

    Args:
        image: images (b, c, h, w), sRGB in 0..1.
        camera: their cameras, batched (b).
        recording: probabilities of degradations.
        lost: largest share that an undistorted image lacks on each side.

    Returns:
        Images of the same shape; `valid` (b, h, w) is False where the lens saw nothing, else True.
    """

    def record_here(image: Tensor) -> Tensor:
        return record(image, steps(g, recording), g)

    b, _, h, w = image.shape
    if recording.lens and _chance(recording.lens, g):
        return through_lenses(image, camera, record_here, g, lost=lost)
    return Sampled(record_here(image), image.new_ones(b, h, w, dtype=torch.bool))


def steps(g: Generator, recording: RecordingConfig) -> list[Step]:
    """Draw one camera's degradations: gain, blur, noise, each by its own probability; then clipping, 8 bits.

    Returns:
        Steps for `pat.sensors.steps.record`, in order.
    """
    steps: list[Step] = []
    if _chance(recording.gain, g):
        steps.append(Jitter(0.04, 0.04, 0.01))
    if _chance(recording.blur, g):
        steps.append(GaussianBlur(0.3 + float(torch.rand((), generator=g))))
    if _chance(recording.noise, g):
        steps.append(Noise(10 ** (3 + 1.5 * float(torch.rand((), generator=g))), 4.0))
    return [*steps, Clip(), Quantise(8)]


def pair_of(scene: ArrayBatch, beta: int, g: Generator) -> Pair:
    """Make the batched pair of alpha and a beta at alpha's size, with depth bounds looser than the scenes'.

    Args:
        beta: number of the beta, from 1.
        g: random generator of the bounds.

    Returns:
        The pair, float64; the far bound is infinite in about half of the batch.
    """
    near, far = scene.depth_range.double().unbind(-1)
    loose = torch.rand(2, len(near), generator=g, dtype=torch.float64).to(near.device)
    depth = near / (1 + 0.6 * loose[0]), torch.where(loose[1] < 0.5, torch.inf, far * (1 + 2 * loose[1]))
    cameras = [c.to(torch.float64) for c in scene.cameras]
    return Pair(cameras[0], cameras[beta].resize(scene.cameras[0].hw), depth)


def perturbed(pair: Pair, pixels: float, g: Generator) -> Pair:
    """Rotate betas at random, so that points move by about `pixels` (root mean square on each axis).

    Args:
        pair: batched, calibrated pair.
        pixels: displacement, pixels of beta.

    Returns:
        The pair, its beta rotated about its centre, without link; the same pair for 0 pixels.
    """
    if pixels == 0:
        return pair
    alpha, beta = pair.cameras
    drawn = torch.randn(len(beta.K), 3, generator=g, dtype=torch.float64).to(beta.K)
    rotation = rotation_from_vector(drawn * pixels / beta.K[:, :1, 0])
    turned = Pose(rotation, torch.zeros_like(beta.t)) @ beta.cam_from_world
    return Pair(alpha, beta.replace(cam_from_world=turned), pair.depth)


def transfer(pair: Pair, depth: Tensor, beta_depth: Tensor) -> tuple[Tensor, Tensor]:
    """Project alpha's pixels at their true depth into beta, and test visibility by beta's depth (within 2 %).

    Args:
        pair: batched pair of pinhole cameras.
        depth: depth (b, h, w) of alpha, metres; NaN where unknown.
        beta_depth: depth (b, hb, wb) of beta's view at any resolution, metres; NaN where unknown.

    Returns:
        Positions (b, h, w, 2) in beta's pixels, also outside its image or behind it, (0, 0) where unknown;
        and masks (b, h, w), True where visible: nowhere at infinite depth.

    Raises:
        ValueError: for cameras that are not calibrated or have lenses.
    """
    hw = pair.alpha.hw
    track = pinhole_track(pair, pixel_grid(hw, device=depth.device).reshape(1, -1, 2))
    z = depth.reshape(len(depth), -1)
    x = track.at(1 / z)
    expected = (track.a[..., 2] + track.b[..., 2] / z) * z
    native = beta_depth[:, None].reciprocal()
    scale = x.new_tensor([beta_depth.shape[-1] / pair.beta.hw[1], beta_depth.shape[-2] / pair.beta.hw[0]])
    sampled = sample(native, (x + 0.5) * scale - 0.5, interpolation="nearest")
    visible = sampled.valid & ((sampled.values[:, 0] * expected - 1).abs() < 0.02)
    return x.nan_to_num(0.0).reshape(-1, *hw, 2), visible.reshape(-1, *hw)


def alone(sample: Sample, i: int) -> Sample:
    """Return sample `i` of a group, as a batch of one."""

    def one(parts: Sequence[Tensor]) -> list[Tensor]:
        return [tensor if len(tensor) == 1 else tensor[i : i + 1] for tensor in parts]

    alpha, ground_truth = one([sample.alpha, sample.ground_truth])
    on_grid = [f.of_one(i) for f in sample.fields]
    return Sample(alpha, one(sample.betas), on_grid, ground_truth, one(sample.position), one(sample.visible))


def enlarged(image: Float[Tensor, "b c hb wb"], hw: HW) -> Float[Tensor, "b c h w"]:
    """Enlarge images to a (height, width) (bicubic, clipped to 0..1).

    Returns:
        Images (b, c, *hw); the same tensor if the size is unchanged.
    """
    if image.shape[-2:] == hw:
        return image
    return interpolate(image, size=hw, mode="bicubic", align_corners=False).clamp(0, 1)


def _chance(p: float, g: Generator) -> bool:
    return bool(torch.rand((), generator=g) < p)


def _generator(*numbers: int) -> Generator:
    """Random generator seeded by a sequence of numbers."""
    return Generator().manual_seed(int(np.random.SeedSequence(numbers).generate_state(1)[0]))
