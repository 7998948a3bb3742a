"""Every transformation of torch on every public operator; the table of docs/reports/transformations.md.

    python -m tests.transformations.run [--out docs/reports/transformations.md]

An answer is held against central differences, a loop, or the operator itself; it is right, or one error of
ours.
"""

from __future__ import annotations

import re
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from torch import Tensor
from torch.func import grad, hessian, jacfwd, jacrev, jvp, vjp, vmap

from docs.update_readme import write_block
from pat.app.cli.parser import script

from .operators import OPERATORS, Operator

STEP = 1e-5


def differences(f: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """The Jacobian (outputs, inputs) by central differences."""
    columns = []
    for e in torch.eye(len(x), dtype=x.dtype) * STEP:
        columns.append((f(x + e) - f(x - e)).flatten() / (2 * STEP))
    return torch.stack(columns, -1)


def weights(f: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    y = f(x)
    return torch.linspace(0.5, 1.5, y.numel(), dtype=x.dtype).reshape(y.shape)


def check_grad(o: Operator) -> None:
    w = weights(o.f, o.x)
    _near(grad(lambda x: (o.f(x) * w).sum())(o.x), w.flatten() @ differences(o.f, o.x))


def check_vjp(o: Operator) -> None:
    w = weights(o.f, o.x)
    _near(vjp(o.f, o.x)[1](w)[0], w.flatten() @ differences(o.f, o.x))


def check_jvp(o: Operator) -> None:
    t = torch.linspace(-1, 1, len(o.x), dtype=o.x.dtype)
    _near(jvp(o.f, (o.x,), (t,))[1].flatten(), differences(o.f, o.x) @ t)


def check_vmap(o: Operator) -> None:
    xs = torch.stack([o.x, o.x + 1e-3, o.x - 2e-3])
    _near(vmap(o.f)(xs), torch.stack([o.f(x) for x in xs]), 1e-9)


def check_jacobian(jacobian: Callable, o: Operator) -> None:
    _near(jacobian(o.f)(o.x).reshape(-1, len(o.x)), differences(o.f, o.x))


def check_hessian(o: Operator) -> None:
    """Against central differences of the gradient that autograd gives."""
    w = weights(o.f, o.x)

    def gradient(x: Tensor) -> Tensor:
        x = x.detach().clone().requires_grad_()
        y = (o.f(x).square() * w).sum()
        return torch.zeros_like(x) if not y.requires_grad else torch.autograd.grad(y, x)[0]

    _near(hessian(lambda x: (o.f(x).square() * w).sum())(o.x), differences(gradient, o.x), 1e-4)


def check_compile(o: Operator) -> None:
    torch._dynamo.reset()
    _near(torch.compile(o.f, fullgraph=True, backend="aot_eager")(o.x), o.f(o.x), 1e-9)


def check_autocast(o: Operator) -> None:
    with torch.autocast("cpu", torch.bfloat16):
        found = o.f(o.x)
    _near(found, o.f(o.x), o.autocast)


CHECKS: dict[str, Callable[[Operator], None]] = {
    "grad": check_grad,
    "vjp": check_vjp,
    "jvp": check_jvp,
    "vmap": check_vmap,
    "jacrev": partial(check_jacobian, jacrev),
    "jacfwd": partial(check_jacobian, jacfwd),
    "hessian": check_hessian,
    "compile": check_compile,
    "autocast": check_autocast,
}
OURS = (NotImplementedError, ValueError, TypeError)


def verdict(operator: str, transformation: str) -> str:
    """right; refused: and the message; else wrong: and what came."""
    try:
        CHECKS[transformation](OPERATORS[operator])
    except AssertionError as error:
        return f"wrong: {str(error).splitlines()[0]}"
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1].filename
        ours = (isinstance(error, OURS) and "site-packages" not in last) or "depends on numbers" in str(error)
        return f"{'refused' if ours else 'wrong'}: {_line(str(error))}"
    return "right"


def _line(message: str) -> str:
    """One line, and of torch's long ones what we told it."""
    said = re.search(r"Message: (.*?depends on numbers.*?)(?= Hint:|\n)", message)
    return " ".join((said[1] if said else message).split())[:200]


def _near(found: Tensor, expected: Tensor, tolerance: float = 1e-5) -> None:
    assert found.shape == expected.shape, f"shape {tuple(found.shape)}, wanted {tuple(expected.shape)}"
    scale = max(1.0, float(expected.detach().abs().max()))
    off = float((found.detach().double() - expected.detach().double()).abs().max())
    assert off <= tolerance * scale, f"{off:.2g} off, of {scale:.2g}"


@dataclass
class Table:
    """Print the table of transformations."""

    out: Path | None = None
    """A document whose block `transformations` the table replaces."""

    def run(self) -> int:
        torch.set_num_threads(1)
        lines = [f"| operator | {' | '.join(CHECKS)} |", f"|---|{'---|' * len(CHECKS)}"]
        notes: list[str] = []
        wrong = 0
        for operator in OPERATORS:
            cells = []
            for transformation in CHECKS:
                found = verdict(operator, transformation)
                wrong += found.startswith("wrong")
                if ": " in found:
                    print(f"{operator}, {transformation}: {found}", file=sys.stderr)
                    kind, _, message = found.partition(": ")
                    if message not in notes:
                        notes.append(message)
                    found = f"{kind} ({notes.index(message) + 1})"
                cells.append(found)
            lines.append(f"| {operator} | {' | '.join(cells)} |")
        text = "\n".join([*lines, "", *(f"{i}. {message}" for i, message in enumerate(notes, 1))])
        print(text)
        if self.out is not None:
            write_block(self.out, "transformations", text)
        return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(script(Table).run())
