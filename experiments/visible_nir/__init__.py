"""Visible - near infrared: alpha sees 800 to 1000 nm, beta colours; the same materials differ in each.

The weights were not trained on near infrared. Here each surface has a near-infrared reflectance of its own:
the farthest (the sky) is dark, some are brighter than in visible light, in some the pattern is reversed.
Distance hazes the visible image alone. The ground truth is alpha's brightness with the colour differences of
beta at alpha's view.
"""

from __future__ import annotations

import torch

from experiments.stage import RenderedScene, SystemScene, purpose_generator
from experiments.system import SystemRecording
from pat.media.colour import from_luma_chroma, linear_from_srgb, srgb_from_linear, to_luma_chroma
from pat.sensors import Clip, Noise, record

TITLE = "near infrared alpha, colour beta: the same materials look different"
REDUCED = 1 / 5
DEPTHS, LAYERS, SEED = (12.0, 150.0), 10, 10
HAZE = 0.002
"""Part of the light lost in a metre."""
GENERATOR = "landscape"


def record_scene(stage: SystemScene | RenderedScene) -> SystemRecording:
    """One frame."""
    generator = purpose_generator(stage.seed, "record")
    if isinstance(stage, RenderedScene):
        infrared = stage.infrared("nir")
    else:
        infrared = linear_from_srgb(stage.seen("nir", stage.mixed(infrared_weights(stage)))[0][:, :1])
    nir_view, colour_view = (hazed(*stage.seen(name)) for name in ("nir", "colour"))
    nir = record(infrared, (Noise(8_000, 4), Clip()), generator)
    colour = record(colour_view, (Noise(6_000, 3), Clip()), generator)
    chroma = to_luma_chroma(srgb_from_linear(nir_view[0]))[1]
    ground_truth = from_luma_chroma(srgb_from_linear(infrared[0]), chroma)
    return SystemRecording({"nir": [nir[0]], "colour": [colour[0]]}, [ground_truth.clamp(0, 1)])


def infrared_weights(stage: SystemScene) -> torch.Tensor:
    """For each layer: weights of its visible colours in its near infrared, and an offset."""
    count, g = stage.scene.present.shape[1], purpose_generator(stage.seed, "infrared")
    mixture = torch.rand(count, 3, generator=g)
    contrast = torch.where(torch.rand(count, 1, generator=g) < 0.25, -0.6, 0.9)
    weights = contrast * mixture / mixture.sum(1, keepdim=True)
    offset = torch.where(contrast < 0, 0.75, 0.0) + 0.25 * torch.rand(count, 1, generator=g)
    weights = torch.cat([weights, offset], 1)
    weights[0] *= 0.4
    return weights


def hazed(image: torch.Tensor, depth: torch.Tensor) -> torch.Tensor:
    """Linear light of a visible image, with the airlight added by distance."""
    clear = linear_from_srgb(image)
    return torch.lerp(torch.full_like(clear, 0.6), clear, torch.exp(-HAZE * depth))
