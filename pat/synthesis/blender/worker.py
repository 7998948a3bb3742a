"""The process that imports bpy: reads paths of requests from standard input, writes one line of JSON for each.

A request is a folder with scene.yaml, rig.yaml and request.json, {"out": folder, "settings": {...}}. An answer is
{"ok": true} or {"error": "one line", "kind": "ValueError"}.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import torch

from arraygeom.rig import Rig

from ...support.schema import from_document
from ..scene import Scene
from .settings import RenderSettings
from .task import render_here


def main() -> None:
    """Serve until standard input ends."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    torch.set_num_threads(1)
    for line in sys.stdin:
        print(json.dumps(answer(Path(line.strip()))), file=answers, flush=True)


def answer(folder: Path) -> dict[str, Any]:
    """Render one request."""
    try:
        request = json.loads((folder / "request.json").read_text(encoding="utf-8"))
        settings = from_document(RenderSettings, request["settings"], "settings")
        scene, rig = Scene.load(folder / "scene.yaml"), Rig.load(folder / "rig.yaml")
        render_here(scene, rig, Path(request["out"]), settings=settings)
    except Exception as error:
        return {"error": " ".join(str(error).split()), "kind": type(error).__name__}
    return {"ok": True}


if __name__ == "__main__":
    main()
