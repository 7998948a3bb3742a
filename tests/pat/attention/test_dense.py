"""All of beta by torch's own attention."""

import torch

from arraygeom import Dense
from pat.attention import attend


def test_dense_attention_is_that_of_every_position():
    g = torch.Generator().manual_seed(0)
    query, key, value = (
        torch.randn(2, d, *hw, generator=g) for d, hw in ((4, (5, 6)), (4, (7, 8)), (3, (7, 8)))
    )
    bias = torch.randn(2, 5, 6, 16, generator=g)
    for given in (None, bias):
        found, wanted = (
            attend(query, key, value, Dense(2), bias=given, backend=b) for b in ("auto", "reference")
        )
        torch.testing.assert_close(found, wanted, atol=1e-5, rtol=1e-5)
