"""Rendering from a process that does not import bpy: worker processes, connected by pipes."""

from __future__ import annotations

import json
import select
import signal
import subprocess
import sys
import tempfile
from contextlib import AbstractContextManager
from pathlib import Path

from arraygeom.rig import Rig

from ...support.schema import to_document
from ..rendered import Rendered
from ..scene import Scene
from .lens import lens_for
from .settings import RenderSettings

_COMMAND = (sys.executable, "-X", "faulthandler", "-m", "pat.synthesis.blender.worker")
_TAIL = 2000


class RenderError(RuntimeError):
    """A scene that could not be rendered: the message is one line. `crashed` if the process died or hung."""

    def __init__(self, message: str, *, crashed: bool = False):
        super().__init__(message)
        self.crashed = crashed


class Worker(AbstractContextManager["Worker"]):
    """A process that renders one scene after another (`python -m pat.synthesis.blender.worker`).

    It starts with the first scene and anew after a crash. Use it as a context manager, or `close` it.
    """

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None
        self._log = tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace")  # noqa: SIM115

    def __exit__(self, *error: object) -> None:
        self.close()

    @property
    def pid(self) -> int | None:
        """The process's number, None if there is none."""
        return None if self._process is None else self._process.pid

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None

    def render(
        self, scene: Scene, rig: Rig, out: Path, *, settings: RenderSettings, timeout: float | None = None
    ) -> Rendered:
        """Like `render`, in this worker."""
        for name, camera in rig.cameras.items():
            lens_for(camera, name)
        with tempfile.TemporaryDirectory(prefix="pat-request-") as folder:
            request = Path(folder)
            scene.save(request / "scene.yaml")
            rig.to("cpu").save(request / "rig.yaml")
            order = {"out": str(Path(out).absolute()), "settings": to_document(settings)}
            (request / "request.json").write_text(json.dumps(order), encoding="utf-8")
            answer = json.loads(self._ask(str(request), timeout))
        if "error" in answer:
            kind = ValueError if answer["kind"] == "ValueError" else RenderError
            raise kind(answer["error"])
        return Rendered(Path(out))

    def _ask(self, line: str, timeout: float | None) -> str:
        process = self._started()
        assert process.stdin
        assert process.stdout
        try:
            process.stdin.write(line + "\n")
            process.stdin.flush()
            ready, _, _ = select.select([process.stdout], [], [], timeout)
        except BrokenPipeError:
            ready = [process.stdout]
        if not ready:
            self.close()
            raise RenderError(f"rendering took longer than {timeout:g} s and was ended", crashed=True)
        answer = process.stdout.readline()
        if not answer:
            raise self._death(process)
        return answer

    def _started(self) -> subprocess.Popen[str]:
        if self._process is None:
            self._log.seek(0)
            self._log.truncate()
            pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": self._log}
            self._process = subprocess.Popen(_COMMAND, text=True, **pipes)  # type: ignore[call-overload]
        return self._process

    def _death(self, process: subprocess.Popen[str]) -> RenderError:
        code = process.wait()
        self._process = None
        self._log.seek(0)
        lines = [line for line in self._log.read()[-_TAIL:].splitlines() if line.strip()]
        cause = signal.Signals(-code).name if code < 0 else f"exit status {code}"
        return RenderError(f"the rendering process died ({cause}){': ' + lines[-1] if lines else ''}", crashed=True)


def render(scene: Scene, rig: Rig, out: Path, *, settings: RenderSettings, timeout: float | None = None) -> Rendered:
    """Render a scene into the folder `out`, atomically, in a process of its own.

    Raises ValueError for what cannot be rendered (one line: skew, a camera inside an object, a missing library),
    RenderError if the process dies or takes longer than `timeout` seconds.
    """
    with Worker() as worker:
        return worker.render(scene, rig, out, settings=settings, timeout=timeout)
