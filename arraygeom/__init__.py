"""Differentiable geometry of rigs of N cameras of different kinds.

Cameras, rigs, two-view geometry and receptive fields as tensor operations; see conventions.md (installed by
itself, the description of the distribution).
"""

from collections.abc import Callable
from importlib import import_module
from types import FunctionType
from typing import Any

from .batching import stack
from .camera import Camera, LensView, Projected, View, intrinsics
from .checks import checked, unchecked
from .distortion import Distortion
from .epipolar import (
    Depth,
    Track,
    depth_from_track,
    epipolar_distance,
    epipolar_lines,
    epipoles,
    essential_matrix,
    fundamental_matrix,
    segments_between,
    shift_origin,
    track,
)
from .fields import (
    Curved,
    Dense,
    Epipolar,
    EpipolarLine,
    HomographyDisplacement,
    Local,
    Moved,
    NearestVoxels,
    ReceptiveField,
    Rectified,
    ThroughLenses,
    Widened,
    approximated,
    default_field,
    lazily,
    sampling_locations,
)
from .homography import (
    apply_homography,
    fit_homography,
    fit_similarity,
    infinite_homography,
    plane_homography,
)
from .multiview import ConsistentDepth, WorldRays, consistent_depth, plane_sweep, warp, world_rays
from .pair import Link, Pair
from .pixels import pixel_grid, resize_matrix
from .pose import Pose, rotation_from_vector
from .rectification import Rectification, rectify
from .relative_pose import TwoViewPose, poses_from_essential, relative_pose
from .reprojection import Bundle, bundle_adjusted, reprojection_residuals
from .rig import SERVICES, Rig
from .sampling import sample, to_grid
from .segments import Positions, Segments
from .sensor import Band, Curve, Sensor
from .triangulation import Triangulated, depth_of, triangulate
from .undistortion import pinhole_view, resampled


def _when_called(module: str, name: str) -> Callable[..., Any]:
    """Function whose module is imported when it is called: the formats of rig files take a while."""
    return lambda *args: getattr(import_module(f"{__name__}.{module}"), name)(*args)


SERVICES.update(
    load=_when_called("io", "read_rig"),
    save=_when_called("io", "write_rig"),
    check=_when_called("rig_check", "oddities"),
)

__all__ = [
    "Band",
    "Bundle",
    "Camera",
    "ConsistentDepth",
    "Curve",
    "Curved",
    "Dense",
    "Depth",
    "Distortion",
    "Epipolar",
    "EpipolarLine",
    "HomographyDisplacement",
    "LensView",
    "Link",
    "Local",
    "Moved",
    "NearestVoxels",
    "Pair",
    "Pose",
    "Positions",
    "Projected",
    "ReceptiveField",
    "Rectification",
    "Rectified",
    "Rig",
    "Segments",
    "Sensor",
    "ThroughLenses",
    "Track",
    "Triangulated",
    "TwoViewPose",
    "View",
    "Widened",
    "WorldRays",
    "apply_homography",
    "approximated",
    "bundle_adjusted",
    "consistent_depth",
    "default_field",
    "depth_from_track",
    "depth_of",
    "epipolar_distance",
    "epipolar_lines",
    "epipoles",
    "essential_matrix",
    "fit_homography",
    "fit_similarity",
    "fundamental_matrix",
    "infinite_homography",
    "intrinsics",
    "lazily",
    "pinhole_view",
    "pixel_grid",
    "plane_homography",
    "plane_sweep",
    "poses_from_essential",
    "rectify",
    "relative_pose",
    "reprojection_residuals",
    "resampled",
    "resize_matrix",
    "rotation_from_vector",
    "sample",
    "sampling_locations",
    "segments_between",
    "shift_origin",
    "stack",
    "to_grid",
    "track",
    "triangulate",
    "unchecked",
    "warp",
    "world_rays",
]


for _name in __all__:
    if isinstance(globals()[_name], FunctionType) and _name != "unchecked":
        globals()[_name] = checked(globals()[_name])
        globals()[_name].__module__ = __name__  # so that it is pickled by name


def __dir__() -> list[str]:
    return __all__
