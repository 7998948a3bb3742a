"""Serving of the explorer to one user of this machine alone, by the standard library."""

from __future__ import annotations

import json
import secrets
import sys
import threading
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from arraygeom.runtime.safe_yaml import load_json

from .page import Explorer, page

LARGEST = 1 << 16
"""Largest question, bytes."""
OWN_NAMES = ("localhost", "127.0.0.1")
"""Host names of this machine."""


class _Server(ThreadingHTTPServer):
    """Server of an explorer's page and answers, one answer at a time."""

    def __init__(self, explorer: Explorer, port: int) -> None:
        super().__init__(("127.0.0.1", port), _Handler)
        self.explorer, self.turn = explorer, threading.Lock()
        self.token = secrets.token_urlsafe(24)
        self.page = page(explorer.values(), "asksServer()").encode()  # computes what answers would wait for

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore browsers that leave before they have their answer."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    server: _Server

    def do_GET(self) -> None:
        if self._is_own() and self._asks_for(""):
            self._send(200, "text/html; charset=utf-8", self.server.page)
        else:
            self._refuse()

    def do_POST(self) -> None:
        length = self.headers.get("Content-Length", "")
        short = length.isdecimal() and int(length) <= LARGEST
        if not (self._is_own() and self._asks_for("answer") and short):
            self._refuse()
            return
        try:
            controls = {**self.server.explorer.controls, **load_json(self.rfile.read(int(length)).decode())}
        except (ValueError, TypeError):
            self._send(400, "text/plain", b"the question is not a JSON object\n")
            return
        with self.server.turn:
            text = json.dumps(self.server.explorer.answer(controls))
        self._send(200, "application/json", text.encode())

    def _asks_for(self, name: str) -> bool:
        wanted = f"/{self.server.token}/{name}"
        return secrets.compare_digest(self.path.encode(), wanted.encode())

    def _is_own(self) -> bool:
        hosts = [f"{name}:{self.server.server_port}" for name in OWN_NAMES]
        origin = self.headers.get("Origin")
        of_page = origin is None or origin.partition("://")[2] in hosts
        return self.headers.get("Host") in hosts and of_page

    def _refuse(self) -> None:
        status, why = (404, b"nothing here\n") if self._is_own() else (403, b"for localhost alone\n")
        self._send(status, "text/plain", why)

    def _send(self, status: int, kind: str, body: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Referrer-Policy", "no-referrer")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing about requests."""


def serve(explorer: Explorer, *, port: int = 0, browser: bool = True) -> None:
    """Serve the explorer to this machine alone until interrupted.

    Its address has a token, without which nothing is served: other users of the machine do not know it.
    Requests for other host names than this machine's, or from pages of other origins, are refused: a foreign
    page whose name is made to resolve to this machine must not read the images.

    Args:
        port: port on localhost; 0 takes a free one.
        browser: True to open the page.

    Raises:
        ValueError: for an invalid port, or one in use or not allowed.
    """
    if not 0 <= port <= 65535:
        raise ValueError(f"--port {port}: wanted 1 to 65535, or 0 for a free one")
    try:
        server = _Server(explorer, port)
    except OSError as error:
        raise ValueError(f"--port {port}: {error.strerror}: give another, or 0 for a free one") from None
    address = f"http://localhost:{server.server_port}/{server.token}/"
    print(f"the explorer is at {address} (Ctrl+C ends it)", flush=True)
    with _opened(address) if browser else nullcontext():
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            pass
        finally:
            server.server_close()


@contextmanager
def _opened(address: str) -> Iterator[None]:
    """Context manager that opens the address by a file that only this user can read: others see programs'
    arguments."""
    with TemporaryDirectory() as folder:
        file = Path(folder) / "explorer.html"
        file.write_text(f'<meta http-equiv="refresh" content="0;url={address}">', encoding="utf-8")
        webbrowser.open(file.as_uri())
        yield
