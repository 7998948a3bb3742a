"""arraygeom beside kornia, for what both have: differences in value and gradient, and the ratio of times.

Run as `python -m tests.benchmarks.bench_kornia`; it writes its table into docs/kornia.md.

The value's difference is the largest over all entries, float64, relative to the largest entry. The gradient's error is
each library's own, of a random cotangent, against central differences of its own values. Times are of forward and
backward in float64 on one thread, for 20,000 points, median of several runs, kornia's divided by ours.
"""

from __future__ import annotations

import re
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from tests.arraygeom.test_kornia_parity import CASES, Parity, cases

PAGE = Path(__file__).parents[2] / "docs" / "kornia.md"
MARKERS = "<!-- table: begin -->", "<!-- table: end -->"
RUNS = 15
STEP = 1e-6


def value_difference(case: Parity) -> float:
    """The largest difference between the two, relative to the largest value."""
    ours, theirs = case.ours(case.at), case.theirs(case.at)
    return float((ours - theirs).abs().max() / ours.abs().max().clamp(min=1e-300))


def gradient_error(f: Callable[[Tensor], Tensor], at: Tensor) -> float:
    """Of a directional derivative against central differences, relative to its size."""
    g = torch.Generator().manual_seed(3)
    leaf = at.clone().requires_grad_()
    value = f(leaf)
    cotangent, step = (torch.randn(shape, dtype=at.dtype, generator=g) for shape in (value.shape, at.shape))
    (gradient,) = torch.autograd.grad((value * cotangent).sum(), leaf)
    step = step * at.abs().clamp(min=1e-3)
    change = (f(at + STEP * step) - f(at - STEP * step)) / (2 * STEP)
    expected = float((change * cotangent).sum().detach())
    return abs(float((gradient * step).sum().detach()) - expected) / max(abs(expected), 1e-12)


def second_order(f: Callable[[Tensor], Tensor], at: Tensor) -> str:
    """Whether the second derivative is finite, at zero for rotation vectors."""
    leaf = at.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(f(leaf).square().sum(), leaf, create_graph=True)
    if not gradient.requires_grad:
        return "none"
    (again,) = torch.autograd.grad(gradient.square().sum(), leaf, allow_unused=True)
    return "none" if again is None else "finite" if bool(again.isfinite().all()) else "not finite"


def time_ratio(case: Parity) -> float:
    """Kornia's time of value and gradient divided by ours: medians of processor time, alternating."""
    leaf = case.at.clone().requires_grad_()
    times: tuple[list[float], list[float]] = ([], [])
    for _ in range(RUNS):
        for f, spent in zip((case.ours, case.theirs), times):
            begin = time.process_time()
            torch.autograd.grad(f(leaf).sum(), leaf)
            spent.append(time.process_time() - begin)
    ours, theirs = (statistics.median(spent[2:]) for spent in times)
    return theirs / ours


def table() -> str:
    """One row a case, as Markdown."""
    lines = [
        "| what | value, relative difference | gradient error, ours | kornia's | second derivative, ours | kornia's "
        "| time, kornia / ours |",
        "|---|---|---|---|---|---|---|",
    ]
    large = cases(20_000)
    for name, case in CASES.items():
        errors = [gradient_error(f, case.at) for f in case[:2]]
        second = [second_order(f, case.at) for f in case[:2]]
        cells = [
            name,
            f"{value_difference(case):.0e}",
            *(f"{e:.0e}" for e in errors),
            *second,
            f"{time_ratio(large[name]):.1f}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def write_page(text: str) -> None:
    """Put the table between the page's markers."""
    begin, end = MARKERS
    pattern = re.compile(re.escape(begin) + r".*?" + re.escape(end), re.S)
    PAGE.write_text(pattern.sub(lambda _: f"{begin}\n{text}\n{end}", PAGE.read_text()))


if __name__ == "__main__":
    torch.set_num_threads(1)
    made = table()
    print(made)
    write_page(made)
