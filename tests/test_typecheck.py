"""The checker that the tests put around every function sees wrong types and sizes."""

from dataclasses import dataclass

import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import Camera, Pose, intrinsics, sample
from pat.media.colour import from_luma_chroma
from pat.networks.blocks import enlarge

from .typecheck import jaxtyped


def refused():
    return pytest.raises(TypeError, match=r"violates|Type-check error")


def test_packages_are_checked_as_they_are_imported():
    image, x = torch.zeros(1, 3, 4, 5), torch.zeros(1, 7, 2)
    assert sample(image, x).values.shape == (1, 3, 7)
    with refused():
        sample(image[0], x)
    with refused():
        sample("image", x)


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
