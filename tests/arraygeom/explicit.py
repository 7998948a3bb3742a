"""Explicit projection in numpy, float64: what fields are held against. Shares no code with the packages."""

import numpy as np


def pixels_of(camera, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) in the frame of a camera to pixels, and which it sees (in front, in the lens's range)."""
    K = camera.K.detach().double().numpy()
    lens = camera.distortion
    with np.errstate(all="ignore"):
        if lens is not None and lens.model == "kannala-brandt":
            xy, seen = _fisheye(lens.coefficients.detach().double().numpy(), X)
        else:
            seen = X[:, 2] > 0
            xy = X[:, :2] / np.where(seen, X[:, 2], 1.0)[:, None]
            if lens is not None:
                xy, inside = _brown(lens.coefficients.detach().double().numpy(), xy)
                seen = seen & inside
    return xy @ K[:2, :2].T + K[:2, 2], seen


def on_image(camera, x: np.ndarray, margin: float = 0.0) -> np.ndarray:
    """Which pixels are on the camera's image, at least `margin` pixels from its edge."""
    h, w = camera.hw
    return ((x >= -0.5 + margin) & (x <= np.array([w - 0.5, h - 0.5]) - margin)).all(-1)


def beta_points(pair, rays: np.ndarray, inverse_depth: np.ndarray) -> np.ndarray:
    """Points of alpha's rays (n, 3), z = 1, at inverse depths (m), in beta's frame over depth: (n, m, 3)."""
    R, t = (v.detach().double().numpy() for v in (pair.beta_from_alpha.R, pair.beta_from_alpha.t))
    return (rays @ R.T)[:, None] + inverse_depth[None, :, None] * t


def rays_of(camera, x: np.ndarray) -> np.ndarray:
    """The rays (n, 3) with z = 1 of a pinhole's pixels."""
    return np.concatenate([x, np.ones((len(x), 1))], -1) @ np.linalg.inv(camera.K.detach().double().numpy()).T


def _brown(c: np.ndarray, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    k1, k2, p1, p2, k3, k4, k5, k6 = (*c, *np.zeros(8))[:8]
    x, y = xy.T
    u = x * x + y * y
    g = (1 + u * (k1 + u * (k2 + u * k3))) / (1 + u * (k4 + u * (k5 + u * k6)))
    out = np.stack(
        [x * g + 2 * p1 * x * y + p2 * (u + 2 * x * x), y * g + p1 * (u + 2 * y * y) + 2 * p2 * x * y], -1
    )
    r = np.concatenate([np.linspace(0, 3, 30001), np.geomspace(3, 1000, 30001)[1:]])
    v = r * r
    radius = r * (1 + v * (k1 + v * (k2 + v * k3))) / (1 + v * (k4 + v * (k5 + v * k6)))
    falls = np.flatnonzero(np.diff(radius) <= 0)
    return out, u < (r[falls[0]] ** 2 if len(falls) else np.inf)


def _fisheye(c: np.ndarray, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    def radius(a: np.ndarray) -> np.ndarray:
        return a * (1 + c[0] * a**2 + c[1] * a**4 + c[2] * a**6 + c[3] * a**8)

    r = np.hypot(X[:, 0], X[:, 1])
    theta = np.arctan2(r, X[:, 2])
    scale = np.where(r > 0, radius(theta) / np.where(r > 0, r, 1.0), 0.0)
    grid = np.linspace(0, np.pi, 30001)
    falls = np.flatnonzero(np.diff(radius(grid)) <= 0)
    return X[:, :2] * scale[:, None], theta < (grid[falls[0]] if len(falls) else np.pi)
