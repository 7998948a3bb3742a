import pytest
import torch

from arraygeom import rotation_from_vector
from arraygeom.homography import apply_homography, fit_similarity, infinite_homography, plane_homography


@pytest.fixture
def scene() -> dict[str, torch.Tensor]:
    """Five random pairs of cameras and planes, in front of both, in float64."""
    g = torch.Generator().manual_seed(3)

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=g, dtype=torch.float64) - 0.5

    K = (
        torch.tensor([[400.0, 0, 150], [0, 420, 110], [0, 0, 1]], dtype=torch.float64)
        .expand(2, 5, 3, 3)
        .clone()
    )
    K[1, :, 0, 0] += 300 * rand(5)
    normal = torch.tensor([0.0, 0, 1], dtype=torch.float64) + 0.4 * rand(5, 3)
    return {
        "K_alpha": K[0],
        "K_beta": K[1],
        "R": rotation_from_vector(0.3 * rand(5, 3)),
        "t": rand(5, 3),
        "normal": normal,
        "d": -3 + rand(5),
    }


def points_on_plane(scene: dict[str, torch.Tensor], n: int = 20) -> torch.Tensor:
    g = torch.Generator().manual_seed(4)
    rays = torch.rand(5, n, 3, generator=g, dtype=torch.float64) - 0.5
    rays[..., 2] = 1
    depth = -scene["d"][:, None] / (rays * scene["normal"][:, None]).sum(-1)
    return rays * depth[..., None]


def project(K: torch.Tensor, X: torch.Tensor) -> torch.Tensor:
    x = X @ K.mT
    return x[..., :2] / x[..., 2:]


def test_a_point_of_the_plane_projects_the_same_through_both(scene):
    X = points_on_plane(scene)
    X_beta = X @ scene["R"].mT + scene["t"][:, None]
    transformed = apply_homography(plane_homography(**scene), project(scene["K_alpha"], X))
    assert transformed.valid.all()
    torch.testing.assert_close(transformed.x, project(scene["K_beta"], X_beta), rtol=0, atol=1e-9)


def test_the_scale_is_the_ratio_of_depths(scene):
    X = points_on_plane(scene, 1)
    x = torch.cat([project(scene["K_alpha"], X), torch.ones(5, 1, 1, dtype=torch.float64)], -1)
    scale = (x @ plane_homography(**scene).mT)[:, 0, 2]
    Z_beta = (X @ scene["R"].mT)[:, 0, 2] + scene["t"][:, 2]
    torch.testing.assert_close(scale, Z_beta / X[:, 0, 2])


def test_a_far_plane_tends_to_the_infinite_homography(scene):
    far = plane_homography(**(scene | {"d": scene["d"] * 1e9}))
    torch.testing.assert_close(
        far, infinite_homography(scene["K_alpha"], scene["K_beta"], scene["R"]), atol=1e-5, rtol=0
    )


def test_points_behind_or_at_infinity_are_flagged_and_finite():
    H = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0.1, 0, 1]])
    transformed = apply_homography(H, torch.tensor([[0.0, 0], [-10, 0], [-20, 5], [float("nan"), 0]]))
    assert transformed.valid.tolist() == [True, False, False, False]
    assert transformed.x.isfinite().all()


def test_gradients(scene):
    x = torch.tensor([[30.0, 40.0], [200.0, 10.0]], dtype=torch.float64).expand(5, 2, 2)
    names = list(scene)

    def transformed(x: torch.Tensor, *values: torch.Tensor) -> torch.Tensor:
        return apply_homography(plane_homography(**dict(zip(names, values))), x).x

    inputs = [v.detach()[:2].clone().requires_grad_() for v in (x, *scene.values())]
    assert torch.autograd.gradcheck(transformed, inputs)


def test_a_similarity_of_one_point_is_refused():
    with pytest.raises(ValueError, match="points"):
        fit_similarity(torch.ones(3, 2), torch.rand(3, 2))
