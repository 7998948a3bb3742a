"""Fusion of real images: stereo pairs, calibrated pairs that are not rectified, an array known only by F.

The folder of images is laid out as `data/`: kitti, middlebury, flickr1024 (stereo pairs), syntim (pairs with
`cam_NAME_g` and `cam_NAME_d`), hfr_lfr (the paper's fast + slow array).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import HomographyDisplacement, Rig, View, apply_homography, pixel_grid, sample, shift_origin
from arraygeom.runtime.atomic import write_text
from calib.images.matches import FittedLink, fit_link, line_distance, match_points, near_lines, seen_depths
from experiments.evaluation.halves import of_half
from pat import FuseSettings, fuse
from pat.fusion.classical import classical
from pat.fusion.steps import resolution_ratio
from pat.lab.evaluation import stereo
from pat.lab.evaluation.protocols import BASELINES, rectified_fusion
from pat.lab.evaluation.tables import markdown_table
from pat.matching.normalisation import normalised
from pat.media.colour import luminance_of, srgb_image
from pat.media.figures import colour_depth, save_panels
from pat.media.images import read_image
from pat.networks.protocol import FusionNetwork
from pat.networks.weights import load_weights
from pat.support.metrics import score

PAIRS = ("kitti", "middlebury", "flickr1024")
SYNTIM = "Serfaty"
"""A scene in colour whose calibration fits its images to about a pixel, and on which nothing was chosen."""
FAST, SLOW = "fast", {"cam1": "F1_ref_to_cam1", "cam2": "F2_ref_to_cam2", "cam3": "F3_ref_to_cam3"}
"""The fast camera is alpha; the slow ones see about 600, 550 and 450 nm: red, green, blue."""
PAIRS_TEXT = """### Stereo pairs

The left image made grey is alpha, the right one reduced is beta, the left one in colour is the ground
truth. PSNR in dB / SSIM; behind a mean, its 95% bootstrap interval. Pairs on which settings were chosen are
left out (`experiments/evaluation/halves.yaml`). Every image is in `pairs/`: beta
enlarged, alpha, classical, fusion, ground truth.

"""
SYNTIM_TEXT = """### Calibrated pairs, not rectified (SYNTIM)

Two cameras rotated against each other, K, R and t as published; the depth range is that of matched points,
widened. Alpha is the left image made grey. The rigs are `syntim_SCENE.yaml`. Between the images of
Serfaty two binders were moved: their misplaced colour comes from that.

"""
FAST_SLOW_TEXT = """### The paper's fast + slow array

Alpha is a frame of the fast camera; the slow ones have filters: 600 nm is shown as red, 550 nm as green,
450 nm as blue. Only fundamental matrices are published. They put points seen in both images some pixels
beside their lines, so F is fitted to those points, and with it a rough homography H and the displacement
along the line. All that is in `fast_slow.yaml`. Values are taken to be linear, alpha's brightest 0.5% are
brought to white, all are sRGB-encoded, and each beta is normalised to alpha's mean and standard deviation:
so colours are in proportion to a grey world, not measured. There is no ground truth.

"""
SCENE, FAST_FRAME, SLOW_FRAME = "pillow_1", "141", "4"
"""Frames of about one instant."""


def showcase(data: Path, out: Path, weights: str = "mono-colour", rates: Sequence[int] = (2, 4)) -> str:
    """Fuse the images in `data`; write showcase.md, figures, rig files to `out`. Returns showcase.md's text.

    Raises FileNotFoundError or ValueError naming what is missing, before any work where possible.
    """
    for folder in (*PAIRS, "syntim", "hfr_lfr"):
        if not (data / folder).is_dir():
            raise FileNotFoundError(f"{data / folder}: no such folder: give the folder that holds {folder}")
    network = load_weights(weights)
    scene = syntim_scene(data / "syntim", SYNTIM)
    array = fast_and_slow_array(data / "hfr_lfr")
    pairs = _pairs(network, data, out, rates)
    text = "\n".join([pairs, _syntim(network, scene, out), _fast_and_slow(network, array, out)])
    write_text(out / "showcase.md", text)
    return text


def _pairs(network: FusionNetwork, data: Path, out: Path, rates: Sequence[int]) -> str:
    methods = {name: BASELINES[name] for name in ("alpha", "classical")}
    methods["fusion"] = rectified_fusion(network)
    sets = {name: of_half(stereo.DATA_SETS[name](data / name), "report") for name in PAIRS}
    return PAIRS_TEXT + stereo.sets_markdown(
        stereo.evaluate_sets(sets, methods, rates, out=out / "pairs"), depth=False
    )


class SyntimScene(NamedTuple):
    """A calibrated pair, left, right, the depth range that both see points in, and its images in colour."""

    name: str
    rig: Rig
    left: Tensor
    right: Tensor


def syntim_scene(folder: Path, name: str) -> SyntimScene:
    """A pair of INRIA's with the depth range of matched points."""
    left, right = (_syntim_image(folder, name, side) for side in (0, 1))
    rig = Rig.load(folder / f"cam_{name}_g")
    depth = seen_depths(rig.pair("left", "right"), match_points(left, right))
    return SyntimScene(name, rig.replace(depth=depth, name=f"SYNTIM {name}"), left, right)


def _syntim(network: FusionNetwork, scene: SyntimScene, out: Path) -> str:
    name, rig, left, right = scene
    images = {"left": luminance_of(left), "right": right}
    frame = fuse(images, rig, alpha="left", network=network)
    results = {
        "alpha": images["left"].expand(3, -1, -1),
        "classical": classical(rig, images, "left", "right"),
        "fusion": frame.image.clamp(0, 1),
    }
    shown = {"alpha: left, grey": images["left"], "beta: right": right, "ground truth: left": left}
    shown |= {name: results[name] for name in ("classical", "fusion")}
    shown["depth"] = colour_depth(frame.depth)
    save_panels(shown, out / f"syntim_{name}.png", columns=3)
    rig.save(out / f"syntim_{name}.yaml")
    rows = [stereo.StereoRow(name, 1, method, *score(image, left)) for method, image in results.items()]
    table = f"{stereo.markdown(rows)}\n{stereo.structure_kept(rows)}"
    return f"{SYNTIM_TEXT}{table}\n\n![{name}](syntim_{name}.png)\n"


def _syntim_image(folder: Path, scene: str, side: int) -> Tensor:
    files = sorted(folder.glob(f"{scene}{side}_OG*.png"))
    if not files:
        raise FileNotFoundError(f"{folder / scene}{side}_OG*.png: no such image")
    return read_image(files[0])


class FastSlowArray(NamedTuple):
    """The fast + slow array at one instant: rig, images, the link fitted to each pair, a table of fits."""

    rig: Rig
    images: dict[str, Tensor]
    fits: dict[str, FittedLink]
    table: str

    @property
    def displacement(self) -> float:
        """Largest displacement along the lines, in alpha's pixels, to which `fuse` resizes betas."""
        pairs = {name: self.rig.pair(FAST, name) for name in self.fits}
        return 1.25 * max(fit.displacement / resolution_ratio(pairs[name]) for name, fit in self.fits.items())


def _fast_and_slow(network: FusionNetwork, array: FastSlowArray, out: Path) -> str:
    settings = FuseSettings(field=HomographyDisplacement(array.displacement), match_levels=True)
    frame = fuse(array.images, array.rig, alpha=FAST, network=network, settings=settings)
    shown = {"alpha: the fast camera": array.images[FAST]}
    shown |= {f"beta: {name}": array.images[name] for name in SLOW}
    shown |= {"betas by the rough homography alone": transformed(array), "fusion": frame.image}
    save_panels(shown, out / "fast_slow.png", columns=2)
    array.rig.save(out / "fast_slow.yaml")
    segments = f"Search segments: +-{array.displacement:.0f} pixels of alpha."
    return f"{FAST_SLOW_TEXT}{array.table}\n{segments}\n\n![fast + slow](fast_slow.png)\n"


def fast_and_slow_array(folder: Path) -> FastSlowArray:
    """The array from its images and `fundamental_matrices.json`."""
    files = {FAST: folder / SCENE / f"{FAST_FRAME}.png"}
    files |= {name: folder / SCENE / f"{name}_{SLOW_FRAME}.png" for name in SLOW}
    linear = {name: luminance_of(read_image(file)) for name, file in files.items()}
    linear[FAST] = linear[FAST] * bright_gain(linear[FAST])
    images = {name: srgb_image(light) for name, light in linear.items()}
    published = published_matrices(folder / "fundamental_matrices.json")
    columns = ("beta", "points", "off the published lines, px", "off the fitted ones, px", "along, px")
    fits, rows = {}, []
    for name, F in published.items():
        matches = match_points(images[FAST], images[name])
        fits[name] = fit = fit_link(matches, F)
        off = [float(line_distance(near_lines(matches, F, within=6), G).median()) for G in (F, fit.link.F)]
        figures = f"{off[0]:.2f}", f"{off[1]:.2f}", f"+-{fit.displacement:.0f}"
        rows.append((name, len(fit.matches.alpha), *figures))
    links = {(FAST, name): fit.link for name, fit in fits.items()}
    views = {name: View(hw=(image.shape[1], image.shape[2])) for name, image in images.items()}
    rig = Rig(views, links=links, name="fast + slow")
    return FastSlowArray(rig, images, fits, markdown_table(columns, rows))


def published_matrices(file: Path) -> dict[str, Float[Tensor, "3 3"]]:
    """F of fast and each slow camera, in our pixels; the file counts from 1. Raises ValueError naming it."""
    try:
        matrices = json.loads(file.read_text())["pillow"]
        return {
            name: shift_origin(torch.tensor(matrices[key], dtype=torch.float64), 1.0)
            for name, key in SLOW.items()
        }
    except (KeyError, TypeError, json.JSONDecodeError) as error:
        raise ValueError(f"{file}: no matrices {', '.join(SLOW.values())} of 'pillow' ({error!r})") from None


def transformed(array: FastSlowArray) -> Float[Tensor, "3 h w"]:
    """Slow images at alpha's view by rough homographies, as red, green, blue normalised to alpha."""
    alpha = array.images[FAST]
    x = pixel_grid((alpha.shape[1], alpha.shape[2]))
    bands = []
    for name in array.fits:
        position = apply_homography(array.rig.pair(FAST, name).homography.to(x), x).x
        bands.append(sample(normalised(array.images[name], alpha)[None], position[None]).values[0])
    return torch.cat(bands)


def bright_gain(image: Float[Tensor, "_ h w"]) -> float:
    """The gain that brings the brightest 0.5 % of the pixels to white."""
    values = luminance_of(image).flatten().sort().values
    return 1 / float(values[int(0.995 * len(values))])
