import numpy as np
import pytest
import torch

from arraygeom import Pair, Pose, apply_homography, rectify, rotation_from_vector
from arraygeom.rectification import rotation_to, rotation_vector
from tests.arraygeom.rigs import random_rig, scene_points, two_cameras
from tests.oracles import Oracle

cv2 = Oracle("cv2")


def sideways(seed: int, **options: float):
    """A random pair whose baseline is mostly along x."""
    rig = random_rig(seed, baseline=0.1, **options)
    beta = rig["beta"]
    centre = rig["alpha"].centre + torch.tensor([0.5 * (-1) ** seed, 0.05, 0.1], dtype=torch.float64)
    return rig.with_camera("beta", beta.replace(cam_from_world=Pose.from_centre(beta.R, centre)))


@pytest.mark.parametrize("seed", range(6))
def test_rows_agree(seed):
    rig = random_rig(seed)
    pair = rig.pair("alpha", "beta")
    done = rectify(pair)
    X = scene_points(rig)
    alpha, beta = (c.project(X) for c in pair.cameras)
    ours = [apply_homography(H, p.x) for H, p in zip((done.H_alpha, done.H_beta), (alpha, beta))]
    both = alpha.valid & beta.valid & ours[0].valid & ours[1].valid
    assert both.sum() > 20
    assert (ours[0].x - ours[1].x)[both, 1].abs().max() < 1e-6
    for camera, transformed in zip(done.pair.cameras, ours):
        torch.testing.assert_close(camera.project(X).x[both], transformed.x[both], atol=1e-8, rtol=0)


@pytest.mark.parametrize("seed", range(6))
def test_rotations_are_opencvs(seed):
    pair = sideways(seed).pair("alpha", "beta")
    pose = pair.beta_from_alpha
    w, h = 64, 48
    zero = np.zeros(5)
    R1, R2, P1, P2, *_ = cv2.stereoRectify(
        pair.alpha.K.numpy(), zero, pair.beta.K.numpy(), zero, (w, h), pose.R.numpy(), pose.t.numpy()
    )
    done = rectify(pair, K=torch.from_numpy(P1[:, :3].copy()), hw=(h, w))
    np.testing.assert_allclose(done.R_alpha.numpy(), R1, atol=1e-9)
    np.testing.assert_allclose(done.R_beta.numpy(), R2, atol=1e-9)
    # the same epipolar rows: a point of alpha is at OpenCV's row in both of our images
    X = scene_points(sideways(seed), 50)
    for camera, c, R, P in zip(done.pair.cameras, pair.cameras, (R1, R2), (P1, P2)):
        local = c.cam_from_world.apply(X).numpy() @ R.T
        theirs = local @ P[:, :3].T
        rows = theirs[:, 1] / theirs[:, 2]
        ahead = local[:, 2] > 0.1
        np.testing.assert_allclose(camera.project(X).x[ahead, 1].numpy(), rows[ahead], atol=1e-6)


def test_differentiable_in_the_rig():
    pair = sideways(1).pair("alpha", "beta")

    def maps(w, t, K):
        pose = Pose(rotation_from_vector(w) @ pair.beta.R, t)
        done = rectify(Pair(pair.alpha, pair.beta.replace(K=K, cam_from_world=pose), pair.depth))
        return done.H_alpha, done.H_beta

    inputs = [
        v.detach().clone().requires_grad_() for v in (torch.zeros(3).double(), pair.beta.t, pair.beta.K)
    ]
    assert torch.autograd.gradcheck(maps, inputs, atol=1e-4)


def test_rotations_there_and_back():
    for w in ([0.0, 0, 0], [1e-5, 0, -2e-5], [0.3, -0.4, 1.0], [2.0, 1.0, -1.5]):
        w = torch.tensor(w, dtype=torch.float64)
        torch.testing.assert_close(rotation_vector(rotation_from_vector(w)), w, atol=1e-12, rtol=0)
    a, b = (
        torch.nn.functional.normalize(torch.tensor(v, dtype=torch.float64), dim=0)
        for v in ([1.0, 2, 3], [-1.0, 1, 1])
    )
    torch.testing.assert_close(rotation_to(a, b) @ a, b)


def test_what_cannot_be_rectified_is_refused():
    with pytest.raises(ValueError, match="baseline"):
        rectify(two_cameras().pair("alpha", "beta"))
    with pytest.raises(ValueError, match="optical"):
        rectify(two_cameras(centre=(0, 0, 0.3)).pair("alpha", "beta"))
