"""`pat batch`: fuses many frames of an array, each to one image."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from . import options
from .fusing import Fusing, Recordings
from .options import Address, Out, say
from .parser import Option, UsageError


@dataclass
class FuseBatch(Fusing):
    """Fuse many frames of an array, one by one: folders, or quoted patterns, of each camera's images.

    Examples:
        pat batch mono/ colour/ --out out/
        pat batch rig.yaml --alpha mono --image "mono=day1/m_*.png" --image "colour=day1/c_*.png" --workers 4

    Frames are matched by names or by the numbers or times in them. Without a rig it is found from the first
    frame, and written to found_rig.yaml beside the results. `pat sequence` fuses frames in order of time.
    """

    headings: ClassVar[Mapping[str, str]] = {
        "many frames": "workers scheduler threads resume on_error",
        "the rig, and where to search": "misfit focal field",
        "brightness and noise": "response match_levels noise luminance",
        "files and memory": "format max_memory",
    }

    out: Out = Path("out")
    """Folder for NAME_fused.png and the like of each frame, called as alpha's file."""
    workers: int = 1
    """Processes on this machine."""
    scheduler: Address = None
    """Address of a Dask scheduler whose workers fuse the frames, such as tcp://host:8786."""
    threads: Annotated[int | None, Option("N")] = None
    """Threads in each process: by default 1 with several, else all cores."""
    resume: bool = False
    """Fuse only frames not in --out yet, or whose images changed."""
    on_error: Literal["stop", "skip"] = "stop"
    """What to do if a frame cannot be fused (a corrupt image, a full disk): stop, or report it and go on."""

    def run(self) -> None:
        """Fuse the frames with the given rig or one found from the images; exits with status 1 if some fail.

        Raises:
            UsageError: for invalid options.
            ValueError: for images or a rig that cannot be used, and as `Batch.run`.
            FileNotFoundError: for a missing file, and unknown weights.
            FileExistsError: for files in the way that no run wrote.
            OSError: if files cannot be written.
            ImportError: for a video or a scheduler without its package.
            SystemExit: with status 1, if frames failed and `on_error` is "skip"; and as `judged`.
        """
        for option, count in {"--workers": self.workers, "--threads": self.threads}.items():
            if count is not None and count < 1:
                raise UsageError(option, "1 or more", count)
        image, with_rig = self.named(self.command)
        from arraygeom.runtime.threads import limited_to

        found = self.recordings(image, with_rig=with_rig)
        with self.judged(), limited_to(self.threads), found as recordings:
            self._fuse(recordings)

    command: ClassVar[str] = "batch"

    def _fuse(self, recordings: Recordings) -> None:
        from arraygeom.io.native import write
        from arraygeom.runtime.together import refuse_others, write_listed

        from ..results import FOUND_RIG

        if recordings.found is None:
            return self._many(self.judged_rig(recordings))
        path, text = self.out / FOUND_RIG, write(recordings.rig)
        refuse_others(self.out, [FOUND_RIG])
        if not path.exists():  # frames that fail may want it; another job's is kept until this one is done
            write_listed(path, text)
        say(f"the rig that was found: {path}")
        self._many(recordings)
        write_listed(path, text)

    def judged_rig(self, recordings: Recordings) -> Recordings:
        """Return the recordings with the rig as corrected by their first frame."""
        from ...fusion.views import ViewFiles

        views = ViewFiles(recordings.rig, recordings.first, alpha=recordings.alpha)
        return recordings._replace(rig=self.healed(views))

    def _many(self, recordings: Recordings) -> None:
        from ...support.jobs import Workers, cores
        from .. import batch

        job = batch.Batch(
            recordings.rig,
            recordings.files,
            recordings.rig.require(recordings.alpha),
            self.out,
            bits=self.bits,
            kind=self.kind,
            strict=self.misfit == "refuse",
            weights=self.network or "mono-colour",
            **self.kind_of_job(),
        )
        several = self.workers > 1 or self.scheduler is not None
        threads = self.threads if self.threads is not None else 1 if several else cores()
        video = self.video_rate(recordings)
        report = job.run(
            workers=Workers(self.workers, self.scheduler, threads),
            resume=self.resume,
            on_error=self.on_error,
            video=video,
            console=options.console(),
        )
        shown = video is not None and (self.out / "fused.mp4").is_file()
        say(f"{self.out}: {report}{', and fused.mp4' * shown}")
        if report.failed:
            sys.exit(1)

    def kind_of_job(self) -> dict[str, Any]:
        """Return the entries of the job that depend on the command."""
        quiet = self.luminance in ("alpha", "recorded")
        return {"settings": self.fuse_settings(noise_by_default=quiet)}

    def video_rate(self, recordings: Recordings) -> float | None:
        """Return the frame rate of the video to write; None for no video."""
        return None
