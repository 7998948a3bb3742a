"""Real and rendered images of rigs: what the benchmarks measure at length."""

import numpy as np
import pytest
import torch

from arraygeom import Rig
from calib.boards.detect import collect_folder
from calib.boards.rig import calibrate
from calib.boards.target import parse_board
from calib.images.doctor import diagnose, diagnose_matches
from calib.images.matches import match_cameras, seen_depths
from calib.images.refinement import refine_matches
from tests.benchmarks.bench_names import MISTAKES
from tests.calib.board_scenes import errors_of, pose_errors
from tests.calib.real import bumblebee, syntim
from tests.calib.rendered import BOARD, photograph
from tests.calib.simulated import worse
from tests.pat.lab.synthesis.scenes import needs_blender


@pytest.mark.slow
@pytest.mark.parametrize("made", ["half-size", "mirrored", "swapped", "inverted", "lens ignored"])
def test_mistakes_with_a_stereo_head_are_named(shared_data, made):
    (pair, *_) = bumblebee(shared_data, ("chair01",))
    kind, make, _ = MISTAKES[made]
    rig = Rig({name: pair.rig[name] for name in pair.images})
    found = diagnose(make(rig, np.random.default_rng(3)), pair.images)
    assert kind in (found.named.kind, *(h.kind for h in found.equal)), found.verdict


@pytest.mark.slow
def test_the_rig_of_another_experiment_is_found_out(shared_data):
    """The published poses of SYNTIM's BatSynt fit its images only when inverted."""
    (pair,) = syntim(shared_data, ("BatSynt",))
    found = diagnose(pair.rig, pair.images)
    assert found.named.kind == "pose inverted"
    assert found.after.misfit < 0.05 * found.before.misfit


@pytest.mark.slow
def test_a_published_rig_that_does_not_fit_is_given_no_name(shared_data):
    """A pixel's shift brings SYNTIM's SmRub nearer to its images, but does not explain them to noise."""
    (pair,) = syntim(shared_data, ("SmRub",))
    rig, matches = Rig({name: pair.rig[name] for name in pair.images}), match_cameras(pair.images)
    rig = rig.replace(depth=seen_depths(rig.pair(*rig.names), matches[rig.names]))
    found = diagnose_matches(rig, {name: camera.hw for name, camera in rig.cameras.items()}, matches)
    assert not found.healthy
    assert found.named.kind == "nothing", found.verdict
    assert "one-pixel shift" in [h.kind for h in found.equal]


@pytest.mark.slow
@pytest.mark.parametrize(
    "source", [lambda data: syntim(data, ("BatInria",)), lambda data: bumblebee(data, ("chair02",))]
)
def test_real_rigs_return(shared_data, source):
    (pair, *_) = source(shared_data)
    matches = match_cameras(pair.images)
    rig = Rig({name: pair.rig[name] for name in pair.images})
    found = refine_matches(worse(rig, torch.Generator().manual_seed(0)), [matches], force=True)
    assert found.accepted
    assert found.held_out[1].median < 0.3 < 1 < found.held_out[0].median
    assert diagnose_matches(found.rig, {n: c.hw for n, c in rig.cameras.items()}, matches).before.misfit < 0.2


@pytest.mark.slow
def test_rendered_photographs_of_four_cameras(tmp_path):
    """Twelve boards, found, fitted and compared with the rig that took them (ten minutes of one core)."""
    needs_blender()
    photograph(tmp_path)
    true = Rig.load(tmp_path / "true.yaml")
    views = collect_folder(tmp_path, parse_board(BOARD)).views
    fit = calibrate({name: views[name] for name in true.names}, parse_board(BOARD)).fit
    degrees, metres = pose_errors(fit, true)
    assert degrees < 0.02
    assert metres < 0.2e-3
    assert np.abs(errors_of(fit, true) / np.sqrt(fit.covariance.diagonal())).max() < 3
