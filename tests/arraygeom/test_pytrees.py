"""Rigs in torch's own containers: pytrees, files of weights, DataLoaders; and as containers of names."""

import pickle

import pytest
import torch
from torch.utils import _pytree as pytree
from torch.utils.data import DataLoader

from arraygeom import Band, Camera, Epipolar, LensView, Link, Pair, Pose, Rig, Sensor, View, stack
from tests.arraygeom.rigs import BARREL, random_rig

PLAIN = random_rig(1)
BENT = PLAIN.with_camera("alpha", PLAIN["alpha"].replace(distortion=BARREL, sensor=Sensor("mono", bits=12)))
LINKED = Rig(
    {
        "a": View(hw=(4, 6), sensor=Sensor(Band(550.0, 80.0))),
        "b": LensView(hw=(4, 6), K=torch.eye(3), distortion=BARREL),
    },
    links={("a", "b"): Link(torch.eye(3))},
    name="two",
)
RIGS = [PLAIN, BENT, LINKED, stack([PLAIN, PLAIN])]


@pytest.mark.parametrize("rig", RIGS, ids=["plain", "bent", "linked", "batch"])
def test_rigs_are_pytrees(rig):
    leaves, spec = pytree.tree_flatten(rig)
    assert all(isinstance(leaf, torch.Tensor) for leaf in leaves)
    assert pytree.tree_unflatten(leaves, spec) == rig
    assert pytree.tree_flatten(rig.replace())[1] == spec
    doubled = pytree.tree_map(lambda t: 2 * t, rig)
    assert [torch.equal(b, 2 * a) for a, b in zip(leaves, pytree.tree_leaves(doubled))] == [True] * len(
        leaves
    )
    assert pytree.tree_map(lambda t: None, rig).names == rig.names
    paths = [pytree.keystr(path) for path, _ in pytree.tree_flatten_with_path(rig)[0]]
    assert len(set(paths)) == len(leaves)


def test_vmap_takes_and_gives_them():
    poses = [random_rig(seed)["alpha"].cam_from_world for seed in range(3)]
    found = torch.vmap(lambda pose: pose.inverse() @ pose)(stack(poses))
    assert isinstance(found, Pose)
    torch.testing.assert_close(found.R, torch.eye(3, dtype=torch.float64).expand(3, 3, 3))


def test_vmap_takes_a_batch_with_one_depth_range():
    batch = Rig(stack([random_rig(seed) for seed in range(3)]).cameras, depth=(1, 8))
    found = torch.vmap(lambda rig: Epipolar()(rig.pair("alpha", "beta"), torch.ones(1, 2)).start)(batch)
    wanted = [Epipolar()(rig.pair("alpha", "beta"), torch.ones(1, 2)).start for rig in batch]
    torch.testing.assert_close(found, torch.stack(wanted))


def test_gradients_by_a_whole_camera():
    camera, X = PLAIN["alpha"], torch.tensor([0.1, 0.2, 3.0], dtype=torch.float64)
    slopes = torch.func.grad(lambda c: c.project(X).x.sum())(camera)
    assert isinstance(slopes, Camera)
    assert slopes.hw == camera.hw
    assert slopes.K[0, 2] == 1


def test_a_pair_made_anew_has_a_memo_of_its_own():
    pair = PLAIN.pair("alpha", "beta")
    pair.memo["widest"] = torch.zeros(1)
    again = pytree.tree_map(lambda t: t, pair)
    assert isinstance(again, Pair)
    assert again.memo == {}
    assert Epipolar()(again, torch.zeros(1, 2)).valid.shape == (1,)


@pytest.mark.parametrize("rig", RIGS, ids=["plain", "bent", "linked", "batch"])
def test_rigs_are_in_files_of_weights(rig, tmp_path):
    torch.save({"rig": rig, "weights": torch.ones(2)}, tmp_path / "w.pt")
    assert torch.load(tmp_path / "w.pt", weights_only=True)["rig"] == rig
    assert pickle.loads(pickle.dumps(rig)) == rig


def test_a_loader_stacks_rigs():
    rigs = [random_rig(seed) for seed in range(4)]
    data = [{"rig": rig, "x": torch.ones(2) * i} for i, rig in enumerate(rigs)]
    batches = list(DataLoader(data, batch_size=2))
    assert [b["rig"] for b in batches] == [stack(rigs[:2]), stack(rigs[2:])]


def test_a_rig_holds_names():
    assert "alpha" in PLAIN
    assert "gamma" not in PLAIN
    assert list(PLAIN) == ["alpha", "beta"] == list(dict.fromkeys(PLAIN))
    assert list(stack([PLAIN, BENT.replace(cameras=PLAIN.cameras)])) == [PLAIN, PLAIN]
