"""`pat sequence`: fuses frames in order of time, from cameras that need not be synchronised."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from . import options
from .batch import FuseBatch
from .fusing import Files, Recordings, with_sensor
from .options import Numbers, Out
from .parser import Option, UsageError

if TYPE_CHECKING:
    from arraygeom import Rig


@dataclass
class FuseSequence(FuseBatch):
    """Fuse frames in order of time into frames at alpha's view and a video; cameras may be unsynchronised.

    Examples:
        pat sequence fast.mp4 slow.mp4 --out out/
        pat sequence rig.yaml --alpha fast --image fast=fast/ --image slow=slow/ --frame-rate fast=120

    Every frame of alpha gets colour from the betas' frames nearest in time, by the rates and offsets of the
    rig. Without a rig it is found from each camera's first frame.
    """

    headings: ClassVar[Mapping[str, str]] = {
        "time": "frame_rate time_offset speed propagate video",
        **FuseBatch.headings,
    }
    command: ClassVar[str] = "sequence"
    takes_videos: ClassVar[bool] = True

    out: Out = Path("out")
    """Folder for NAME_fused.png and the like of each frame, called as alpha's file, and fused.mp4."""
    frame_rate: Numbers = ()
    """Frames a second of a camera, instead of the rig's."""
    time_offset: Numbers = ()
    """Seconds of a camera's first frame on a common clock, instead of the rig's."""
    speed: Annotated[float | None, Option("PIXELS")] = None
    """Fastest motion, pixels of alpha a second; by default estimated from alpha's frames."""
    video: Annotated[float | None, Option("RATE")] = None
    """Frames a second of the video; 0 for none. By default 25, and of videos as alpha has."""
    propagate: bool = True
    """Fuse each frame alone, without colour along motion: frames flicker."""

    def frames(self, files: Files) -> Files:
        """Return all files, with a warning where numbers are missing."""
        from ..frame_matching import warn_of_gaps

        warn_of_gaps(files)
        return files

    def timed(self, rig: Rig) -> Rig:
        """Return the rig with the cameras' frame rates and time offsets that the command line states.

        Raises:
            ValueError: for a camera that the rig lacks or that is given twice, text that is no number, and a
                rate that is not positive.
        """
        for entry, given in {"frame_rate": self.frame_rate, "time_offset": self.time_offset}.items():
            for name, value in options.numbers_by_name(given, f"--{entry.replace('_', '-')}").items():
                rig = with_sensor(rig, name, **{entry: value})
        return rig

    def judged_rig(self, recordings: Recordings) -> Recordings:
        """Return the recordings unchanged: first frames of unsynchronised cameras need not match."""
        return recordings

    def _fuse(self, recordings: Recordings) -> None:
        if self.video and self.bits == 32:
            options.warn("--video: of frames of 32 bits there is none: of no effect")
        if recordings.found is not None:
            clocks = {"--frame-rate": self.frame_rate, "--time-offset": self.time_offset}
            if named := [option for option, value in clocks.items() if value]:
                raise UsageError(", ".join(named), "a rig: give one with --rig RIG")
        rig = recordings.rig
        for name, rate in recordings.rates.items():
            if name in rig.names:
                rig = with_sensor(rig, name, frame_rate=rate)
        super()._fuse(recordings._replace(rig=rig))

    def kind_of_job(self) -> dict[str, Any]:
        """Return the entries of the job that make it a sequence."""
        further = {"sequence": True, "speed": self.speed, "alone": not self.propagate}
        return {"settings": self.fuse_settings(), **further}

    def video_rate(self, recordings: Recordings) -> float | None:
        """Return the requested frame rate, or that of alpha's video, or 25; None for no video."""
        rate = self.video if self.video is not None else recordings.rates.get(recordings.alpha, 25.0)
        return rate if rate and self.bits != 32 else None
