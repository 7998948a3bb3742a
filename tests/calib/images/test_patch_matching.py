"""Matched points by patches: to hundredths of a pixel, whatever brightness does; left alone where wrong."""

import cv2
import numpy as np
import pytest
import torch

from calib.images.matches import match_points
from calib.images.patch_matching import _sampled, refine_points
from tests.calib.scenes import texture

A = np.array([[0.93, -0.08], [0.11, 1.04]])
SHIFT = np.array([6.3, -4.7])


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def warped(rng, hw=(240, 320)):
    """An image and how a second camera sees it: y = A x + shift, darker and flatter, with noise."""
    image = (texture(hw, seed=3)[0].numpy() * 255).astype(np.float32)
    there = cv2.warpAffine(
        image, np.c_[A, SHIFT], hw[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
    )
    images = image, 0.6 * there + 20
    return [(p + rng.normal(0, 0.7, hw)).round().clip(0, 255).astype(np.uint8) for p in images]


def points(rng):
    return rng.uniform(40, (280, 200), (60, 2))


def test_points_return_to_where_they_are_seen(rng):
    alpha, beta = warped(rng)
    x = points(rng)
    ground_truth = x @ A.T + SHIFT
    found = refine_points(
        alpha, beta, x, ground_truth + rng.normal(0, 0.5, x.shape), np.tile(np.eye(2), (60, 1, 1))
    ).y
    off = np.linalg.norm(found - ground_truth, axis=1)
    assert np.median(off) < 0.05
    assert (off < 0.15).mean() > 0.95


def test_more_patches_than_opencv_takes_rows_are_sampled(rng):
    image = rng.uniform(size=(20, 30)).astype(np.float32)
    x = rng.integers(1, 19, (40_000, 3, 2)).astype(float)
    assert (_sampled(image, x) == image[x[..., 1].astype(int), x[..., 0].astype(int)]).all()


def test_uncorrelated_patches_are_rejected(rng):
    alpha, _ = warped(rng)
    other = (texture((240, 320), seed=9)[0].numpy() * 255).astype(np.uint8)
    x = points(rng)
    y = x + SHIFT
    found = refine_points(alpha, other, x, y, np.tile(A, (60, 1, 1))).y
    assert (found == y).all(1).mean() > 0.9
    assert refine_points(alpha, other, x[:0], y[:0], np.zeros((0, 2, 2))).y.shape == (0, 2)


def test_matches_are_better_for_it(rng):
    alpha, beta = (torch.from_numpy(p / np.float32(255))[None] for p in warped(rng))
    matches = match_points(alpha, beta)
    off = np.linalg.norm(matches.alpha.numpy() @ A.T + SHIFT - matches.beta.numpy(), axis=1)
    assert len(off) > 60
    assert np.median(off) < 0.08


def test_deviations_distinguish_good_points_from_bad_ones(rng):
    """Points without texture have large ones, unfitted ones infinite; others are as off as they say."""
    alpha, beta = warped(rng)
    flat = [np.where(np.arange(320) < 160, p, (p * 0.04 + 120).astype(np.uint8)) for p in (alpha, beta)]
    noisy = [(p + rng.normal(0, 0.7, p.shape)).round().clip(0, 255).astype(np.uint8) for p in flat]
    x = points(rng)
    ground_truth = x @ A.T + SHIFT
    found = refine_points(*noisy, x, ground_truth + rng.normal(0, 0.3, x.shape), np.tile(A, (60, 1, 1)))
    left = (x[:, 0] < 140) & (ground_truth[:, 0] < 140) & np.isfinite(found.deviation)
    right = (x[:, 0] > 180) & (ground_truth[:, 0] > 180)
    assert np.median(found.deviation[right]) > 4 * np.median(found.deviation[left])
    assert np.median(np.linalg.norm(found.y - ground_truth, axis=1)[left]) < 3 * np.median(
        found.deviation[left]
    )
    alike, *_ = warped(rng)
    assert (
        np.isinf(refine_points(alike, alike[::-1], x, x, np.tile(np.eye(2), (60, 1, 1))).deviation).mean()
        > 0.9
    )
