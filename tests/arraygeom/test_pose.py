import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from arraygeom import Pose, rotation_from_vector
from arraygeom.pose import rotation_error
from tests.oracles import Oracle

transform = Oracle("scipy.spatial.transform")

vectors = st.lists(st.floats(-4, 4), min_size=3, max_size=3)


def random_pose(seed: int, *batch: int) -> Pose:
    g = torch.Generator().manual_seed(seed)
    w, t = (torch.randn(*batch, 3, generator=g, dtype=torch.float64) for _ in range(2))
    return Pose(rotation_from_vector(w), t)


def close(a: Pose, b: Pose) -> None:
    torch.testing.assert_close(a.R, b.R, atol=1e-12, rtol=0)
    torch.testing.assert_close(a.t, b.t, atol=1e-12, rtol=0)


@given(vectors)
def test_exponential_is_scipys(w):
    R = rotation_from_vector(torch.tensor(w, dtype=torch.float64))
    np.testing.assert_allclose(R.numpy(), transform.Rotation.from_rotvec(w).as_matrix(), atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-8, 1e-5, 1e-3, 0.5])
def test_exponential_in_float32_near_zero_angle(angle):
    w = angle * torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64) / 14**0.5
    expected = rotation_from_vector(w)
    R = rotation_from_vector(w.float())
    assert R.dtype == torch.float32
    torch.testing.assert_close(R, expected.float(), atol=2e-7, rtol=0)
    torch.testing.assert_close(R - R.T, (expected - expected.T).float(), atol=2e-7 * angle, rtol=1e-6)


def test_exponentials_derivative_in_float32_at_zero_is_the_generators():
    w = torch.zeros(3, requires_grad=True)
    (gradient,) = torch.autograd.grad(rotation_from_vector(w)[2, 1], w)
    assert gradient.tolist() == [1.0, 0.0, 0.0]


def test_group_axioms():
    a, b, c = (random_pose(i) for i in range(3))
    close((a @ b) @ c, a @ (b @ c))
    close(a @ a.inverse(), Pose.identity())
    close(a.inverse() @ a, Pose.identity())
    X = torch.randn(7, 3, dtype=torch.float64)
    torch.testing.assert_close((a @ b).apply(X), a.apply(b.apply(X)))


def test_centre_is_where_the_camera_is():
    R, centre = random_pose(3).R, torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    pose = Pose.from_centre(R, centre)
    torch.testing.assert_close(pose.centre, centre)
    assert pose.apply(centre[None]).abs().max() < 1e-12


@pytest.mark.parametrize(("dtype", "drift"), [(torch.float64, 1e-15), (torch.float32, 5e-7)])
def test_a_thousand_steps_stay_on_the_manifold(dtype, drift):
    g = torch.Generator().manual_seed(0)
    pose = random_pose(0).to(dtype)
    for _ in range(1000):
        pose = pose.perturbed(0.1 * torch.randn(3, generator=g, dtype=dtype))
    assert rotation_error(pose.R) < drift


def test_gradients():
    w = torch.tensor([[0.0, 0, 0], [0.3, -0.2, 0.5]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(rotation_from_vector, w)
    assert torch.autograd.gradgradcheck(rotation_from_vector, w)


def test_rotation_error_shows_reflections_and_scales():
    R = random_pose(5).R
    assert rotation_error(R) < 1e-12
    assert rotation_error(1.01 * R) == pytest.approx(0.0201, abs=1e-6)
    assert rotation_error(-R) == 2


def test_a_camera_looks_at_its_target():
    g = torch.Generator().manual_seed(0)
    centre, target, down = torch.randn(3, 20, 3, generator=g, dtype=torch.float64)
    pose = Pose.look_at(centre, target, down=down)
    torch.testing.assert_close(pose.centre, centre)
    there = pose.apply(target)
    torch.testing.assert_close(
        there, torch.nn.functional.pad((target - centre).norm(dim=-1)[:, None], (2, 0))
    )
    y = pose.apply(centre + down)
    assert y[:, 0].abs().max() < 1e-9
    assert (y[:, 1] > 0).all()
    assert float(rotation_error(pose.R).max()) < 1e-12
    mixed = Pose.look_at(centre, target.float(), down=down.float())
    torch.testing.assert_close(mixed.R, pose.R, atol=1e-5, rtol=0)
    torch.testing.assert_close(Pose.look_at(centre.float(), target).centre, centre.float().double())
    level = Pose.look_at(torch.zeros(3), torch.tensor([0.0, 0.0, 5.0]))
    assert level.R.equal(torch.eye(3))
    with pytest.raises(ValueError, match="`down`"):
        Pose.look_at(torch.zeros(3), torch.tensor([0.0, 2.0, 0.0]))


def test_poses_go_through_matrices_quaternions_and_kornias_se3():
    g = torch.Generator().manual_seed(1)
    pose = Pose(
        rotation_from_vector(torch.randn(7, 3, generator=g, dtype=torch.float64)), torch.randn(7, 3).double()
    )
    X = torch.randn(7, 3, generator=g, dtype=torch.float64)
    homogeneous = torch.cat([X, torch.ones(7, 1)], -1)
    torch.testing.assert_close((pose.matrix @ homogeneous[..., None])[:, :3, 0], pose.apply(X))
    assert Pose.from_matrix(pose.matrix) == pose
    assert (pose.inverse() @ pose).matrix.sub(torch.eye(4)).abs().max() < 1e-12
    for back in (Pose.from_quaternion(pose.quaternion, pose.t), Pose.from_kornia(pose.to_kornia())):
        torch.testing.assert_close(back.matrix, pose.matrix)
    torch.testing.assert_close(pose.to_kornia().matrix(), pose.matrix)
    torch.testing.assert_close(pose[0].to_kornia().matrix().reshape(4, 4), pose[0].matrix)
    t = pose.t.clone().requires_grad_()
    Pose.from_kornia(pose.replace(t=t).to_kornia()).apply(X).sum().backward()
    torch.testing.assert_close(t.grad, torch.ones_like(t))
