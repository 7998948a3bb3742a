"""Integer and half-precision pixels, autocast, mixed types, and batches with pixels of their own."""

import dataclasses

import pytest
import torch

from arraygeom import (
    Camera,
    Curved,
    Dense,
    Distortion,
    Epipolar,
    EpipolarLine,
    HomographyDisplacement,
    Local,
    Moved,
    NearestVoxels,
    Pose,
    Rectified,
    Rig,
    ThroughLenses,
    Widened,
    apply_homography,
    depth_of,
    epipolar_distance,
    epipolar_lines,
    fit_homography,
    fit_similarity,
    fundamental_matrix,
    infinite_homography,
    intrinsics,
    rectify,
    sample,
    sampling_locations,
    shift_origin,
    stack,
    to_grid,
    triangulate,
)
from arraygeom.fields import covering_displacement
from arraygeom.pixels import pixel_grid
from tests.arraygeom.rigs import random_rig, scene_points, two_cameras

FIELDS = [
    Epipolar(),
    EpipolarLine(),
    HomographyDisplacement(8.0),
    HomographyDisplacement(),
    Rectified(20.0),
    Rectified(),
    NearestVoxels(24, 12),
    Local(3),
    Dense(4),
    Curved(16),
    ThroughLenses(Epipolar(), 16),
    Widened(Epipolar(), 2, 3),
    Widened(Epipolar(), along=3),
    Moved(Epipolar(), torch.full((2, 48, 64), 0.25)),
]
CHUNKED = [Epipolar(), EpipolarLine(), HomographyDisplacement(8.0), HomographyDisplacement()]
WHOLE = pixel_grid((48, 64))[::5, ::5]


def pair_of(seed=1, **changes):
    return random_rig(seed, **changes).pair("alpha", "beta")


def assert_alike(found, expected, **tolerance):
    for f in dataclasses.fields(expected):
        one, two = getattr(found, f.name), getattr(expected, f.name)
        torch.testing.assert_close(one, two, **tolerance)


@pytest.mark.parametrize("dtype", [torch.int64, torch.int32, torch.uint8, torch.float16])
@pytest.mark.parametrize("field", FIELDS, ids=repr)
def test_fields_of_whole_pixels_are_those_of_floats(field, dtype):
    pair = pair_of()
    assert_alike(field(pair, WHOLE.to(dtype)), field(pair, WHOLE), atol=0, rtol=0)
    assert_alike(sampling_locations(field, pair, WHOLE.to(dtype)), field(pair, WHOLE), atol=0, rtol=0)


@pytest.mark.parametrize("dtype", [torch.int64, torch.uint8, torch.float16])
def test_points_of_whole_pixels_are_those_of_floats(dtype):
    rig = random_rig(1)
    lens = Distortion("brown-conrady", torch.tensor([-0.1, 0.02, 0.001, 0], dtype=torch.float64))
    pair, bent = rig.pair("alpha", "beta"), rig["alpha"].replace(distortion=lens)
    x, y = WHOLE.reshape(-1, 2), WHOLE.flip(0).reshape(-1, 2)
    depth = torch.full_like(x[:, 0], 2)
    through = rig.with_camera("alpha", bent).pair("alpha", "beta")
    for ask in (
        lambda x, y, d: epipolar_lines(pair.fundamental, x),
        lambda x, y, d: epipolar_distance(pair.fundamental, x, y),
        lambda x, y, d: apply_homography(pair.homography, x),
        lambda x, y, d: bent.rays(x),
        lambda x, y, d: bent.distort(x),
        lambda x, y, d: bent.undistort(x),
        lambda x, y, d: bent.unproject(x, d),
        lambda x, y, d: bent.project(torch.cat([x, d[:, None]], -1)),
        lambda x, y, d: bent.contains(x),
        lambda x, y, d: depth_of(pair, x, y),
        lambda x, y, d: depth_of(through, x, y),
        lambda x, y, d: triangulate(list(pair.cameras), torch.stack([x, y])),
        lambda x, y, d: to_grid(x, (48, 64)),
        lambda x, y, d: sample(torch.ones(1, 1, 20, 20), x[None]),
    ):
        torch.testing.assert_close(
            ask(x.to(dtype), y.to(dtype), depth.to(dtype)), ask(x, y, depth), equal_nan=True
        )


def test_numbers_of_a_rig_are_not_made_integers():
    with pytest.raises(TypeError, match=r"float32.*float64"):
        random_rig(1).to(torch.int64)


def test_autocast_leaves_geometry_alone():
    rig = random_rig(1).to(torch.float32)
    pair, points = rig.pair("alpha", "beta"), scene_points(random_rig(1)).float()
    lens = Distortion("brown-conrady", torch.tensor([-0.1, 0.02, 0.001, *[0.0] * 9, 0.02, 0.03]))
    bent = rig["alpha"].replace(distortion=lens)
    x = WHOLE.reshape(-1, 2)
    y = apply_homography(pair.homography, x).x
    for ask in (
        lambda: pair.fundamental,
        lambda: pair.homography,
        lambda: pair.beta_from_alpha.inverse().R,
        lambda: shift_origin(pair.fundamental, 1.0),
        lambda: infinite_homography(rig["alpha"].K, rig["beta"].K, rig["beta"].R),
        lambda: bent.project(points),
        lambda: bent.undistort(x),
        lambda: rig["alpha"].unproject(x, torch.ones(len(x))),
        lambda: rig["alpha"].resize((24, 32)).rot90(1).K,
        lambda: rig["alpha"].cam_from_world.perturbed(torch.full((3,), 0.1)).R,
        lambda: rectify(pair).H_beta,
        lambda: triangulate(list(pair.cameras), torch.stack([c.project(points).x for c in pair.cameras])),
        lambda: depth_of(pair, x, y),
        lambda: fit_homography(x, y),
        lambda: fit_similarity(x, y),
    ):
        with torch.autocast("cpu", torch.bfloat16):
            found = ask()
        torch.testing.assert_close(found, ask(), atol=0, rtol=0, equal_nan=True)


@pytest.mark.parametrize("field", FIELDS, ids=repr)
def test_cameras_of_several_types_are_those_of_the_widest(field):
    """K float64 and pose float32 as numbers of float32 in float64; and cameras that differ."""
    rig = random_rig(1).to(torch.float32)
    wide, x = rig.to(torch.float64), pixel_grid((48, 64), dtype=torch.float64)[::5, ::5]

    def mixed(camera: Camera) -> Camera:
        return camera.replace(K=camera.K.to(torch.float64))

    for name in rig.names:
        one = rig.with_camera(name, mixed(rig[name]))
        assert_alike(
            field(one.pair("alpha", "beta"), x), field(wide.pair("alpha", "beta"), x), atol=2e-4, rtol=1e-5
        )


def test_points_of_several_types():
    rig = random_rig(1)
    camera, X = rig["alpha"].replace(K=rig["alpha"].K.float()), scene_points(rig)
    torch.testing.assert_close(
        camera.project(X.float()).x.double(), rig["alpha"].project(X).x, atol=1e-3, rtol=1e-5
    )
    F = fundamental_matrix(camera.K, rig["beta"].K, rig.pair("alpha", "beta").beta_from_alpha)
    torch.testing.assert_close(F, rig.pair("alpha", "beta").fundamental, atol=1e-6, rtol=1e-4)


@pytest.mark.parametrize("field", CHUNKED, ids=repr)
@pytest.mark.parametrize("shape", [(200, 200), (128, 128), (40000,), (2, 3, 7000)])
def test_rigs_of_a_batch_with_pixels_of_their_own(field, shape):
    rigs = [random_rig(i) for i in range(4)]
    batch = stack(rigs).pair("alpha", "beta")
    g = torch.Generator().manual_seed(0)
    x = torch.rand((4, *shape, 2), generator=g) * torch.tensor([63.0, 47.0])
    found = field(batch, x)
    assert found.valid.shape == (4, *shape)
    for i, rig in enumerate(rigs):
        assert_alike(found[i], field(rig.pair("alpha", "beta"), x[i]), atol=1e-4, rtol=0)


def test_the_covering_displacement_of_a_batch_is_each_rigs_own():
    rigs = [two_cameras(centre=(b, 0, 0)) for b in (0.05, 0.8)]
    batch = stack(rigs).pair("alpha", "beta")
    alone = torch.stack([covering_displacement(r.pair("alpha", "beta")) for r in rigs])
    torch.testing.assert_close(covering_displacement(batch), alone)
    assert not covering_displacement(batch, WHOLE[None, :0].double()).any()
    torch.testing.assert_close(
        covering_displacement(batch, WHOLE[None].double()),
        torch.stack([covering_displacement(r.pair("alpha", "beta"), WHOLE.double()) for r in rigs]),
    )
    found = sampling_locations(HomographyDisplacement(), batch)
    for i, rig in enumerate(rigs):
        assert_alike(found[i], sampling_locations(HomographyDisplacement(), rig.pair("alpha", "beta")))


@pytest.mark.parametrize("shape", [(), (5,), (3,), (3, 5), (3, 3, 5)])
def test_a_batch_of_cameras_meets_the_leading_axes_of_points(shape):
    rigs = [random_rig(i) for i in range(3)]
    cameras = stack([r["alpha"] for r in rigs])
    X = torch.randn((3, *shape, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    X[..., 2] += 5
    found = cameras.project(X)
    back = cameras.unproject(found.x, found.depth)
    for i, rig in enumerate(rigs):
        torch.testing.assert_close(found.x[i], rig["alpha"].project(X[i]).x)
    torch.testing.assert_close(back, X)
    turned = cameras.rot90(1)
    torch.testing.assert_close(turned.unproject(turned.project(X).x, found.depth), X)


@pytest.mark.parametrize("shape", [(), (5,), (4, 3)])
def test_points_without_the_batch_axis_are_refused(shape):
    pose = stack([Pose.identity()] * 3)
    with pytest.raises(ValueError, match="points"):
        pose.apply(torch.zeros(*shape, 3, dtype=torch.float64))


def test_samples_outside_an_image_are_zero_whatever_its_first_pixel():
    image = torch.ones(1, 2, 4, 4)
    image[..., 0, 0] = torch.nan
    found = sample(image, torch.tensor([[[-9.0, 0.0], [2.0, 2.0]]]))
    assert found.values.tolist() == [[[0.0, 1.0], [0.0, 1.0]]]


def test_extended_samples_are_those_of_the_nearest_pixel():
    image = torch.arange(20.0).reshape(1, 1, 4, 5)
    found = sample(image, torch.tensor([[[-9.0, -3.0], [1.5, 70.0], [99.0, 2.0], [2.0, 1.0]]]), extended=True)
    assert found.values.flatten().tolist() == [0.0, 16.5, 14.0, 7.0]
    assert found.valid.all()


def test_intrinsics_keep_the_gradient():
    focal, centre = torch.nn.Parameter(torch.tensor(500.0)), torch.tensor([3.0, 4.0], requires_grad=True)
    K = intrinsics(focal, (480, 640), centre)
    assert K.tolist() == [[500.0, 0, 3], [0, 500, 4], [0, 0, 1]]
    K.sum().backward()
    assert focal.grad == 2
    assert centre.grad.tolist() == [1, 1]
    assert intrinsics((torch.tensor(5.0), 6.0), (3, 3)).diagonal().tolist() == [5, 6, 1]
    with pytest.raises(ValueError, match="number"):
        intrinsics(torch.ones(3), (480, 640))


def test_a_batch_of_rigs_is_not_one_rig_file(tmp_path):
    with pytest.raises(ValueError, match=r"batch[^/]*$"):
        stack([random_rig(0), random_rig(1)]).save(tmp_path / "rig.yaml")
    assert not list(tmp_path.iterdir())


def test_numbers_that_a_format_leaves_out_are_named(tmp_path):
    from arraygeom.io import RigFileWarning, write_rig

    rig = random_rig(1)
    with pytest.warns(RigFileWarning, match="depth") as found:
        write_rig(rig, tmp_path / "chain.yaml", format="kalibr")
    assert len(found) == 1
    write_rig(Rig(rig.cameras), tmp_path / "chain.yaml", format="kalibr")
    with pytest.warns(RigFileWarning, match="world"):
        write_rig(Rig({"beta": rig["beta"]}), tmp_path / "camera.yml", format="opencv")
    placed = rig["beta"].replace(cam_from_world=Pose.identity())
    write_rig(Rig({"beta": placed}), tmp_path / "camera.yml", format="opencv")


ZERO = """image_width: 64
image_height: 48
camera_name: mono
camera_matrix: {rows: 3, cols: 3, data: [50, 0, 32, 0, 50, 24, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
projection_matrix: {rows: 3, cols: 4, data: [50, 0, 32, 0, 0, 50, 24, 0, 0, 0, 1, 0]}
"""


def test_a_lens_of_zeros_is_no_lens(tmp_path):
    (tmp_path / "mono.yaml").write_text(ZERO)
    assert Rig.load(tmp_path / "mono.yaml")["mono"].distortion is None
    zero = Distortion("brown-conrady", torch.zeros(5, dtype=torch.float64))
    random_rig(1).with_camera("beta", random_rig(1)["beta"].replace(distortion=zero)).save(
        tmp_path / "rig.yaml"
    )
    assert Rig.load(tmp_path / "rig.yaml")["beta"].distortion is None


@pytest.mark.parametrize("seed", range(20))
def test_homographies_of_steep_planes_are_fitted(seed):
    """Exact matches of planes that come as near as a hundredth of where they are farthest."""
    g = torch.Generator().manual_seed(seed)
    x = torch.rand(60, 2, generator=g, dtype=torch.float64) * 640
    slope = torch.randn(2, generator=g, dtype=torch.float64)
    slope = slope * 0.99 / (x @ slope).abs().max()
    H = torch.eye(3, dtype=torch.float64) + 0.2 * torch.randn(3, 3, generator=g, dtype=torch.float64)
    H[2] = torch.tensor([*slope.tolist(), 1.0])
    y = apply_homography(H, x)
    assert y.valid.all()
    fitted = fit_homography(x, y.x)
    error = (apply_homography(fitted, x).x - y.x).norm(dim=-1).max()
    assert error < 1e-6 * y.x.abs().max()
    noisy = fit_homography(x, y.x + torch.randn(60, 2, generator=g, dtype=torch.float64))
    assert apply_homography(noisy, x).valid.all()
    assert (apply_homography(noisy, x).x - y.x).square().mean().sqrt() < 3
