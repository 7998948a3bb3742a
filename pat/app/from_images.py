"""Arrays from images without a rig: alpha, the betas' bands, and the rig are all derived from the images."""

from __future__ import annotations

import logging
import math
import os
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.linalg import LinAlgError
from torch.nn.functional import interpolate

from arraygeom import LensView, Link, Rig, Sensor, View, apply_homography, resize_matrix
from arraygeom.io.source import RigSource
from arraygeom.io.xmp import named_by_band, rig_of_images, states_cameras
from arraygeom.pixels import HW
from arraygeom.runtime.progress import log_step, part, stage
from arraygeom.runtime.text import ASSUMED, OPEN, REGISTERED, UNSCALED
from arraygeom.undistortion import pixels_between
from calib.images.focal_length import common_focal_length
from calib.images.from_images import UncalibratedRig, link_of_points, rig_from_images, usable_matches
from calib.images.known_intrinsics import centres_found
from calib.images.lenses import describe_lenses
from calib.images.matches import Pairs, PointMatches, match_cameras, undistort_matches
from calib.images.self_calibration import RefinedPair, joined, refined_by_depth, self_calibrated

from ..fusion.steps import without_lenses
from ..fusion.views import is_in_colour, range_of, read_view
from ..media.images import ImageSources, read_image, write_image
from ..media.raw import developed_rig
from ..media.tags import focal_length
from ..media.video import read_video
from ..networks.weights import load_weights
from .dense_matches import MatchedDepth, matched_depth
from .point_matches import read_matches

LOG = logging.getLogger(__name__)

MATCHED = 1600
"""Pixels of the longer side that images are reduced to for matching features."""
COARSE = 640
"""Pixels of alpha's longer side for dense matches."""
LINES = 0.45
"""Share of the time to find a rig that epipolar lines take; the rest is calibration."""
EVEN = 0.004
"""Standard deviation below which an image is of one colour: a count of 8 bits."""
WAVELENGTHS = {"edge": 720, "red": 620, "green": 540, "blue": 460}
"""Nanometres of colour names; a red edge is no red."""
COLOURS = ((570, 700), (500, 580), (400, 500))
"""Ranges in nanometres in which three bands are shown as red, green and blue."""
LONGEST_VISIBLE = 760
"""Nanometres beyond which bands are not put in order."""

Images = Mapping[str, Float[Tensor, "_ h w"]]
Say = Callable[[str], None]


@dataclass(frozen=True)
class ImageArray:
    """Array found from its images.

    Attributes:
        rig: rig of the developed images.
        recorded: rig of the files, with their sensors' coding and black level.
        images: images (c, h, w) of alpha, which is first, and of the betas to fuse; one band where three are
            equal, unless tags state the cameras.
        alpha: name of alpha.
        weights: name of the weights to fuse with.
        match_levels: True to match each beta's mean and contrast to alpha's.
        notes: sentences on what was found.
    """

    rig: Rig
    recorded: Rig
    images: dict[str, Tensor]
    alpha: str
    weights: str
    match_levels: bool
    notes: tuple[str, ...]

    @property
    def lasting(self) -> Rig | None:
        """The recorded rig, for other captures of these cameras; None if the images leave its lines and depth
        open."""
        return None if self.recorded.name == OPEN else self.recorded


def array_from_images(
    sources: ImageSources,
    *,
    alpha: str | None = None,
    weights: str | None = None,
    focal: Mapping[str, float] | None = None,
    matches: str | Path | None = None,
    further: Sequence[Mapping[str, Path]] = (),
    say: Say = lambda line: None,
) -> ImageArray:
    """Find the array of one image from each camera.

    Args:
        sources: files or tensors (c, h, w) in 0..1 by camera, or a list of files (`camera_names`).
        alpha: camera whose view is wanted; None for the largest grey image, or else the largest.
        weights: weights by name or file; None chooses them by the bands.
        focal: focal lengths in pixels by camera, in place of those in the files' tags; None for none.
        matches: file of matched points (`read_matches`) from which the rig is found; None matches the
            images.
        further: files of other captures by camera, used too where tags state cameras without parallax.
        say: function that is called with a line of text for each finding.

    Returns:
        The array: alpha, and the betas that show enough of what alpha shows.

    Raises:
        ValueError: in one line, for fewer than two images, what is no image in 0..1, an image of one colour,
            images that do not show the same things, an unknown alpha, tags, matches or weights that cannot be
            used, and a focal length that is not positive, of an unknown camera, or beside tags that state it.
        FileNotFoundError: for a missing file, and unknown weights where no tags state the cameras.
        TypeError: for an image that is neither file nor tensor, and a tensor without a name.
    """
    sources, focal = by_camera(sources), focal or {}
    files = {name: Path(path) for name, path in sources.items() if isinstance(path, str | Path)}
    images: dict[str, Any] = {name: image for name, image in sources.items() if name not in files}
    for name, image in images.items():
        range_of(name, image)
    for name, length in focal.items():
        if name not in sources or not 0 < length < math.inf:
            raise ValueError(
                f"focal: '{name}={length:g}' is of no camera ({', '.join(sources)}), or not positive"
            )
    notes: list[str] = []

    def note(line: str) -> None:
        notes.append(line)
        say(line)

    tagged = None if images else _tagged_rig(files, note)
    if tagged is not None and focal:
        raise ValueError("focal: the images' tags state the focal lengths: leave it out")
    images |= {name: read_image(file, name=name) for name, file in files.items()}
    by_pair: Pairs | None = None
    if matches is not None:
        sizes = {name: _hw(image) for name, image in images.items()}
        given = read_matches(matches, {n: files.get(n, n) for n in sources}, sizes)
        by_pair = {pair: PointMatches(*points) for pair, points in given.items()}
    images = {name: _textured(f"{name}: {files.get(name, 'the image')}", images[name]) for name in sources}
    alpha = _chosen_alpha(images, alpha, note)
    if tagged is not None:
        images = {name: read_view(tagged, name, files[name], like=tagged[alpha].sensor) for name in images}
    names = _ordered_betas(images, alpha, note)
    images = {name: images[name] for name in (alpha, *names)}
    if tagged is None:
        lengths = _focal_lengths(images, files, focal, note)
        bands = load_weights(weights or _weights_of(images, alpha)).bands
        rig, names = found_rig(images, alpha, lengths, bands, note, by_pair)
        sensors = {name: Sensor({1: "mono", 3: "rgb"}.get(len(images[name]))) for name in names}
        recorded = rig = _with_sensors(rig, sensors)
    else:
        like = tagged[alpha].sensor
        others = ({n: read_view(tagged, n, one[n], like=like) for n in images} for one in further)
        rig, names = _rig_of_bands(tagged, images, others, alpha, note, by_pair)
        recorded = _with_sensors(rig, {name: tagged[name].sensor for name in names})
    images = {name: images[name] for name in names}
    weights = weights or _weights_of(images, alpha)
    several = len(names) > 2 and all(len(images[name]) == 1 for name in names[1:])
    if several:
        note("radiometry: each band is brought to alpha's mean and contrast, as for a grey world")
    return ImageArray(rig, recorded, images, alpha, weights, several, tuple(notes))


def _with_sensors(rig: Rig, sensors: Mapping[str, Sensor]) -> Rig:
    return rig.replace(cameras={name: rig[name].replace(sensor=sensor) for name, sensor in sensors.items()})


def by_camera(sources: ImageSources) -> Mapping[str, str | Path | Tensor]:
    """Name the images of a list by camera (`camera_names`); of a mapping only the number is checked.

    Args:
        sources: files or tensors by camera, or a list of files.

    Returns:
        Files or tensors by camera; a mapping itself.

    Raises:
        ValueError: for fewer than two images.
        TypeError: for a tensor without a name.
    """
    if isinstance(sources, str | Path):
        raise ValueError(f"an array has two images or more, got {sources}: give a list of them")
    if not isinstance(sources, Mapping):
        for source in sources:
            if not isinstance(source, str | Path):
                got = type(source).__name__
                raise TypeError(f"an image is a {got} without a name: give files, or {{NAME: tensor}}")
        sources = camera_names([Path(path) for path in sources])
    if len(sources) < 2:
        raise ValueError(f"an array has two images or more, got {len(sources)}")
    return sources


def _focal_lengths(
    images: Images, files: Mapping[str, Path], user_focal: Mapping[str, float], note: Say
) -> dict[str, float]:
    """Focal lengths in pixels, as given or else by the files' tags; cameras without either are absent."""
    by_tags = {n: focal_length(files[n], _hw(x)) for n, x in images.items() if n in files}
    lengths = {n: length for n, length in {**by_tags, **user_focal}.items() if length and n in images}
    for name, length in lengths.items():
        note(f"{name}: focal length {length:.0f} pixels, {'as given' if name in user_focal else 'by EXIF'}")
    return lengths


def camera_names(paths: Sequence[Path]) -> dict[str, Path]:
    """Name the cameras of files.

    Names are by `named_by_band` if the files' tags state the cameras; else the files' names without suffix,
    else their folders', with _ in place of all but letters, digits, "." and "-", else "camera1", "camera2",
    ...: the first kind in which no two are equal and none is empty.

    Returns:
        Files by camera, in their order.

    Raises:
        OSError: for a file that cannot be opened.
    """
    if states_cameras(paths):
        return named_by_band(paths)
    for names in ([p.stem for p in paths], [p.resolve().parent.name for p in paths]):
        plain = [re.sub(r"[^\w.-]+", "_", name).strip("_") for name in names]
        if len(set(plain)) == len(plain) and all(plain):
            return dict(zip(plain, paths))
    return {f"camera{i}": path for i, path in enumerate(paths, 1)}


def by_capture(paths: Sequence[Path]) -> dict[str, list[Path]]:
    """Group the images of several captures by the names of their bands (`named_by_band`).

    Captures with other ends of names than the largest are left out, with a RigFileWarning.

    Args:
        paths: image files, in any order; names in a capture differ after the last "_".

    Returns:
        Files of whole captures by band, in the captures' order; empty for a single whole capture, a single
        band, and if the largest capture's tags do not state their cameras.

    Raises:
        OSError: for a file that cannot be opened.
        ImportError: without Pillow.
    """
    captures: dict[tuple[Path, str], dict[str, Path]] = {}
    for path in paths:
        stem, _, end = path.stem.rpartition("_")
        captures.setdefault((path.parent, stem), {})[end] = path
    most = max(captures.values(), key=len, default={})
    whole = [capture for capture in captures.values() if capture.keys() == most.keys()]
    if len(most) < 2 or len(whole) < 2 or not states_cameras(list(most.values())):
        return {}
    if left_out := len(paths) - len(whole) * len(most):
        RigSource(paths[0].parent).warn(f"{left_out} images are left out, whose captures lack a band")
    named = {name: path.stem.rpartition("_")[2] for name, path in named_by_band(list(most.values())).items()}
    return {name: [capture[end] for capture in whole] for name, end in named.items()}


def video_frames(videos: Mapping[str, Path], folder: Path) -> tuple[dict[str, list[Path]], dict[str, float]]:
    """Write the frames of videos as PNG files into a folder.

    Files get their video's modification time, by which a resumed job recognises them.

    Args:
        videos: video file by camera.
        folder: folder to write to, with a subfolder for each camera, made if missing.

    Returns:
        Files in the order of frames, by camera; and frames for each second, by camera.

    Raises:
        ValueError: for a video without frames, or one that cannot be read.
        FileNotFoundError: for a missing video.
        OSError: if a file cannot be written.
    """
    files: dict[str, list[Path]] = {}
    rates: dict[str, float] = {}
    for name, path in videos.items():
        frames, rates[name] = read_video(path)
        files[name] = []
        for i, image in enumerate(frames):
            files[name].append(folder / name / f"{i:06d}.png")
            write_image(files[name][-1], image)
            os.utime(files[name][-1], ns=(path.stat().st_mtime_ns,) * 2)
        if not files[name]:
            raise ValueError(f"{path}: holds no frames: is the video whole?")
    return files, rates


def _tagged_rig(files: Mapping[str, Path], note: Say) -> Rig | None:
    """Rig from the images' tags, translations apart; None if not every image has such tags."""
    if not states_cameras(list(files.values())):
        return None
    with warnings.catch_warnings(record=True, action="always") as caught:
        rig = rig_of_images(files)
    note(f"lenses and orientations of {', '.join(files)}: by the images' tags")
    for text in (str(warning.message) for warning in caught):
        if "RigTranslations" not in text:
            note(text)
    return rig


def _rig_of_bands(
    tagged: Rig, images: Images, further: Iterable[Images], alpha: str, note: Say, by_pair: Pairs | None
) -> tuple[Rig, list[str]]:
    """Rig of tags with translations where images have parallax, else with maps by all captures' points; and
    the cameras that match, alpha first."""
    translated, why = None, "matches are given"
    if by_pair is None:
        try:
            translated = _translated_rig(tagged, images, alpha, note)
            if translated[0].name != OPEN:
                return translated
            why = "the cameras' orientations alone explain the points"
        except LinAlgError:
            why = "too little parallax"
        except ValueError as error:
            why = str(error).partition(":")[0]
    note(f"no depth ({why}): maps between the bands by matched points")
    try:
        return _mapped_rig(tagged, chain([images], further), alpha, note, by_pair)
    except ValueError:
        if translated is None:
            raise
        return translated


@stage()
def _translated_rig(tagged: Rig, images: Images, alpha: str, note: Say) -> tuple[Rig, list[str]]:
    """Rig of tags with translations and depths from the images, and the cameras that match, alpha first."""
    straight, pinhole = without_lenses(Rig({name: tagged[name] for name in images}), images)
    shown = {name: pixels_between(tagged[name], straight[name])[1][None].float() for name in images}
    lengths = {name: float(straight[name].K[0, 0]) for name in images}
    finest = lengths[alpha] * matching_factor(images[alpha])
    factors = {name: min(finest / length, 1.0) for name, length in lengths.items()}
    reduced = {name: scaled(image, factors[name]) for name, image in pinhole.items()}
    masks = {name: scaled(mask, factors[name])[0] > 0.99 for name, mask in shown.items()}
    translated, facts = centres_found(resized_rig(straight, reduced), reduced, masks, alpha=alpha)
    for name, (points, distance) in facts.items():
        note(f"{name}: {points} points, {distance:.2f} px from their lines, intrinsics kept")
    for name in images.keys() - {*translated.names}:
        note(f"{name}: left out, too little in common with the others")
    note(f"depths are multiples of the baseline {alpha} to {translated.betas(alpha)[0]}")
    rig, names = developed_rig(tagged, images), [alpha, *translated.betas(alpha)]
    cameras = {name: rig[name].replace(cam_from_world=translated[name].cam_from_world) for name in names}
    return Rig(cameras, depth=translated.depth, name=translated.name or UNSCALED), names


def _mapped_rig(
    tagged: Rig, captures: Iterable[Images], alpha: str, note: Say, by_pair: Pairs | None = None
) -> tuple[Rig, list[str]]:
    """Cameras of tags without poses (open without parallax, and not needed): their lenses, and a homography,
    or F, by the points of all captures."""
    pools: dict[tuple[str, str], list[PointMatches]] = {}
    used = 0
    for images in captures:
        rig = Rig({name: tagged[name] for name in images})
        straight, pinhole = without_lenses(rig, images)
        reduced = {name: scaled(image, matching_factor(image)) for name, image in pinhole.items()}
        sized = resized_rig(straight, reduced)
        try:
            if by_pair is None:
                matched = match_cameras(reduced, alpha=alpha)
            else:
                bare = {pair: undistort_matches(rig.pair(*pair), points) for pair, points in by_pair.items()}
                to_sized = {name: sized[name].K @ torch.linalg.inv(rig[name].K) for name in images}
                matched = usable_matches(_moved(bare, to_sized), alpha=alpha)
        except ValueError:
            if not used:
                raise
            continue
        used += 1
        for pair, points in matched.items():
            pools.setdefault(pair, []).append(points)
    views = Rig({name: View(hw=sized[name].hw) for name in sized.names})
    links, every = {}, []
    for pair, parts in pools.items():
        points = PointMatches(*(torch.cat(side) for side in zip(*parts)))
        links[pair], explained = link_of_points(views, pair, points)
        every.append(explained.has_lines)
        note(f"{alpha} > {pair[1]}: {explained.as_text(focal_lengths=True)}")
    names = [alpha, *(name for name in sized.names if (alpha, name) in links)]
    for name in sized.names:
        if name not in names:
            note(f"{name}: left out, too little in common with {alpha}")
    cameras = {name: developed_rig(tagged, images)[name] for name in names}
    to_tags = {name: cameras[name].K @ torch.linalg.inv(sized[name].K) for name in names}
    lenses = {
        name: LensView(hw=camera.hw, K=camera.K, distortion=camera.distortion, sensor=camera.sensor)
        for name, camera in cameras.items()
    }
    own = {(a, b): link.transformed(to_tags[a], to_tags[b]) for (a, b), link in links.items()}
    return Rig(lenses, links=own, name="" if all(every) else REGISTERED if used > 1 else OPEN), names


@stage()
def found_rig(
    images: Images,
    alpha: str,
    focal: Mapping[str, float],
    bands: int | None,
    note: Say,
    by_pair: Pairs | None = None,
) -> tuple[Rig, list[str]]:
    """Find the rig of images, and the cameras that it relates to alpha.

    Args:
        images: images (c, h, w) by camera.
        alpha: name of alpha.
        focal: focal lengths in pixels by camera, where known.
        bands: number of bands that the network takes as one colour image: a beta of so many is compared with
            alpha by its luma, others by the combination of bands most similar to alpha. None for no number.
        note: function that is called with a line of text for each finding.
        by_pair: matches between the images by pair; None to match the images.

    Returns:
        The rig of the images at their own sizes, calibrated up to a scale where points matched between alpha
        and a beta have parallax, else with F or a homography alone; and its cameras' names, alpha first. The
        rig is named `UNSCALED` or `ASSUMED` if calibrated, else `OPEN` if lines stay open, else not at all.

    Raises:
        ValueError: if no image shows enough of what alpha shows, and as `rig_from_images`.
    """
    factors = {name: matching_factor(image) for name, image in images.items()}
    reduced = {name: scaled(image, factors[name]) for name, image in images.items()}
    lengths = {name: length * factors[name] for name, length in focal.items()}
    if by_pair is not None:
        by_pair = _moved(by_pair, {n: resize_matrix(_hw(x), _hw(reduced[n])) for n, x in images.items()})
    with part(0, LINES):
        uncalibrated = rig_from_images(reduced, focal=lengths, alpha=alpha, matches=by_pair)
    betas = [name for name in images if (alpha, name) in uncalibrated.rig.links]
    if not betas:
        raise ValueError(f"no image shows enough of what '{alpha}' shows: choose another alpha")
    for name in images.keys() - {alpha, *betas}:
        note(f"{name}: left out, too little in common with {alpha}")
    with_lines = [name for name in betas if uncalibrated.explained[alpha, name].has_lines]
    known = lengths.keys() & {alpha, *betas}
    observed = {} if known else _observed_focal_lengths(uncalibrated, alpha, with_lines)
    for name, (length, deviation) in observed.items():
        note(f"{name}: focal length {length / factors[name]:.0f} px +- {deviation:.0%}, by matched points")
    lengths |= {name: length for name, (length, _) in observed.items()}
    rig = _calibrated(uncalibrated, reduced, alpha, betas, lengths, bands, note, by_pair is None)
    if rig.name == UNSCALED and known != {alpha, *betas}:
        rig = rig.replace(name=ASSUMED)
    return resized_rig(rig, images), [alpha, *betas]


def _observed_focal_lengths(
    uncalibrated: UncalibratedRig, alpha: str, betas: Sequence[str]
) -> dict[str, tuple[float, float]]:
    """Focal length, pixels, and its relative deviation, of alpha and the betas of its size, from the
    best-determined pair; empty if there is none."""
    fits = []
    for name in betas:
        LOG.info("looking for the focal length of %s and %s", alpha, name)
        views = {n: uncalibrated.rig[n] for n in (alpha, name)}
        link, matches = uncalibrated.rig.links[alpha, name], uncalibrated.matches[alpha, name]
        fits.append(common_focal_length(views, link, matches))
    best = min((fit for fit in fits if fit is not None), key=lambda fit: fit.deviation, default=None)
    if best is None:
        return {}
    alike = [name for name in (alpha, *betas) if uncalibrated.rig[name].hw == uncalibrated.rig[alpha].hw]
    return dict.fromkeys(alike, (best.length, best.deviation))


def _calibrated(
    uncalibrated: UncalibratedRig,
    images: Images,
    alpha: str,
    betas: Sequence[str],
    focal: Mapping[str, float],
    bands: int | None,
    note: Say,
    dense: bool,
) -> Rig:
    """Rig of alpha and these betas, each pair calibrated and refined by dense matches at reduced size; or
    not refined, unless several have to be of one scale.

    A pair whose lines no poses fit as well as F alone keeps F's, with the nearest poses for rough depths; one
    without parallax has F alone. Each is reported in a line.
    """
    pairs: dict[str, RefinedPair] = {}
    depths: dict[str, MatchedDepth] = {}
    links: dict[tuple[str, str], Link] = {}
    for i, name in enumerate(betas):
        log_step(LOG, LINES + (1 - LINES) * i / len(betas), "calibrating %s and %s", alpha, name)
        pair = _calibrated_pair(uncalibrated, alpha, name, focal, note)
        if pair is None or not pair.exact:
            links[alpha, name] = uncalibrated.rig.links[alpha, name]
        if pair is None:
            continue
        pairs[name] = pair
        if (pair.exact and dense) or len(betas) > 1:
            pairs[name], depths[name] = _refined(pair, images, bands, links)
        if pairs[name] is not pair:
            points, distance = pairs[name].points, pairs[name].distance
            note(f"{alpha} > {name}: {points} points, {distance:.2f} px from their lines")
    if any(getattr(view, "distortion", None) is not None for view in uncalibrated.rig.cameras.values()):
        note(describe_lenses(uncalibrated.rig))
    names = {alpha, *betas}
    if not pairs:
        cameras = {name: view for name, view in uncalibrated.rig.cameras.items() if name in names}
        links = {pair: link for pair, link in uncalibrated.rig.links.items() if names >= {*pair}}
        return uncalibrated.rig.replace(cameras=cameras, links=links)
    first = next(iter(pairs))
    assumed = [name for name in (alpha, *pairs) if name not in focal]
    of = f" {alpha} to {first}" if len(betas) > 1 else ""
    rough = f"; focal lengths of {', '.join(assumed)} are assumed, and the proportions of depth with them"
    note(f"depths are multiples of the baseline{of}{rough if assumed else ''}")
    scales = {name: _relative_scale(depths[first], depths[name]) if name in depths else 1.0 for name in pairs}
    rig = joined(pairs, scales)
    for name in betas:
        if name not in pairs:
            rig = rig.with_camera(name, uncalibrated.rig[name])
    return rig.replace(cameras={name: rig[name] for name in (alpha, *betas)}, links=links)


def _calibrated_pair(
    uncalibrated: UncalibratedRig, alpha: str, name: str, focal: Mapping[str, float], note: Say
) -> RefinedPair | None:
    """Alpha and one beta with poses by their points; None without. What they determine and leave open is
    reported."""
    views = {n: uncalibrated.rig[n] for n in (alpha, name)}
    link, matches = uncalibrated.rig.links[alpha, name], uncalibrated.matches[alpha, name]
    note(f"{alpha} > {name}: {uncalibrated.describe(alpha, name)}")
    if not uncalibrated.explained[alpha, name].has_lines:
        return None
    pair = self_calibrated(views, link, matches, focal=focal)
    if pair is None:
        note(f"no depth by {name}: no poses of it and {alpha} have such lines")
        return None
    exact = f"poses by {pair.points} points, {pair.distance:.2f} px from their epipolar lines; refining"
    rough = f"lines by F; depths are rough, by poses whose lines are {pair.distance:.2f} px off"
    note(f"{alpha} > {name}: {exact if pair.exact else rough}")
    return pair


def _refined(
    pair: RefinedPair, images: Images, bands: int | None, links: Mapping[tuple[str, str], Link]
) -> tuple[RefinedPair, MatchedDepth]:
    """Pair refined by dense matches at reduced size, unless it has one of these links; and their depth."""
    alpha, beta = pair.rig.names
    factor = min(COARSE / max(images[alpha].shape[-2:]), 1.0)
    small = {name: scaled(images[name], factor) for name in (alpha, beta)}
    link = links.get((alpha, beta))
    rig = resized_rig(pair.rig if link is None else pair.rig.replace(links={(alpha, beta): link}), small)
    with warnings.catch_warnings(action="ignore"):
        LOG.info("dense matches of %s and %s", alpha, beta)
        depth = matched_depth(small, rig, alpha=alpha, bands=bands if bands == len(small[beta]) else None)
    if link is not None:
        return pair, depth
    refined = refined_by_depth(pair._replace(rig=rig), small, *depth)
    if refined.rig is rig:
        return pair, depth
    return refined._replace(rig=resized_rig(refined.rig, images), distance=refined.distance / factor), depth


def _relative_scale(first: MatchedDepth, other: MatchedDepth) -> float:
    """Factor that brings another pair's depths to those of the first."""
    sure = (first.confidence > 0.5) & (other.confidence > 0.5)
    both = sure & first.depth.isfinite() & other.depth.isfinite()
    return float((first.depth[both] / other.depth[both]).median()) if both.any() else 1.0


def _moved(pairs: Pairs, maps: Mapping[str, Tensor]) -> dict[tuple[str, str], PointMatches]:
    """The matches in images whose pixels are A x of the old ones, A by camera."""
    return {
        (a, b): PointMatches(
            apply_homography(maps[a], points.alpha).x, apply_homography(maps[b], points.beta).x
        )
        for (a, b), points in pairs.items()
    }


def resized_rig(rig: Rig, images: Images) -> Rig:
    """Return the rig with its cameras resized to the images' sizes; `images` must have all of them."""
    for name in rig.names:
        rig = rig.resize(name, _hw(images[name]))
    return rig


def _hw(image: Tensor) -> HW:
    return int(image.shape[-2]), int(image.shape[-1])


def matching_factor(image: Float[Tensor, "c h w"]) -> float:
    """Return the factor that reduces an image to the size at which features are matched (`MATCHED`): at most
    1."""
    return min(MATCHED / max(image.shape[-2:]), 1.0)


def scaled(image: Float[Tensor, "c h w"], factor: float) -> Float[Tensor, "c h2 w2"]:
    """Reduce an image by a factor (bicubic, antialiased), to sides of at least 16 pixels.

    Returns:
        The image, clipped to 0..1; the same tensor, not clipped, for a factor of 1 or more.
    """
    if factor >= 1:
        return image
    hw = [max(round(n * factor), 16) for n in image.shape[-2:]]
    reduced = interpolate(image[None], size=hw, mode="bicubic", antialias=True, align_corners=False)
    return reduced[0].clamp(0, 1)


def _textured(label: str, image: Float[Tensor, "c h w"]) -> Float[Tensor, "_ h w"]:
    """Image, reduced to one band if all are equal. Raises ValueError for an image of one colour."""
    if float(image.flatten(1).std(-1, correction=0).amax()) < EVEN:
        raise ValueError(f"{label}: is of one colour, with nothing to match: give another image")
    return image[:1] if len(image) == 3 and not is_in_colour(image) else image


def _chosen_alpha(images: Images, alpha: str | None, note: Say) -> str:
    """Alpha as requested, or the largest grey image, or the largest of all."""
    if alpha is not None:
        if alpha not in images:
            raise ValueError(f"alpha: no camera '{alpha}'; the images' names are {', '.join(images)}")
        return alpha
    grey = [name for name, image in images.items() if len(image) == 1]
    chosen = max(grey or images, key=lambda name: math.prod(images[name].shape[-2:]))
    h, w = images[chosen].shape[-2:]
    why = "the largest grey image" if grey else "the largest image"
    if len(grey) == 1:
        why = "the only grey image"
    elif sum(images[name].shape[-2:] == (h, w) for name in grey or images) > 1:
        why = "the first of images of one size"
    note(f"alpha, whose view and detail the result has: {chosen} ({w}x{h}, {why}; --alpha takes another)")
    return chosen


def _ordered_betas(images: Images, alpha: str, note: Say) -> list[str]:
    """Betas in the order of their bands: as given if one is in colour, else from red to blue."""
    betas = [name for name in images if name != alpha]
    if any(len(images[name]) == 3 for name in betas):
        return betas
    waves = {name: _wavelength(name) for name in betas}
    if all(waves.values()):
        betas = sorted(betas, key=lambda name: -waves[name])
    shown = ", shown as red, green, blue by their names" if show_colour(betas, [1] * len(betas)) else ""
    note(f"bands: {', '.join(betas)}, each at alpha's view{shown}")
    return betas


def _weights_of(images: Images, alpha: str) -> str:
    """Name of the shipped weights for alpha and the betas of these images."""
    names = [name for name in images if name != alpha]
    bands = [len(images[name]) for name in names]
    return "mono-colour" if 3 in bands or show_colour(names, bands) else "mono-spectral"


def show_colour(names: Sequence[str], bands: Sequence[int]) -> bool:
    """Return True if cameras of one band each record, by their names, red, green and blue, in this order."""
    shown = [low <= _wavelength(name) <= high for name, (low, high) in zip(names, COLOURS)]
    return set(bands) == {1} and len(names) == 3 and all(shown)


def _wavelength(name: str) -> float:
    """Wavelength in nanometres by a camera's name, such as cam_550nm or green; 0 if it does not say."""
    if number := re.search(r"(?<!\d)([3-9]\d\d)(?:\s*nm)?(?!\d)", name):
        return float(number[1]) if float(number[1]) <= LONGEST_VISIBLE else 0.0
    words = re.split(r"[^a-z]+", name.lower())
    return next((float(w) for colour, w in WAVELENGTHS.items() if colour in words), 0.0)
