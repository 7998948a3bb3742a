"""Gradients of `Curved` by the compiled loop against those of its formulas."""

import pytest
import torch
from torch import Tensor
from torch.autograd import forward_ad

from arraygeom import Curved, Positions, Rig, pixel_grid
from arraygeom.fields.curved import RayCurve
from tests.arraygeom.random_rigs import KINDS, drawn
from tests.arraygeom.rigs import uniform
from tests.arraygeom.test_field_kernels import BROWN, LENSES, pair_with, readable

NUMBERS = ("first", "last", "K", "coefficients")


@pytest.fixture(autouse=True)
def however_few_pixels(monkeypatch) -> None:
    monkeypatch.setattr("arraygeom.fields.curved.FEW", 0)


CURVES = {
    **{name: (lens, None, 0.3) for name, lens in LENSES.items()},
    "wide": ("wide", None, 0.02),
    "in angle and partly behind": (("brown-conrady", BROWN), True, 100.0),
    "range ends on the image": (("brown-conrady", [-1.2, 0.0, 0.01, -0.02]), None, 0.5),
    "range of angles ends on the image": (("kannala-brandt", [-0.6, 0.0, 0.0, 0.0]), None, 0.5),
}
"""Lens, whether fractions are even in angle if not as the camera says, and by which share of their distance
the ends are moved apart: no end stays on the very edge of the image, where rounding chooses between two
answers, and the image cuts many curves at both."""


def curve_of(name: str, count: int = 1000) -> tuple[RayCurve, list[Tensor]]:
    """Curves of `CURVES`, and their numbers as parameters, in float64."""
    lens, wide, apart = CURVES[name]
    pair = pair_with(lens)
    x = pixel_grid(pair.alpha.hw, dtype=torch.float64)[::37, ::41].reshape(-1, 2)
    curve = RayCurve.from_pixels(pair, *pair.depth, x)
    some = curve.valid.nonzero()[:, 0]
    some = some[:: -(-len(some) // count)]
    first, last, K, c = (t.detach().clone() for t in curve.numbers)
    first, last = (v + apart * (v - w) for v, w in ((first, last), (last, first)))
    K = K + K.new_tensor([[0, 3, 0], [-2, 0, 0], [0, 0, 0]])
    inverse = curve.inverse[0][some], curve.inverse[1][some]
    curve = curve._replace(valid=curve.valid[some], inverse=inverse, wide=wide or curve.wide)
    return curve, [t.requires_grad_() for t in (first[some], last[some], K, c)]


def slopes(answer: Positions, by: list[Tensor]) -> list[Tensor]:
    g = torch.Generator().manual_seed(1)
    upstream = uniform(g, -1, 1, *answer.xy.shape).to(answer.xy.dtype)
    found = torch.autograd.grad(answer.xy, by, upstream, allow_unused=True)
    return [torch.zeros_like(t) if s is None else s for t, s in zip(by, found)]


def difference(found: Tensor, expected: Tensor) -> float:
    """Largest difference, as a share of the gradient by the same pixel."""
    if not expected.numel():
        return 0.0
    size = (
        expected.abs().amax(-1, keepdim=True) if expected.ndim == 2 and len(expected) > 3 else expected.abs()
    )
    return float(((found - expected).abs() / (size + 1e-3 * expected.abs().max()).clamp(min=1e-2)).max())


@pytest.mark.parametrize("nodes", [3, 24])
@pytest.mark.parametrize("name", CURVES)
def test_gradients_by_each_number_of_a_curve_are_those_of_the_formulas(name, nodes):
    curve, numbers = curve_of(name)
    curve = curve.with_numbers(*numbers)
    found, expected = curve.positions(nodes, 40), curve.formulas(nodes, 40)
    assert torch.equal(found.mask, expected.mask)
    assert (found.xy - expected.xy).abs().max() < 1e-9
    assert expected.mask.any(-1).sum() > 100
    for number, mine, theirs in zip(NUMBERS, slopes(found, numbers), slopes(expected, numbers)):
        assert difference(mine, theirs) < 1e-9, number


@pytest.mark.parametrize("name", ["none", "prism", "fisheye", "wide"])
def test_gradients_are_differences(name):
    curve, numbers = curve_of(name, 3)

    def positions(*numbers: Tensor) -> Tensor:
        answer = curve.with_numbers(*numbers).positions(6, 4)
        return answer.xy[answer.mask]

    assert len(positions(*numbers)) > 6
    assert torch.autograd.gradcheck(positions, numbers, atol=1e-5, rtol=1e-5)
    assert torch.autograd.gradgradcheck(positions, numbers, atol=1e-4, rtol=1e-4, fast_mode=True)


def gradients(rig: Rig, x: Tensor, dtype: torch.dtype = torch.float64) -> dict[str, Tensor]:
    """Gradients by each parameter of a rig and by alpha's pixels, through `Curved`."""
    changes = rig.parameters(free=["*"])
    x = x.to(dtype, copy=True).requires_grad_()
    answer = Curved(24, nodes=16)(rig.perturbed(changes).pair("alpha", "beta"), x)
    if not answer.xy.requires_grad:
        return {}
    return dict(zip([*changes, "pixels"], slopes(answer, [*changes.values(), x])))


@pytest.mark.parametrize("seed", range(3 * len(KINDS)))
def test_gradients_by_each_parameter_of_any_rig_are_those_of_the_formulas(seed, monkeypatch):
    one = drawn(seed, lenses=True)
    h, w = one.pair.alpha.hw
    others = uniform(torch.Generator().manual_seed(seed), -0.5, 0.5, 20, 2) + 0.5
    x = torch.cat([torch.from_numpy(one.x), others * others.new_tensor([w - 1, h - 1])])
    found = gradients(one.rig, x)
    readable(monkeypatch)
    expected = gradients(one.rig, x)
    for parameter, slope in expected.items():
        assert difference(found[parameter], slope) < 1e-9, (one.kind, parameter)


@pytest.mark.parametrize("seed", [0, 4, 12, 18])
def test_float32_is_as_good_as_the_formulas(seed, monkeypatch):
    one = drawn(seed, lenses=True)
    x = torch.from_numpy(one.x)
    compiled = gradients(one.rig, x, torch.float32)
    readable(monkeypatch)
    exact, formulas = gradients(one.rig, x), gradients(one.rig, x, torch.float32)
    for parameter, slope in exact.items():
        off, theirs = (difference(found[parameter].double(), slope) for found in (compiled, formulas))
        assert off < 1e-4 + 2 * theirs, (one.kind, parameter)


def test_every_way_to_differentiate_gives_the_same(monkeypatch):
    """Forward mode gave no tangent, in silence: the compiled loop knew nothing of it."""
    pair, x = pair_with("radial"), torch.tensor([[300.0, 200.0], [400.0, 300.0]], dtype=torch.float64)
    by_autograd = torch.autograd.functional

    def positions(x: Tensor) -> Tensor:
        return Curved(5, nodes=8)(pair, x).xy

    def size(x: Tensor) -> Tensor:
        return positions(x).square().sum()

    def all_ways() -> list[Tensor]:
        with forward_ad.dual_level():
            dual = positions(forward_ad.make_dual(x, torch.ones_like(x)))
            tangent = forward_ad.unpack_dual(dual).tangent
        return [
            tangent,
            *(by_autograd.jacobian(positions, x, vectorize=v) for v in (False, True)),
            by_autograd.jacobian(positions, x, vectorize=True, strategy="forward-mode"),
            *(jacobian(positions)(x) for jacobian in (torch.func.jacfwd, torch.func.jacrev)),
            by_autograd.hessian(size, x),
            torch.func.hessian(size)(x),
        ]

    found = all_ways()
    readable(monkeypatch)
    for mine, theirs in zip(found, all_ways(), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-9, atol=1e-9)
