"""Convolutions in bfloat16."""

import pytest
import torch

from pat import fuse
from pat.data.sample_array import load_sample
from pat.evaluation.metrics import score
from pat.networks.weights import load_weights


def test_bfloat16_changes_the_image_little_and_something(monkeypatch):
    if not torch.cpu._is_avx512_bf16_supported():
        pytest.skip("this processor has no bfloat16")
    sample = load_sample()
    images = {name: sample.images[name] for name in sample.rig.names}
    exact, rounded = (
        fuse(
            load_weights("mono-colour", precision=p),
            sample.rig,
            images,
            alpha="mono",
            align=False,
            response="rec601",
        )
        for p in ("float32", "bfloat16")
    )
    apart = (exact.image - rounded.image).abs()
    assert 0 < apart.max() < 0.02
    scores = [score(frame.image.clamp(0, 1), sample.ground_truth).psnr for frame in (exact, rounded)]
    assert abs(scores[0] - scores[1]) < 0.02
    assert (exact.confidence - rounded.confidence).abs().max() < 0.02


def test_a_processor_without_bfloat16_refuses_it(monkeypatch):
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: False)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ValueError, match=r"bfloat16.*float32"):
        load_weights("mono-colour", precision="bfloat16")
