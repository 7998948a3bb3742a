"""Measures of alignment: offsets of patches, homographies, occlusion, on images whose truth is known."""

import cv2
import numpy as np
import pytest
import torch

from experiments.alignment import (
    PATCH,
    SEARCH,
    AlignmentScene,
    aligned_scene,
    alignment_markdown,
    alignment_rows,
    ecc_homography,
    local_offsets,
)
from pat.lab.data.pairs import Disparity
from pat.lab.evaluation.protocols import rectified_rig

HW = (120, 200)


def texture(hw=HW, seed=0):
    """Blobs of some pixels, 8 bits."""
    noise = np.random.default_rng(seed).standard_normal(hw).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.clip(128 + smooth * 300, 0, 255).astype(np.uint8)


def moved(image, x, y):
    return cv2.warpAffine(
        image, np.float32([[1, 0, x], [0, 1, y]]), image.shape[::-1], borderMode=cv2.BORDER_REFLECT
    )


@pytest.mark.parametrize("sign", [1, -1])
def test_offsets_are_those_of_the_image(sign):
    """Whatever the sign of the contrast."""
    own = texture()
    other = moved(own, 1.3, -0.6)
    other = other if sign > 0 else 255 - other
    reach = PATCH + SEARCH
    x = np.stack(
        np.meshgrid(np.arange(reach, HW[1] - reach, 9), np.arange(reach, HW[0] - reach, 9)), -1
    ).reshape(-1, 2)
    offsets, located = local_offsets(own, other, x)
    assert np.median(np.abs(offsets - np.hypot(1.3, 0.6))) < 0.1
    assert located.mean() > 0.9


def test_what_has_no_one_place_is_not_located():
    """Neither noise that the bands do not share, nor a patch of which an edge of depth parts."""
    own, x = texture(), np.array([[60, 60], [100, 60], [140, 60]])
    assert not local_offsets(own, texture(seed=1), x)[1].any()
    parted = own.copy()
    parted[:, 100:] = moved(own, 3, 0)[:, 100:]
    assert local_offsets(own, parted, x)[1].tolist() == [True, False, True]


def test_the_homography_is_found():
    own = texture((480, 640))
    H = np.array([[1.01, 0.003, 9.0], [-0.002, 0.995, -6.0], [1e-6, 2e-6, 1.0]])
    other = cv2.warpPerspective(own, H, own.shape[::-1])
    found = ecc_homography(own, other)
    corners = np.array([[[50.0, 50], [590, 50], [590, 430], [50, 430]]])
    assert np.abs(cv2.perspectiveTransform(corners, found) - cv2.perspectiveTransform(corners, H)).max() < 1.0


def test_a_shifted_band_is_aligned_and_measured():
    wide = texture((HW[0], HW[1] + 12))
    left, right = wide[:, : HW[1]], wide[:, 12:]
    recorded = {"alpha": left[None], "red": right[None] // 2 + 20}
    images = {name: torch.from_numpy(values.astype(np.float32) / 255) for name, values in recorded.items()}
    truth = Disparity(torch.full(HW, 12.0), torch.ones(HW, dtype=torch.bool))
    rig = rectified_rig(HW, {"red": HW}, 40.0)
    scene = AlignmentScene("shifted", rig, images, recorded, "alpha", True, truth=truth)
    (row,) = alignment_rows(scene, aligned_scene(scene, 0.1))
    assert row.true > 0.95
    assert row.aligned > 0.95
    assert row.by_truth > 0.99
    assert row.off == 0
    assert "uint8" in alignment_markdown([row])
