"""Convolutions in bfloat16."""

import copy
import pickle
from inspect import unwrap

import pytest
import torch

from pat import FuseSettings, fuse
from pat.app.sample_array import load_sample
from pat.networks.weights import load_weights, set_precision
from pat.support.metrics import score


def test_a_precision_changes_the_image_little_and_something():
    if not torch.cpu._is_avx512_bf16_supported():
        pytest.skip("this processor does not multiply bfloat16")
    sample = load_sample()
    settings = FuseSettings(align=False, response="rec601")
    exact, rounded = (
        fuse(
            sample.images,
            sample.rig,
            alpha="mono",
            network=load_weights("mono-colour", precision=p),
            settings=settings,
        )
        for p in ("float32", "bfloat16")
    )
    apart = (exact.image - rounded.image).abs()
    assert 0 < apart.max() < 0.05
    scores = [score(frame.image.clamp(0, 1), sample.ground_truth).psnr for frame in (exact, rounded)]
    assert abs(scores[0] - scores[1]) < 0.02
    assert (exact.confidence - rounded.confidence).abs().max() < 0.02


def test_a_copy_of_a_network_in_bfloat16_computes_with_its_own_weights():
    network = load_weights("mono-colour-small")
    set_precision(network, "bfloat16")
    other = copy.deepcopy(network)
    for parameter in other.encoder.parameters():
        parameter.zero_()
    image = torch.rand(1, 1, 32, 32)
    assert network.encoder(image).half.any()
    assert not other.encoder(image).half.any()
    again = pickle.loads(pickle.dumps(network))
    assert again.encoder(image).half.equal(network.encoder(image).half)


def test_a_precision_that_there_is_not_is_refused():
    with pytest.raises(ValueError, match="precision"):
        unwrap(load_weights)("mono-colour-small", precision="float16")


def test_a_processor_without_bfloat16_refuses_it(monkeypatch):
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: False)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ValueError, match="bfloat16"):
        load_weights("mono-colour", precision="bfloat16")
