"""`pat weights ...`: files of weights."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

from tyro.conf import Positional, arg

from .options import Out, say, writable


@dataclass
class Import:
    """Convert a checkpoint of the paper's authors (best.pth.tar) to a weights file for `--weights`.

    The file is read as tensors and numbers; nothing in it is run.
    Example: pat weights import log_2inputs/x4/best.pth.tar --out pat-authors.safetensors
    """

    checkpoint: Annotated[Positional[Path], arg(metavar="FILE", help="Checkpoint, for any number of inputs.")]
    out: Out = Path("pat-authors.safetensors")
    """Weights file to write."""

    def run(self) -> None:
        """Write the weights. Raises FileNotFoundError or ValueError for a file that is not such a checkpoint."""
        from ..networks.authors import read_authors
        from ..networks.paper import PAT
        from ..networks.weights import save_weights

        writable(self.out)
        read = read_authors(self.checkpoint)
        network = PAT(read.config)
        network.load_state_dict(read.state)
        save_weights(network, self.out, facts=read.facts)
        betas, c = read.config.betas, read.config
        what = f"{betas} beta{'s' * (betas > 1)}, images of {c.in_channels} channels, enlarged {c.scale}x"
        say(f"written: {self.out} (PAT for {what})")


class WeightsCommands:
    """Convert weights of other programs."""

    commands: ClassVar[Mapping[str, Any]] = {"import": Import}
