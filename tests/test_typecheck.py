"""The checker that the tests put around every function sees wrong types and sizes."""

import itertools
import random
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import Camera, Pose, intrinsics
from pat.media.colour import from_luma_chroma
from pat.support.blocks import enlarge

from .typecheck import WITH_ARGUMENTS, jaxtyped, of_types


def refused():
    return pytest.raises(TypeError, match=r"violates|Type-check error")


def test_packages_are_checked_as_they_are_imported():
    luma, chroma = torch.zeros(1, 4, 5), torch.zeros(2, 4, 5)
    assert from_luma_chroma(luma, chroma).shape == (3, 4, 5)
    with refused():
        from_luma_chroma(luma[0], chroma)
    with refused():
        from_luma_chroma("image", chroma)


def test_axes_of_one_name_are_equally_long():
    assert from_luma_chroma(torch.zeros(1, 4, 5), torch.zeros(2, 4, 5)).shape == (3, 4, 5)
    with refused():
        from_luma_chroma(torch.zeros(1, 4, 5), torch.zeros(2, 4, 6))


def test_fields_of_dataclasses_are_checked():
    pose = Pose.identity()
    assert Camera(K=intrinsics(5.0, (4, 5)), cam_from_world=pose, hw=(4, 5)).hw == (4, 5)
    with refused():
        Camera(K=intrinsics(5.0, (4, 5)), cam_from_world=pose, hw="4x5")
    with refused():
        Pose(torch.eye(3), torch.zeros(2))


def test_axes_may_be_named_after_arguments():
    assert enlarge(torch.zeros(1, 2, 3, 4), 2).shape == (1, 2, 6, 8)
    with refused():
        enlarge(torch.zeros(1, 2, 3), 2)


def doubled(x: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
    return torch.cat([x, x])


@dataclass
class Holder:
    x: Float[Tensor, "n"]
    y: Float[Tensor, "n"]


def test_results_and_calls_within_calls_have_axes_of_their_own():
    with refused():
        jaxtyped(doubled)(torch.zeros(2))
    inner = jaxtyped(lengths)

    @jaxtyped
    def outer(x):
        return inner(x) + inner(torch.cat([x, x]))

    assert outer(torch.zeros(2)) == 6
    assert jaxtyped(Holder)(torch.zeros(2), torch.zeros(2)).x.shape == (2,)
    with refused():
        Holder(torch.zeros(2), torch.zeros(3))


def lengths(x: Float[Tensor, "n"]) -> int:
    return len(x)


def test_names_only_for_type_checkers_are_not_checked():
    def later(x: "Unknown") -> int:
        return 1

    later.__qualname__ = "later"  # as of a function of a module
    assert jaxtyped(later)("anything") == 1


def test_annotations_stay_as_they_are_written():
    """The compiled kernels distinguish kinds of arguments by what is written there."""

    def f(i: int, x: "Float[Tensor, 'n']") -> None: ...

    f.__qualname__ = "f"
    notes = dict(f.__annotations__)
    jaxtyped(f)
    assert f.__annotations__ == notes


def test_axes_are_compared_as_jaxtyping_compares_them():
    """Types of arrays of every kind, each with a few of many values, in calls of two arguments."""
    words = (
        "n",
        "n m",
        "n 3",
        "*b n",
        "*b 3 n",
        "*b n n",
        "...",
        "... n",
        "_ n",
        "*b",
        "2 *b n",
        "",
        "n *_ m",
        "n _",
    )
    shapes = [shape for k in range(4) for shape in itertools.product((2, 3), repeat=k)]
    values = [torch.zeros(shape) for shape in shapes] + [
        torch.zeros(2, 3, dtype=torch.int64),
        np.zeros((2, 3)),
        1.0,
    ]
    pairs, rng = list(itertools.product(values, repeat=2)), random.Random(0)
    seen = set()
    for one, other in itertools.product(words, repeat=2):

        def f(x, y): ...

        f.__annotations__ = {"x": Float[Tensor, one], "y": Float[Tensor, other]}
        f.__qualname__ = "f"
        ours, theirs = jaxtyped(f), WITH_ARGUMENTS(f, typechecker=of_types)
        for x, y in rng.sample(pairs, 8):
            verdicts = [accepts(function, x, y) for function in (ours, theirs)]
            assert verdicts[0] == verdicts[1], (one, other, x, y)
            seen.add(verdicts[0])
    assert seen == {True, False}


def accepts(function, *given):
    try:
        function(*given)
    except TypeError:
        return False
    return True
