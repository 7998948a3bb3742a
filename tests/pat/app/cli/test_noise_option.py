"""Values of --noise."""

import pytest

from pat.app.cli.options import noise_of
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
        (["mono"], "neither estimate nor none nor NAME=ELECTRONS"),
        (["none", "mono=200"], "give estimate or none alone"),
        (["mono=dark"], "neither estimate nor none nor NAME=ELECTRONS"),
        (["mono=200,2,1"], "has 3 numbers"),
        (["mono=-200"], "electrons at white must be 1 or more"),
        (["mono=0.02"], "not a standard deviation"),
        (["mono=200,-2"], "read must be 0 or more, got -2: "),
        (["mono=200", "mono=50"], "given twice"),
    ],
)
def test_what_is_no_level_is_named(given, said):
    with pytest.raises(ValueError, match=said):
        noise_of(given)
