"""High frame rate - low frame rate: a fast mono alpha, three slow filtered cameras, an object that moves.

No two clocks agree. Every frame of alpha gets colour from the slow frames nearest in time
(`pat.fusion.sequence`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import torch
from torch import Tensor

from experiments.exposures import banded
from experiments.stage import RenderedScene, SystemScene, purpose_generator
from experiments.system import SystemRecording
from pat.media.colour import linear_from_srgb, luminance, srgb_from_linear
from pat.sensors import Clip, Noise, record

TITLE = "fast mono alpha, three slow cameras with filters, not synchronised; an object moves"
REDUCED = 1 / 4
DEPTHS, LAYERS, SEED = (2.2, 9.0), 9, 14
FRAMES = 11
SPEED = 18.0
"""Speed of the object, per cent of alpha's width in the time of a slow frame."""
GENERATOR = "still-life"
MOVING = 0.12
"""Seconds in which the ball of the rendered scene crosses the image."""


def record_scene(stage: SystemScene | RenderedScene) -> SystemRecording:
    """Eleven frames of alpha, and of each beta those of that time."""
    rig, generator = stage.rig, purpose_generator(stage.seed, "record")
    raw: dict[str, list[Tensor]] = {name: [] for name in rig.names}
    ground_truth = []
    for name, frames in lights(stage).items():
        for lit in frames:
            filtered = luminance(lit) if name == stage.alpha else banded(lit, rig[name].sensor.response)
            raw[name].append(record(filtered, (Noise(8_000, 4), Clip()), generator)[0])
            if name == stage.alpha:
                bands = [banded(lit, rig[b].sensor.response)[0] for b in rig.betas(name)]
                ground_truth.append(srgb_from_linear(torch.cat(bands)))
    return SystemRecording(raw, ground_truth)


def lights(stage: SystemScene | RenderedScene) -> Mapping[str, Iterable[Tensor]]:
    """The linear colours that each camera receives, frame by frame."""
    if isinstance(stage, RenderedScene):
        return {
            name: [stage.light(name, i).clamp(0, 1) for i in range(len(frames))]
            for name, frames in stage.frames.items()
        }
    velocity, layer = object_velocity(stage)

    def layered(name: str) -> Iterator[Tensor]:
        for time in frame_times(stage, name):
            yield linear_from_srgb(stage.seen(name, stage.moved(layer, velocity * time))[0])

    return {name: layered(name) for name in stage.rig.names}


def frame_times(stage: SystemScene, name: str) -> list[float]:
    """The times at which a camera records, seconds, for as long as alpha does."""
    sensor, alpha_sensor = (stage.rig[n].sensor for n in (name, stage.alpha))
    rate, last = sensor.frame_rate or 1.0, (FRAMES - 1) / (alpha_sensor.frame_rate or 1.0)
    return [t for i in range(FRAMES) if (t := sensor.time_offset + i / rate) <= last + 0.5 / rate]


def object_velocity(stage: SystemScene) -> tuple[Tensor, int]:
    """Metres a second in alpha's frame, and which layer moves: one of about a seventh of the image."""
    free = stage.shares() * (~stage.scene.solid[0])
    layer = int((free - 0.14).abs().argmin())
    depth = float(stage.seen(stage.alpha)[1].median())
    camera = stage.camera(stage.alpha)
    across = SPEED / 100 * camera.hw[1] * 30.0 * depth / float(camera.K[0, 0, 0])
    return torch.tensor([across, 0.15 * across, 0.0], dtype=torch.float64), layer
