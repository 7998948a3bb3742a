"""Stacking, indexing, `to` and equality of every dataclass of tensors, and their one-line texts."""

import dataclasses

import pytest
import torch

from arraygeom import (
    Band,
    Camera,
    Distortion,
    Epipolar,
    LensView,
    Link,
    Pair,
    Pose,
    Positions,
    Rig,
    Segments,
    Sensor,
    View,
    intrinsics,
    sampling_locations,
    stack,
)
from arraygeom.batching import tensors_of
from arraygeom.checks import check_hw
from arraygeom.rectification import rectify
from arraygeom.runtime.text import UNSCALED
from tests.arraygeom.rigs import parallel_rig, random_rig

F64 = torch.float64


def lens(k: float) -> Distortion:
    return Distortion("brown-conrady", torch.tensor([k, 0, 0, 0], dtype=F64))


def each(seed: int) -> list:
    """One instance of every batched class."""
    rig = random_rig(seed)
    rig = rig.with_camera("beta", rig["beta"].replace(distortion=lens(0.01 * seed)))
    pair = rig.pair("alpha", "beta")
    straight = random_rig(seed).pair("alpha", "beta")
    link = Link(straight.fundamental, straight.homography)
    segments = sampling_locations(Epipolar(), straight, torch.rand(3, 2, dtype=F64) * 40)
    view = LensView(hw=(4, 6), K=intrinsics(3.0 + seed, (4, 6)), distortion=lens(0.1))
    return [
        View(hw=(4, 6)),
        view,
        rig["beta"],
        lens(0.1 * seed),
        rig["alpha"].cam_from_world,
        link,
        pair,
        rig,
        segments,
        segments.positions(5),
        dataclasses.replace(straight, link=link),
        rig.replace(links={("alpha", "beta"): link}),
    ]


PARTS = [type(value).__name__ for value in each(0)]


@pytest.mark.parametrize("i", range(1, len(PARTS)), ids=PARTS[1:])
def test_items_of_a_batch_are_those_stacked(i):
    items = [each(seed)[i] for seed in (1, 2, 3)]
    batch = stack(items)
    assert type(batch) is type(items[0])
    assert len(batch) == 3
    assert [batch[n] == item for n, item in enumerate(items)] == [True] * 3
    assert batch[-1] == items[2]
    assert batch[1:] == stack(items[1:])
    assert batch[torch.tensor([2, 0])] == stack([items[2], items[0]])
    assert list(batch) == items
    assert batch[0] != items[1]
    assert stack([batch, batch]).batch_shape == (2, 3, *items[0].batch_shape)


@pytest.mark.parametrize("i", range(len(PARTS)), ids=PARTS)
def test_to_moves_every_tensor_and_keeps_the_class_and_masks(i):
    value = each(1)[i]
    moved = value.to(torch.float32)
    assert type(moved) is type(value)
    assert {t.dtype for t, _ in tensors_of(moved)} <= {torch.float32, torch.bool}
    assert value == value.to(F64)
    assert (moved == value) is (not list(tensors_of(value)))
    if not isinstance(value, Rig):  # whose depths are checked, which takes values
        there = value.to("meta", torch.float32)
        assert {(t.device.type, t.dtype) for t, _ in tensors_of(there)} <= {
            ("meta", torch.float32),
            ("meta", torch.bool),
        }


def test_equality_is_of_classes_shapes_types_and_values():
    pose = random_rig(1)["alpha"].cam_from_world
    assert pose == Pose(pose.R.clone(), pose.t.clone())
    assert pose != Pose(pose.R, pose.t + 1e-9)
    assert pose != pose.to(torch.float32)
    assert Pose.identity() != Pose.identity(dtype=torch.float32)
    assert pose != stack([pose])
    assert pose != "pose"
    assert random_rig(1) == random_rig(1) != random_rig(2)
    assert random_rig(1).replace(name="other") != random_rig(1)
    assert random_rig(1).replace(depth=None) != random_rig(1)
    camera = random_rig(1)["alpha"]
    assert camera != LensView(hw=camera.hw, K=camera.K)
    assert camera.replace(distortion=lens(0.1)) != camera
    with pytest.raises(TypeError, match="unhashable"):
        hash(pose)


def test_what_is_not_computed_with_does_not_count():
    pair = random_rig(1).pair("alpha", "beta")
    pair.memo["widest"] = torch.zeros(1)
    assert pair == random_rig(1).pair("alpha", "beta")
    assert not stack([pair, pair]).memo


def test_tensors_without_batch_axes_are_shared():
    camera = stack([random_rig(1)["alpha"], random_rig(2)["alpha"]])
    rig = Rig({"a": camera, "b": random_rig(3)["beta"]}, depth=(1.0, 2.0))
    assert len(rig) == 2
    assert rig[1] == Rig({"a": random_rig(2)["alpha"], "b": random_rig(3)["beta"]}, depth=(1.0, 2.0))
    one = Rig({"a": random_rig(1)["alpha"].replace(K=camera.K[:1])})
    assert Rig({**one.cameras, "b": camera})[1]["a"].K.equal(camera.K[0])


def test_batches_that_share_a_tensor_stack():
    cameras = stack([random_rig(1)["alpha"], random_rig(2)["alpha"]])
    poses = [random_rig(seed)["alpha"].cam_from_world for seed in (3, 4, 5)]
    batches = [cameras.replace(cam_from_world=pose) for pose in poses]
    for several in (batches, batches[:2]):
        stacked = stack(several)
        assert stacked.batch_shape == (len(several), 2)
        assert [stacked[i, 1] == batch[1] for i, batch in enumerate(several)] == [True] * len(several)


def test_names_are_cameras_and_numbers_items():
    rig = stack([random_rig(1), random_rig(2)])
    assert rig["beta"][1] == rig[1]["beta"] == random_rig(2)["beta"]
    with pytest.raises(ValueError, match="'beta'"):
        rig["beto"]


def test_single_items_are_no_batch():
    rig = random_rig(1)
    for wrong in (
        lambda: rig[0],
        lambda: len(rig["alpha"]),
        lambda: list(rig["alpha"]),
        lambda: View(hw=(2, 2))[0],
    ):
        with pytest.raises(TypeError, match=r"arraygeom.stack"):
            wrong()
    assert all([rig, rig["alpha"], View(hw=(2, 2))])
    assert len(rig) == len(list(rig)) == len(rig.names)
    with pytest.raises(IndexError):
        stack([rig])[1]


def test_gradients_reach_stacked_items():
    pose = random_rig(1)["alpha"].cam_from_world
    R = pose.R.clone().requires_grad_()
    stack([pose, Pose(R, pose.t)])[1].R.sum().backward()
    assert R.grad.equal(torch.ones_like(R))


@pytest.mark.parametrize(
    ("items", "said"),
    [
        ([], "stack"),
        ([random_rig(1)["alpha"], random_rig(1)["beta"]], r"Camera.hw.*\(48, 64\)"),
        ([random_rig(1), random_rig(1).replace(depth=None)], "Rig.depth.*NoneType"),
        (
            [random_rig(1), Rig({"alpha": random_rig(1)["alpha"]}, (1, 2))],
            "Rig.cameras: ",
        ),
        (
            [lens(1), Distortion("kannala-brandt", torch.zeros(4, dtype=F64))],
            "brown-conrady.*kannala-brandt",
        ),
        (
            [lens(1), Distortion("brown-conrady", torch.zeros(5, dtype=F64))],
            "Distortion.coefficients: ",
        ),
        ([lens(1), random_rig(1)], "Distortion"),
    ],
)
def test_unlike_things_do_not_stack(items, said):
    with pytest.raises(ValueError, match=said):
        stack(items)


def test_labels_are_the_first_ones():
    one, other = random_rig(1).replace(name="one"), random_rig(1).replace(name="other")
    assert stack([one, other]).name == "one"


def test_a_rig_in_one_line():
    camera = Camera(K=intrinsics(999.0, (497, 741)), cam_from_world=Pose.identity(), hw=(497, 741))
    t = torch.tensor([-0.193, 0, 0], dtype=F64)
    colour = camera.replace(cam_from_world=Pose(camera.R, t), sensor=Sensor(response="rgb"))
    rig = Rig({"mono": camera, "colour": colour}, depth=(2, 5))
    assert repr(rig) == "Rig: mono 741x497 f=999, colour 741x497 f=999 rgb; baseline 19.3 cm; 2-5 m"
    assert repr(rig.replace(depth=(2, torch.inf))).endswith("2 m to infinity")
    assert repr(rig.scaled(1 / 0.193).replace(name=UNSCALED)).endswith("; baseline 1; 10.4-25.9 baselines")
    nir = colour.replace(
        sensor=Sensor(response=Band(850.0, 40.0)), distortion=lens(0.1), K=intrinsics(2.0, (497, 741))
    )
    three = rig.with_camera("nir", nir.replace(cam_from_world=Pose(camera.R, 3 * t)))
    assert repr(three) == (
        "Rig: mono 741x497 f=999, colour 741x497 f=999 rgb, nir 741x497 f=2 brown-conrady 850+-20 nm; "
        "baselines 19.3-57.9 cm; 2-5 m"
    )
    assert repr(stack([rig, rig])).startswith("Rig: batch of 2, mono 741x497 f=999")
    assert repr(Rig({"a": View(hw=(2, 3))})) == "Rig: a 3x2"


def test_everything_has_a_short_text():
    for value in [*each(1), *(stack([a, b]) for a, b in zip(each(1), each(2)))]:
        assert repr(value).startswith(f"{type(value).__name__}: ")
        assert len(repr(value)) < 200
        assert "tensor" not in repr(value)
    assert repr(random_rig(1)["alpha"].cam_from_world).startswith("Pose: rotation ")
    assert repr(lens(0.2)) == "Distortion: brown-conrady 0.2 0 0 0"
    s = Segments(torch.zeros(4, 2), torch.ones(4, 2) * 3, torch.tensor([True, True, True, False]))
    assert repr(s) == "Segments: batch of 4, 75 % valid, median length 4.2 px"
    assert repr(s.positions(7)) == "Positions: batch of 4, 7 samples each, 75 % valid"
    nothing = Segments(torch.zeros(0, 2), torch.zeros(0, 2), torch.zeros(0, dtype=torch.bool))
    assert repr(nothing) == "Segments: batch of 0, none valid"
    assert "0 % valid" in repr(Positions(torch.zeros(2, 3, 2), torch.zeros(2, 3, dtype=torch.bool)))


def test_notebooks_show_an_escaped_table():
    cameras = {"<b>": random_rig(1)["alpha"], "<script>alert(1)</script>": random_rig(1)["beta"]}
    html = Rig(cameras, depth=(1, 2), name="a & b")._repr_html_()
    assert "<script>" not in html
    assert "<b>" not in html
    assert "&lt;b&gt;" in html
    assert "a &amp; b; baseline" in html
    assert html.count("<tr>") == 3


def test_a_pair_says_what_relates_it():
    pair = random_rig(1).pair("alpha", "beta")
    assert repr(pair).startswith("Pair: alpha 64x48 f=")
    linked = Pair(View(hw=(2, 3)), View(hw=(4, 5)), None, Link(torch.eye(3)))
    assert repr(linked) == "Pair: alpha 3x2, beta 5x4; link by F"


def test_a_pair_of_unknown_scale_says_so():
    """Its lengths are not said to be metres."""
    rig = parallel_rig(999.0, (497, 741), {"a": (), "b": (1.0,)}, (2, 5))
    pair = rig.replace(name=UNSCALED).pair("a", "b")
    assert repr(pair).endswith("; baseline 1; 2-5 baselines")
    assert repr(rectify(pair).pair).endswith("; baseline 1; 2-5 baselines")


def test_a_size_in_a_tensor_is_refused():
    """A size is two integers; a tensor would make the camera a batch."""
    with pytest.raises(ValueError, match="hw"):
        check_hw(torch.tensor([240, 320]))
