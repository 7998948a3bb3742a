import dataclasses

import numpy as np
import pytest
import torch

from arraygeom import (
    Camera,
    Curved,
    Distortion,
    Epipolar,
    EpipolarLine,
    HomographyDisplacement,
    Local,
    NearestVoxels,
    Pair,
    Pose,
    Rig,
    ThroughLenses,
    View,
    intrinsics,
    rotation_from_vector,
    sampling_locations,
    stack,
)
from arraygeom.fields.curved import _Straight
from arraygeom.pixels import pixel_grid
from tests.arraygeom import explicit
from tests.arraygeom.rigs import half_rotation, known_by_f, random_rig, two_cameras, uniform, with_lenses

FISHEYE = Distortion("kannala-brandt", torch.tensor([0.1, -0.05, 0.02, -0.004], dtype=torch.float64))
BARREL = Distortion("brown-conrady", torch.tensor([-0.28, 0.07, 1e-3, -5e-4], dtype=torch.float64))


def fisheye_rig() -> Rig:
    """Two fisheyes of about 150 degrees, 480 x 400 and 400 x 360 pixels, strongly curved lines."""

    def camera(hw: tuple[int, int], focal: float, w: list[float], centre: list[float]) -> Camera:
        R = rotation_from_vector(torch.tensor(w, dtype=torch.float64))
        pose = Pose.from_centre(R, torch.tensor(centre, dtype=torch.float64))
        return Camera(K=intrinsics(focal, hw), cam_from_world=pose, hw=hw, distortion=FISHEYE)

    cameras = {
        "alpha": camera((400, 480), 180.0, [0, 0, 0], [0, 0, 0]),
        "beta": camera((360, 400), 150.0, [0.1, -0.15, 0.2], [0.4, 0.25, 0.1]),
    }
    return Rig(cameras, depth=(0.5, 8.0))


def distance_to_polyline(points: torch.Tensor, line: torch.Tensor) -> torch.Tensor:
    """From points (n, k, 2) to polylines (n, l, 2)."""
    a, b = line[:, None, :-1], line[:, None, 1:]
    step = b - a
    s = ((points[:, :, None] - a) * step).sum(-1) / step.square().sum(-1).clamp(min=1e-12)
    foot = a + s.clamp(0, 1)[..., None] * step
    return (points[:, :, None] - foot).norm(dim=-1).amin(-1)


def test_spacing_is_even_in_pixels():
    pair = fisheye_rig().pair("alpha", "beta")
    x = pixel_grid((400, 480), dtype=torch.float64)[10::23, 7::29].reshape(-1, 2)
    p = Curved(64)(pair, x)
    steps = p.xy.diff(dim=-2).norm(dim=-1)[p.mask.all(-1)]
    long = steps.sum(-1) > 10
    assert ((steps / steps.mean(-1, keepdim=True))[long] - 1).abs().max() < 0.1


def test_gradients_in_every_parameter_lenses_included():
    rig = with_lenses(random_rig(3), BARREL, FISHEYE)
    x = torch.tensor([[30.0, 20.0]], dtype=torch.float64)
    zero = torch.zeros(3, dtype=torch.float64)
    cameras = [rig[n] for n in ("alpha", "beta")]
    numbers = [v for c in cameras for v in (c.K, zero, c.t, c.distortion.coefficients)]
    numbers = [v.detach().clone().requires_grad_() for v in (*numbers, *rig.depth)]

    def positions(*numbers):
        moved = [
            c.replace(
                K=K,
                cam_from_world=Pose(rotation_from_vector(w) @ c.R, t),
                distortion=dataclasses.replace(c.distortion, coefficients=k),
            )
            for c, (K, w, t, k) in zip(cameras, (numbers[:4], numbers[4:8]))
        ]
        p = Curved(4, nodes=8)(Pair(*moved, (numbers[8], numbers[9])), x)
        return p.xy[p.mask]

    assert positions(*numbers).numel() == 8
    assert torch.autograd.gradcheck(positions, numbers, atol=1e-4, rtol=1e-4, fast_mode=True)


@pytest.mark.parametrize("lens", [None, BARREL, FISHEYE], ids=["pinhole", "barrel", "fisheye"])
@pytest.mark.parametrize("centre", [(0, 0, 0), (0, 0, 0.5), (0, 0, 5.0), (0.3, 0, 0)])
@pytest.mark.parametrize("turned", [False, True])
def test_degenerate_rigs_give_finite_values_and_gradients(lens, centre, turned):
    rig = two_cameras(half_rotation() if turned else None, centre=centre, depth=(1.0, float("inf")))
    rig = with_lenses(rig, lens, lens)
    changes = rig.parameters(free=["*.rotation", "*.translation", "*.focal", "*.centre", "depth.near"])
    for dtype in (torch.float32, torch.float64):
        p = sampling_locations(
            Curved(16),
            rig.perturbed(changes).pair("alpha", "beta"),
            pixel_grid((48, 64), dtype=dtype)[::4, 1::4],
        )
        assert p.xy.isfinite().all()
        slopes = torch.autograd.grad(p.xy.sum(), list(changes.values()), allow_unused=True)
        assert all(s is None or s.isfinite().all() for s in slopes)


def test_batched_rigs_agree_with_single_ones():
    rigs = [with_lenses(random_rig(i), FISHEYE, None) for i in range(2)]
    g = torch.Generator().manual_seed(0)
    x = uniform(g, 5, 40, 2, 6, 2)
    batch = stack(rigs)
    together = Curved(8)(batch.pair("alpha", "beta"), x)
    shared = Curved(8)(batch.pair("alpha", "beta"), x[:1])
    for i, rig in enumerate(rigs):
        alone = Curved(8)(rig.pair("alpha", "beta"), x[i])
        torch.testing.assert_close(together.xy[i], alone.xy)
        torch.testing.assert_close(shared.xy[i], Curved(8)(rig.pair("alpha", "beta"), x[0]).xy)


def test_straight_fields_refuse_lenses():
    with pytest.raises(ValueError, match="use Curved"):
        sampling_locations(Epipolar(), fisheye_rig().pair("alpha", "beta"))


@pytest.mark.parametrize("lenses", [(BARREL, BARREL), (BARREL, None), (None, BARREL)])
def test_a_straight_field_through_lenses_follows_the_same_curve(lenses):
    rig = with_lenses(random_rig(3), *lenses)
    pair = rig.pair("alpha", "beta")
    x = pixel_grid(pair.alpha.hw, dtype=torch.float64)[::7, ::7].reshape(-1, 2)
    exact = Curved(200)(pair, x)
    whole = exact.mask.all(-1)
    found = ThroughLenses(Epipolar(), 200)(pair, x)
    both = whole & found.mask.all(-1)
    assert both.sum() > 15
    assert distance_to_polyline(exact.xy[both], found.xy[both]).max() < 0.05
    assert (found.xy[both][:, 0] - exact.xy[both][:, 0]).norm(dim=-1).max() < 0.5
    by_F = ThroughLenses(HomographyDisplacement(100.0), 400)(known_by_f(rig).pair("alpha", "beta"), x)
    near = (exact.xy[both][:, :, None] - by_F.xy[both][:, None]).norm(dim=-1)
    assert near.masked_fill(~by_F.mask[both][:, None], torch.inf).amin(-1).max() < 0.5


def test_through_no_lenses_is_the_field_itself():
    pair = random_rig(4).pair("alpha", "beta")
    x = pixel_grid(pair.alpha.hw, dtype=torch.float64)
    straight, through = Epipolar()(pair, x).positions(9), ThroughLenses(Epipolar(), 9)(pair, x)
    assert torch.equal(through.mask, straight.mask)
    assert torch.equal(through.xy[through.mask], straight.xy[straight.mask])


def test_links_through_lenses_survive_what_is_done_to_images():
    """Resized, cropped and turned: the same points, in the new pixels."""
    rig = known_by_f(with_lenses(random_rig(3), BARREL, BARREL))
    x = torch.tensor([[30.0, 20.0]], dtype=torch.float64)
    before = ThroughLenses(HomographyDisplacement(20.0), 21)(rig.pair("alpha", "beta"), x)
    h, w = rig["beta"].hw
    changed = rig.resize("beta", (2 * h, 2 * w)).rot90("beta", 1).pair("alpha", "beta")
    after = ThroughLenses(HomographyDisplacement(40.0), 200)(changed, x)
    doubled = (before.xy + 0.5) * 2 - 0.5
    turned = torch.stack([doubled[..., 1], 2 * w - 1 - doubled[..., 0]], -1)[before.mask]
    assert len(turned) > 5
    assert distance_to_polyline(turned[None], after.xy[after.mask][None]).max() < 0.3


@pytest.mark.parametrize("field", [EpipolarLine(), HomographyDisplacement(20.0), NearestVoxels(), Local()])
def test_fields_of_links_refuse_lenses(field):
    rig = known_by_f(with_lenses(random_rig(3), None, BARREL))
    with pytest.raises(ValueError, match="ThroughLenses"):
        field(rig.pair("alpha", "beta"), torch.tensor([[30.0, 20.0]]))
    plain = rig.with_camera("beta", View(hw=rig["beta"].hw))
    field(plain.pair("alpha", "beta"), torch.tensor([[30.0, 20.0]]))


def moving_forward(lens: Distortion | None, *, focal: float = 400.0, centre=(0.05, -0.03, 0.8)) -> Rig:
    """Beta ahead of alpha, within the depth range: many rays pass the plane of beta's centre."""
    beta = Pose.from_centre(
        rotation_from_vector(torch.tensor([0.02, 0.1, -0.05]).double()), torch.tensor(centre).double()
    )
    cameras = {
        "alpha": Camera(K=intrinsics(focal, (360, 480)), cam_from_world=Pose.identity(), hw=(360, 480)),
        "beta": Camera(K=intrinsics(focal, (300, 440)), cam_from_world=beta, hw=(300, 440), distortion=lens),
    }
    return Rig(cameras, depth=(0.3, 20.0))


@pytest.mark.parametrize("seed", range(4))
def test_without_lenses_rays_that_pass_beta_keep_their_near_end(seed):
    g = torch.Generator().manual_seed(seed)
    centre = [float(uniform(g, -0.3, 0.3)), float(uniform(g, -0.3, 0.3)), float(uniform(g, 0.4, 1.5))]
    pair = moving_forward(None, centre=centre).pair("alpha", "beta")
    x = pixel_grid(pair.alpha.hw, dtype=torch.float64)[3::9, 2::9]
    curved, straight = Curved(32)(pair, x), Epipolar()(pair, x)
    assert torch.equal(curved.mask.any(-1), straight.valid)
    off = (curved.xy - straight.positions(32).xy).norm(dim=-1)[straight.valid]
    assert off.max() < 1e-6


@pytest.mark.parametrize(
    ("lens", "focal"),
    [(None, 400.0), (BARREL, 330.0), (FISHEYE, 400.0), (FISHEYE, 150.0)],
    ids=["none", "barrel", "narrow", "wide"],
)
def test_everything_that_beta_sees_of_a_ray_is_near_a_sample(lens, focal):
    """Forward motion: 4,000 points of each ray, projected in numpy, against the polyline of the samples."""
    pair = moving_forward(lens, focal=focal).pair("alpha", "beta")
    x = pixel_grid(pair.alpha.hw, dtype=torch.float64)[5::40, 4::40].reshape(-1, 2)
    rays = explicit.rays_of(pair.alpha, x.numpy())
    X = explicit.beta_points(pair, rays, 1 / np.geomspace(0.3, 20.0, 4000))
    xy, seen = explicit.pixels_of(pair.beta, X.reshape(-1, 3))
    seen &= (X[..., 2] > 2e-3).reshape(-1) | (lens is FISHEYE)
    on = (seen & explicit.on_image(pair.beta, xy, 0.01)).reshape(len(x), -1)
    p = Curved(200)(pair, x)
    assert torch.equal(p.mask.any(-1), torch.from_numpy(on.any(-1)))
    assert explicit.on_image(pair.beta, p.xy[p.mask].numpy(), -1e-9).all()
    for i in np.flatnonzero(on.any(-1)):
        points, line = torch.from_numpy(xy.reshape(*on.shape, 2)[i][on[i]]), p.xy[i][p.mask[i]]
        step = line.diff(dim=0).norm(dim=-1)
        off = torch.cdist(points, line).amin(-1).max()
        assert off < 0.6 * step.median() + 0.5


def test_a_view_without_a_lens_beside_one_with_takes_pixels_of_any_device():
    """The meta device stands for a GPU."""
    x = pixel_grid((4, 6), device="meta").reshape(-1, 2)
    straight = _Straight.from_view(View(hw=(4, 6)))
    for found, valid in (straight.undistort(x), straight.distort(x)):
        assert found.device.type == valid.device.type == "meta"
