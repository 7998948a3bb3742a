"""Fields of explicit positions, fused: those along a curve as well as segments."""

import warnings

import numpy as np
import pytest
import torch

from arraygeom import Dense, Epipolar, Local, NearestVoxels, Positions, Segments
from arraygeom.fields.grid import FieldOnGrid
from pat import FuseSettings, fuse, load_weights
from pat.matching import cost
from pat.matching import kernels as kernels
from pat.matching.cost import planes_of
from pat.matching.semi_global import along_tangents
from pat.support.metrics import score
from tests.pat.layered_array import ALPHA, middle_of_sample


def along_the_segment(pair, x):
    """A field of one's own: the calibrated segment as explicit positions."""
    return Epipolar()(pair, x).positions(64)


def arc(pair, x):
    """Positions on a parabola through (x - 12, y), which cameras have for each other through a lens."""
    step = torch.linspace(-8, 8, 33, dtype=x.dtype)
    offset = torch.stack([step - 12, 0.05 * step.square()], -1)
    return Positions(x[..., None, :] + offset, torch.ones(*x.shape[:-1], 33, dtype=torch.bool))


def test_tangents_touch_their_curve_at_the_match():
    """Beta is alpha moved by 14 pixels: along the arc that is the label 12, which is 0.2 pixels down."""
    g = torch.Generator().manual_seed(0)
    alpha = torch.nn.functional.avg_pool2d(torch.rand(1, 1, 68, 132, generator=g), 5, 1)
    alpha = (alpha - alpha.min()) / (alpha.max() - alpha.min())
    beta = alpha.roll(-14, -1)
    field = FieldOnGrid(lambda x: arc(None, x[None]), 33, None)
    found = along_tangents(alpha, beta, field)
    assert isinstance(found.pixels, Segments)
    h, w = alpha.shape[-2:]
    y, x = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
    s = Segments(*(t[0, 8:-8, 24:-8] for t in vars(found.pixels).values()))
    match = torch.stack([x - 14.0, y + 0.2], -1)[8:-8, 24:-8].double()
    foot = s.at(s.fraction(match))
    near = (foot - match).norm(dim=-1)
    assert float(near.quantile(0.9)) < 0.25
    slope = (s.start - s.end)[..., 1] / (s.start - s.end)[..., 0]
    assert float((slope - 2 * 0.05 * -2).abs().quantile(0.9)) < 0.06


@pytest.mark.parametrize(
    "field", [NearestVoxels(), Local(9), Dense(stride=24)], ids=lambda f: type(f).__name__
)
def test_sets_are_fused_and_said_to_have_no_order(field):
    s = middle_of_sample()
    with pytest.warns(UserWarning, match="order"):
        frame = fuse(
            s.images,
            s.rig,
            alpha=ALPHA,
            network=load_weights("mono-colour"),
            settings=FuseSettings(field=field, response="rec601"),
        )
    assert bool(frame.image.isfinite().all())


def test_a_curve_of_ones_own_is_fused_as_well_as_the_segment():
    s, network = middle_of_sample(), load_weights("mono-colour")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        frames = [
            fuse(s.images, s.rig, alpha=ALPHA, network=network, settings=FuseSettings(field=f))
            for f in (None, along_the_segment)
        ]
    straight, own = (score(f.image.clamp(0, 1), s.ground_truth).psnr for f in frames)
    assert own > straight - 0.4


def test_costs_of_positions_are_those_of_labels():
    rng = np.random.default_rng(0)
    own, other = rng.random((2, 6, 9)).astype(np.float32)
    (a, a_bits), (b, b_bits) = planes_of(own), planes_of(other)
    places = rng.integers(-1, b.size, (6, 9, 5)).astype(np.int32)
    found = np.empty((6, 9, 1, 16), np.uint8)
    kernels.costs_at((a.ravel(), a_bits.ravel()), (b.ravel(), b_bits.ravel()), places, found)
    assert (found[..., 5:] == kernels.NO_LABEL).all()
    for y, x, label in np.ndindex(places.shape):
        at = divmod(int(places[y, x, label]), 9)
        bright = int(min(abs(a[y, x] - b[at]) * cost.BRIGHTNESS, cost.TRUNCATED))
        expected = bin(int(a_bits[y, x] ^ b_bits[at])).count("1") + bright
        assert found[y, x, 0, label] == (expected if places[y, x, label] >= 0 else cost.NOWHERE)
