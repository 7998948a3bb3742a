"""Compiled loops of `Curved`, equal to its readable form in `curved.py`, in float64, pixel by pixel.

Each runs in one thread and without Python's lock. Imported when first needed.
"""

from __future__ import annotations

import math

import numpy as np

from ..epipolar import FRONT
from ..runtime.compiled import compiled
from ..segments import FLAT

PINHOLE, BROWN, FISHEYE = 0, 1, 2
TINY = 1e-24
FARTHEST_OFF = 0.25
SERIES = 1e-3


@compiled(nogil=True, cache=True, error_model="numpy")
def curved_positions(begin, end, first, last, valid, lens, even, fractions, hw, xy, mask):
    """Write the positions `xy` and the `mask` of the samples of alpha's pixels `begin` to `end`.

    Args:
        begin: first pixel of alpha.
        end: pixel after the last.
        first: near ends of the curves (n, 3) in beta's frame, as in `RayCurve`, float64.
        last: far ends (n, 3).
        valid: mask (n) of the pixels whose ray beta may see.
        lens: beta's `LensNumbers`.
        even: fractions of the nodes along the curve, 0..1.
        fractions: fractions of the samples along the visible part, 0..1.
        hw: height and width of beta.
        xy: positions (n, samples, 2) to write, pixels of beta, on its image; 0 where masked.
        mask: mask (n, samples) to write, True for samples that count.
    """
    nodes, samples = len(even), len(fractions)
    s, x, y, visible = np.empty(nodes), np.empty(nodes), np.empty(nodes), np.empty(nodes, np.bool_)
    pieces = np.empty((4, nodes - 1))
    along, s_at, x_at, y_at = np.empty(samples), np.empty(samples), np.empty(samples), np.empty(samples)
    visible_at = np.empty(samples, np.bool_)
    for p in range(begin, end):
        total = 0.0
        if valid[p]:
            _shares(first[p], last[p], lens.wide, even, s)
            _project(first[p], last[p], s, lens, x, y, visible)
            total = _pieces(x, y, visible, hw, pieces)
        if total > 0:
            _along(pieces, total, fractions, along)
            _shares(first[p], last[p], lens.wide, along, s_at)
            _project(first[p], last[p], s_at, lens, x_at, y_at, visible_at)
        right, bottom = hw[1] - 0.5, hw[0] - 0.5
        for i in range(samples):
            near = (x_at[i] > -0.5 - FARTHEST_OFF) & (x_at[i] < right + FARTHEST_OFF)
            near = near & (y_at[i] > -0.5 - FARTHEST_OFF) & (y_at[i] < bottom + FARTHEST_OFF)
            counts = (total > 0) & near & visible_at[i]
            mask[p, i] = counts
            xy[p, i, 0] = min(max(x_at[i], -0.5), right) if counts else 0.0
            xy[p, i, 1] = min(max(y_at[i], -0.5), bottom) if counts else 0.0


@compiled(inline="always")
def _shares(first, last, wide, u, s):
    """Write to s the share of `last` in points at fractions u: even in undistorted pixels, or in angle."""
    if not wide:
        z0, z1 = first[2], last[2]
        for i in range(len(u)):
            s[i] = u[i] * z0 / ((1 - u[i]) * z1 + u[i] * z0)
        return
    cx = first[1] * last[2] - first[2] * last[1]
    cy = first[2] * last[0] - first[0] * last[2]
    cz = first[0] * last[1] - first[1] * last[0]
    squared = cx * cx + cy * cy + cz * cz
    dot = first[0] * last[0] + first[1] * last[1] + first[2] * last[2]
    angle = math.atan2(math.sqrt(squared), dot) if squared > TINY else 0.0
    r0 = math.sqrt(max(first[0] ** 2 + first[1] ** 2 + first[2] ** 2, FRONT**2))
    r1 = math.sqrt(max(last[0] ** 2 + last[1] ** 2 + last[2] ** 2, FRONT**2))
    for i in range(len(u)):
        a, b = (1 - u[i]) * _sinc((1 - u[i]) * angle) * r1, u[i] * _sinc(u[i] * angle) * r0
        s[i] = b / (a + b)


@compiled(inline="always")
def _sinc(angle):
    return math.sin(angle) / angle if angle != 0 else 1.0


@compiled(inline="always")
def _project(first, last, s, lens, x, y, visible):
    """Write beta's pixels of the points at shares s, and which it can see."""
    a, b = (first[0], first[1], first[2]), (last[0] - first[0], last[1] - first[1], last[2] - first[2])
    # A loop for each model, without branches within the first two: they become vector instructions.
    if lens.model == PINHOLE:
        for i in range(len(s)):
            X, Y, Z = a[0] + s[i] * b[0], a[1] + s[i] * b[1], a[2] + s[i] * b[2]
            z = Z if Z > 0 else 1.0
            x[i], y[i], visible[i] = X / z, Y / z, (Z > 0) & (X * X + Y * Y + Z * Z > FRONT**2)
    elif lens.model == BROWN:
        for i in range(len(s)):
            X, Y, Z = a[0] + s[i] * b[0], a[1] + s[i] * b[1], a[2] + s[i] * b[2]
            inverse = 1 / (Z if Z > 0 else 1.0)
            x[i], y[i], visible[i] = X * inverse, Y * inverse, (Z > 0) & (X * X + Y * Y + Z * Z > FRONT**2)
        _brown(lens.c, lens.limit, x, y, visible)
    else:
        for i in range(len(s)):
            X, Y, Z = a[0] + s[i] * b[0], a[1] + s[i] * b[1], a[2] + s[i] * b[2]
            x[i], y[i], inside = _fisheye(lens.c, lens.limit, X, Y, Z)
            visible[i] = inside and X * X + Y * Y + Z * Z > FRONT**2
    K = lens.K
    for i in range(len(s)):
        u, v = x[i], y[i]
        x[i], y[i] = K[0, 0] * u + K[0, 1] * v + K[0, 2], K[1, 0] * u + K[1, 1] * v + K[1, 2]


@compiled(inline="always")
def _brown(c, limit, x, y, visible):
    """Distort normalised points in place, invalid ones unseen; `distortion._brown_distort` without a tilt."""
    farthest = 0.0
    for i in range(len(x)):
        farthest = max(farthest, x[i] * x[i] + y[i] * y[i])
    if not farthest < limit:
        for i in range(len(x)):
            squared = x[i] * x[i] + y[i] * y[i]
            pull = math.sqrt(limit / (squared if squared > limit else limit))
            x[i], y[i], visible[i] = x[i] * pull, y[i] * pull, visible[i] & (squared < limit)
    k1, k2, p1, p2, k3, k4 = c[0], c[1], c[2], c[3], c[4], c[5]
    k5, k6, s1, s2, s3, s4 = c[6], c[7], c[8], c[9], c[10], c[11]
    for i in range(len(x)):
        a, b = x[i], y[i]
        u = a * a + b * b
        inverse = 1 / (1 + u * (k4 + u * (k5 + u * k6)))
        g = (1 + u * (k1 + u * (k2 + u * k3))) * inverse
        dg = (k1 + u * (2 * k2 + 3 * u * k3) - g * (k4 + u * (2 * k5 + 3 * u * k6))) * inverse
        x[i] = a * g + 2 * p1 * a * b + p2 * (u + 2 * a * a) + u * (s1 + s2 * u)
        y[i] = b * g + p1 * (u + 2 * b * b) + 2 * p2 * a * b + u * (s3 + s4 * u)
        cross = 2 * (a * b * dg + p1 * a + p2 * b)
        prism_x, prism_y = 2 * (s1 + 2 * s2 * u), 2 * (s3 + 2 * s4 * u)
        xx = g + 2 * a * a * dg + 2 * p1 * b + 6 * p2 * a + prism_x * a
        yy = g + 2 * b * b * dg + 6 * p1 * b + 2 * p2 * a + prism_y * b
        determinant = xx * yy - (cross + prism_x * b) * (cross + prism_y * a)
        visible[i] = visible[i] & (determinant > 0) & (xx + yy > 0)


@compiled(inline="always")
def _fisheye(c, limit, x, y, z):
    """Return the normalised distorted point of a point in the camera's frame (`fisheye_project`)."""
    u = x * x + y * y
    if z > 0 and u < SERIES * z * z:
        t = u / (z * z)
        ratio = (1 - t * (1 / 3 - t * (1 / 5 - t * (1 / 7 - t * (1 / 9 - t / 11))))) / z
    elif u > 0:
        r = math.sqrt(u)
        ratio = math.atan2(r, z) / r
    else:
        ratio = math.atan2(1.0, 1.0)
    v = u * ratio * ratio
    inside = v < limit
    pull = 1.0 if inside else math.sqrt(limit / max(v, 1e-30))
    w = v if inside else limit
    factor = ratio * pull * (1 + w * (c[0] + w * (c[1] + w * (c[2] + w * c[3]))))
    return x * factor, y * factor, inside and (u > 0 or z > 0)


@compiled(inline="always")
def _pieces(x, y, visible, hw, out):
    """Write each piece's visible fractions (from, to) and length, and the sum of lengths; return the whole.

    `curved.visible_pieces` is its readable form.
    """
    total = 0.0
    for i in range(out.shape[1]):
        low, high = 0.0, 1.0
        for a, b, limit in ((x[i], x[i + 1], hw[1] - 0.5), (y[i], y[i + 1], hw[0] - 0.5)):
            moves = b - a
            if abs(moves) < FLAT:
                low = max(low, 0.0 if -0.5 <= a <= limit else 2.0)
            else:
                one, other = (-0.5 - a) * (1 / moves), (limit - a) * (1 / moves)
                low, high = max(low, min(one, other)), min(high, max(one, other))
        shown = (visible[i] or visible[i + 1]) and low <= high
        length = 0.0
        if shown:
            length = math.sqrt((x[i + 1] - x[i]) ** 2 + (y[i + 1] - y[i]) ** 2 + 1e-6) * (high - low)
        total += length
        out[0, i], out[1, i] = low if shown else 0.0, high if shown else 1.0
        out[2, i], out[3, i] = length, total
    return total


@compiled(inline="always")
def _along(pieces, total, fractions, out):
    """Write the fractions of the whole polyline at fractions of its visible length; `curved.along_pieces`."""
    count = pieces.shape[1]
    final = 0
    while final < count - 1 and pieces[3, final] < total:
        final += 1
    i = 0
    for k in range(len(fractions)):
        wanted = fractions[k] * total
        while i < final and pieces[3, i] <= wanted:
            i += 1
        length = pieces[2, i]
        within = min(max(1 - (pieces[3, i] - wanted) / length, 0.0), 1.0) if length > 0 else 0.0
        out[k] = (i + pieces[0, i] + within * (pieces[1, i] - pieces[0, i])) / count
