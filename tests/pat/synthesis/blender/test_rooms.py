"""Rendered pairs to learn from: what they state of their disparity is so, from both sides."""

import torch
from skimage.data import data_dir

from arraygeom import sample
from experiments.completion import rooms
from experiments.completion.pairs import HW, MOST


def photographs(folder):
    files = [folder / f"{name}.png" for name in ("astronaut", "coffee")]
    for file in files:
        file.symlink_to(f"{data_dir}/{file.name}")
    return files


def test_a_room_has_the_disparity_that_it_is_rendered_with(tmp_path, worker, monkeypatch):
    """Right shows what left does, as far to the left as is stated; in the mirror image too."""
    monkeypatch.setattr(rooms, "render", worker.render)
    files = photographs(tmp_path)
    pairs = [rooms.room_pair(files, seed) for seed in (8, 9)]
    for pair in pairs:
        value, valid = pair.disparity
        assert pair.left.shape == pair.right.shape == (3, *HW)
        assert bool(valid.all())
        assert 0 < float(value.min()) < 0.5 * float(value.max()) < 0.5 * MOST
        y, x = torch.meshgrid(*(torch.arange(float(n)) for n in HW), indexing="ij")
        seen, on = sample(pair.right[None], torch.stack([x - value, y], -1)[None])
        apart = (seen[0] - pair.left).abs().amax(0)
        off = (pair.right - pair.left).abs().amax(0)
        assert float((apart < 0.06)[on[0]].float().mean()) > 0.85
        assert float((off < 0.06).float().mean()) < 0.75
    assert torch.equal(pairs[0].left.flip(-1), pairs[1].right)


def test_disparities_are_within_the_rigs_depths():
    rig = rooms.rectified_rig(500.0, 60.0, 10.0)
    pair = rig.pair("left", "right")
    at = torch.tensor([200.0, 100.0], dtype=torch.float64)
    X = rig["left"].unproject(at, rig.depth[0].double())
    torch.testing.assert_close(at - rig["right"].project(X).x, at.new_tensor([60.0, 0.0]))
    assert pair.calibrated
