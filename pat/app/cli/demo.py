"""`pat demo` and `pat warm-up`: fusion of what ships with the package."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from . import options
from .fuse import fuse_with_progress
from .options import NetworkName, Out, say


@dataclass
class Demo:
    """Fuse a photograph and the sample array: image, depth, confidence of the photograph, a figure, a table.

    The photograph is scikit-image's motorcycle: its left image as a mono camera's, its right one, reduced, as
    a colour camera's. Both arrays are recorded as real cameras do (another response, a darker exposure, 300
    electrons at white), the rendered one as ideal cameras too; beside the fusion stands what is done without
    learning.
    """

    out: Out = Path("out/demo")
    """Folder for the results."""
    network: NetworkName = "mono-colour"

    def run(self) -> None:
        """Fuse both arrays; write and print the score of each method.

        Raises:
            FileExistsError: for files in the way that no run wrote.
            OSError: if writing fails, and FileNotFoundError for unknown weights.
            ValueError: for weights that cannot be used, and an `out` that cannot be written.
        """
        from arraygeom.runtime.together import refuse_others, write_listed, write_together

        from ...fusion.fuse import FuseSettings
        from ...networks.weights import load_weights
        from ...support.metrics import score
        from ..demo import as_real_cameras, classical_methods, save_demo_figure
        from ..results import refuse_to_replace, save_frame
        from ..sample_array import ALPHA, load_motorcycle, load_sample

        options.writable(self.out, folder=True)
        refuse_to_replace(self.out)
        refuse_others(self.out, ["demo.png", "demo.md"])
        network = load_weights(self.network)
        sample = load_sample()
        arrays = {
            "photograph": as_real_cameras(load_motorcycle()),
            "rendered": as_real_cameras(sample),
            "rendered, ideal": (sample, None),
        }
        columns: dict[str, dict[str, str]] = {}
        for name, (array, noise) in arrays.items():
            say(f"{name}: classical fusion")
            alone = array.images[ALPHA].expand(3, -1, -1)
            methods = {"alpha alone": alone, **classical_methods(network, array, noise)}
            say(f"{name}: fusion with the network '{self.network}'")
            settings = FuseSettings(noise=noise)
            frame = fuse_with_progress(self.network, array.rig, array.images, alpha=ALPHA, settings=settings)
            methods["fusion"] = frame.image.clamp(0, 1)
            scores = {method: score(image, array.ground_truth) for method, image in methods.items()}
            columns[name] = {method: f"{psnr:.2f} / {ssim:.3f}" for method, (psnr, ssim) in scores.items()}
            if name == "photograph":
                written = save_frame(frame, self.out)
                panels = {
                    "mono camera": array.images[ALPHA],
                    "classical, denoised and corrected": methods["classical, denoised and corrected"],
                    "fusion": methods["fusion"],
                }
                with write_together(self.out, group="demo.png", last="demo.png") as folder:
                    save_demo_figure(panels, CORNER, folder / "demo.png")
        table = table_of(columns)
        print(table, end="")
        write_listed(self.out / "demo.md", table)
        written += [self.out / "demo.png", self.out / "demo.md"]
        say(f"written: {', '.join(map(str, written))}")


CORNER = (190, 300)
"""Row and column of the photograph's window that the figure enlarges."""


def table_of(columns: dict[str, dict[str, str]]) -> str:
    """Format a Markdown table of scores, with a column for each recording and a line for each method.

    Args:
        columns: formatted score by method, for each recording (one or more) by name; the first has all.

    Returns:
        The text; a dash where a method does not apply.
    """
    methods = list(next(iter(columns.values())))
    wide = max(map(len, methods))

    def line(first: str, cells: Iterable[str]) -> str:
        return f"| {first:{wide}s} | {' | '.join(f'{cell:>15s}' for cell in cells)} |"

    rule = line("-" * wide, ["-" * 14 + ":"] * len(columns))
    rows = [line(name, (scores.get(name, "-") for scores in columns.values())) for name in methods]
    return "\n".join([line("PSNR, dB / SSIM", columns), rule, *rows, ""])


@dataclass
class WarmUp:
    """Compile the kernels `pat fuse` uses, once for this machine, so that no later command waits for it."""

    def run(self) -> None:
        """Compile the kernels by fusing the sample array once, with noise, and as two betas with lenses."""
        import torch

        from arraygeom import Distortion
        from arraygeom.runtime.compiled import cache_folder

        from ...attention.kernels import forward
        from ...fusion.fuse import FuseSettings, fuse_frame
        from ...networks.weights import load_weights
        from ...sensors import NoiseLevel
        from ..sample_array import ALPHA, load_sample

        options.say_when_compiling()
        sample, begin = load_sample(), time.monotonic()
        lens = Distortion("brown-conrady", torch.full((4,), -1e-3).double())
        colour = sample.rig["colour"].replace(distortion=lens)
        rig = sample.rig.with_camera("colour", colour).with_camera("second", colour)
        images = {**sample.images, "second": sample.images["colour"]}
        settings = FuseSettings(noise=dict.fromkeys(images, NoiseLevel.from_electrons(300)))
        fuse_frame(images, rig, alpha=ALPHA, network=load_weights("mono-colour"), settings=settings)
        folder = cache_folder(forward)
        kept = "" if folder is None else f", kept in {folder}"
        say(f"kernels are ready: {time.monotonic() - begin:.0f} s{kept}")
