"""Wide field - narrow field: a mono telephoto alpha, a wide colour camera behind a mosaic of filters.

Beta has about a tenth of alpha's pixels on what both see, and one colour in each of those: every colour is
propagated to up to 40 pixels. Alpha is focused at 7 m, beta at its hyperfocal distance.
"""

from __future__ import annotations

import torch
from torch import Tensor

from arraygeom import Rig
from experiments.sensors import DecodeSRGB, Mosaic
from experiments.stage import RenderedScene, SystemScene, purpose_generator
from experiments.system import SystemRecording
from pat.media.colour import linear_from_srgb, luminance, srgb_from_linear
from pat.sensors import Clip, GaussianBlur, Noise, record

TITLE = "mono telephoto, and a wide colour camera with 10 times fewer pixels on what both see"
REDUCED = 1 / 8
DEPTHS, LAYERS, SEED = (4.5, 30.0), 10, 13
FOCUS, FOCAL_LENGTH, F_NUMBER, PITCH = 7.0, 0.025, 4.0, 1.85e-6
GENERATOR = "still-life"


def record_scene(stage: SystemScene | RenderedScene) -> SystemRecording:
    """One frame."""
    image, depth = stage.seen("narrow")
    generator = purpose_generator(stage.seed, "record")
    ground_truth = defocused(linear_from_srgb(image), depth, stage.rig)
    tele = record(luminance(ground_truth), (Noise(10_000, 3), Clip()), generator)
    wide = record(stage.seen("wide")[0], (DecodeSRGB(), Noise(6_000, 3), Clip(), Mosaic("RGGB")), generator)
    return SystemRecording({"narrow": [tele[0]], "wide": [wide[0]]}, [srgb_from_linear(ground_truth[0])])


def defocused(image: Tensor, depth: Tensor, rig: Rig) -> Tensor:
    """The image through alpha's lens: blurred by the thin lens's circle for each pixel's depth."""
    scale = rig["narrow"].hw[1] / 4024
    circle = FOCAL_LENGTH**2 / F_NUMBER / (FOCUS - FOCAL_LENGTH) * (depth - FOCUS).abs() / depth
    sigma = circle / PITCH * scale / 4
    steps = torch.linspace(0, float(sigma.max()) + 1e-3, 6)
    stack = [image, *(record(image, (GaussianBlur(float(s)),), torch.Generator()) for s in steps[1:])]
    level = (sigma / steps[-1] * (len(steps) - 1)).clamp(0, len(steps) - 1 - 1e-4)
    low, within = level.floor().long(), level.frac()
    stacked = torch.stack(stack)[:, 0]
    near, far = (stacked.gather(0, i[None, None].expand(1, 3, -1, -1))[0] for i in (low, low + 1))
    return torch.lerp(near, far, within)[None]
