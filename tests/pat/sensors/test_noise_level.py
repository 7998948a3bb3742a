"""Noise levels: what is recorded has the stated deviation, and it is found again in the image."""

import pytest
import torch
from scipy.optimize import nnls

from experiments.sensors import DecodeSRGB, EncodeSRGB
from pat.sensors import Clip, Noise, NoiseLevel, generator_for, record
from pat.sensors.noise_level import _fitted
from tests.pat.layered_array import load_sample

LEVELS = {
    "200 electrons": NoiseLevel.from_electrons(200, 2),
    "50 electrons": NoiseLevel.from_electrons(50, 2),
    "200 electrons, values": NoiseLevel.from_electrons(200, 2, "values"),
    "10 of 255": NoiseLevel(read=10 / 255, added_to="values"),
}


@pytest.mark.parametrize("name", LEVELS)
@pytest.mark.parametrize("value", [0.1, 0.25, 0.5, 0.8])
def test_recorded_noise_has_the_stated_deviation(name, value):
    recorded = LEVELS[name].recorded(torch.full((1, 1, 200, 200), value), generator_for(0, name, value))
    stated = float(LEVELS[name].deviation(recorded).mean())
    assert float(recorded.std()) == pytest.approx(stated, rel=0.05)


@pytest.mark.parametrize(
    ("name", "value", "bias"), [("50 electrons", 0.05, 0.048), ("50 electrons", 0.25, -0.029)]
)
def test_the_bias_of_clipped_and_encoded_noise_is_removed(name, value, bias):
    recorded = LEVELS[name].recorded(torch.full((1, 1, 200, 200), value), generator_for(0, name, value))
    assert float(recorded.mean()) - value == pytest.approx(bias, abs=0.004)
    assert float(LEVELS[name].unbiased(recorded).mean()) == pytest.approx(value, abs=0.006)


def test_each_image_of_a_batch_has_its_own_level():
    shot, read = torch.tensor([0.02, 0.002]).view(2, 1, 1, 1), torch.tensor([0.04, 0.0]).view(2, 1, 1, 1)
    image = torch.rand(2, 3, 20, 21, generator=generator_for(0, "batch"))
    both = NoiseLevel(shot, read)
    for i in range(2):
        alone, part = NoiseLevel(float(shot[i]), float(read[i])), image[i : i + 1]
        torch.testing.assert_close(both.deviation(image)[i : i + 1], alone.deviation(part))
        torch.testing.assert_close(both.unbiased(image)[i : i + 1], alone.unbiased(part))


def test_a_level_in_another_precision_leaves_the_images_as_it_is():
    level = torch.full((2, 1, 1, 1), 0.1, dtype=torch.float64)
    image = torch.rand(2, 3, 20, 21, generator=generator_for(0, "batch"))
    assert NoiseLevel(level, level).recorded(image, generator_for(0)).dtype == torch.float32


def test_without_noise_nothing_is_biased():
    image = torch.rand(1, 3, 20, 21, generator=generator_for(0, "clean"))
    torch.testing.assert_close(NoiseLevel().unbiased(image), image, atol=1e-6, rtol=0)


def test_light_is_recorded_as_the_forward_model_does():
    """The same distribution as the chain of sensor steps."""
    image = torch.full((1, 1, 300, 300), 0.4)
    chain = [DecodeSRGB(), Noise(100, 3), Clip(), EncodeSRGB()]
    other = record(image, chain, generator_for(0, "chain"))
    ours = NoiseLevel.from_electrons(100, 3).recorded(image, generator_for(0, "ours"))
    quantiles = torch.linspace(0.02, 0.98, 13)
    a, b = (x.flatten().quantile(quantiles) for x in (ours, other))
    assert float((a - b).abs().max()) < 0.01


@pytest.mark.parametrize("name", LEVELS)
def test_the_level_is_estimated_from_an_image(name):
    ideal = load_sample().ground_truth[None]
    recorded = LEVELS[name].recorded(ideal, generator_for(0, name))
    found = NoiseLevel.estimated(recorded)
    stated = LEVELS[name].deviation(recorded).mean()
    assert float(found.deviation(recorded).mean()) == pytest.approx(float(stated), rel=0.2)


def test_an_image_without_noise_or_without_content_has_none():
    flat = torch.full((1, 1, 64, 64), 0.5)
    assert not NoiseLevel.estimated(flat).deviation(flat).any()
    assert NoiseLevel.estimated(torch.zeros(1, 3, 64, 64)) == NoiseLevel()
    assert NoiseLevel.estimated(torch.rand(1, 1, 8, 8)) == NoiseLevel()


@pytest.mark.parametrize("wrong", [{"shot": -1.0}, {"read": float("nan")}, {"read": torch.tensor([-0.1])}])
def test_a_negative_level_is_refused(wrong):
    with pytest.raises(ValueError, match="noise: "):
        NoiseLevel(**wrong)


def test_what_is_no_level_is_refused():
    with pytest.raises(ValueError, match="electrons"):
        NoiseLevel.from_electrons(0)
    with pytest.raises(ValueError, match="read"):
        NoiseLevel.from_electrons(100, -2)
    with pytest.raises((ValueError, TypeError), match=r"light|values"):  # by type, where types are checked
        NoiseLevel(0.01, added_to="srgb")


@pytest.mark.parametrize("rises", [-0.9, 0.0, 3.0])
def test_shot_and_read_noise_are_the_nearest_that_are_not_negative(rises):
    """Noise that falls with brightness is read noise alone: SciPy's solver finds the same."""
    value = torch.linspace(0.1, 0.9, 12).double()
    variance = 1e-4 * (1 + rises * value)
    found, _ = _fitted("values", value, variance)
    design = torch.stack([value, torch.ones_like(value)], -1) / variance[:, None]
    (shot, read), _ = nnls(design.numpy(), torch.ones_like(value).numpy())
    assert (found.shot, found.read**2) == pytest.approx((shot, read), rel=1e-6, abs=1e-12)
