"""Runs a system: a scene is rendered for its rig, recorded to files, fused from them and compared."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from arraygeom import Rig
from arraygeom.runtime.atomic import write_text
from experiments.hdr import merged, missed, tone_curve, usable_range
from experiments.names import refuse_unknown
from pat import fuse
from pat.app.results import save_frame, view_of
from pat.fusion.classical import classical_baseline
from pat.fusion.frame import Frame
from pat.fusion.frames import ImageFiles
from pat.fusion.fuse import FuseSettings
from pat.fusion.sequence import SequenceFusion
from pat.fusion.views import ViewFiles
from pat.lab.evaluation.tables import markdown_table
from pat.media.colour import linear_from_srgb, luminance, to_bytes, to_luma_chroma
from pat.media.figures import colour_depth, save_panels
from pat.media.images import write_image
from pat.media.raw import match_luminance
from pat.media.video import write_video
from pat.networks.protocol import FusionNetwork
from pat.networks.weights import Network, load_weights
from pat.support.metrics import score

SceneKind = Literal["layered", "rendered"]
NAMES = ("wide-narrow", "visible-nir", "exposures", "fast-slow")


@dataclass(frozen=True)
class SystemRecording:
    """Raw values 0..1 by camera, frame by frame, and the ground truth: alpha's view (sRGB).

    `light` is the linear light that each camera received, on alpha's scale, for systems that need it.
    """

    raw: Mapping[str, list[Float[Tensor, "_ _ _"]]]
    ground_truth: list[Float[Tensor, "3 h w"]]
    light: Mapping[str, Float[Tensor, "1 _ _"]] = field(default_factory=dict)


@dataclass(frozen=True)
class ArraySystem:
    """One of the paper's arrays: its rig at full size, and the module that renders and records it."""

    name: str
    rig: Rig
    module: ModuleType

    @property
    def title(self) -> str:
        """A line of description."""
        return str(self.module.TITLE)

    @property
    def alpha(self) -> str:
        """The first camera."""
        return self.rig.names[0]

    @property
    def expected(self) -> str:
        """The table that `run_system` gave at reduced size when it was last recorded."""
        return Path(self.module.__file__ or "").with_name("expected.md").read_text(encoding="utf-8")

    def sized(self, full: bool, *, scale: float = 1.0) -> Rig:
        """The rig at full size, or at `scale` times the reduced one; raw images keep even sides."""
        rig = self.rig
        for name in rig.names if not full else ():
            h, w = (max(round(n * scale * self.module.REDUCED / 2) * 2, 16) for n in rig[name].hw)
            rig = rig.resize(name, (h, w))
        return rig


Panels = dict[str, Tensor]


class SystemResult(NamedTuple):
    """The table that was written, the files, and the images of the figure by title."""

    table: str
    written: list[Path]
    panels: Panels


def load_system(name: str) -> ArraySystem:
    """A system by name. Raises ValueError listing the names."""
    refuse_unknown("no system", [name], NAMES)
    module = importlib.import_module(f"experiments.{name.replace('-', '_')}")
    return ArraySystem(name, Rig.load(Path(module.__file__ or "").with_name("rig.yaml")), module)


def run_system(
    name: str,
    out: Path,
    *,
    full: bool = False,
    scale: float = 1.0,
    scene: SceneKind = "layered",
    weights: str = "mono-colour",
    max_memory: str | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> SystemResult:
    """Render, record, fuse and compare; inputs, images, figure.png and scores.md go to `out`.

    At `full` size, or at `scale` times the reduced one, which is minutes on two cores; half of it is seconds.
    `scene` is layered photographs, or a believable one rendered with Blender.
    """
    system = load_system(name)
    rig = system.sized(full, scale=scale)
    say(f"rendering and recording {', '.join(f'{n} {rig[n].hw[1]}x{rig[n].hw[0]}' for n in rig.names)}")
    recording = system.module.record_scene(_stage(system, rig, scene))
    files = write_recording(recording, rig, out / "inputs")
    say("fusing")
    run = _sequence if len(recording.ground_truth) > 1 else _still
    lines, panels = run(Recorded(rig, files, recording, out, load_weights(weights), max_memory))
    save_panels(panels, out / "figure.png", columns=4)
    table = "\n".join(lines) + "\n"
    write_text(out / "scores.md", table)
    return SystemResult(table, files_of(out), panels)


def files_of(folder: Path) -> list[Path]:
    """List the files in a folder itself, in order."""
    return sorted(path for path in folder.iterdir() if path.is_file())


def _stage(system: ArraySystem, rig: Rig, scene: SceneKind) -> Any:
    """The scene before the cameras, with what a system's module asks of it."""
    from .stage import RenderedScene, SystemScene

    module = system.module
    if scene == "layered":
        depths, layers = module.DEPTHS, module.LAYERS
        return SystemScene(rig, system.alpha, depths=depths, layers=layers, seed=module.SEED)
    frames, rate = getattr(module, "FRAMES", 1), rig[system.alpha].sensor.frame_rate or 1.0
    duration = 0.0 if frames == 1 else frames / rate
    moving, infrared = getattr(module, "MOVING", 0.0), "nir" in rig.names
    return RenderedScene(
        rig, module.GENERATOR, module.SEED, infrared=infrared, moving=moving, duration=duration
    )


def write_recording(recording: SystemRecording, rig: Rig, out: Path) -> dict[str, list[Path]]:
    """The raw images as 16-bit files with the rig's counts, which are returned; the ground truth, the rig."""
    out.mkdir(parents=True, exist_ok=True)
    rig.save(out / "rig.yaml")
    files = {}
    for name, images in recording.raw.items():
        white = 2 ** (rig[name].sensor.bits or 16) - 1
        files[name] = [out / f"{name}_{i:03d}.png" for i in range(len(images))]
        for file, image in zip(files[name], images):
            write_image(file, (image.clamp(0, 1) * white).round() / 65535, bits=16)
    for i, image in enumerate(recording.ground_truth):
        write_image(out / f"ground_truth_{i:03d}.png", image, bits=16)
    return files


class Recorded(NamedTuple):
    """A recorded system, its first camera alpha, and how it is fused."""

    rig: Rig
    files: Mapping[str, list[Path]]
    recording: SystemRecording
    out: Path
    network: Network
    max_memory: str | None


def _still(recorded: Recorded) -> tuple[list[str], Panels]:
    """One frame fused and compared: lines of the table, and panels of the figure."""
    rig, files, recording, out, network, max_memory = recorded
    alpha, ground_truth = rig.names[0], recording.ground_truth[0]
    views = ViewFiles(rig, {name: paths[0] for name, paths in files.items()}, alpha=alpha)
    read, images = views.developed, dict(views)
    frame = fuse(images, read, alpha=alpha, network=network, settings=FuseSettings(max_memory=max_memory))
    save_frame(frame, out, bits=16, view=view_of(read, alpha, bits=16))
    baseline = classical_baseline(read, images, alpha)
    if len(images) == 2:
        baseline = match_luminance(baseline, images[alpha], read[alpha].sensor)
    rows = {"alpha alone": images[alpha].expand(3, -1, -1), "classical": baseline, "fusion": frame.image}
    extra: list[str] = []
    if recording.light:
        merged_frame = merged(frame, rig, images, alpha)
        rows["fusion, exposures merged"] = merged_frame.image
        extra = _ranges(rig, recording, images, frame, merged_frame)
        extra += _permuted(network, read, images, alpha, frame)
        write_image(out / "merged.tif", linear_from_srgb(merged_frame.image.clamp(min=0)), bits=32)
    white = 1.0 if not recording.light else float(ground_truth.max())
    panels = {f"{n}{' (alpha)' if n == alpha else ''}": images[n] for n in rig.names}
    for name, light in recording.light.items():
        panels[f"{name}: clipped red, noisy blue"] = missed(images[name], light)
    compared = {"ground truth": ground_truth, **{n: p for n, p in rows.items() if n != "alpha alone"}}
    shown = tone_curve(ground_truth) if recording.light else torch.Tensor.clone
    panels |= {name: shown(image) for name, image in compared.items()}
    panels |= {"depth (red is near)": colour_depth(frame.depth), "confidence": frame.confidence[None]}
    scores = [*_table(rows, ground_truth, white), *_confidence_line(frame, ground_truth)]
    return [*scores, *extra], panels


def _sequence(recorded: Recorded) -> tuple[list[str], Panels]:
    """All frames fused, with and without propagated colour, and compared."""
    rig, files, recording, out, network, max_memory = recorded
    alpha, ground_truth = rig.names[0], recording.ground_truth
    frames = {name: ImageFiles(paths, rig, name, alpha=alpha) for name, paths in files.items()}
    fusion = SequenceFusion(network, rig, frames, alpha, settings=FuseSettings(max_memory=max_memory))
    colours, fused = fused_frames(fusion, len(ground_truth))
    by_themselves = [fusion.alone(i) for i in range(len(fused))]
    for i, frame in enumerate(fused):
        save_frame(frame, out / "frames", name=f"{i:03d}", view=view_of(rig, alpha, bits=8))
    write_video(out / "fused.mp4", [f.image for f in fused], rate=10)
    greys = [fusion.grey(i) for i in range(len(fused))]
    methods = {
        "alpha alone": [g.expand(3, -1, -1) for g in greys],
        "classical": [classical_baseline(rig, _images(fusion, i), alpha) for i in range(len(fused))],
        "fusion, each frame alone": [f.image for f in by_themselves],
        "fusion": [f.image for f in fused],
    }
    lines = [*_sequence_table(methods, ground_truth, greys), *_confidence_line(fused[2], ground_truth[2])]
    i = next(i for i in range(len(fused)) if i not in colours)
    first = next(name for name in rig.betas(alpha))
    panels = {f"alpha, frame {i}": greys[i], f"beta {first}": frames[first][0]}
    panels["ground truth"] = ground_truth[i]
    panels |= {n: p[i] for n, p in methods.items() if n != "alpha alone"}
    panels |= {
        "confidence": fused[i].confidence[None],
        "confidence, frame alone": by_themselves[i].confidence[None],
    }
    return lines, panels


def fused_frames(fusion: SequenceFusion, count: int) -> tuple[set[int], list[Frame]]:
    """The numbers of the key frames, and all frames with colour propagated from these."""
    keys = fusion.timeline.key_frames()
    colours = {key.alpha: fusion.colour(key) for key in keys}
    return set(colours), [fusion.frame(i, keys, lambda key: colours[key.alpha]) for i in range(count)]


def _images(fusion: SequenceFusion, i: int) -> dict[str, Tensor]:
    betas = {n: fusion.frames[n][j] for n, j in fusion.timeline.at(i).items()}
    return {fusion.alpha: fusion.grey(i), **betas}


def _table(rows: Mapping[str, Tensor], ground_truth: Tensor, white: float) -> list[str]:
    scores = {name: score((image / white).clamp(0, 1), ground_truth / white) for name, image in rows.items()}
    cells = [(name, f"{of_method.psnr:.2f}", f"{of_method.ssim:.4f}") for name, of_method in scores.items()]
    return markdown_table(["", "PSNR, dB", "SSIM"], cells).splitlines()


def _sequence_table(
    methods: Mapping[str, list[Tensor]], ground_truth: list[Tensor], greys: list[Tensor]
) -> list[str]:
    """Scores and flicker of each method, means over the frames."""
    rows = []
    for name, images in methods.items():
        scores = [score(p.clamp(0, 1), t) for p, t in zip(images, ground_truth)]
        psnr, ssim = ([getattr(s, kind) for s in scores] for kind in ("psnr", "ssim"))
        figures = (f"{sum(psnr) / len(psnr):.2f}", f"{min(psnr):.2f}", f"{sum(ssim) / len(ssim):.4f}")
        rows.append((name, *figures, f"{1000 * flicker(images, greys):.2f}"))
    rows.append(("ground truth", "", "", "", f"{1000 * flicker(ground_truth, greys):.2f}"))
    table = markdown_table(["", "PSNR, dB", "lowest", "SSIM", "flicker x 1000"], rows)
    note = "flicker is the mean change of chroma from frame to frame where nothing moves."
    return [f"Means over the frames; {note}", "", *table.splitlines()]


STILL = 0.5
"""Pixels that move less than this between two frames are still."""


def flicker(images: Sequence[Float[Tensor, "3 h w"]], greys: Sequence[Float[Tensor, "1 h w"]]) -> float:
    """Mean change of chroma (R - Y, B - Y) from frame to frame where nothing moves, 0..1.

    `greys` are alpha's frames, which show what moves. Raises ValueError for fewer than two frames.
    """
    if len(images) < 2:
        raise ValueError("flicker needs two frames or more")
    changes = []
    for (a, b), (grey_a, grey_b) in zip(pairwise(images), pairwise(greys)):
        change = (to_luma_chroma(b)[1] - to_luma_chroma(a)[1]).abs().mean(0)
        changes.append(float(change[still(grey_a, grey_b)].mean()))
    return sum(changes) / len(changes)


def still(a: Float[Tensor, "1 h w"], b: Float[Tensor, "1 h w"]) -> Bool[Tensor, "h w"]:
    """Where nothing moves from frame a to b, and nothing near does."""
    engine = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    flow = engine.calc(to_bytes(a[0]), to_bytes(b[0]), np.empty(0, np.float32))
    moves = (np.square(flow).sum(-1) > STILL**2).astype(np.uint8)
    return torch.from_numpy(cv2.dilate(moves, np.ones((9, 9), np.uint8)) == 0)


WRONG = 0.1
"""Chroma farther off than this counts as a wrong colour."""


def _confidence_line(frame: Frame, ground_truth: Tensor) -> list[str]:
    """Shares of wrong colours among the quarters of the pixels with the highest and the lowest confidence."""
    off = (to_luma_chroma(frame.image)[1] - to_luma_chroma(ground_truth)[1]).abs().amax(0).flatten()
    order = frame.confidence.flatten().argsort()
    quarter = len(order) // 4
    high, low = (
        float((off[pixels] > WRONG).float().mean()) for pixels in (order[-quarter:], order[:quarter])
    )
    share = f"{high:.1%} of the quarter where confidence is highest, {low:.1%} where lowest."
    return ["", f"Wrong colours: {share}"]


def _ranges(
    rig: Rig, recording: SystemRecording, images: Mapping[str, Tensor], frame: Frame, joint: Frame
) -> list[str]:
    """A table of the range of light that each image measures with an error of at most a quarter."""
    measured = {name: (linear_from_srgb(images[name])[0], recording.light[name][0]) for name in rig.names}
    ground_truth = linear_from_srgb(recording.ground_truth[0])
    for name, image in {"fusion": frame.image, "fusion, exposures merged": joint.image}.items():
        measured[name] = (luminance(linear_from_srgb(image.clamp(min=0)))[0], luminance(ground_truth)[0])
    ranges = {name: usable_range(value, light) for name, (value, light) in measured.items()}
    rows = [(name, f"{r.low:.4f}", f"{r.high:.3f}", f"{r.stops:.1f}") for name, r in ranges.items()]
    columns = ["light measured to a quarter", "darkest", "brightest", "stops"]
    return ["", *markdown_table(columns, rows).splitlines()]


def _permuted(
    network: FusionNetwork, rig: Rig, images: Mapping[str, Tensor], alpha: str, frame: Frame
) -> list[str]:
    """Return lines of text on a fusion with betas in another order against the same fusion with bands
    reordered."""
    betas = rig.betas(alpha)
    order = [2, 0, 1]
    permuted = rig.replace(cameras={n: rig[n] for n in (alpha, *(betas[i] for i in order))})
    other = fuse(images, permuted, alpha=alpha, network=network).image
    same, before = (
        score(other.clamp(0, 1), image.clamp(0, 1)).psnr for image in (frame.image[order], frame.image)
    )
    follow = f"the bands follow to {same:.1f} dB (against the former order: {before:.1f} dB)."
    return ["", f"Betas in another order: {follow}"]
