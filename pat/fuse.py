"""Whole frames: a rig and one picture a camera in, one fused picture out.

Frames too large for the memory allowed are fused in tiles of alpha, each with just the part of every beta that
its segments touch, and a halo (`pat.tiles`). Tiled and whole results are equal to 1e-5.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.nn.functional import interpolate

from arraygeom import (
    Camera,
    Curved,
    Epipolar,
    EpipolarLine,
    HomographyDisplacement,
    LensView,
    Moved,
    Pair,
    Positions,
    ReceptiveField,
    Rectified,
    Rig,
    ThroughLenses,
    View,
    Widened,
    apply_homography,
    depth_from_track,
    pinhole_view,
    pixel_grid,
    retaken,
)
from arraygeom.fields import pinhole_track
from arraygeom.pixels import HW, coarse_grid, map_homogeneous, shift_matrix
from arraygeom.undistortion import pixels_between

from .develop import as_bright
from .images import Pictures, luminance, write_atomically
from .memory import give_back, parse_bytes
from .model import Fused, FusionNetwork, Look
from .tiles import (
    PROBE,
    SLACK,
    Beta,
    Plan,
    Probe,
    Strip,
    Tile,
    held_memory,
    padded,
    plan,
    strip,
    survey_memory,
    survey_tiles,
    surveyed,
    touched,
    working_memory,
)

Progress = Callable[[Iterable["Tile"], int], Iterable["Tile"]]
"""Wraps the tiles (and their number) to show how far the work is, as `rich.progress.track` does."""


class FusedFrame(NamedTuple):
    """A fused frame at alpha's view.

    image: (C, H, W), in alpha's coding, not cut to 0..1.
    depth: (H, W), metres along alpha's axis; NaN where no calibrated beta tells it.
    confidence: (H, W), 0 to 1: that every band's beta sees the point, and that it is known where.
    """

    image: Float[Tensor, "c h w"]
    depth: Float[Tensor, "h w"]
    confidence: Float[Tensor, "h w"]


def fuse(
    network: FusionNetwork,
    rig: Rig,
    images: Pictures,
    *,
    alpha: str,
    depth: tuple[float, float] | None = None,
    field: ReceptiveField | Mapping[str, ReceptiveField] | None = None,
    max_memory: float | str | None = None,
    match_levels: bool = False,
    progress: Progress | None = None,
    announce: Callable[[Plan], None] | None = None,
    store: Path | None = None,
) -> FusedFrame:
    """Fuse one frame at the view of camera `alpha`.

    Lenses: unless `field` is `Curved` or `ThroughLenses`, pictures that a lens bends are taken across to pinhole views
    first (up to 62 degrees off axis). The answer is at alpha's own pixels all the same: what the fusion adds to alpha
    is bent back, alpha's own detail stays as it was, and what the pinhole view leaves out has confidence 0. A beta
    turned by about a quarter or half a turn against alpha is turned upright. Where alpha is known to measure the
    luminance of linear light and one beta the colours, the result is as bright in that sense
    (`pat.develop.as_bright`).

    Args:
        network: `load_weights("mono-colour")`, say.
        rig: the cameras. Those without a picture in `images` are left out.
        images: tensors by camera name, (C, H, W) in 0..1, each of the size that the rig states. A mapping that reads
            them when asked saves memory (`pat.develop.ViewFiles`).
        alpha: the camera whose view is wanted.
        depth: (near, far) in metres, instead of the rig's.
        field: where to look; by default the depth-bounded epipolar segment of calibrated cameras, the run of the
            epipolar line around H x of those known by F, and a row of beta of those known only by size. Or a field for
            each of some betas, by name.
        max_memory: bytes, or like "4GiB": what the process may take in all, libraries and pictures included, if there
            is nothing else in it. Default: no limit.
        match_levels: bring each beta to alpha's mean and standard deviation first, for cameras whose exposures or
            filters differ and which are not radiometrically calibrated.
        progress: shows the tiles as they are done.
        store: a folder in which finished tiles of a frame of several are kept, so that one that was stopped goes on;
            tiles of other pictures, rigs or weights are not taken. Whoever gave it removes it afterwards.
        announce: is told the plan before the work begins; the time of a large frame is estimated by fusing a piece.

    Raises:
        ValueError: a camera that the rig lacks, a picture of another size, a rig whose views do not overlap.
    """
    rig = rig if depth is None else rig.replace(depth=depth)
    _check_names(rig, images, alpha)
    fields = field if isinstance(field, Mapping) else dict.fromkeys(rig.betas(alpha), field)
    bent = any(_has_lens(rig[name]) for name in images) and not any(map(_follows_lenses, fields.values()))
    how = _How(match_levels, None if max_memory is None else parse_bytes(max_memory), progress, announce, store)
    return (_fuse_bent if bent else _fuse_straight)(network, rig, images, alpha, fields, how)


class _How(NamedTuple):
    """What `fuse` is told of how to work; `limit` is the memory, bytes."""

    match_levels: bool
    limit: float | None
    progress: Progress | None
    announce: Callable[[Plan], None] | None
    store: Path | None


Fields = Mapping[str, ReceptiveField | None]


def _fuse_bent(network: FusionNetwork, rig: Rig, images: Pictures, alpha: str, fields: Fields, how: _How) -> FusedFrame:
    """By way of pinhole views of what lenses bend."""
    straight_rig, straight = without_lenses(rig, {name: _picture(rig, images, name) for name in images})
    fields = {name: _straightened(f, rig[alpha], straight_rig[alpha]) for name, f in fields.items()}
    frame = _fuse_straight(network, straight_rig, straight, alpha, fields, how)
    return _bent(frame, straight[alpha], _picture(rig, images, alpha), straight_rig[alpha], rig[alpha])


def _fuse_straight(
    network: FusionNetwork, rig: Rig, images: Pictures, alpha: str, fields: Fields, how: _How
) -> FusedFrame:
    own = _grey(_picture(rig, images, alpha))[None]
    levels = own if how.match_levels else None
    names = [name for name in rig.betas(alpha) if name in images]
    groups = together(rig, names, fields, network.joins_bands)
    betas = [_joined_beta(network, rig, images, alpha, group, fields.get(group[0]), levels) for group in groups]
    one_colour = len(names) == 1 and betas[0].picture.shape[1] == 3
    planned = _planned(network, own, betas, how)
    if how.announce:
        how.announce(planned)
    betas = [surveyed(network, own, beta, survey_tiles(network, rig[alpha].hw)) for beta in betas]
    frame = _fused_in_tiles(network, own, betas, planned.tiles, how)
    image = as_bright(frame.image, own[0], rig[alpha].sensor) if one_colour else frame.image
    if len(groups) < len(names):
        image = image[_band_order(names, groups, {name: images[name].shape[0] for name in names})]
    return frame._replace(image=image)


def together(
    rig: Rig, names: Sequence[str], fields: Fields, which: Literal["no", "neighbours", "all"]
) -> list[list[str]]:
    """The betas in groups that see the same from one place (K, R, t, lens and size), and are looked at alike.

    `which` says whether such are put together only if they follow each other, or all, or none.
    """
    groups: list[list[str]] = []
    for name in names:
        near = [] if which == "no" else groups[-1:] if which == "neighbours" else groups
        home = [g for g in near if fields.get(g[0]) is fields.get(name) and _same_view(rig[g[0]], rig[name])]
        if home:
            home[0].append(name)
        else:
            groups.append([name])
    return groups


def _same_view(one: View, other: View) -> bool:
    """Whether two calibrated cameras differ at most in their sensors."""
    if not (isinstance(one, Camera) and isinstance(other, Camera)) or one.hw != other.hw:
        return False
    if (one.distortion is None) != (other.distortion is None):
        return False
    if one.distortion and other.distortion and one.distortion.model != other.distortion.model:
        return False
    return all(torch.equal(*numbers) for numbers in zip(_calibration(one), _calibration(other)))


def _calibration(camera: Camera) -> list[Tensor]:
    lens = [] if camera.distortion is None else [camera.distortion.coefficients]
    return [camera.K, camera.R, camera.t, *lens]


def _joined_beta(
    network: FusionNetwork,
    rig: Rig,
    images: Pictures,
    alpha: str,
    group: list[str],
    field: ReceptiveField | None,
    levels: Tensor | None,
) -> Beta:
    """The betas of a group as one; with `levels`, each is levelled by itself."""
    pictures = [_picture(rig, images, name)[None] for name in group]
    if levels is not None and len(group) > 1:
        pictures, levels = [levelled(picture, levels) for picture in pictures], None
    return _prepare(network, rig.pair(alpha, group[0]), torch.cat(pictures, 1), field, levels, " and ".join(group))


def _band_order(names: Sequence[str], groups: Sequence[Sequence[str]], bands: Mapping[str, int]) -> list[int]:
    """Which of the groups' bands, one after the other, are those of the betas in the order of their names."""
    joined = [(name, band) for group in groups for name in group for band in range(bands[name])]
    return [joined.index((name, band)) for name in names for band in range(bands[name])]


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


def _fused_in_tiles(network: FusionNetwork, own: Tensor, betas: list[Beta], tiles: list[Tile], how: _How) -> FusedFrame:
    """The frame, put together from its tiles or from where they are kept. Empties `betas` when they are done."""
    hw = own.shape[-2], own.shape[-1]

    def make(tile: Tile) -> FusedFrame:
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


def _assembled(hw: HW, parts: Iterable[tuple[Tile, FusedFrame]]) -> FusedFrame:
    frame: list[Tensor] = []
    for tile, found in parts:
        frame = frame or [part.new_empty(*part.shape[:-2], *hw) for part in found]
        top, bottom, left, right = tile.inner
        for whole, part in zip(frame, found):
            whole[..., top:bottom, left:right] = part
    return FusedFrame(*frame)


class TileStore(NamedTuple):
    """Finished tiles in a folder; `digest` is of all that they depend on and is part of their names."""

    folder: Path
    digest: str

    @classmethod
    def of(cls, folder: Path, network: FusionNetwork, own: Tensor, betas: list[Beta]) -> TileStore:
        """The store for one frame's tiles."""
        digest = hashlib.sha256(type(network).__name__.encode())
        parameters = network.state_dict().values() if isinstance(network, nn.Module) else ()
        for tensor in (*parameters, own, *(b.picture for b in betas)):
            digest.update(tensor.detach().cpu().contiguous().numpy())
        x = pixel_grid((own.shape[-2], own.shape[-1]), dtype=torch.float64)[::64, ::64].reshape(-1, 2)
        for beta in betas:
            digest.update(b"".join(part.numpy().tobytes() for part in vars(beta.look.at(x)).values()))
        return cls(folder, digest.hexdigest()[:16])

    def keep(self, tile: Tile, make: Callable[[Tile], FusedFrame]) -> None:
        """Make a tile, unless it is there."""
        file = self._file(tile)
        if file.exists():
            return
        frame = make(tile)
        with write_atomically(file) as temporary:
            save_file({name: part.contiguous() for name, part in frame._asdict().items()}, temporary)

    def fetch(self, tile: Tile) -> FusedFrame:
        """A tile that was kept."""
        return FusedFrame(**load_file(self._file(tile)))

    def _file(self, tile: Tile) -> Path:
        return self.folder / f"{self.digest}_{'_'.join(map(str, (*tile.inner, *tile.outer)))}.safetensors"


def without_lenses(rig: Rig, images: Pictures) -> tuple[Rig, dict[str, Tensor]]:
    """The rig and its pictures with pinhole views in place of cameras with lenses; see `arraygeom.pinhole_view`."""
    straight = dict(images)
    for name, image in images.items():
        camera = rig[name]
        if isinstance(camera, LensView) and camera.distortion is not None:
            view = pinhole_view(camera)
            rig = rig.mapped(name, view.K @ torch.linalg.inv(camera.K), view.hw).with_camera(name, view)
            straight[name] = retaken(image, camera, view, extended=True).values[0].clamp(min=0)
    return rig, straight


def _has_lens(view: View) -> bool:
    return isinstance(view, LensView) and view.distortion is not None


def _follows_lenses(field: ReceptiveField | None) -> bool:
    while isinstance(field, Widened | Moved):
        field = field.field
    return isinstance(field, Curved | ThroughLenses)


def _straightened(field: ReceptiveField | None, lens: View, pinhole: View) -> ReceptiveField | None:
    """The field for the pinhole view of alpha: displacements are between pixels of that, too."""
    if not (isinstance(field, Moved) and isinstance(lens, LensView) and isinstance(pinhole, LensView)):
        return field
    if lens.distortion is None:
        return field
    x, seen = pixels_between(lens, pinhole)
    rays, valid = lens.to(torch.float64).rays(field.points(x))
    there = map_homogeneous(pinhole.K.double()[:2], rays[..., :2] / rays[..., 2:])
    known = seen & valid & (rays[..., 2] > 0)
    step = torch.where(known[..., None], there - pixel_grid(pinhole.hw, dtype=torch.float64), 0.0)
    return Moved(field.field, step.movedim(-1, 0).to(field.displacement))


def _bent(frame: FusedFrame, straight: Tensor, own: Tensor, pinhole: View, lens: View) -> FusedFrame:
    """The frame at the pixels of alpha's own picture."""
    if not (isinstance(pinhole, LensView) and isinstance(lens, LensView) and lens.distortion is not None):
        return frame
    added = frame.image - _grey(straight)
    inverse = (1 / frame.depth).nan_to_num(0.0)
    back = retaken(torch.cat([added, frame.confidence[None]]), pinhole, lens, interpolation="bilinear").values[0]
    depth = 1 / retaken(inverse[None], pinhole, lens, interpolation="nearest").values[0, 0]
    return FusedFrame(_grey(own) + back[:-1], torch.where(depth.isfinite(), depth, torch.nan), back[-1])


def levelled(picture: Float[Tensor, "*b h w"], like: Float[Tensor, "*c ha wa"]) -> Float[Tensor, "*b h w"]:
    """The picture with the mean and the standard deviation of another; not cut to 0..1."""
    return (picture - picture.mean()) / picture.std().clamp(min=1e-6) * like.std() + like.mean()


def default_field(pair: Pair) -> ReceptiveField:
    """The field that what is known of a pair allows."""
    if pair.link is not None:
        return HomographyDisplacement(0.06 * max(pair.beta.hw))
    if pair.calibrated:
        return Epipolar()
    return Rectified(alpha_is="either", max_disparity=0.12 * pair.beta.hw[1])


def _check_names(rig: Rig, images: Pictures, alpha: str) -> None:
    for name in (alpha, *images):
        rig.known(name)
    if alpha not in images:
        raise ValueError(f"no picture of alpha, '{alpha}'")
    if not set(images) - {alpha}:
        raise ValueError(f"no picture of any other camera than alpha, '{alpha}': fusion needs at least one beta")


def _picture(rig: Rig, images: Pictures, name: str) -> Tensor:
    """The picture of a camera, which may be read from its file only now, found to be usable."""
    image, (h, w) = images[name], rig[name].hw
    if tuple(image.shape[1:]) != (h, w):
        got = f"{image.shape[2]}x{image.shape[1]}"
        raise ValueError(
            f"the picture of '{name}' is {got}, the rig says {w}x{h}: resize the rig, or give the right picture"
        )
    if not torch.isfinite(image).all():
        raise ValueError(f"the picture of '{name}' has NaN or infinite values")
    return image


def _grey(picture: Tensor) -> Tensor:
    return luminance(picture) if picture.shape[0] == 3 else picture


def _prepare(
    network: FusionNetwork, pair: Pair, picture: Tensor, field: ReceptiveField | None, levels: Tensor | None, name: str
) -> Beta:
    """A beta upright and at the pitch that the network wants, its field checked to reach it somewhere."""
    turns = quarter_turns(pair)
    if turns:
        pair, picture = pair.turn_beta(turns), picture.rot90(turns, (-2, -1))
    if network.equal_pitch:
        pair, picture = _at_equal_pitch(*_common_part(pair, picture, field, network))
    if levels is not None:
        picture = levelled(picture, levels)
    field = field or default_field(pair)
    look = Look.along(field, pair)
    if not _reaches(look, pair):
        bounds = "" if pair.depth is None else f" between {pair.depth[0]:g} and {pair.depth[1]:g} m"
        raise ValueError(f"alpha's and '{name}'s views do not overlap{bounds}: check the poses and the depth range")
    return Beta(picture, pair, look, field.points if isinstance(field, Moved) else lambda x: x)


def _common_part(
    pair: Pair, picture: Tensor, field: ReceptiveField | None, network: FusionNetwork
) -> tuple[Pair, Tensor]:
    """A calibrated beta without what alpha never looks at, if that is much: it would be enlarged for nothing.

    Not where the field may go by the pictures' sizes.
    """
    h, w = pair.beta.hw
    follows = field is None or isinstance(field, (Epipolar, EpipolarLine))
    if not follows or pair.link is not None or not pair.calibrated or pitch_ratio(pair) > 0.8:
        return pair, picture
    found = Look.along(field or default_field(pair), pair).at(coarse_grid(pair.alpha.hw).reshape(-1, 2))
    top, bottom, left, right = touched(found, (h, w), network)
    if (bottom - top) * (right - left) > 0.75 * h * w:
        return pair, picture
    part = pair.map_beta(shift_matrix(left, top), (bottom - top, right - left))
    return part, picture[..., top:bottom, left:right]


def _at_equal_pitch(pair: Pair, picture: Tensor) -> tuple[Pair, Tensor]:
    """Beta resized so that where the views meet its pixels are about the size of alpha's."""
    scale = pitch_ratio(pair)
    if 0.8 < scale < 1.25:
        return pair, picture
    hw = (max(round(pair.beta.hw[0] / scale), 16), max(round(pair.beta.hw[1] / scale), 16))
    picture = interpolate(picture, size=hw, mode="bicubic", align_corners=False, antialias=True).clamp(0, 1)
    return pair.resize_beta(hw), picture


def pitch_ratio(pair: Pair) -> float:
    """Pixels of beta to a pixel of alpha, by the pair's rough homography at the middle of alpha; 1 if undefined."""
    steps = _steps_in_beta(pair)
    area = 0.0 if steps is None else abs(float(torch.linalg.det(steps)))
    return math.sqrt(area) if area > 0 else 1.0


def quarter_turns(pair: Pair) -> int:
    """How often beta's picture must be turned (see `Camera.turn`) to be upright as alpha's is, 0 to 3."""
    steps = _steps_in_beta(pair)
    if steps is None:
        return 0
    (a, c), (b, d) = steps.tolist()
    return round(math.atan2(c - b, a + d) / (math.pi / 2)) % 4


def _steps_in_beta(pair: Pair) -> Float[Tensor, "2 2"] | None:
    """What a pixel to the right and one down from the middle of alpha are in beta, by the pair's rough homography."""
    h, w = pair.alpha.hw
    middle = torch.tensor([[(w - 1) / 2, (h - 1) / 2]], dtype=torch.float64)
    steps = torch.cat([middle, middle + torch.tensor([[1.0, 0.0], [0.0, 1.0]], dtype=torch.float64)])
    x, valid = apply_homography(pair.homography.double(), steps)
    return x[1:] - x[:1] if bool(valid.all()) else None


def _reaches(look: Look, pair: Pair) -> bool:
    found = look.at(pixel_grid(pair.alpha.hw)[::8, ::8].reshape(-1, 2))
    return bool((found.mask if isinstance(found, Positions) else found.valid).any())


def _fuse_tile(network: FusionNetwork, alpha: Tensor, betas: list[Beta], tile: Tile) -> FusedFrame:
    """The inner part of a tile."""
    top, bottom, left, right = tile.outer
    pieces = [strip(b, tile.outer, network) for b in betas]
    pictures = [padded(p.picture, network.multiple) for p in pieces]
    with torch.no_grad():
        fused = network(
            padded(alpha[..., top:bottom, left:right], network.multiple), pictures, [p.look for p in pieces]
        )
    image = fused.image[0, :, : bottom - top, : right - left]
    depth, confidence = _depth(fused, pieces, (bottom - top, right - left), (left, top))
    rows = slice(tile.inner[0] - top, tile.inner[1] - top)
    columns = slice(tile.inner[2] - left, tile.inner[3] - left)
    return FusedFrame(image[:, rows, columns], depth[rows, columns], confidence[rows, columns])


UNSEEN = 1e-4
"""Confidences up to this say that beta does not see the point: then it does not tell a depth either."""


def _depth(fused: Fused, pieces: list[Strip], hw: HW, corner: tuple[int, int]) -> tuple[Tensor, Tensor]:
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
