"""Real images fused: stereo pairs, calibrated pairs that are not rectified, an array known only by F.

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
from arraygeom.atomic import write_text
from calib.images.matches import FittedLink, fit_link, line_distance, match_points, near_lines, seen_depths

from ..evaluation.baseline import classical
from ..evaluation.metrics import score
from ..evaluation.stereo import METHODS, Row, evaluate_sets, markdown, rectified_fusion, sets_markdown, structure_kept
from ..fusion.fuse import fuse
from ..fusion.results import colour_depth, save_panels
from ..fusion.steps import normalised, resolution_ratio
from ..media.colour import luminance_of
from ..media.images import read_image
from ..networks.protocol import FusionNetwork
from ..networks.weights import load_weights
from ..sensors import Clip, Coded, Exposure, record

PAIRS = ("kitti", "middlebury", "flickr1024")
SYNTIM = ("Color", "Serfaty", "Poly")
"""Scenes in colour whose calibration fits their images to about a pixel."""
FAST, SLOW = "fast", {"cam1": "F1_ref_to_cam1", "cam2": "F2_ref_to_cam2", "cam3": "F3_ref_to_cam3"}
"""The fast camera is alpha; the slow ones see about 600, 550 and 450 nm: red, green, blue."""
SCENE, FAST_FRAME, SLOW_FRAME = "pillow_1", "141", "4"
"""Frames of about one instant."""


def showcase(data: Path, out: Path, weights: str = "mono-colour", rates: Sequence[int] = (2, 4)) -> str:
    """Fuse what is in `data`; write showcase.md, the figures and the rig files into `out`. Returns showcase.md's text.

    Raises FileNotFoundError or ValueError naming what is missing, before any work where that can be known.
    """
    for folder in (*PAIRS, "syntim", "hfr_lfr"):
        if not (data / folder).is_dir():
            raise FileNotFoundError(f"{data / folder}: no such folder: give the folder that holds {folder}")
    network = load_weights(weights)
    scenes, array = [syntim_scene(data / "syntim", name) for name in SYNTIM], fast_and_slow_array(data / "hfr_lfr")
    parts = (_pairs(network, data, out, rates), _syntim(network, scenes, out), _fast_and_slow(network, array, out))
    text = "\n".join(parts)
    write_text(out / "showcase.md", text)
    return text


def _pairs(network: FusionNetwork, data: Path, out: Path, rates: Sequence[int]) -> str:
    methods = {**METHODS, "fusion": rectified_fusion(network)}
    rows = evaluate_sets({name: data / name for name in PAIRS}, methods, rates, out=out / "pairs")
    return (
        "### Stereo pairs\n\n"
        "The left image made grey is alpha, the right one reduced is beta, the left one in colour is the truth.\n"
        "PSNR in dB / SSIM; behind a mean, its 95% bootstrap interval. Every image is in `pairs/`: beta enlarged,\n"
        f"alpha, classical, fusion, truth.\n\n{sets_markdown(rows)}"
    )


class Scene(NamedTuple):
    """A calibrated pair, left and right, with the depth range of what both see, and its images in colour."""

    name: str
    rig: Rig
    left: Tensor
    right: Tensor


def syntim_scene(folder: Path, name: str) -> Scene:
    """A pair of INRIA's, its depth range by matched points."""
    left, right = (_syntim_image(folder, name, side) for side in (0, 1))
    rig = Rig.load(folder / f"cam_{name}_g")
    depth = seen_depths(rig.pair("left", "right"), match_points(left, right))
    return Scene(name, rig.replace(depth=depth, name=f"SYNTIM {name}"), left, right)


def _syntim(network: FusionNetwork, scenes: Sequence[Scene], out: Path) -> str:
    rows = [row for scene in scenes for row in _fused_scene(network, scene, out)]
    figures = "".join(f"![{scene.name}](syntim_{scene.name}.png)\n" for scene in scenes)
    return (
        "### Calibrated pairs, not rectified (SYNTIM)\n\n"
        "Two cameras turned against each other, K, R and t as published; the depth range is that of matched points,\n"
        "widened. Alpha is the left image made grey. The rigs are `syntim_SCENE.yaml`. Between the images of\n"
        "Serfaty two binders were moved: colour of theirs that is out of place comes from that.\n\n"
        f"{markdown(rows)}\n{structure_kept(rows)}\n\n{figures}"
    )


def _fused_scene(network: FusionNetwork, scene: Scene, out: Path) -> list[Row]:
    """The scores of one scene; its rig file and figure go into `out`."""
    name, rig, left, right = scene
    images = {"left": luminance_of(left), "right": right}
    frame = fuse(network, rig, images, alpha="left")
    results = {
        "alpha": images["left"].expand(3, -1, -1),
        "classical": classical(rig, images, "left", "right"),
        "fusion": frame.image.clamp(0, 1),
    }
    shown = {"alpha: left, grey": images["left"], "beta: right": right, "truth: left": left}
    shown |= {"classical": results["classical"], "fusion": results["fusion"], "depth": colour_depth(frame.depth)}
    save_panels(shown, out / f"syntim_{name}.png", columns=3)
    rig.save(out / f"syntim_{name}.yaml")
    return [Row(name, 1, method, *score(image, left)) for method, image in results.items()]


def _syntim_image(folder: Path, scene: str, side: int) -> Tensor:
    found = sorted(folder.glob(f"{scene}{side}_OG*.png"))
    if not found:
        raise FileNotFoundError(f"{folder / scene}{side}_OG*.png: no such image")
    return read_image(found[0])


class Array(NamedTuple):
    """The fast + slow array at one instant: rig, images, and what is known of each pair."""

    rig: Rig
    images: dict[str, Tensor]
    fits: dict[str, FittedLink]
    table: str

    @property
    def displacement(self) -> float:
        """How far to look along the lines, in alpha's pixels, which is what `fuse` brings betas to."""
        pairs = {name: self.rig.pair(FAST, name) for name in self.fits}
        return 1.25 * max(fit.displacement / resolution_ratio(pairs[name]) for name, fit in self.fits.items())


def _fast_and_slow(network: FusionNetwork, array: Array, out: Path) -> str:
    field = HomographyDisplacement(array.displacement)
    frame = fuse(network, array.rig, array.images, alpha=FAST, field=field, match_levels=True)
    shown = {"alpha: the fast camera": array.images[FAST]}
    shown |= {f"beta: {name}": array.images[name] for name in SLOW}
    shown |= {"betas by the rough map alone": transformed(array), "fusion": frame.image}
    save_panels(shown, out / "fast_slow.png", columns=2)
    array.rig.save(out / "fast_slow.yaml")
    return (
        "### The paper's fast + slow array\n\n"
        "Alpha is a frame of the fast camera; the slow ones carry filters: 600 nm is shown as red, 550 nm as green,\n"
        "450 nm as blue. Only fundamental matrices are published. They put points seen in both images some pixels\n"
        "beside their lines, so F is fitted to those points, and with it a rough map H and how far along the line to\n"
        "look. All that is in `fast_slow.yaml`. Values are taken to be linear, alpha's brightest 0.5% are brought to\n"
        "white, all are coded as sRGB, and each beta is brought to alpha's mean and spread: so colours are in\n"
        "proportion to a grey world, not measured. There is no truth to compare with.\n\n"
        f"{array.table}\n"
        f"Looked along +-{array.displacement:.0f} pixels of alpha.\n\n![fast + slow](fast_slow.png)\n"
    )


def fast_and_slow_array(folder: Path) -> Array:
    """The array from its images and `fundamental_matrices.json`."""
    images = {FAST: _coded(read_image(folder / SCENE / f"{FAST_FRAME}.png"), brightest=0.995)}
    images |= {name: _coded(read_image(folder / SCENE / f"{name}_{SLOW_FRAME}.png")) for name in SLOW}
    published = published_matrices(folder / "fundamental_matrices.json")
    fits, lines = {}, ["| beta | points | off the published lines, px | off the fitted ones, px | along, px |"]
    lines.append("| --- | ---: | ---: | ---: | ---: |")
    for name, F in published.items():
        matches = match_points(images[FAST], images[name])
        fits[name] = fit = fit_link(matches, F)
        off = [float(line_distance(near_lines(matches, F, within=6), G).median()) for G in (F, fit.link.F)]
        cells = (name, len(fit.matches.alpha), f"{off[0]:.2f}", f"{off[1]:.2f}", f"+-{fit.displacement:.0f}")
        lines.append(f"| {' | '.join(map(str, cells))} |")
    links = {(FAST, name): fit.link for name, fit in fits.items()}
    views = {name: View(hw=(image.shape[1], image.shape[2])) for name, image in images.items()}
    return Array(Rig(views, links=links, name="fast + slow"), images, fits, "\n".join(lines) + "\n")


def published_matrices(file: Path) -> dict[str, Float[Tensor, "3 3"]]:
    """F of the fast camera and each slow one, in our pixels; the file counts from 1. Raises ValueError naming it."""
    try:
        matrices = json.loads(file.read_text())["pillow"]
        return {name: shift_origin(torch.tensor(matrices[key], dtype=torch.float64), 1.0) for name, key in SLOW.items()}
    except (KeyError, TypeError, json.JSONDecodeError) as error:
        raise ValueError(f"{file}: wanted 3x3 matrices {', '.join(SLOW.values())} under 'pillow' ({error!r})") from None


def transformed(array: Array) -> Float[Tensor, "3 h w"]:
    """The slow images at alpha's view by their rough maps, as red, green and blue, at alpha's level: no matching."""
    alpha = array.images[FAST]
    x = pixel_grid((alpha.shape[1], alpha.shape[2]))
    bands = []
    for name in array.fits:
        where = apply_homography(array.rig.pair(FAST, name).homography.to(x), x).x
        bands.append(sample(normalised(array.images[name], alpha)[None], where[None]).values[0])
    return torch.cat(bands)


def _coded(image: Float[Tensor, "_ h w"], *, brightest: float | None = None) -> Float[Tensor, "1 h w"]:
    """Linear values coded as sRGB; with `brightest`, exposed so that this share of the pixels stays below white."""
    linear = luminance_of(image)
    gain = 1.0 if brightest is None else 1 / float(linear.flatten().sort().values[int(brightest * linear.numel())])
    return record(linear[None], (Exposure(gain), Clip(), Coded()), torch.Generator()).image[0]
