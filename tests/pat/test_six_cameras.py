"""Six cameras of one's own, from their formula to a fused picture."""

import inspect
import math

import numpy as np
import pytest
import torch

from arraygeom import (
    Curved,
    Epipolar,
    EpipolarLine,
    HomographyDisplacement,
    Local,
    NearestVoxels,
    Rig,
    default_field,
    depth_of,
    pixel_grid,
    sampling_locations,
    triangulate,
)
from arraygeom.io import write_rig
from experiments.evaluation.sweeps import ablate as ablate_rigs
from pat import load_weights
from pat.app.cli.main import main
from pat.app.explore.page import opened
from pat.lab.evaluation.ablation import AblationCase, FieldFamily, ablate, families
from tests.arraygeom.rigs import number
from tests.pat.any_camera import fused_in_the_room, hit, rig_of_two
from tests.pat.own_cameras import (
    WIDE,
    OwnEquidistant,
    OwnPolynomial,
    OwnPort,
    OwnShutter,
    OwnSphere,
    OwnTelecentric,
)

HW = (120, 160)
K2, K3, STEP, DISTANCE, INDEX = 0.02, -0.03, (0.03, 0.01, 0.02), 0.05, 1.333


SIX = {
    "equidistant": (OwnEquidistant(), 45.0),
    "polynomial": (OwnPolynomial(number(K2), number(K3)), 45.0),
    "sphere": (OwnSphere(), HW[1] / (2 * math.pi)),
    "telecentric": (OwnTelecentric(), 50.0),
    "shutter": (OwnShutter(number(*STEP)), 140.0),
    "port": (OwnPort(number(DISTANCE), number(INDEX)), 140.0),
}
LINES = {"equidistant": 10, "polynomial": 16, "sphere": 10, "telecentric": 9, "shutter": 16, "port": 19}
WHOLE = "equidistant", "polynomial", "sphere"
"""Those that see more than half of the space: their depth is a distance."""


def rig_of(name: str) -> Rig:
    """Two of the cameras in the room."""
    return rig_of_two(*SIX[name], HW, around=name == "telecentric", wide=name in WHOLE)


def by_angle(X, radius):
    theta = np.arccos(X[:, 2] / np.linalg.norm(X, axis=1))
    around = np.arctan2(X[:, 1], X[:, 0])
    return radius(theta)[:, None] * np.stack([np.cos(around), np.sin(around)], -1), theta <= WIDE


def of_sphere(X):
    latitude = np.arcsin(X[:, 1] / np.linalg.norm(X, axis=1))
    return np.stack([np.arctan2(X[:, 0], X[:, 2]), latitude], -1), np.ones(len(X), bool)


def of_shutter(X):
    """Project by bisection of the row, over the image's rows alone."""
    low, high = np.full(len(X), -1.0), np.full(len(X), 1.0)
    for _ in range(70):
        row = (low + high) / 2
        y, z = (X[:, i] - row * STEP[i] for i in (1, 2))
        later = y > row * np.abs(z)
        low, high = np.where(later, row, low), np.where(later, high, row)
    there = X - low[:, None] * np.array(STEP)
    xy = there[:, :2] / there[:, 2:]
    return xy, (there[:, 2] > 0) & (np.abs(xy[:, 1] - low) < 1e-9)


def of_port(X):
    """Project by bisection of the angle in air."""
    radius, low, high = np.hypot(X[:, 0], X[:, 1]), np.zeros(len(X)), np.full(len(X), np.pi / 2)
    for _ in range(80):
        angle = (low + high) / 2
        there = DISTANCE * np.tan(angle) + (X[:, 2] - DISTANCE) * np.tan(np.arcsin(np.sin(angle) / INDEX))
        low, high = np.where(there < radius, angle, low), np.where(there < radius, high, angle)
    return X[:, :2] / radius[:, None] * np.tan(low)[:, None], X[:, 2] > DISTANCE


ORACLES = {
    "equidistant": lambda X: by_angle(X, lambda theta: theta),
    "polynomial": lambda X: by_angle(X, lambda theta: theta + K2 * theta**2 + K3 * theta**3),
    "sphere": of_sphere,
    "telecentric": lambda X: (X[:, :2], X[:, 2] > 0),
    "shutter": of_shutter,
    "port": of_port,
}


@pytest.mark.parametrize("name", SIX)
def test_no_flag_of_100_000_points_is_wrong(name):
    camera = rig_of(name)["alpha"]
    X = np.random.default_rng(0).normal(size=(100_000, 3)) * 3
    if name in ("shutter", "port"):
        X[:, 2] = np.abs(X[:, 2]) - 0.2
    xy, valid = ORACLES[name](X)
    x = xy * camera.K.numpy()[[0, 1], [0, 1]] + camera.K.numpy()[:2, 2]
    with np.errstate(invalid="ignore"):
        on = valid & (x > -0.5).all(1) & (x[:, 0] < HW[1] - 0.5) & (x[:, 1] < HW[0] - 0.5)
    found = camera.project(torch.from_numpy(X))
    assert int((on != (found.valid & camera.contains(found.x)).numpy()).sum()) == 0
    assert np.abs(found.x.numpy() - x)[on].max() < 1e-8
    assert (
        sum(bool(line.strip()) for line in inspect.getsource(type(camera.distortion)).splitlines())
        == LINES[name]
    )


@pytest.mark.parametrize("name", SIX)
def test_fields_points_files_and_pages(name, tmp_path):
    rig = rig_of(name)
    pair = rig.pair("alpha", "beta")
    alpha, beta = pair.cameras
    X, distance = hit(alpha, pixel_grid(HW, dtype=torch.float64))
    X = X[distance > 0]
    a, b = alpha.project(X), beta.project(X)
    both = a.valid & b.valid & beta.contains(b.x) & alpha.contains(a.x)
    assert int(both.sum()) > 3000
    x_alpha, x_beta, X = a.x[both][::7], b.x[both][::7], X[both][::7]

    field = default_field(pair)
    assert isinstance(field, Curved)
    found = sampling_locations(Curved(256, bounds=field.bounds), pair, x_alpha)
    apart = torch.where(found.mask, (found.xy - x_beta[:, None]).norm(dim=-1), torch.inf).amin(-1)
    within = (distance[distance > 0][both][::7] < 5) | (name not in WHOLE)
    assert float(apart[within].max()) < 0.3

    points = triangulate(pair.cameras, torch.stack([x_alpha, x_beta]), deviation=0.02)
    shifted = (x_alpha - x_beta).norm(dim=-1) > 1  # others are near the baseline
    assert float(points.valid[shifted].double().mean()) > 0.99
    assert float((points.X - X)[points.valid & shifted].norm(dim=-1).max()) < 1e-6

    rig.save(tmp_path / "rig.yaml")
    assert Rig.load(tmp_path / "rig.yaml") == rig
    assert main(["show", str(tmp_path / "rig.yaml"), "--out", str(tmp_path / "show")]) in (0, None)
    assert {path.name for path in (tmp_path / "show").iterdir()} >= {"rig.png", "fields.png"}
    explorer = opened(rig)
    answer = explorer.answer(explorer.controls)
    assert "error" not in answer
    assert answer["betas"]


STRAIGHT = Epipolar(), EpipolarLine(), HomographyDisplacement(9.0), NearestVoxels(), Local()


@pytest.mark.parametrize("name", SIX)
def test_what_cannot_serve_says_what_is_missing(name, tmp_path):
    rig = rig_of(name)
    pair, x = rig.pair("alpha", "beta"), number(80.0, 60.0)[None]
    for field in STRAIGHT:
        with pytest.raises(ValueError, match="Curved"):
            sampling_locations(field, pair, x)
    with pytest.raises(ValueError, match=pair.alpha.distortion.model):
        write_rig(rig, tmp_path / "transforms.json", format="nerfstudio")
    with pytest.raises(ValueError, match="scenes"):
        ablate_rigs(load_weights("pat-supervised"), {"own": rig}, scenes=1)
    rig.save(tmp_path / "rig.yaml")
    text = (tmp_path / "rig.yaml").read_text().replace("own-", "unknown-")
    (tmp_path / "rig.yaml").write_text(text)
    with pytest.raises(ValueError, match="model: "):
        Rig.load(tmp_path / "rig.yaml")
    if not pair.cameras[0].central:
        with pytest.raises(ValueError, match="point"):
            depth_of(pair, x, x)


@pytest.mark.parametrize(
    "name", [n if n == "telecentric" else pytest.param(n, marks=pytest.mark.slow) for n in SIX]
)
def test_pictures(name, tmp_path):
    rig = rig_of(name)
    found = fused_in_the_room(rig, wide=name in WHOLE)
    print(f"{name}: {found.alone:.2f} dB alone, {found.psnr:.2f} fused, depth off by {found.off:.1%}")
    assert found.psnr > found.alone + 4
    assert found.off < 0.1

    chosen = {"calibrated": families()["calibrated"], "epipolar": FieldFamily(lambda far: Epipolar())}
    case, network = (
        AblationCase(name, rig, found.images, found.truth, found.depth),
        load_weights("mono-colour"),
    )
    rows = {row.family: row for row in ablate(network, [case], out=tmp_path, chosen=chosen)}
    assert rows["calibrated"].psnr == pytest.approx(found.psnr, abs=1e-3)
    assert rows["calibrated"].within_one > 0.5
    assert "needs pinhole cameras" in rows["epipolar"].note
    assert "pinhole" in rows["classical"].note
