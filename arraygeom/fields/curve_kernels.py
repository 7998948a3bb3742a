"""Compiled loops of `Curved`, equal to its readable form in `curved.py`, in float64, pixel by pixel.

Each runs in one thread and without Python's lock. Imported when first needed.
"""

from __future__ import annotations

import math

import numpy as np

from ..epipolar import FRONT
from ..runtime.compiled import compiled
from ..segments import FLAT

BROWN, FISHEYE = 1, 2
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
    room = _room(len(even), len(fractions))
    _, x, y, visible = room[1]
    right, bottom = hw[1] - 0.5, hw[0] - 0.5
    for p in range(begin, end):
        total = _follow(first[p], last[p], lens, even, fractions, hw, room) if valid[p] else 0.0
        for i in range(len(fractions)):
            counts = total > 0 and visible[i] and _near(x[i], y[i], hw)
            mask[p, i] = counts
            xy[p, i, 0] = min(max(x[i], -0.5), right) if counts else 0.0
            xy[p, i, 1] = min(max(y[i], -0.5), bottom) if counts else 0.0


@compiled(nogil=True, cache=True, error_model="numpy")
def curved_gradients(begin, end, first, last, valid, lens, even, fractions, hw, by_xy, by_first, by_last):
    """Write the gradient by the ends of some of alpha's curves: `curved_positions` in reverse.

    What that computes is computed again.

    Args:
        begin: first pixel of alpha; this and the next eight as in `curved_positions`.
        by_xy: gradient by the positions (n, samples, 2).
        by_first: gradient by the near ends (n, 3) to write, zeros before.
        by_last: gradient by the far ends (n, 3) to write, zeros before.

    Returns:
        The sums over these pixels of the gradients by the intrinsics (3, 3) and by the coefficients (14).
    """
    room, by_nodes = _room(len(even), len(fractions)), np.empty((3, len(even)))
    by_samples, by_pieces = np.empty((3, len(fractions))), np.empty((4, len(even) - 1))
    (s, x, y, _), (s_at, x_at, y_at, visible), pieces, along, piece, within = room
    by_K, by_c = np.zeros((3, 3)), np.zeros(14)
    for p in range(begin, end):
        if not valid[p] or not _follow(first[p], last[p], lens, even, fractions, hw, room) > 0:
            continue
        for i in range(len(fractions)):
            counts = visible[i] and _near(x_at[i], y_at[i], hw)
            by_samples[0, i] = by_xy[p, i, 0] if counts and -0.5 <= x_at[i] <= hw[1] - 0.5 else 0.0
            by_samples[1, i] = by_xy[p, i, 1] if counts and -0.5 <= y_at[i] <= hw[0] - 0.5 else 0.0
        numbers = (first[p], last[p], lens, by_first[p], by_last[p], by_K, by_c)
        _project_back(numbers, along, s_at, by_samples)
        _along_back(pieces, fractions, piece, within, by_samples[2], by_pieces)
        _pieces_back(x, y, hw, pieces, by_pieces, by_nodes)
        _project_back(numbers, even, s, by_nodes)
    return by_K, by_c


@compiled(error_model="numpy")
def _room(nodes, samples):
    """Make arrays for a curve's numbers: shares, x, y and visibility at the nodes, the same at the samples,
    pieces, fractions of samples, their pieces, and fractions within these."""
    at_nodes = np.empty(nodes), np.empty(nodes), np.empty(nodes), np.empty(nodes, np.bool_)
    at_samples = np.empty(samples), np.empty(samples), np.empty(samples), np.empty(samples, np.bool_)
    pieces, within = np.empty((4, nodes - 1)), np.empty(samples)
    return at_nodes, at_samples, pieces, np.empty(samples), np.empty(samples, np.int64), within


@compiled(error_model="numpy")
def _follow(first, last, lens, even, fractions, hw, room):
    """Write the numbers of a curve, those of the samples if there are any, and return its visible length."""
    (s, x, y, visible), (s_at, x_at, y_at, visible_at), pieces, along, piece, within = room
    _project(first, last, lens, even, s, x, y, visible)
    total = _pieces(x, y, visible, hw, pieces)
    if total > 0:
        _along(pieces, total, fractions, piece, within, along)
        _project(first, last, lens, along, s_at, x_at, y_at, visible_at)
    return total


@compiled(inline="always")
def _near(x, y, hw):
    """Return True for a point that is moved onto the edge of the image, or lies within it."""
    low, right, bottom = -0.5 - FARTHEST_OFF, hw[1] - 0.5 + FARTHEST_OFF, hw[0] - 0.5 + FARTHEST_OFF
    return (x > low) & (x < right) & (y > low) & (y < bottom)


@compiled(inline="always")
def _shares(first, last, wide, u, s):
    """Write to s the share of `last` in points at fractions u: even in undistorted pixels, or in angle."""
    if not wide:
        z0, z1 = first[2], last[2]
        for i in range(len(u)):
            s[i] = u[i] * z0 / ((1 - u[i]) * z1 + u[i] * z0)
        return
    angle, _, _, _, _, r0, r1 = _opening(first, last)
    for i in range(len(u)):
        a, b = (1 - u[i]) * _sinc((1 - u[i]) * angle) * r1, u[i] * _sinc(u[i] * angle) * r0
        s[i] = b / (a + b)


@compiled(inline="always")
def _opening(first, last):
    """Return the angle between two points, its sine and cosine times the lengths, the squared lengths, and
    the lengths, which are not below `FRONT`."""
    cx = first[1] * last[2] - first[2] * last[1]
    cy = first[2] * last[0] - first[0] * last[2]
    cz = first[0] * last[1] - first[1] * last[0]
    squared = cx * cx + cy * cy + cz * cz
    dot = first[0] * last[0] + first[1] * last[1] + first[2] * last[2]
    sine = math.sqrt(squared) if squared > TINY else 0.0
    f0 = first[0] * first[0] + first[1] * first[1] + first[2] * first[2]
    f1 = last[0] * last[0] + last[1] * last[1] + last[2] * last[2]
    angle, r0, r1 = math.atan2(sine, dot), math.sqrt(max(f0, FRONT**2)), math.sqrt(max(f1, FRONT**2))
    return angle if sine > 0 else 0.0, sine, dot, f0, f1, r0, r1


@compiled(inline="always")
def _sinc(angle):
    return math.sin(angle) / angle if angle != 0 else 1.0


@compiled(inline="always")
def _sinc_slope(angle):
    if abs(angle) < 1e-2:
        squared = angle * angle
        return -angle / 3 * (1 - squared / 10 * (1 - squared / 28))
    return (math.cos(angle) - math.sin(angle) / angle) / angle


@compiled(error_model="numpy")
def _project(first, last, lens, u, s, x, y, visible):
    """Write the shares s of `last` in the points at fractions u, their pixels in beta, and which it can
    see."""
    _shares(first, last, lens.wide, u, s)
    a, b = (first[0], first[1], first[2]), (last[0] - first[0], last[1] - first[1], last[2] - first[2])
    if lens.model == BROWN:  # without branches within the loops: they become vector instructions
        for i in range(len(s)):
            X, Y, Z = a[0] + s[i] * b[0], a[1] + s[i] * b[1], a[2] + s[i] * b[2]
            inverse = 1 / (Z if Z > 0 else 1.0)
            x[i], y[i], visible[i] = X * inverse, Y * inverse, (Z > 0) & (X * X + Y * Y + Z * Z > FRONT**2)
        _brown(lens.c, lens.limit, x, y, visible)
    else:
        for i in range(len(s)):
            X, Y, Z = a[0] + s[i] * b[0], a[1] + s[i] * b[1], a[2] + s[i] * b[2]
            u, _, inside, _, scale, p = _fisheye(lens.c, lens.limit, X, Y, Z)
            x[i], y[i] = X * scale * p, Y * scale * p
            visible[i] = inside and (u > 0 or Z > 0) and X * X + Y * Y + Z * Z > FRONT**2
    K = lens.K
    for i in range(len(s)):
        u, v = x[i], y[i]
        x[i], y[i] = K[0, 0] * u + K[0, 1] * v + K[0, 2], K[1, 0] * u + K[1, 1] * v + K[1, 2]


@compiled(error_model="numpy")
def _project_back(numbers, u, s, by):
    """Write the gradient by the fractions u as by[2], that by the pixels being by[:2], and add those by the
    ends, K and the coefficients: `_project` in reverse."""
    first, last, lens, by_first, by_last, by_K, by_c = numbers
    angle, sine, dot, f0, f1, r0, r1 = _opening(first, last)
    if not lens.wide:  # the same, with depths for lengths
        angle, r0, r1 = 0.0, first[2], last[2]
    by_angle, by_r0, by_r1, K = 0.0, 0.0, 0.0, lens.K
    for i in range(len(u)):
        by_x, by_y = by[0, i], by[1, i]
        by[2, i] = 0.0
        if by_x == 0 and by_y == 0:
            continue
        X, Y = first[0] + s[i] * (last[0] - first[0]), first[1] + s[i] * (last[1] - first[1])
        Z = first[2] + s[i] * (last[2] - first[2])
        by_a, by_b = K[0, 0] * by_x + K[1, 0] * by_y, K[0, 1] * by_x + K[1, 1] * by_y
        if lens.model == BROWN:
            z = Z if Z > 0 else 1.0
            a, b, by_X, by_Y = _brown_back(lens.c, lens.limit, X / z, Y / z, by_a, by_b, by_c)
            by_X, by_Y = by_X / z, by_Y / z
            by_Z = -(X * by_X + Y * by_Y) / z if Z > 0 else 0.0
        else:
            a, b, by_X, by_Y, by_Z = _fisheye_back(lens.c, lens.limit, X, Y, Z, by_a, by_b, by_c)
        for j, v in enumerate((a, b, 1.0)):
            by_K[0, j] += by_x * v
            by_K[1, j] += by_y * v
        by_s = 0.0
        for j, v in enumerate((by_X, by_Y, by_Z)):
            by_first[j] += (1 - s[i]) * v
            by_last[j] += s[i] * v
            by_s += v * (last[j] - first[j])
        w, v = 1 - u[i], u[i]
        a, b = w * _sinc(w * angle), v * _sinc(v * angle)
        by_share = by_s / (a * r1 + b * r0) ** 2
        by_a, by_b = -by_share * b * r0, by_share * a * r1
        by_r0, by_r1 = by_r0 + by_b * b, by_r1 + by_a * a
        by[2, i] = by_b * r0 - by_a * r1
        if angle > 0:
            by[2, i] = by_b * r0 * math.cos(v * angle) - by_a * r1 * math.cos(w * angle)
            by_angle += by_b * r0 * v * v * _sinc_slope(v * angle)
            by_angle += by_a * r1 * w * w * _sinc_slope(w * angle)
    if not lens.wide:
        by_first[2] += by_r0
        by_last[2] += by_r1
        return
    for j in range(3):
        if sine > 0:
            by_first[j] += by_angle / sine * (dot / f0 * first[j] - last[j])
            by_last[j] += by_angle / sine * (dot / f1 * last[j] - first[j])
        by_first[j] += by_r0 * first[j] / r0 if f0 > FRONT**2 else 0.0
        by_last[j] += by_r1 * last[j] / r1 if f1 > FRONT**2 else 0.0


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
    for i in range(len(x)):
        x[i], y[i], xx, xy, yx, yy, _, _ = _brown_terms(c, x[i], y[i])
        visible[i] = visible[i] & (xx * yy - xy * yx > 0) & (xx + yy > 0)


@compiled(inline="always")
def _brown_terms(c, a, b):
    """Return a distorted point, its derivatives xx, xy, yx, yy, the radial factor, and 1 / its
    denominator."""
    k1, k2, p1, p2, k3, k4 = c[0], c[1], c[2], c[3], c[4], c[5]
    k5, k6, s1, s2, s3, s4 = c[6], c[7], c[8], c[9], c[10], c[11]
    u = a * a + b * b
    inverse = 1 / (1 + u * (k4 + u * (k5 + u * k6)))
    g = (1 + u * (k1 + u * (k2 + u * k3))) * inverse
    dg = (k1 + u * (2 * k2 + 3 * u * k3) - g * (k4 + u * (2 * k5 + 3 * u * k6))) * inverse
    x = a * g + 2 * p1 * a * b + p2 * (u + 2 * a * a) + u * (s1 + s2 * u)
    y = b * g + p1 * (u + 2 * b * b) + 2 * p2 * a * b + u * (s3 + s4 * u)
    cross = 2 * (a * b * dg + p1 * a + p2 * b)
    prism_x, prism_y = 2 * (s1 + 2 * s2 * u), 2 * (s3 + 2 * s4 * u)
    xx = g + 2 * a * a * dg + 2 * p1 * b + 6 * p2 * a + prism_x * a
    yy = g + 2 * b * b * dg + 6 * p1 * b + 2 * p2 * a + prism_y * b
    return x, y, xx, cross + prism_x * b, cross + prism_y * a, yy, g, inverse


@compiled(inline="always")
def _brown_back(c, limit, a, b, by_x, by_y, by_c):
    """Return the distorted point of a normalised one, and the gradient by the latter; add that by the
    coefficients."""
    squared = a * a + b * b
    pull = 1.0 if squared < limit else math.sqrt(limit / squared)
    a, b, u = a * pull, b * pull, squared if squared < limit else limit
    x, y, xx, xy, yx, yy, g, inverse = _brown_terms(c, a, b)
    cross, radial = 2 * a * b, (by_x * a + by_y * b) * inverse * u
    of_u, of_u2, of_u3 = radial, radial * u, radial * u * u
    by_c[0], by_c[1], by_c[4] = by_c[0] + of_u, by_c[1] + of_u2, by_c[4] + of_u3
    by_c[5], by_c[6], by_c[7] = by_c[5] - g * of_u, by_c[6] - g * of_u2, by_c[7] - g * of_u3
    by_c[2] += by_x * cross + by_y * (u + 2 * b * b)
    by_c[3] += by_x * (u + 2 * a * a) + by_y * cross
    by_c[8], by_c[9] = by_c[8] + by_x * u, by_c[9] + by_x * u * u
    by_c[10], by_c[11] = by_c[10] + by_y * u, by_c[11] + by_y * u * u
    by_a, by_b = by_x * xx + by_y * yx, by_x * xy + by_y * yy
    if not squared < limit:
        outward = (a * by_a + b * by_b) / u
        by_a, by_b = pull * (by_a - outward * a), pull * (by_b - outward * b)
    return x, y, by_a, by_b


@compiled(inline="always")
def _fisheye(c, limit, x, y, z):
    """Return a point's squared radius u, the slope in u of its angle over the radius, whether that is within
    the limit, the squared angle, and angle over radius and distorted over plain angle, moved in to it;
    `lenses.fisheye.fisheye_project`."""
    u = x * x + y * y
    ratio, slope = _angle_over_radius(u, z)
    inside = u * ratio * ratio < limit
    w = u * ratio * ratio if inside else limit
    scale = ratio if inside else math.sqrt(limit / max(u, 1e-30))
    return u, slope, inside, w, scale, 1 + w * (c[0] + w * (c[1] + w * (c[2] + w * c[3])))


@compiled(inline="always")
def _angle_over_radius(u, z):
    """Return the angle off axis over the radius, of the squared radius u and the depth z, and its slope in
    u."""
    if z > 0 and u < SERIES * z * z:
        t = u / (z * z)
        slope = -(1 / 3 - t * (2 / 5 - t * (3 / 7 - t * (4 / 9 - t * 5 / 11)))) / (z * z * z)
        return (1 - t * (1 / 3 - t * (1 / 5 - t * (1 / 7 - t * (1 / 9 - t / 11))))) / z, slope
    if u > 0:
        ratio = math.atan2(math.sqrt(u), z) / math.sqrt(u)
        return ratio, (z / (u + z * z) - ratio) / (2 * u)
    return math.atan2(1.0, 1.0), 0.0


@compiled(inline="always")
def _fisheye_back(c, limit, x, y, z, by_x, by_y, by_c):
    """Return the distorted point of a point in the camera's frame, and the gradient by the latter; add that
    by the coefficients."""
    u, slope, inside, w, scale, p = _fisheye(c, limit, x, y, z)
    by_factor = by_x * x + by_y * y
    for j, v in enumerate((w, w * w, w * w * w, w * w * w * w)):
        by_c[j] += by_factor * scale * v
    by_u, by_z = -by_factor * scale * p / (2 * u), 0.0
    if inside:
        p_slope = c[0] + w * (2 * c[1] + w * (3 * c[2] + w * 4 * c[3]))
        by_ratio = by_factor * (p + 2 * w * p_slope)
        by_u, by_z = by_factor * scale**3 * p_slope + by_ratio * slope, -by_ratio / (u + z * z)
    factor = scale * p
    return x * factor, y * factor, by_x * factor + 2 * x * by_u, by_y * factor + 2 * y * by_u, by_z


@compiled(inline="always")
def _pieces(x, y, visible, hw, out):
    """Write each piece's visible fractions (from, to) and length, and the sum of lengths; return the whole.

    `curved.visible_pieces` is its readable form.
    """
    total = 0.0
    for i in range(out.shape[1]):
        in_x, out_x = _crossings(x[i], x[i + 1], hw[1] - 0.5)
        in_y, out_y = _crossings(y[i], y[i + 1], hw[0] - 0.5)
        low, high = max(0.0, max(in_x, in_y)), min(1.0, min(out_x, out_y))
        shown = (visible[i] or visible[i + 1]) and low <= high
        length = 0.0
        if shown:
            length = math.sqrt((x[i + 1] - x[i]) ** 2 + (y[i + 1] - y[i]) ** 2 + 1e-6) * (high - low)
        total += length
        out[0, i], out[1, i] = low if shown else 0.0, high if shown else 1.0
        out[2, i], out[3, i] = length, total
    return total


@compiled(inline="always")
def _crossings(a, b, limit):
    """Return the fractions at which a piece, from a to b along one axis, comes onto the image and leaves."""
    moves = b - a
    if abs(moves) < FLAT:
        return 0.0 if -0.5 <= a <= limit else 2.0, 1.0
    one, other = (-0.5 - a) * (1 / moves), (limit - a) * (1 / moves)
    return min(one, other), max(one, other)


@compiled(inline="always")
def _pieces_back(x, y, hw, pieces, by_pieces, by):
    """Write the gradient by the nodes' pixels as by[:2]: `_pieces` in reverse."""
    by[:], by_end = 0.0, 0.0
    for i in range(pieces.shape[1] - 1, -1, -1):
        low, high, length = pieces[0, i], pieces[1, i], pieces[2, i]
        by_end += by_pieces[3, i]
        if length == 0:
            continue
        by_length, whole = by_pieces[2, i] + by_end, length / (high - low)
        by_low, by_high = by_pieces[0, i] - by_length * whole, by_pieces[1, i] + by_length * whole
        at_x, at_y = _crossings(x[i], x[i + 1], hw[1] - 0.5), _crossings(y[i], y[i + 1], hw[0] - 0.5)
        for axis, v, mine, other in ((0, x, at_x, at_y), (1, y, at_y, at_x)):
            moves = v[i + 1] - v[i]
            by_stop = by_length * (high - low) * moves / whole
            by_start = -by_stop
            if low > 0 and mine[0] >= other[0]:
                share = by_low / moves * (0.5 if mine[0] == other[0] else 1.0)
                by_start, by_stop = by_start + (low - 1) * share, by_stop - low * share
            if high < 1 and mine[1] <= other[1]:
                share = by_high / moves * (0.5 if mine[1] == other[1] else 1.0)
                by_start, by_stop = by_start + (high - 1) * share, by_stop - high * share
            by[axis, i], by[axis, i + 1] = by[axis, i] + by_start, by[axis, i + 1] + by_stop


@compiled(inline="always")
def _along(pieces, total, fractions, piece, within, out):
    """Write the piece, the fraction of its visible part and that of the whole polyline, at fractions of the
    visible length; `curved.along_pieces`."""
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
        w = min(max(1 - (pieces[3, i] - wanted) / length, 0.0), 1.0) if length > 0 else 0.0
        piece[k], within[k] = i, w
        out[k] = (i + pieces[0, i] + w * (pieces[1, i] - pieces[0, i])) / count


@compiled(inline="always")
def _along_back(pieces, fractions, piece, within, by_out, by_pieces):
    """Write the gradient by the numbers of each piece: `_along` in reverse."""
    count = pieces.shape[1]
    by_pieces[:] = 0.0
    for k in range(len(fractions)):
        i, w, by = piece[k], within[k], by_out[k] / count
        by_pieces[0, i] += by * (1 - w)
        by_pieces[1, i] += by * w
        by_way = by * (pieces[1, i] - pieces[0, i]) / pieces[2, i]
        by_pieces[2, i] += by_way * (1 - w)
        by_pieces[3, i] -= by_way
        by_pieces[3, count - 1] += by_way * fractions[k]
