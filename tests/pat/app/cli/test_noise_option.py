"""Values of --noise."""

import pytest

from pat.app.cli.options import noise_of, numbers_by_name
from pat.sensors import NoiseLevel


def test_levels_by_camera_or_estimated():
    assert noise_of([]) is None
    assert noise_of([], by_default=True) == "auto"
    assert noise_of(["none"], by_default=True) is None
    assert noise_of(["estimate"]) == "estimate"
    levels = {"mono": NoiseLevel.from_electrons(200, 2), "colour": NoiseLevel.from_electrons(50)}
    assert noise_of(["mono=200,2", "colour=50"]) == levels


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["mono"], "--noise: .*'mono'"),
        (["none", "mono=200"], "--noise: .*none, mono=200"),
        (["mono=dark"], "--noise: .*'mono=dark'"),
        (["=200"], "--noise: .*'=200'"),
        (["mono=200,2,1"], "--noise: 'mono=200,2,1'"),
        (["mono=-200"], "electrons .*-200"),
        (["mono=0.02"], "electrons .*0.02"),
        (["mono=200,-2"], "read .*-2"),
        (["mono=200", "mono=50"], "--noise: 'mono'"),
    ],
)
def test_what_is_no_level_is_named(given, said):
    with pytest.raises(ValueError, match=said):
        noise_of(given)


def test_a_number_without_a_name_is_refused():
    with pytest.raises(ValueError, match="'=800'"):
        numbers_by_name(["=800"], "--focal")
