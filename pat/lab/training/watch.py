"""Progress of a run: a bar, a line for each step and each validation, images, TensorBoard."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from rich import progress
from rich.console import Console
from torch import Tensor
from torch.nn.functional import interpolate

from arraygeom.runtime.atomic import write_text
from arraygeom.runtime.extras import install_line
from pat.media.images import write_image
from pat.networks.protocol import FusionNetwork, fused_at_once

from .samples import Sample

SHOWN = 3
"""Number of validation groups whose first scene is shown."""
HEADER = "step,loss,gradient,rate\n"


class Watch:
    """Progress reports until `close`: `steps.csv`, `log.jsonl`, images, a bar on a terminal, TensorBoard.

    Args:
        out: folder of the run.
        step: step at which the run continues; lines of later steps are removed.
        scenes: scenes in a step, for the speed.
        tensorboard: True to log for TensorBoard too.

    Raises:
        ValueError: for TensorBoard without its package, and a damaged line of the files.
        OSError: if a file cannot be written.
    """

    def __init__(self, out: Path, step: int, scenes: int, *, tensorboard: bool) -> None:
        self.out, self.scenes, self.ticked = out, scenes, time.monotonic()
        self.board = _board(out / "tensorboard") if tensorboard else None
        _keep_lines(self.out / "steps.csv", step, lambda line: int(line.partition(",")[0]), header=HEADER)
        _keep_lines(self.out / "log.jsonl", step, lambda line: json.loads(line)["step"])
        self.steps = (self.out / "steps.csv").open("a", encoding="utf-8")
        self.bar = progress.Progress(
            progress.TextColumn("step {task.fields[step]}"),
            progress.BarColumn(),
            progress.TaskProgressColumn(),
            progress.TextColumn("loss {task.fields[loss]:.4f}  {task.fields[speed]:.1f} scenes/s"),
            progress.TimeElapsedColumn(),
            progress.TimeRemainingColumn(),
            console=Console(stderr=True),
            disable=not Console(stderr=True).is_terminal,
        )
        self.task = self.bar.add_task("training", total=1.0, step=step, loss=0.0, speed=0.0)
        self.bar.start()

    def step(self, step: int, loss: float, norm: float, rate: float, *, done: float) -> None:
        """Report one step: to steps.csv, on the bar, and every tenth to TensorBoard.

        Args:
            step: number of the step.
            loss: its loss.
            norm: norm of the gradient, before clipping.
            rate: learning rate.
            done: completed share of the run, 1 at the end.
        """
        now = time.monotonic()
        speed, self.ticked = self.scenes / (now - self.ticked), now
        self.steps.write(f"{step},{loss!r},{norm!r},{rate!r}\n")
        self.bar.update(self.task, completed=min(done, 1.0), step=step, loss=loss, speed=speed)
        if self.board and step % 10 == 0:
            values = {"loss": loss, "gradient": norm, "rate": rate, "scenes a second": speed}
            for name, value in values.items():
                self.board.add_scalar(name, value, step)

    def validated(self, facts: Mapping[str, float]) -> None:
        """Report the figures of a validation: print them and write them to log.jsonl, rounded to 4 decimals,
        and two to TensorBoard.

        Args:
            facts: figures by name: "step", and for TensorBoard "psnr" and "matched".
        """
        line = json.dumps({k: round(v, 4) for k, v in facts.items()})
        self.bar.console.print(line, highlight=False) if not self.bar.disable else print(line, flush=True)
        self.steps.flush()
        with (self.out / "log.jsonl").open("a", encoding="utf-8") as file:
            file.write(line + "\n")
        if self.board:
            for name in ("psnr", "matched"):
                self.board.add_scalar(f"validation/{name}", facts[name], int(facts["step"]))

    def show(self, network: FusionNetwork, samples: list[Sample], step: int) -> None:
        """Write an image of validation samples: beta, alpha, fused image, ground truth, confidence side by
        side.

        It is `images/step-N.png` in the run's folder (N of six digits), and is sent to TensorBoard too: the
        first scene of up to `SHOWN` groups, of which there must be one.
        """
        sheet = contact_sheet(network, samples[:SHOWN])
        write_image(self.out / "images" / f"step-{step:06d}.png", sheet)
        if self.board:
            self.board.add_image("validation", sheet, step)

    def close(self) -> None:
        """Close the bar and the files."""
        self.bar.stop()
        self.steps.close()
        if self.board:
            self.board.close()


@torch.no_grad()
def contact_sheet(network: FusionNetwork, samples: list[Sample]) -> Float[Tensor, "3 _ _"]:
    """Compose one row for the first scene of each group: beta (three bands or one), alpha, fused, truth,
    confidence.

    Returns:
        RGB image 0..1, on the CPU.
    """
    return torch.cat([_row(network, sample) for sample in samples], -2).cpu()


def _row(network: FusionNetwork, sample: Sample) -> Tensor:
    fused = fused_at_once(network, sample.inputs)
    beta = torch.cat([b[:1] for b in sample.betas], 1)
    confidence = torch.stack([c[:1] for c in fused.confidence], 1).amin(1, keepdim=True)
    hw = (sample.ground_truth.shape[-2], sample.ground_truth.shape[-1])
    columns = [beta, sample.alpha[:1], fused.image[:1], sample.ground_truth[:1], confidence]
    three = [c[:, :3] if c.shape[1] > 2 else c[:, :1].expand(-1, 3, -1, -1) for c in columns]
    row = [interpolate(c.float(), hw, mode="bilinear", align_corners=False) for c in three]
    return torch.cat(row, -1)[0].clamp(0, 1)


def _keep_lines(path: Path, step: int, step_of: Any, *, header: str = "") -> None:
    """Remove the lines of steps after `step`, and an incomplete last line."""
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    lines = text.splitlines(keepends=True)[bool(header) :]
    try:
        earlier = [line for line in lines if line.endswith("\n") and step_of(line) <= step]
    except (KeyError, TypeError, ValueError):
        raise ValueError(f"{path}: has a line without its step: remove that, or give another `out`") from None
    write_text(path, header + "".join(earlier))


def _board(folder: Path) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        install = install_line("tensorboard", "tensorboard")
        raise ValueError(f"tensorboard is not installed: {install}") from None
    return SummaryWriter(folder)
