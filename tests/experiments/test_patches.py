"""Patches of rendered scenes: their rigs predict what they show, and errors name the folder."""

import shutil

import pytest
import torch

from arraygeom import (
    Camera,
    Epipolar,
    Pose,
    Rig,
    Sensor,
    intrinsics,
    rotation_from_vector,
    stack,
)
from arraygeom.fields.grid import FieldOnGrid
from experiments.__main__ import Experiments
from experiments.patches import PatchGrid, ScenePatches
from pat.cli.main import main
from pat.data import scene_folders
from pat.data.windows import reduced_depth
from pat.farm.backends import LayeredSettings
from pat.media.images import read_image
from pat.sensors import Clip, Resample
from pat.synthesis.check import CheckLimits

SMALL = PatchGrid(hw=(32, 48), grid=(2, 3), reduce=2)


def make_rig(width: int = 128) -> Rig:
    turned = rotation_from_vector(torch.tensor([0.005, 0.02, 0.01]).double())
    mono = Camera(
        K=intrinsics(130.0, (96, width)),
        cam_from_world=Pose.identity(),
        hw=(96, width),
        sensor=Sensor("mono"),
    )
    colour = Camera(
        K=intrinsics((100.0, 104.0), (80, 112)),
        cam_from_world=Pose(turned, torch.tensor([-0.1, 0.01, 0.0]).double()),
        hw=(80, 112),
    )
    return Rig({"mono": mono, "colour": colour}, depth=(2.0, 12.0))


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    """Three layered scenes of patterns; copy what you break."""
    root = tmp_path_factory.mktemp("data")
    renderer = LayeredSettings(layers=(4, 7), oversampling=1).renderer(make_rig(), CheckLimits())
    for seed in range(3):
        renderer(seed, root / "scenes" / f"{seed:06d}")
    return root


@pytest.fixture
def broken(rendered, tmp_path):
    shutil.copytree(rendered, tmp_path / "data")
    return tmp_path / "data"


def test_the_papers_windows_reach_from_edge_to_edge():
    corners = PatchGrid().corners((1536, 2048))
    assert len(corners) == PatchGrid().count == 49
    assert corners[0] == (0, 0)
    assert corners[-1] == (1536 - 128, 2048 - 384)
    assert PatchGrid.like_the_papers((1536, 2048)) == PatchGrid()
    with pytest.raises(ValueError, match=r"384x128 .*300x200"):
        PatchGrid().corners((200, 300))
    with pytest.raises(ValueError, match="cannot be reduced 3 times"):
        PatchGrid(reduce=3)


def test_points_of_the_whole_image_are_where_the_patches_cameras_project_them(rendered):
    data = ScenePatches(rendered, patches=SMALL, chains={})
    X = torch.tensor([[0.1, -0.2, 5.0], [-0.4, 0.3, 8.0]]).double()
    whole = make_rig()["mono"].project(X).x
    for i, (top, left) in enumerate(SMALL.corners((96, 128))):
        wanted = (whole - torch.tensor([left, top]).double() + 0.5) / 2 - 0.5
        torch.testing.assert_close(data[i].rig["mono"].project(X).x, wanted)
        assert data[i].images["mono"].shape == (3, 16, 24)


def test_reduced_depth_is_exact_on_planes_and_takes_sides_at_edges():
    plane = (1 / (0.2 + 0.001 * torch.arange(16.0))).expand(1, 8, 16).clone()
    wanted = 1 / (0.2 + 0.001 * ((torch.arange(4.0) + 0.5) * 4 - 0.5))
    torch.testing.assert_close(reduced_depth(plane, (2, 4))[0, 0], wanted)
    near = plane[0, 0, 5].item()
    plane[..., 6:] = 1.0
    found = reduced_depth(plane, (2, 4))[0, 0]
    assert found[1].item() in (pytest.approx(near), 1.0)
    torch.testing.assert_close(found[2:], torch.ones(2))


def test_patches_are_recorded_as_responses_say_and_anew_with_each_seed(rendered):
    data = ScenePatches(rendered, patches=SMALL, seed=3)
    assert len(data) == 18
    patch = data[7]
    assert list(patch.images) == ["mono", "colour"]
    assert patch.images["mono"].shape == (1, 16, 24)
    assert patch.images["colour"].shape[0] == patch.ground_truth.shape[0] == 3
    grey = (patch.ground_truth * torch.tensor([0.299, 0.587, 0.114])[:, None, None]).sum(0)
    assert (patch.images["mono"][0] - grey).abs().mean() < 0.06
    assert torch.equal(data[7].images["mono"], patch.images["mono"])
    other = ScenePatches(rendered, patches=SMALL, seed=4)[7]
    assert not torch.equal(other.images["mono"], patch.images["mono"])
    assert torch.equal(other.ground_truth, patch.ground_truth)
    with pytest.raises(IndexError):
        data[18]


def test_segments_of_patches_contain_the_true_points(rendered):
    data = ScenePatches(rendered, patches=SMALL)
    patches = [data[i] for i in range(len(data))]
    pair = stack([patch.rig for patch in patches]).pair("mono", "colour")
    where = FieldOnGrid.of(Epipolar(), pair)
    depth = torch.stack([patch.depth[8:9, 12] for patch in patches]).double()
    X = pair.cameras[0].unproject(torch.tensor([12.0, 8.0]).double().expand(len(patches), 1, 2), depth)
    found = where.at(torch.tensor([[12.0, 8.0]]))
    seen = pair.cameras[1].project(X).x[:, 0].float()
    inside = found.valid[:, 0] & pair.beta.contains(seen)
    along = found.fraction(seen[:, None])[:, 0]
    off = (found.at(along[:, None])[:, 0] - seen).norm(dim=-1)
    assert inside.sum() >= 4
    assert off[inside].max() < 0.01
    assert ((along > -0.01) & (along < 1.01))[inside].all()


def test_the_rig_follows_the_chains(rendered):
    data = ScenePatches(rendered, patches=SMALL, chains={"colour": [Resample(0.5), Clip()]})
    patch, plain = data[4], ScenePatches(rendered, patches=SMALL, chains={})[4]
    X = torch.tensor([0.05, 0.02, 4.0]).double()
    x, whole = (p.rig["colour"].project(X).x for p in (patch, plain))
    assert patch.images["colour"].shape[-2:] == patch.rig["colour"].hw
    (h, w), (h0, w0) = patch.rig["colour"].hw, plain.rig["colour"].hw
    torch.testing.assert_close(x, (whole + 0.5) * torch.tensor([w / w0, h / h0]).double() - 0.5)


def test_folders_without_whole_scenes_are_reported(broken, tmp_path):
    with pytest.raises(FileNotFoundError, match="no such folder"):
        scene_folders(tmp_path / "none")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="'pat render"):
        scene_folders(tmp_path / "empty")
    (broken / "scenes/000001/render.json").unlink()
    with pytest.raises(ValueError, match=r"000001: .*render.json"):
        ScenePatches(broken)


def test_scenes_that_cannot_be_read_are_reported(broken):
    file = broken / "scenes/000001/colour-0000.npz"
    file.write_bytes(file.read_bytes()[:500])
    data = ScenePatches(broken, patches=SMALL)
    assert data[0].ground_truth.shape == (3, 16, 24)
    with pytest.raises(ValueError, match=r"000001: .*'pat render'"):
        data[6]


def test_images_of_changing_size_are_reported(broken):
    shutil.rmtree(broken / "scenes/000002")
    LayeredSettings(oversampling=1).renderer(make_rig(160), CheckLimits())(2, broken / "scenes/000002")
    with pytest.raises(ValueError, match=r"000002: .*mono 160x96, .*mono 128x96"):
        ScenePatches(broken, patches=SMALL)[12]


def test_names_that_the_rig_lacks_are_reported(rendered):
    with pytest.raises(ValueError, match="no camera 'mno'; did you mean 'mono'"):
        ScenePatches(rendered, alpha="mno")
    with pytest.raises(ValueError, match="no camera 'color'; did you mean 'colour'"):
        ScenePatches(rendered, chains={"color": []})


def test_show_and_info_on_the_command_line(rendered, tmp_path, capsys, refusal):
    sensors = tmp_path / "sensors.yaml"
    chains = "mono: [{spectral: luminance}, clip, encode-srgb]", "colour: [{box-blur: 3}, clip, encode-srgb]"
    sensors.write_text("\n".join(chains))
    arguments = ["patches", str(rendered), "--sensors", str(sensors), "--out", str(tmp_path / "x.png")]
    main([*arguments, "--samples", "2"], group=Experiments)
    assert read_image(tmp_path / "x.png").std() > 0.1
    assert "147 patches of 3 scenes" in " ".join(capsys.readouterr().err.split())
    main(["data", "info", str(rendered)])
    assert "3 scenes of mono 128x96, colour 112x80" in capsys.readouterr().out
    sensors.write_text("mono: [{spectrl: luminance}]\n")
    assert "no step is called 'spectrl'; did you mean 'spectral'" in " ".join(refusal(*arguments).split())
