"""What is done to images before fusion, and undone after it."""

from __future__ import annotations

from collections.abc import Mapping

from arraygeom import ReceptiveField
from arraygeom.fields import default_field

from .results import Frame

Fields = Mapping[str, ReceptiveField | None]

import math
from collections.abc import Mapping, Sequence
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

from arraygeom import (
    Camera,
    Curved,
    Epipolar,
    EpipolarLine,
    LensView,
    Moved,
    Pair,
    ReceptiveField,
    Rig,
    ThroughLenses,
    View,
    Widened,
    apply_homography,
    pinhole_view,
    pixel_grid,
    resampled,
)
from arraygeom.pixels import coarse_grid, map_homogeneous, shift_matrix
from arraygeom.undistortion import pixels_between

from ..media.colour import luminance
from ..media.images import Images
from ..networks.protocol import FusionNetwork, Look
from .tiles import (
    touched,
)


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


def _band_order(names: Sequence[str], groups: Sequence[Sequence[str]], bands: Mapping[str, int]) -> list[int]:
    """Which of the groups' bands, one after the other, are those of the betas in the order of their names."""
    joined = [(name, band) for group in groups for name in group for band in range(bands[name])]
    return [joined.index((name, band)) for name in names for band in range(bands[name])]


def without_lenses(rig: Rig, images: Images) -> tuple[Rig, dict[str, Tensor]]:
    """The rig and its images with pinhole views in place of cameras with lenses; see `arraygeom.pinhole_view`."""
    straight = dict(images)
    for name, image in images.items():
        camera = rig[name]
        if isinstance(camera, LensView) and camera.distortion is not None:
            view = pinhole_view(camera)
            rig = rig.transformed(name, view.K @ torch.linalg.inv(camera.K), view.hw).with_camera(name, view)
            straight[name] = resampled(image, camera, view, extended=True).values[0].clamp(min=0)
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


def _bent(frame: Frame, straight: Tensor, own: Tensor, pinhole: View, lens: View) -> Frame:
    """The frame at the pixels of alpha's own image."""
    if not (isinstance(pinhole, LensView) and isinstance(lens, LensView) and lens.distortion is not None):
        return frame
    added = frame.image - _grey(straight)
    inverse = (1 / frame.depth).nan_to_num(0.0)
    back = resampled(torch.cat([added, frame.confidence[None]]), pinhole, lens, interpolation="bilinear").values[0]
    depth = 1 / resampled(inverse[None], pinhole, lens, interpolation="nearest").values[0, 0]
    return Frame(_grey(own) + back[:-1], torch.where(depth.isfinite(), depth, torch.nan), back[-1])


def normalised(image: Float[Tensor, "*b h w"], like: Float[Tensor, "*c ha wa"]) -> Float[Tensor, "*b h w"]:
    """The image with the mean and the standard deviation of another; not cut to 0..1."""
    return (image - image.mean()) / image.std().clamp(min=1e-6) * like.std() + like.mean()


def _grey(image: Tensor) -> Tensor:
    return luminance(image) if image.shape[0] == 3 else image


def _common_part(
    pair: Pair, image: Tensor, field: ReceptiveField | None, network: FusionNetwork
) -> tuple[Pair, Tensor]:
    """A calibrated beta without what alpha never looks at, if that is much: it would be enlarged for nothing.

    Not where the field may go by the images' sizes.
    """
    h, w = pair.beta.hw
    follows = field is None or isinstance(field, (Epipolar, EpipolarLine))
    if not follows or pair.link is not None or not pair.calibrated or pitch_ratio(pair) > 0.8:
        return pair, image
    found = Look.along(field or default_field(pair), pair).at(coarse_grid(pair.alpha.hw).reshape(-1, 2))
    top, bottom, left, right = touched(found, (h, w), network)
    if (bottom - top) * (right - left) > 0.75 * h * w:
        return pair, image
    part = pair.transform_beta(shift_matrix(left, top), (bottom - top, right - left))
    return part, image[..., top:bottom, left:right]


def _at_equal_pitch(pair: Pair, image: Tensor) -> tuple[Pair, Tensor]:
    """Beta resized so that where the views meet its pixels are about the size of alpha's."""
    scale = pitch_ratio(pair)
    if 0.8 < scale < 1.25:
        return pair, image
    hw = (max(round(pair.beta.hw[0] / scale), 16), max(round(pair.beta.hw[1] / scale), 16))
    image = interpolate(image, size=hw, mode="bicubic", align_corners=False, antialias=True).clamp(0, 1)
    return pair.resize_beta(hw), image


def pitch_ratio(pair: Pair) -> float:
    """Pixels of beta to a pixel of alpha, by the pair's rough homography at the middle of alpha; 1 if undefined."""
    steps = _steps_in_beta(pair)
    area = 0.0 if steps is None else abs(float(torch.linalg.det(steps)))
    return math.sqrt(area) if area > 0 else 1.0


def quarter_turns(pair: Pair) -> int:
    """How often beta's image must be turned (see `Camera.turn`) to be upright as alpha's is, 0 to 3."""
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
