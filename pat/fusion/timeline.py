"""Recording times of the cameras of a sequence, and the frames of alpha that get colour from betas."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from arraygeom import Rig
from arraygeom.runtime.warned import warn


class KeyFrame(NamedTuple):
    """Key frame of a sequence: a frame of alpha that is fused with betas.

    Attributes:
        alpha: number of alpha's frame.
        betas: number of the frame nearest in time, for each beta by name.
    """

    alpha: int
    betas: dict[str, int]


@dataclass(frozen=True)
class Timeline:
    """Recording times of a sequence's frames: `name`'s frame i at time_offset + i / frame_rate, seconds.

    Attributes:
        rig: the cameras, with frame rates.
        counts: number of frames of each camera.
        alpha: name of alpha.

    Raises:
        ValueError: for a camera without a frame rate or frames, or that the rig lacks, and without frames of
            alpha or any beta.
    """

    rig: Rig
    counts: Mapping[str, int]
    alpha: str

    def __post_init__(self) -> None:
        for name, count in self.counts.items():
            if self.rig[name].sensor.frame_rate is None:
                raise ValueError(
                    f"the frame rate of '{name}' is not known: add 'frame_rate' to it in the rig, or give "
                    f"--frame-rate {name}=25"
                )
            if count < 1:
                raise ValueError(f"no frames of '{name}'")
        if self.alpha not in self.counts:
            raise ValueError(f"no frames of alpha, '{self.alpha}'")
        if not self.betas:
            raise ValueError("no frames of any other camera than alpha: fusion needs at least one beta")

    @property
    def betas(self) -> list[str]:
        """Betas that have frames."""
        return [name for name in self.rig.betas(self.alpha) if name in self.counts]

    def rate(self, name: str) -> float:
        """Return a camera's frames per second."""
        return self.rig[name].sensor.frame_rate or 1.0

    def time(self, name: str, i: int) -> float:
        """Return the time at which frame i was recorded, seconds of the rig's clock.

        Raises:
            IndexError: for a frame that the camera does not have, as one below 0.
        """
        if not 0 <= i < self.counts[name]:
            raise IndexError(f"'{name}' has no frame {i}: give 0 to {self.counts[name] - 1}")
        return self.rig[name].sensor.time_offset + i / self.rate(name)

    def nearest(self, name: str, time: float) -> int:
        """Return the number of the frame recorded nearest to a time; the first or last one beyond these."""
        i = round((time - self.rig[name].sensor.time_offset) * self.rate(name))
        return min(max(i, 0), self.counts[name] - 1)

    @property
    def interval(self) -> float:
        """Time between key frames, seconds."""
        return 1 / min(max(self.rate(name) for name in self.betas), self.rate(self.alpha))

    def key_frames(self) -> list[KeyFrame]:
        """List the key frames: for each frame of the fastest beta the nearest one of alpha.

        Frames of alpha further away than half of `interval` are none.

        Returns:
            Key frames, in the order of time.

        Raises:
            ValueError: for a beta without a frame near any of them: the recordings do not overlap.
        """
        fastest = max(self.betas, key=self.rate)
        gains: dict[int, float] = {}
        for i in range(self.counts[fastest]):
            time = self.time(fastest, i)
            index = self.nearest(self.alpha, time)
            gap = abs(self.time(self.alpha, index) - time)
            if gap <= 0.5 * self.interval + 1e-9:
                gains[index] = min(gap, gains.get(index, gap))
        for name in self.betas:
            within = 0.5 * max(1 / self.rate(name), self.interval) + 1e-9
            times = (self.time(self.alpha, i) for i in gains)
            if not any(abs(self.time(name, self.nearest(name, t)) - t) <= within for t in times):
                raise ValueError(
                    f"no frame of '{name}' is near one of alpha in time: check 'frame_rate' and 'time_offset'"
                )
        return [KeyFrame(i, self.at(i)) for i in sorted(gains)]

    def warn_of_ends(self) -> None:
        """Warn of each beta that lacks a frame within one of its own intervals of some frame of alpha.

        Its first or last frame gives colour there.
        """
        times = [self.time(self.alpha, i) for i in range(self.counts[self.alpha])]
        for name in self.betas:
            nearest = (self.time(name, self.nearest(name, t)) for t in times)
            without = sum(abs(a - b) > 1 / self.rate(name) + 1e-9 for a, b in zip(nearest, times))
            if without:
                ends = self.time(name, 0), self.time(name, self.counts[name] - 1)
                warn(
                    f"'{name}' recorded from {ends[0]:.4g} to {ends[1]:.4g} s and '{self.alpha}' from "
                    f"{times[0]:.4g} to {times[-1]:.4g} s: {without} of {len(times)} frames get colour from "
                    "its first or last one; check 'frame_rate' and 'time_offset', or give fewer frames"
                )

    def at(self, index: int) -> dict[str, int]:
        """Return for each beta the number of its frame nearest in time to alpha's frame `index`."""
        return {name: self.nearest(name, self.time(self.alpha, index)) for name in self.betas}
