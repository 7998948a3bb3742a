"""Lenses fitted anew, without a pole."""

import pytest
import torch

from arraygeom import Distortion, Rig, stack
from arraygeom.lens_coverage import coverage
from pat.app.lens_refit import refit_lens, refit_rig
from tests.arraygeom.test_io_owners import POLE, pole


def test_a_lens_fitted_anew_has_no_pole():
    """In the middle it is the same, beyond the pole it is what the formula is again there."""
    fitted, largest, usual = refit_lens(pole())
    assert coverage(fitted).share == 1
    assert usual < largest < 15
    X = torch.tensor([[0.1, 0.05, 1.0], [0.3, -0.2, 1.0]], dtype=torch.float64)
    assert float((fitted.project(X).x - pole().project(X).x).norm(dim=-1).max()) < 3
    beyond = torch.tensor([0.75 * 0.97, 0.45 * 0.97, 1.0], dtype=torch.float64)
    u = float(beyond[:2].square().sum())
    k1, k2, _, _, k3, k4, k5, k6 = POLE
    factor = (1 + u * (k1 + u * (k2 + u * k3))) / (1 + u * (k4 + u * (k5 + u * k6)))
    wanted = beyond[:2] * factor * 808 + torch.tensor([640, 400])
    assert not bool(pole().project(beyond).valid)
    assert float((fitted.project(beyond).x - wanted).norm()) < 5


def test_a_fisheye_is_not_fitted_anew():
    lens = Distortion("kannala-brandt", torch.zeros(4, dtype=torch.float64))
    with pytest.raises(ValueError, match="brown-conrady"):
        refit_lens(pole().replace(distortion=lens))


def test_batches_are_not_fitted_anew():
    for camera in (stack([pole()]), pole().replace(K=pole().K.expand(4, 3, 3))):
        with pytest.raises(ValueError, match="a batch"):
            refit_lens(camera)
        with pytest.raises(ValueError, match="a batch"):
            refit_rig(Rig({"a": camera}))
