"""Run notebooks in place, keeping outputs: python notebooks/run.py [FILE ...]. Written atomically."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient

HERE = Path(__file__).parent


def execute(notebook: nbformat.NotebookNode, folder: Path) -> nbformat.NotebookNode:
    """The notebook with its outputs, run in `folder` with this checkout's packages. Raises as nbclient."""
    # seconds, for machines with other work
    patience = {"timeout": 1800, "startup_timeout": 600, "iopub_timeout": 120}
    client = NotebookClient(
        notebook,
        kernel_name="python3",
        resources={"metadata": {"path": str(folder)}},
        coalesce_streams=True,
        **patience,
    )
    searched = os.pathsep.join(filter(None, (str(HERE.parent), os.environ.get("PYTHONPATH"))))
    client.execute(env={**os.environ, "PYTHONPATH": searched})
    # the state of the explorer: images again, of no use without a kernel
    notebook.metadata.pop("widgets", None)
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
    return notebook


def main(files: list[str]) -> None:
    """Run each and write it back."""
    for path in [Path(f) for f in files] or sorted(HERE.glob("*.ipynb")):
        start = time.monotonic()
        notebook = execute(nbformat.read(path, as_version=4), path.parent)
        temporary = path.with_suffix(".tmp")
        nbformat.write(notebook, temporary)
        temporary.replace(path)
        print(f"{path.name}: {time.monotonic() - start:.0f} s, {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main(sys.argv[1:])
