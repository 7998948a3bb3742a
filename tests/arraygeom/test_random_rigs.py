"""Every field on random rigs, degenerate ones among them, against explicit projection in numpy."""

import pytest
import torch

from tests.arraygeom.random_rigs import KINDS, check, check_variants, drawn


def one_rig(seed: int) -> None:
    lenses = seed // len(KINDS) % 2 == 1
    one, other = drawn(seed, lenses=lenses), drawn(seed + 1, lenses=lenses)
    for dtype in (torch.float64, torch.float32):
        check(one, dtype)
    check_variants(one, other)


@pytest.mark.parametrize("seed", range(2 * len(KINDS)))
def test_every_field_on_every_kind_of_rig(seed):
    one_rig(seed)


@pytest.mark.slow
@pytest.mark.parametrize("block", range(50))
def test_five_thousand_rigs(block):
    for seed in range(100 + 100 * block, 200 + 100 * block):
        one_rig(seed)
