"""Parts of `bench_job`, each a process of its own: `python -m tests.benchmarks.job_parts PART ...`.

`scene`: the sample array enlarged to any size, with several copies of the colour camera, through lenses or
not. `classical`, `opencv`: other ways to the same image, from files to a file. `stages`: `pat fuse` with the
time of its parts printed as JSON.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

STAGES = {
    "read": ["pat.media.images.read_image", "pat.app.cli.options.load_rig"],
    "views": ["pat.fusion.fuse.prepared"],
    "field": ["arraygeom.fields.grid.FieldOnGrid.from_field"],
    "plan": ["pat.fusion.fuse.plan_frame"],
    "pre-pass": ["pat.fusion.fuse.find_corrections"],
    "matching": [f"pat.matching.match.{name}" for name in ("located_in_one", "agreed", "transferred")],
    "choice": ["pat.matching.match.chosen"],
    "attention": ["pat.attention.attend._attend"],
    "network": ["pat.networks.guided.GuidedPAT.forward"],
    "depth": ["pat.fusion.tiles.measured_depth", "pat.fusion.fuse.final_depth"],
    "write": ["pat.app.results.save_frame", "pat.app.report.report_page"],
}
"""What is counted as each part, without the parts within it."""


def scene(folder: Path, width: int, height: int, betas: int, k1: float = 0.0) -> None:
    """Rig and images: the sample array's, enlarged; `betas` copies of its colour camera, a pixel apart.

    With `k1`, as through lenses of that first radial coefficient.
    """
    import cv2
    import torch

    from arraygeom import Distortion, Rig, resampled
    from pat.app.sample_array import ALPHA, BETA, SAMPLE

    rig = Rig.load(SAMPLE / "rig.yaml")
    folder.mkdir(parents=True, exist_ok=True)
    cameras = {}
    for name in (ALPHA, BETA):
        h, w = rig[name].hw
        hw = round(h * height / rig[ALPHA].hw[0]), round(w * width / rig[ALPHA].hw[1])
        image = cv2.resize(cv2.imread(str(SAMPLE / f"{name}.png")), hw[::-1], interpolation=cv2.INTER_CUBIC)
        camera = rig[name].resize(hw)
        if k1:
            straight, values = camera, torch.from_numpy(image).movedim(-1, 0).float()
            camera = straight.replace(
                distortion=Distortion("brown-conrady", torch.tensor([k1, 0, 0, 0]).double())
            )
            seen = resampled(values, straight, camera, extended=True).values[0]
            image = seen.clamp(0, 255).round().byte().movedim(0, -1).numpy().copy()
        for i, copy in enumerate([name] if name == ALPHA else [f"{name}{i + 1}" for i in range(betas)]):
            image[0, 0] = i
            cv2.imwrite(str(folder / f"{copy}.png"), image[..., 0] if name == ALPHA else image)
            cameras[copy] = camera
    Rig(cameras, depth=rig.depth, name="benchmark").save(folder / "rig.yaml")


def classical(folder: Path, out: Path) -> None:
    """The classical baseline with the first beta."""
    from arraygeom import Rig
    from pat.fusion.classical import classical as baseline
    from pat.media.colour import luminance_of
    from pat.media.images import read_image, write_image

    rig = Rig.load(folder / "rig.yaml")
    images = {name: read_image(folder / f"{name}.png") for name in ("mono", "colour1")}
    images["mono"] = luminance_of(images["mono"])
    fused = baseline(rig, images, "mono", "colour1")
    out.mkdir(parents=True, exist_ok=True)
    write_image(out / "fused.png", fused)


def opencv(folder: Path, out: Path) -> None:
    """Fuse as with OpenCV alone: SGBM on rectified images, its weighted least squares filter, beta warped to
    alpha, alpha as the luma of the result."""
    import cv2
    import numpy as np

    from arraygeom import Rig, rectify

    pair = Rig.load(folder / "rig.yaml").pair("mono", "colour1")
    mono = cv2.imread(str(folder / "mono.png"), cv2.IMREAD_GRAYSCALE)
    colour = cv2.imread(str(folder / "colour1.png"))
    K = pair.cameras[0].K
    found = rectify(pair, K=K)
    wh = (mono.shape[1], mono.shape[0])
    left = cv2.warpPerspective(mono, found.H_alpha.numpy(), wh, flags=cv2.INTER_CUBIC)
    right = cv2.warpPerspective(colour, found.H_beta.numpy(), wh, flags=cv2.INTER_CUBIC)
    near, _ = (float(d) for d in pair.depth_range)
    count = 16 * int(np.ceil(float(K[0, 0] * pair.beta_from_alpha.t.norm()) / near / 16))
    matcher = cv2.StereoSGBM.create(0, count, 5, 200, 800, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY)
    back = cv2.ximgproc.createRightMatcher(matcher)
    smoother = cv2.ximgproc.createDisparityWLSFilter(matcher)
    grey = cv2.cvtColor(right, cv2.COLOR_BGR2GRAY)
    disparity = smoother.filter(
        matcher.compute(left, grey), left, None, back.compute(grey, left)
    ) / np.float32(16)
    rows, columns = np.mgrid[: wh[1], : wh[0]].astype(np.float32)
    warped = cv2.remap(right, columns - disparity, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    warped = cv2.warpPerspective(warped, np.linalg.inv(found.H_alpha.numpy()), wh, flags=cv2.INTER_CUBIC)
    luma = cv2.cvtColor(warped, cv2.COLOR_BGR2YCrCb)
    luma[..., 0] = mono
    fused = cv2.cvtColor(luma, cv2.COLOR_YCrCb2BGR)
    out.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(out / "fused.png"), fused)


class Clock:
    """Seconds by part, of the wall and of cores: of the innermost part that is running in the main thread.

    What other threads compute meanwhile counts as that part's, too: torch's, and the comparison of rig and
    images.
    """

    def __init__(self) -> None:
        self.seconds: Counter[str] = Counter()
        self.core_seconds: Counter[str] = Counter()
        self.running = ["import"]
        self.since = time.perf_counter(), time.process_time()

    def to(self, part: str | None) -> None:
        """Begin a part; None: end the innermost."""
        now = time.perf_counter(), time.process_time()
        self.seconds[self.running[-1]] += now[0] - self.since[0]
        self.core_seconds[self.running[-1]] += now[1] - self.since[1]
        self.since = now
        if part is None:
            self.running.pop()
        else:
            self.running.append(part)

    def around(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, its time counted."""

        def counted(*given: Any, **options: Any) -> Any:
            if threading.current_thread() is not threading.main_thread():
                return function(*given, **options)
            self.to(part)
            try:
                return function(*given, **options)
            finally:
                self.to(None)

        return counted


def stages(arguments: list[str]) -> None:
    """`pat fuse` of some arguments, and a line of JSON with the seconds of its parts."""
    from importlib import import_module

    clock = Clock()
    for part, names in STAGES.items():
        for name in names:
            owner, attribute = _owner(name, import_module)
            given = vars(owner)[attribute]
            wrapped = clock.around(part, getattr(owner, attribute))
            setattr(owner, attribute, staticmethod(wrapped) if isinstance(given, classmethod) else wrapped)
    from pat.app.cli.main import main

    clock.to("rest")
    try:
        main(["fuse", *arguments])
    finally:
        clock.to(None)
        print(json.dumps({"stages": clock.seconds, "cores": clock.core_seconds}))


def _owner(name: str, load: Callable[[str], Any]) -> tuple[Any, str]:
    """The module or class that holds a function, and the function's name in it."""
    path, _, attribute = name.rpartition(".")
    try:
        return load(path), attribute
    except ModuleNotFoundError:
        module, _, inner = path.rpartition(".")
        return getattr(load(module), inner), attribute


if __name__ == "__main__":
    part, *given = sys.argv[1:]
    if part == "scene":
        scene(Path(given[0]), *map(int, given[1:4]), *map(float, given[4:]))
    elif part == "stages":
        stages(given)
    else:
        {"classical": classical, "opencv": opencv}[part](Path(given[0]), Path(given[1]))
