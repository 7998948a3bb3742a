"""arraygeom beside kornia, for what both have: values, gradients, low precision, and the ratio of times.

Run as `python -m tests.benchmarks.bench_kornia`; it writes both into docs/reports/kornia.md.

The value's difference is the largest over all entries, float64, relative to the largest entry. The gradient's
error is each library's own, of a random cotangent, against central differences of its own values; second
derivatives have to be finite. Under autocast to bfloat16 (float32 given) and with everything in float16
errors are against float64, relative to the largest entry. Times are of forward and backward in float64 on one
thread, for 20,000 points, median of several runs, kornia's divided by ours. Kornia's functions are counted as
they are called from our code, by a profiler.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from functools import partial
from statistics import median
from types import FrameType

import kornia.geometry
import torch
from torch import Tensor

from arraygeom import Camera, Distortion, Pose, Rig, relative_pose
from docs.update_readme import write_block
from pat import fuse
from pat.app.cli.parser import script
from pat.lab.evaluation.tables import markdown_table
from pat.networks.guided import GuidedPAT
from tests.arraygeom.rigs import random_rig
from tests.arraygeom.test_kornia_parity import CASES, Parity, cases
from tests.benchmarks.printed import REPORTS, timed
from tests.transformations.operators import OPERATORS

OUR_PACKAGES = "arraygeom", "pat", "calib"
RUNS = 15
STEP = 1e-6


def value_difference(case: Parity) -> float:
    """The largest difference between the two, relative to the largest value."""
    ours, theirs = case.ours(case.at).detach(), case.theirs(case.at).detach()
    return float((ours - theirs).abs().max() / ours.abs().max().clamp(min=1e-300))


def gradient_error(f: Callable[[Tensor], Tensor], at: Tensor) -> float:
    """Return the error of a directional derivative against central differences, relative to its size."""
    g = torch.Generator().manual_seed(3)
    leaf = at.clone().requires_grad_()
    value = f(leaf)
    cotangent, step = (torch.randn(shape, dtype=at.dtype, generator=g) for shape in (value.shape, at.shape))
    (gradient,) = torch.autograd.grad((value * cotangent).sum(), leaf)
    step = step * at.abs().clamp(min=1e-3)
    change = (f(at + STEP * step) - f(at - STEP * step)) / (2 * STEP)
    expected = float((change * cotangent).sum().detach())
    return abs(float((gradient * step).sum().detach()) - expected) / max(abs(expected), 1e-12)


def second_order(f: Callable[[Tensor], Tensor], at: Tensor) -> None:
    """Raises AssertionError where a second derivative is not finite."""
    leaf = at.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(f(leaf).square().sum(), leaf, create_graph=True)
    if gradient.requires_grad:
        (again,) = torch.autograd.grad(gradient.square().sum(), leaf, allow_unused=True)
        assert again is None or bool(again.isfinite().all())


def low_precision(name: str, side: int, dtype: torch.dtype) -> str:
    """The error of ours (0) or kornia's (1): under autocast for float32, else with all given in `dtype`."""
    case, exact = cases(40, dtype)[name], CASES[name][side](CASES[name].at)
    try:
        with torch.autocast("cpu", torch.bfloat16, enabled=dtype == torch.float32):
            value = case[side](case.at).double()
    except Exception:
        return "refused"
    error = float((value - exact).detach().abs().max() / exact.detach().abs().max())
    return f"{error:.0e}" if math.isfinite(error) else "not finite"


def time_ratio(case: Parity) -> float:
    """Kornia's time of value and gradient divided by ours: medians of processor time, alternating."""
    leaf = case.at.clone().requires_grad_()
    ways = (lambda f=f: torch.autograd.grad(f(leaf).sum(), leaf) for f in (case.ours, case.theirs))
    ours, theirs = timed(*ways, repeats=RUNS)
    return median(theirs) / median(ours)


def table() -> str:
    """One row a case, as Markdown."""
    rows, large = [], cases(20_000)
    for name, case in CASES.items():
        for f in case[:2]:
            second_order(f, case.at)
        gradients = (f"{gradient_error(f, case.at):.0e}" for f in case[:2])
        low = (low_precision(name, i, dtype) for dtype in (torch.float32, torch.float16) for i in (0, 1))
        rows.append(
            [name, f"{value_difference(case):.0e}", *gradients, *low, f"{time_ratio(large[name]):.1f}"]
        )
    columns = (
        *("what", "value, relative difference", "gradient error, ours", "kornia's", "autocast, ours"),
        *("kornia's", "float16, ours", "kornia's", "time, kornia / ours"),
    )
    return markdown_table(columns, rows, align="l")


def kornia_calls(run: Callable[[], object]) -> set[str]:
    """Kornia's functions that our packages call themselves while something runs."""
    found = set()

    def noted(frame: FrameType, event: str, _: object) -> None:
        back = frame.f_back
        module = frame.f_globals.get("__name__", "")
        if event == "call" and back is not None and module.startswith("kornia."):
            ours = back.f_globals.get("__name__", "").partition(".")[0] in OUR_PACKAGES
            if ours and frame.f_code.co_name.isidentifier():
                found.add(f"{module}.{frame.f_code.co_qualname}")

    kornia.geometry.epipolar  # noqa: B018  (imported before: modules are not functions)
    sys.setprofile(noted)
    try:
        run()
    finally:
        sys.setprofile(None)
    return found


def counts() -> str:
    """Which of kornia's functions our operators call, and which `fuse`."""
    calls = {name: kornia_calls(partial(o.f, o.x)) for name, o in OPERATORS.items()}
    every = set().union(*calls.values(), kornia_calls(convert))
    lines = [
        f"{sum(map(bool, calls.values()))} of {len(calls)} operators "
        f"call {len(every)} of kornia's functions:",
        "",
    ]
    lines += [f"- `{name}`" for name in sorted(every)]
    return "\n".join([*lines, "", f"`fuse` calls {len(kornia_calls(fused))} of them."])


def convert() -> None:
    """Rigs and poses there and back."""
    rig = random_rig(1)
    pose = rig["alpha"].cam_from_world
    Rig.from_kornia(rig.to_kornia())
    for model in ("brown-conrady", "kannala-brandt"):
        lens = Distortion(model, torch.full((4,), 0.01, dtype=torch.float64))
        Camera.from_kornia(rig["alpha"].replace(distortion=lens).to_kornia(), cam_from_world=pose)
    Pose.from_kornia(pose.to_kornia())
    Pose.from_quaternion(pose.quaternion, pose.t)
    pair = rig.pair("alpha", "beta")
    x = torch.rand(2, 8, 2)
    relative_pose(pair.fundamental, *(camera.K for camera in pair.cameras), *x)


def fused() -> None:
    """A small fusion."""
    rig = Rig({"alpha": random_rig(1)["alpha"], "beta": random_rig(1)["beta"]}, depth=(1.5, 10.0))
    images = {"alpha": torch.rand(1, 48, 64), "beta": torch.rand(3, 40, 60)}
    fuse(images, rig, alpha="alpha", network=GuidedPAT())


def main() -> None:
    """Print the lists, and put them into docs/reports/kornia.md."""
    torch.set_num_threads(1)
    for name, made in {"table": table(), "calls": counts()}.items():
        print(made)
        write_block(REPORTS / "kornia.md", name, made)


if __name__ == "__main__":
    script(main)
