"""Pieces of a frame: tiles of alpha, the strips of the betas that they look at, and how many fit into memory."""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.nn.functional import pad

from arraygeom import (
    Pair,
    Positions,
    Segments,
    pixel_grid,
)
from arraygeom.atomic import write_atomically
from arraygeom.pixels import HW

from ..networks.protocol import FusionNetwork, Look
from ..networks.semi_global import SemiGlobalMatches
from ..support.memory import give_back
from .results import Frame

REACH = 224
"""The widest halo, pixels: what is farther off changes images by at most 2.2e-6 with trained weights (at 192 pixels
3e-5, at 160 2e-4; measured on three scenes), whatever their convolutions could carry."""
SURVEY_REACH = 256
"""The halo of the pieces of a survey, pixels."""
SURVEYED = 1_600_000
"""Pixels of alpha that are surveyed at once. Larger frames are cut the same way whatever memory is allowed, so that
results do not depend on it."""
LIBRARIES = 0.56 * 2**30
"""What Python, torch and the compiled loops take, bytes (430 MiB were measured, and what small things add)."""
SLACK = 1.08
"""What a process takes over what is counted here: 5 % were seen."""
SURVEY_BYTES = 330.0
"""Working memory of a survey for each pixel of alpha, measured."""
FRAME_BYTES = 20.0
"""A fused frame's for each pixel: three colours, depth and confidence."""


@dataclass(frozen=True)
class Beta:
    """One beta, ready for the network: its image (1, C, H, W), its pair with alpha, where to look.

    `points` says where alpha's pixels are when beta records: elsewhere only if they move (`Moved`).
    """

    image: Tensor
    pair: Pair
    look: Look
    points: Callable[[Tensor], Tensor]


class Tile(NamedTuple):
    """Rows and columns of the output, and of alpha's image that they need: (top, bottom, left, right)."""

    inner: tuple[int, int, int, int]
    outer: tuple[int, int, int, int]


def tiles_of(hw: HW, side: int | tuple[int, int], halo: int) -> Iterator[Tile]:
    """Tiles (square, or of a height and a width) with a halo, cut off at the frame's borders."""
    (h, w), (rows, columns) = hw, side if isinstance(side, tuple) else (side, side)
    for top in range(0, h, rows):
        for left in range(0, w, columns):
            bottom, right = min(top + rows, h), min(left + columns, w)
            outer = (max(top - halo, 0), min(bottom + halo, h), max(left - halo, 0), min(right + halo, w))
            yield Tile((top, bottom, left, right), outer)


def _whole(hw: HW) -> Tile:
    return Tile((0, hw[0], 0, hw[1]), (0, hw[0], 0, hw[1]))


class Plan(NamedTuple):
    """How a frame will be fused: tiles, memory of the process at most (bytes), time, if estimated (seconds), and in
    how many pieces it is surveyed first."""

    tiles: list[Tile]
    memory: float
    seconds: float | None
    surveys: int = 1

    def __str__(self) -> str:
        many = "1 piece" if len(self.tiles) == 1 else f"{len(self.tiles)} tiles"
        survey = "" if self.surveys == 1 else f" after a survey in {self.surveys} pieces"
        time = "" if self.seconds is None else f", about {_duration(self.seconds)}"
        return f"{many}{survey}, {self.memory / 2**30:.2f} GiB in all{time}"


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"


def plan(
    network: FusionNetwork,
    hw: HW,
    betas: list[Beta],
    limit: float | None,
    held: float = 0.0,
    surveying: float = 0.0,
) -> list[Tile]:
    """The tiles with the least work (their halos overlap) of which none takes more than `limit` without `held` bytes.

    One tile if the whole frame does not. Raises ValueError if not even tiles of 64 pixels fit, or the survey, which
    takes `surveying`, does not.
    """
    whole = _whole(hw)
    if limit is None:
        return [whole]
    left, halo = limit / SLACK - held, min(network.halo, REACH)
    if max(working_memory(network, whole, betas), surveying) <= left:
        return [whole]
    for sides in _by_work(hw, halo, network.multiple, left / network.bytes_per_pixel) if surveying <= left else ():
        tiles = list(tiles_of(hw, sides, halo))
        largest_first = sorted(tiles, key=lambda tile: -_area(tile.outer))
        if all(working_memory(network, tile, betas) <= left for tile in largest_first):
            return tiles
    least = max(working_memory(network, tile, betas) for tile in tiles_of(hw, 64, halo))
    needed = SLACK * (held + max(least, surveying)) / 2**20
    raise ValueError(f"max_memory is {limit / 2**20:.0f} MiB; this frame and network need at least {needed:.0f} MiB")


def working_memory(network: FusionNetwork, tile: Tile, betas: list[Beta]) -> float:
    """Bytes that a tile takes: those for its part of alpha and for the part of each beta that it looks at."""
    pixels = _area(tile.outer)
    for beta in betas:
        top, bottom, left, right = tile.outer
        x = pixel_grid((-(-(bottom - top) // 32) + 1, -(-(right - left) // 32) + 1)) * 32
        x = torch.minimum(x, x.new_tensor([right - left - 1, bottom - top - 1])) + x.new_tensor([left, top])
        pixels += _area(touched(beta.look.at(x.reshape(-1, 2)), beta.pair.beta.hw, network))
    return network.bytes_per_pixel * pixels


def survey_memory(surveys: list[Tile], probe: Probe | None) -> float:
    """Bytes that the survey takes; none if the network was seen to make none."""
    if probe and not probe.known:
        return 0.0
    return SURVEY_BYTES * max(_area(tile.outer) for tile in surveys)


def _by_work(hw: HW, halo: int, multiple: int, most: float) -> list[tuple[int, int]]:
    """Heights and widths of tiles of at most so many pixels with their halos, the least work first."""
    h, w = hw
    sides: dict[tuple[int, int], int] = {}
    for rows in range(1, -(-h // 64) + 1):
        for columns in range(1, -(-w // 64) + 1):
            side = max(-(-h // rows // multiple) * multiple, 64), max(-(-w // columns // multiple) * multiple, 64)
            if side not in sides and math.prod(min(s + 2 * halo, n) for s, n in zip(side, hw)) <= most:
                sides[side] = math.prod(_covered_length(n, s, halo) for n, s in zip(hw, side))
    return sorted(sides, key=lambda side: sides[side])


def _covered_length(length: int, side: int, halo: int) -> int:
    """What pieces of a length add up to with their halos."""
    return sum(min(i + side + halo, length) - max(i - halo, 0) for i in range(0, length, side))


def _area(box: tuple[int, int, int, int]) -> int:
    top, bottom, left, right = box
    return (bottom - top) * (right - left)


PROBE = (192, 512)
"""Least and greatest side of the piece of alpha that is fused to estimate the time, pixels."""
PROBED = 1 / 40
"""The part of alpha that the piece is between these."""


class Probe(NamedTuple):
    """What a piece from the middle of alpha took, for each of its pixels: bytes that the survey leaves, seconds of
    the survey and of the rest."""

    known: float
    survey: float
    fusion: float

    @classmethod
    def of(
        cls, network: FusionNetwork, own: Tensor, betas: list[Beta], fuse_tile: Callable[[list[Beta], Tile], object]
    ) -> Probe:
        """Survey and fuse a small piece, as loops may have to be compiled, and then one to measure."""
        h, w = own.shape[-2:]
        side = min(max(math.sqrt(h * w * PROBED), PROBE[0]), PROBE[1])
        for n in (PROBE[0], int(side)):
            piece = _middle((h, w), n, network.multiple)
            begin = time.perf_counter()
            found = [survey_piece(network, own, beta, piece) for beta in betas]
            middle = time.perf_counter()
            fuse_tile(betas, piece)
            end = time.perf_counter()
        known = sum(
            part.nbytes
            for semi_global_matching in found
            if semi_global_matching is not None
            for part in semi_global_matching
        )
        surveying, pixels = middle - begin, _area(piece.outer)
        again = surveying if known else 0.0
        return cls(known / pixels, surveying / pixels, max(end - middle - again, 0.0) / pixels)

    def seconds(self, surveys: list[Tile], tiles: list[Tile]) -> float:
        """About how long a frame will take here, if the machine stays as busy as it was."""
        surveying, fusing = (sum(_area(tile.outer) for tile in pieces) for pieces in (surveys, tiles))
        return self.survey * surveying + self.fusion * fusing


def _middle(hw: HW, side: int, multiple: int) -> Tile:
    top, left = (max((n - side) // 2, 0) // multiple * multiple for n in hw)
    box = (top, min(top + side, hw[0]), left, min(left + side, hw[1]))
    return Tile(box, box)


def held_memory(own: Tensor, betas: list[Beta], known: float, *, frame: bool) -> float:
    """Bytes of the process that do not depend on the tiles: libraries, images, survey, and the frame if kept."""
    pixels = own.shape[-2] * own.shape[-1]
    images = own.nbytes + sum(beta.image.nbytes for beta in betas)
    return LIBRARIES + images + pixels * (known + (FRAME_BYTES if frame else 0.0))


def survey_tiles(network: FusionNetwork, hw: HW) -> list[Tile]:
    """The pieces that a frame is surveyed in: one, or those with the least work of at most `SURVEYED` pixels."""
    if math.prod(hw) <= SURVEYED:
        return [_whole(hw)]
    return list(tiles_of(hw, _by_work(hw, SURVEY_REACH, network.multiple, SURVEYED)[0], SURVEY_REACH))


def surveyed(network: FusionNetwork, alpha: Tensor, beta: Beta, pieces: list[Tile]) -> Beta:
    """The beta with what the network wants to know before it fuses pieces of a frame."""
    m = network.multiple
    with torch.no_grad():
        told = replace(beta, look=network.normalisation(padded(alpha, m), padded(beta.image, m), beta.look))
        if len(pieces) == 1:
            known = network.survey(padded(alpha, m), padded(beta.image, m), told.look)
        else:
            known = _joined(((p, survey_piece(network, alpha, told, p)) for p in pieces), network, alpha)
    return replace(told, look=replace(told.look, known=known))


def survey_piece(network: FusionNetwork, alpha: Tensor, beta: Beta, tile: Tile) -> SemiGlobalMatches | None:
    """The survey of a piece of alpha with the strip of beta that it looks at."""
    top, bottom, left, right = tile.outer
    part, m = strip(beta, tile.outer, network), network.multiple
    with torch.no_grad():
        return network.survey(padded(alpha[..., top:bottom, left:right], m), padded(part.image, m), part.look)


def _joined(
    pieces: Iterator[tuple[Tile, SemiGlobalMatches | None]], network: FusionNetwork, alpha: Tensor
) -> SemiGlobalMatches | None:
    """The survey of a whole frame (to whole multiples) from the inner parts of its pieces."""
    hw = [-(-n // network.multiple) * network.multiple for n in alpha.shape[-2:]]
    whole: list[Tensor] = []
    for (inner, outer), found in pieces:
        if found is None:
            return None
        ends = (hw[i] if inner[2 * i + 1] == n else inner[2 * i + 1] for i, n in enumerate(alpha.shape[-2:]))
        box = (inner[0], next(ends), inner[2], next(ends))
        part = found.cut((box[0] - outer[0], box[1] - outer[0], box[2] - outer[2], box[3] - outer[2]))
        steps = [(box[1] - box[0]) // p.shape[-2] for p in part]
        whole = whole or [p.new_empty(*p.shape[:-2], hw[0] // s, hw[1] // s) for p, s in zip(part, steps)]
        for target, p, s in zip(whole, part, steps):
            target[..., box[0] // s : box[1] // s, box[2] // s : box[3] // s] = p
        del found, part, p
        give_back()
    return SemiGlobalMatches(*whole)


@dataclass(frozen=True)
class Strip:
    """The part of a beta that a tile needs. `look` maps the tile's pixels to the strip's; `offset` is its corner."""

    image: Tensor
    look: Look
    pair: Pair
    offset: tuple[int, int]
    points: Callable[[Tensor], Tensor]


def strip(beta: Beta, outer: tuple[int, int, int, int], network: FusionNetwork) -> Strip:
    """The part of a beta that alpha's (top, bottom, left, right) looks at."""
    top, bottom, left, right = outer
    corner = torch.tensor([float(left), float(top)])
    x = pixel_grid((bottom - top, right - left)) + corner
    y0, y1, x0, x1 = touched(beta.look.at(x[::2, ::2].reshape(-1, 2)), beta.pair.beta.hw, network)
    shift = torch.tensor([float(x0), float(y0)])

    def at(x: Tensor) -> Segments | Positions:
        found = beta.look.at(x + corner.to(x))
        if isinstance(found, Positions):
            return Positions(found.xy - shift.to(x), found.mask)
        return Segments(found.start - shift.to(x), found.end - shift.to(x), found.valid)

    m = network.multiple
    known = beta.look.known
    if known is not None:
        known = known.cut((top, top - (top - bottom) // m * m, left, left - (left - right) // m * m))
    look = replace(beta.look, at=at, known=known)
    return Strip(beta.image[..., y0:y1, x0:x1], look, beta.pair, (x0, y0), beta.points)


def touched(found: Segments | Positions, hw: HW, network: FusionNetwork) -> tuple[int, int, int, int]:
    """(top, bottom, left, right) of the part of beta that is looked at, with a halo; aligned to `multiple`."""
    if isinstance(found, Positions):
        points = found.xy[found.mask]
    else:
        points = torch.cat([found.start[found.valid], found.end[found.valid]])
    if not len(points):
        return 0, network.multiple, 0, network.multiple
    low, high = points.amin(0) - network.beta_halo, points.amax(0) + network.beta_halo
    m = network.multiple
    (x0, y0), (x1, y1) = (torch.div(v, m, rounding_mode="floor").long() * m for v in (low, high + m))
    return max(int(y0), 0), min(int(y1), hw[0]), max(int(x0), 0), min(int(x1), hw[1])


def padded(image: Tensor, multiple: int) -> Tensor:
    """The image continued at the bottom and the right to whole multiples."""
    h, w = image.shape[-2:]
    return pad(image, (0, -w % multiple, 0, -h % multiple), mode="replicate")


class TileStore(NamedTuple):
    """Finished tiles in a folder; `digest` is of all that they depend on and is part of their names."""

    folder: Path
    digest: str

    @classmethod
    def of(cls, folder: Path, network: FusionNetwork, own: Tensor, betas: list[Beta]) -> TileStore:
        """The store for one frame's tiles."""
        digest = hashlib.sha256(type(network).__name__.encode())
        parameters = network.state_dict().values() if isinstance(network, nn.Module) else ()
        for tensor in (*parameters, own, *(b.image for b in betas)):
            digest.update(tensor.detach().cpu().contiguous().numpy())
        x = pixel_grid((own.shape[-2], own.shape[-1]), dtype=torch.float64)[::64, ::64].reshape(-1, 2)
        for beta in betas:
            digest.update(b"".join(part.numpy().tobytes() for part in vars(beta.look.at(x)).values()))
        return cls(folder, digest.hexdigest()[:16])

    def keep(self, tile: Tile, make: Callable[[Tile], Frame]) -> None:
        """Make a tile, unless it is there."""
        file = self._file(tile)
        if file.exists():
            return
        frame = make(tile)
        with write_atomically(file) as temporary:
            save_file({name: part.contiguous() for name, part in frame._asdict().items()}, temporary)

    def fetch(self, tile: Tile) -> Frame:
        """A tile that was kept."""
        return Frame(**load_file(self._file(tile)))

    def _file(self, tile: Tile) -> Path:
        return self.folder / f"{self.digest}_{'_'.join(map(str, (*tile.inner, *tile.outer)))}.safetensors"
