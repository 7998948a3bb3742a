"""Serving the explorer to this machine alone."""

from __future__ import annotations

import re
import socket
from collections.abc import Mapping
from typing import Any

import panel as pn
from jaxtyping import Float
from torch import Tensor
from tornado.web import RequestHandler

from arraygeom import Rig

from .page import Explorer, prepared
from .theme import PAGE


def serve(
    rig: Rig,
    images: Mapping[str, Float[Tensor, "_ _ _"]],
    *,
    alpha: str | None = None,
    field: str = "auto",
    port: int = 0,
    browser: bool = True,
) -> None:
    """Serve the explorer to this machine alone until interrupted; port 0 takes a free one.

    Requests for other host names than this machine's are refused, whatever their origin: a foreign page whose name is
    made to resolve to this machine must not read the images. Raises as `explorer`, and ValueError for a port that is
    none or in use.
    """
    check_port(port)
    scene, alpha = prepared(rig, images, alpha)
    Explorer(scene, alpha, field).panel()  # once beforehand: what it imports and compiles must not delay the page
    pn.config.raw_css = [*pn.config.raw_css, PAGE]
    port = port or free_port()
    server = pn.serve(
        {"/": lambda: Explorer(scene, alpha, field).panel()},
        port=port,
        address="localhost",
        websocket_origin=[f"{name}:{port}" for name in OWN_NAMES],
        show=False,
        start=False,
        title=f"pat explore {rig.name}".strip(),
        verbose=False,
    )
    refuse_foreign_hosts(server)
    print(f"the explorer is at http://localhost:{port} (Ctrl+C ends it)", flush=True)
    server.start()
    if browser:
        server.show("/")
    try:
        server.io_loop.start()
    except KeyboardInterrupt:
        pass
    finally:
        server.stop()


OWN_NAMES = ("localhost", "127.0.0.1")
"""Host names of this machine."""


class ForeignHost(RequestHandler):
    """The answer to requests for another host."""

    def prepare(self) -> None:
        """Refuse."""
        self.set_status(403)
        self.finish("the explorer answers to localhost alone\n")


def refuse_foreign_hosts(server: Any) -> None:
    """Refuse every request, WebSockets included, whose Host is not this machine's, before any other rule applies."""
    own = "|".join(map(re.escape, OWN_NAMES))
    server._tornado.add_handlers(f"(?!(?:{own})$).*", [(r".*", ForeignHost)])


def check_port(port: int) -> None:
    """Raises ValueError for a number that is no port, or a port that is in use."""
    if not 0 <= port <= 65535:
        raise ValueError(f"--port {port}: wanted 1 to 65535, or 0 for a free one")
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("localhost", port))
        except OSError as error:
            raise ValueError(f"--port {port}: {error.strerror}: give another, or 0 for a free one") from None


def free_port() -> int:
    """A port on localhost that nothing listens at."""
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        return probe.getsockname()[1]
