"""Kornia's batches, stereo cameras, named poses and augmentations: rigs are theirs, pixels follow images."""

import dataclasses

import kornia.augmentation as K
import pytest
import torch
from kornia.geometry.camera import PinholeCamera, StereoCamera
from kornia.geometry.liegroup import Se2
from kornia.geometry.linalg import transform_points
from kornia.geometry.pose import NamedPose

from arraygeom import (
    Curved,
    Distortion,
    Epipolar,
    Link,
    Pair,
    Pose,
    Rig,
    rectify,
    sample,
    sampling_locations,
    stack,
)
from arraygeom.kornia_models import to_pinhole_batch
from arraygeom.rectification import to_stereo_camera
from tests.arraygeom.rigs import random_rig, scene_points

F64 = torch.float64
RIG = random_rig(3)
ALPHA, BETA = RIG["alpha"], RIG["beta"]
X = scene_points(RIG)
LENS = Distortion("brown-conrady", torch.tensor([-0.1, 0.02, 0, 0], dtype=F64))


def six() -> PinholeCamera:
    """A batch of six pinholes that differ in everything, the sizes of their images too."""
    rig = {f"c{i}": (ALPHA, BETA)[i % 2].resize((40 + i, 60 + i)) for i in range(6)}
    moved = Rig(rig).perturbed({f"c{i}.translation": torch.full((3,), 0.01 * i, dtype=F64) for i in range(6)})
    return to_pinhole_batch(moved.to_kornia())


def test_a_batch_of_six_is_a_rig_and_comes_back():
    theirs = six()
    theirs.intrinsics.requires_grad_()
    rig = Rig.from_kornia(theirs, depth=RIG.depth)
    assert rig.names == tuple(f"camera{i}" for i in range(6))
    assert [camera.hw for camera in rig.cameras.values()] == [(40 + i, 60 + i) for i in range(6)]
    found = torch.stack([camera.project(X).x for camera in rig.cameras.values()])
    torch.testing.assert_close(found, theirs.project(X.expand(6, -1, -1)))
    found.sum().backward()
    assert bool((theirs.intrinsics.grad[:, 0, 2] == len(X)).all())
    back = to_pinhole_batch(rig.to_kornia())
    for name in ("intrinsics", "extrinsics", "height", "width"):
        torch.testing.assert_close(getattr(back, name), getattr(theirs, name), check_dtype=False)


@pytest.mark.parametrize("field", ["K", "cam_from_world"])
def test_a_batch_of_one_field_alone_is_a_batch(field):
    batch = ALPHA.replace(**{field: getattr(stack([ALPHA, ALPHA]), field)})
    back = batch.to_kornia()
    torch.testing.assert_close(back.project(X.expand(2, -1, -1)), ALPHA.project(X).x.expand(2, -1, -1))


def stereo(baselines: list[float]) -> StereoCamera:
    K = torch.tensor([[500.0, 0, 31.0], [0, 510, 24.0], [0, 0, 1]], dtype=F64).expand(len(baselines), 3, 3)
    moved = torch.tensor([[-b, 0, 0] for b in baselines], dtype=F64)[..., None]
    return StereoCamera(torch.cat([K, 0 * moved], -1), torch.cat([K, K @ moved], -1))


@pytest.mark.parametrize("baselines", [[0.1], [0.1, 0.25]])
def test_a_stereo_camera_is_a_rig_and_comes_back(baselines):
    theirs = stereo(baselines)
    rig = Rig.from_kornia(theirs, hw=(48, 64), depth=(1, 9), batched=len(baselines) > 1)
    assert rig.batch_shape == (() if len(baselines) == 1 else (2,))
    assert rig.names == ("left", "right")
    disparity = 5 + 20 * torch.rand(len(baselines), 48, 64, 1, dtype=F64)
    points = theirs.reproject_disparity_to_3D(disparity).flatten(1, 2)
    left, right = (rig[name].project(points if rig.batch_shape else points[0]).x for name in rig.names)
    torch.testing.assert_close((left - right)[..., 0].reshape(disparity[..., 0].shape), disparity[..., 0])
    torch.testing.assert_close((left - right)[..., 1], torch.zeros_like(left[..., 1]), rtol=0, atol=1e-9)
    torch.testing.assert_close(left.reshape(-1, 48, 64, 2)[0, 3, 7], torch.tensor([7.0, 3.0], dtype=F64))
    back = to_stereo_camera(rig.pair("left", "right"))
    torch.testing.assert_close(back.rectified_right_camera, theirs.rectified_right_camera)
    torch.testing.assert_close(back.Q, theirs.Q)


def test_a_rectified_pair_is_a_stereo_camera_and_others_are_refused():
    pair = RIG.pair("alpha", "beta")
    right = pair if float(pair.beta_from_alpha.t[0]) < 0 else RIG.pair("beta", "alpha")
    rectified = rectify(right).pair
    theirs = to_stereo_camera(rectified)
    torch.testing.assert_close(theirs.tx, (ALPHA.centre - BETA.centre).norm()[None])
    twice = (one.replace(cam_from_world=stack([one.cam_from_world] * 2)) for one in rectified.cameras)
    both = to_stereo_camera(Pair(*twice, rectified.depth))
    torch.testing.assert_close(both.Q, theirs.Q.expand(2, 4, 4))
    for wrong in (right, dataclasses.replace(rectified, alpha=rectified.beta, beta=rectified.alpha)):
        with pytest.raises(ValueError, match="rectif"):
            to_stereo_camera(wrong)
    with pytest.raises(ValueError, match="hw"):
        Rig.from_kornia(stereo([0.1]))


def test_named_poses_there_and_back():
    theirs = NamedPose(ALPHA.cam_from_world.to_kornia(), "world", "alpha")
    ours = Pose.from_kornia(theirs)
    torch.testing.assert_close(ours.apply(X[0]), theirs.transform_points(X[0]))
    from_beta = theirs * NamedPose(BETA.cam_from_world.to_kornia(), "world", "beta").inverse()
    torch.testing.assert_close(
        Pose.from_kornia(from_beta).inverse().t, RIG.pair("alpha", "beta").beta_from_alpha.t
    )
    with pytest.raises(ValueError, match="matrix"):
        Pose.from_kornia(NamedPose(Se2.identity(), "a", "b"))


AUGMENTATIONS = {
    "crop": K.RandomCrop((24, 32), p=1.0),
    "crop and resize": K.RandomResizedCrop((30, 40), scale=(0.5, 0.9), p=1.0),
    "resize": K.Resize((96, 100)),
    "mirror": K.RandomHorizontalFlip(p=0.5),
    "upside down": K.RandomVerticalFlip(p=1.0),
    "rotate": K.RandomRotation(20.0, p=1.0),
    "quarter turn": K.RandomRotation90((1, 1), p=1.0),
    "affine": K.RandomAffine(10.0, (0.1, 0.1), (0.8, 1.2), 5.0, p=1.0),
}


def augmented(names, images):
    """Images that went through augmentations, and their container."""
    torch.manual_seed(1)
    container = K.AugmentationSequential(*(AUGMENTATIONS[name] for name in names), data_keys=["input"])
    return container(images), container


@pytest.mark.parametrize("names", [*([name] for name in AUGMENTATIONS), ["affine", "mirror", "crop"]])
@pytest.mark.parametrize(
    "lens", [None, Distortion("brown-conrady", torch.tensor([-0.1, 0.02, 0, 0]).double())]
)
def test_a_camera_follows_its_augmented_image(names, lens):
    """Pixels of its points are kornia's, images are alike there, and fields of either rig hold them."""
    h, w = ALPHA.hw
    rows, columns = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
    images = torch.stack([columns, rows, columns - 2 * rows]).to(F64).expand(2, 3, h, w) / w
    out, container = augmented(names, images)
    before = stack([RIG.with_camera("alpha", ALPHA.replace(distortion=lens))] * 2)
    rig = before.transformed("alpha", container.transform_matrix, out.shape[-2:])
    points = X.expand(2, *X.shape)
    x, moved = before["alpha"].project(points).x, rig["alpha"].project(points).x
    torch.testing.assert_close(
        moved, transform_points(container.transform_matrix.to(F64), x), rtol=0, atol=1e-6
    )
    inside = (x > 2).all(-1) & (x < x.new_tensor([w - 3, h - 3])).all(-1) & rig["alpha"][0].contains(moved)
    inside &= (moved > 1).all(-1) & (moved < moved.new_tensor([out.shape[-1] - 2, out.shape[-2] - 2])).all(-1)
    assert int(inside.sum()) > 5
    theirs, ours = (sample(i, p.to(i)).values.movedim(1, -1)[inside] for i, p in ((out, moved), (images, x)))
    torch.testing.assert_close(theirs, ours, rtol=0, atol=1e-4)
    seen = rig["beta"].project(points).x
    field = Epipolar() if lens is None else Curved(64)
    for alpha, beta, at, there in (("alpha", "beta", moved, seen), ("beta", "alpha", seen, moved)):
        depth = rig[alpha].project(points).depth
        hold = rig[alpha][0].contains(at) & rig[beta][0].contains(there)
        hold &= (depth > rig.depth[0][0]) & (depth < rig.depth[1][0])
        samples = sampling_locations(field, rig.pair(alpha, beta), at)
        samples = samples.positions(256) if lens is None else samples
        nearest = torch.where(samples.mask, (samples.xy - there[..., None, :]).norm(dim=-1), torch.inf).amin(
            -1
        )
        assert float(nearest[hold].max()) < 1.0


def test_links_follow_each_image_of_a_batch():
    """A mirrored image in a batch of two: matches stay on their lines."""
    alpha, beta = (camera.project(X).x for camera in (ALPHA, BETA))
    link = Link(RIG.pair("alpha", "beta").fundamental)
    A = torch.tensor([[-1.0, 0, 63], [0, 1, 0], [0, 0, 1]]).double()
    A = torch.stack([A, torch.eye(3).double()])
    rig = stack([Rig({"alpha": ALPHA, "beta": BETA}, links={("alpha", "beta"): link})] * 2)
    F = rig.transformed("alpha", A, (48, 64)).transformed("beta", A, (48, 64)).links["alpha", "beta"].F
    moved = [transform_points(A, p.expand(2, -1, -1)) for p in (alpha, beta)]
    x, y = (torch.nn.functional.pad(p, (0, 1), value=1.0) for p in moved)
    off = torch.einsum("bni,bij,bnj->bn", y, F, x)
    torch.testing.assert_close(off, torch.zeros_like(off), rtol=0, atol=1e-6 * float(F.abs().max()))


def test_a_perspective_augmentation_is_refused():
    out, container = (K.AugmentationSequential(K.RandomPerspective(0.3, p=1.0), data_keys=["input"]),) * 2
    out(torch.rand(2, 3, *ALPHA.hw))
    with pytest.raises(ValueError, match="perspective"):
        stack([ALPHA] * 2).transformed(container.transform_matrix, ALPHA.hw)
    with pytest.raises(TypeError):  # augmentations that bend an image have no matrix
        ALPHA.transformed(None, ALPHA.hw)
