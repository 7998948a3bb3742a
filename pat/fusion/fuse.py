"""Whole frames: a rig and one image a camera in, one fused image out.

Frames too large for the memory allowed are fused in tiles of alpha, each with just the part of every beta that
its segments touch, and a halo (`pat.fusion.tiles`). Tiled and whole results are equal to 1e-5.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from arraygeom import (
    Moved,
    Pair,
    Positions,
    ReceptiveField,
    Rig,
    depth_from_track,
    pixel_grid,
)
from arraygeom.fields import default_field, pinhole_track
from arraygeom.pixels import HW

from ..media.images import Images
from ..media.raw import as_bright
from ..networks.protocol import FusionNetwork, FusionOutput, Look
from ..support.memory import give_back, parse_bytes
from .results import Frame
from .steps import (
    Fields,
    _at_equal_pitch,
    _band_order,
    _bent,
    _common_part,
    _follows_lenses,
    _grey,
    _has_lens,
    _straightened,
    normalised,
    quarter_turns,
    together,
    without_lenses,
)
from .tiles import (
    PROBE,
    SLACK,
    Beta,
    Plan,
    Probe,
    Strip,
    Tile,
    TileStore,
    held_memory,
    padded,
    plan,
    strip,
    survey_memory,
    survey_tiles,
    surveyed,
    working_memory,
)

Progress = Callable[[Iterable["Tile"], int], Iterable["Tile"]]
"""Wraps the tiles (and their number) to show how far the work is, as `rich.progress.track` does."""


def fuse(
    network: FusionNetwork,
    rig: Rig,
    images: Images,
    *,
    alpha: str,
    depth: tuple[float, float] | None = None,
    field: ReceptiveField | Mapping[str, ReceptiveField] | None = None,
    max_memory: float | str | None = None,
    match_levels: bool = False,
    progress: Progress | None = None,
    announce: Callable[[Plan], None] | None = None,
    store: Path | None = None,
) -> Frame:
    """Fuse one frame at the view of camera `alpha`.

    Lenses: unless `field` is `Curved` or `ThroughLenses`, images that a lens bends are taken across to pinhole views
    first (up to 62 degrees off axis). The answer is at alpha's own pixels all the same: what the fusion adds to alpha
    is bent back, alpha's own detail stays as it was, and what the pinhole view leaves out has confidence 0. A beta
    turned by about a quarter or half a turn against alpha is turned upright. Where alpha is known to measure the
    luminance of linear light and one beta the colours, the result is as bright in that sense
    (`pat.media.raw.as_bright`).

    Args:
        network: `load_weights("mono-colour")`, say.
        rig: the cameras. Those without an image in `images` are left out.
        images: tensors by camera name, (C, H, W) in 0..1, each of the size that the rig states. A mapping that reads
            them when asked saves memory (`pat.fusion.views.ViewFiles`).
        alpha: the camera whose view is wanted.
        depth: (near, far) in metres, instead of the rig's.
        field: where to look; by default the depth-bounded epipolar segment of calibrated cameras, the run of the
            epipolar line around H x of those known by F, and a row of beta of those known only by size. Or a field for
            each of some betas, by name.
        max_memory: bytes, or like "4GiB": what the process may take in all, libraries and images included, if there
            is nothing else in it. Default: no limit.
        match_levels: bring each beta to alpha's mean and standard deviation first, for cameras whose exposures or
            filters differ and which are not radiometrically calibrated.
        progress: shows the tiles as they are done.
        store: a folder in which finished tiles of a frame of several are kept, so that one that was stopped goes on;
            tiles of other images, rigs or weights are not taken. Whoever gave it removes it afterwards.
        announce: is told the plan before the work begins; the time of a large frame is estimated by fusing a piece.

    Raises:
        ValueError: a camera that the rig lacks, an image of another size, a rig whose views do not overlap.
    """
    rig = rig if depth is None else rig.replace(depth=depth)
    _check_names(rig, images, alpha)
    fields = field if isinstance(field, Mapping) else dict.fromkeys(rig.betas(alpha), field)
    has_lens = any(_has_lens(rig[name]) for name in images) and not any(map(_follows_lenses, fields.values()))
    how = _How(match_levels, None if max_memory is None else parse_bytes(max_memory), progress, announce, store)
    return (_fuse_bent if has_lens else _fuse_straight)(network, rig, images, alpha, fields, how)


class _How(NamedTuple):
    """What `fuse` is told of how to work; `limit` is the memory, bytes."""

    match_levels: bool
    limit: float | None
    progress: Progress | None
    announce: Callable[[Plan], None] | None
    store: Path | None


def _fuse_bent(network: FusionNetwork, rig: Rig, images: Images, alpha: str, fields: Fields, how: _How) -> Frame:
    """By way of pinhole views of what lenses bend."""
    straight_rig, straight = without_lenses(rig, {name: _image(rig, images, name) for name in images})
    fields = {name: _straightened(f, rig[alpha], straight_rig[alpha]) for name, f in fields.items()}
    frame = _fuse_straight(network, straight_rig, straight, alpha, fields, how)
    return _bent(frame, straight[alpha], _image(rig, images, alpha), straight_rig[alpha], rig[alpha])


def _fuse_straight(network: FusionNetwork, rig: Rig, images: Images, alpha: str, fields: Fields, how: _How) -> Frame:
    own = _grey(_image(rig, images, alpha))[None]
    levels = own if how.match_levels else None
    names = [name for name in rig.betas(alpha) if name in images]
    groups = together(rig, names, fields, network.joins_bands)
    betas = [_joined_beta(network, rig, images, alpha, group, fields.get(group[0]), levels) for group in groups]
    one_colour = len(names) == 1 and betas[0].image.shape[1] == 3
    planned = _planned(network, own, betas, how)
    if how.announce:
        how.announce(planned)
    betas = [surveyed(network, own, beta, survey_tiles(network, rig[alpha].hw)) for beta in betas]
    frame = _fused_in_tiles(network, own, betas, planned.tiles, how)
    image = as_bright(frame.image, own[0], rig[alpha].sensor) if one_colour else frame.image
    if len(groups) < len(names):
        image = image[_band_order(names, groups, {name: images[name].shape[0] for name in names})]
    return frame._replace(image=image)


def _joined_beta(
    network: FusionNetwork,
    rig: Rig,
    images: Images,
    alpha: str,
    group: list[str],
    field: ReceptiveField | None,
    levels: Tensor | None,
) -> Beta:
    """The betas of a group as one; with `levels`, each is levelled by itself."""
    bands = [_image(rig, images, name)[None] for name in group]
    if levels is not None and len(group) > 1:
        bands, levels = [normalised(band, levels) for band in bands], None
    return _prepare(network, rig.pair(alpha, group[0]), torch.cat(bands, 1), field, levels, " and ".join(group))


def _planned(network: FusionNetwork, own: Tensor, betas: list[Beta], how: _How) -> Plan:
    """The tiles under the limit, and for a large frame the time, by fusing a piece."""
    hw = own.shape[-2], own.shape[-1]
    surveys, large = survey_tiles(network, hw), math.prod(hw) > 16 * PROBE[0] ** 2
    measured = large and (how.limit or how.announce)
    probe = Probe.of(network, own, betas, partial(_fuse_tile, network, own)) if measured else None
    held = held_memory(own, betas, probe.known if probe else 0.0, frame=how.store is None)
    surveying = survey_memory(surveys, probe)
    tiles = plan(network, hw, betas, how.limit, held, surveying)
    work = max(surveying, *(working_memory(network, tile, betas) for tile in tiles))
    return Plan(tiles, SLACK * (held + work), probe.seconds(surveys, tiles) if probe else None, len(surveys))


def _fused_in_tiles(network: FusionNetwork, own: Tensor, betas: list[Beta], tiles: list[Tile], how: _How) -> Frame:
    """The frame, put together from its tiles or from where they are kept. Empties `betas` when they are done."""
    hw = own.shape[-2], own.shape[-1]

    def make(tile: Tile) -> Frame:
        frame = _fuse_tile(network, own, betas, tile)
        if len(tiles) > 1:
            give_back()
        return frame

    shown = how.progress(tiles, len(tiles)) if how.progress else tiles
    if not how.store or len(tiles) == 1:
        return _assembled(hw, ((tile, make(tile)) for tile in shown))
    kept = TileStore.of(how.store, network, own, betas)
    for tile in shown:
        kept.keep(tile, make)
    betas.clear()
    return _assembled(hw, ((tile, kept.fetch(tile)) for tile in tiles))


def _assembled(hw: HW, parts: Iterable[tuple[Tile, Frame]]) -> Frame:
    frame: list[Tensor] = []
    for tile, found in parts:
        frame = frame or [part.new_empty(*part.shape[:-2], *hw) for part in found]
        top, bottom, left, right = tile.inner
        for whole, part in zip(frame, found):
            whole[..., top:bottom, left:right] = part
    return Frame(*frame)


def _check_names(rig: Rig, images: Images, alpha: str) -> None:
    for name in (alpha, *images):
        rig.require(name)
    if alpha not in images:
        raise ValueError(f"no image of alpha, '{alpha}'")
    if not set(images) - {alpha}:
        raise ValueError(f"no image of any other camera than alpha, '{alpha}': fusion needs at least one beta")


def _image(rig: Rig, images: Images, name: str) -> Tensor:
    """The image of a camera, which may be read from its file only now, found to be usable."""
    image, (h, w) = images[name], rig[name].hw
    if tuple(image.shape[1:]) != (h, w):
        got = f"{image.shape[2]}x{image.shape[1]}"
        raise ValueError(
            f"the image of '{name}' is {got}, the rig says {w}x{h}: resize the rig, or give the right image"
        )
    if not torch.isfinite(image).all():
        raise ValueError(f"the image of '{name}' has NaN or infinite values")
    return image


def _prepare(
    network: FusionNetwork, pair: Pair, image: Tensor, field: ReceptiveField | None, levels: Tensor | None, name: str
) -> Beta:
    """A beta upright and at the pitch that the network wants, its field checked to reach it somewhere."""
    turns = quarter_turns(pair)
    if turns:
        pair, image = pair.rot90_beta(turns), image.rot90(turns, (-2, -1))
    if network.equal_pitch:
        pair, image = _at_equal_pitch(*_common_part(pair, image, field, network))
    if levels is not None:
        image = normalised(image, levels)
    field = field or default_field(pair)
    look = Look.along(field, pair)
    if not _reaches(look, pair):
        bounds = "" if pair.depth is None else f" between {pair.depth[0]:g} and {pair.depth[1]:g} m"
        raise ValueError(f"alpha's and '{name}'s views do not overlap{bounds}: check the poses and the depth range")
    return Beta(image, pair, look, field.points if isinstance(field, Moved) else lambda x: x)


def _reaches(look: Look, pair: Pair) -> bool:
    found = look.at(pixel_grid(pair.alpha.hw)[::8, ::8].reshape(-1, 2))
    return bool((found.mask if isinstance(found, Positions) else found.valid).any())


def _fuse_tile(network: FusionNetwork, alpha: Tensor, betas: list[Beta], tile: Tile) -> Frame:
    """The inner part of a tile."""
    top, bottom, left, right = tile.outer
    pieces = [strip(b, tile.outer, network) for b in betas]
    images = [padded(p.image, network.multiple) for p in pieces]
    with torch.no_grad():
        fused = network(padded(alpha[..., top:bottom, left:right], network.multiple), images, [p.look for p in pieces])
    image = fused.image[0, :, : bottom - top, : right - left]
    depth, confidence = _depth(fused, pieces, (bottom - top, right - left), (left, top))
    rows = slice(tile.inner[0] - top, tile.inner[1] - top)
    columns = slice(tile.inner[2] - left, tile.inner[3] - left)
    return Frame(image[:, rows, columns], depth[rows, columns], confidence[rows, columns])


UNSEEN = 1e-4
"""Confidences up to this say that beta does not see the point: then it does not tell a depth either."""


def _depth(fused: FusionOutput, pieces: list[Strip], hw: HW, corner: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Depth by the betas that are calibrated, weighted by confidence in inverse depth; confidence, the least."""
    h, w = hw
    like = fused.position[0]
    x = (pixel_grid(hw, dtype=like.dtype, device=like.device) + like.new_tensor(corner)).reshape(-1, 2)
    total, weights = like.new_zeros(2, h, w)
    for piece, position, confidence in zip(pieces, fused.position, fused.confidence):
        if piece.pair.link is not None or not piece.pair.calibrated:
            continue
        seen = position[0, :, :h, :w].movedim(0, -1) + like.new_tensor(piece.offset)
        found = depth_from_track(pinhole_track(piece.pair, piece.points(x)), seen.reshape(-1, 2))
        told = found.valid.reshape(h, w) & (confidence[0, :h, :w] > UNSEEN)
        weight = torch.where(told, confidence[0, :h, :w], 0.0)
        total = total + weight / torch.where(found.valid, found.depth, 1.0).reshape(h, w)
        weights = weights + weight
    known = weights > 0
    depth = torch.where(known, weights / torch.where(known, total, 1.0), torch.nan)
    return depth.to(fused.image), torch.stack([c[0, :h, :w] for c in fused.confidence]).amin(0)
