"""`Curved` into cameras of every model, from everywhere, against all that they see of a ray."""

import numpy as np
import pytest
import torch

from arraygeom import Camera, Curved, Pair, Pose, intrinsics
from arraygeom.fields.ray_depth import ray_depth
from arraygeom.lenses import Equirectangular, FlatPort, RollingShutter
from tests.arraygeom.any_camera import BETAS, KINDS, Pushbroom, drawn, lost_and_false, seen
from tests.arraygeom.rigs import number


def all_seen(beta: str, seeds, count: int) -> None:
    for seed in seeds:
        kind, rig, x = drawn(beta, seed)
        lost, false = lost_and_false(rig.pair("a", "b"), x, count)
        assert lost < 1, f"{beta}, seed {seed}, {kind}: {lost} pixels lost"
        assert false < 1, f"{beta}, seed {seed}, {kind}: {false} pixels false"


@pytest.mark.parametrize("beta", BETAS)
def test_all_that_a_camera_sees_of_a_ray_is_near_a_sample(beta):
    all_seen(beta, range(len(KINDS)), 200)


@pytest.mark.slow
@pytest.mark.parametrize("beta", BETAS)
def test_all_that_a_camera_sees_of_a_ray_in_many_rigs(beta):
    all_seen(beta, range(100, 100 + 10 * len(KINDS)), 500)


ROLLING = RollingShutter(velocity=number(0.5, 0.1, 0.2), rotation=number(0.1, 0.3, 0.2), readout=number(0.03))
PORT = FlatPort(distance=number(0.05), thickness=number(0.01), glass=number(1.52), water=number(1.333))


def from_behind(model, focal: float) -> Pair:
    """Alpha 3 m behind beta, its near bound behind beta too."""
    hw = (240, 320)
    alpha = Camera(K=intrinsics(300.0, hw), cam_from_world=Pose.identity(), hw=hw)
    there = Pose.from_centre(torch.eye(3, dtype=torch.float64), number(0.1, -0.05, 3.0))
    beta = Camera(K=intrinsics(focal, hw), cam_from_world=there, hw=hw, distortion=model)
    return Pair(alpha, beta, (number(1.0), number(20.0)))


@pytest.mark.parametrize(
    ("model", "focal"),
    [(ROLLING, 300.0), (PORT, 300.0), (Pushbroom(), 300.0)],
    ids=["rolling shutter", "flat port", "pushbroom"],
)
def test_a_near_bound_behind_a_camera_that_is_not_central_loses_nothing(model, focal):
    pair = from_behind(model, focal)
    x = number(200, 110, 150, 135, 120, 100).reshape(-1, 2)
    xy, on = seen(pair, x, np.linspace(3.0, 20.0, 20001))
    found = Curved()(pair, x)
    assert on.any(-1).all()
    for points, line in zip(
        map(np.ndarray.__getitem__, xy, on), (p[m] for p, m in zip(found.xy, found.mask))
    ):
        longest = np.linalg.norm(points[0] - points[-1])
        assert float((line[0] - line[-1]).norm()) > longest - 2
        assert np.linalg.norm(points[:, None] - line.numpy()[None], axis=-1).min(1).max() < longest / 100 + 1


def test_depth_is_found_again_where_the_image_is_a_small_part_of_the_curve():
    pair = from_behind(ROLLING, 300.0)
    x, wanted = number(200, 90, 150, 150, 120, 100).reshape(-1, 2), number(4.0, 6.0, 9.0)
    there = pair.cameras[1].project(pair.cameras[0].unproject(x, wanted))
    assert bool((there.valid & pair.beta.contains(there.x)).all())
    torch.testing.assert_close(ray_depth(pair, x, there.x).depth, wanted, rtol=1e-4, atol=0)


def test_gradients_pass_where_nodes_were_moved():
    """Held against differences: the nodes are constants, what stays on the curve does not depend on them."""
    pair = from_behind(ROLLING, 300.0)
    x = number(200, 90, 150, 150).reshape(-1, 2)
    near = number(3.6).requires_grad_()

    def positions(near, t, v):
        beta = pair.cameras[1]
        model = RollingShutter(velocity=v, rotation=ROLLING.rotation, readout=ROLLING.readout)
        beta = beta.replace(cam_from_world=Pose(beta.R, t), distortion=model)
        return Curved(5, nodes=500)(Pair(pair.alpha, beta, (near, pair.depth[1])), x).xy

    inputs = near, pair.cameras[1].t.clone().requires_grad_(), ROLLING.velocity.clone().requires_grad_()
    assert torch.autograd.gradcheck(positions, inputs, atol=0.1, rtol=1e-3)


def test_the_seam_of_a_panorama_takes_nothing_of_a_curve():
    """Straight over the seam, with few nodes, every piece of the curve is kept."""
    hw = (100, 200)
    alpha = Camera(K=intrinsics(100.0, hw), cam_from_world=Pose.identity(), hw=hw)
    there = Pose.from_centre(torch.diag(number(-1, 1, -1)), number(0.2, 0.0, 0.0))
    K = intrinsics(hw[1] / (2 * np.pi), hw)
    beta = Camera(K=K, cam_from_world=there, hw=hw, distortion=Equirectangular())
    pair, x = Pair(alpha, beta, (number(0.5), number(20.0))), number(105.0, 50.0)[None]
    xy, on = seen(pair, x, 1 / np.linspace(1 / 20, 2, 4000))
    assert on.all()
    assert np.ptp(xy[0, :, 0]) > 150
    found = Curved(400, nodes=12)(pair, x)
    assert bool(found.mask.all())
    apart = np.linalg.norm(xy[0][:, None] - found.xy[0].numpy()[None], axis=-1).min(1)
    assert apart.max() < 0.2


def test_a_panorama_behind_a_rolling_shutter_has_its_seam():
    still = {n: number(0.0, 0.0, 0.0) for n in ("velocity", "rotation")}
    moving = RollingShutter(**still, readout=number(0.1), lens=Equirectangular())
    assert moving.period == Equirectangular.period
