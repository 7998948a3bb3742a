"""Gradients through a whole fusion: to the rig, the images and the weights."""

import math
from functools import partial

import pytest
import torch

from arraygeom import Rig
from pat import FuseSettings, fuse, load_weights
from tests.pat.fusion.recovering import recovered, rotated, rotation_left
from tests.pat.layered_array import middle_of_sample


@pytest.fixture(scope="module")
def cropped():
    """The middle of the sample array; its rig, images and ground truth."""
    sample = middle_of_sample()
    return sample.rig, sample.images, sample.ground_truth


def error_of(cropped, angle: torch.Tensor) -> torch.Tensor:
    """Return the error of the image fused with the colour camera rotated, against the ground truth."""
    rig, images, ground_truth = cropped
    network, turned = load_weights("mono-colour"), rotated(rig, angle)
    frame = fuse(
        images, turned, alpha="mono", network=network, settings=FuseSettings(align=False), differentiable=True
    )
    return (frame.image - ground_truth).square().mean()


@pytest.mark.parametrize("degrees", [-0.3, 0.3])
def test_the_fused_image_says_which_way_a_camera_is_rotated(cropped, degrees):
    """Its error's derivative leads back, as far as the next test goes with it."""
    angle = torch.tensor(math.radians(degrees), dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(error_of(cropped, angle), angle)
    assert slope.item() * degrees > 0


@pytest.mark.slow
def test_a_rotation_is_recovered_through_the_fused_image(cropped):
    assert abs(rotation_left(partial(error_of, cropped))) < 0.02


@pytest.mark.parametrize(("which", "steps"), [(("rz", "ty", "focal"), 3), (("ry",), 2)])
def test_a_rig_is_recovered_from_images_alone(cropped, which, steps):
    """The point that alpha sees is in the colour image at the position of its depth, in the true rig."""
    rig, images, _ = cropped
    left = recovered(load_weights("mono-colour"), rig, images, which, steps=steps)[-1]
    assert left.abs().max() < 0.1


@pytest.mark.parametrize("betas", [1, 2])
@pytest.mark.parametrize(("kind", "axis", "step"), [("rotation", 1, 0.0017), ("translation", 0, 0.002)])
def test_depths_follow_a_camera_that_moves_along_the_segments(cropped, kind, axis, step, betas):
    """Matches stay where they are in its image, depths change. A constant position along the segment would
    move the match instead. Of two betas, here one twice, only the first moves."""
    rig, images, _ = cropped
    rig = Rig({"mono": rig["mono"]} | {f"colour{i}": rig["colour"] for i in range(betas)}, depth=rig.depth)
    images = {name: images[name.rstrip("01")] for name in rig.names}
    network, way = load_weights("mono-colour"), torch.eye(3, dtype=torch.float64)[axis]

    def fused(far: torch.Tensor, **options):
        changed = rig.perturbed({f"colour0.{kind}": far * way})
        return fuse(
            images, changed, alpha="mono", network=network, settings=FuseSettings(align=False), **options
        )

    before, after = (fused(torch.tensor(s, dtype=torch.float64)) for s in (-step, step))
    far = torch.zeros((), dtype=torch.float64, requires_grad=True)
    frame = fused(far, differentiable=True)
    change = (1 / after.depth - 1 / before.depth) / (2 * step)
    likely = (torch.stack([f.confidence.detach() for f in (frame, before, after)]) > 0.7).all(0)
    (slope,) = torch.autograd.grad((1 / frame.depth)[likely].mean(), far)
    assert slope.item() == pytest.approx(change[likely].mean().item(), rel=0.15)


@pytest.mark.parametrize("luminance", ["alpha", "mix"])
def test_gradients_reach_rig_images_and_weights(cropped, luminance, recwarn):
    """Torch warns once a process of numbers taken out of tensors with gradients, here always."""
    rig, images, _ = cropped
    network = load_weights("mono-colour").requires_grad_(True)
    angle = torch.zeros((), dtype=torch.float64, requires_grad=True)
    images = {name: image.clone().requires_grad_() for name, image in images.items()}
    settings = FuseSettings(align=False, luminance=luminance)
    torch.set_warn_always(True)
    frame = fuse(
        images, rotated(rig, angle), alpha="mono", network=network, settings=settings, differentiable=True
    )
    torch.set_warn_always(False)
    frame.image.square().mean().backward()
    assert not recwarn.list
    for tensor in (angle, *images.values(), *network.parameters()):
        assert tensor.grad is not None
        assert tensor.grad.isfinite().all()
    assert all(float(t.grad.abs().max()) > 0 for t in (angle, *images.values()))


def test_without_differentiable_everything_is_detached(cropped):
    rig, images, _ = cropped
    angle = torch.zeros((), dtype=torch.float64, requires_grad=True)
    images = images | {"colour": images["colour"].clone().requires_grad_()}
    frame = fuse(images, rotated(rig, angle), alpha="mono", network=load_weights("mono-colour"))
    assert [part.requires_grad for part in frame[:3]] == [False, False, False]


def test_a_differentiable_fusion_is_of_the_whole_frame(cropped, tmp_path):
    rig, images, _ = cropped
    network = load_weights("mono-colour")
    for more, message in (
        ({"settings": FuseSettings(max_memory="2GiB")}, "max_memory.*store"),
        ({"store": tmp_path}, "max_memory.*store"),
        ({"settings": FuseSettings(noise="estimate")}, "noise"),
    ):
        with pytest.raises(ValueError, match=message):
            fuse(images, rig, alpha="mono", network=network, differentiable=True, **more)


def test_a_transformation_of_torch_func_is_refused(cropped):
    rig, images, _ = cropped
    network = load_weights("mono-colour")

    def depth(angle: torch.Tensor) -> torch.Tensor:
        turned = rotated(rig, angle)
        return fuse(
            images,
            turned,
            alpha="mono",
            network=network,
            settings=FuseSettings(align=False),
            differentiable=True,
        ).depth[96, 128]

    with pytest.raises(NotImplementedError, match=r"torch\.autograd"):
        torch.func.grad(depth)(torch.zeros((), dtype=torch.float64))
