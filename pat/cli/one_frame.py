"""One frame fused with what is done, and how far it is, on the terminal."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, Literal

from . import options
from .options import say

if TYPE_CHECKING:
    from torch import Tensor

    from arraygeom import Rig
    from arraygeom.chunks import Tile

    from ..fusion.results import Frame
    from ..fusion.tiles import Plan

LOG = logging.getLogger(__name__)


def fuse_with_progress(
    weights: str,
    rig: Rig,
    images: Mapping[str, Tensor],
    *,
    device: str = "cpu",
    precision: Literal["float32", "bfloat16"] = "float32",
    **further: Any,
) -> Frame:
    """`fuse` with weights by name, the plan and a bar on the terminal. The frame is on the CPU."""
    from ..fusion.fuse import fuse
    from ..networks.weights import load_weights

    where = options.device_of(device)
    network = load_weights(weights, precision=precision).to(where)
    if where != "cpu":
        rig, images = rig.to(where), {name: image.to(where) for name, image in images.items()}
    options.say_when_compiling()
    with options.working("fusing") as retitle:

        def announce(plan: Plan) -> None:
            say(f"plan: {plan}")
            retitle("fusing" if plan.seconds is None else f"fusing, about {plan.duration} in all")

        frame = fuse(network, rig, images, progress=_numbered, announce=announce, **further)
    return frame.mapped(lambda part: part.cpu())


def _numbered(tiles: Iterable[Tile], count: int) -> Iterator[Tile]:
    """The tiles, each said as it begins where there are several."""
    for i, tile in enumerate(tiles, 1):
        if count > 1:
            LOG.info("tile %d of %d", i, count)
        yield tile
