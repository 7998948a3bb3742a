"""The networks that remove noise."""

import pytest
import torch

from pat.fusion.classical import non_local_means
from pat.media.colour import luminance
from pat.networks.denoiser import DenoiserConfig, LowLightNetwork
from pat.networks.weights import DENOISER, SHIPPED, STEP, load_denoiser, load_weights, save_weights
from pat.sensors import NoiseLevel, generator_for
from pat.support.tensor_files import read_tensors, write_tensors
from tests.pat.layered_array import load_sample


def psnr(image, ideal):
    return -10 * float((image.clamp(0, 1) - ideal).square().mean().log10())


def drawn(*shape):
    return torch.rand(shape, generator=torch.Generator().manual_seed(0))


def test_without_noise_images_stay_as_they_are():
    network, image = load_denoiser(), drawn(2, 3, 37, 50)
    assert torch.equal(network.colour(image, 0 * image), image)
    assert torch.equal(network.band(image[:, :1], 0 * image[:, :1]), image[:, :1])


@pytest.mark.parametrize("electrons", [200, 50])
def test_a_band_is_better_than_after_non_local_means(electrons):
    ideal, recorded, ours = denoised("band", electrons)
    rival = non_local_means(recorded[0], float((recorded - ideal).std()))[None]
    assert psnr(ours, ideal) > psnr(rival, ideal) + 0.5


@pytest.mark.parametrize(("electrons", "gain"), [(200, 2.5), (50, 6.0)])
def test_colours_lose_noise(electrons, gain):
    """In spite of thin lines of equal brightness, which are lost among the noise."""
    ideal, recorded, ours = denoised("colour", electrons)
    assert psnr(ours, ideal) > psnr(recorded, ideal) + gain


def denoised(part, electrons):
    """A part of the sample scene, as recorded, and denoised."""
    ideal = load_sample().ground_truth[None, :, :256, :320]
    ideal = luminance(ideal) if part == "band" else ideal
    level = NoiseLevel.from_electrons(electrons, 2)
    recorded = level.recorded(ideal, generator_for(0, part, electrons))
    ours = getattr(load_denoiser(), part)(level.unbiased(recorded), level.deviation(recorded))
    return ideal, recorded, ours


def test_the_shipped_network_is_small_and_described():
    assert DENOISER.stat().st_size < 5e6
    assert DENOISER.with_suffix(".md").is_file()


def test_weights_in_bytes_are_a_quarter_as_long_and_off_by_half_a_step_at_most(tmp_path):
    network = LowLightNetwork(DenoiserConfig((16, 16, 16), blocks=1))
    save_weights(network, tmp_path / "whole.safetensors")
    save_weights(network, tmp_path / "bytes.safetensors", in_bytes=True)
    again = load_denoiser(tmp_path / "bytes.safetensors").state_dict()
    for name, tensor in network.state_dict().items():
        most = tensor.abs().amax(tuple(range(1, tensor.dim())), keepdim=True) if tensor.dim() > 1 else 0
        assert ((again[name] - tensor).abs() <= most / 254 * 1.001).all()
    whole, of_bytes = ((tmp_path / f"{name}.safetensors").stat().st_size for name in ("whole", "bytes"))
    assert of_bytes < 0.4 * whole


def test_steps_that_do_not_fit_are_refused(tmp_path):
    network = LowLightNetwork(DenoiserConfig((4, 4, 4), blocks=1))
    save_weights(network, tmp_path / "w.safetensors", in_bytes=True)
    tensors, metadata = read_tensors(tmp_path / "w.safetensors")
    name = next(name for name in tensors if name.endswith(STEP))
    write_tensors(tmp_path / "w.safetensors", tensors | {name: tensors[name].flatten()}, metadata)
    with pytest.raises(ValueError, match=r"w\.safetensors: the steps of "):
        load_denoiser(tmp_path / "w.safetensors")


def test_written_and_read_back(tmp_path):
    narrow = LowLightNetwork(DenoiserConfig((4, 4, 4), blocks=1))
    save_weights(narrow, tmp_path / "w.safetensors")
    again = load_denoiser(tmp_path / "w.safetensors")
    assert again.config == narrow.config
    assert all(torch.equal(v, again.state_dict()[k]) for k, v in narrow.state_dict().items())
    with pytest.raises(ValueError, match="weights"):
        load_weights(tmp_path / "w.safetensors")
    with pytest.raises(ValueError, match="weights"):
        load_denoiser(SHIPPED / "mono-colour.safetensors")
