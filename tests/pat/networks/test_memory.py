"""Peak memory with several betas, in processes of their own: it is as counted, and hardly grows with them."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from arraygeom.runtime.chunks import Tile
from pat.fusion.inputs import frame_inputs
from pat.fusion.tiles import fuse_tile, working_memory
from pat.fusion.views import Views
from pat.matching.inputs import BetaMatches, Colours, Comparison, Matches
from pat.matching.multiview import agreed
from pat.networks.weights import load_weights
from pat.support.memory import give_back, limited, peak_memory, resident
from tests.arraygeom.rigs import parallel_rig

RESETS_PEAK = Path("/proc/self/clear_refs").exists()
REPEATS = 2
SIDE, TILE = 1536, (256, 1280, 256, 1280)


def frame_of(side, betas):
    """A frame of noise, its betas beside alpha by as many centimetres."""
    places = {"mono": (), **{f"colour{i}": (i / 100,) for i in range(1, betas + 1)}}
    rig = parallel_rig(float(side), (side, side), places, (0.03, 20.0))
    images = {name: torch.rand(1 if name == "mono" else 3, side, side) for name in rig.names}
    network = load_weights("mono-colour")
    return network, frame_inputs(network, Views.of(rig, images, alpha="mono"))


def found_in(inputs):
    """Matches as they might be found; fills are shared."""
    (h, w), n = inputs.hw, len(inputs.betas)
    fills = torch.rand(1, 1, 3, h, w)
    made = [
        BetaMatches(
            5 * torch.rand(1, 1, h, w),
            torch.rand(1, 3, h // 2, w // 2),
            Comparison.from_images(inputs.alpha, inputs.betas[i].image),
            colours=Colours(torch.rand(1, 3, h, w), *torch.rand(2, 1, 1, h, w), fills),
        )
        for i in range(n)
    ]
    return Matches(tuple(made))


def growth(work):
    """Return the bytes by which the peak exceeds the process's memory; the least of several runs after the
    first."""
    least = float("inf")
    for i in range(REPEATS + 1):
        give_back()
        before = resident()
        Path("/proc/self/clear_refs").write_text("5")
        with limited(1.0):  # what is freed goes back at once
            work()
        least = min(least, peak_memory() - before) if i else least
    return least


def bytes_to_agree(betas):
    """For each pixel."""
    inputs = frame_of(800, betas)[1].inputs
    found = found_in(inputs)
    return growth(lambda: agreed(inputs, found)) / inputs.alpha.numel()


def bytes_of_a_tile(betas):
    """Over those that are counted."""
    network, frame = frame_of(SIDE, betas)
    tile, matches = Tile(TILE, TILE), found_in(frame.inputs)
    return growth(lambda: fuse_tile(network, frame, matches, tile)) / working_memory(
        network, frame.inputs, tile
    )


MEASURED = {
    "agree": (bytes_to_agree, 3),
    "tile of 1": (bytes_of_a_tile, 1),
    "tile of 3": (bytes_of_a_tile, 3),
}


@pytest.fixture(scope="module")
def measured():
    """In a process of their own."""
    if not RESETS_PEAK:
        pytest.skip("peak memory is read as Linux tells it")
    command = [sys.executable, "-m", "tests.pat.networks.test_memory"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=Path(__file__).parents[3])
    return json.loads(done.stdout.splitlines()[-1])


def test_agreement_takes_little_more_than_its_result(measured):
    """Disparity and facts, 7 bytes for each beta, and intermediate results in strips."""
    assert measured["agree"] < 220


@pytest.mark.parametrize("betas", [1, 3])
def test_a_tile_takes_what_is_counted(betas, measured):
    """Not more, or a limit is exceeded, and not much less, or tiles are small for nothing. Some more if what
    is freed goes back late."""
    assert 0.55 < measured[f"tile of {betas}"] < 1.25


if __name__ == "__main__":
    with torch.no_grad():
        torch.set_num_threads(1)
        print(json.dumps({what: of(betas) for what, (of, betas) in MEASURED.items()}))
