"""A calibration's uncertainty in pixels, bands and points, beside random draws of it."""

from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from arraygeom import Epipolar, Pose, Positions, Rig, Widened, triangulate
from arraygeom.uncertainty import bands, position_covariance, triangulation_covariance
from tests.arraygeom.rigs import BARREL, random_rig, uniform, with_lenses

DRAWS = 400


class Stated(NamedTuple):
    names: tuple[str, ...]
    matrix: Tensor


def stated(rig: Rig) -> Stated:
    """A covariance of both cameras' numbers, correlated."""
    sizes = {"rotation": 1e-3, "translation": 1e-3, "focal": 0.3, "centre": 0.3, "distortion": 1e-3}
    zeros = rig.parameters(free=["*.*"])
    zeros = {k: z for k, z in zeros.items() if not k.startswith("depth")}
    names = tuple(f"{k}.{i}" for k, z in zeros.items() for i in range(z.numel()))
    scale = torch.tensor([sizes[n.split(".")[1]] for n in names], dtype=torch.float64)
    mix = torch.randn(len(names), len(names), dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    matrix = torch.eye(len(names), dtype=torch.float64) + 0.3 * mix @ mix.T / len(names)
    return Stated(names, scale[:, None] * matrix * scale)


def draws(rig: Rig, covariance: Stated) -> list[Rig]:
    g = torch.Generator().manual_seed(5)
    root = torch.linalg.cholesky(covariance.matrix)
    found = []
    for change in torch.randn(DRAWS, len(covariance.names), dtype=torch.float64, generator=g) @ root.T:
        changes = {k: torch.zeros_like(z).detach() for k, z in rig.parameters(free=["*.*"]).items()}
        for name, value in zip(covariance.names, change):
            kind, _, index = name.rpartition(".")
            changes[kind].view(-1)[int(index)] = value
        found.append(rig.perturbed({k: c for k, c in changes.items() if not k.startswith("depth")}))
    return found


@pytest.fixture(params=[False, True], ids=["pinholes", "lenses"])
def rig(request) -> Rig:
    return with_lenses(random_rig(1), BARREL, BARREL) if request.param else random_rig(1)


def test_positions_scatter_as_stated(rig):
    covariance, x = stated(rig), uniform(torch.Generator().manual_seed(1), 15, 30, 6, 2)
    found = position_covariance(rig, covariance, "alpha", "beta", x, 3.0)
    drawn = torch.stack(
        [r["beta"].project(r["alpha"].unproject(x, x.new_full((6,), 3.0))).x for r in draws(rig, covariance)]
    )
    scatter = torch.stack([torch.cov(drawn[:, i].T) for i in range(len(x))])
    seen = found.isfinite().all((-1, -2))
    assert seen.sum() > 2
    ratio = scatter.diagonal(dim1=1, dim2=2)[seen] / found.diagonal(dim1=1, dim2=2)[seen]
    assert (ratio.sqrt() - 1).abs().max() < 0.15


def test_points_scatter_as_stated(rig):
    """The covariance is small: deviations hold to first order."""
    covariance = stated(rig)._replace(matrix=0.03 * stated(rig).matrix)
    X = torch.tensor([[0.1, 0.0, 3.0], [-0.2, 0.1, 4.0]], dtype=torch.float64)
    x = torch.stack([camera.project(X).x for camera in rig.cameras.values()])
    found = triangulation_covariance(rig, covariance, x)
    drawn = torch.stack(
        [triangulate(list(r.cameras.values()), x, residual=50).X for r in draws(rig, covariance)]
    )
    for i in range(2):
        ratio = torch.cov(drawn[:, i].T).diagonal() / found[i].diagonal()
        assert (ratio.sqrt() - 1).abs().max() < 0.2


def test_bands_hold_the_share_that_they_state():
    """Points between the bounds, across the segment; the field's samples are within a row of them."""
    rig = random_rig(1)
    covariance = stated(rig)
    x = uniform(torch.Generator().manual_seed(1), 12, 36, 8, 2)
    z = uniform(torch.Generator().manual_seed(2), 1.6, 9, 8)
    segments = Epipolar()(rig.pair("alpha", "beta"), x)
    band = bands(rig, covariance, "alpha", "beta", x, 0.9)
    field = Widened.from_covariance(rig, covariance, "alpha", "beta", confidence=0.9)
    locations = field(rig.pair("alpha", "beta"), x)
    assert isinstance(locations, Positions)
    step = torch.nn.functional.normalize(segments.end - segments.start, dim=-1)
    held, sampled = [], []
    for r in draws(rig, covariance):
        y = r["beta"].project(r["alpha"].unproject(x, z)).x
        off = y - segments.start
        across = (off[:, 0] * step[:, 1] - off[:, 1] * step[:, 0]).abs()
        share = segments.fraction(y).clamp(0, 1)
        width = band.across[:, 0] * (1 - share) + band.across[:, 1] * share
        held.append((across <= width)[segments.valid])
        near = torch.where(locations.mask, (locations.xy - y[:, None]).norm(dim=-1), torch.inf).amin(-1)
        sampled.append((near < 0.6)[segments.valid & (across <= width) & rig["beta"].contains(y)])
    assert float(torch.cat(held).double().mean()) == pytest.approx(0.9, abs=0.03)
    assert torch.cat(sampled).double().mean() > 0.99


def test_a_band_follows_its_images():
    """Beta at twice the size has bands of twice the width."""
    rig = random_rig(1)
    field = Widened.from_covariance(rig, stated(rig), "alpha", "beta")
    larger = rig.resize("beta", tuple(2 * n for n in rig["beta"].hw))
    x = torch.tensor([[30.0, 20.0]], dtype=torch.float64)
    assert field.margins is not None
    one, two = (field.margins.at(r.pair("alpha", "beta"), x) for r in (rig, larger))
    torch.testing.assert_close(two, 2 * one)


def test_covariances_of_another_rig_are_refused():
    rig = random_rig(1)
    with pytest.raises(ValueError, match="gamma"):
        bands(rig, Stated(("gamma.rotation.0",), torch.eye(1)), "alpha", "beta", torch.zeros(1, 2))
    with pytest.raises(ValueError, match=r"beta\.rotation"):
        bands(rig, Stated(("beta.rotation.3",), torch.eye(1)), "alpha", "beta", torch.zeros(1, 2))
    with pytest.raises(ValueError, match="depth"):
        bands(rig.replace(depth=None), stated(rig), "alpha", "beta", torch.zeros(1, 2))
    with pytest.raises(ValueError, match="confidence"):
        bands(rig, stated(rig), "alpha", "beta", torch.zeros(1, 2), 1.0)


def test_a_band_without_one_of_its_ends_has_both_widths_at_the_other():
    """Beta, 3 m ahead of alpha, does not see the near bound: there is no segment, nor a direction of it."""
    rig = random_rig(1)
    pose = Pose.from_centre(torch.eye(3).double(), torch.tensor([0.5, 0, 3], dtype=torch.float64))
    rig = rig.replace(
        depth=(0.5, 8.0), cameras={**rig.cameras, "beta": rig["beta"].replace(cam_from_world=pose)}
    )
    x, covariance = torch.tensor([[30.0, 20.0]], dtype=torch.float64), stated(rig)
    band = bands(rig, covariance, "alpha", "beta", x)
    assert band.across[0].isnan().tolist() == band.along[0].isnan().tolist() == [True, False]
    of_both = position_covariance(rig, covariance, "alpha", "beta", x, 8.0)[0].trace().sqrt()
    torch.testing.assert_close(band.across[0, 1], band.along[0, 1])
    torch.testing.assert_close(band.along[0, 1], 1.959964 * of_both)
