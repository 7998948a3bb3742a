"""Random rigs, degenerate ones among them, held against explicit projection in numpy."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

import arraygeom as ag
from tests.arraygeom import explicit

FRONT = 1e-3
"""What the conventions say: in front of beta from this ratio of depths on."""
SHORTEST = 1e-3
"""Segments shorter than this, in pixels, are lengthened along x."""
DEPTHS = 400
PIXELS = 6


@dataclass(frozen=True)
class Drawn:
    """A rig, pixels of alpha (n, 2) with their rays (n, 3, z = 1), and what kind of rig it is."""

    kind: str
    rig: ag.Rig
    x: np.ndarray
    rays: np.ndarray

    @property
    def pair(self) -> ag.Pair:
        return self.rig.pair("alpha", "beta")


KINDS = (
    *("ordinary", "ordinary", "no baseline", "identical", "forward", "backward", "looking back"),
    *("near is far", "far is infinite", "tiny baseline", "long baseline", "narrow", "wide", "tiny image"),
    *("quarter turn", "skewed", "on the epipole", "sideways", "anywhere"),
)


def drawn(seed: int, *, lenses: bool = False) -> Drawn:
    """The rig of a seed."""
    rng = np.random.default_rng(seed)
    kind = KINDS[seed % len(KINDS)]
    hw = (1, 3) if kind == "tiny image" else tuple(int(n) for n in rng.integers(20, 80, 2))
    beta_hw = (2, 1) if kind == "tiny image" else tuple(int(n) for n in rng.integers(20, 80, 2))
    share = {"narrow": (8, 30), "wide": (0.15, 0.4)}.get(kind, (0.6, 1.4))
    alpha = _camera(rng, hw, share, np.zeros(3), np.zeros(3))
    w, c = _motion(rng, kind)
    beta = alpha if kind == "identical" else _camera(rng, beta_hw, share, w, c)
    if kind == "quarter turn":
        beta = beta.rot90(int(rng.integers(1, 4)))
    if kind == "skewed":
        K = beta.K.clone()
        K[0, 1] = 0.1 * K[0, 0]
        beta = beta.replace(K=K)
    near = float(rng.uniform(0.3, 3))
    far = {"near is far": near, "far is infinite": math.inf}.get(kind, near * float(rng.uniform(1.5, 30)))
    if lenses:
        alpha, beta = (camera.replace(distortion=_lens(rng)) for camera in (alpha, beta))
    moved = _moved_world(rng)
    rig = ag.Rig({"alpha": _in_world(alpha, moved), "beta": _in_world(beta, moved)}, depth=(near, far))
    return Drawn(kind, rig, *_pixels(rng, kind, alpha, beta))


def _camera(
    rng: np.random.Generator, hw: Any, share: tuple[float, float], w: np.ndarray, centre: np.ndarray
) -> ag.Camera:
    focal = hw[1] * rng.uniform(*share, 2)
    middle = np.array([hw[1], hw[0]]) * rng.uniform(0.35, 0.65, 2)
    pose = ag.Pose.from_centre(ag.rotation_from_vector(torch.from_numpy(w)), torch.from_numpy(centre))
    return ag.Camera(K=ag.intrinsics(tuple(focal), hw, tuple(middle)), cam_from_world=pose, hw=hw)


def _motion(rng: np.random.Generator, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Beta's rotation vector and centre in alpha's frame."""
    w, c = rng.uniform(-0.25, 0.25, 3), rng.uniform(-0.4, 0.4, 3)
    if kind in ("no baseline", "narrow"):
        return w * (kind != "narrow"), c * (kind == "narrow")
    if kind in ("forward", "backward"):
        return 0.2 * w, np.array(
            [0.1 * c[0], 0.1 * c[1], (1 if kind == "forward" else -1) * rng.uniform(0.1, 2)]
        )
    if kind == "looking back":
        return np.array([0, math.pi, 0]) + 0.1 * w, c + np.array([0, 0, rng.uniform(0, 6)])
    if kind == "sideways":
        return np.array([0, rng.choice([-1, 1]) * math.pi / 2, 0]) + 0.1 * w, 5 * c
    if kind == "anywhere":
        return rng.uniform(-math.pi, math.pi, 3), rng.uniform(-5, 5, 3)
    return w, c * {"tiny baseline": 1e-6, "long baseline": 20}.get(kind, 1.0)


def _lens(rng: np.random.Generator) -> ag.Distortion | None:
    kind = rng.integers(4)
    if kind == 0:
        return None
    if kind == 1:
        return ag.Distortion("kannala-brandt", torch.from_numpy(rng.uniform(-0.05, 0.05, 4) / [1, 2, 4, 8]))
    small = rng.uniform(-1, 1, 5) * [0.25, 0.1, 2e-3, 2e-3, 0.02]
    return ag.Distortion("brown-conrady", torch.from_numpy(small))


def _moved_world(rng: np.random.Generator) -> ag.Pose:
    return ag.Pose(
        ag.rotation_from_vector(torch.from_numpy(rng.uniform(-3, 3, 3))),
        torch.from_numpy(rng.uniform(-3, 3, 3)),
    )


def _in_world(camera: ag.Camera, world: ag.Pose) -> ag.Camera:
    return camera.replace(cam_from_world=camera.cam_from_world @ world)


def _pixels(
    rng: np.random.Generator, kind: str, alpha: ag.Camera, beta: ag.Camera
) -> tuple[np.ndarray, np.ndarray]:
    """Whole pixels and others, alpha's corners, and the epipole where it is in front."""
    h, w = alpha.hw
    x = rng.uniform([0, 0], [w - 1, h - 1], (PIXELS, 2))
    x[: PIXELS // 2] = np.round(x[: PIXELS // 2])
    x[0] = [0, 0] if rng.random() < 0.5 else [w - 1, h - 1]
    rays = explicit.rays_of(alpha, x)
    centre = beta.centre.numpy()
    if kind == "on the epipole" and centre[2] > 0:
        rays[-1] = centre / centre[2]
    if alpha.distortion is None:
        return (rays @ alpha.K.numpy().T)[:, :2], rays
    x, seen = explicit.pixels_of(alpha, rays)
    # Undistorted pixels of the image's area can be outside its lens's range: others take their place.
    rays = np.where(seen[:, None], rays, [0, 0, 1.0])
    return explicit.pixels_of(alpha, rays)[0], rays


# What is asserted -------------------------------------------------------------------------------------------


def check(one: Drawn, dtype: torch.dtype) -> None:
    """Every field on a rig in one precision. Raises AssertionError that names the field."""
    for name, field, near, far in fields_of(one):
        found = field(one.pair, torch.from_numpy(one.x).to(dtype))
        _finite(name, found)
        if near is not None:
            _holds_what_is_seen(name, one, found, near, far, dtype)
    _explicit_lists(one, dtype)
    _gradients(one, dtype)


def fields_of(one: Drawn) -> list[tuple[str, Any, float | None, float | None]]:
    """Name, field, and the depths between which it must hold each point beta sees (None: not checked so)."""
    near, far = (float(d) for d in one.rig.depth)
    # Not by a half: whether a corner moved onto the very edge of the image is inside is up to rounding.
    step = torch.full((2, *one.pair.alpha.hw), 0.4)
    both: list[tuple[str, Any, float | None, float | None]] = [("Curved", ag.Curved(48), near, far)]
    both += [("Moved", ag.Moved(ag.Curved(16), step), None, None)]
    if _have_pinhole_views(one):
        both += [("ThroughLenses", ag.ThroughLenses(ag.Epipolar(), 48), None, None)]
    both += [("Widened(Curved)", ag.Widened(ag.Curved(48), 1.4, 2), near, far)]
    if one.pair.has_lens:
        return both
    baseline = float(one.pair.beta_from_alpha.t.norm())
    return [
        *both,
        ("Epipolar", ag.Epipolar(), near, far),
        ("EpipolarLine", ag.EpipolarLine(), 1e-3 * (baseline or 1.0), math.inf),
        ("HomographyDisplacement", ag.HomographyDisplacement(), None, None),
        ("Widened", ag.Widened(ag.Epipolar(), along=2), near, far),
        ("Widened across", ag.Widened(ag.Epipolar(), 2, 1, samples=48), near, far),
        ("Rectified", ag.Rectified(10.0, alpha_is="either"), None, None),
        ("NearestVoxels", ag.NearestVoxels(24, 8), None, None),
        ("Local", ag.Local(3), None, None),
        ("Dense", ag.Dense(5), None, None),
    ]


def _have_pinhole_views(one: Drawn) -> bool:
    """Return True if each image has a pixel less than 62 degrees off axis; tiny ones of wide
    lenses may not."""
    try:
        for camera in one.pair.cameras:
            ag.pinhole_view(camera)
    except ValueError:
        return False
    return True


def _finite(name: str, found: Any) -> None:
    for f in dataclasses.fields(found):
        value = getattr(found, f.name)
        assert value.dtype == torch.bool or bool(value.isfinite().all()), f"{name}.{f.name} is not finite"


def _holds_what_is_seen(
    name: str, one: Drawn, found: Any, near: float, far: float, dtype: torch.dtype
) -> None:
    """Every point of a ray that beta sees is at the segment, and the segment's ends are at points it sees."""
    pair, (w_far, w_near) = one.pair, (1 / far, 1 / near)
    # Even in inverse depth, and in its logarithm: near a camera that the ray passes pixels change quickest.
    w = np.concatenate(
        [np.linspace(w_far, w_near, DEPTHS), np.geomspace(max(w_far, 1e-6), max(w_near, 1e-6), DEPTHS)]
    )
    X = explicit.beta_points(pair, one.rays, np.sort(w))
    ratio = X[..., 2]
    xy, seen = explicit.pixels_of(pair.beta, X.reshape(-1, 3))
    xy, seen = xy.reshape(*ratio.shape, 2), seen.reshape(ratio.shape)
    size = max(*pair.beta.hw, float(pair.beta.K.abs().max()))
    tolerance = (2e-8 if dtype == torch.float64 else 6e-6) * size
    fisheye = pair.beta.distortion is not None and pair.beta.distortion.model == "kannala-brandt"
    distance = np.linalg.norm(X, axis=-1) if fisheye else ratio
    # What rounding makes of a pixel, and more of that of a point near beta's centre.
    blur = tolerance * (1 + np.abs(one.rays).max()) * (1 + 1 / np.maximum(distance, 1e-9))
    off_edge = np.minimum(xy + 0.5, np.array(pair.beta.hw[::-1]) - 0.5 - xy).min(-1)
    must = seen & (distance > 1.1 * FRONT) & (off_edge > blur)
    may = seen & (distance > 0.9 * FRONT) & (off_edge > -1 - blur)
    start, last, valid, across = _ends(found)
    for i in range(len(one.x)):
        if must[i].any():
            assert valid[i], f"{name}: {one.kind}: pixel {i} sees {must[i].sum()} points and is not valid"
            line = start[i] if across else np.stack([start[i], last[i]])
            off = _distance(xy[i][must[i]], line, across)
            slack = _slack(name, line) + blur[i][must[i]] + (SHORTEST if name == "Widened" else 0.0)
            assert (off <= slack).all(), (
                f"{name}: {one.kind}: pixel {i}: {off.max()} px off, {slack[off.argmax()]}"
            )
        elif valid[i] and not may[i].any() and not name.startswith("Widened"):
            # Between two of the explicit depths, perhaps: then the segment is short.
            gap = np.linalg.norm(np.diff(xy[i], axis=0), axis=-1)
            assert gap.max() > 0.5, f"{name}: {one.kind}: pixel {i} sees nothing and is valid"


def _ends(found: Any) -> tuple[Any, Any, np.ndarray, bool]:
    if isinstance(found, ag.Segments):
        return *(v.double().numpy() for v in (found.start, found.end)), found.valid.numpy(), False
    assert isinstance(found, ag.Positions)
    xy, mask = found.xy.double().numpy(), found.mask.numpy()
    return [points[m] for points, m in zip(xy, mask)], None, mask.any(-1), True


def _distance(points: np.ndarray, line: np.ndarray, across: bool) -> np.ndarray:
    """From points (k, 2) to the nearest of positions, or to a segment."""
    if across:
        return np.linalg.norm(points[:, None] - line[None], axis=-1).min(-1)
    a, step = line[0], line[1] - line[0]
    s = ((points - a) @ step) / max(step @ step, 1e-30)
    return np.linalg.norm(points - (a + np.clip(s, 0, 1)[:, None] * step), axis=-1)


def _slack(name: str, line: np.ndarray) -> float:
    """Half the distance between samples, for positions."""
    if len(line) == 2 and not name.startswith(("Curved", "Widened(", "Widened a")):
        return 0.0
    if len(line) < 2:
        return 1.0
    steps = np.linalg.norm(np.diff(line, axis=0), axis=-1)
    return 0.8 * float(np.median(steps)) + 0.3 + (1.0 if "across" in name or "(" in name else 0.0)


def _explicit_lists(one: Drawn, dtype: torch.dtype) -> None:
    """Fields from F and H, whose answers numpy gives pixel by pixel. For pinholes, in float64."""
    if one.pair.has_lens or dtype != torch.float64:
        return
    pair, x = one.pair, torch.from_numpy(one.x)
    H, F = pair.homography.numpy(), pair.fundamental.numpy()
    h, w = pair.beta.hw
    local, nearest = ag.Local(3)(pair, x), ag.NearestVoxels(24, 8)(pair, x)
    displaced = ag.HomographyDisplacement(5.0)(pair, x)
    for i, p in enumerate(one.x):
        q = H @ [*p, 1]
        line = F @ [*p, 1]
        norm = np.hypot(*line[:2])
        placed = q[2] > 0.02 * np.abs(H).max() * 1e-3 and q[2] > 1e-9
        if not placed or norm < 1e-9 * np.abs(F).max() * np.abs(p).max(initial=1) or np.abs(F).max() < 1e-12:
            continue
        centre, line = q[:2] / q[2], line / norm
        if np.abs(centre).max() > 1e5:
            continue
        window = np.array([[u, v] for v in (-1, 0, 1) for u in (-1, 0, 1)]) + centre
        inside = ((window >= -0.5) & (window <= [w - 0.5, h - 0.5])).all(-1)
        assert np.array_equal(local.mask[i].numpy(), inside), f"Local: {one.kind}"
        assert np.abs(local.xy[i].numpy() - window)[inside].max(initial=0) < 1e-6, f"Local: {one.kind}"
        foot = centre - (line[:2] @ centre + line[2]) * line[:2]
        if displaced.valid[i]:
            for end in (displaced.start[i].numpy(), displaced.end[i].numpy()):
                assert abs(line[:2] @ end + line[2]) < 1e-5, (
                    f"HomographyDisplacement: {one.kind}: off its line"
                )
                assert np.linalg.norm(end - foot) < 5 + 1e-5, f"HomographyDisplacement: {one.kind}: too far"
        else:
            walk = foot + np.linspace(-4.9, 4.9, 50)[:, None] * [-line[1], line[0]]
            assert not explicit.on_image(pair.beta, walk, 0.01).any(), (
                f"HomographyDisplacement: {one.kind}: missed"
            )
        _nearest_pixels(one.kind, nearest.xy[i].numpy()[nearest.mask[i].numpy()], centre, line, (h, w))


def _nearest_pixels(
    kind: str, found: np.ndarray, centre: np.ndarray, line: np.ndarray, hw: tuple[int, int]
) -> None:
    """The 24 whole pixels nearest the line in a window of 17 x 17, where rounding does not decide."""
    around = np.round(centre)
    if (np.abs(centre - np.floor(centre) - 0.5) < 1e-6).any():
        return
    grid = np.stack(np.meshgrid(np.arange(-8, 9), np.arange(-8, 9)), -1).reshape(-1, 2) + around
    grid = grid[((grid >= 0) & (grid <= [hw[1] - 1, hw[0] - 1])).all(-1)]
    distance = np.abs(grid @ line[:2] + line[2])
    assert len(found) == min(24, len(grid)), f"NearestVoxels: {kind}: {len(found)} pixels"
    if len(found):
        mine = np.sort(np.abs(found @ line[:2] + line[2]))
        assert np.abs(mine - np.sort(distance)[: len(mine)]).max() < 2e-3, (
            f"NearestVoxels: {kind}: not the nearest"
        )
        assert len(np.unique(found, axis=0)) == len(found), f"NearestVoxels: {kind}: a pixel twice"


def _gradients(one: Drawn, dtype: torch.dtype) -> None:
    changes = one.rig.parameters(free=["*"])
    x = torch.from_numpy(one.x).to(dtype).requires_grad_()
    for name, field, *_ in fields_of(one):
        found = field(one.rig.perturbed(changes).pair("alpha", "beta"), x)
        ends = (found.start + found.end).sum() if isinstance(found, ag.Segments) else found.xy.sum()
        if not ends.requires_grad:
            continue
        slopes = torch.autograd.grad(ends, [x, *changes.values()], allow_unused=True)
        for parameter, slope in zip(["pixels", *changes], slopes):
            assert slope is None or bool(slope.isfinite().all()), (
                f"{name}: {one.kind}: gradient of {parameter}"
            )


def check_variants(one: Drawn, other: Drawn) -> None:
    """Autocast, whole pixels, and a batch of two give what one rig gives."""
    x = torch.from_numpy(one.x).float()
    whole = x.round().clamp(min=0)
    single = one.rig.to(torch.float32).pair("alpha", "beta")
    for name, field, *_ in fields_of(one):
        _same(f"{name}: {one.kind}: whole", field(one.pair, whole.long()), field(one.pair, whole))
        expected = field(single, x)
        with torch.autocast("cpu", torch.bfloat16):
            fresh = one.rig.to(torch.float32).pair("alpha", "beta")
            _same(f"{name}: {one.kind}: autocast", field(fresh, x), expected)
    if one.pair.has_lens or other.pair.has_lens or one.kind == "tiny image" or other.kind == "tiny image":
        return
    other_rig = ag.Rig(
        {n: other.rig[n].replace(hw=one.rig[n].hw) for n in one.rig.names}, depth=other.rig.depth
    )
    batch = ag.stack([one.rig, other_rig]).pair("alpha", "beta")
    pixels = torch.from_numpy(np.stack([one.x, other.x]))
    for name, field, *_ in fields_of(one):
        found = field(batch, pixels)
        for i, (rig, kind) in enumerate(((one.rig, one.kind), (other_rig, other.kind))):
            # At the epipole (the last pixel) and with hardly any baseline, the direction of the line is up to
            # rounding.
            n = PIXELS - (kind == "on the epipole" and name in BY_LINES)
            tolerance = 1e-4 if kind == "tiny baseline" and name in BY_LINES else 1e-6
            alone = field(rig.pair("alpha", "beta"), pixels[i])
            mine, theirs = (
                type(found)(*(v[:n] for v in parts))
                for parts in ([v[i] for v in vars(found).values()], vars(alone).values())
            )
            _same(f"{name}: {one.kind}: batched", mine, theirs, tolerance)


BY_LINES = ("HomographyDisplacement", "NearestVoxels")
"""Fields from F alone."""


def _same(name: str, found: Any, expected: Any, tolerance: float = 0.0) -> None:
    for f in dataclasses.fields(expected):
        a, b = getattr(found, f.name), getattr(expected, f.name)
        torch.testing.assert_close(
            a.expand_as(b), b, atol=tolerance, rtol=tolerance, msg=lambda m: f"{name}: {m}"
        )
