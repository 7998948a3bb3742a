"""The usual mistakes in rigs, each with the remedy that undoes it.

A `Remedy` turns the given rig into the rig that is right if that mistake was made. Operations on images that
the rig does not state (rotation, resizing, cropping) are applied to the rig's camera.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import combinations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from arraygeom import Camera, Distortion, LensView, Pose, Rig, View, resize_matrix, rotation_from_vector
from arraygeom.pixels import HW, rot90_matrix, shift_matrix
from arraygeom.pose import rotation_vector

from .parameters import LARGEST_CHANGE, SIGMA

RESIZED = (0.5, 2.0, 0.25, 4.0, 1 / 3, 3.0, 2 / 3, 1.5, 0.75, 4 / 3)
UNITS = {
    1e-3: "millimetres taken for metres",
    1e3: "metres taken for millimetres",
    1e-2: "centimetres taken for metres",
    1e2: "metres taken for centimetres",
}
OFF_CENTRE = 0.05
"""Principal points within this of the middle of the image, as a share of its longer side, are plausible."""
TRANSPOSE = torch.eye(3, dtype=torch.float64)[[1, 0, 2]]
"""Exchanges x and y."""


@dataclass(frozen=True)
class Remedy:
    """A possible mistake: its kind ("resized", "units", ...), description, and the change that undoes it.

    approximate: the change holds numbers that were estimated, and undoes it roughly.
    small: a drift of a calibrated camera's principal point does the same.
    """

    kind: str
    words: str
    repair: Callable[[Rig], Rig]
    approximate: bool = False
    small: bool = False

    def is_plausible(self, rig: Rig) -> bool:
        """Whether a rig may hold this mistake, by its numbers alone.

        Another size and exchanged axes change K by more than a drift does, and take principal points away
        from the middles of images, not towards them. By points alone a drift is taken for such a mistake now
        and then: lines of distant narrow views depend on little but the difference of two principal points.
        """
        if self.kind not in ("resized", "x and y exchanged"):
            return True
        views = zip(rig.cameras.values(), self.repair(rig).cameras.values())
        changed = [
            (a, b) for a, b in views if a is not b and isinstance(a, LensView) and isinstance(b, LensView)
        ]
        nearer = all(_centre_offset(b) <= max(_centre_offset(a), OFF_CENTRE) for a, b in changed)
        return nearer and (not changed or any(_beyond_drift(a.K, b.K) for a, b in changed))


def _beyond_drift(given: Tensor, other: Tensor) -> bool:
    """Whether a focal length or a principal point differs by more than `LARGEST_CHANGE` prior deviations."""
    focal = (other / given - 1).diagonal()[:2].abs().max() / SIGMA["focal"]
    centre = (other - given)[:2, 2].norm() / SIGMA["centre"]
    return bool(torch.maximum(focal, centre) > LARGEST_CHANGE)


def _centre_offset(view: LensView) -> float:
    """Of the principal point from the middle of the image, as a share of its longer side."""
    middle = view.K.new_tensor([view.hw[1] - 1, view.hw[0] - 1]) / 2
    return float((view.K[:2, 2] - middle).norm()) / max(view.hw)


NOTHING = Remedy("nothing", "as given", lambda rig: rig)


def remedies(rig: Rig, sizes: Mapping[str, HW]) -> list[Remedy]:
    """All single mistakes that are possible with a rig whose images have these sizes, likely ones first.

    Where images do not have the sizes that the rig states, only those that explain it.
    """
    names = [name for name in rig.names if name in sizes]
    wrong = tuple(name for name in names if rig[name].hw != sizes[name])
    if wrong:
        return [*_of_sizes(rig, wrong, sizes), *_swapped(rig, names, sizes)]
    return [
        *_swapped(rig, names, sizes),
        *_poses(rig, names),
        *_units(rig),
        *_exchanged(rig, names),
        *_rotated(rig, names, sizes),
        *_scaled(names),
        *_lenses(rig, names),
        *_shifts(names),
    ]


def bare_cameras(rig: Rig, names: Iterable[str]) -> dict[str, Camera]:
    """Those of the cameras that are calibrated and have no lens distortion."""
    return {n: c for n in names if isinstance(c := rig[n], Camera) and c.distortion is None}


def lens_remedy(rig: Rig, names: Iterable[str], k1: float) -> Remedy:
    """Distortion was ignored, and is about `k1` in all cameras that have none.

    With k2 = 1.5 k1^2, as lenses tend to have it (a fisheye's r = theta has 1.8, ordinary wide ones about
    1.3): one parameter, and one to one at any radius.
    """
    bare = bare_cameras(rig, names)
    words = f"distortion ignored: about k1 = {k1:.3f} in {', '.join(map(repr, bare))}"
    lens = Distortion("brown-conrady", torch.tensor([k1, 1.5 * k1**2, 0, 0], dtype=torch.float64))
    repair = partial(on_cameras, names=bare, change=lambda c: c.replace(distortion=lens))
    return Remedy("distortion", words, repair, approximate=True)


TURNS = tuple(range(-29, 29))
"""Whole turns, in radians, that may be missing from a rotation vector in degrees: it is at most 180 long."""


def from_degrees(R: Float[Tensor, "3 3"], turns: Int[Tensor, "*b"]) -> Float[Tensor, "*b 3 3"]:
    """The rotations whose vector was in degrees, so many turns longer, and was taken for radians."""
    vector = rotation_vector(R)
    angle = vector.norm()
    whole = torch.deg2rad(angle + 2 * math.pi * turns)[..., None]
    return rotation_from_vector(vector / angle.clamp(min=1e-12) * whole)


def degrees_remedy(turns: Mapping[str, int]) -> Remedy:
    """Rotation vectors of cameras were in degrees, taken for radians; `turns` of each are missing."""

    def repair(rig: Rig) -> Rig:
        for name, missing in turns.items():
            change = partial(_with_rotation, missing=missing)
            rig = on_cameras(rig, [name], change)
        return rig

    return Remedy("degrees and radians", "rotation of all cameras in degrees, taken for radians", repair)


def _with_rotation(camera: Camera, missing: int) -> Camera:
    return camera.replace(cam_from_world=Pose(from_degrees(camera.R, torch.tensor(missing)), camera.t))


def mirror_matrix(hw: HW, *, across: bool) -> Float[Tensor, "3 3"]:
    """The pixel map of mirroring an image left to right (`across`), or top to bottom.

    >>> (mirror_matrix((4, 6), across=True) @ torch.tensor([5.0, 1.0, 1.0], dtype=torch.float64)).tolist()
    [0.0, 1.0, 1.0]
    """
    A = torch.eye(3, dtype=torch.float64)
    axis = 0 if across else 1
    A[axis, axis], A[axis, 2] = -1, hw[1 - axis] - 1
    return A


ROTATIONS: dict[str, Callable[[HW], Tensor]] = {
    "rotated by 180 degrees": lambda hw: rot90_matrix(hw, 2),
    "rotated by 90 degrees counter-clockwise": lambda hw: rot90_matrix(hw, 1),
    "rotated by 90 degrees clockwise": lambda hw: rot90_matrix(hw, 3),
    "mirrored left to right": lambda hw: mirror_matrix(hw, across=True),
    "mirrored top to bottom": lambda hw: mirror_matrix(hw, across=False),
    "mirrored about the diagonal (rows and columns exchanged)": lambda hw: TRANSPOSE,
    "mirrored about the other diagonal": lambda hw: rot90_matrix(hw[::-1], 2) @ TRANSPOSE,
}
"""Rotations and mirrorings of an image of a size: x' ~ A x."""


def rotated_view(view: View, words: str) -> tuple[Float[Tensor, "3 3"], HW]:
    """A and the new size of one of `ROTATIONS`."""
    A = ROTATIONS[words](view.hw)
    return A, view.hw[::-1] if bool(A[0, 0] == 0) else view.hw


def swap(rig: Rig, a: str, b: str) -> Rig:
    """The rig in which two names have exchanged their cameras."""
    other = {a: b, b: a}
    cameras = {n: rig[other.get(n, n)] for n in rig.names}
    links = {(other.get(i, i), other.get(j, j)): link for (i, j), link in rig.links.items()}
    return rig.replace(cameras=cameras, links=links)


def on_cameras(rig: Rig, names: Iterable[str], change: Callable[[Camera], Camera]) -> Rig:
    """The rig with the calibrated ones among some cameras changed."""
    changed = {n: change(c) for n in names if isinstance(c := rig[n], Camera)}
    return rig.replace(cameras={**rig.cameras, **changed})


def on_pixels(rig: Rig, names: Iterable[str], change: Callable[[str, View], tuple[Tensor, HW]]) -> Rig:
    """The rig with the pixels of some cameras transformed: x' ~ A x, and the new size."""
    for name in names:
        rig = rig.transformed(name, *change(name, rig[name]))
    return rig


def _groups(names: Iterable[str]) -> Iterator[tuple[tuple[str, ...], str]]:
    """All cameras together, then one by one; with a label."""
    names = tuple(names)
    if names:
        yield names, "all cameras"
        yield from (((n,), f"'{n}'") for n in names)


def _calibrated(rig: Rig, names: Iterable[str]) -> list[str]:
    return [n for n in names if isinstance(rig[n], Camera)]


def _swapped(rig: Rig, names: list[str], sizes: Mapping[str, HW]) -> Iterator[Remedy]:
    for a, b in combinations(names, 2):
        if rig[a].hw == sizes[b] and rig[b].hw == sizes[a]:
            yield Remedy("cameras swapped", f"images of '{a}' and '{b}' swapped", partial(swap, a=a, b=b))


def _of_other_axes(pose: Pose) -> Pose:
    """The same camera where y was upwards and z backwards, as in OpenGL and Blender."""
    D = torch.diag(pose.t.new_tensor([1, -1, -1]))
    return Pose(D @ pose.R, D @ pose.t)


def _reordered(pose: Pose, order: list[int]) -> Pose:
    return Pose.from_quaternion(pose.quaternion[..., order], pose.t)


POSES: dict[tuple[str, str], Callable[[Pose], Pose]] = {
    ("pose inverted", "pose of {} inverted (world from camera)"): Pose.inverse,
    ("sign of t", "translation of {} with the wrong sign"): lambda pose: Pose(pose.R, -pose.t),
    ("R transposed", "R of {} transposed"): lambda pose: Pose(pose.R.mT, pose.t),
    ("centre as t", "t of {} is the camera's centre"): lambda pose: Pose.from_centre(pose.R, pose.t),
    ("OpenGL axes", "axes of {} are OpenGL's (y upwards, z backwards)"): _of_other_axes,
    ("order of quaternions", "quaternion of {} is w, x, y, z and was read as x, y, z, w"): partial(
        _reordered, order=[1, 2, 3, 0]
    ),
    ("order of quaternions", "quaternion of {} is x, y, z, w and was read as w, x, y, z"): partial(
        _reordered, order=[3, 0, 1, 2]
    ),
    ("degrees and radians", "rotation of {} in radians, taken for degrees"): lambda pose: Pose(
        rotation_from_vector(torch.rad2deg(rotation_vector(pose.R))), pose.t
    ),
}
"""Mistakes in a pose, and what undoes them."""


def _poses(rig: Rig, names: list[str]) -> Iterator[Remedy]:
    for (kind, words), change in POSES.items():
        for group, label in _groups(_calibrated(rig, names)):
            yield Remedy(kind, words.format(label), partial(_with_poses, names=group, change=change))


def _with_poses(rig: Rig, names: Iterable[str], change: Callable[[Pose], Pose]) -> Rig:
    return on_cameras(rig, names, lambda c: c.replace(cam_from_world=change(c.cam_from_world)))


def _units(rig: Rig) -> Iterator[Remedy]:
    for factor, words in UNITS.items() if rig.depth is not None else ():
        scaled = partial(lambda pose, factor: Pose(pose.R, pose.t * factor), factor=factor)
        words = f"translations against the depth range: {words}"
        yield Remedy("units", words, partial(_with_poses, names=rig.names, change=scaled))


def _exchanged(rig: Rig, names: list[str]) -> Iterator[Remedy]:
    for group, label in _groups(_calibrated(rig, names)):
        words = f"x and y exchanged in focal lengths and principal point of {label}"
        yield Remedy("x and y exchanged", words, partial(on_cameras, names=group, change=_transposed))
    if rig.links:
        words = "x and y exchanged in F (it is for row, column)"
        repair = partial(on_pixels, names=names, change=lambda _, view: (TRANSPOSE, view.hw))
        yield Remedy("x and y exchanged", words, repair)


def _transposed(camera: Camera) -> Camera:
    P = TRANSPOSE.to(camera.K)
    return camera.replace(K=P @ camera.K @ P)


def _rotated(rig: Rig, names: list[str], sizes: Mapping[str, HW]) -> Iterator[Remedy]:
    """Images rotated or mirrored after calibration, where the sizes allow it."""
    for words in ROTATIONS:
        for group, label in _groups(names):
            yield from _rotated_group(rig, group, label, words, sizes)


def _rotated_group(
    rig: Rig, group: tuple[str, ...], label: str, words: str, sizes: Mapping[str, HW]
) -> Iterator[Remedy]:
    if all(rotated_view(rig[n], words)[1] == sizes[n] for n in group):
        repair = partial(on_pixels, names=group, change=lambda _, view: rotated_view(view, words))
        yield Remedy("rotated or mirrored", f"image of {label} {words}", repair)


def _scaled(names: list[str]) -> Iterator[Remedy]:
    """K is for images of another size than the rig states."""
    for factor in RESIZED:
        A = torch.diag(torch.tensor([factor, factor, 1.0], dtype=torch.float64))
        A[:2, 2] = 0.5 * factor - 0.5
        for group, label in _groups(names):
            words = f"K of {label} is for images {1 / factor:.3g} times as large"
            yield Remedy("resized", words, _same_size(group, A))


def _shifts(names: list[str]) -> Iterator[Remedy]:
    for pixels, kind in ((0.5, "half-pixel shift"), (1.0, "one-pixel shift")):
        for group, label in _groups(names):
            for shift in (-pixels, pixels):
                words = f"pixels of {label} are {shift:+g} from where the rig counts them"
                yield Remedy(kind, words, _same_size(group, shift_matrix(-shift, -shift)), small=True)


def _same_size(names: tuple[str, ...], A: Tensor) -> Callable[[Rig], Rig]:
    """The repair x' ~ A x of the pixels of some cameras, whose image sizes stay."""
    return partial(on_pixels, names=names, change=lambda _, view: (A, view.hw))


def _of_sizes(rig: Rig, wrong: tuple[str, ...], sizes: Mapping[str, HW]) -> Iterator[Remedy]:
    """Explanations of image sizes other than those that the rig states."""
    label = ", ".join(map(repr, wrong))
    if all(rig[n].hw == sizes[n][::-1] for n in wrong):
        for words in ROTATIONS:
            yield from _rotated_group(rig, wrong, label, words, sizes)
        words = f"size of {label} written as height, width"
        yield Remedy("x and y exchanged", words, _to_sizes(wrong, sizes, _cropped_at_corner))
    for words, matrix in FITS.items():
        yield Remedy("resized", f"image of {label} {words}", _to_sizes(wrong, sizes, matrix))


def _cropped_at_corner(old: HW, new: HW) -> Tensor:
    return shift_matrix(0, 0)


FITS: dict[str, Callable[[HW, HW], Tensor]] = {
    "resized": resize_matrix,
    "cropped about its middle": lambda old, new: shift_matrix((old[1] - new[1]) / 2, (old[0] - new[0]) / 2),
    "cropped at the right and the bottom": _cropped_at_corner,
}
"""How an image may have come to another size."""


def _to_sizes(
    names: Iterable[str], sizes: Mapping[str, HW], matrix: Callable[[HW, HW], Tensor]
) -> Callable[[Rig], Rig]:
    return partial(
        on_pixels, names=names, change=lambda name, view: (matrix(view.hw, sizes[name]), sizes[name])
    )


def _lenses(rig: Rig, names: list[str]) -> Iterator[Remedy]:
    curved = [n for n in _calibrated(rig, names) if n not in bare_cameras(rig, names)]
    for group, label in _groups(curved):
        drop = partial(on_cameras, names=group, change=lambda camera: camera.replace(distortion=None))
        negate = partial(on_cameras, names=group, change=_opposite_lens)
        yield Remedy(
            "distortion", f"images of {label} are undistorted already: distortion applied twice", drop
        )
        yield Remedy("distortion", f"distortion of {label} with the wrong sign (the inverse map)", negate)


def _opposite_lens(camera: Camera) -> Camera:
    lens = camera.distortion
    return camera if lens is None else camera.replace(distortion=Distortion(lens.model, -lens.coefficients))
