"""Sixty commands typed wrongly for the first time, and what each answers: python -m tests.refusals."""

from __future__ import annotations

import contextlib
import io
import shlex
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import torch

from pat.app.cli.main import main
from pat.app.sample_array import SAMPLE
from pat.media.images import write_image

LINES = """
pat
pat fuze mono.png colour.png
pat fuse
pat fuse mono.png
pat fuse mono.png color.png
pat fuse mono.png mono.png
pat fuse mono.png notes.txt
pat fuse mono.png broken.png
pat fuse mono.png empty.png
pat fuse mono.png flat.png
pat fuse colour.png other.png
pat fuse rig.yaml
pat fuse rig.yaml mono.png
pat fuse rig.yaml mono.png colour.png
pat fuse rig.yaml --image mono=mono.png --image colour=colour.png
pat fuse rig.yaml --alpha left --image mono=mono.png --image colour=colour.png
pat fuse rig.yaml --alpha mono --image mono=mono.png
pat fuse rig.yaml --alpha mono --image mono=mono.png --image color=colour.png
pat fuse rig.yaml --alpha mono --image mono mono.png --image colour=colour.png
pat fuse rig.yaml --alpha mono --image mono=colour.png --image colour=mono.png
pat fuse rig.yaml --alpha mono --image mono=small.png --image colour=colour.png
pat fuse rig.yaml --alpha mono --image mono=mono.png --image mono=colour.png
pat fuse missing.yaml --alpha mono --image mono=mono.png --image colour=colour.png
pat fuse notes.txt --alpha mono --image mono=mono.png --image colour=colour.png
pat fuse broken.yaml --alpha mono --image mono=mono.png --image colour=colour.png
pat fuse typo.yaml --alpha mono --image mono=mono.png --image colour=colour.png
pat fuse nodepth.yaml --alpha mono --image mono=mono.png --image colour=colour.png
pat fuse rig.yaml --alpha mono --image mono=mono.png --image colour=colour.png --depth 20 2
pat fuse rig.yaml --alpha mono --image mono=mono.png --image colour=colour.png --depth 2
pat fuse rig.yaml --alpha mono --image mono=mono.png --image colour=colour.png --depth near far
pat fuse rig.yaml --alpha mono --image mono=mono.png --image colour=colour.png --network mono-color
pat fuse rig.yaml --alpha mono --image mono=mono.png --image colour=colour.png --network notes.txt
pat fuse rig.yaml --alpha mono --image mono=mono.png --image colour=colour.png --field epipolr
pat fuse rig.yaml --alpha mono --image mono=mono.png --image colour=colour.png --response 1,2
pat fuse rig.yaml --alpha mono --image mono=mono.png --image colour=colour.png --noise 200
pat fuse rig.yaml --alpha mono --image mono=mono.png --image colour=colour.png --noise mono=loud
pat fuse rig.yaml --alpha mono --image mono=mono.png --image colour=colour.png --max-memory 7
pat fuse rig.yaml --alpha mono --image mono=mono.png --image colour=colour.png --max-memory 10MiB
pat fuse rig.yaml --alpha mono --image mono=mono.png --image colour=colour.png --device gpu
pat fuse rig.yaml --alpha mono --image mono=mono.png --image colour=colour.png --format jpg
pat fuse rig.yaml --alpha mono --image mono=mono.png --image colour=colour.png --extras html
pat fuse rig.yaml --alpha mono --image mono=mono.png --image colour=colour.png --out mono.png
pat fuse rig.yaml --alpha mono --image mono=mono.png --image colour=colour.png --depth-map mono.png
pat fuse rig.yaml --alpha mono --image mono=mono.png --image colour=colour.png --matches notes.txt
pat fuse mono.png colour.png --focal 800
pat fuse mono.png colour.png --focal mono=long
pat fuse mono.png colour.png --quality high
pat batch rig.yaml --alpha mono --image mono=frames --image colour=none
pat batch rig.yaml --alpha mono --image mono=*.jpg --image colour=*.jpg
pat sequence rig.yaml --alpha mono --image mono=mono.png
pat align mono.png
pat align nothing/
pat show rig.yaml --image mono=colour.png
pat rig info
pat rig info notes.txt
pat rig convert rig.yaml --to blender
pat rig doctor rig.yaml
pat rig refine rig.yaml --image mono=mono.png
pat calibrate photos --board charuco:9x7
pat calibrate nothing --board charuco:9x7:60mm
pat calibrate photos --board charuco:9x7:60mm
pat board chess -o board.pdf
pat explore rig.yaml --image mono=missing.png
pat help fuze
pat lab train pat-supervised
""".strip().splitlines()


def prepare(folder: Path) -> None:
    """Write the files that the commands name."""
    for name in ("rig.yaml", "mono.png", "colour.png"):
        shutil.copy(SAMPLE / name, folder / name)
    text = (SAMPLE / "rig.yaml").read_text()
    (folder / "broken.yaml").write_text(text.replace("cameras:", "cameras: ["))
    (folder / "typo.yaml").write_text(text.replace("focal: [460", "focus: [460"))
    (folder / "nodepth.yaml").write_text(text.replace("depth: [1.4, 20.0]\n", ""))
    (folder / "notes.txt").write_text("Thursday: take more pictures\n")
    (folder / "broken.png").write_bytes((SAMPLE / "mono.png").read_bytes()[:5000])
    (folder / "empty.png").write_bytes(b"")
    write_image(folder / "flat.png", torch.full((3, 400, 640), 0.5))
    write_image(folder / "other.png", torch.rand(3, 400, 640, generator=torch.Generator().manual_seed(0)))
    write_image(folder / "small.png", torch.rand(1, 200, 320, generator=torch.Generator().manual_seed(0)))
    for name in ("frames", "photos/mono", "photos/colour"):
        (folder / name).mkdir(parents=True)
    for name in ("mono", "colour"):
        shutil.copy(SAMPLE / f"{name}.png", folder / "photos" / name / "001.png")


def said(line: str) -> tuple[str, str]:
    """Run a line in the present folder; return its exit status, and what it wrote on standard error."""
    heard = io.StringIO()
    with contextlib.redirect_stderr(heard), contextlib.redirect_stdout(io.StringIO()):
        try:
            main(shlex.split(line)[1:])
            status = "0"
        except SystemExit as end:
            text = end.code if isinstance(end.code, str) else ""
            status = "1" if text else str(end.code or 0)
            heard.write(text)
    return status, heard.getvalue().strip()


def answers() -> Iterator[tuple[str, str, str]]:
    """Yield each line with its exit status and its answer; run in a folder of its own."""
    with tempfile.TemporaryDirectory() as name, contextlib.chdir(name):
        prepare(Path(name))
        for line in LINES:
            yield (line, *said(line))


if __name__ == "__main__":
    for line, status, text in answers():
        sys.stdout.write(f"$ {line}\n{text}\n  [{status}]\n\n")
        sys.stdout.flush()
