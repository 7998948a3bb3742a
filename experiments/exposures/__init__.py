"""Short exposure - long exposure: four mono cameras, three behind filters, each exposed for its own time.

Alpha has no filter. The filters pass 80 nm about 450, 550 and 600 nm: less than a third of alpha's light,
which longer exposures make up for. The scene's surfaces are lit from very dark to very bright.
"""

from __future__ import annotations

import torch
from torch import Tensor

from arraygeom import Band
from experiments.sensors import Spectral
from experiments.stage import RenderedScene, SystemScene, purpose_generator
from experiments.system import SystemRecording
from pat.media.colour import linear_from_srgb, luminance, srgb_from_linear
from pat.media.raw import light_of
from pat.sensors import Clip, Noise, record

TITLE = "four mono cameras, three filters, four exposures: more range than any one of them has"
REDUCED = 2 / 5
DEPTHS, LAYERS, SEED = (2.2, 11.0), 10, 13
ELECTRONS, READ = 10_500, 4
"""Electrons at white and noise of reading in electrons, of the sensors."""
DARKEST = 0.004
"""Light on the darkest surface, as part of that on the brightest."""
OVER = 3.0
"""Factor of the brightest surface over alpha's white."""
GENERATOR = "still-life"
GAIN = 1.5
"""Light of the rendered scene: the lamp is above alpha's white then."""


def record_scene(stage: SystemScene | RenderedScene) -> SystemRecording:
    """One frame. The ground truth is in alpha's exposure, not clipped at white."""
    rig, alpha = stage.rig, stage.alpha
    raw, bands, lights = {}, {}, {}
    for name in rig.names:
        lit = light(stage, name)
        sensor = rig[name].sensor
        filtered = luminance(lit) if name == alpha else banded(lit, sensor.response)
        exposed = filtered * light_of(sensor, rig[alpha].sensor)
        lights[name] = filtered[0]
        steps, generator = (Noise(ELECTRONS, READ), Clip()), purpose_generator(stage.seed, name)
        raw[name] = [record(exposed, steps, generator)[0]]
        if name != alpha:
            bands[name] = banded(light(stage, alpha), sensor.response)[0]
    ground_truth = srgb_from_linear(torch.cat([bands[name] for name in rig.betas(alpha)]))
    return SystemRecording(raw, [ground_truth], lights)


def light(stage: SystemScene | RenderedScene, name: str) -> Tensor:
    """Linear colours of what a camera sees, 1 being alpha's white."""
    if isinstance(stage, RenderedScene):
        return GAIN * stage.light(name)
    count, g = stage.scene.present.shape[1], purpose_generator(stage.seed, "light")
    lit = DARKEST ** torch.rand(count, generator=g)
    lit[1], lit[2] = 1.0, DARKEST
    strength = stage.seen(name, stage.painted(lit.sqrt().tolist()))[0].square()
    return linear_from_srgb(stage.seen(name)[0]) * strength * OVER


def banded(linear: Tensor, response: object) -> Tensor:
    """Return the light that passes a filter, white staying white."""
    assert isinstance(response, Band)
    return record(linear, (Spectral(response),), torch.Generator())
