"""Wrong uses of the library, by name: what it says of each. Run as a program, where nothing checks types."""

from __future__ import annotations

import json
import math
import traceback
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from arraygeom import (
    Band,
    Camera,
    Curve,
    Curved,
    Dense,
    Distortion,
    Epipolar,
    HomographyDisplacement,
    Link,
    Local,
    Moved,
    NearestVoxels,
    Pair,
    Pose,
    Rectified,
    Rig,
    Segments,
    Sensor,
    ThroughLenses,
    Track,
    Widened,
    apply_homography,
    approximated,
    bundle_adjusted,
    consistent_depth,
    default_field,
    depth_from_track,
    depth_of,
    epipolar_distance,
    epipolar_lines,
    epipoles,
    essential_matrix,
    fit_homography,
    fit_similarity,
    fundamental_matrix,
    infinite_homography,
    intrinsics,
    lazily,
    pinhole_view,
    pixel_grid,
    plane_homography,
    plane_sweep,
    poses_from_essential,
    rectify,
    relative_pose,
    reprojection_residuals,
    resampled,
    resize_matrix,
    rotation_from_vector,
    sample,
    sampling_locations,
    segments_between,
    shift_origin,
    stack,
    to_grid,
    track,
    triangulate,
    warp,
    world_rays,
)
from arraygeom.fields import AroundMatches
from arraygeom.fields.ray_depth import ray_depth
from arraygeom.lens_coverage import coverage
from arraygeom.robust import least_squares, robust_least_squares
from arraygeom.viz import draw_matches, draw_residuals
from arraygeom.wide_views import cube_faces, rectify_spherical

HW = (48, 64)
K = intrinsics(60.0, HW)
EYE, ZERO = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
OPENGL = torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64))
ASIDE = torch.tensor([-0.1, 0, 0], dtype=torch.float64)
X = torch.tensor([[20.0, 20.0]], dtype=torch.float64)
ENDS = Distortion("brown-conrady", torch.tensor([-1e4, 0, 0, 0], dtype=torch.float64))
IMAGE = torch.rand(1, 3, *HW, generator=torch.Generator().manual_seed(0))


def camera(**changes: Any) -> Camera:
    return Camera(**{"K": K, "cam_from_world": Pose(EYE, ZERO), "hw": HW} | changes)


def moved(**changes: Any) -> Camera:
    return camera(cam_from_world=Pose(EYE, ASIDE), **changes)


def batch_of_poses(count: int = 2) -> Camera:
    return camera(cam_from_world=Pose(EYE, ASIDE.expand(count, 3)))


def rig(beta: Camera | None = None, alpha: Camera | None = None, **changes: Any) -> Rig:
    return Rig({"alpha": alpha or camera(), "beta": beta or moved()}, **{"depth": (1.0, 5.0)} | changes)


def pair(**changes: Any) -> Any:
    return rig(**changes).pair("alpha", "beta")


def posed(R: Any = EYE, t: Any = ASIDE) -> Rig:
    return rig(camera(cam_from_world=Pose(R, t)))


def lens(model: Any, coefficients: Any) -> Any:
    made = Distortion(model, torch.tensor(coefficients, dtype=torch.float64))
    return rig(moved(distortion=made))


def toed_in(angle: float) -> torch.Tensor:
    return rotation_from_vector(torch.tensor([0.0, angle, 0.0], dtype=torch.float64))


def with_parts(**changes: Callable[[Any], Any]) -> Any:
    """A field whose segments' parts are changed so."""

    def field(pair: Any, x: Any) -> Segments:
        parts = vars(Epipolar()(pair, x))
        return Segments(**{name: changes.get(name, lambda part: part)(part) for name, part in parts.items()})

    return field


def with_nan(t: torch.Tensor) -> torch.Tensor:
    return torch.where(torch.arange(t.numel()).reshape(t.shape) == 0, torch.nan, t)


WRONG: dict[str, Callable[[], Any]] = {
    "2 R": lambda: posed(2 * EYE),
    "R a reflection": lambda: posed(torch.diag(EYE.new_tensor([-1, 1, 1]))),
    "R of NaN": lambda: posed(with_nan(EYE)),
    "R 4 x 4": lambda: posed(torch.eye(4, dtype=torch.float64)),
    "R a rotation vector": lambda: posed(ZERO),
    "R a list": lambda: posed([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]),
    "R of whole numbers": lambda: posed(torch.eye(3, dtype=torch.int64)),
    "R with a row lost": lambda: posed(torch.stack([EYE[0], EYE[1], EYE[1]])),
    "t infinite": lambda: posed(t=ASIDE / 0),
    "t a column": lambda: posed(t=ASIDE[:, None]),
    "t in millimetres": lambda: posed(t=1000 * ASIDE),
    "t in millimetres of a short baseline": lambda: posed(t=100 * ASIDE),
    "OpenGL's pose for one camera": lambda: posed(OPENGL, OPENGL @ ASIDE),
    "OpenGL's poses for both cameras, toed in": lambda: rig(
        camera(cam_from_world=Pose.from_centre(OPENGL @ toed_in(0.6), -10 * ASIDE)),
        camera(cam_from_world=Pose.from_centre(OPENGL @ toed_in(-0.6), 10 * ASIDE)),
    ),
    "world_from_cam for cam_from_world, sides named": lambda: Rig(
        {"left": camera(), "right": camera(cam_from_world=Pose(EYE, -ASIDE))}, depth=(1, 5)
    ),
    "pose a 4 x 4 matrix": lambda: camera(cam_from_world=torch.eye(4)),
    "2 K": lambda: camera(K=2 * K),
    "K transposed": lambda: camera(K=K.mT),
    "K of NaN": lambda: camera(K=with_nan(K)),
    "K without focal length": lambda: camera(K=intrinsics(0.0, HW)),
    "K 3 x 4": lambda: camera(K=torch.cat([K, ZERO[:, None]], 1)),
    "K of whole numbers": lambda: camera(K=K.long()),
    "K of an image twice the size": lambda: rig(moved(K=intrinsics(120.0, (96, 128)))),
    "K in millimetres": lambda: rig(moved(K=intrinsics(4.0, HW))),
    "K normalised": lambda: rig(moved(K=intrinsics(1.0, HW, (0.5, 0.5)))),
    "K mirrored": lambda: rig(moved(K=intrinsics((-60.0, 60.0), HW))),
    "hw (width, height)": lambda: rig(moved(hw=HW[::-1])),
    "hw with channels": lambda: camera(hw=(3, *HW)),
    "hw 0": lambda: camera(hw=(0, 64)),
    "hw not whole": lambda: camera(hw=(48.5, 64)),
    "K and pose of batches unlike": lambda: camera(
        K=K.expand(2, 3, 3), cam_from_world=Pose(EYE.expand(3, 3, 3), ZERO)
    ),
    "distortion a tensor": lambda: camera(distortion=torch.zeros(5)),
    "sensor a word": lambda: camera(sensor="mono"),
    "unknown lens": lambda: lens("opencv", [0.0, 0, 0, 0]),
    "three coefficients": lambda: lens("brown-conrady", [0.1, 0, 0]),
    "coefficients of NaN": lambda: lens("brown-conrady", [math.nan, 0, 0, 0]),
    "coefficients of another unit": lambda: lens("brown-conrady", [-40.0, 0, 0, 0]),
    "depth reversed": lambda: rig(depth=(5, 1)),
    "depth one number": lambda: rig(depth=5.0),
    "depth in millimetres": lambda: rig(depth=(1000.0, 5000.0)),
    "cameras of batches unlike": lambda: Rig({"a": batch_of_poses(2), "b": batch_of_poses(3)}),
    "cameras a list": lambda: Rig([camera(), camera()]),
    "a camera that is K": lambda: Rig({"a": K}),
    "both cameras the same": lambda: Rig({"a": camera(), "b": camera()}, depth=(1, 5)),
    "a link to a name unknown": lambda: rig(links={("alpha", "gamma"): Link(EYE)}),
    "a link by a text": lambda: Rig({"a": camera(), "b": moved()}, links={"ab": Link(pair().fundamental)}),
    "a link of three cameras": lambda: rig(links={("alpha", "beta", "alpha"): Link(EYE)}),
    "links as a list": lambda: rig(links=[Link(EYE)]),
    "F of rank three": lambda: rig(links={("alpha", "beta"): Link(EYE)}),
    "F of NaN": lambda: Link(with_nan(EYE)),
    "a field called as a function": lambda: Epipolar(pair(), X),
    "a class for a field": lambda: sampling_locations(Epipolar, pair(), X),
    "pixels of three numbers": lambda: sampling_locations(Epipolar(), pair(), ZERO),
    "points a list": lambda: camera().project([0.0, 0, 2]),
    "points an array": lambda: camera().project(ZERO.numpy()),
    "pixels a list": lambda: sampling_locations(Epipolar(), pair(), [[20.0, 20]]),
    "pixels a list, of a field": lambda: Epipolar()(pair(), [[20.0, 20]]),
    "pixels an array, of a field": lambda: Rectified(8)(pair(), X.numpy()),
    "pixels a list, of a curve": lambda: Curved(8)(pair(), [[20.0, 20]]),
    "pixels a list, of a camera": lambda: camera().unproject([20.0, 20], torch.ones(())),
    "pixels an array, on the image": lambda: camera().contains(X.numpy()),
    "a curve's bounds by another word": lambda: ray_depth(pair(), X, X, "range"),
    "near beyond far": lambda: Epipolar(near=5, far=2)(pair(), X),
    "near below 0": lambda: Curved(near=-1.0),
    "no samples": lambda: Curved(0),
    "displacement below 0": lambda: HomographyDisplacement(-5),
    "disparity below 0": lambda: Rectified(-5),
    "alpha up": lambda: Rectified(8, alpha_is="up"),
    "count 0": lambda: NearestVoxels(count=0),
    "size 0": lambda: Local(0),
    "stride 0": lambda: Dense(0),
    "across below 0": lambda: Widened(Epipolar(), across=-1.0),
    "widened class": lambda: Widened(Epipolar, across=1.0),
    "lenses on a class": lambda: ThroughLenses(Epipolar),
    "field of whole numbers": lambda: sampling_locations(with_parts(start=Tensor.long), pair(), X),
    "field of x alone": lambda: sampling_locations(with_parts(end=lambda end: end[..., :1]), pair(), X),
    "field of weights": lambda: sampling_locations(with_parts(valid=Tensor.float), pair(), X),
    "moved by one plane": lambda: Moved(Epipolar(), torch.zeros(HW)),
    "frame rate below 0": lambda: Sensor(frame_rate=-30.0),
    "coding unknown": lambda: Sensor(coding="sRGB"),
    "band without width": lambda: Band(450, 0),
    "band of None": lambda: Band(None, None),
    "time offset None": lambda: Sensor(time_offset=None),
    "gains of two colours": lambda: Sensor(gain=(1.0, 2.0)),
    "curve of unlike lengths": lambda: Curve((400.0, 500.0), (1.0,)),
    "a rig in half precision": lambda: rig().to(torch.float16),
    "a depth of each pixel as a column": lambda: camera().unproject(X.expand(5, 2), torch.ones(5, 1)),
    "depths of other pixels": lambda: camera().unproject(X.expand(5, 2), torch.ones(3)),
    "triangulation of one view": lambda: triangulate([camera()], X[None]),
    "points of two numbers": lambda: camera().project(X),
    "points of two numbers, in a pose": lambda: Pose(EYE, ZERO).apply(X),
    "rays of three numbers": lambda: camera().rays(ZERO),
    "a depth that is a number": lambda: camera().unproject(X, 2.0),
    "depths a list": lambda: camera().unproject(X, [2.0]),
    "no depth": lambda: camera().unproject(X, None),
    "a rotation of four numbers": lambda: rotation_from_vector(torch.zeros(4)),
    "a change a list": lambda: rig().perturbed({"beta.rotation": [0.0, 0, 0]}),
    "a change of two numbers": lambda: rig().perturbed({"beta.rotation": torch.zeros(2)}),
    "a change of one focal length of two": lambda: rig().perturbed({"beta.focal": torch.ones(1)}),
    "a lens of a number": lambda: lens("fov", 0.9),
    "cameras by number": lambda: Rig({0: camera(), 1: moved()}),
    "three points for a homography": lambda: fit_homography(X.expand(3, 2), X.expand(3, 2)),
    "points of other counts": lambda: fit_homography(X.expand(5, 2), X.expand(4, 2)),
    "matches of other counts": lambda: AroundMatches.from_points(X.expand(5, 2), X.expand(4, 2), HW),
    "no matches to draw": lambda: draw_matches(rig(), "alpha", {}, {}),
    "no matches of beta to draw": lambda: draw_matches(rig(), "alpha", {"beta": (X[:0], X[:0])}, {}),
    "no residuals to draw": lambda: draw_residuals(pair(), X[:0], X[:0]),
    "robust least squares of no steps": lambda: robust_least_squares(
        EYE, ZERO, ZERO, torch.ones_like, steps=0
    ),
    "least squares of NaN": lambda: least_squares(EYE, with_nan(ZERO), ZERO + 1),
    "points of NaN": lambda: fit_homography(X.expand(5, 2) * math.nan, X.expand(5, 2)),
    "epipoles of a 3 x 4 matrix": lambda: epipoles(torch.zeros(3, 4)),
    "an image without its batch": lambda: sample(torch.rand(1, *HW), X[None]),
    "an image of bytes": lambda: sample(torch.zeros(1, 1, *HW, dtype=torch.uint8), X[None]),
    "an empty image": lambda: sample(torch.zeros(1, 1, 48, 0), X[None]),
    "pixels of two images for three": lambda: sample(torch.rand(3, 1, *HW), X.expand(2, 1, 2)),
    "an interpolation unknown": lambda: sample(torch.rand(1, 1, *HW), X[None], interpolation="lanczos"),
    "a deviation below 0": lambda: triangulate([camera(), moved()], X.expand(2, 1, 2), deviation=-1.0),
    "seen by three of two": lambda: triangulate(
        [camera(), moved()], X.expand(2, 1, 2), seen=torch.ones(3, 1, dtype=torch.bool)
    ),
    "seen as numbers": lambda: triangulate([camera(), moved()], X.expand(2, 1, 2), seen=torch.ones(2, 1)),
    "matches a list": lambda: triangulate([camera(), moved()], X.expand(2, 1, 2).tolist()),
    "residuals of one view of two": lambda: reprojection_residuals(
        [camera(), moved()], ZERO[None] + 2, X[None]
    ),
    "residuals of no cameras": lambda: reprojection_residuals([], ZERO[None] + 2, X[None][:0]),
    "residuals of one pixel for five points": lambda: reprojection_residuals(
        [camera(), moved()], ZERO.expand(5, 3) + 2, X.expand(2, 1, 2)
    ),
    "residuals, seen by one view of two": lambda: reprojection_residuals(
        [camera(), moved()], ZERO.expand(5, 3) + 2, X.expand(2, 5, 2), seen=torch.ones(1, 5).bool()
    ),
    "a bundle, seen by three views of two": lambda: bundle_adjusted(
        rig(), ZERO.expand(5, 3) + 2, X.expand(2, 5, 2), free=["*.t*"], seen=torch.ones(3, 5).bool()
    ),
    "a camera for a pair": lambda: depth_of(camera(), X, X),
    "a camera for a pair, in a field": lambda: sampling_locations(Epipolar(), camera(), X),
    "a camera for a pair, to rectify": lambda: rectify(camera()),
    "a camera for a pair, to warp": lambda: warp(camera(), IMAGE, torch.ones(1, *HW)),
    "a rig for a pair": lambda: depth_of(rig(), X, X),
    "a rig for a pair, by default": lambda: default_field(rig()),
    "a pair for a rig": lambda: consistent_depth(pair(), {"alpha": torch.ones(HW)}, "alpha"),
    "a pair for a camera": lambda: world_rays(pair(), X),
    "a rig for a camera": lambda: pinhole_view(rig()),
    "a matrix for a pose": lambda: essential_matrix(torch.eye(4)),
    "a matrix for a pose, in F": lambda: fundamental_matrix(K, K, torch.eye(4)),
    "a pose for a rotation": lambda: infinite_homography(K, K, Pose(EYE, ASIDE)),
    "a camera for K": lambda: infinite_homography(camera(), K, EYE),
    "a pair's cameras for segments": lambda: segments_between(camera(), X, X, HW),
    "a rig for cameras": lambda: triangulate(rig(), X.expand(2, 1, 2)),
    "pairs for cameras": lambda: triangulate([pair(), pair()], X.expand(2, 1, 2)),
    "pixels of no size": lambda: pixel_grid((0, 5)),
    "pixels of a tensor's shape": lambda: pixel_grid(IMAGE.shape),
    "pixels of one number": lambda: pixel_grid(48),
    "pixels of floats": lambda: pixel_grid((4.5, 6.0)),
    "a grid of no size": lambda: to_grid(X, (0, 64)),
    "a grid of three numbers": lambda: to_grid(ZERO[None], HW),
    "resized from nothing": lambda: resize_matrix((0, 5), HW),
    "resized to a factor": lambda: resize_matrix(HW, 2.0),
    "resized to nothing": lambda: camera().resize((0, 64)),
    "resized to (width, height, channels)": lambda: camera().resize((64, 48, 3)),
    "resized, a rig, to a factor": lambda: rig().resize("beta", 0.5),
    "resized, a camera unknown": lambda: rig().resize("gamma", HW),
    "cropped to nothing": lambda: camera().crop(0, 0, (0, 0)),
    "cropped at text": lambda: camera().crop("top", 0, HW),
    "rotated by degrees": lambda: camera().rot90(90.5),
    "scaled by 0": lambda: rig().scaled(0.0),
    "scaled by a tensor of three": lambda: rig().scaled(ZERO),
    "a homography 4 x 4": lambda: apply_homography(torch.eye(4), X),
    "a homography a vector": lambda: apply_homography(ZERO, X),
    "a homography of whole numbers": lambda: apply_homography(torch.eye(3, dtype=torch.int64), X),
    "points exchanged with a homography": lambda: apply_homography(X, EYE),
    "points homogeneous, in a homography": lambda: apply_homography(EYE, ZERO[None]),
    "lines of a homogeneous point": lambda: epipolar_lines(EYE, ZERO[None]),
    "lines of F 3 x 4": lambda: epipolar_lines(torch.zeros(3, 4), X),
    "distances of points of three numbers": lambda: epipolar_distance(EYE, X, ZERO[None]),
    "F exchanged with points": lambda: epipolar_distance(X, EYE, X),
    "an origin of a vector": lambda: shift_origin(ZERO, 1),
    "an origin of text": lambda: shift_origin(EYE, "matlab"),
    "a plane's normal of four numbers": lambda: plane_homography(
        K, K, EYE, ASIDE, normal=torch.ones(4), d=torch.tensor(-2.0)
    ),
    "a plane at a number": lambda: plane_homography(K, K, EYE, ASIDE, normal=ZERO, d=-2.0),
    "t before R": lambda: plane_homography(K, K, ASIDE, EYE, normal=ZERO, d=torch.tensor(-2.0)),
    "a similarity of one point": lambda: fit_similarity(X, X),
    "a similarity of other counts": lambda: fit_similarity(X.expand(3, 2), X.expand(4, 2)),
    "a similarity to one point": lambda: fit_similarity(EYE[:, :2], X),
    "a similarity of three numbers": lambda: fit_similarity(ZERO.expand(3, 3), ZERO.expand(3, 3)),
    "a track of a pair": lambda: track(pair(), X, X, X),
    "a track's depth of three numbers": lambda: depth_from_track(Track(ZERO[None], ZERO), ZERO[None]),
    "a track's depth, of points": lambda: depth_from_track(X, X),
    "poses of F 3 x 4": lambda: poses_from_essential(torch.zeros(3, 4)),
    "a relative pose of points of other counts": lambda: relative_pose(
        EYE, K, K, X.expand(8, 2), X.expand(7, 2)
    ),
    "a relative pose without points": lambda: relative_pose(EYE, K, K, X[:0], X[:0]),
    "a relative pose, K and points exchanged": lambda: relative_pose(EYE, X, X, K, K),
    "a bundle of a list": lambda: bundle_adjusted([camera()], ZERO[None], X[None], free=["*"]),
    "a bundle of points of two numbers": lambda: bundle_adjusted(rig(), X, X.expand(2, 1, 2), free=["*"]),
    "a bundle of one view of two": lambda: bundle_adjusted(rig(), ZERO[None] + 2, X[None], free=["*.t*"]),
    "residuals, seen as numbers": lambda: reprojection_residuals(
        [camera()], ZERO[None] + 2, X[None], seen=torch.ones(1, 1)
    ),
    "residuals of a camera": lambda: reprojection_residuals(camera(), ZERO[None] + 2, X[None]),
    "warped without its batch": lambda: warp(pair(), IMAGE[0], torch.ones(1, *HW)),
    "warped by a number": lambda: warp(pair(), IMAGE, 2.0),
    "warped by depths of another size": lambda: warp(pair(), IMAGE, torch.ones(1, 8, 8)),
    "swept at one depth": lambda: plane_sweep(pair(), IMAGE, torch.tensor(2.0)),
    "swept at a list": lambda: plane_sweep(pair(), IMAGE, [2.0, 3.0]),
    "swept, an image of another size": lambda: plane_sweep(pair(), IMAGE[..., :8], torch.ones(2)),
    "consistent, depths a list": lambda: consistent_depth(rig(), [torch.ones(HW)], "alpha"),
    "consistent, a map of another size": lambda: consistent_depth(
        rig(), {"alpha": torch.ones(8, 8)}, "alpha"
    ),
    "consistent, no such camera": lambda: consistent_depth(rig(), {"alpha": torch.ones(HW)}, "gamma"),
    "consistent, a batch of rigs": lambda: consistent_depth(
        stack([rig()]), {"alpha": torch.ones(HW), "beta": torch.ones(HW)}, "alpha"
    ),
    "resampled from a pair": lambda: resampled(IMAGE[0], pair(), pair()),
    "resampled with a batch": lambda: resampled(IMAGE, camera(), camera()),
    "resampled from a batch of poses": lambda: resampled(IMAGE[0], batch_of_poses(), camera()),
    "a pinhole view of a batch of poses": lambda: pinhole_view(batch_of_poses()),
    "faces of a batch of poses": lambda: cube_faces(batch_of_poses()),
    "resampled an array": lambda: resampled(IMAGE[0].numpy(), camera(), camera()),
    "resampled, an image of another size": lambda: resampled(IMAGE[0, :, :8], camera(), camera()),
    "rectified to no size": lambda: rectify(pair(), hw=(0, 64)),
    "rectified by fx": lambda: rectify(pair(), K=60.0),
    "rectified, a batch of poses": lambda: rectify(posed(EYE, ASIDE.expand(2, 3)).pair("alpha", "beta")),
    "rectified on the sphere, a batch of poses": lambda: rectify_spherical(
        posed(EYE, ASIDE.expand(2, 3)).pair("alpha", "beta")
    ),
    "rectified on the sphere, a focal length below 0": lambda: rectify_spherical(pair(), focal=-1.0),
    "rectified on the sphere, without a ray": lambda: rectify_spherical(
        Pair(*(one(K=intrinsics(60.0, HW, (999.0, 0.0)), distortion=ENDS) for one in (camera, moved)), None)
    ),
    "coverage by a batch of lenses": lambda: coverage(camera(distortion=stack([ENDS, ENDS]))),
    "rectified along the baseline": lambda: rectify(
        Pair(camera(), camera(cam_from_world=Pose(EYE, EYE[2] / 10)), None)
    ),
    "approximated without depth": lambda: approximated(rig(depth=None).pair("alpha", "beta")),
    "approximated, a batch of poses": lambda: approximated(
        posed(EYE, ASIDE.expand(2, 3)).pair("alpha", "beta")
    ),
    "approximated F": lambda: approximated(Link(EYE)),
    "locations without a field": lambda: sampling_locations(None, pair(), X),
    "lazily, a name": lambda: lazily("epipolar", pair()),
    "stacked nothing": lambda: stack([]),
    "stacked unlike": lambda: stack([camera(), Pose(EYE, ZERO)]),
    "stacked sizes": lambda: stack([camera(), camera(hw=(24, 32), K=K)]),
    "indexed a single camera": lambda: camera()[0],
    "projected on another device": lambda: apply_homography(EYE, X.to("meta")),
    "projected NaN for a camera": lambda: camera().project(None),
    "focal lengths of three numbers": lambda: intrinsics((1.0, 2.0, 3.0), HW),
    "focal lengths a matrix": lambda: intrinsics(torch.rand(2, 2), HW),
    "a focal length of text": lambda: intrinsics("wide", HW),
    "intrinsics of no size": lambda: intrinsics(60.0, (0, 64)),
    "a pose looking at itself": lambda: Pose.look_at(ZERO, ZERO),
    "a pose looking at two numbers": lambda: Pose.look_at(X[0], ZERO),
    "a pose of a 3 x 3 matrix": lambda: Pose.from_matrix(EYE),
    "a pose of a quaternion of 0": lambda: Pose.from_quaternion(torch.zeros(4), ZERO),
    "a pose of a quaternion of three": lambda: Pose.from_quaternion(ZERO, ZERO),
    "a pose times a matrix": lambda: Pose(EYE, ZERO) @ EYE,
    "a camera for an alpha": lambda: rig().pair(camera(), "beta"),
    "a pair with itself": lambda: rig().pair("alpha", "alpha"),
    "a parameter unknown": lambda: rig().parameters(free=["beta.zoom"]),
    "parameters as text": lambda: rig().parameters(free="beta.rotation"),
    "a camera that is a path": lambda: rig().with_camera("beta", "beta.png"),
    "segments of no samples": lambda: Epipolar()(pair(), X).positions(0),
    "segments at a list": lambda: Epipolar()(pair(), X).at([0.5]),
    "segments masked to no size": lambda: Epipolar()(pair(), X).mask((0, 5)),
    "a homography at a depth of 0": lambda: pair().homography_at(0.0),
    "a homography at text": lambda: pair().homography_at("near"),
    "a link of a list": lambda: Link([[0.0] * 3] * 3),
    "a disparity of text": lambda: Rectified("8"),
    "a camera for K's image": lambda: sample(camera(), X[None]),
    # What nothing can know of:
    "pixels (y, x)": lambda: sampling_locations(Epipolar(), pair(), X.flip(-1)),
    "pixels normalised": lambda: sampling_locations(Epipolar(), pair(), X / 64),
    "first pixel at (0.5, 0.5)": lambda: rig(moved(K=intrinsics(60.0, HW, (32.0, 24.0)))),
    "R transposed, by a little": lambda: posed(toed_in(-0.02)),
}
"""Each makes something wrong, and uses it; a rig is asked what is odd about it."""

SILENT = {
    "pixels (y, x)": "pixels inside of the image",
    "pixels normalised": "pixels inside of the image",
    "first pixel at (0.5, 0.5)": "a principal point half a pixel off is no farther off than lenses are "
    "mounted",
    "R transposed, by a little": "a small rotation is as likely as its inverse",
}
"""Wrong uses of which nothing is said, and why."""


def answer(use: Callable[[], Any]) -> str:
    """The first sentence that a wrong use gets: an error, a warning or an oddity; empty if none."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            made = use()
        except (TypeError, ValueError, Warning) as error:
            last = traceback.extract_tb(error.__traceback__)[-1].filename
            if "tests" in Path(last).parts or "arraygeom" not in Path(last).parts:
                raise
            return f"{type(error).__name__}: {error}"
    return " ".join(made.check()[:1]) if isinstance(made, Rig) else ""


def answers(names: Iterable[str] = WRONG) -> dict[str, str]:
    """Return the message of each wrong use."""
    return {name: answer(WRONG[name]) for name in names}


if __name__ == "__main__":
    print(json.dumps({"right": answer(rig)} | answers(), indent=1))
