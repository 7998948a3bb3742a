"""The compiled loops of the explicit fields against their readable forms."""

import sys

import pytest
import torch

from arraygeom import Curved, Distortion, NearestVoxels, Pair, pixel_grid
from arraygeom.runtime.compiled import can_compile
from tests.arraygeom.rigs import pairs, random_rig
from tests.arraygeom.test_curved import fisheye_rig

BROWN = [-0.2, 0.05, 0.001, -0.0005, 0.01, 0.02, 0.01, 0.003, 0.001, 0.002, -0.001, 0.0005]
LENSES = {
    "none": None,
    "radial": ("brown-conrady", [-0.4, 0.1, 0.0, 0.0]),
    "rational": ("brown-conrady", BROWN[:8]),
    "prism": ("brown-conrady", BROWN),
    "fisheye": ("kannala-brandt", [0.05, -0.01, 0.002, 0.0]),
}


def readable(monkeypatch) -> None:
    for module in ("curved", "explicit"):
        monkeypatch.setattr(f"arraygeom.fields.{module}.compilable", lambda t: False)


def pair_with(lens: str | tuple[str, list[float]] | None) -> Pair:
    """One whose beta sees part of what alpha sees through a lens, or two strong fisheyes."""
    if lens == "wide":
        return fisheye_rig().pair("alpha", "beta")
    given = LENSES[lens] if isinstance(lens, str) else lens
    return pairs(given and Distortion(given[0], torch.tensor(given[1], dtype=torch.float64)))[2]


@pytest.mark.parametrize("name", [*LENSES, "wide"])
def test_curved_positions_are_those_of_the_formulas(name, monkeypatch):
    pair = pair_with(name)
    x = pixel_grid(pair.alpha.hw, dtype=torch.float64)[::43, ::47].reshape(-1, 2)
    compiled = Curved(40, nodes=24)(pair, x)
    readable(monkeypatch)
    expected = Curved(40, nodes=24)(pair, x)
    assert torch.equal(compiled.mask, expected.mask)
    assert 0.5 < compiled.mask.float().mean() < 1
    assert (compiled.xy - expected.xy).abs().max() < 1e-9


def test_few_pixels_wait_for_no_compiler(monkeypatch):
    """The explorer asks for one, and waited half a minute for the first through a lens."""
    pair = pair_with("radial")
    monkeypatch.setattr("arraygeom.fields.curved.RayCurve.positions", None)
    assert Curved(40)(pair, torch.tensor([[300.0, 200.0]])).xy.shape == (1, 40, 2)


@pytest.mark.parametrize("field", [Curved(40, nodes=24), NearestVoxels(24, 12)], ids=repr)
def test_without_numba_the_formulas_are_used(field, monkeypatch):
    pair = pair_with("none")
    x = pixel_grid(pair.alpha.hw, dtype=torch.float64)[::43, ::47].reshape(-1, 2)
    expected = field(pair, x)
    monkeypatch.setitem(sys.modules, "numba", None)
    monkeypatch.delitem(sys.modules, "arraygeom.fields.kernels", raising=False)
    monkeypatch.delitem(sys.modules, "arraygeom.fields.curve_kernels", raising=False)
    can_compile.cache_clear()
    try:
        found = field(pair, x)
    finally:
        can_compile.cache_clear()
    assert torch.equal(found.mask, expected.mask)
    assert (found.xy - expected.xy).abs().max() < 1e-9


@pytest.mark.parametrize(
    "field", [NearestVoxels(24, 12), NearestVoxels(96, 80), NearestVoxels(200, 5)], ids=repr
)
@pytest.mark.parametrize("seed", range(3))
def test_nearest_pixels_are_those_of_the_readable_form(field, seed, monkeypatch):
    pair = random_rig(seed, turn=0.4).pair("alpha", "beta")
    x = pixel_grid(pair.alpha.hw, dtype=torch.float64)[::9, ::11].reshape(-1, 2)
    compiled = field(pair, x)
    readable(monkeypatch)
    expected = field(pair, x)
    assert torch.equal(compiled.mask, expected.mask)
    assert torch.equal(compiled.xy, expected.xy)


@pytest.mark.parametrize("far", [1e12, 1e20, 1e30])
def test_pixels_whose_window_is_far_off_beta_have_none(far):
    """The compiled loop read memory beside its own where their coordinates are no integers."""
    x = torch.tensor([[far, 1.0], [1.0, far], [-far, far]])
    assert not NearestVoxels(24, 12)(pair_with("none"), x).mask.any()
