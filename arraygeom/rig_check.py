"""Plausibility checks of a rig: possible numbers that are more often than not mistakes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, combinations, pairwise
from typing import TypeVar

import torch
from torch import Tensor

from .camera import Camera, LensView, View
from .checks import derived
from .distortion import BROWN_CONRADY, Distortion
from .fields.default import recorded_field
from .lens_coverage import LensKey, coverage, normalised, once_a_lens
from .pair import Pair
from .pixels import HW, coarse_grid
from .rig import Rig
from .runtime.text import length_unit

T = TypeVar("T")

SMALLEST_BASELINE, LARGEST_BASELINE = 1e-4, 50.0
"""Bounds of a baseline in metres: outside, a mistaken unit is more likely than a camera array."""
NARROWEST, WIDEST = 0.5, 140.0
"""Bounds of a pinhole's angle of view in degrees: outside, its focal length is hardly in pixels. (A 1 m lens
on an inch of sensor has 1.5, the widest rectilinear lenses have 130.)"""
DECENTRED = 0.1
"""Distance of a principal point from the image's middle, as a share of its longer side, above which it is
more likely of another image: exchanging the sides of a 4:3 image moves it by 0.18, halving by 0.3."""
LEAST_DISPARITY = 0.5
"""Pixels of disparity between near and far below which depth is not seen."""
COVERED = 0.995
"""Share of an image below which the end of its lens model is reported."""
OFF_BACK = 0.05
"""Error in pixels of projecting a pixel's ray that is tolerated: lenses in float32 err by thousandths."""
MOST_CAMERAS = 16
"""Number of cameras above which each is compared with the next alone, as there are many pairs."""
MOST_PAIRS = 120
"""Number of pairs, evenly spread over the rig, whose overlap is computed: all of `MOST_CAMERAS` cameras."""
MOST_LENSES = 120
"""Number of different lenses, evenly spread over the rig, that are checked."""
RANK = 1e-3
"""Ratio of F's least to largest singular value above which it is not of rank two."""


def oddities(rig: Rig) -> tuple[str, ...]:
    """List what is odd about a rig, a sentence each; for a batch, of its first rig."""
    if rig.batch_shape:
        rig = rig[(0,) * len(rig.batch_shape)]
    with torch.no_grad():
        return tuple(derived(list, _all(rig)))


def unit_oddity(rig: Rig) -> str | None:
    """Return a sentence on a single rig's baselines that suggest another unit than metres.

    Returns:
        The sentence without its subject ("has cameras 80 m apart: ..."); None for usual baselines, all
        cameras at one place, fewer than two calibrated ones, and a rig of unknown scale.

    Raises:
        ValueError: for a batch of rigs.
    """
    if rig.batch_shape:
        raise ValueError(f"a batch of rigs {tuple(rig.batch_shape)}: give one of them, as rig[0]")
    centres = [camera.centre for camera in rig.cameras.values() if isinstance(camera, Camera)]
    if len(centres) < 2 or length_unit(rig) != "m":
        return None
    places = torch.stack(centres)
    longest, end = 0.0, places[0]
    for _ in range(3):  # from end to end: without the distances of all pairs
        distances = (places - end).norm(dim=-1)
        longest, end = max(longest, float(distances.max())), places[distances.argmax()]
    if longest > LARGEST_BASELINE:
        return (
            f"has cameras {longest:.3g} m apart: is this file in millimetres? "
            "Then convert it (`pat rig convert`) and write units: millimetres, which its depth is in, too, "
            "or read it by `arraygeom.io.read_rig(path, scale=0.001)`; "
            "if its scale is arbitrary, all is well"
        )
    if 0 < longest < SMALLEST_BASELINE:
        return (
            f"has cameras at most {1e3 * longest:.3g} mm apart: is this file in metres, "
            "and read as millimetres? Then read it by `arraygeom.io.read_rig(path, scale=1000)`"
        )
    return None


def _lenses(rig: Rig) -> list[tuple[list[str], LensView]]:
    """Different lenses, `MOST_LENSES` at most: for each the names of its cameras, and one of these."""
    groups: dict[LensKey, list[str]] = {}
    for name, camera in rig.cameras.items():
        if isinstance(camera, LensView) and camera.distortion is not None:
            groups.setdefault(LensKey(camera), []).append(name)
    lenses = [(names, rig[names[0]]) for names in groups.values()]
    return _spread(lenses, MOST_LENSES)


def _spread(items: Sequence[T], most: int) -> list[T]:
    """At most so many of the items, evenly spread."""
    return list(items[:: -(-len(items) // most) or 1])


def lens_ends(lenses: Iterable[tuple[Sequence[str], LensView]]) -> Iterator[str]:
    """Yield a sentence on lens models that end within their images, with the names of their cameras.

    Lenses that end alike share a sentence. A `CameraModel` states itself where it ends (a pole, the rim of a
    fisheye's circle), which is no mistake unless it covers nothing.

    Args:
        lenses: for each lens the names of its cameras, and one of these, single.
    """
    ending: dict[tuple[str, str, str], list[str]] = {}
    for names, camera in lenses:
        covered = coverage(camera)
        stated = covered.share > 0 and not isinstance(camera.distortion, Distortion)
        if stated or covered.share >= COVERED:
            continue
        refit = ": check the coefficients"
        if isinstance(camera.distortion, Distortion) and camera.distortion.model == BROWN_CONRADY:
            refit = ", as at a pole or a fold of its formula; fit one without: `pat rig convert --refit`"
        where = f"ends {covered.degrees:.1f} degrees off the axis" if covered.share else "covers nothing"
        ending.setdefault((where, f"{100 * (1 - covered.share):.0f}", refit), []).extend(names)
    for (where, unused, refit), names in ending.items():
        yield f"the lens model of {_listed(names)} {where}: {unused} % of its image is not used{refit}"


def _listed(names: Sequence[str]) -> str:
    """Return up to three names, and the number of the others."""
    more = [f"{len(names) - 3} more"] * (len(names) > 3)
    return " and ".join([", ".join(f"'{name}'" for name in names[:3]), *more])


def file_oddities(rig: Rig) -> list[str]:
    """List the sentences that reading a rig's file warns of: its unit, lenses that fold in their images."""
    ends = lens_ends(
        one for one in _lenses(rig) if getattr(one[1].distortion, "model", None) == BROWN_CONRADY
    )
    unit = unit_oddity(rig)
    return [*([] if unit is None else [unit]), *ends]


def _all(rig: Rig) -> Iterator[str]:
    """Sentences on units, lenses, K, overlap, positions, baselines, F."""
    if unit := unit_oddity(rig):
        yield f"the rig {unit}"
    lenses = _lenses(rig)
    yield from lens_ends(one for one in lenses if not _round_trip(one[1])[1])
    for names, camera in lenses:
        if (lens := camera.distortion) is not None and not (off := _round_trip(camera)[0]) <= OFF_BACK:
            yield (
                f"the model of {_listed(names)}, {lens.model}, projects the rays of its pixels "
                f"up to {off:.3g} px off them: project and unproject are to be the inverse of one another"
            )
    names = [name for name, camera in rig.cameras.items() if isinstance(camera, Camera)]
    for name in names:
        yield from _of_K(name, rig[name])
    pairs = list(combinations(names, 2)) if len(names) <= MOST_CAMERAS else list(pairwise(names))
    compared, small = _spread(pairs, MOST_PAIRS), rig
    if not rig.links:
        small = rig.replace(
            cameras={n: rig[n].resize(_reduced(rig[n].hw)) for n in dict.fromkeys(chain(*compared))}
        )
    for one, other in [order for pair in compared for order in (pair, pair[::-1])]:
        # a few pixels decide most pairs: through lenses all take seconds
        if not _overlap(small.pair(one, other)) and not _overlap(rig.pair(one, other)):
            near, far = map(float, rig.depth or (0, 0))
            bounds = f" between {near:g} and {far:g} {length_unit(rig)}" if rig.depth is not None else ""
            yield (
                f"'{other}' sees nothing of what '{one}' sees{bounds}: check the poses, "
                "which are X_cam = R X_world + t with z forward and y down (OpenGL's look along -z), "
                "and the depth range"
            )
    yield from _of_positions(rig, pairs)
    for pair in pairs:
        yield from _of_baseline(rig, *pair)
    yield from _of_sides(rig)
    for (alpha, beta), link in rig.links.items():
        values = torch.linalg.svdvals(link.F.double())
        if values[0] == 0 or values[2] > RANK * values[0]:
            yield f"F of '{alpha}' and '{beta}' is not of rank two: was it copied whole?"


def _grid(camera: View) -> Tensor:
    """Pixels all over an image: at most 64 in a row, for huge images too."""
    return coarse_grid(camera.hw, max(16, max(camera.hw) // 64))


def _of_K(name: str, camera: Camera) -> Iterator[str]:
    """Sentences on a mirrored image, an unlikely focal length, a principal point far off the middle."""
    (h, w), K = camera.hw, camera.K.double()
    focal = float(K[:2, :2].det().abs().sqrt())
    if K[:2, :2].det() < 0:
        yield f"'{name}' has a focal length below 0: its image is mirrored"
    across = float(torch.rad2deg(2 * torch.atan(torch.tensor(max(h, w) / (2 * focal)))))
    if camera.distortion is None and not NARROWEST < across < WIDEST:
        yield (
            f"'{name}' has a focal length of {focal:.4g} px, {across:.3g} degrees across its {w}x{h} pixels: "
            "is it in pixels, of images of this size?"
        )
    off = (K[:2, 2] - K.new_tensor([(w - 1) / 2, (h - 1) / 2])).norm()
    if off > DECENTRED * max(h, w):
        x, y = K[:2, 2].tolist()
        yield (
            f"'{name}' has its principal point at ({x:.4g}, {y:.4g}), {off:.3g} px from the middle of "
            f"{w}x{h}: is hw (height, width), and K of whole images of this size?"
        )


@once_a_lens
def _round_trip(camera: LensView) -> tuple[float, bool]:
    """Largest error in pixels of projecting the rays of pixels back, and whether all of them have rays."""
    lens = camera.distortion
    assert lens is not None
    points = normalised(camera, _grid(camera).to(camera.K))
    directions, has_ray = lens.unproject(points)
    back, has_image = lens.project(lens.origins(points) + directions)
    valid, off = has_ray & has_image, ((back - points) @ camera.K[:2, :2].mT).norm(dim=-1)
    return float(torch.where(valid, off, 0.0).max()), bool(valid.all())


def _reduced(hw: HW) -> HW:
    """Size of an image reduced to at most 128 pixels a side, of the same shape."""
    scale = min(1.0, 128 / max(hw))
    return max(1, round(scale * hw[0])), max(1, round(scale * hw[1]))


def _overlap(pair: Pair) -> bool:
    """True if the segment of any pixel of a grid reaches beta's image, and where no segment is known."""
    if pair.depth is None and not (pair.alpha.has_pinhole_view and pair.beta.has_pinhole_view):
        return True
    locations = recorded_field(pair)(pair, _grid(pair.alpha).to(pair.cameras[0].K))
    return bool((locations.valid if hasattr(locations, "valid") else locations.mask).any())


def _of_positions(rig: Rig, pairs: Iterable[tuple[str, str]]) -> Iterator[str]:
    """One sentence for all cameras at one position."""
    together: dict[tuple[float, ...], dict[str, None]] = {}
    for pair in pairs:
        if bool((rig[pair[0]].centre == rig[pair[1]].centre).all()):
            together.setdefault(tuple(rig[pair[0]].centre.tolist()), {}).update(dict.fromkeys(pair))
    for names in together.values():
        *others, last = (f"'{name}'" for name in names)
        yield f"{', '.join(others)} and {last} are at the same position: between them depth has no effect"


def _of_baseline(rig: Rig, a: str, b: str) -> Iterator[str]:
    """Sentences on a baseline out of proportion to the depth range."""
    baseline, unit = float((rig[a].centre - rig[b].centre).norm()), length_unit(rig)
    question = f"are depth and poses both in {'metres' if unit == 'm' else unit}?"
    if baseline > 0 and rig.depth is not None:
        near, far = map(float, rig.depth)
        focal = float(rig[b].K[:2, :2].det().abs().sqrt())
        moved = focal * baseline * (1 / near - 1 / far)
        if near < far and moved < LEAST_DISPARITY:
            yield (
                f"'{a}' and '{b}' are {baseline:.3g} {unit} apart: from {near:g} to {far:g} {unit} a match "
                f"moves by {moved:.2g} px; {question}"
            )
        if focal * baseline / far > 2 * max(rig[b].hw) * focal / float(rig[a].K[:2, :2].det().abs().sqrt()):
            yield (
                f"'{a}' and '{b}' are {baseline:.3g} {unit} apart, which is more than the depth of "
                f"{far:g} {unit} allows: {question}"
            )


def _of_sides(rig: Rig) -> Iterator[str]:
    """Return a sentence on cameras called left and right that are the other way round."""
    left, right = rig.cameras.get("left"), rig.cameras.get("right")
    if (
        isinstance(left, Camera)
        and isinstance(right, Camera)
        and left.cam_from_world.apply(right.centre)[0] < 0
    ):
        yield "'right' is to the left of 'left': is t a position (t is -R times that), or of the wrong sign?"
