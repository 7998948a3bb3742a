"""The explorer's server: for this machine's own names only, ports that are checked, a quiet end."""

import re
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from functools import partial
from pathlib import Path

import pytest

from pat.app.explore.page import opened
from pat.app.sample_array import SAMPLE, load_sample

ROOT = Path(__file__).parents[4]
IMAGES = [a for n in ("mono", "colour") for a in ("--image", f"{n}={SAMPLE / n}.png")]
EXPLORE = ["explore", str(SAMPLE / "rig.yaml"), *IMAGES, "--no-browser"]


@pytest.fixture
def server():
    command = [sys.executable, "-m", "pat", *EXPLORE]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    # also if the tests run in the background
    heard = partial(signal.signal, signal.SIGINT, signal.default_int_handler)
    process = subprocess.Popen(command, cwd=ROOT, preexec_fn=heard, **pipes)
    yield process, re.search(r"http://localhost:(\d+)", process.stdout.readline())[1]
    process.kill()
    process.communicate()


def status(port, path, data=None, **headers) -> int:
    request = urllib.request.Request(f"http://127.0.0.1:{port}{path}", data, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=300) as answer:
            return answer.status
    except urllib.error.HTTPError as error:
        return error.code


def test_foreign_hosts_are_refused_whatever_their_origin_and_ctrl_c_is_quiet(server):
    process, port = server
    for host in (f"localhost:{port}", f"127.0.0.1:{port}"):
        assert status(port, "/", Host=host) == 200
    for host in (
        f"evil.example:{port}",
        "evil.example",
        f"localhost.evil.example:{port}",
        f"xlocalhost:{port}",
    ):
        for path in ("/", "/answer", "/elsewhere"):
            assert status(port, path, Host=host) == 403
        assert status(port, "/answer", b"{}", Host=host, Origin=f"http://{host}") == 403
    own = f"localhost:{port}"
    assert status(port, "/answer", b"{}", Host=own, Origin="http://evil.example") == 403
    assert status(port, "/answer", b"{}", Host=own, Origin=f"http://{own}") == 200
    assert status(port, "/answer", b"[1", Host=own) == 400
    assert status(port, "/elsewhere", Host=own) == 404
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 0
    assert "Traceback" not in errors


@pytest.mark.parametrize("port", ["99999", "-1"])
def test_a_port_that_is_none_is_one_line(port, refusal):
    said = refusal(*EXPLORE, "--port", port)
    assert said == f"pat: --port {port}: wanted 1 to 65535, or 0 for a free one"


def test_a_port_in_use_is_one_line(server, refusal):
    _, port = server
    said = refusal(*EXPLORE, "--port", port)
    assert said == f"pat: --port {port}: Address already in use: give another, or 0 for a free one"


def test_a_saved_grid_answers_for_the_pixels_of_its_cells():
    """A column a pixel: each cell's is its own. Half a pixel off, every other one was its neighbour's."""
    rig = load_sample().rig
    for name in rig.names:
        rig = rig.resize(name, (6, 8))
    grid = opened(rig).grid(columns=8)
    assert {place: answer["x"] for place, answer in grid["answers"].items()} == {
        f"{i},{j}": [i, j] for i in range(8) for j in range(6)
    }


def test_weights_without_attention_are_refused_and_no_page_is_written(tmp_path, refusal):
    for weights, said in {"mono-colour": "are not of the paper's network", "foo": "no weights 'foo'"}.items():
        page = tmp_path / f"{weights}.html"
        assert said in refusal(*EXPLORE, "--weights", weights, "--save", page)
        assert not page.exists()
