"""Fusing a frame in pieces that fit into memory: the plan, one tile, and keeping finished tiles."""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn

from arraygeom import pixel_grid
from arraygeom.runtime.chunks import Box, Tile, area, assembled, sides_by_work, tiles_of, whole

from ..matching.inputs import Inputs, Matches
from ..networks.protocol import FusionNetwork, matched_for
from ..support.convolutions import convolutions_in_parallel
from ..support.memory import LIBRARIES, SLACK
from ..support.tensor_files import read_tensors, write_tensors
from .depth import certain, measured_depth
from .frame import Frame
from .inputs import FrameInputs

MAX_HALO = 256
"""Widest halo, pixels: points farther off change an image of KITTI's by 7e-6 with trained weights (at 240
pixels 5e-5, at 224 2e-4), however far their convolutions reach."""
MATCHING_BYTES = 360.0
"""Working memory of matching for each pixel of alpha, measured."""
FILLING_BYTES = 80.0
"""Working memory of filling for each pixel of the whole frame, counted."""
FRAME_BYTES = 12.0
"""Memory of a fused frame for each pixel: depth, confidence and half-width."""
BAND_BYTES = (4.0, 2.0)
"""Memory for each of its bands, and for the band's confidence if there are several."""
WRITING_BYTES = 65.0
"""Memory, for each pixel, to take a fused frame back to alpha's pixels and write it, measured."""
PROBE = (192, 512)
"""Least and greatest side of the piece of alpha that is fused to estimate the time, pixels."""
ESTIMATED = 4_000_000
"""Alpha's pixels from which the time is estimated: smaller frames take seconds, and so does estimating."""
LARGE = 16 * PROBE[0] ** 2
"""Alpha's pixels from which a piece is fused to learn matches' memory, and planned memory is kept to."""
PROBED = 1 / 40
"""Part of alpha that the piece is between these."""


class Plan(NamedTuple):
    """Plan of a frame's fusion.

    Attributes:
        tiles: tiles to fuse.
        memory: expected peak memory of the process, bytes.
        seconds: estimated time, seconds; None if it was not estimated.
        pieces: number of tiles in which the frame is matched first.
    """

    tiles: list[Tile]
    memory: float
    seconds: float | None
    pieces: int = 1

    @property
    def duration(self) -> str:
        """Estimated time in words; empty if it was not estimated."""
        seconds = self.seconds
        return "" if seconds is None else f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"

    def __str__(self) -> str:
        many = "1 piece" if len(self.tiles) == 1 else f"{len(self.tiles)} tiles"
        matching = "" if self.pieces == 1 else f" after matching in {self.pieces} pieces"
        time = "" if self.seconds is None else f", about {self.duration}"
        return f"{many}{matching}, {self.memory / 2**30:.2f} GiB in all{time}"


def plan_frame(
    network: FusionNetwork,
    frame: FrameInputs,
    *,
    limit: float | None,
    estimate: bool,
    stored: bool,
    before: float = 0.0,
    after: float = 0.0,
    kept: float = 0.0,
) -> Plan:
    """Plan the tiles of a frame under a limit of memory.

    Args:
        limit: memory limit of the process, bytes; None for no limit.
        estimate: True to estimate a very large frame's time by fusing a small part; with a limit that is
            done for large frames anyway.
        stored: True if finished tiles are stored on disk until all are there.
        before: work before fusion, as a share of it, to add to the time.
        after: seconds of work after fusion, to add to the time.
        kept: bytes that the caller holds beside the frame.

    Returns:
        The plan; its time is None unless it was measured.

    Raises:
        ValueError: for a limit that is too small even for tiles of 64 pixels, or for matching.
    """
    pieces, pixels = frame.inputs.pieces, math.prod(frame.hw)
    bands = frame.inputs.bands or sum(beta.image.shape[1] for beta in frame.inputs.betas)
    of_frame = FRAME_BYTES + bands * sum(BAND_BYTES[: len(frame.inputs.betas)])
    wanted = (pixels > LARGE and limit) or (pixels > ESTIMATED and estimate)
    probe = Probe.from_frame(network, frame) if wanted else None
    for_each = (probe.matches if probe else 0.0) + (0.0 if stored else of_frame)
    held = kept + LIBRARIES + frame.inputs.nbytes + pixels * for_each
    matching = max(MATCHING_BYTES * max(area(tile.outer) for tile in pieces), FILLING_BYTES * pixels)
    matching = matching if network.uses_matches else 0.0
    tiles = tiles_within(network, frame, limit, held, matching)
    work = max(matching, *(working_memory(network, frame.inputs, tile) for tile in tiles))
    held = max(held + work, LIBRARIES + kept + pixels * (of_frame + WRITING_BYTES))
    seconds = (1 + before) * probe.seconds(pieces, tiles) + after if probe else None
    return Plan(tiles, SLACK * held, seconds, len(pieces))


def tiles_within(
    network: FusionNetwork, frame: FrameInputs, limit: float | None, held: float = 0.0, matching: float = 0.0
) -> list[Tile]:
    """Choose the tiles of a frame that fit into memory with the least work, that of their halos included.

    Args:
        limit: memory limit of the process, bytes; None for no limit.
        held: bytes that the process holds beside the tile in work.
        matching: bytes that matching takes, which must fit too.

    Returns:
        The tiles; one if the whole frame fits, or without a limit.

    Raises:
        ValueError: if not even tiles of 64 pixels fit, or matching does not.
    """
    one = whole(frame.hw)
    if limit is None:
        return [one]
    left, halo = limit / SLACK - held, min(network.halo, MAX_HALO)

    def memory(tile: Tile) -> float:
        return working_memory(network, frame.inputs, tile)

    if max(memory(one), matching) <= left:
        return [one]
    most = left / network.working_bytes(1, [0])
    for sides in sides_by_work(frame.hw, halo, network.multiple, most) if matching <= left else ():
        tiles = list(tiles_of(frame.hw, sides, halo))
        if all(memory(tile) <= left for tile in sorted(tiles, key=lambda tile: -area(tile.outer))):
            return tiles
    least = max(map(memory, tiles_of(frame.hw, 64, halo)))
    needed = SLACK * (held + max(least, matching)) / 2**20
    raise ValueError(
        f"max_memory: {limit / 2**20:.0f} MiB are too few: this frame and network need {needed:.0f} or more"
    )


def working_memory(network: FusionNetwork, inputs: Inputs, tile: Tile) -> float:
    """Return the bytes of a tile: its part of alpha, and the part of each beta that its segments touch."""
    betas = [area(inputs.touched(beta, tile.outer, 16)) for beta in inputs.betas]
    return network.working_bytes(area(tile.outer), betas)


class Probe(NamedTuple):
    """Measured cost of matching and fusing a part from the middle of alpha, per pixel.

    Attributes:
        matches: bytes of its matches, per pixel.
        matching: seconds of matching, per pixel.
        fusing: seconds of fusing, per pixel.
    """

    matches: float
    matching: float
    fusing: float

    @classmethod
    @torch.no_grad()
    def from_frame(cls, network: FusionNetwork, frame: FrameInputs) -> Probe:
        """Measure the cost of matching and fusing a part from the middle of alpha.

        A small part comes first, as loops may have to be compiled.

        Returns:
            The measured cost: seconds and bytes for a pixel of alpha.
        """
        side = min(max(math.sqrt(math.prod(frame.hw) * PROBED), PROBE[0]), PROBE[1])
        for n in (PROBE[0], int(side)):
            top, left = (max((size - n) // 2, 0) // network.multiple * network.multiple for size in frame.hw)
            box = (top, min(top + n, frame.hw[0]), left, min(left + n, frame.hw[1]))
            tile = Tile(box, box)
            inputs = frame.inputs.cut(_to_multiple(tile.outer, network.multiple))
            begin = time.perf_counter()
            matches = matched_for(network, inputs)
            middle = time.perf_counter()
            _fused(network, inputs, matches, frame, tile)
            end = time.perf_counter()
        pixels, nbytes = area(tile.outer), matches.nbytes if matches else 0
        return cls(nbytes / pixels, (middle - begin) / pixels, (end - middle) / pixels)

    def seconds(self, pieces: list[Tile], tiles: list[Tile]) -> float:
        """Estimate the seconds of a frame here, if the machine stays as busy as it was."""
        matching, fusing = (sum(area(tile.outer) for tile in some) for some in (pieces, tiles))
        return self.matching * matching + self.fusing * fusing


def _to_multiple(box: Box, multiple: int) -> Box:
    """Return a box whose corner is at a whole multiple, its sides padded to whole multiples."""
    top, bottom, left, right = box
    return top, bottom + (top - bottom) % multiple, left, right + (left - right) % multiple


class FusedTile(NamedTuple):
    """Inner part of a fused tile.

    Attributes:
        image: fused image (C, h, w), not clipped.
        depth: depth (h, w) along alpha's axis, or its rays, in the rig's unit; NaN where unknown.
        confidence: confidence of the image (h, w), 0 to 1.
        half_width: half-width of the interval of inverse depth (h, w), as in `Frame`.
        matched: positions of its pixels in each whole beta with their confidence, (betas, 3, h, w): x, y in
            beta's pixels, confidence; empty if not kept.
        by_band: confidence of each band (C, h, w), float16, where they are several betas'; else empty.
    """

    image: Tensor
    depth: Tensor
    confidence: Tensor
    half_width: Tensor
    matched: Tensor
    by_band: Tensor

    @property
    def frame(self) -> Frame:
        """The same of a whole frame, as its result."""
        by_band = self.by_band if len(self.by_band) else None
        return Frame(self.image, self.depth, self.confidence, self.half_width, by_band)


def fuse_tile(network: FusionNetwork, frame: FrameInputs, matches: Matches | None, tile: Tile) -> FusedTile:
    """Fuse a tile of a frame, with the whole frame's matches (None for a network that uses none).

    Returns:
        Its inner part.
    """
    box = _to_multiple(tile.outer, network.multiple)
    return _fused(network, frame.inputs.cut(box), matches and matches.cut(box), frame, tile)


def _fused(
    network: FusionNetwork, inputs: Inputs, matches: Matches | None, frame: FrameInputs, tile: Tile
) -> FusedTile:
    """Fuse a tile by the network, cut to its inner part, with depth and confidence by the betas."""
    top, bottom, left, right = tile.inner
    box = (top - tile.outer[0], bottom - tile.outer[0], left - tile.outer[2], right - tile.outer[2])
    with convolutions_in_parallel():
        output = certain(network(inputs, matches), matches, inputs)
    output = output.cut(box)
    cropped = replace(inputs, betas=tuple(replace(beta, field=beta.field.cut(box)) for beta in inputs.betas))
    hw = bottom - top, right - left
    depth, half_width, confidence = measured_depth(output, cropped, frame.placements, hw, (left, top))
    corners = [p.new_tensor(beta.offset)[:, None, None] for beta, p in zip(cropped.betas, output.position)]
    of_betas = zip(output.position, corners, output.confidence)
    matched = torch.stack([torch.cat([p[0] + corner, c]) for p, corner, c in of_betas]).to(output.image)
    bands = [beta.image.shape[1] for beta in cropped.betas]
    by_band = output.image[0, :0]
    if len(bands) > 1 and sum(bands) == output.image.shape[1]:
        by_band = torch.cat([c.expand(n, -1, -1) for c, n in zip(output.confidence, bands)])
    return FusedTile(output.image[0], depth, confidence, half_width, matched, by_band.half())


def fused_in_tiles(
    network: FusionNetwork,
    frame: FrameInputs,
    matches: Matches | None,
    tiles: list[Tile],
    *,
    keep_matched: bool = True,
    progress: Callable[[Iterable[Tile], int], Iterable[Tile]] | None = None,
    store: Path | None = None,
) -> FusedTile:
    """Fuse a frame tile by tile, or take finished tiles from a folder.

    Args:
        matches: matches of the whole frame; None for a network that uses none.
        tiles: tiles to fuse.
        keep_matched: False to leave out `matched`, which takes 12 bytes a pixel and beta.
        progress: function of the tiles and their number that yields the tiles to show progress; None for
            none.
        store: folder of finished tiles, read and written if they are several; None for none.

    Returns:
        The whole frame, in the form of one tile; of `store` without gradients, its damaged tiles made anew.

    Raises:
        OSError: if a finished tile cannot be written to `store`.
    """

    def make(tile: Tile) -> FusedTile:
        made = fuse_tile(network, frame, matches, tile)
        return made if keep_matched else made._replace(matched=made.matched[:0])

    shown = progress(tiles, len(tiles)) if progress else tiles
    if store and len(tiles) > 1:
        digest = _digest(network, frame)
        files = {t: store / f"{digest}_{'_'.join(map(str, (*t.inner, *t.outer)))}.safetensors" for t in tiles}
        for tile in shown:
            if not _is_whole(files[tile]):
                write_tensors(files[tile], make(tile)._asdict())
        parts = ((tile, FusedTile(**read_tensors(file)[0])) for tile, file in files.items())
    else:
        parts = ((tile, make(tile)) for tile in shown)
    # A single tile is the frame as it is, with its gradients.
    return FusedTile(*assembled(frame.hw, ((Tile(tile.inner, tile.inner), fused) for tile, fused in parts)))


def _is_whole(file: Path) -> bool:
    try:
        read_tensors(file)
    except (OSError, ValueError):
        return False
    return True


def _digest(network: FusionNetwork, frame: FrameInputs) -> str:
    """Return a digest of all that a frame's tiles depend on; of fields of positions, those of some pixels."""
    inputs = frame.inputs
    how = type(network).__name__, FusedTile._fields, inputs.luminance, inputs.bands, inputs.sees_luma
    module = network if isinstance(network, nn.Module) else nn.Module()
    rounded = [name for name, layer in module.named_modules() if "forward" in vars(layer)]  # by `in_bfloat16`
    digest = hashlib.sha256(f"{how} {rounded}".encode())
    parameters = module.state_dict().values()
    some = pixel_grid(inputs.hw, dtype=torch.float64)[::64, ::64].reshape(-1, 2)
    samples = [b.field.at(some) if b.field.pixels is None else b.field.pixels for b in inputs.betas]
    fields = [tensor for one in samples for tensor in vars(one).values()]
    cameras = [camera for place in frame.placements if place.pair.calibrated for camera in place.pair.cameras]
    poses = [tensor for camera in cameras for tensor in (camera.K, camera.R, camera.t)]
    for tensor in (*parameters, inputs.alpha, *(b.image for b in inputs.betas), *fields, *poses):
        digest.update(tensor.detach().cpu().contiguous().numpy())
    return digest.hexdigest()[:16]
