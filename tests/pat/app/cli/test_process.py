"""The command as a process of its own, and its help."""

import dataclasses
import os
import re
import subprocess
import sys
from pathlib import Path
from threading import Barrier, Thread

import pytest

from pat.app.cli import options
from pat.app.cli.main import Pat, command_paths, main
from pat.app.cli.options import FIELD_NAMES, WEIGHT_NAMES, field_named

ROOT = Path(__file__).parents[4]


def run(*words: str, then: str = "") -> subprocess.CompletedProcess:
    command = " ".join([sys.executable, "-m", "pat", *words, then])
    return subprocess.run(["bash", "-c", command], cwd=ROOT, capture_output=True, text=True)


@pytest.mark.parametrize(
    "words", [(), ("rig",), ("help",), ("help", "fuse"), ("fuse", "--help"), ("lab", "train", "--help")]
)
def test_help_imports_no_torch(words):
    code = f"""
import sys
from pat.app.cli.main import Pat, command_paths, main
from pat.app.cli.options import FIELD_NAMES, WEIGHT_NAMES, field_named
try: main({list(words)})
except SystemExit as stop: assert not stop.code
assert not {{"torch", "numpy", "scipy", "numba", "arraygeom", "rich"}} & set(sys.modules), sys.modules
assert "lab" in {list(words)} or "pat.lab" not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.stderr == ""
    assert any(word in done.stdout for word in ("fuse", "info", "rate"))


@pytest.mark.parametrize("path", [*command_paths()], ids=" ".join)
def test_every_command_has_help_that_reads_well(path, capsys):
    with pytest.raises(SystemExit) as stop:
        main([*path, "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    first = next(line for line in text.splitlines() if line and not line.startswith(("usage", " ")))
    assert text.count(first) == 1
    assert "{None}" not in text
    assert "(default: None)" not in text
    assert "(default: )" not in text


def test_the_explorer_needs_no_matplotlib(tmp_path):
    code = f"""
import sys
sys.modules["matplotlib"] = None
from pat.app.cli.main import main
main(["explore", "pat/app/sample/rig.yaml", "--save", {str(tmp_path / "page.html")!r}])
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "page.html").is_file()


def test_names_are_those_of_the_package():
    from arraygeom.fields.default import FIELDS
    from pat.networks.weights import shipped

    assert tuple(sorted(shipped())) == WEIGHT_NAMES
    assert tuple(FIELDS) == FIELD_NAMES
    assert all(dataclasses.is_dataclass(field_named(name)) for name in FIELD_NAMES)
    assert field_named("auto") is None


def test_help_lists_every_command(capsys):
    with pytest.raises(SystemExit):
        main([])
    text = capsys.readouterr().out
    lines = [line.split()[0] for line in text.splitlines() if line.startswith("  ")]
    assert lines == [*Pat.commands]
    assert all(len(line) <= 120 for line in text.splitlines())


@pytest.mark.parametrize("words", [["--version"], ["fuse", "a.png", "--version"]])
def test_the_version_is_printed(words, capsys):
    with pytest.raises(SystemExit):
        main(words)
    assert re.fullmatch(r"arraygeom-pat \d+\.\d+\S*\n", capsys.readouterr().out)


REFUSED = {
    "fuse --depth 2": "--depth",
    "fuse --format jpg": "--format",
    "fuse --netwrok x": "--network",
    "batch --workers x": "--workers",
    "fuse --alpha": "--alpha",
    "rig info r a=A": "--image",
    "lab evaluate --rates x": "--rates",
    "rig convert a": "OUT",
}


@pytest.mark.parametrize("line", REFUSED)
def test_what_the_parser_refuses_is_one_line(line, refusal):
    words = line.split()
    path = " ".join(words[:2] if words[0] in ("rig", "lab") else words[:1])
    said = refusal(*words)
    assert REFUSED[line] in said
    assert said.endswith(f"(`pat {path} --help` explains)")


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("fuse no.yaml --image a=b.png", "no.yaml: no such rig file"),
        ("rig info no.yaml", "no.yaml: no such rig file"),
        ("fuse --image a=LICENSE b=README.md", "b=README.md: no such rig file: if it is an image, write"),
        ("fuse no.png nothing.png", "no.png: no such image"),
        ("align no.png nothing.png", "no.png: no such image"),
        ("fuse --image mono.png --image c=b.png", "the images alone: `pat fuse mono.png b.png`"),
        ("fues", "did you mean 'fuse'"),
        ("fuse a.png b.png --max-memory 4gigs", "--max-memory"),
        ("align a.png b.png --confidence 80", "--confidence"),
        ("align a.png b.png --matches no.csv", "no.csv"),
    ],
)
def test_mistakes_that_need_no_torch_are_said_before_it_is_imported(line, said):
    """A mistake in the words of a line is answered at once."""
    code = f"""
import sys
from pat.app.cli.main import main
try: main({line.split()})
finally: assert "torch" not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert said in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_an_image_without_a_camera_is_explained(refusal):
    said = refusal("fuse", ROOT / "README.md", "--image", "mono.png")
    assert "--image mono.png" in said
    assert "mono=mono.png" in said


@pytest.mark.parametrize("command", ["fuse", "align"])
@pytest.mark.parametrize("others", [(), ("mono.png",)], ids=["alone", "with an image"])
def test_a_first_file_that_is_no_image_is_said_to_be_none(command, others, refusal):
    sample = ROOT / "pat" / "app" / "sample"
    said = refusal(command, ROOT / "README.md", *(str(sample / name) for name in others))
    assert f"{ROOT / 'README.md'}: is no image: images end in .png, .tif, .jpg" in said


def test_commands_that_do_not_exist(refusal):
    assert "'fuse'" in refusal("fues")
    assert "'doctor'" in refusal("rig", "docter")
    assert "fuse, batch" in refusal("--precision")
    assert "`pat lab train`" in refusal("train")


def test_a_closed_pipe_is_quiet():
    done = run("rig", "--help", then="| true; exit ${PIPESTATUS[0]}")
    assert (done.stdout, done.stderr) == ("", "")
    assert done.returncode in (0, 141)
    done = run("--help", then="| (exec 0<&-; sleep 1); exit ${PIPESTATUS[0]}")
    assert (done.stderr, done.returncode) == ("", 141)


def test_an_interruption_while_pat_is_imported_is_one_line():
    code = """
import builtins, runpy, sys
ordinary = builtins.__import__
def interrupted(name, *args, **kwargs):
    if name == "argparse":
        raise KeyboardInterrupt
    return ordinary(name, *args, **kwargs)
builtins.__import__ = interrupted
sys.argv = ["pat", "--help"]
runpy.run_module("pat", run_name="__main__")
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (130, "pat: interrupted\n")


def test_threads_that_wait_sleep():
    """They leave cores to other processes; a user's setting is kept."""
    code = (
        "import os\nfrom pat.__main__ import main\ntry: main()\nfinally: print(os.environ['OMP_WAIT_POLICY'])"
    )
    for given, wanted in (({}, "PASSIVE"), ({"OMP_WAIT_POLICY": "ACTIVE"}, "ACTIVE")):
        others = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
        line = [sys.executable, "-c", code, "--help"]
        done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, env=others | given)
        assert done.stdout.split()[-1] == wanted


def test_that_kernels_are_compiled_is_said_once(monkeypatch):
    event = pytest.importorskip("numba.core.event")
    said, listeners, barrier = [], [], Barrier(4)
    monkeypatch.setattr(event, "register", lambda kind, listener: listeners.append(listener))
    monkeypatch.setattr(options, "say", said.append)
    options.say_when_compiling.__wrapped__()

    def compile_one() -> None:
        barrier.wait()
        listeners[0].on_start(None)

    threads = [Thread(target=compile_one) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(said) == 1


@pytest.mark.slow
def test_nothing_is_compiled_after_warm_up(tmp_path):
    """Not by the demo either, which removes noise, nor by cameras with lenses."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}

    def said(*words):
        command = [sys.executable, "-m", "pat", *words]
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stderr

    assert "compiling kernels" in said("warm-up")
    assert "compiling" not in said("demo", "--out", str(tmp_path / "demo"))
