import cv2
import numpy as np
import pytest
import torch

from arraygeom.camera import Camera, intrinsics
from arraygeom.pose import Pose
from experiments.sensors import Defocus, DiscBlur, MotionBlur, Vignetting, circle_of_confusion, record
from pat.sensors import Resample

HW = (61, 81)
LENS, F_NUMBER = 50.0, 2.0


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def camera(fx: float = 800.0, fy: float | None = None) -> Camera:
    return Camera(K=intrinsics((fx, fy or fx), HW), cam_from_world=Pose.identity(), hw=HW)


def defocused(image, depth, focus=2.0, shape="disc", cam=None):
    step = Defocus(focus, F_NUMBER, LENS, shape)
    return record(image, [step], generator(), depth=depth, camera=cam or camera()).image


def point() -> torch.Tensor:
    image = torch.zeros(1, 1, *HW, dtype=torch.float64)
    image[..., 30, 40] = 1
    return image


def at(z: float) -> torch.Tensor:
    return torch.full((1, *HW), z, dtype=torch.float64)


def variances(spread: torch.Tensor) -> tuple[float, float]:
    """Along x and y, about the mean."""
    found = []
    for axis in (0, 1):
        p = spread[0, 0].sum(axis)
        x = torch.arange(len(p), dtype=p.dtype)
        mean = (p * x).sum() / p.sum()
        found.append(((p * (x - mean) ** 2).sum() / p.sum()).item())
    return found[0], found[1]


@pytest.mark.parametrize("z", [0.8, 1.0, 3.0, 8.0])
@pytest.mark.parametrize("shape", ["disc", "gaussian"])
def test_a_point_out_of_focus_becomes_a_disc_of_the_size_theory_gives(z, shape):
    """The variance of a disc along an axis is (diameter / 4)^2, its soft rim adds a pixel's own 1/12."""
    spread = defocused(point(), at(z), shape=shape)
    diameter = 800 * (LENS / F_NUMBER * 1e-3) * abs(1 / 2.0 - 1 / z)
    assert spread.sum().item() == pytest.approx(1, rel=1e-3)
    for variance in variances(spread):
        rim = 1 / 12 if shape == "disc" else 0.0
        assert 4 * (variance - rim) ** 0.5 == pytest.approx(diameter, rel=0.05)


def test_the_disc_is_an_ellipse_where_pixels_are_not_square():
    x, y = variances(defocused(point(), at(0.8), cam=camera(800.0, 1200.0)))
    assert (y / x) ** 0.5 == pytest.approx(1.5, rel=0.03)


def test_in_focus_nothing_changes_and_flat_images_stay_flat():
    image = torch.rand(2, 3, *HW, generator=generator(), dtype=torch.float64)
    torch.testing.assert_close(defocused(image, at(2.0).expand(2, -1, -1)), image)
    depth = 0.7 + 5 * torch.rand(2, *HW, generator=generator(), dtype=torch.float64)
    grey = torch.full_like(image, 0.3)
    torch.testing.assert_close(defocused(grey, depth), grey)


def test_uniform_depth_is_uniform_blur():
    image = torch.rand(1, 3, *HW, generator=generator(), dtype=torch.float64)
    radius = circle_of_confusion(at(1.0), 2.0, F_NUMBER, LENS, torch.tensor([800.0])).abs().max().item() / 2
    torch.testing.assert_close(
        defocused(image, at(1.0)), record(image, [DiscBlur(radius)], generator()).image, atol=0.01, rtol=0
    )


def test_what_is_near_and_sharp_keeps_its_colour_beside_what_is_far_and_blurred():
    image, depth = torch.zeros(1, 1, *HW, dtype=torch.float64), at(50.0)
    image[..., 40:], depth[..., 40:] = 1.0, 2.0
    seen = defocused(image, depth)[0, 0, 30]
    assert seen[40:].min() > 0.99
    assert seen[:35].max() < 0.01


def test_what_is_near_and_blurred_spreads_over_what_is_far_and_sharp():
    image, depth = torch.zeros(1, 1, *HW, dtype=torch.float64), at(2.0)
    image[..., 40:], depth[..., 40:] = 1.0, 0.8
    seen = defocused(image, depth)[0, 0, 30]
    radius = 800 * 0.025 * (1 / 0.8 - 1 / 2.0) / 2
    assert seen[39].item() == pytest.approx(0.5, abs=0.1)
    assert seen[int(40 - radius / 2)] > 0.05
    assert seen[: int(40 - radius - 1)].max() < 1e-6
    assert (seen.diff() >= -1e-9).all()


def test_defocus_follows_the_resampled_camera():
    """Half the pixels, half the disc."""
    steps = [Resample(0.5), Defocus(2.0, F_NUMBER, LENS)]
    step = Defocus(2.0, F_NUMBER, LENS)
    seen = record(point(), steps, generator(), depth=at(0.8), camera=camera())
    whole = record(point(), [step], generator(), depth=at(0.8), camera=camera())
    assert variances(seen.image)[0] == pytest.approx(variances(whole.image)[0] / 4, rel=0.1)


def test_gradients_of_defocus_in_image_and_depth():
    g = generator()
    image = torch.rand(1, 1, 7, 8, generator=g, dtype=torch.float64, requires_grad=True)
    depth = (1.2 + 0.1 * torch.rand(1, 7, 8, generator=g, dtype=torch.float64)).requires_grad_()
    small = Camera(K=intrinsics(150.0, (7, 8)), cam_from_world=Pose.identity(), hw=(7, 8))
    assert torch.autograd.gradcheck(lambda i, z: defocused(i, z, cam=small), (image, depth))


def test_motion_blur_is_as_long_as_shutter_times_velocity_and_stays_centred():
    """A box of length L has variance L^2 / 12; looking up between pixels adds at most 1/4."""
    spread = record(point(), [MotionBlur(0.02, (600.0, 0.0))], generator()).image
    x, y = variances(spread)
    assert spread.sum().item() == pytest.approx(1)
    assert (12 * x) ** 0.5 == pytest.approx(12, rel=0.05)
    assert y == pytest.approx(0, abs=1e-9)
    columns = torch.arange(HW[1]).double()
    assert (spread[0, 0].sum(0) * columns).sum().item() == pytest.approx(40)


def test_motion_blur_agrees_with_a_line_filter_of_opencv():
    image = torch.rand(1, 1, *HW, generator=generator(), dtype=torch.float64)
    mean = cv2.blur(image[0, 0].numpy(), (9, 1), borderType=cv2.BORDER_REPLICATE)
    sampled = record(image, [MotionBlur(1.0, (9.0, 0.0))], generator()).image[0, 0].numpy()
    assert np.abs(sampled - mean).max() < 0.06
    assert np.abs(sampled - mean).mean() < 0.01


def test_vignetting_against_the_formula():
    flat = torch.ones(1, 2, *HW, dtype=torch.float64)
    seen = record(flat, [Vignetting((-0.3, 0.05))], generator()).image[0, 0]
    assert seen[30, 40].item() == pytest.approx(1)
    r2 = (40.0**2 + 30.0**2) / ((HW[0] ** 2 + HW[1] ** 2) / 4)
    assert seen[0, 0].item() == pytest.approx(1 - 0.3 * r2 + 0.05 * r2**2)
    natural = record(flat, [Vignetting(natural=True)], generator(), camera=camera(100.0)).image[0, 1]
    assert natural[30, 0].item() == pytest.approx(np.cos(np.arctan(0.4)) ** 4)


def test_vignetting_is_centred_on_the_principal_point():
    off = Camera(K=intrinsics(100.0, HW, (20.0, 10.0)), cam_from_world=Pose.identity(), hw=HW)
    flat = torch.ones(1, 1, *HW, dtype=torch.float64)
    seen = record(flat, [Vignetting((-0.5,))], generator(), camera=off).image[0, 0]
    assert divmod(int(seen.argmax()), HW[1]) == (10, 20)


def test_what_a_step_misses_is_named():
    image = torch.rand(1, 1, 8, 8)
    for step, words in (
        (Defocus(2, 2, 50), "depth"),
        (Vignetting(natural=True), "camera"),
    ):
        with pytest.raises(ValueError, match=words):
            record(image, [step], generator())
    with pytest.raises(ValueError, match="f_number"):
        Defocus(2, 0, 50)
