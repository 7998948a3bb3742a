"""A rig that is only roughly right is healed by its images, and the healed one written beside."""

import pytest
import torch
from torch.nn.functional import avg_pool2d

from arraygeom import Pose, Rig, Sensor, rotation_from_vector
from pat.app.healing import checked_rig
from pat.app.sample_array import load_sample
from pat.fusion.views import ViewFiles
from pat.media.images import read_image, write_image
from pat.support.metrics import score
from tests.pat.commands import images, pat


@pytest.fixture(scope="module")
def material(tmp_path_factory):
    """The sample array at half its size, a rig as with a ruler, both in files, and the ground truth."""
    folder, sample = tmp_path_factory.mktemp("healing"), load_sample()
    rig = sample.rig.resize("mono", (200, 320)).resize("colour", (180, 280))
    for name, image in sample.images.items():
        write_image(folder / f"{name}.png", avg_pool2d(image, 2))
    camera = rig["colour"]
    tilted = rotation_from_vector(torch.tensor([0.04, 0.0, 0.03], dtype=torch.float64)) @ camera.R
    rough = camera.replace(
        cam_from_world=Pose(tilted, camera.t), K=camera.K * camera.K.new_tensor([[1.03], [1.03], [1]])
    )
    rig.save(folder / "right.yaml")
    rig.with_camera("colour", rough).save(folder / "rough.yaml")
    return folder, avg_pool2d(sample.ground_truth, 2)


def fused(folder, rig, out):
    files = images(folder, "mono", "colour")
    how = "--network mono-colour --extras none"
    pat(f"fuse {folder / rig} --alpha mono {files} {how} -o {folder / out}")
    return read_image(folder / out / "fused.png")


def test_a_frame_heals_its_own_rig_and_says_so(material, capsys):
    """A rig measured with a ruler is corrected by the frame's own matches."""
    folder, ground_truth = material
    before = (folder / "rough.yaml").read_text()
    right, healed = (fused(folder, f"{name}.yaml", name) for name in ("right", "rough"))
    said = " ".join(capsys.readouterr().err.split())
    assert "healed" in said
    assert score(healed, ground_truth).psnr > score(right, ground_truth).psnr - 0.5
    assert (folder / "rough.yaml").read_text() == before
    written = Rig.load(folder / "rough" / "healed_rig.yaml")
    assert written.names == ("mono", "colour")
    assert not (folder / "right" / "healed_rig.yaml").exists()


def test_a_stated_depth_range_is_not_replaced_without_a_word(material, monkeypatch):
    folder, _ = material
    rough = Rig.load(folder / "rough.yaml")
    views = ViewFiles(rough, {name: folder / f"{name}.png" for name in rough.names}, alpha="mono")
    for depth, replaced in (([*map(float, rough.depth)], False), ([0.5, 40.0], True)):
        monkeypatch.setattr("pat.app.healing._depth_range", lambda *_, depth=depth: tuple(depth))
        assert ("stated depth range" in checked_rig(views, heal=True).text) == replaced


def test_a_rig_where_the_healed_one_would_go_is_refused_and_kept(material, capsys):
    folder, _ = material
    given = folder / "same" / "healed_rig.yaml"
    given.parent.mkdir()
    given.write_text((folder / "rough.yaml").read_text())
    before = given.read_text()
    with pytest.raises(SystemExit):
        fused(folder, "same/healed_rig.yaml", "same")
    assert given.read_text() == before
    assert "healed_rig.yaml" in capsys.readouterr().err


def test_a_healed_rig_is_of_the_files_as_they_were_recorded(material):
    """Raw files are developed by it in many frames and by the next command."""
    folder, _ = material
    rig = Rig.load(folder / "rough.yaml")
    rig = rig.with_camera("colour", rig["colour"].replace(sensor=Sensor("rgb", bits=8, black_level=2.0)))
    files = {name: folder / f"{name}.png" for name in rig.names}
    healed = checked_rig(ViewFiles(rig, files, alpha="mono"), heal=True)
    assert {name: healed.rig[name].sensor for name in files} == {name: rig[name].sensor for name in files}


def test_a_right_rig_is_left_as_it_is(material):
    folder, _ = material
    views = ViewFiles(
        Rig.load(folder / "right.yaml"), {n: folder / f"{n}.png" for n in ("mono", "colour")}, alpha="mono"
    )
    assert checked_rig(views, heal=True) is None


def test_a_refusal_of_refine_has_a_status_of_its_own_and_says_what_to_do(material, capsys):
    folder, _ = material
    files = images(folder, "mono", "colour")
    with pytest.raises(SystemExit) as stop:
        pat(f"rig refine {folder / 'rough.yaml'} {files} -o {folder / 'x.yaml'}")
    assert stop.value.code == 4
    said = " ".join(capsys.readouterr().err.split())
    assert f"or fuse without a rig: `pat fuse {folder / 'colour.png'} {folder / 'mono.png'}`" in said
    assert not (folder / "x.yaml").exists()
