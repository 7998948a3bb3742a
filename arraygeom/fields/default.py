"""The default field of a pair, and fields by name: one policy for fusion, drawings and refinement."""

from __future__ import annotations

import difflib
from typing import Literal

from ..checks import check_field
from ..epipolar import FRONT
from ..pair import Pair
from ..pixels import coarse_grid
from ..runtime.extras import Registry, error_line, imported
from ..runtime.tracing import traced
from .curved import Curved, ThroughLenses
from .explicit import Dense, Local, NearestVoxels
from .protocol import ReceptiveField
from .straight import AroundHomography, Epipolar, EpipolarLine, HomographyDisplacement, Rectified

_FAMILIES = {
    "epipolar": Epipolar,
    "line": EpipolarLine,
    "homography": HomographyDisplacement,
    "rectified": Rectified,
    "nearest": NearestVoxels,
    "local": Local,
    "dense": Dense,
    "curved": Curved,
}
FIELDS = Registry("field", ("__call__",), _FAMILIES)
"""Fields by name: classes that can be constructed without arguments; yours may be a field or function too."""


def named_field(name: str) -> ReceptiveField:
    """Return the field of a name in `FIELDS`, or another one named "module:object", which is imported.

    A class is instantiated without arguments. Importing runs the module's code; the current directory is
    searched too.

    Returns:
        The field, to be called with a pair and pixels of alpha.

    Raises:
        ValueError: for a name that is neither, a module or object that cannot be imported (`imported`), or an
            object that is no field, such as a class that needs arguments.
    """
    if ":" not in name and name not in FIELDS:
        near = difflib.get_close_matches(name, FIELDS, 1)
        hint = f"did you mean '{near[0]}'?" if near else f"use one of {', '.join(FIELDS)}, or MODULE:OBJECT"
        raise ValueError(f"no field is called '{name}': {hint}")
    field = FIELDS[name] if name in FIELDS else imported(name, "field")
    try:
        field = field() if isinstance(field, type) else field
        check_field(field)
    except Exception as error:
        raise ValueError(f"the field '{name}': {error_line(error)}") from error
    return field


NEAR, DEVIATIONS = 2.0, 4.0
"""Displacement from H x of a pair at one place: pixels at least, and standard deviations of points from it. A
shorter search is no choice between positions, and matches are then held for doubtful."""
LINE_SHARE = 0.06
"""Displacement from H x along the line of a pair with a link, as a share of beta's longer side."""
ROW_SHARE = 0.12
"""Largest disparity, either way, of a pair of which only the sizes are known, as a share of beta's width."""


def default_field(pair: Pair) -> ReceptiveField:
    """Return the field that fusion uses for a pair; through lenses where a view has one.

    Returns:
        With a link (measured between these very images), calibrated or not, `HomographyDisplacement`, or
        `AroundHomography` if F is zero. For another calibrated pair `AroundHomography` without a baseline,
        else `Epipolar`; called, it raises ValueError without a depth range: a search of the whole line must
        be requested (`EpipolarLine`). `Rectified` with alpha on either side where only sizes are known. With
        a lens in either view `Curved` in place of `Epipolar`, with the bounds of `natural_bounds`, and
        `ThroughLenses` of any other; `Curved` always where a view has no pinhole view.

    Raises:
        ValueError: for an uncalibrated pair with a view without a pinhole view, and float32 poses too far
            from the origin for the pair's depth range.
    """
    return _through_lenses(straight_field(pair), pair)


def straight_field(pair: Pair) -> ReceptiveField:
    """Return the `default_field` of the pair after its images are undistorted."""
    if pair.at_one_place:
        return AroundHomography(max(NEAR, DEVIATIONS * (0.0 if pair.link is None else pair.link.spread)))
    if pair.link is not None:
        return HomographyDisplacement(LINE_SHARE * max(pair.beta.hw))
    if pair.calibrated:
        return Epipolar()
    return Rectified(ROW_SHARE * pair.beta.hw[1], alpha_is="either")


def _through_lenses(field: ReceptiveField, pair: Pair, samples: int = 96, nodes: int = 64) -> ReceptiveField:
    if not pair.has_lens:
        return field
    if not isinstance(field, Epipolar) and all(view.has_pinhole_view for view in (pair.alpha, pair.beta)):
        return ThroughLenses(field, samples)
    return Curved(samples, nodes=nodes, bounds=natural_bounds(pair))


def natural_bounds(pair: Pair) -> Literal["depth", "distance"]:
    """Return the quantity that a pair's depth range bounds: "distance" if alpha sees 90 degrees off axis.

    Returns:
        "distance" along the ray if one of some pixels all over alpha looks 90 degrees or more off its axis;
        else, and while the pair is traced, "depth" along the axis.

    Raises:
        ValueError: for an uncalibrated pair.
    """
    alpha = pair.cameras[0]
    if alpha.distortion is None or not alpha.distortion.sees_behind or traced():
        return "depth"
    rays, valid = alpha.rays(coarse_grid(alpha.hw).to(alpha.K).reshape(*[1] * len(alpha.batch_shape), -1, 2))
    return "distance" if bool((valid & (rays[..., 2] <= FRONT * rays.norm(dim=-1))).any()) else "depth"


def recorded_field(pair: Pair, *, samples: int = 256, nodes: int = 64) -> ReceptiveField:
    """Return a pair's `default_field`, or the whole line in place of `Epipolar` without a depth range, for
    drawings.

    Args:
        samples: positions per pixel of `Curved` and `ThroughLenses`.
        nodes: nodes of `Curved`.

    Returns:
        The field, through lenses where a view has one; without a pinhole view it is `Curved`, which needs a
        depth range.

    Raises:
        ValueError: as `default_field`.
    """
    field = straight_field(pair)
    if isinstance(field, Epipolar) and pair.depth is None:
        field = EpipolarLine()
    return _through_lenses(field, pair, samples, nodes)
