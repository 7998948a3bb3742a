import pytest
import torch

from arraygeom import (
    Curved,
    Epipolar,
    NearestVoxels,
    Pair,
    Positions,
    Rectified,
    Segments,
    ThroughLenses,
    View,
    Widened,
)
from arraygeom.fields.widened import direction, tangents
from arraygeom.pixels import pixel_grid
from tests.arraygeom.rigs import random_rig, two_cameras

WIDE = Pair(View(hw=(40, 60)), View(hw=(40, 60)))


def test_motion_along_makes_segments_longer():
    x = torch.tensor([[30.0, 20.0], [58.0, 20.0]])
    s = Widened(Rectified(10.0), along=4.0)(WIDE, x)
    assert isinstance(s, Segments)
    assert s.start[:, 0].tolist() == [16.0, 44.0]
    assert s.end[:, 0].tolist() == [34.0, 59.5]


def test_uncertainty_across_makes_bands():
    x = torch.tensor([[30.0, 20.0]])
    band = Widened(Rectified(10.0), across=2.0, samples=11)(WIDE, x)
    assert band.xy.shape == (1, 55, 2)
    rows = band.xy[0].reshape(5, 11, 2)
    assert rows[:, 0].tolist() == [[20.0, y] for y in (18.0, 19.0, 20.0, 21.0, 22.0)]
    assert rows[2, :, 0].tolist() == list(range(20, 31))
    assert band.mask.all()


def test_rows_are_at_most_a_pixel_apart():
    field = Widened(Rectified(10.0), across=1.5, samples=2)
    assert field.rows == 5
    y = field(WIDE, torch.tensor([[30.0, 20.0]])).xy[0, ::2, 1]
    assert y.tolist() == [18.5, 19.25, 20.0, 20.75, 21.5]


def test_the_first_row_is_to_the_left_of_the_way():
    def downward(pair, x):
        return Segments(x, x + x.new_tensor([0.0, 5.0]), torch.ones_like(x[..., 0], dtype=torch.bool))

    band = Widened(downward, across=1.0, samples=2)(WIDE, torch.tensor([[30.0, 20.0]]))
    assert band.xy[0, 0].tolist() == [31.0, 20.0]  # facing down the image, left is +x


def test_bands_hold_points_moved_by_less_than_they_allow():
    rig = random_rig(1)
    pair = rig.pair("alpha", "beta")
    x = pixel_grid(pair.alpha.hw, dtype=torch.float64)[8:40:6, 8:56:6]
    segments = Epipolar()(pair, x)
    band = Widened(Epipolar(), 3.0, 3.0, samples=64)(pair, x)
    g = torch.Generator().manual_seed(0)
    moved = segments.at(torch.rand(x.shape[:-1], generator=g, dtype=torch.float64))
    moved = moved + 2 * torch.randn(moved.shape, generator=g, dtype=torch.float64).clamp(-1, 1)
    inside = segments.valid & pair.beta.contains(moved)
    nearest = torch.where(band.mask, (band.xy - moved[..., None, :]).norm(dim=-1), torch.inf).amin(-1)
    assert nearest[inside].max() < 0.75


def test_points_widen_to_windows():
    pair = two_cameras().pair("alpha", "beta")
    band = Widened(Epipolar(), 2.0, 2.0, samples=5)(pair, torch.tensor([[30.0, 20.0]]))
    torch.testing.assert_close(band.xy.reshape(5, 5, 2), pixel_grid((5, 5)) + torch.tensor([28.0, 18.0]))


def test_curves_widen_about_their_tangents():
    pair = random_rig(1).pair("alpha", "beta")
    x = pixel_grid(pair.alpha.hw, dtype=torch.float64)[8:40:6, 8:56:6]
    a = Widened(Curved(16), across=1.0, along=2.0)(pair, x)
    b = Widened(Epipolar(), across=1.0, along=2.0, samples=16)(pair, x)
    both = a.mask & b.mask
    assert both.sum() > 500
    assert (a.xy - b.xy)[both].abs().max() < 0.1


def test_nothing_outside_the_image_counts():
    band = Widened(Rectified(10.0), across=3.0, samples=4)(WIDE, torch.tensor([[30.0, 0.0]]))
    assert band.mask.sum() == 4 * 4
    assert not Widened(Rectified(10.0), across=1.0)(WIDE, torch.tensor([[-30.0, 0.0]])).mask.any()
    assert (
        Widened(NearestVoxels(8, 4), across=1.0)(random_rig(0).pair("alpha", "beta"), torch.zeros(1, 2))
        .xy.isfinite()
        .all()
    )


def test_gradients_are_those_of_the_field():
    pair = random_rig(3).pair("alpha", "beta")
    x = torch.tensor([[30.0, 20.0]], dtype=torch.float64)

    def positions(t):
        pose = pair.beta.cam_from_world
        moved = pair.beta.replace(cam_from_world=type(pose)(pose.R, t))
        p = Widened(Epipolar(), across=1.0, along=1.0, samples=3)(Pair(pair.alpha, moved, pair.depth), x)
        return p.xy[p.mask]

    assert torch.autograd.gradcheck(positions, [pair.beta.t.clone().requires_grad_()], atol=1e-5)


def test_directions_of_nothing_have_no_slope():
    step = torch.zeros(1, 2, requires_grad=True)
    direction(step).sum().backward()
    assert step.grad.tolist() == [[0.0, 0.0]]


def test_samples_that_do_not_count_turn_no_tangent():
    xy = torch.stack([torch.arange(9.0), torch.full((9,), 20.0)], -1) + 10
    mask = torch.ones(9, dtype=torch.bool)
    mask[[0, 3, 4, 8]] = False
    p = Positions(torch.where(mask[:, None], xy, 0.0), mask)
    assert tangents(p)[mask].tolist() == [[1.0, 0.0]] * 5


@pytest.mark.parametrize("field", [Epipolar(), Curved(64), ThroughLenses(Epipolar(), 64)], ids=repr)
def test_lines_beside_the_image_are_brought_in(field):
    """Cameras differing by a shift of the principal point: lines of alpha's first rows pass above beta's."""
    rig = two_cameras(centre=(0.2, 0.0, 0.0))
    rig = rig.with_camera("beta", rig["beta"].crop(2, 0, (46, 64)))
    pair = rig.pair("alpha", "beta")
    x = torch.tensor([[40.0, 0.6]], dtype=torch.float64)  # row -1.4 of beta
    band = Widened(field, across=3.0)(pair, x)
    assert band.mask.any()
    assert band.xy[band.mask][:, 1].max() == pytest.approx(1.6)
    assert not Widened(field, across=0.5)(pair, x).mask.any()
