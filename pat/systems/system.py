"""Running a system: a scene is rendered for its rig, recorded, fused from files as a user's would be, and compared."""

from __future__ import annotations

import importlib
import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from arraygeom import Rig
from pat.classical import classical_band_calibrated
from pat.demo import classical
from pat.develop import read_views, to_linear
from pat.fuse import FusedFrame, fuse
from pat.hdr import merged, usable_range
from pat.images import luminance, to_luma_chroma, write_image, write_text
from pat.metrics import score
from pat.model import FusionNetwork
from pat.results import colour_depth, save_frame, save_panels, view_of
from pat.sensors import Coded
from pat.sequence import PictureFiles, SequenceFusion, flicker
from pat.video import write_video
from pat.weights import load_weights

NAMES = ("wide-narrow", "visible-nir", "exposures", "fast-slow")


@dataclass(frozen=True)
class Recording:
    """What the cameras recorded: raw values 0..1 by camera, frame by frame; alpha's view in truth (sRGB).

    `light` is the linear light that each camera saw, on alpha's scale, where that is asked about.
    """

    raw: Mapping[str, list[Float[Tensor, "_ _ _"]]]
    truth: list[Float[Tensor, "3 h w"]]
    light: Mapping[str, Float[Tensor, "1 _ _"]] = field(default_factory=dict)


@dataclass(frozen=True)
class System:
    """One of the paper's arrays: its rig at full size, and how it is run (see the modules of the four)."""

    name: str
    rig: Rig
    module: ModuleType

    @property
    def title(self) -> str:
        """What it is, in a line."""
        return str(self.module.TITLE)

    @property
    def alpha(self) -> str:
        """The first camera."""
        return self.rig.names[0]

    @property
    def expected(self) -> str:
        """The figures that `run` gave when they were last looked at, at reduced size."""
        file = Path(self.module.__file__ or "").with_name("expected.md")
        return file.read_text(encoding="utf-8") if file.is_file() else ""

    def sized(self, full: bool, *, scale: float = 1.0) -> Rig:
        """The rig at full size, or at `scale` times the reduced one; raw pictures keep even sides."""
        rig = self.rig
        for name in rig.names if not full else ():
            h, w = (max(round(n * scale * self.module.REDUCED / 2) * 2, 16) for n in rig[name].hw)
            rig = rig.resize(name, (h, w))
        return rig


class Result(NamedTuple):
    """The table that was written, and the files."""

    table: str
    written: list[Path]


def load_system(name: str) -> System:
    """A system by name. Raises ValueError naming those there are."""
    if name not in NAMES:
        raise ValueError(f"no system '{name}': there are {', '.join(NAMES)}")
    module = importlib.import_module(f"pat.systems.{name.replace('-', '_')}")
    return System(name, Rig.load(Path(module.__file__ or "").with_name("rig.yaml")), module)


def run_system(
    name: str,
    out: Path,
    *,
    full: bool = False,
    scale: float = 1.0,
    photos: Path | None = None,
    weights: str = "mono-colour",
    max_memory: str | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> Result:
    """Render, record, fuse and compare; inputs, pictures, figure.png and scores.md go to `out`.

    At `full` size, or at `scale` times the reduced one, which is minutes on two cores; half of it is seconds.
    `photos` is a folder of pictures for the scene's textures; without, patterns and scikit-image's pictures are used.
    """
    from .stage import Stage

    system = load_system(name)
    module, rig = system.module, system.sized(full, scale=scale)
    say(f"rendering and recording {', '.join(f'{n} {rig[n].hw[1]}x{rig[n].hw[0]}' for n in rig.names)}")
    stage = Stage(rig, system.alpha, depths=module.DEPTHS, layers=module.LAYERS, photos=photos, seed=module.SEED)
    recording = module.record_scene(stage)
    files = write_recording(recording, rig, out / "inputs")
    say("fusing")
    network = load_weights(weights)
    run = _sequence if len(recording.truth) > 1 else _still
    lines, panels = run(network, system, rig, files, recording, out, {"max_memory": max_memory})
    save_panels(panels, out / "figure.png", columns=4)
    table = "\n".join(lines) + "\n"
    write_text(out / "scores.md", table)
    return Result(table, sorted(p for p in out.iterdir() if p.is_file()))


def write_recording(recording: Recording, rig: Rig, out: Path) -> dict[str, list[Path]]:
    """The pictures as cameras store them, 16 bits with the counts of the rig's, the truth, and the rig."""
    out.mkdir(parents=True, exist_ok=True)
    rig.save(out / "rig.yaml")
    files: dict[str, list[Path]] = {}
    for name, pictures in recording.raw.items():
        white = 2 ** (rig[name].sensor.bits or 16) - 1
        files[name] = [out / f"{name}_{i:03d}.png" for i in range(len(pictures))]
        for path, picture in zip(files[name], pictures):
            counts = (picture.clamp(0, 1) * white).round()
            write_image(path, counts / 65535, bits=16)
    for i, picture in enumerate(recording.truth):
        write_image(out / f"truth_{i:03d}.png", picture, bits=16)
    return files


Panels = dict[str, Tensor]


def _still(
    network: FusionNetwork,
    system: System,
    rig: Rig,
    files: Mapping[str, list[Path]],
    recording: Recording,
    out: Path,
    options: Mapping[str, Any],
) -> tuple[list[str], Panels]:
    alpha, truth = system.alpha, recording.truth[0]
    read, images = read_views(rig, {name: paths[0] for name, paths in files.items()}, alpha=alpha)
    frame = fuse(network, read, images, alpha=alpha, **options)
    baseline = classical_baseline(read, images, alpha)
    rows = {"alpha alone": images[alpha].expand(3, -1, -1), "classical": baseline, "fusion": frame.image}
    extra: list[str] = []
    if recording.light:
        merged_frame = merged(frame, rig, images, alpha)
        rows["fusion, exposures merged"] = merged_frame.image
        extra = [
            *_ranges(rig, recording, images, frame, merged_frame, alpha),
            *_permuted(network, read, images, alpha, frame),
        ]
        write_image(out / "merged.tif", to_linear(merged_frame.image.clamp(min=0)), bits=32)
    save_frame(frame, out, bits=16, view=view_of(read, alpha, bits=16))
    white = 1.0 if not recording.light else float(truth.max())
    panels = {f"{n}{' (alpha)' if n == alpha else ''}": images[n] for n in rig.names}
    panels |= {"truth": truth, **{n: p for n, p in rows.items() if n != "alpha alone"}}
    panels |= {"depth (bright is near)": colour_depth(frame.depth), "confidence": frame.confidence[None]}
    return [*_table(rows, truth, white), *_known_where(frame, truth), *extra], panels


def _sequence(
    network: FusionNetwork,
    system: System,
    rig: Rig,
    files: Mapping[str, list[Path]],
    recording: Recording,
    out: Path,
    options: Mapping[str, Any],
) -> tuple[list[str], Panels]:
    alpha = system.alpha
    frames = {name: PictureFiles(paths, rig, name, alpha=alpha) for name, paths in files.items()}
    job = SequenceFusion(network, rig, frames, alpha, options=options)
    keys = job.timeline.key_frames()
    colours = {key.alpha: job.colour(key) for key in keys}
    fused = [job.frame(i, keys, lambda key: colours[key.alpha]) for i in range(len(recording.truth))]
    alone = [job.alone(i) for i in range(len(fused))]
    for i, frame in enumerate(fused):
        save_frame(frame, out / "frames", name=f"{i:03d}", view=view_of(rig, alpha, bits=8))
    write_video(out / "fused.mp4", [f.image for f in fused], rate=10)
    greys = [job.grey(i) for i in range(len(fused))]
    base = [classical_baseline(rig, _pictures(job, i), alpha) for i in range(len(fused))]
    methods = {
        "alpha alone": [g.expand(3, -1, -1) for g in greys],
        "classical": base,
        "fusion, each frame alone": [f.image for f in alone],
        "fusion": [f.image for f in fused],
    }
    lines = [*_sequence_table(methods, recording.truth, greys), *_known_where(fused[2], recording.truth[2])]
    i = next(i for i in range(len(fused)) if i not in colours)
    first = next(name for name in rig.betas(alpha))
    panels = {f"alpha, frame {i}": greys[i], f"beta {first}": frames[first][0], "truth": recording.truth[i]}
    panels |= {n: p[i] for n, p in methods.items() if n != "alpha alone"}
    panels |= {"confidence": fused[i].confidence[None], "confidence, frame alone": alone[i].confidence[None]}
    return lines, panels


def _pictures(job: SequenceFusion, i: int) -> dict[str, Tensor]:
    return {job.alpha: job.grey(i), **{n: job.frames[n][j] for n, j in job.timeline.at(i).items()}}


def classical_baseline(rig: Rig, images: Mapping[str, Tensor], alpha: str) -> Float[Tensor, "3 h w"]:
    """The classical fusion: with the one colour beta, or with each of the betas that see one band."""
    betas = [name for name in rig.betas(alpha) if name in images]
    if images[betas[0]].shape[0] == 3:
        return classical(rig, dict(images), alpha, betas[0])
    return torch.cat([_band(rig, images, alpha, name) for name in betas])


def _band(rig: Rig, images: Mapping[str, Tensor], alpha: str, name: str) -> Tensor:
    pair = rig.pair(alpha, name)
    (a, b), pose = pair.cameras, pair.beta_from_alpha
    near, far = (float(d) for d in pair.depth_range)
    return classical_band_calibrated(images[alpha], images[name], a.K, b.K, pose.R, pose.t, depth=(near, far))


def _table(rows: Mapping[str, Tensor], truth: Tensor, white: float) -> list[str]:
    lines = ["| | PSNR, dB | SSIM |", "| --- | ---: | ---: |"]
    for name, picture in rows.items():
        found = score((picture / white).clamp(0, 1), truth / white)
        lines.append(f"| {name} | {found.psnr:.2f} | {found.ssim:.4f} |")
    return lines


def _sequence_table(methods: Mapping[str, list[Tensor]], truth: list[Tensor], greys: list[Tensor]) -> list[str]:
    lines = ["| | PSNR, dB | lowest | SSIM | flicker x 1000 |", "| --- | ---: | ---: | ---: | ---: |"]
    for name, pictures in {**methods, "truth": truth}.items():
        scores = [score(p.clamp(0, 1), t) for p, t in zip(pictures, truth)]
        levels, ssim = [s.psnr for s in scores], sum(s.ssim for s in scores) / len(scores)
        shown = f"{1000 * flicker(pictures, greys):.2f}"
        figures = (
            ("", "", "")
            if name == "truth"
            else (f"{sum(levels) / len(levels):.2f}", f"{min(levels):.2f}", f"{ssim:.4f}")
        )
        lines.append(f"| {name} | {' | '.join(figures)} | {shown} |")
    return [
        "Means over the frames; flicker is the mean change of chroma from frame to frame where nothing moves.",
        "",
        *lines,
    ]


WRONG = 0.1
"""Chroma farther off than this counts as a wrong colour."""


def _known_where(frame: FusedFrame, truth: Tensor) -> list[str]:
    """Whether confidence knows where colour is wrong: among the surest and the least sure quarter of the pixels."""
    off = (to_luma_chroma(frame.image)[1] - to_luma_chroma(truth)[1]).abs().amax(0).flatten()
    order = frame.confidence.flatten().argsort()
    quarter = len(order) // 4
    sure, doubtful = (float((off[part] > WRONG).float().mean()) for part in (order[-quarter:], order[:quarter]))
    return ["", f"Wrong colours: {sure:.1%} of the quarter where confidence is highest, {doubtful:.1%} where lowest."]


def _ranges(
    rig: Rig, recording: Recording, images: Mapping[str, Tensor], frame: FusedFrame, joint: FusedFrame, alpha: str
) -> list[str]:
    """A table of the range of light that each picture tells right to a quarter."""
    lines = ["", "| light told right to a quarter | darkest | brightest | stops |", "| --- | ---: | ---: | ---: |"]
    told = {name: (to_linear(images[name])[0], recording.light[name][0]) for name in rig.names}
    truth = to_linear(recording.truth[0])
    for name, picture in {"fusion": frame.image, "fusion, exposures merged": joint.image}.items():
        told[name] = (luminance(to_linear(picture.clamp(min=0)))[0], luminance(truth)[0])
    for name, (value, light) in told.items():
        found = usable_range([value], [light])
        lines.append(f"| {name} | {found.low:.4f} | {found.high:.3f} | {found.stops:.1f} |")
    return lines


def _permuted(
    network: FusionNetwork, rig: Rig, images: Mapping[str, Tensor], alpha: str, frame: FusedFrame
) -> list[str]:
    """How far a fusion with the betas in another order differs from the same fusion with its bands reordered."""
    betas = rig.betas(alpha)
    order = [2, 0, 1]
    turned = rig.replace(cameras={n: rig[n] for n in (alpha, *(betas[i] for i in order))})
    other = fuse(network, turned, images, alpha=alpha).image
    same = score(other.clamp(0, 1), frame.image[order].clamp(0, 1)).psnr
    left = score(other.clamp(0, 1), frame.image.clamp(0, 1)).psnr
    return ["", f"Betas in another order: the bands follow to {same:.1f} dB (against the former order: {left:.1f} dB)."]


def coded(linear: Float[Tensor, "c h w"]) -> Float[Tensor, "c h w"]:
    """Linear light coded as sRGB."""
    return Coded().apply(linear[None], Generator())[0]


def mosaic(rgb: Float[Tensor, "3 h w"], pattern: str) -> Float[Tensor, "1 h w"]:
    """What a sensor behind a colour filter mosaic records: one of the three colours at each pixel."""
    raw = torch.empty_like(rgb[:1])
    for i, (row, column) in enumerate(itertools.product((0, 1), (0, 1))):
        raw[0, row::2, column::2] = rgb["RGB".index(pattern[i]), row::2, column::2]
    return raw
