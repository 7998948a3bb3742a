import cv2
import numpy as np
import pytest
import torch

from arraygeom.camera import Camera, intrinsics
from arraygeom.distortion import Distortion
from arraygeom.pose import Pose, rotation_from_vector
from arraygeom.rig import Rig
from experiments.sensors import Crop, Defocus, Demosaic, Mosaic, MotionBlur, Vignetting, record, record_array
from pat.sensors import BoxBlur, GaussianBlur, Noise, Resample

PATTERNS = ["RGGB", "GRBG", "BGGR", "GBRG"]


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def smooth(*shape: int, sigma: float = 4.0) -> torch.Tensor:
    image = torch.rand(*shape, generator=generator(), dtype=torch.float64)
    image = record(image, [GaussianBlur(sigma)], generator()).image
    return ((image - image.min()) / (image.max() - image.min())).clamp(0, 1)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_a_mosaic_keeps_the_colours_its_name_says(pattern):
    image = torch.rand(2, 3, 6, 8, generator=generator())
    raw = record(image, [Mosaic(pattern)], generator()).image
    for i, letter in enumerate(pattern):
        y, x = divmod(i, 2)
        assert torch.equal(raw[:, 0, y::2, x::2], image[:, "RGB".index(letter), y::2, x::2])


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize(("method", "tolerance"), [("bilinear", 0.01), ("edge-aware", 0.01)])
def test_smooth_images_come_back_from_mosaic_and_demosaic(pattern, method, tolerance):
    image = smooth(2, 3, 60, 80)
    back = record(image, [Mosaic(pattern), Demosaic(pattern, method)], generator()).image
    error = (back - image)[..., 3:-3, 3:-3].abs()
    assert error.mean() < tolerance / 4
    assert error.max() < 4 * tolerance


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("method", ["bilinear", "edge-aware"])
def test_demosaicing_moves_nothing(pattern, method):
    """A ramp has no curvature: inside the border it comes back exactly where it was."""
    y, x = torch.meshgrid(torch.linspace(0.1, 0.4, 40), torch.linspace(0.1, 0.5, 60), indexing="ij")
    ramp = torch.stack([x, y, x + y])[None].double()
    back = record(ramp, [Mosaic(pattern), Demosaic(pattern, method)], generator()).image
    torch.testing.assert_close(back[..., 2:-2, 2:-2], ramp[..., 2:-2, 2:-2], atol=2e-3, rtol=0)


def test_bilinear_agrees_with_opencv():
    image = torch.rand(1, 3, 40, 60, generator=generator(), dtype=torch.float64)
    raw = record(image, [Mosaic("RGGB")], generator()).image
    wanted = (
        cv2.cvtColor((raw[0, 0].numpy() * 65535).round().astype(np.uint16), cv2.COLOR_BayerRGGB2RGB) / 65535
    )
    back = record(raw, [Demosaic("RGGB")], generator()).image[0].movedim(0, -1).numpy()
    np.testing.assert_allclose(back[2:-2, 2:-2], wanted[2:-2, 2:-2], atol=1e-4)


def test_the_edge_aware_gradient_is_that_of_bilinear():
    image = torch.rand(1, 3, 6, 8, generator=generator(), requires_grad=True)
    gradients = []
    for method in ("bilinear", "edge-aware"):
        seen = record(image, [Mosaic(), Demosaic(method=method)], generator()).image
        gradients.append(torch.autograd.grad(seen[:, 0].sum(), image)[0])
    assert torch.equal(*gradients)


CHAINS = {
    "half": [Resample(0.5)],
    "crop then bicubic": [Crop(7, 12, (40, 60)), Resample((33, 51), "bicubic")],
    "all": [
        *(Vignetting((-0.01,)), GaussianBlur(1.0), Defocus(2.0, 4.0, 25.0), MotionBlur(0.01, (100.0, 50.0))),
        *(Crop(2, 4, (56, 84)), Resample(0.5, "bicubic"), BoxBlur(3), Mosaic(), Demosaic(), Noise(1e9)),
    ],
    "none": [],
}


@pytest.mark.parametrize(
    "lens", [None, Distortion("brown-conrady", torch.tensor([-0.1, 0.02, 0.0, 0.0]).double())]
)
@pytest.mark.parametrize("chain", CHAINS)
def test_points_are_found_where_the_rig_of_the_recorded_images_projects_them(chain, lens):
    """Soft dots are drawn where 3-D points project in the ideal images of two cameras, then recorded."""
    turned = Pose(
        rotation_from_vector(torch.tensor([0.02, -0.05, 0.1]).double()), torch.tensor([0.1, 0.02, 0]).double()
    )
    cameras = {
        "left": Camera(
            K=intrinsics(90.0, (64, 96)), cam_from_world=Pose.identity(), hw=(64, 96), distortion=lens
        ),
        "right": Camera(K=intrinsics((85.0, 80.0), (70, 90)), cam_from_world=turned, hw=(70, 90)),
    }
    rig = Rig(cameras, depth=(1, 5))
    chains = {"left": CHAINS[chain], "right": CHAINS["half"]}
    for X in torch.tensor([[0.13, -0.07, 1.6], [-0.2, 0.1, 2.0]]).double():
        images = {n: _dot(c, X) for n, c in cameras.items()}
        depth = {n: torch.full((1, *c.hw), 1.8).double() for n, c in cameras.items()}
        recorded = record_array(images, rig, chains, seed=0, depth=depth)
        for name in cameras:
            wanted = recorded.rig[name].project(X).x
            assert recorded.rig[name].hw == tuple(recorded.images[name].shape[-2:])
            torch.testing.assert_close(_found(recorded.images[name]), wanted, atol=0.02, rtol=0)


def _dot(camera: Camera, X: torch.Tensor) -> torch.Tensor:
    x, y = camera.project(X).x
    rows, columns = torch.meshgrid(*(torch.arange(float(n)).double() for n in camera.hw), indexing="ij")
    return torch.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * 4**2))[None, None].expand(1, 3, -1, -1)


def _found(image: torch.Tensor) -> torch.Tensor:
    light = image.mean(1)[0] - image.mean(1)[0].median()
    light = torch.where(light > 0.02, light, 0.0)
    rows, columns = torch.meshgrid(*(torch.arange(float(n)).double() for n in light.shape), indexing="ij")
    return torch.stack([(light * c).sum() / light.sum() for c in (columns, rows)])


def test_each_camera_draws_for_itself():
    """A camera more, or another order, changes no other camera's noise."""
    rig = Rig(
        {n: Camera(K=intrinsics(90.0, (8, 8)), cam_from_world=Pose.identity(), hw=(8, 8)) for n in "abc"}
    )
    images = {n: torch.full((1, 1, 8, 8), 0.5) for n in "abc"}
    chains = {n: [Noise(100.0)] for n in "abc"}
    three = record_array(images, rig, chains, seed=1).images
    two = record_array({n: images[n] for n in "ca"}, rig, {n: chains[n] for n in "ca"}, seed=1).images
    assert torch.equal(three["a"], two["a"])
    assert torch.equal(three["c"], two["c"])
    assert not torch.equal(three["a"], three["b"])
    assert not torch.equal(three["a"], record_array(images, rig, chains, seed=2).images["a"])


def test_mistakes_are_named():
    image = torch.rand(1, 3, 7, 8)
    for step, words in ((Mosaic(), "even"), (Crop(4, 0, (5, 5)), "leaves the image")):
        with pytest.raises(ValueError, match=words):
            record(image, [step], generator())
    rig = Rig({"mono": Camera(K=intrinsics(9.0, (8, 8)), cam_from_world=Pose.identity(), hw=(8, 8))})
    with pytest.raises(ValueError, match="did you mean 'mono'"):
        record_array({}, rig, {"mno": []}, seed=0)
