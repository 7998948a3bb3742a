"""The explorer's server: for this machine's own names only, ports that are checked, a quiet end."""

import json
import os
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
from pat.app.explore.serving import _opened
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
    yield process, *re.search(r"http://localhost:(\d+)(/\S+/)", process.stdout.readline()).groups()
    process.kill()
    process.communicate()


def status(port, path, data=None, **headers) -> int:
    request = urllib.request.Request(f"http://127.0.0.1:{port}{path}", data, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=300) as answer:
            return answer.status
    except urllib.error.HTTPError as error:
        return error.code


def another_user(ask) -> list:
    """Return what a process of another user of this machine, "nobody", is answered."""
    source, sink = os.pipe()
    child = os.fork()
    if not child:
        try:
            os.setgroups([])
            os.setgid(65534)
            os.setuid(65534)
            answers = ask()
        except BaseException as error:  # else this process would go on with the tests
            answers = [repr(error)]
        os.write(sink, json.dumps(answers).encode())
        os._exit(0)
    os.close(sink)
    with open(source) as answers:
        os.waitpid(child, 0)
        return json.load(answers)


@pytest.mark.skipif(sys.platform != "linux" or os.geteuid() != 0, reason="only root becomes another user")
def test_another_user_of_the_machine_is_refused(server):
    """Whoever is told the address may look; others can neither guess it nor read it off the process."""
    process, port, page = server
    own, token = f"localhost:{port}", page.strip("/")

    def read(path) -> str:
        try:
            return Path(path).read_bytes().decode(errors="replace")
        except PermissionError:
            return "not permitted"

    def ask() -> list:
        guessed = [f"/{'a' * len(token)}/", f"/{token[:-1]}/", f"/{token[:-1]}%00/", "/", "/answer"]
        refused = [status(port, path, data, Host=own) for path in guessed for data in (None, b"{}")]
        about = [read(f"/proc/{process.pid}/{name}") for name in ("cmdline", "environ", "maps", "mem")]
        foreign = [status(port, page, Host=host) for host in ("evil.example", f"evil.example:{port}")]
        foreign.append(status(port, f"{page}answer", b"{}", Host=own, Origin="http://evil.example"))
        return [refused, about, foreign, status(port, page, Host=own)]

    assert status(port, "/", Host=own) == 404  # and all modules are there: others cannot read root's
    answers = another_user(ask)
    assert len(answers) == 4, answers
    refused, about, foreign, told = answers
    assert {*refused} == {404}
    assert "explore" in about[0]
    assert token not in "".join(about)
    assert {*about[1:]} == {"not permitted"}
    assert {*foreign} == {403}
    assert told == 200


def test_the_browser_is_not_told_the_token_where_others_see_it(monkeypatch):
    """The arguments of its process are seen by all users."""
    opened_by_browser = []
    monkeypatch.setattr("webbrowser.open", opened_by_browser.append)
    with _opened("http://localhost:1/token/"):
        (file,) = [Path(url.removeprefix("file://")) for url in opened_by_browser]
        assert "url=http://localhost:1/token/" in file.read_text()
        assert file.parent.stat().st_mode & 0o077 == 0


def test_only_what_was_given_is_imported_or_looked_up(tmp_path, monkeypatch):
    """A question imported any module, and told by the weights which files there are."""
    (tmp_path / "evilmod.py").write_text("open('ran', 'w')\nfield = None\n")
    (tmp_path / "a.safetensors").touch()
    monkeypatch.chdir(tmp_path)
    explorer = opened(load_sample().rig)
    errors = set()
    for change in (
        {"field": "evilmod:field"},
        {"second": "evilmod:field"},
        {"weights": "a.safetensors"},
        {"weights": "b.safetensors"},
        {"field": ["epipolar"]},
        {"near": [[[1]]]},
    ):
        errors.add(explorer.answer({**explorer.controls, **change})["error"].replace("b.s", "a.s"))
    assert len(errors) == 5
    assert not (tmp_path / "ran").exists()
    assert "error" not in explorer.answer({**explorer.controls, "field": "epipolar"})


def test_foreign_hosts_are_refused_whatever_their_origin_and_ctrl_c_is_quiet(server):
    process, port, page = server
    for host in (f"localhost:{port}", f"127.0.0.1:{port}"):
        assert status(port, page, Host=host) == 200
    for host in (
        f"evil.example:{port}",
        "evil.example",
        f"localhost.evil.example:{port}",
        f"xlocalhost:{port}",
    ):
        for path in (page, f"{page}answer", "/elsewhere"):
            assert status(port, path, Host=host) == 403
        assert status(port, f"{page}answer", b"{}", Host=host, Origin=f"http://{host}") == 403
    own = f"localhost:{port}"
    answer = f"{page}answer"
    assert status(port, answer, b"{}", Host=own, Origin="http://evil.example") == 403
    assert status(port, answer, b"{}", Host=own, Origin=f"http://{own}") == 200
    for text in (b"[1", b"[" * 60_000, b"\xff", b"3"):
        assert status(port, answer, text, Host=own) == 400
    deep = b'{"moved": ' + b'{"a":' * 900 + b"1" + b"}" * 900 + b"}"
    assert status(port, answer, deep, Host=own) in (200, 400)
    for path in ("/", "/answer", "/elsewhere", page[:-2] + "/", f"{page}../"):
        assert status(port, path, Host=own) == status(port, path, b"{}", Host=own) == 404
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 0
    assert "Traceback" not in errors


@pytest.mark.parametrize("port", ["99999", "-1"])
def test_a_port_that_is_none_is_one_line(port, refusal):
    said = refusal(*EXPLORE, "--port", port)
    assert said == f"pat: --port {port}: wanted 1 to 65535, or 0 for a free one"


def test_a_port_in_use_is_one_line(server, refusal):
    _, port, _ = server
    said = refusal(*EXPLORE, "--port", port)
    assert said == f"pat: --port {port}: Address already in use: give another, or 0 for a free one"


def test_a_saved_grid_answers_for_the_pixels_of_its_cells():
    """One column per pixel: each cell has its own answer, not its neighbour's."""
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
        assert said in refusal(*EXPLORE, "--network", weights, "--save", page)
        assert not page.exists()
