import cv2
import numpy as np
import pytest
import torch

from arraygeom import Camera, Pose, Rig
from pat.fusion.classical import (
    _rectified_plane,
    _regressed,
    classical,
    classical_baseline,
    classical_fusion,
    classical_view,
)
from pat.fusion.gradients import without_gradient
from pat.lab.data import StereoPair, middlebury_pairs
from pat.lab.evaluation.protocols import mono_colour_task
from pat.media.colour import luminance, to_luma_chroma
from pat.networks.weights import load_weights
from pat.support.metrics import score


def patches(height=96, width=160, *, seed=0):
    """A smooth colour image with texture that can be matched, away from black and white."""
    rng = np.random.default_rng(seed)
    coarse = cv2.resize(
        rng.random((8, 12, 3)).astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC
    )
    grain = cv2.GaussianBlur(rng.random((height, width)).astype(np.float32), (0, 0), 1.5) - 0.5
    image = 0.25 + 0.5 * coarse.clip(0, 1) + 0.5 * grain[..., None]
    return torch.from_numpy(image.clip(0, 1)).permute(2, 0, 1).contiguous()


def shifted_pair(disparity):
    scene = patches(width=192)
    return StereoPair("shift", scene[:, :, :160], scene[:, :, disparity : 160 + disparity])


@pytest.mark.parametrize(("rate", "least"), [(1, 45), (2, 38), (4, 30)])
def test_a_shifted_image_gives_its_colours_back(rate, least):
    alpha, beta, ground_truth, _ = mono_colour_task(shifted_pair(9), rate)
    result = classical_fusion(alpha, beta, max_disparity=20.0)
    away = (slice(None), slice(None), slice(12, None))
    assert score(result[away], ground_truth[away]).psnr > least
    assert score(result, ground_truth).psnr > score(alpha.expand(3, -1, -1), ground_truth).psnr + 3


def test_the_result_has_alphas_luminance():
    alpha, beta, *_ = mono_colour_task(StereoPair("a", 0.2 + 0.6 * patches(), 0.2 + 0.6 * patches(seed=1)), 2)
    result = classical_fusion(alpha, beta, max_disparity=30.0)
    inside = ((result > 0) & (result < 1)).all(0)
    assert inside.float().mean() > 0.9
    assert (luminance(result) - alpha)[:, inside].abs().max() < 1e-5


def test_a_darker_colour_camera_is_matched_too():
    alpha, beta, ground_truth, _ = mono_colour_task(shifted_pair(9), 2)
    darker = classical_fusion(alpha, 0.2 * beta, max_disparity=20.0)
    expected = 0.2 * to_luma_chroma(ground_truth)[1][:, :, 12:]
    assert (to_luma_chroma(darker)[1][:, :, 12:] - expected).abs().mean() < 0.004


@pytest.mark.parametrize("hw", [(1, 1), (2, 3), (5, 40), (40, 5), (17, 33)])
@pytest.mark.parametrize("beta_hw", [(1, 1), (8, 16), (50, 70)])
def test_tiny_and_featureless_images_are_served(hw, beta_hw):
    for alpha, beta in (
        (torch.rand(1, *hw), torch.rand(3, *beta_hw)),
        (torch.full((1, *hw), 0.5), torch.tensor([0.5, 0.4, 0.3])[:, None, None].expand(3, *beta_hw)),
        (torch.zeros(1, *hw), torch.zeros(3, *beta_hw)),
    ):
        result = classical_fusion(alpha, beta, max_disparity=1e5)
        assert result.shape == (3, *hw)
        assert result.isfinite().all()


def test_a_featureless_pair_takes_betas_colour():
    beta = torch.tensor([0.6, 0.5, 0.3])[:, None, None].expand(3, 24, 32)
    result = classical_fusion(luminance(beta), beta, max_disparity=10.0)
    torch.testing.assert_close(result, beta.contiguous(), atol=1e-4, rtol=0)


@pytest.mark.parametrize(
    ("error", "said", "images"),
    [
        (ValueError, r"'beta'.*5", {"beta": torch.rand(5, 24, 32)}),
        (ValueError, r"'alpha'.*4", {"alpha": torch.rand(4, 24, 32)}),
        (ValueError, r"'alpha'.*32x20.*32x24", {"alpha": torch.rand(1, 20, 32)}),
        (ValueError, r"'beta'.*30x24.*32x24", {"beta": torch.rand(3, 24, 30)}),
        (TypeError, "'beta'.*ndarray", {"beta": np.ones((3, 24, 32), np.float32)}),
    ],
)
@pytest.mark.parametrize("fuse", [classical, classical_view, without_gradient])
def test_images_that_do_not_fit_are_refused(error, said, images, fuse):
    rig = rig_of(camera(200.0, (24, 32)), camera(200.0, (24, 32), t=[-0.1, 0.0, 0.0]), (2.0, 6.0))
    images = {"alpha": torch.rand(1, 24, 32), "beta": torch.rand(3, 24, 32), **images}
    further = {classical_view: {"longest": 16}, without_gradient: {"network": load_weights("mono-colour")}}
    named = {"beta": "beta"} if fuse is classical else further[fuse]
    calls = {"rig": rig, "images": images, "alpha": "alpha", **named}
    with pytest.raises(error, match=said):
        fuse(**calls)


@pytest.mark.parametrize(
    ("alpha", "beta", "most", "said"),
    [(1, 3, 0.0, "max_disparity"), (1, 1, 9.0, "beta.*1, 20, 20"), (3, 3, 9.0, "alpha.*3, 20, 20")],
)
def test_no_disparity_to_search_and_other_bands_are_refused(alpha, beta, most, said):
    with pytest.raises(ValueError, match=said):
        classical_fusion(torch.rand(alpha, 20, 20), torch.rand(beta, 20, 20), max_disparity=most)


def test_colour_follows_luminance_as_it_does_nearby():
    luma = np.random.default_rng(0).random((30, 40)).astype(np.float32)
    chroma = np.stack([0.4 * luma, 0.1 - 0.2 * luma], -1)
    residual = np.full_like(luma, 0.1)
    moved = _regressed(chroma, luma, residual) - chroma
    np.testing.assert_allclose(moved, np.broadcast_to([0.04, -0.02], moved.shape), atol=0.004)


def rotation(*vector):
    return torch.from_numpy(cv2.Rodrigues(np.array(vector))[0])


def camera(focal, hw, R=None, t=(0.0, 0.0, 0.0)):
    K = torch.tensor([[focal, 0, (hw[1] - 1) / 2], [0, focal * 1.02, (hw[0] - 1) / 2], [0, 0, 1]]).double()
    pose = Pose(torch.eye(3).double() if R is None else R, torch.tensor(t).double())
    return Camera(K=K, cam_from_world=pose, hw=hw)


def rig_of(alpha, beta, depth):
    return Rig({"alpha": alpha, "beta": beta}, depth=depth)


POSES = {
    "right": (rotation(0.02, -0.06, 0.05), [-0.3, 0.02, 0.03]),
    "left": (rotation(-0.03, 0.08, -0.04), [0.3, 0.03, -0.02]),
    "below": (rotation(0.06, 0.02, 0.1), [0.03, -0.25, 0.02]),
    "above": (rotation(-0.05, 0.0, 0.0), [0.0, 0.25, 0.0]),
}


@pytest.mark.parametrize("pose", POSES)
def test_rectifying_puts_points_on_one_row_and_disparities_in_range(pose):
    R, t = POSES[pose][0].numpy(), np.array(POSES[pose][1])
    near, far = 2.0, 6.0
    rig = rig_of(camera(200.0, (96, 160)), camera(120.0, (70, 100), *POSES[pose]), (near, far))
    pair = rig.pair("alpha", "beta")
    K_alpha, K_beta = (c.K.numpy() for c in pair.cameras)
    plane = _rectified_plane(pair)
    rng = np.random.default_rng(0)
    pixels = np.c_[rng.uniform(0, 159, 200), rng.uniform(0, 95, 200), np.ones(200)]
    points = pixels @ np.linalg.inv(K_alpha).T * rng.uniform(near, far, (200, 1))
    in_alpha, in_beta = (
        (x := p @ H.T)[:, :2] / x[:, 2:]
        for p, H in ((points @ K_alpha.T, plane.from_alpha), ((points @ R.T + t) @ K_beta.T, plane.from_beta))
    )
    np.testing.assert_allclose(in_alpha[:, 1], in_beta[:, 1], atol=1e-9)
    disparity = in_alpha[:, 0] - in_beta[:, 0]
    assert disparity.min() > -1e-9
    assert disparity.max() < plane.max_disparity + 1e-9
    assert (in_alpha >= -1e-9).all()
    assert (in_alpha <= np.array(plane.wh) - 1 + 1e-9).all()


@pytest.mark.parametrize("pose", POSES)
def test_a_slanted_plane_seen_by_unrectified_cameras_is_coloured(pose):
    R, t = POSES[pose][0], torch.tensor(POSES[pose][1]).double()
    hw, beta_hw = (96, 160), (80, 120)
    rig = rig_of(camera(200.0, hw), camera(140.0, beta_hw, *POSES[pose]), (2.0, 6.0))
    K_alpha, K_beta = (c.K for c in rig.cameras.values())
    normal, distance = torch.tensor([0.1, 0.2, -1.0]).double(), 3.0
    H = K_beta @ (R - t[:, None] * normal / distance) @ K_alpha.inverse()
    ground_truth = patches(*hw)
    beta = cv2.warpPerspective(
        ground_truth.permute(1, 2, 0).numpy(),
        H.numpy(),
        beta_hw[::-1],
        flags=cv2.INTER_AREA,
        borderMode=cv2.BORDER_REFLECT,
    )
    beta = torch.from_numpy(beta).permute(2, 0, 1)
    alpha = luminance(ground_truth)
    result = classical(rig, {"alpha": alpha, "beta": beta}, "alpha", "beta")
    seen = cv2.warpPerspective(np.ones(beta_hw, np.uint8), H.inverse().numpy(), hw[::-1]) > 0
    seen = torch.from_numpy(cv2.erode(seen.astype(np.uint8), np.ones((9, 9)), borderValue=1)) > 0
    error = (result - ground_truth)[:, seen].square().mean().sqrt()
    assert seen.float().mean() > 0.5
    assert error < 0.25 * (alpha - ground_truth)[:, seen].square().mean().sqrt()


@pytest.mark.parametrize(
    ("t", "near", "complaint"),
    [
        ([0.0, 0.0, 0.3], 2.0, "line"),
        ([0.05, 0.0, 0.3], 2.0, "line"),
        ([0.0, 0.0, 0.0], 2.0, r"\bt\b"),
        ([-0.1, 0.0, 0.0], 1e-4, "near"),
    ],
)
def test_rigs_that_cannot_be_rectified_are_refused(t, near, complaint):
    rig = rig_of(camera(200.0, (24, 32)), camera(200.0, (24, 32), t=t), (near, 6.0))
    images = {"alpha": torch.rand(1, 24, 32), "beta": torch.rand(3, 24, 32)}
    with pytest.raises(ValueError, match=complaint):
        classical(rig, images, "alpha", "beta")


def test_teddy_keeps_its_colours(shared_data):
    pair = next(pair for pair in middlebury_pairs(shared_data / "middlebury") if "teddy" in pair.name)
    alpha, beta, ground_truth, _ = mono_colour_task(pair, 2)
    result, grey = (
        score(classical_fusion(alpha, beta, max_disparity=64.0), ground_truth),
        score(alpha.expand(3, -1, -1), ground_truth),
    )
    assert result.psnr > grey.psnr + 10
    assert result.ssim > grey.ssim + 0.1


def test_a_baseline_without_the_image_of_a_beta_is_refused():
    K = torch.tensor([[160.0, 0, 79.5], [0, 160, 47.5], [0, 0, 1]])
    rig = Rig(
        {name: Camera(K=K, cam_from_world=Pose.identity(), hw=(96, 160)) for name in "ab"}, depth=(1.0, 9.0)
    )
    with pytest.raises(ValueError, match="'a'"):
        classical_baseline(rig, {"a": torch.zeros(1, 96, 160)}, "a")
