"""Several colour betas about a mono alpha: rendered scenes of five cameras, fused with one, two, four betas.

    pat lab render arrays.yaml --scenes 4 --out arrays  # for each generator, with the rig that `--rig FILE`
    # writes, seed 1, preset fast: abstract, photographs (of City100), experiments.scenes:still_life
    python -m tests.benchmarks.bench_arrays arrays/* --out tests/benchmarks/RESULTS_arrays.md

Alpha is the luma of what its camera sees, each beta is reduced 2x; the figure is PSNR (dB) against alpha's
colours.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np

from arraygeom import Rig
from pat import FuseSettings, fuse, load_weights
from pat.app.cli.parser import Option, script
from pat.lab.data.windows import read_view, reduced, scene_folders, scene_rig
from pat.lab.evaluation.tables import markdown_header, markdown_row
from pat.media.colour import luminance, srgb_image
from pat.networks.protocol import FusionNetwork
from pat.support.metrics import score
from tests.arraygeom.rigs import parallel_rig
from tests.benchmarks.printed import print_tables

CENTRES = {"left": (-0.09, 0.0), "right": (0.09, 0.0), "up": (0.0, -0.07), "down": (0.0, 0.07)}
"""Centres of the betas, metres right of and below alpha."""
SETS = (("left",), ("right",), ("left", "right"), ("up", "down"), tuple(CENTRES))


def array() -> Rig:
    """The rig that is rendered."""
    return parallel_rig(430.0, (288, 416), {"alpha": (), **CENTRES}, (1.0, 8.0))


def scores(network: FusionNetwork, folder: Path) -> list[float]:
    """PSNR with each set of betas."""
    rig = scene_rig(folder)
    h, w = (n - n % 2 for n in rig["alpha"].hw)
    seen = {name: srgb_image(read_view(folder, name).rgb.float())[:, :h, :w] for name in ("alpha", *CENTRES)}
    rig = rig.replace(cameras={name: rig[name].crop(0, 0, (h, w)) for name in seen})
    images = {"alpha": luminance(seen["alpha"])} | {
        n: reduced(seen[n][None], (h // 2, w // 2))[0] for n in CENTRES
    }
    for name in CENTRES:
        rig = rig.resize(name, (h // 2, w // 2))
    found = []
    for betas in SETS:
        names = ("alpha", *betas)
        some = rig.replace(cameras={name: rig[name] for name in names})
        frame = fuse(
            {name: images[name] for name in names},
            some,
            alpha="alpha",
            network=network,
            settings=FuseSettings(response="rec601"),
        )
        found.append(score(frame.image.clamp(0, 1), seen["alpha"]).psnr)
    return found


def table(folders: Sequence[Path]) -> Iterator[str]:
    """A row for each scene, then their means."""
    columns = [
        "scene",
        *("four" if betas == tuple(CENTRES) else " + ".join(betas) for betas in SETS),
        "two over the better",
    ]
    yield from markdown_header(columns).splitlines()
    network, rows = load_weights("mono-colour"), []
    for folder in (scene for root in folders for scene in scene_folders(root)):
        left, right, two, *others = scores(network, folder)
        rows.append([left, right, two, *others, two - max(left, right)])
        yield markdown_row([f"{folder.parent.parent.name} {folder.name}", *(f"{v:.2f}" for v in rows[-1])])
    yield markdown_row(["**mean**", *(f"{v:.2f}" for v in np.mean(rows, 0))])


def main(
    folders: Annotated[tuple[Path, ...], Option(positional=True)] = (),
    out: Path | None = None,
    rig: Path | None = None,
) -> None:
    """Print the table of folders of scenes; or write the rig to render to the file `rig`, and end."""
    if rig:
        return array().save(rig)
    print_tables("Betas on all sides", [table(folders)], out)


if __name__ == "__main__":
    script(main)
