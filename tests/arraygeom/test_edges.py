"""Halves, huge numbers, empty sets, no lenses, epipoles, caches: right formulas, awkward numbers."""

import dataclasses

import pytest
import torch

from arraygeom import (
    Curved,
    Distortion,
    Epipolar,
    EpipolarLine,
    HomographyDisplacement,
    Link,
    Moved,
    NearestVoxels,
    Pair,
    Pose,
    Positions,
    Rig,
    ThroughLenses,
    View,
    default_field,
    depth_of,
    epipolar_lines,
    epipoles,
    pixel_grid,
    rectify,
    sampling_locations,
    triangulate,
)
from arraygeom.distortion import COEFFICIENT_COUNTS
from arraygeom.fields.straight import covering_displacement
from tests.arraygeom.rigs import BARREL, parallel_rig, random_rig, with_lenses
from tests.arraygeom.test_camera_models import MODELS
from tests.arraygeom.test_precision import FIELDS, WHOLE

F64 = torch.float64
EMPTY = torch.zeros(0, 2)


def pinholes() -> Rig:
    return random_rig(1)


def bent() -> Rig:
    return with_lenses(random_rig(1), BARREL, BARREL)


LENSES = {
    name: Distortion(name, torch.full((counts[0],), 0.01)) for name, counts in COEFFICIENT_COUNTS.items()
}
LENSES |= {
    name: model.to(torch.float32) for name, (model, _) in MODELS.items() if model.central and name != "own"
}


@pytest.mark.parametrize("model", LENSES)
@pytest.mark.parametrize("size", [1e18, 1e20, 3e38])
def test_lenses_are_finite_at_huge_points_in_float32(model, size):
    lens = LENSES[model]
    X = torch.tensor([[size, 0, 1], [size, size, size], [0, 0, size], [size, -size, -size], [1, 1, 1 / size]])
    X.requires_grad_()
    for value, _ in (lens.project(X), *(f(X[:, :2]) for f in (lens.distort, lens.undistort, lens.unproject))):
        assert value.isfinite().all()
        assert torch.autograd.grad(value[1:4].sum(), X)[0][1:4].isfinite().all()
    (large, valid), (small, expected) = lens.project(X), lens.project(X.detach() / size)
    assert valid[1:4].equal(expected[1:4])
    torch.testing.assert_close(large[1:4][valid[1:4]], small[1:4][valid[1:4]], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("model", [name for name, (model, _) in MODELS.items() if not model.central])
def test_cameras_whose_rays_do_not_meet_are_finite_at_huge_points(model):
    """Up to the distance at which rays are followed, with the values of float64 there."""
    X = torch.tensor([[1e9, 0, 1], [1e18, 1e18, 1e18], [0, 0, 3e38], [1e20, -1e20, -1e20], [1, 1, 1e-20]])
    X.requires_grad_()
    lens = MODELS[model][0].to(torch.float32)
    for value in (lens.project(X)[0], lens.unproject(X[:, :2])[0]):
        assert value.isfinite().all()
        assert not value.requires_grad or torch.autograd.grad(value.sum(), X)[0].isfinite().all()


@pytest.mark.parametrize("near", [1e-38, 1e-30, 1e-20])
def test_a_near_bound_of_nothing_is_finite_in_float32(near):
    pair = pinholes().to(torch.float32).pair("alpha", "beta")
    tiny, small = (Epipolar(bound)(pair, WHOLE) for bound in (near, 1e-12))
    assert tiny.start.isfinite().all()
    assert tiny.end.isfinite().all()
    assert tiny.valid.equal(small.valid)
    torch.testing.assert_close(tiny.start, small.start, atol=1e-3, rtol=0)


def test_a_lens_of_zeros_is_no_lens():
    zero = Distortion("brown-conrady", torch.zeros(5, dtype=F64))
    rig = pinholes()
    plain, same = (
        rig.pair("alpha", "beta"),
        Rig({n: rig[n].replace(distortion=zero) for n in rig.names}, depth=rig.depth).pair("alpha", "beta"),
    )
    assert Epipolar()(same, WHOLE) == Epipolar()(plain, WHOLE)
    assert rectify(same).H_beta.equal(rectify(plain).H_beta)
    y = WHOLE.reshape(-1, 2)
    assert depth_of(same, y, y).depth.equal(depth_of(plain, y, y).depth)
    assert same.alpha.to_kornia().intrinsics.equal(plain.alpha.to_kornia().intrinsics)
    free = dataclasses.replace(zero, coefficients=zero.coefficients.clone().requires_grad_())
    with pytest.raises(ValueError, match="pinhole"):  # one that is to be learned is a lens
        Epipolar()(dataclasses.replace(same, alpha=same.alpha.replace(distortion=free)), WHOLE)


@pytest.mark.parametrize("rig", [pinholes(), bent()], ids=["pinholes", "lenses"])
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_no_pixels_have_no_positions(rig, dtype):
    x = EMPTY.to(dtype)
    for pair in (rig.pair("alpha", "beta"), rig.pair("beta", "alpha")):
        fields = [f for f in FIELDS if not isinstance(f, Moved) or pair.alpha is rig["alpha"]]
        for field in [Curved(5), ThroughLenses(Epipolar(), 5)] if pair.has_lens else fields:
            found = field(pair, x.requires_grad_())
            assert {len(part) for part in vars(found).values()} == {0}, field
        assert len(depth_of(pair, x, x).depth) == 0
        assert triangulate(list(pair.cameras), torch.stack([x, x])).X.shape == (0, 3)


def test_nearest_voxels_of_no_pixels_keep_their_shape():
    assert NearestVoxels(7, 4)(pinholes().pair("alpha", "beta"), EMPTY).xy.shape == (0, 7, 2)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_there_is_no_line_on_the_epipole_nor_of_zero(dtype):
    # [e]x: e at (31, 20)
    F = torch.tensor([[0.0, -1e-3, 0.02], [1e-3, 0, -0.031], [-0.02, 0.031, 0]], dtype=dtype)
    views = {"a": View(hw=(48, 64)), "b": View(hw=(40, 60))}
    pair = Rig(views, links={("a", "b"): Link(F)}).pair("a", "b")
    nothing = Rig(views, links={("a", "b"): Link(torch.zeros_like(F))}).pair("a", "b")
    e = epipoles(F.double())[0]
    x = torch.stack([(e[:2] / e[2]).to(dtype), torch.tensor([31.1, 20.0], dtype=dtype)])
    assert EpipolarLine()(pair, x).valid.tolist() == [False, True]
    assert not EpipolarLine()(nothing, x).valid.any()
    assert not epipolar_lines(F, x)[0].any()
    assert epipolar_lines(F, x)[1].isfinite().all()


@pytest.mark.parametrize("lens", ["brown-conrady", "kannala-brandt"])
def test_gradients_of_curves_by_betas_lens_are_those_of_differences(lens):
    """The differences are of the computed function: positions of its nodes depend on the lens too."""
    rig, c = (
        random_rig(2),
        BARREL.coefficients if lens == "brown-conrady" else torch.tensor([0.05, -0.01, 2e-3, -1e-3]),
    )
    x, c = WHOLE.double().reshape(-1, 2), c.double()

    def positions(c):
        beta = rig["beta"].replace(distortion=Distortion(lens, c))
        return Curved(16)(rig.with_camera("beta", beta).pair("alpha", "beta"), x).xy

    leaf = c.clone().requires_grad_()
    weight = torch.randn(positions(c).shape, dtype=F64, generator=torch.Generator().manual_seed(0))
    (gradient,) = torch.autograd.grad((positions(leaf) * weight).sum(), leaf)
    steps = 1e-6 * torch.eye(4, dtype=F64)
    expected = torch.stack([((positions(c + e) - positions(c - e)) * weight).sum() / 2e-6 for e in steps])
    assert float((gradient - expected).norm() / expected.norm()) < 2e-5


def test_a_displacement_follows_its_pair():
    """Steps in place, inference mode, export leave no former answer, nor one that gradients cannot use."""
    rig = pinholes()
    K = rig["beta"].K.clone()
    pair = dataclasses.replace(rig.pair("alpha", "beta"), beta=rig["beta"].replace(K=K))
    field = HomographyDisplacement()
    with torch.inference_mode():
        field(pair, WHOLE)
    leaf = K.clone().requires_grad_()
    learned = dataclasses.replace(pair, beta=pair.beta.replace(K=leaf))
    with torch.inference_mode():
        field(learned, WHOLE)
    field(learned, WHOLE).start.sum().backward()
    assert leaf.grad is not None
    before = covering_displacement(pair)
    K[:2] *= 2
    fresh = dataclasses.replace(pair, beta=pair.beta.replace(K=K))
    torch.testing.assert_close(covering_displacement(pair), covering_displacement(fresh))
    assert covering_displacement(pair) != before
    traced = rig.pair("alpha", "beta")

    class Field(torch.nn.Module):
        def forward(self, x):
            return field(traced, x).start

    torch.export.export(Field(), (WHOLE.reshape(-1, 2),))
    assert field(traced, WHOLE).start.equal(field(rig.pair("alpha", "beta"), WHOLE).start)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_cameras_of_108_megapixels(dtype):
    """Segments to 0.02 px in float32, of which a pixel of 12,000 is known to 1e-3."""
    hw = (9000, 12_000)
    rig = parallel_rig(12_000.0, hw, {"alpha": (), "beta": (0.1, -0.003, -0.002)}, (2.0, 50.0))
    x = pixel_grid((90, 120), dtype=F64) * 100
    exact = Epipolar()(rig.pair("alpha", "beta"), x)
    found = Epipolar()(rig.to(dtype).pair("alpha", "beta"), x.to(dtype))
    both = exact.valid & found.valid
    assert float((exact.valid == found.valid).double().mean()) > 0.999
    for one, two in ((found.start, exact.start), (found.end, exact.end)):
        assert float((one.double() - two).abs()[both].max()) < 0.02
    voxels = [NearestVoxels(9, 3)(rig.to(t).pair("alpha", "beta"), x[::20, ::20].to(t)) for t in (dtype, F64)]
    off = (voxels[0].xy.double() - voxels[1].xy).abs().amax(-1)
    assert float((off > 0).double().mean()) < 0.05


FAR_ORIGIN = torch.tensor([500_000.0, 5_000_000.0, 300.0], dtype=F64)
"""As of UTM coordinates, metres."""


def in_utm(rig: Rig) -> Rig:
    moved = {}
    for name, camera in rig.cameras.items():
        pose = camera.cam_from_world
        moved[name] = camera.replace(cam_from_world=Pose(pose.R, pose.t - pose.R @ FAR_ORIGIN))
    return Rig(moved, depth=rig.depth)


@pytest.mark.parametrize("rig", [pinholes(), bent()], ids=["pinholes", "lenses"])
def test_rigs_in_map_coordinates_are_right_or_refused(rig):
    """To a hundredth of a pixel in float64, whatever pixels are; float32 would hold poses to half a metre."""
    here, there = (r.pair("alpha", "beta") for r in (rig, in_utm(rig)))
    for dtype in (F64, torch.float32):
        x = torch.tensor([[20.0, 12.0], [31.0, 25.0]], dtype=dtype)
        for field in (default_field(here), EpipolarLine() if not here.has_lens else Curved(8)):
            found = [sampling_locations(field, pair, x) for pair in (here, there)]
            one, other = (f if isinstance(f, Positions) else f.positions(5) for f in found)
            assert torch.equal(one.mask, other.mask)
            assert float((one.xy - other.xy).abs().max()) < 0.01
        assert x.dtype == one.xy.dtype
    X = torch.tensor([[0.1, 0.2, 4.0]], dtype=F64)
    pixels = [
        torch.stack([c.project(X + FAR_ORIGIN).x for c in there.cameras]).to(t) for t in (F64, torch.float32)
    ]
    for x in pixels:
        assert float((triangulate(there.cameras, x).X - FAR_ORIGIN - X).abs().max()) < 1e-3
    single = in_utm(rig).to(torch.float32).pair("alpha", "beta")
    with pytest.raises(ValueError, match=r"float32.*float64"):
        default_field(single)(single, torch.tensor([[20.0, 12.0]]))


@pytest.mark.parametrize("unit", [1e-3, 1, 1e3])
def test_a_place_far_off_is_judged_by_the_scene_whatever_its_unit(unit):
    """10 km from the origin float32 holds a millimetre: nothing at 100 m, too little at half a metre."""
    x = torch.tensor([[20.0, 12.0]])

    def pair(baseline: float, near: float) -> Pair:
        places = {"alpha": (1e4,), "beta": (1e4 + baseline,)}
        rig = parallel_rig(50.0, (48, 64), places, (near, 10 * near))
        return rig.scaled(unit).to(torch.float32).pair("alpha", "beta")

    assert Epipolar()(pair(10.0, 100.0), x).valid.all()
    with pytest.raises(ValueError, match="cameras"):
        Epipolar()(pair(0.1, 0.5), x)
