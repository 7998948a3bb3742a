"""Training on scenes made while training.

Every batch has its own rigs, fields and degradations: layered scenes from photographs, seen by random cameras
through `arraygeom`. The loss is on the fused image, and on the matched positions of networks that report them.

The parts are in `pat.training`: recipes (`config`), samples, losses, checkpoints, the loop.
"""

from __future__ import annotations

from .config import RecordingConfig, TrainConfig, load_config, recipes, save_config
from .loop import train
from .losses import image_loss, match_loss, validation
from .samples import Sample, degraded, pair_of, photographs, scenes, transfer

__all__ = [
    "RecordingConfig",
    "Sample",
    "TrainConfig",
    "degraded",
    "image_loss",
    "load_config",
    "match_loss",
    "pair_of",
    "photographs",
    "recipes",
    "save_config",
    "scenes",
    "train",
    "transfer",
    "validation",
]
