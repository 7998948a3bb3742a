"""align: recorded values at alpha's pixels, any type, through lenses, rotations; files; what is refused."""

from dataclasses import replace

import numpy as np
import pytest
import tifffile
import torch

from arraygeom import (
    Band,
    Camera,
    Curved,
    Distortion,
    Epipolar,
    Moved,
    Pose,
    Rig,
    Sensor,
    View,
    Widened,
    intrinsics,
    sample,
)
from arraygeom.undistortion import recorded_pixels, straight_pixels
from pat import FuseSettings, align
from pat.app.aligned_files import RecordedFiles, save_aligned, write_bands
from pat.app.aligned_page import aligned_page, ndvi, shown_layers
from pat.app.report import Facts
from pat.fusion.align import OUTSIDE, SEEN, filled, resampled_values
from pat.fusion.steps import without_lenses
from pat.matching.inputs import Inputs, Matches
from pat.matching.match import match
from pat.media.images import read_image, read_recorded
from pat.networks.configs import PATConfig
from pat.networks.paper import PAT
from tests.arraygeom.rigs import parallel_rig

HW = (96, 160)
DEPTH = 4.4
LENS = Distortion("brown-conrady", torch.tensor([-0.12, 0.03, 1e-3, -1e-3], dtype=torch.float64))


def textured(x: torch.Tensor) -> torch.Tensor:
    """A band-limited pattern on the plane z = DEPTH, at points (*n, 2) of it."""
    phases = torch.rand(24, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    waves = (phases[:, :2] - 0.5) * 18
    return 0.5 + 0.06 * (x @ waves.T + 6.3 * phases[:, 2]).sin().sum(-1)


def recorded_by(camera: Camera) -> torch.Tensor:
    """The image (1, H, W) of a camera before the plane."""
    h, w = camera.hw
    y, x = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
    rays, _ = camera.rays(torch.stack([x, y], -1).double())
    rays = rays @ camera.R.double()
    t = (DEPTH - camera.centre[2]) / rays[..., 2]
    return textured((camera.centre + t[..., None] * rays)[..., :2])[None].float().clamp(0, 1)


def array(lens: Distortion | None = None, turns: int = 0) -> tuple[Rig, dict[str, torch.Tensor]]:
    rig = parallel_rig(150.0, HW, {"mono": (), "nir": (0.15,)}, (2.0, 20.0), distortion=lens)
    rig = rig.with_camera("nir", rig["nir"].replace(sensor=Sensor(response=Band(840.0, 40.0))))
    images = {name: recorded_by(rig[name]) for name in rig.names}
    if turns:
        rig, images["nir"] = rig.rot90("nir", turns), images["nir"].rot90(turns, (-2, -1))
    return rig, images


@pytest.fixture(scope="module")
def found():
    """The array, aligned."""
    rig, images = array()
    return align(images, rig, alpha="mono", settings=FuseSettings(align=False))


@pytest.mark.parametrize("count", [1, 3])
def test_fine_texture_and_short_segments_are_no_reason_for_doubt(count):
    """Matches are more distinct than those to which certainty was fitted, and are right."""
    alpha = Camera(K=intrinsics(150.0, HW), cam_from_world=Pose.identity(), hw=HW)
    offsets = torch.tensor([[-0.15, 0, 0], [0.15, 0, 0], [0, -0.15, 0]], dtype=torch.float64)[:count]
    betas = [alpha.replace(cam_from_world=Pose(alpha.R, t)) for t in offsets]
    rig = Rig({"green": alpha} | {f"band{i}": beta for i, beta in enumerate(betas)}, depth=(3.5, 6.0))
    aligned = align({name: recorded_by(rig[name]) for name in rig.names}, rig, alpha="green")
    for view in list(aligned.values())[1:]:
        inside = view.visibility != OUTSIDE
        assert view.confidence[inside].mean() > 0.8


def in_order(pair, x):
    return Epipolar()(pair, x).positions(64)


@pytest.mark.parametrize(
    ("lens", "turns", "field"),
    [(None, 0, None), (LENS, 0, None), (None, 1, None), (LENS, 0, in_order), (LENS, 1, Curved())],
)
def test_positions_are_of_the_recorded_image(lens, turns, field):
    """Also in images that are not undistorted: betas are distorted once."""
    rig, images = array(lens, turns)
    found = align(images, rig, alpha="mono", settings=FuseSettings(align=False, field=field))
    view = found["nir"]
    y, x = np.mgrid[: HW[0], : HW[1]]
    pixels = torch.from_numpy(np.stack([x, y], -1).astype(float))
    X = rig["mono"].unproject(pixels, torch.full(HW, DEPTH).double())
    expected = rig["nir"].project(X).x.numpy()
    inner = (slice(12, -12), slice(30, -12))
    off = np.linalg.norm(view.positions - expected, axis=-1)[inner]
    assert np.nanmedian(off) < 0.15
    assert view.valid[inner].mean() > 0.8
    assert np.abs(view.values[0] - images["mono"][0].numpy())[inner][view.valid[inner]].mean() < 0.02
    assert np.nanmedian(np.abs(found.depth[inner] - DEPTH)) < 0.1


@pytest.mark.parametrize("lens", [None, LENS])
def test_points_that_move_may_do_so_within_a_band(lens):
    """Depth is that at the positions when beta records, through lenses too."""
    rig, images = array(lens)
    step = torch.stack([torch.full(HW, 4.0), torch.full(HW, 1.0)])
    within, around = Widened(Moved(Epipolar(), step), along=2.0), Moved(Widened(Epipolar(), along=2.0), step)
    one, other = (
        align(images, rig, alpha="mono", settings=FuseSettings(align=False, field=field))
        for field in (within, around)
    )
    assert np.array_equal(one.depth, other.depth, equal_nan=True)
    assert np.array_equal(one["nir"].positions, other["nir"].positions, equal_nan=True)


@pytest.mark.parametrize("lens", [None, LENS])
def test_positions_are_those_that_were_chosen(lens):
    rig, images = array(lens, 0)

    def farther(inputs):
        (found,) = match(inputs).betas
        return Matches((replace(found, chosen=found.chosen + 4),))

    found, moved = (
        align(images, rig, alpha="mono", settings=FuseSettings(align=False), matcher=matcher)["nir"].positions
        for matcher in (match, farther)
    )
    assert np.nanmedian(np.linalg.norm(moved - found, axis=-1)) == pytest.approx(4, abs=0.2)


@pytest.mark.parametrize(
    ("interpolation", "kind"), [("nearest", "nearest"), ("bilinear", "bilinear"), ("cubic", "bicubic")]
)
def test_values_are_samples_of_what_was_recorded(interpolation, kind):
    rig, images = array()
    counts = np.rint(20000 + 20000 * images["nir"].numpy()).astype(np.uint16)
    for recorded in (counts, counts.astype(np.float32)):
        own = {"mono": images["mono"], "nir": recorded}
        found = align(
            images,
            rig,
            alpha="mono",
            settings=FuseSettings(align=False),
            recorded=own,
            interpolation=interpolation,
        )
        view = found["nir"]
        assert view.values.dtype == recorded.dtype
        where = torch.from_numpy(np.nan_to_num(view.positions)).double()[None]
        values = torch.from_numpy(recorded.astype(np.float64))[None]
        taken = sample(values, where, interpolation=kind).values[0].numpy()
        error = np.abs(view.values.astype(float) - taken)[:, view.valid]
        assert error.max() <= (0.5 if recorded.dtype == np.uint16 else 1e-6 * 40000)
        if interpolation == "nearest":
            assert np.isin(view.values[:, view.valid], recorded).all()


@pytest.mark.parametrize("kind", [np.int64, np.uint64, np.float32, np.bool_])
def test_nearest_values_are_those_recorded_of_any_type(kind):
    """Integers of 64 bits keep all their bits."""
    values = np.arange(12).reshape(1, 3, 4)
    values = values % 2 == 0 if kind is np.bool_ else (np.iinfo(np.int64).max - values).astype(kind)
    positions = np.stack(np.meshgrid(np.arange(4), np.arange(3)), -1).astype(np.float32) + np.float32(0.3)
    taken = resampled_values(values, positions, "nearest")
    assert taken.dtype == values.dtype
    assert np.array_equal(taken, values)
    assert not resampled_values(values, positions + 9, "nearest").any()


@pytest.mark.parametrize("interpolation", ["bilinear", "cubic"])
def test_truth_values_are_rounded_too(interpolation):
    """Any share of a true neighbour, or overshoot, counted as true: masks grew."""
    values = np.zeros((1, 6, 8), np.bool_)
    values[:, :, 4:] = True
    positions = np.stack(np.meshgrid(np.arange(8), np.arange(6)), -1).astype(np.float32)
    for step, least in ((0.3, 4), (0.7, 3)):
        taken = resampled_values(values, positions + np.float32([step, 0]), interpolation)[0, :, :7]
        assert taken.dtype == np.bool_
        assert np.array_equal(taken, np.broadcast_to(np.arange(7) >= least, taken.shape))


def test_the_greatest_integers_stay_so():
    values = np.full((1, 4, 5), np.iinfo(np.int64).max)
    taken = resampled_values(values, np.full((1, 1, 2), 1.25, np.float32), "bilinear")
    assert int(taken[0, 0, 0]) == pytest.approx(np.iinfo(np.int64).max, rel=1e-12)


def test_without_a_view_there_are_no_values_unless_filled(found):
    view = found["nir"]
    beyond = view.visibility == OUTSIDE
    assert beyond.any()
    assert np.isnan(view.values[:, ~view.valid]).all()
    assert np.isnan(view.positions[beyond]).all()
    full = filled(np.where(view.valid, view.values, 0), view.valid, "propagate")
    assert np.isin(full, view.values[:, view.valid]).all()
    assert (full[:, view.valid] == view.values[:, view.valid]).all()
    rig, images = array()
    settings = FuseSettings(align=False)
    everything = align(images, rig, alpha="mono", settings=settings, min_confidence=0.0)["nir"]
    assert (everything.visibility[~beyond] == SEEN).all()


@pytest.mark.parametrize("undistorted", [True, False])
def test_recorded_pixels_undo_all_that_was_done_to_a_view(undistorted):
    rig, images = array(LENS)
    straight = without_lenses(rig, images)[0] if undistorted else rig
    now = straight.rot90("nir", 1).resize("nir", (77, 50)).crop("nir", 5, 7, (40, 30))["nir"]
    X = torch.tensor([[0.2, 0.1, 4.0], [-0.3, 0.2, 5.0]], dtype=torch.float64)
    found, valid = recorded_pixels(now.project(X).x, now, rig["nir"])
    assert valid.all()
    assert torch.allclose(found, rig["nir"].project(X).x, atol=1e-6)
    back, valid = straight_pixels(found, now, rig["nir"])
    assert valid.all()
    assert torch.allclose(back, now.project(X).x, atol=1e-6)


def test_views_without_calibration():
    _, images = array()
    rig = Rig({"mono": View(hw=HW), "nir": View(hw=HW)})
    view = align(images, rig, alpha="mono", settings=FuseSettings(align=False))["nir"]
    assert np.abs(view.values[0] - images["mono"][0].numpy())[view.valid].mean() < 0.03


def test_files_have_names_wavelengths_and_types(tmp_path):
    rig, images = array()
    counts = {name: np.rint(image.numpy() * 4000).astype(np.uint16) for name, image in images.items()}
    for name, values in counts.items():
        tifffile.imwrite(tmp_path / f"{name}.tif", values[0])
    recorded = RecordedFiles(rig, {name: tmp_path / f"{name}.tif" for name in counts})
    assert (recorded["nir"] == counts["nir"]).all()
    found = align(images, rig, alpha="mono", settings=FuseSettings(align=False), recorded=recorded)
    written = save_aligned(found, tmp_path / "out", positions="tif")
    with tifffile.TiffFile(tmp_path / "out" / "aligned.tif") as file:
        assert (file.asarray() == found.stack()).all()
        assert file.asarray().dtype == np.uint16
        assert file.pages[0].tags["ImageDescription"].value == "mono, nir"
        assert 'sample="1">0.84<' in file.pages[0].tags[42112].value
    assert {"nir_visibility.png", "nir_positions.tif", "depth.tif"} <= {path.name for path in written}
    states = read_recorded(tmp_path / "out" / "nir_visibility.png")[0]
    assert ((states == 255) == found["nir"].valid).all()
    assert (np.asarray(found["nir"]) == found.band("nir")).all()
    assert "not seen by nir" in aligned_page(found, rig, Facts(["a note"]))


def test_types_that_differ_go_to_files_of_their_own(tmp_path):
    rig, images = array()
    own = {"mono": (images["mono"].numpy() * 255).astype(np.uint8), "nir": images["nir"].numpy()}
    save_aligned(align(images, rig, alpha="mono", settings=FuseSettings(align=False), recorded=own), tmp_path)
    assert tifffile.imread(tmp_path / "mono.tif").dtype == np.uint8
    assert tifffile.imread(tmp_path / "nir.tif").dtype == np.float32
    assert not (tmp_path / "aligned.tif").exists()


def test_files_of_a_former_alignment_are_gone(found, tmp_path):
    save_aligned(found, tmp_path, pages={"index.html": "its page"})
    unknown = replace(found, depth=np.full_like(found.depth, np.nan))
    written = save_aligned(unknown, tmp_path, separate=True, positions="none")
    assert {path.name for path in written} == {path.name for path in tmp_path.iterdir() if path.is_file()}


def test_a_camera_called_depth_has_no_file_of_its_own(found, tmp_path):
    usual, (rig, images) = shown_layers(found), array()
    rig = Rig({"mono": rig["mono"], "depth": rig["nir"]}, depth=rig.depth)
    images = {"mono": images["mono"], "depth": images["nir"]}
    found = align(images, rig, alpha="mono", settings=FuseSettings(align=False))
    assert (tifffile.imread(save_aligned(found, tmp_path)[0]) == found.stack())[0].all()
    layers = shown_layers(found)
    assert torch.equal(layers["depth"], usual["nir"])
    assert torch.equal(layers["derived depth"], usual["depth"])
    with pytest.raises(ValueError, match=r"depth\.tif"):
        save_aligned(found, tmp_path, separate=True)


def test_cameras_of_any_name_write_into_the_folder_and_never_share_a_file(found, tmp_path):
    """Names cannot lead outside the folder, nor to another camera's file."""
    rig, images = array()
    evil, other, out = "../../evil", str(tmp_path / "evil"), tmp_path / "a" / "b" / "out"
    rig = Rig({evil: rig["mono"], other: rig["nir"]}, depth=rig.depth)
    found = align(
        {evil: images["mono"], other: images["nir"]}, rig, alpha=evil, settings=FuseSettings(align=False)
    )
    written = save_aligned(found, out, separate=True, name="7")
    assert {path.parent for path in written} == {out}
    assert [path for path in tmp_path.rglob("*evil*") if path.parent != out] == []
    assert len([path for path in written if path.suffix == ".tif"]) == 3
    views = dict(zip(("x", "x_positions"), found.views.values()))
    with pytest.raises(ValueError, match=r"x_positions\.tif"):
        save_aligned(replace(found, alpha="x_positions", views=views), out, separate=True, positions="tif")


def test_a_file_of_the_user_is_not_replaced(found, tmp_path):
    (tmp_path / "depth.tif").write_text("mine")
    with pytest.raises(FileExistsError, match=r"depth\.tif"):
        save_aligned(found, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["depth.tif"]
    assert (tmp_path / "depth.tif").read_text() == "mine"


def test_ndvi_needs_both_bands_and_both_views(found):
    assert ndvi(found) is None
    rig, images = array()
    red = rig.with_camera("mono", rig["mono"].replace(sensor=Sensor(response=Band(660.0, 40.0))))
    found = align(images, red, alpha="mono", settings=FuseSettings(align=False))
    index, (r, nir) = ndvi(found), (found.band(name) for name in ("mono", "nir"))
    seen = found["nir"].valid
    assert np.isnan(index[~seen]).all()
    assert np.allclose(index[seen], ((nir - r) / (nir + r))[seen], atol=1e-6, equal_nan=True)


def test_mistakes_are_named(found):
    rig, images = array()
    with pytest.raises(ValueError, match=r"'nir' .*1x4x4.*\(C, 96, 160\)"):
        align(
            images,
            rig,
            alpha="mono",
            settings=FuseSettings(align=False),
            recorded={**images, "nir": np.zeros((1, 4, 4))},
        )
    for recorded, said in (
        ({"mono": images["mono"]}, "'nir'"),
        ({**images, "nir": images["nir"].numpy().astype(complex)}, "'nir'.*complex128"),
    ):
        with pytest.raises(ValueError, match=said):  # before anything is matched
            align(images, rig, alpha="mono", recorded=recorded, matcher=lambda inputs: pytest.fail("matched"))
    with pytest.raises(KeyError, match="mono, nir"):
        found.band("red")


def test_weights_without_matches_are_refused():
    """Such weights ask for no padding, and odd sides would crash the process."""
    rig, images = array()
    for name in rig.names:
        rig, images[name] = rig.crop(name, 0, 0, (95, 159)), images[name][:, :95, :159]
    with pytest.raises(ValueError, match="matches"):
        align(images, rig, alpha="mono", network=PAT(PATConfig(betas=1, dim=4, in_channels=1)))
    inputs = Inputs(images["mono"][None], betas=())
    with pytest.raises(ValueError, match="159x95"):
        match(inputs)


def test_values_in_bfloat16_and_names_beyond_ascii(tmp_path):
    rig, images = array()
    rig = Rig({"möno": rig["mono"], "nir": rig["nir"]}, depth=rig.depth)
    images = {"möno": images["mono"], "nir": images["nir"]}
    recorded = {name: image.bfloat16() for name, image in images.items()}
    found = align(images, rig, alpha="möno", settings=FuseSettings(align=False), recorded=recorded)
    assert found["nir"].values.dtype == np.float32
    save_aligned(found, tmp_path)
    with tifffile.TiffFile(tmp_path / "aligned.tif") as file:
        assert file.pages[0].tags["ImageDescription"].value == "möno, nir"
        assert ">möno<" in file.pages[0].tags[42112].value


def test_one_band_and_packed_values(tmp_path):
    write_bands(tmp_path / "one.tif", np.ones((1, 8, 9), np.float32), ["x"], [None])
    assert read_image(tmp_path / "one.tif").shape == (1, 8, 9)
    for names, waves in ((["x"], [None]), (["x", "y"], [None]), (["x"] * 3, [None] * 3)):
        with pytest.raises(ValueError, match=r"two\.tif.*2 bands"):
            write_bands(tmp_path / "two.tif", np.ones((2, 8, 9), np.float32), names, waves)


def test_ndvi_is_of_light_where_the_sensors_are_stated():
    """Counts above the black level, by exposure and gain."""
    rig, images = array()
    facts = {"mono": (Band(660.0, 40.0), 100.0, 0.01, 2.0), "nir": (Band(840.0, 40.0), 300.0, 0.04, 1.0)}
    cameras, counts = {}, {}
    for name, (band, black, exposure, gain) in facts.items():
        recorded = {"coding": "linear", "bits": 16, "black_level": black}
        sensor = Sensor(response=band, exposure=exposure, gain=gain, **recorded)
        cameras[name] = rig[name].replace(sensor=sensor)
        counts[name] = np.rint(black + images[name].numpy() * 1e6 * exposure * gain).astype(np.uint16)
    stated = rig.replace(cameras=cameras)
    found = align(
        images,
        stated,
        alpha="mono",
        settings=FuseSettings(align=False),
        recorded=counts,
        interpolation="nearest",
    )
    index, nir = ndvi(found, stated), found["nir"]
    where = np.rint(np.nan_to_num(nir.positions)).astype(int)
    seen = nir.valid
    light = images["nir"][0].numpy()[where[..., 1], where[..., 0]], images["mono"][0].numpy()
    expected = (light[0] - light[1]) / (light[0] + light[1])
    assert np.nanmedian(np.abs(index - expected)[seen]) < 1e-3


def test_of_an_alpha_in_colour_nothing_is_said(recwarn):
    """It said where colours come from, though nothing is fused."""
    rig, images = array()
    images["mono"] = torch.cat([images["mono"], *(0.9 * images["mono"] for _ in range(2))])
    align(images, rig, alpha="mono", settings=FuseSettings(align=False))
    assert not [w for w in recwarn if "in colour" in str(w.message)]
