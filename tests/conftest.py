"""Shapes and types of every public function are checked while testing, and only then."""

import gc
import os
import re
from collections.abc import Generator
from importlib.util import find_spec
from pathlib import Path

import pytest

gc.set_threshold(70_000, 20)  # as `pat` does: a seventh of the time of imports went into seeking cycles

if find_spec("beartype"):  # arraygeom's tests run with nothing but its own dependencies, too
    from tests import typecheck

    typecheck.install()

if find_spec("hypothesis"):
    from hypothesis import HealthCheck, settings

    settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
    settings.load_profile("any machine")

# of workers that start beside other work
os.environ.setdefault("DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT", "300s")

SHARED = Path(__file__).parents[2] / "shared" / "data"


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    """Numbers drawn without a seed are the same whichever tests ran before, in whichever process."""
    import torch  # here, as xdist's own process needs none

    torch.manual_seed(0)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call() -> Generator:
    """Restore torch's number of threads after a test: more would spin, and slow all later tests."""
    import torch

    threads = torch.get_num_threads()
    found = yield
    assert torch._C.get_num_threads() <= threads, "the test left torch more threads than it had"
    return found


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real images beside the checkout; a test that needs it skips where it is absent."""
    if not SHARED.is_dir():
        pytest.skip(f"real images not at {SHARED}")
    return SHARED


@pytest.fixture
def refusal(capsys):
    """Return the one line with which `pat`, or another group of commands, refuses its arguments."""

    def said(*arguments: object, **group: object) -> str:
        from pat.app.cli.main import main

        with pytest.raises(SystemExit) as stop:
            main([str(argument) for argument in arguments], **group)
        assert stop.value.code == 2
        lines = capsys.readouterr().err.splitlines()
        errors = [i for i, line in enumerate(lines, 1) if re.match("pat: (?!warning)", line)]
        assert errors == [len(lines)]
        return lines[-1]

    return said
