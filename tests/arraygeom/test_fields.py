import dataclasses

import pytest
import torch

from arraygeom import (
    Dense,
    Epipolar,
    EpipolarLine,
    HomographyDisplacement,
    Link,
    Local,
    Moved,
    NearestVoxels,
    Pair,
    Pose,
    Positions,
    Rectified,
    Rig,
    Segments,
    View,
    Widened,
    epipolar_lines,
    lazily,
    rotation_from_vector,
    sampling_locations,
    stack,
)
from arraygeom.fields import covering_displacement
from arraygeom.fields.grid import FieldOnGrid
from arraygeom.homography import apply_homography
from arraygeom.pixels import pixel_grid
from tests.arraygeom.rigs import half_rotation, known_by_f, random_rig, two_cameras

STRAIGHT = [Epipolar(), EpipolarLine(), HomographyDisplacement(8.0), HomographyDisplacement()]
ALL = [*STRAIGHT, Rectified(20.0), NearestVoxels(24, 12), Local(3), Dense(4)]


def ids(field) -> str:
    return repr(field)


def pair_of(rig: Rig) -> Pair:
    return rig.pair("alpha", "beta")


# ------------------------------------------------------------------ they hold what is seen, and are on the
# line


@pytest.mark.parametrize("field", STRAIGHT, ids=ids)
def test_segments_lie_on_the_lines_and_inside_the_image(field):
    pair = pair_of(random_rig(1))
    segments = sampling_locations(field, pair, pixel_grid(pair.alpha.hw, dtype=torch.float64))
    lines = epipolar_lines(pair.fundamental, pixel_grid(pair.alpha.hw, dtype=torch.float64))
    assert segments.valid.any()
    for end in (segments.start, segments.end):
        assert pair.beta.contains(end).all()
        off = (lines[..., :2] * end).sum(-1) + lines[..., 2]
        assert off[segments.valid].abs().max() < 1e-6


@pytest.mark.parametrize("mirrored", ["neither", "alpha", "beta"])
def test_starts_are_near_and_ends_far_for_calibrated_pairs(mirrored):
    """Also behind a mirror, where F by K has the other sign."""
    rig = random_rig(1)
    if mirrored != "neither":
        h, w = rig[mirrored].hw
        flip = torch.tensor([[-1.0, 0, w - 1], [0, 1, 0], [0, 0, 1]], dtype=torch.float64)
        rig = rig.transformed(mirrored, flip, (h, w))
    pair = pair_of(rig)
    x = pixel_grid(pair.alpha.hw, dtype=torch.float64)
    reference = Epipolar()(pair, x)
    direction = reference.end - reference.start
    for field in (EpipolarLine(), HomographyDisplacement(20.0)):
        s = field(pair, x)
        both = s.valid & reference.valid & (s.length > 0.1)
        assert (((s.end - s.start) * direction).sum(-1)[both] > 0).all()


def test_calibration_and_f_give_the_same_lines():
    rig = random_rig(1, baseline=0.1)
    pair, linked = pair_of(rig), pair_of(known_by_f(rig))
    x = pixel_grid(pair.alpha.hw, dtype=torch.float64)[::4, ::4]
    a, b = (HomographyDisplacement(8.0)(p, x) for p in (pair, linked))
    torch.testing.assert_close(a.start, b.start)
    torch.testing.assert_close(a.end, b.end)
    line, piece = EpipolarLine()(linked, x), EpipolarLine()(pair, x)
    assert line.valid[piece.valid].all()
    assert (line.length - piece.length)[piece.valid].min() > -1e-6


def test_bounds_of_the_field_override_those_of_the_rig():
    rig = random_rig(1)
    x = pixel_grid(rig["alpha"].hw, dtype=torch.float64)
    a, b = Epipolar(near=2.0, far=4.0)(pair_of(rig), x), Epipolar()(pair_of(rig.replace(depth=(2.0, 4.0))), x)
    torch.testing.assert_close(a.start, b.start, atol=0, rtol=0)
    with pytest.raises(ValueError, match="0 < near <= far"):
        Epipolar(near=20.0)(pair_of(rig), x)


def test_the_covering_displacement_covers_and_is_the_least():
    pair = pair_of(random_rig(2))
    x = pixel_grid(pair.alpha.hw, dtype=torch.float64)
    exact = Epipolar()(pair, x)
    disparity = covering_displacement(pair, x)
    assert covering_displacement(pair) == pytest.approx(disparity.item(), abs=1e-9)
    centre = apply_homography(pair.homography, x).x
    ends = torch.stack([(centre - e).norm(dim=-1)[exact.valid] for e in (exact.start, exact.end)])
    # along the line; H x itself lies on it for a plane's homography
    assert ends.max() == pytest.approx(disparity.item(), abs=1e-9)


# --------------------------------------------------------------------------------------- rectified, local,
# dense


@pytest.mark.parametrize("side", ["left", "right", "either"])
def test_rectified_runs(side):
    pair = Pair(View(hw=(4, 20)), View(hw=(4, 20)))
    x = torch.tensor([[10.0, 2.0], [3.0, 0.0]])
    s = Rectified(5.0, alpha_is=side)(pair, x)
    expected = {"left": [(5, 10), (-0.5, 3)], "right": [(15, 10), (8, 3)], "either": [(5, 15), (-0.5, 8)]}[
        side
    ]
    assert s.start[:, 0].tolist() == [e[0] for e in expected]
    assert s.end[:, 0].tolist() == [e[1] for e in expected]
    assert s.start[:, 1].tolist() == [2.0, 0.0]
    assert s.valid.all()


def test_a_whole_row_begins_at_the_largest_disparity():
    """An alpha on the right has its near points farther right in beta."""
    pair, x = Pair(View(hw=(4, 20)), View(hw=(4, 20))), torch.tensor([[10.0, 2.0]])
    s = Rectified(alpha_is="right")(pair, x)
    assert (s.start[0, 0], s.end[0, 0]) == (19, 0)


def test_rectified_scales_to_another_size():
    pair = Pair(View(hw=(4, 20)), View(hw=(8, 10)))
    s = Rectified()(pair, torch.tensor([[10.0, 1.0]]))
    assert s.start.tolist() == [[0.0, 2.5]]
    assert s.end.tolist() == [[9.0, 2.5]]


def test_epipolar_is_rectified_on_a_rectified_pair():
    rig = two_cameras(centre=(0.5, 0, 0), depth=(1.0, float("inf")))
    x = pixel_grid((48, 64))
    a, b = sampling_locations(Epipolar(), pair_of(rig)), Rectified(16.0)(pair_of(rig), x)
    assert torch.equal(a.valid, b.valid)
    torch.testing.assert_close(a.start, b.start, atol=1e-4, rtol=0)
    torch.testing.assert_close(a.end, b.end, atol=1e-4, rtol=0)


def test_local_and_dense_sample_where_they_say():
    pair = pair_of(known_by_f(random_rig(1)))
    x = torch.tensor([[30.0, 20.0]], dtype=torch.float64)
    local = Local(3)(pair, x)
    centre = apply_homography(pair.link.H, x).x
    torch.testing.assert_close(local.xy[:, 4], centre)
    torch.testing.assert_close(local.xy[0, 5] - local.xy[0, 3], torch.tensor([2.0, 0], dtype=torch.float64))
    assert Dense(4)(pair, x).xy[0].tolist() == pixel_grid(pair.beta.hw)[::4, ::4].reshape(-1, 2).tolist()


# ------------------------------------------------------------------------------------------------ nearest
# voxels


def test_nearest_voxels_take_ties_by_row():
    """A line half way between two rows: the upper one."""
    pair = Pair(
        View(hw=(9, 9)),
        View(hw=(9, 9)),
        None,
        Link(torch.tensor([[0.0, 0, 0], [0, 0, -1], [0, 1, 0.5]]), torch.eye(3)),
    )
    found = NearestVoxels(9, 8)(pair, torch.tensor([[4.0, 4.0]]))
    assert found.mask.all()
    assert sorted(found.xy[0].tolist()) == [[float(c), 4.0] for c in range(9)]


# -------------------------------------------------------------------------------------------- shapes and
# batches


@pytest.mark.parametrize("field", ALL, ids=ids)
@pytest.mark.parametrize("shape", [(), (5,), (3, 4), (2, 3, 4)])
def test_any_set_of_pixels(field, shape):
    pair = pair_of(random_rig(1)).to(torch.float32)
    x = torch.rand(*shape, 2) * 40
    found, listed = field(pair, x), field(pair, x.reshape(-1, 2))
    for f in dataclasses.fields(found):
        value = getattr(found, f.name)
        assert value.shape[: len(shape)] == shape
        torch.testing.assert_close(value.reshape(getattr(listed, f.name).shape), getattr(listed, f.name))


@pytest.mark.parametrize("shape", [(), (5,), (4, 3)])
def test_pixels_without_the_batch_axis_are_refused(shape):
    with pytest.raises(ValueError, match=r"\(3,\)"):
        Epipolar()(pair_of(stack([random_rig(i) for i in range(3)])), torch.zeros(*shape, 2))


def test_whole_images_in_chunks_are_what_single_rows_are():
    rig = random_rig(1).resize("alpha", (300, 400))
    pair = pair_of(rig)
    for field in STRAIGHT:
        whole = sampling_locations(field, pair)
        row = field(pair, pixel_grid((300, 400))[123])
        torch.testing.assert_close(whole.start[123], row.start, atol=0, rtol=0)
        assert whole.start.shape == (300, 400, 2)
        assert torch.equal(lazily(field, pair)(pixel_grid((300, 400))[123]).end, row.end)


def test_fields_are_asked_where_the_numbers_of_a_link_are():
    """The meta device stands for a GPU."""
    asked = []

    def field(pair, x):
        asked.append(x.device.type)
        zero = torch.zeros(x.shape)
        return Segments(zero, zero, zero[..., 0] == 0)

    pair = Pair(View(hw=(8, 8)), View(hw=(8, 8)), link=Link(torch.eye(3), torch.eye(3)).to("meta"))
    FieldOnGrid.from_field(field, pair)
    lazily(field, pair)(pixel_grid((8, 8)).reshape(-1, 2))
    assert set(asked) == {"meta"}


def test_ends_that_are_not_finite_are_not_on_a_grid():
    """Compiled loops would look at pixels that there are not, and crash the process."""

    def field(pair, x):
        end = torch.where(x[..., :1] < 4, x, torch.nan)
        return Segments(end - 1, end, (x[..., 0] < 4) | (x[..., 1] < 2))

    found = FieldOnGrid.from_field(field, Pair(View(hw=(8, 8)), View(hw=(8, 8)))).straight
    assert found.start.isfinite().all()
    assert found.end.isfinite().all()
    assert torch.equal(found.valid[0], pixel_grid((8, 8))[..., 0] < 4)


def test_segments_far_beyond_the_image_are_clipped_to_it():
    """Matching takes as many labels as the longest segment has pixels: 10^9 of them would exhaust
    the memory."""

    def field(pair, x):
        return Segments(x - x.new_tensor([1e9, 0]), x, x[..., 0] < 6)

    on_grid = FieldOnGrid.from_field(field, Pair(View(hw=(8, 8)), View(hw=(9, 16))))
    assert on_grid.samples == 6
    for segments in (on_grid.straight, on_grid.at(torch.zeros(1, 2))):
        assert float(segments.start.min()) == pytest.approx(-0.5, abs=1e-6)
    assert on_grid.straight.valid[0].sum() == on_grid.blocks.valid[0].sum() * 4 == 8 * 6


def test_lenses_and_missing_calibration_are_refused():
    pair = pair_of(known_by_f(random_rig(1)))
    with pytest.raises(ValueError, match=r"HomographyDisplacement.*Rectified"):
        sampling_locations(Epipolar(), pair)
    with pytest.raises(ValueError, match="depth"):
        sampling_locations(Epipolar(), pair_of(random_rig(1).replace(depth=None)))


# -----------------------------------------------------------------------------------------------------
# gradients


def geometry(rig: Rig) -> list[torch.Tensor]:
    """Everything a calibrated pair is made of: K, rotation vector, t of both cameras, near and far."""
    numbers = [
        v for c in (rig["alpha"], rig["beta"]) for v in (c.K, torch.zeros(3, dtype=torch.float64), c.t)
    ]
    return [v.detach().clone().requires_grad_() for v in (*numbers, *rig.depth)]


def ends(field, rig: Rig, x: torch.Tensor, numbers: list[torch.Tensor]) -> torch.Tensor:
    """The field's coordinates as a function of the rig's numbers."""
    a, b = (
        rig[n].replace(K=K, cam_from_world=Pose(rotation_from_vector(w) @ rig[n].R, t))
        for n, (K, w, t) in zip(("alpha", "beta"), (numbers[:3], numbers[3:6]))
    )
    found = field(Pair(a, b, (numbers[6], numbers[7])), x)
    if isinstance(found, Segments):
        return torch.stack([found.start, found.end])[:, found.valid]
    return found.xy[found.mask]


@pytest.mark.parametrize("field", [*STRAIGHT, Local(3)], ids=ids)
def test_gradients_in_every_rig_parameter(field):
    rig = random_rig(3)
    x = torch.tensor([[5.0, 40.0], [30.0, 20.0], [60.0, 3.0]], dtype=torch.float64)
    numbers = geometry(rig)
    assert ends(field, rig, x, numbers).numel() >= 8
    assert torch.autograd.gradcheck(
        lambda *n: ends(field, rig, x, n),
        numbers,
        atol=1e-4,
        rtol=1e-4,
        fast_mode=field == HomographyDisplacement(),
    )


@pytest.mark.parametrize("field", STRAIGHT[:3], ids=ids)
def test_second_derivatives_of_straight_fields(field):
    rig = random_rig(3)
    x = torch.tensor([[30.0, 20.0]], dtype=torch.float64)
    assert torch.autograd.gradgradcheck(
        lambda *n: ends(field, rig, x, n), geometry(rig), atol=1e-3, rtol=1e-3, fast_mode=True
    )


def test_gradients_of_an_uncalibrated_pair():
    pair = pair_of(known_by_f(random_rig(3)))
    x = torch.tensor([[30.0, 20.0], [5.0, 40.0]], dtype=torch.float64)

    def found(F, H):
        s = HomographyDisplacement(6.0)(dataclasses.replace(pair, link=Link(F, H)), x)
        return torch.stack([s.start, s.end])

    inputs = [v.detach().clone().requires_grad_() for v in (pair.link.F / pair.link.F.norm(), pair.link.H)]
    assert torch.autograd.gradcheck(found, inputs, atol=1e-4, rtol=1e-4)


# ----------------------------------------------------------------------------------------------- degenerate
# rigs


INFINITE = float("inf")
DEGENERATE = {
    "identical cameras": two_cameras(),
    "identical cameras to infinity": two_cameras(depth=(1.0, INFINITE)),
    "pure rotation": two_cameras(rotation_from_vector(torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64))),
    "near is far": two_cameras(centre=(0.3, 0.1, 0), depth=(2.0, 2.0)),
    "epipole inside": two_cameras(centre=(0, 0, 0.5)),
    "epipole on a pixel": two_cameras(centre=(0.5 / 32, 0.5 / 32, 1.0)),
    "beta behind": two_cameras(centre=(0, 0, -2.0), depth=(0.5, INFINITE)),
    "opposing": two_cameras(half_rotation(), centre=(0.1, 0, 5.0)),
    "opposing on the axis": two_cameras(half_rotation(), centre=(0, 0, 5.0)),
    "beta beyond the scene": two_cameras(centre=(0, 0, 20.0)),
    "beta among the scene": two_cameras(centre=(0.2, 0, 3.0), depth=(0.5, INFINITE)),
    "looking away": two_cameras(half_rotation()),
    "sideways": two_cameras(
        rotation_from_vector(torch.tensor([0.0, 1.4, 0], dtype=torch.float64)), centre=(1.0, 0, 1)
    ),
    "far is infinite": two_cameras(centre=(0.3, 0.1, 0), depth=(0.5, INFINITE)),
}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("field", ALL, ids=ids)
@pytest.mark.parametrize("case", DEGENERATE)
def test_degenerate_rigs_give_finite_values_and_gradients(case, field, dtype):
    rig = DEGENERATE[case].to(dtype)
    names = ["*.rotation", "*.translation", "*.focal", "*.centre", "depth.near"]
    changes = rig.parameters(free=names)
    found = sampling_locations(
        field, pair_of(rig.perturbed(changes)), pixel_grid((48, 64), dtype=dtype)[::2, 1::2]
    )
    values = [v for v in vars(found).values() if v.dtype.is_floating_point]
    assert all(v.isfinite().all() for v in values)
    total = sum(v.sum() for v in values)
    if total.requires_grad:
        slopes = torch.autograd.grad(total, list(changes.values()), allow_unused=True)
        assert all(s is None or s.isfinite().all() for s in slopes)


# ---------------------------------------------------------------------------------------- float32 against
# float64


@pytest.mark.parametrize(
    ("case", "depth"),
    [("identical cameras to infinity", 1.0), ("pure rotation", 1.0), ("near is far", 2.0)],
)
def test_rays_that_are_a_point_in_beta_sample_it(case, depth):
    rig, x = DEGENERATE[case], pixel_grid((48, 64), dtype=torch.float64)
    s = Epipolar()(pair_of(rig), x)
    seen = rig["beta"].project(rig["alpha"].unproject(x, torch.full((48, 64), depth, dtype=torch.float64)))
    inside = seen.valid & rig["beta"].contains(seen.x)
    assert torch.equal(s.valid, inside)
    torch.testing.assert_close(s.start[inside], seen.x[inside], atol=1e-6, rtol=0)
    assert s.length.max() < 1e-4


def test_gradients_are_finite_where_only_some_rigs_of_a_batch_are_degenerate():
    rig = stack([DEGENERATE["identical cameras"], DEGENERATE["near is far"], DEGENERATE["opposing"]])
    changes = rig.parameters(free=["beta.*"])
    s = sampling_locations(
        Epipolar(), pair_of(rig.perturbed(changes)), pixel_grid((48, 64), dtype=torch.float64)[None, ::8, ::8]
    )
    slopes = torch.autograd.grad(s.start.sum() + s.end.sum(), list(changes.values()), allow_unused=True)
    assert all(v is None or v.isfinite().all() for v in slopes)


def test_what_a_field_gives_is_asked_wherever_it_is_called():
    """Widened, sampling locations, drawings and `fuse` all check a field's result."""
    pair = pair_of(two_cameras())
    x = torch.tensor([[20.0, 20.0], [30.0, 10.0]])

    def ends(pair, x):
        found = Epipolar()(pair, x)
        return found.start, found.end

    def fewer(pair, x):
        found = Epipolar()(pair, x)
        return Segments(found.start[:1], found.end[:1], found.valid[:1])

    def without_mask(pair, x):
        found = Epipolar()(pair, x).positions(8)
        object.__setattr__(found, "mask", None)
        return found

    def without_samples(pair, x):
        found = Epipolar()(pair, x).positions(8)
        return Positions(found.xy[:, :0], found.mask[:, :0])

    def of_kind(**changes):
        def kind(pair, x):
            found = vars(Epipolar()(pair, x))
            return Segments(**{**found, **{name: change(found[name]) for name, change in changes.items()}})

        return kind

    wrong = {
        of_kind(end=lambda end: end.to("meta")): "end float32 .* meta, .* on one device",
        without_samples: "mask bool .*: wanted xy .* L at least 1",
        ends: "the field ends gave a tuple: fields give Segments or Positions",
        fewer: r"the field fewer gave \(1,\) pixels for \(2,\)",
        without_mask: "the field without_mask gave Positions whose mask is a NoneType",
    }
    for field, said in wrong.items():
        for asked in (field, Widened(field, across=1), Moved(field, torch.zeros(2, *pair.alpha.hw))):
            with pytest.raises(ValueError, match=said):
                sampling_locations(asked, pair, x)
