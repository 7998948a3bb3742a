"""Poses from E and F, against OpenCV and the pair they were made from."""

import numpy as np
import pytest
import torch

from arraygeom import essential_matrix, poses_from_essential, relative_pose, stack
from tests.arraygeom.rigs import random_rig, scene_points
from tests.oracles import Oracle

cv2 = Oracle("cv2")


def seen(seed: int, n: int = 30):
    rig = random_rig(seed)
    X = scene_points(rig, n)
    x, y = (rig[name].project(X) for name in rig.names)
    both = x.valid & y.valid
    return rig.pair("alpha", "beta"), x.x[both], y.x[both]


@pytest.mark.parametrize("seed", range(5))
def test_the_four_poses_are_opencvs(seed):
    pose = random_rig(seed).pair("alpha", "beta").beta_from_alpha
    E = essential_matrix(pose)
    R1, R2, t = cv2.decomposeEssentialMat(E.numpy())
    theirs = sorted(np.r_[R.ravel(), s * t.ravel()].round(6).tolist() for R in (R1, R2) for s in (1, -1))
    found = poses_from_essential(E)
    ours = sorted(torch.cat([found.R.flatten(1), found.t], 1).numpy().round(6).tolist())
    np.testing.assert_allclose(ours, theirs, atol=2e-6)


@pytest.mark.parametrize("seed", range(5))
def test_the_pose_comes_back_from_f(seed):
    pair, x, y = seen(seed)
    for scale in (1.0, -7.0):
        found = relative_pose(scale * pair.fundamental, pair.alpha.K, pair.beta.K, x, y)
        torch.testing.assert_close(found.beta_from_alpha.R, pair.beta_from_alpha.R)
        t = pair.beta_from_alpha.t
        torch.testing.assert_close(found.beta_from_alpha.t, t / t.norm())
        assert found.in_front.all()


@pytest.mark.parametrize("noise", [0.5, 2.0])
@pytest.mark.parametrize("seed", range(5))
def test_the_pose_of_noisy_matches_is_opencvs(seed, noise):
    """E from F of noisy matches has singular values that differ; R is a rotation all the same."""
    pair, x, y = seen(seed, 200)
    rng = np.random.default_rng(seed)
    x, y = (p + noise * torch.from_numpy(rng.standard_normal(p.shape)) for p in (x, y))
    F, _ = cv2.findFundamentalMat(x.numpy(), y.numpy(), cv2.FM_8POINT)
    K, L = pair.alpha.K, pair.beta.K
    E = L.T @ torch.from_numpy(F) @ K
    normalised = [((p - M[:2, 2]) @ torch.linalg.inv(M[:2, :2]).T).numpy() for p, M in ((x, K), (y, L))]
    _, R, t, _ = cv2.recoverPose(E.numpy(), *normalised, np.eye(3))
    found = relative_pose(torch.from_numpy(F), K, L, x, y).beta_from_alpha
    np.testing.assert_allclose(found.R.numpy(), R, atol=1e-9)
    np.testing.assert_allclose(found.t.numpy(), t[:, 0], atol=1e-9)


def test_gradients_batches_and_float32():
    pairs = [seen(seed) for seed in (1, 2)]
    n = min(len(x) for _, x, _ in pairs)
    F, K, L = (
        torch.stack(part) for part in zip(*((p.fundamental, p.alpha.K, p.beta.K) for p, _, _ in pairs))
    )
    x, y = (torch.stack([pair[i][:n] for pair in pairs]) for i in (1, 2))
    both = relative_pose(F, K, L, x, y).beta_from_alpha
    poses = [relative_pose(F[i], K[i], L[i], x[i], y[i]).beta_from_alpha for i in range(2)]
    torch.testing.assert_close(both.matrix, stack(poses).matrix)
    single = relative_pose(F.float(), K.float(), L.float(), x.float(), y.float()).beta_from_alpha
    torch.testing.assert_close(single.matrix.double(), both.matrix, atol=2e-5, rtol=0)
    assert torch.autograd.gradcheck(
        lambda E: poses_from_essential(E).matrix, essential_matrix(both[0]).requires_grad_()
    )
