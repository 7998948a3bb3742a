import io

import numpy as np
import pytest
import torch

from arraygeom import (
    Distortion,
    Epipolar,
    Local,
    Rig,
    Segments,
    View,
    Widened,
    sampling_locations,
    viz,
)
from arraygeom.lenses import Orthographic
from arraygeom.runtime.text import UNSCALED
from tests.arraygeom.rigs import known_by_f, random_rig, scene_points, two_cameras

pytest.importorskip("matplotlib", reason="drawings need matplotlib")

X = torch.tensor([[20.0, 20.0], [40.0, 30.0], [30.0, 25.0]], dtype=torch.float64)


def png(figure) -> bytes:
    target = io.BytesIO()
    figure.savefig(target, dpi=40)
    return target.getvalue()


def with_lens(rig: Rig) -> Rig:
    lens = Distortion("kannala-brandt", torch.tensor([0.1, 0.01, 0, 0], dtype=torch.float64))
    return rig.with_camera("beta", rig["beta"].replace(distortion=lens))


@pytest.mark.parametrize(
    "rig", [random_rig(0), with_lens(random_rig(0)), two_cameras(), random_rig(0).replace(depth=None)]
)
def test_rigs_are_drawn(rig):
    figure = viz.draw_rig(rig)
    assert len(png(figure)) > 1000
    assert {t.get_text().strip() for t in figure.axes[0].texts} == {"alpha", "beta"}


def test_the_depth_range_of_an_uncalibrated_alpha_is_not_drawn():
    rig = random_rig(0)
    rig = rig.with_camera("sketch", View(hw=(48, 64)))
    assert len(viz.draw_rig(rig, alpha="sketch").axes[0].lines) < len(viz.draw_rig(rig).axes[0].lines)
    with pytest.raises(ValueError, match="'gamma'"):
        viz.draw_rig(rig, alpha="gamma")


@pytest.mark.parametrize(("name", "unit"), [("", "m"), (UNSCALED, "baselines")])
def test_axes_are_in_the_rigs_unit(name, unit):
    axes = viz.draw_rig(random_rig(0).replace(name=name)).axes[0]
    assert [axes.get_xlabel(), axes.get_ylabel(), axes.get_zlabel()] == [
        f"{c} ({unit})" for c in ("x", "z", "-y")
    ]


@pytest.mark.parametrize("lens", [None, Orthographic()], ids=["pinhole", "orthographic"])
def test_frusta_are_in_front_of_their_cameras_and_project_to_the_corners(lens):
    camera = random_rig(1)["alpha"].replace(distortion=lens)
    border = torch.from_numpy(viz.frustum(camera, 2.0)[-1])
    projected = camera.project(border)
    torch.testing.assert_close(projected.depth, torch.full_like(projected.depth, 2.0))
    torch.testing.assert_close(projected.x, viz.image_border(camera.hw))


def test_pixels_beyond_the_lens_are_moved_inside():
    camera = random_rig(1)["alpha"]
    lens = Distortion("brown-conrady", torch.tensor([-0.9, 0, 0, 0], dtype=torch.float64))
    border = viz.frustum(camera.replace(distortion=lens), 1.0)[-1]
    assert np.isfinite(border).all()


def test_fields_are_drawn_at_their_sampling_locations():
    rig = random_rig(1)
    figure = viz.draw_fields(
        rig, "alpha", X, images={"alpha": torch.rand(3, 48, 64), "beta": np.zeros((40, 60))}
    )
    assert len(png(figure)) > 1000
    segments = sampling_locations(Epipolar(), rig.pair("alpha", "beta"), X)
    drawn = [line.get_xydata() for line in figure.axes[1].lines if len(line.get_xydata()) == 1]
    np.testing.assert_allclose(np.concatenate(drawn), segments.start[segments.valid].numpy())


def test_images_of_a_single_row_are_drawn():
    figure = viz.new_figure()
    viz.show_image(figure.subplots(), (1, 40), torch.rand(1, 1, 40))
    assert len(png(figure)) > 1000


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("kind", [np.uint16, bool])
def test_numbers_of_any_type_are_as_bright_as_their_share_of_white(kind, channels):
    axes = viz.new_figure().subplots()
    ramp = np.linspace(0, 1, 12).reshape(2, 6, 1)
    values = np.broadcast_to(ramp * (65535 if kind is np.uint16 else 2), (2, 6, channels)).astype(kind)
    viz.show_image(axes, (2, 6), values)
    wanted = ramp if kind is np.uint16 else values
    shown = axes.images[0].get_array().reshape(2, 6, channels)
    np.testing.assert_allclose(shown, np.broadcast_to(wanted, shown.shape), atol=1e-4)


def test_any_field_can_be_drawn():
    def here(pair, x):
        return Segments(x, x + 3, torch.ones_like(x[..., 0], dtype=torch.bool))

    for field in (here, Local(3), Widened(Epipolar(), across=2.0), {"beta": here}, None):
        assert len(png(viz.draw_fields(random_rig(1), "alpha", X, field=field))) > 1000
    assert len(png(viz.draw_fields(with_lens(random_rig(1)), "alpha", X))) > 1000


def test_uncalibrated_pairs_are_drawn_about_their_homography():
    rig = known_by_f(random_rig(1))
    assert len(png(viz.draw_fields(rig, "alpha", X))) > 1000
    with pytest.raises(ValueError, match="draw"):
        viz.draw_rig(rig)


def test_residuals_state_their_median():
    rig = random_rig(1)
    a, b = (rig[n].project(scene_points(rig)).x for n in ("alpha", "beta"))
    lines = torch.tensor([0.0, 1.0], dtype=torch.float64)
    figure = viz.draw_residuals(rig.pair("alpha", "beta"), a, b + 0.3 * lines)
    assert len(png(figure)) > 1000
    title = figure.axes[1].get_title()
    assert "200 matches" in title
    assert 0.1 < float(title.split()[-2]) <= 0.3


@pytest.mark.parametrize("factor", [1e3, 1e-3])
def test_what_is_drawn_of_the_depth_range_is_the_same_in_another_unit(factor):
    """No limit of the drawing is in metres."""
    rig = random_rig(0).scaled(0.01).replace(depth=(0.2, 0.25))
    drawn = [len(viz.depth_outline(r, viz.calibrated(r), None)) for r in (rig, rig.scaled(factor))]
    assert drawn[0] == drawn[1]
