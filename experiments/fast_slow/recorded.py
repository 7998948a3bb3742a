"""The paper's own recording of this array: seven fast frames, and two of each slow camera."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from torch import Tensor

from arraygeom import HomographyDisplacement, Rig
from arraygeom.runtime.atomic import write_text
from experiments.showcase import FAST, SCENE, SLOW, bright_gain, fast_and_slow_array
from experiments.system import SystemResult, files_of, flicker, fused_frames
from pat.app.cli.fusing import with_sensor
from pat.app.results import save_frame
from pat.fusion.frame import Frame
from pat.fusion.fuse import FuseSettings
from pat.fusion.sequence import SequenceFusion
from pat.lab.evaluation.tables import markdown_table
from pat.media.colour import luminance_of, srgb_image
from pat.media.figures import save_panels
from pat.media.images import read_image
from pat.media.video import write_video
from pat.networks.weights import load_weights

FAST_FRAMES, SLOW_FRAMES = range(141, 148), (4, 5)
RATES = {FAST: 227.0, **dict.fromkeys(SLOW, 30.0)}
DETAIL = (slice(300, 800), slice(600, 1200))
"""Rows and columns around the moving object."""


def run_recorded(folder: Path, out: Path, *, weights: str, say: Callable[[str], None]) -> SystemResult:
    """Fuse the seven frames with and without propagating colour; write images, a video and scores.md.

    Frame 141 is taken to be simultaneous with slow frame 4, and the rates to be the paper's: offsets are not
    published.
    """
    say("fitting the lines of each pair to points seen in both images")
    array = fast_and_slow_array(folder)
    rig, frames = array.rig, recorded_frames(folder)
    for name, rate in RATES.items():
        rig = with_sensor(rig, name, frame_rate=rate)
    settings = FuseSettings(field=HomographyDisplacement(array.displacement), match_levels=True)
    job = SequenceFusion(load_weights(weights), rig, frames, FAST, settings=settings)
    keys = [str(FAST_FRAMES[key.alpha]) for key in job.timeline.key_frames()]
    say(f"fusing key frames {', '.join(keys)}, then all")
    _, fused = fused_frames(job, len(FAST_FRAMES))
    say("fusing each frame alone, to compare")
    by_themselves = [job.alone(i) for i in range(len(FAST_FRAMES))]
    methods = {"each frame alone": by_themselves, "colour propagated": fused}
    flickers = {n: flicker([f.image for f in of_method], frames[FAST]) for n, of_method in methods.items()}
    rows = [(name, f"{1000 * value:.2f}") for name, value in flickers.items()]
    note = "Flicker is the mean change of chroma from frame to frame where nothing moves.\n"
    table = f"{markdown_table(['', 'flicker x 1000'], rows)}\n{note}"
    _write(out, array.rig, frames[FAST], fused, by_themselves)
    write_text(out / "scores.md", table)
    return SystemResult(table, files_of(out), {})


def recorded_frames(folder: Path) -> dict[str, list[Tensor]]:
    """The frames, taken as linear, sRGB-encoded; alpha's brightest 0.5% in the first are brought to white."""
    raw = {FAST: [read_image(folder / SCENE / f"{i}.png") for i in FAST_FRAMES]}
    raw |= {name: [read_image(folder / SCENE / f"{name}_{i}.png") for i in SLOW_FRAMES] for name in SLOW}
    gains = {FAST: bright_gain(raw[FAST][0])}
    return {n: [srgb_image(luminance_of(p) * gains.get(n, 1.0)) for p in images] for n, images in raw.items()}


def _write(out: Path, rig: Rig, alpha: list[Tensor], fused: list[Frame], alone: list[Frame]) -> None:
    """Frames, video, rig and figures."""
    for number, frame in zip(FAST_FRAMES, fused):
        save_frame(frame, out / "frames", name=str(number))
    write_video(out / "fused.mp4", [f.image for f in fused], rate=5)
    rig.save(out / "rig.yaml")
    rows, columns = DETAIL
    detail = {f"frame {n}": f.image[:, rows, columns] for n, f in zip(FAST_FRAMES, fused)}
    detail |= {"confidence, 144": fused[3].confidence[None, rows, columns]}
    detail |= {f"frame {n} alone": f.image[:, rows, columns] for n, f in zip(FAST_FRAMES, alone)}
    detail |= {"confidence, 144 alone": alone[3].confidence[None, rows, columns]}
    save_panels(detail, out / "details.png", columns=4)
    save_panels({"alpha, 144": alpha[3], "fused, 144": fused[3].image}, out / "figure.png", columns=2)
