"""The usual mistakes in rigs: a table of hypotheses, each with the rig that is right if it holds.

A change of images that the rig does not state (rotation, resizing, cropping) is applied to the rig's camera.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations

import torch
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation
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
SHIFTS = {"half-pixel shift": 0.5, "one-pixel shift": 1.0}
"""Shifts of pixels by kind; a drift of a calibrated camera's principal point has the same effect."""
OFF_CENTRE, FAR_OFF = 0.05, 0.175
"""Standard deviation of a principal point from the image's middle, as a share of the longer side; and the
distance beyond which it is that of no whole image."""
FOCAL_SHARE, FOCAL_SPREAD = 1.2, 0.7
"""Median focal length as a share of the image's longer side, and the standard deviation of its logarithm."""
SHORTEST_FOCAL = 0.2
"""Least focal length in pixels, as a share of the image's longer side: shorter ones are in another unit."""
TRANSPOSE = torch.eye(3, dtype=torch.float64)[[1, 0, 2]]
"""Matrix that exchanges x and y."""
OPENGL = Pose(torch.diag(torch.tensor([1, -1, -1], dtype=torch.float64)), torch.zeros(3, dtype=torch.float64))
"""Pose from the axes of OpenGL and Blender, y upwards and z backwards."""
TURNS = tuple(range(-29, 29))
"""Whole turns, in radians, that may be missing from a rotation vector in degrees: it is at most 180 long."""

Change = Callable[[Rig, Sequence[str]], Rig]
"""Function from a rig and names of cameras to the rig in which these are changed."""
Group = tuple[Sequence[str], str]
"""Names of cameras, and their common label."""


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A possible mistake, with the rig that is right if it was made. Instances compare by identity.

    Attributes:
        kind: kind of mistake, such as "resized" or "units"; "nothing" for the rig as given.
        words: description in words, without a full stop.
        rig: the repaired rig.
        approximate: True if numbers of that rig were estimated.
    """

    kind: str
    words: str
    rig: Rig
    approximate: bool = False


def hypotheses(rig: Rig, sizes: Mapping[str, HW]) -> list[Hypothesis]:
    """List the rig as given, and the single mistakes plausible in a rig whose images have these sizes.

    Mistakes whose repair must be estimated from points are left out (`ignored_lens`, `zoomed`, `cropped`,
    `in_degrees`), and mistakes in cameras without a size. Where images do not have the sizes (height, width)
    that the rig states, only mistakes that explain them are listed.

    Returns:
        Hypotheses, "nothing" first, then likely ones before others.
    """
    names = [name for name in rig.names if name in sizes]
    wrong = [name for name in names if rig[name].hw != sizes[name]]
    candidates = [
        Hypothesis("cameras swapped", f"images of '{a}' and '{b}' swapped", swap(rig, a, b))
        for a, b in combinations(names, 2)
    ]
    if wrong:
        candidates = [*_of_sizes(rig, wrong, sizes), *candidates]
    else:
        candidates = [h for h in [*candidates, *_of_numbers(rig, names)] if _is_plausible(rig, h)]
    fitting = [h for h in candidates if all(h.rig[name].hw == sizes[name] for name in names)]
    return [Hypothesis("nothing", "as given", rig), *fitting]


def _is_plausible(rig: Rig, hypothesis: Hypothesis) -> bool:
    """Return True if a rig may hold this mistake, by its numbers alone.

    Another size and exchanged axes change K by more than a drift does, and take principal points away from
    the middles of images, not towards them. By points alone a drift is taken for such a mistake now and then:
    lines of distant narrow views depend on little but the difference of two principal points.
    """
    if hypothesis.kind not in ("resized", "x and y exchanged"):
        return True
    views = zip(rig.cameras.values(), hypothesis.rig.cameras.values())
    changed = [(a, b) for a, b in views if a is not b and isinstance(a, LensView) and isinstance(b, LensView)]
    nearer = all(_centre_offset(b) <= max(_centre_offset(a), OFF_CENTRE) for a, b in changed)
    return nearer and (not changed or any(_beyond_drift(a.K, b.K) for a, b in changed))


def _beyond_drift(K: Tensor, changed_K: Tensor) -> bool:
    """Return True if a focal length or principal point differs by `LARGEST_CHANGE` prior deviations."""
    focal = (changed_K / K - 1).diagonal()[:2].abs().max() / SIGMA["focal"]
    centre = (changed_K - K)[:2, 2].norm() / SIGMA["centre"]
    return bool(torch.maximum(focal, centre) > LARGEST_CHANGE)


def unlikelihood(rig: Rig) -> float:
    """Return -2 log probability of a rig's focal lengths and principal points by its images' sizes.

    The least likely camera counts alone, as those of one kind share their oddities; a constant is left out.
    """
    views = [view for view in rig.cameras.values() if isinstance(view, LensView)]
    off_centre = [_centre_offset(view) / OFF_CENTRE for view in views]
    focal = [math.log(focal_length_of(view) / (FOCAL_SHARE * max(view.hw))) / FOCAL_SPREAD for view in views]
    return max((c**2 + f**2 for c, f in zip(off_centre, focal)), default=0.0)


def is_short(view: LensView) -> bool:
    """Return True if the focal length is too short to be in pixels of such an image."""
    return focal_length_of(view) < SHORTEST_FOCAL * max(view.hw)


def focal_length_of(view: LensView) -> float:
    """Return the mean focal length, pixels, also of images that were rotated or mirrored."""
    return float(view.K[:2, :2].det().abs().sqrt())


def _centre_offset(view: LensView) -> float:
    """Return the principal point's distance from the image's middle, as a share of its longer side."""
    return float((view.K[:2, 2] - _middle(view)).norm()) / max(view.hw)


def _middle(view: LensView) -> Tensor:
    return view.K.new_tensor([view.hw[1] - 1, view.hw[0] - 1]) / 2


def ignored_lens(rig: Rig, bare: Sequence[str], k1: float) -> Hypothesis:
    """Build the hypothesis that distortion of about `k1` was ignored in some cameras.

    k2 is 1.5 k1^2, as lenses tend to have it: one parameter, and one to one at any radius.

    Args:
        bare: names of the cameras, which have no lens.
        k1: first radial coefficient of Brown-Conrady.

    Returns:
        The hypothesis, with the rig in which the calibrated ones of these cameras have that lens.
    """
    words = f"distortion ignored: about k1 = {k1:.3f} in {', '.join(map(repr, bare))}"
    lens = Distortion("brown-conrady", torch.tensor([k1, 1.5 * k1**2, 0, 0], dtype=torch.float64))
    bent = on_cameras(rig, bare, lambda camera: camera.replace(distortion=lens))
    return Hypothesis("distortion", words, bent, approximate=True)


def from_degrees(R: Float[Tensor, "3 3"], turns: Int[Tensor, "*b"]) -> Float[Tensor, "*b 3 3"]:
    """Correct a rotation whose vector was in degrees and was taken for radians.

    Args:
        R: rotation as read.
        turns: numbers of whole turns to add to its angle first, as a vector in degrees is longer than a turn.

    Returns:
        The corrected rotation for each number of turns, (*b, 3, 3).
    """
    vector = rotation_vector(R)
    angle = vector.norm()
    whole = torch.deg2rad(angle + 2 * math.pi * turns)[..., None]
    return rotation_from_vector(vector / angle.clamp(min=1e-12) * whole)


def zoomed(rig: Rig, names: Sequence[str], factor: float) -> Hypothesis:
    """Build the hypothesis that the true focal lengths of some cameras are `factor` times those of the rig.

    They were stated in another unit, or the image was zoomed or cropped.

    Args:
        names: names of the cameras, one at least, calibrated.

    Returns:
        The hypothesis, with the rig whose focal lengths are multiplied; principal points and links stay.
    """
    who = ", ".join(map(repr, names))
    short = all(is_short(rig[name]) for name in names)
    words = f"focal length of {who} in millimetres" if short else f"image of {who} zoomed or cropped"

    words += f": about {focal_length_of(rig[names[0]]) * factor:.0f} px"
    scale = torch.diag(torch.tensor([factor, factor, 1.0], dtype=torch.float64))
    change = partial(_partly_scaled, scale, slice(0, 2))
    return Hypothesis("focal length", words, on_cameras(rig, names, change), approximate=True)


def may_be_cropped(rig: Rig, name: str) -> bool:
    """Return True if a camera's principal point is farther from the image's middle than in whole images."""
    return isinstance(rig[name], Camera) and _centre_offset(rig[name]) > FAR_OFF


def centred(rig: Rig, names: Sequence[str]) -> Rig:
    """Return the rig with these cameras' principal points in the middle of their images."""

    def change(camera: Camera) -> Camera:
        K = camera.K.clone()
        K[:2, 2] = _middle(camera)
        return camera.replace(K=K)

    return on_cameras(rig, names, change)


def cropped(rig: Rig, names: Sequence[str]) -> Hypothesis:
    """Build the hypothesis that images of some cameras were cropped, and K was for the whole images.

    Args:
        rig: the rig with principal points of the images as they are.
        names: names of the cameras, one at least, calibrated.

    Returns:
        The hypothesis, with that rig as it is.
    """
    u, v = (float(c) for c in rig[names[0]].K[:2, 2])
    words = f"image of {', '.join(map(repr, names))} cropped: principal point at about ({u:.0f}, {v:.0f})"
    return Hypothesis("cropped", words, rig, approximate=True)


def in_degrees(rig: Rig, turns: Mapping[str, int]) -> Hypothesis:
    """Build the hypothesis that rotation vectors in degrees were taken for radians.

    Args:
        turns: whole turns missing from the vector of each camera, by name, calibrated; other cameras stay.

    Returns:
        The hypothesis, with the rig whose rotations are corrected.
    """
    cameras = dict(rig.cameras)
    for name, missing in turns.items():
        pose = Pose(from_degrees(rig[name].R, torch.tensor(missing)), rig[name].t)
        cameras[name] = rig[name].replace(cam_from_world=pose)
    words = "rotation of all cameras in degrees, taken for radians"
    return Hypothesis("degrees and radians", words, rig.replace(cameras=cameras))


ROTATIONS = {
    "rotated by 180 degrees": (2, False),
    "rotated by 90 degrees counter-clockwise": (1, False),
    "rotated by 90 degrees clockwise": (3, False),
    "mirrored left to right": (3, True),
    "mirrored top to bottom": (1, True),
    "mirrored about the diagonal (rows and columns exchanged)": (0, True),
    "mirrored about the other diagonal": (2, True),
}
"""Rotations and mirrorings of an image: quarter turns, and True if x and y are exchanged first."""


def rotated_view(view: View, words: str) -> tuple[Float[Tensor, "3 3"], HW]:
    """Compute the pixel map and image size of a view after one of `ROTATIONS`.

    Args:
        words: key of `ROTATIONS`, such as "rotated by 180 degrees".

    Returns:
        A (3, 3) of x' ~ A x, float64, and the new height and width.

    Raises:
        KeyError: for `words` that are not in `ROTATIONS`.
    """
    turns, exchanged = ROTATIONS[words]
    hw = view.hw[::-1] if exchanged else view.hw
    A = rot90_matrix(hw, turns)
    return A @ TRANSPOSE if exchanged else A, hw[::-1] if turns % 2 else hw


def swap(rig: Rig, a: str, b: str) -> Rig:
    """Return the rig in which two names have exchanged their cameras, links included."""
    other = {a: b, b: a}
    cameras = {n: rig[other.get(n, n)] for n in rig.names}
    links = {(other.get(i, i), other.get(j, j)): link for (i, j), link in rig.links.items()}
    return rig.replace(cameras=cameras, links=links)


def on_cameras(rig: Rig, names: Iterable[str], change: Callable[[Camera], Camera]) -> Rig:
    """Return the rig with the calibrated ones among these cameras changed."""
    changed = {n: change(c) for n in names if isinstance(c := rig[n], Camera)}
    return rig.replace(cameras={**rig.cameras, **changed})


def on_pixels(rig: Rig, names: Iterable[str], change: Callable[[str, View], tuple[Tensor, HW]]) -> Rig:
    """Return the rig with the pixels of these cameras transformed.

    Args:
        change: function from a name and its view to A of x' ~ A x and the new size.
    """
    for name in names:
        rig = rig.transformed(name, *change(name, rig[name]))
    return rig


def _poses(change: Callable[[Pose], Pose]) -> Change:
    return partial(on_cameras, change=lambda c: c.replace(cam_from_world=change(c.cam_from_world)))


def _same_size(A: Tensor) -> Change:
    """Return the change that maps pixels by x' ~ A x and keeps image sizes."""
    return partial(on_pixels, change=lambda _, view: (A, view.hw))


def _partly_scaled(A: Float[Tensor, "3 3"], columns: slice, camera: Camera) -> Camera:
    """Return the camera with these columns of K for pixels x' ~ A x."""
    K = camera.K.clone()
    K[:2, columns] = (A.to(K) @ K)[:2, columns]
    return camera.replace(K=K)


def _opposite_lens(camera: Camera) -> Camera:
    lens = camera.distortion
    assert lens is not None
    return camera.replace(distortion=lens.with_coefficients(-lens.coefficients))


def _mirrored(axis: str, rotated: bool, pose: Pose) -> Pose:
    """Return the pose with an axis reversed in the translation and, if `rotated`, in the rotation too."""
    S = torch.ones(3).to(pose.t)
    S["xyz".index(axis)] = -1
    return Pose(S[:, None] * pose.R * S if rotated else pose.R, S * pose.t)


def _reversed_angles(order: str, pose: Pose) -> Pose:
    """Return the pose whose rotation is by the same angles about the axes in the opposite order."""
    angles = Rotation.from_matrix(pose.R.detach().cpu().numpy()).as_euler(order.upper())
    R = Rotation.from_euler(order[::-1].upper(), angles[::-1]).as_matrix()
    return Pose(torch.from_numpy(R).to(pose.R), pose.t)


POSES: dict[tuple[str, str], Callable[[Pose], Pose]] = {
    ("pose inverted", "pose of {} inverted (world from camera)"): Pose.inverse,
    ("sign of t", "translation of {} with the wrong sign"): lambda pose: Pose(pose.R, -pose.t),
    ("R transposed", "R of {} transposed"): lambda pose: Pose(pose.R.mT, pose.t),
    ("centre as t", "t of {} is the camera's centre"): lambda pose: Pose.from_centre(pose.R, pose.t),
    ("OpenGL axes", "axes of {} are OpenGL's (y upwards, z backwards)"): lambda pose: OPENGL @ pose,
    ("order of quaternions", "quaternion of {} is w, x, y, z and was read as x, y, z, w"): lambda pose: (
        Pose.from_quaternion(pose.quaternion[..., [1, 2, 3, 0]], pose.t)
    ),
    ("order of quaternions", "quaternion of {} is x, y, z, w and was read as w, x, y, z"): lambda pose: (
        Pose.from_quaternion(pose.quaternion[..., [3, 0, 1, 2]], pose.t)
    ),
    ("degrees and radians", "rotation of {} in radians, taken for degrees"): lambda pose: Pose(
        rotation_from_vector(torch.rad2deg(rotation_vector(pose.R))), pose.t
    ),
    ("OpenGL axes", "pose of {} is world from camera in OpenGL's axes, as of NeRF files"): lambda pose: (
        OPENGL @ pose.inverse()
    ),
    ("frame of t", "t of {} is along the axes of the other frame (R t is meant)"): lambda pose: Pose(
        pose.R, (pose.R @ pose.t[..., None])[..., 0]
    ),
    ("frame of t", "t of {} is along the axes of the other frame (the inverse of R, times t)"): lambda pose: (
        Pose(pose.R, (pose.R.mT @ pose.t[..., None])[..., 0])
    ),
    **{
        ("sign of t", f"{axis} of the translation of {{}} with the wrong sign"): partial(
            _mirrored, axis, False
        )
        for axis in "xyz"
    },
    **{
        ("left-handed", f"pose of {{}} in a left-handed system ({axis} the other way)"): partial(
            _mirrored, axis, True
        )
        for axis in "xyz"
    },
    **{
        ("order of angles", f"Euler angles of {{}} about {order}, applied in the opposite order"): partial(
            _reversed_angles, order
        )
        for order in ("xyz", "zyx", "yxz", "zxy", "xzy", "yzx")
    },
}
"""Mistakes in a pose by kind and words, with the function that undoes each."""
EXCHANGED = {
    "x and y exchanged in focal lengths and principal point of {}": partial(
        on_cameras,
        change=lambda camera: camera.replace(K=TRANSPOSE.to(camera.K) @ camera.K @ TRANSPOSE.to(camera.K)),
    )
}
CURVED = {
    "images of {} are undistorted already: distortion applied twice": partial(
        on_cameras, change=lambda camera: camera.replace(distortion=None)
    ),
}
OPPOSITE = {
    "distortion of {} with the wrong sign (the inverse map)": partial(on_cameras, change=_opposite_lens)
}
"""Mistake of a `Distortion` alone: in other camera models a sign may be part of the numbers' meaning."""
FITS: dict[str, Callable[[HW, HW], Tensor]] = {
    "resized": resize_matrix,
    "cropped about its middle": lambda old, new: shift_matrix((old[1] - new[1]) / 2, (old[0] - new[0]) / 2),
    "cropped at the right and the bottom": lambda old, new: shift_matrix(0, 0),
}
"""Ways in which an image may have come to another size, with the map of its pixels."""


def _of_numbers(rig: Rig, names: Sequence[str]) -> Iterator[Hypothesis]:
    """Yield mistakes in a rig's numbers, or of images that keep their sizes."""
    every = _groups(names)
    calibrated = [name for name in names if isinstance(rig[name], Camera)]
    for (kind, words), change in POSES.items():
        yield from _of_groups(rig, _groups(calibrated), kind, {words: _poses(change)})
    for factor, words in UNITS.items() if rig.depth is not None else ():
        scaled = _poses(lambda pose, factor=factor: Pose(pose.R, pose.t * factor))
        yield Hypothesis("units", f"translations against the depth range: {words}", scaled(rig, rig.names))
    yield from _of_groups(rig, _groups(calibrated), "x and y exchanged", EXCHANGED)
    if rig.links:
        words = "x and y exchanged in F (it is for row, column)"
        yield Hypothesis("x and y exchanged", words, _same_size(TRANSPOSE)(rig, names))
    yield from _rotated(rig, every)
    for factor in RESIZED:
        A = torch.diag(torch.tensor([factor, factor, 1.0], dtype=torch.float64))
        A[:2, 2] = 0.5 * factor - 0.5
        words = f"K of {{}} is for images {1 / factor:.3g} times as large"
        yield from _of_groups(rig, every, "resized", {words: _same_size(A)})
        for what, columns in (("principal point", slice(2, 3)), ("focal lengths", slice(0, 2))):
            words = f"{what} of {{}} for images {1 / factor:.3g} times as large"
            undo: Change = partial(on_cameras, change=partial(_partly_scaled, A, columns))
            yield from _of_groups(rig, _groups(calibrated), "resized", {words: undo})
    curved = [name for name in calibrated if rig[name].distortion is not None]
    yield from _of_groups(rig, _groups(curved), "distortion", CURVED)
    lenses = [name for name in curved if isinstance(rig[name].distortion, Distortion)]
    yield from _of_groups(rig, _groups(lenses), "distortion", OPPOSITE)
    for kind, pixels in SHIFTS.items():
        shifts = {
            f"pixels of {{}} are {shift:+g} from where the rig counts them": _same_size(
                shift_matrix(-shift, -shift)
            )
            for shift in (-pixels, pixels)
        }
        yield from _of_groups(rig, every, kind, shifts)


def _of_sizes(rig: Rig, wrong: Sequence[str], sizes: Mapping[str, HW]) -> Iterator[Hypothesis]:
    """Yield explanations of image sizes other than those that the rig states."""
    label = ", ".join(map(repr, wrong))

    def resized(matrix: Callable[[HW, HW], Tensor]) -> Rig:
        return on_pixels(rig, wrong, lambda name, view: (matrix(view.hw, sizes[name]), sizes[name]))

    yield from _rotated(rig, [(wrong, label)])
    if all(rig[name].hw == sizes[name][::-1] for name in wrong):
        as_cropped = resized(FITS["cropped at the right and the bottom"])
        yield Hypothesis("x and y exchanged", f"size of {label} written as height, width", as_cropped)
    for words, matrix in FITS.items():
        yield Hypothesis(words.split()[0], f"image of {label} {words}", resized(matrix))


def _rotated(rig: Rig, groups: Sequence[Group]) -> Iterator[Hypothesis]:
    """Yield images rotated or mirrored after calibration, whether or not the sizes allow it."""
    for words in ROTATIONS:
        change = partial(on_pixels, change=lambda _, view, words=words: rotated_view(view, words))
        yield from _of_groups(rig, groups, "rotated or mirrored", {f"image of {{}} {words}": change})


def _of_groups(
    rig: Rig, groups: Sequence[Group], kind: str, changes: Mapping[str, Change]
) -> Iterator[Hypothesis]:
    """Yield one kind of mistake in each group of cameras.

    Args:
        changes: the change that undoes it, by words with {} for the cameras.
    """
    for names, label in groups:
        for words, change in changes.items():
            yield Hypothesis(kind, words.format(label), change(rig, names))


def _groups(names: Sequence[str]) -> list[Group]:
    """List all cameras together, then one by one, each with a label; nothing for no cameras."""
    return [(names, "all cameras"), *(([name], f"'{name}'") for name in names)] if names else []
