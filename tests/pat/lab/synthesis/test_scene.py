from typing import get_args

import numpy as np
import pytest

from pat.lab.synthesis.scene import Key, Motion, Relief, Shape
from pat.lab.synthesis.shapes import inside, mesh
from tests.pat.lab.synthesis.scenes import thing

VOLUMES = {
    "cube": 1.0,
    "sphere": np.pi / 6,
    "cylinder": np.pi / 4,
    "cone": np.pi / 12,
    "torus": np.pi**2 * 0.35 * 0.15,
}
SOLIDS = [s for s in get_args(Shape) if s not in ("plane", "room", "lathe")]


def corners(shape):
    return np.split(shape.vertices[shape.faces], 4, axis=1)


def volume(shape) -> float:
    a, b, c, d = (x[:, 0] for x in corners(shape))
    return float((np.cross(b, c) * a + np.cross(c, d) * a).sum() / 6)


def test_motion_passes_through_its_keys_and_rotates_evenly():
    keys = (
        Key(position=(0, 0, 5)),
        Key(position=(1, 0, 5), rotation=(0, 0, np.pi / 2), extent=(2, 1, 1), time=2.0),
    )
    motion = Motion(keys)
    half = motion.at(1.0)
    np.testing.assert_allclose(half.position, [0.5, 0, 5])
    np.testing.assert_allclose(half.extent, [1.5, 1, 1])
    np.testing.assert_allclose(half.R[:2, :2], np.sqrt(0.5) * np.array([[1, -1], [1, 1]]), atol=1e-12)
    for key in keys:
        np.testing.assert_allclose(motion.at(key.time).position, key.position)
    assert all(np.array_equal(a, b) for a, b in zip(motion.at(9.0), motion.at(2.0)))


def test_keys_must_be_in_order():
    with pytest.raises(ValueError, match="times"):
        Motion((Key(position=(0, 0, 0)), Key(position=(0, 0, 0))))


@pytest.mark.parametrize("shape", SOLIDS)
@pytest.mark.parametrize("relief", [None, Relief(height=0.02, size=0.4)])
def test_solids_are_closed_and_face_outwards(shape, relief):
    solid = mesh(thing(shape, (0, 0, 0), extent=(2.0, 1.0, 1.5), relief=relief))
    assert volume(solid) == pytest.approx(3 * VOLUMES[shape], rel=0.03)
    if relief is None:
        np.testing.assert_allclose(
            [solid.vertices.min(0), solid.vertices.max(0)], [[-1, -0.5, -0.75], [1, 0.5, 0.75]], atol=1e-9
        )
        return
    a, b = np.roll(solid.faces, -1, 1), solid.faces
    edges = np.stack([b, a], -1)[a != b]
    _, uses = np.unique(np.sort(edges, 1), axis=0, return_counts=True)
    assert (uses == 2).all(), "a relief must not crack"


@pytest.mark.parametrize("shape", [*SOLIDS, "plane"])
def test_images_on_surfaces_are_not_mirrored(shape):
    """Seen from outside, u is right where v is down, and lengths are true on flat faces."""
    surface = mesh(thing(shape, (0, 0, 0), extent=(2.0, 1.0, 1.5)))
    a, b, c, _ = (x[:, 0] for x in corners(surface))
    ua, ub, uc = (surface.uv[:, i] for i in range(3))
    turn = (ub - ua)[:, 0] * (uc - ua)[:, 1] - (ub - ua)[:, 1] * (uc - ua)[:, 0]
    assert (turn[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-9] < 1e-12).all()
    if shape in ("plane", "cube"):
        np.testing.assert_allclose(np.linalg.norm(b - a, axis=1), np.linalg.norm(ub - ua, axis=1))


@pytest.mark.parametrize("shape", SOLIDS)
def test_inside_agrees_with_the_surface(shape):
    """Vertices drawn in to the surface's own inside are inside, pushed out they are not."""
    item = thing(shape, (1.0, 2.0, 5.0), extent=(2.0, 1.0, 1.5))
    solid, place = mesh(item), item.motion.at(0)
    a, b, c, d = (x[:, 0] for x in corners(solid))
    normal = np.cross(c - a, d - b)
    size = np.linalg.norm(normal, axis=1)
    middle = ((a + b + c + d) / 4)[size > 1e-6]
    normal = (normal / size[:, None])[size > 1e-6]
    for step, expected in ((-0.02, True), (0.02, False)):
        X = (middle + step * normal)[::7] @ place.R.T + place.position
        assert [inside(item, x, 0.0) for x in X] == [expected] * len(X)
    assert not inside(thing("room", (1.0, 2.0, 5.0)), place.position, 0.0)
