"""Derivatives of residuals, part by part."""

import torch

from calib.images.least_squares import jacobian


def parts(z):
    return [
        z[0] * torch.arange(3.0).double() + z[1] ** 2,
        torch.sin(z[2:3] * torch.arange(1, 5).double()) * z[0],
    ]


def test_derivatives_part_by_part_are_those_of_the_whole():
    z = torch.tensor([0.3, -1.2, 0.7, 5.0], dtype=torch.float64)
    values, found = jacobian(parts, z)
    torch.testing.assert_close(values, torch.cat(parts(z)))
    expected = torch.autograd.functional.jacobian(lambda z: torch.cat(parts(z)), z)
    torch.testing.assert_close(found, expected)
