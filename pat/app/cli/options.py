"""Options that several commands share: their types and help, what NAME=VALUE means, and what is printed.

Nothing here or in the modules of the commands imports torch before a command runs: `pat --help` is printed at
once.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryFile
from threading import Lock
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from ...support.folders import printable
from .parser import Option, UsageError

if TYPE_CHECKING:
    from rich.console import Console
    from torch import Tensor

    from arraygeom import ReceptiveField, Rig

    from ...fusion.tiles import Plan

T = TypeVar("T")

SHIPPED = Path(__file__).parents[2] / "networks" / "shipped"
WEIGHT_NAMES = tuple(sorted(path.stem for path in SHIPPED.glob("*.safetensors")))


FIELD_NAMES = ("epipolar", "line", "homography", "rectified", "nearest", "local", "dense", "curved")
"""The keys of `arraygeom.fields.FIELDS`, whose import takes torch."""
FIELD_HELP = (
    f"Receptive field in the other cameras: {', '.join(FIELD_NAMES)}, or MODULE:OBJECT for your own; "
)
FIELD_HELP += "auto takes what the rig allows."
FieldName = Annotated[str, Option("NAME", FIELD_HELP)]


def response_of(text: str) -> Any:
    """What `--response fit`, `rec601` or `R,G,B` states. Raises ValueError for anything else."""
    if text in ("fit", "rec601"):
        return text
    try:
        red, green, blue = (float(number) for number in text.split(","))
    except ValueError:
        raise ValueError(
            f"--response: '{text}' is neither 'fit' nor 'rec601' nor R,G,B, such as 0.33,0.33,0.33"
        ) from None
    if not 0.8 <= red + green + blue <= 1.25:  # an exposure is fitted or stated, not a part of the weights
        raise ValueError(
            f"--response: {text} add up to {red + green + blue:.3g}: give weights that add up to 1"
        )
    return red, green, blue


def noise_of(texts: Iterable[str], *, by_default: bool = False) -> Any:
    """The noise of `--noise estimate` or `--noise NAME=ELECTRONS[,READ]`; none: None. Raises ValueError.

    Without, None or, `by_default`, "auto": estimated where it shows plainly.
    """
    from ...sensors import NoiseLevel

    entries = list(texts)
    if not entries:
        return "auto" if by_default else None
    if entries in (["estimate"], ["none"]):
        return None if entries == ["none"] else "estimate"
    if {"estimate", "none"} & {*entries}:
        raise ValueError(
            f"--noise: got {', '.join(entries)}: give estimate or none alone, or NAME=ELECTRONS of each"
        )
    levels = []
    for entry in entries:
        name, _, numbers = entry.partition("=")
        try:
            electrons, *read = (float(number) for number in numbers.split(","))
        except ValueError:
            raise ValueError(
                f"--noise: '{entry}' is neither estimate nor none nor NAME=ELECTRONS[,READ], as mono=200,2"
            ) from None
        if (count := 1 + len(read)) > 2:
            raise ValueError(f"--noise: '{entry}' has {count} numbers; wanted electrons at white, read noise")
        levels.append((name, NoiseLevel.of_electrons(electrons, sum(read))))
    return dict(_once("--noise", levels))


RigFile = Annotated[Path, Option("RIG", "Rig file of any known format; also: --rig RIG.", positional=True)]
Images = Annotated[tuple[str, ...], Option("NAME=FILE", repeat=True)]
Numbers = Annotated[tuple[str, ...], Option("NAME=NUMBER", repeat=True)]
Name = Annotated[str | None, Option("NAME")]
Out = Annotated[Path, Option("PATH", short="-o")]
MaybeOut = Annotated[Path | None, Option("PATH", short="-o")]
Depth = Annotated[tuple[float, float] | None, Option("NEAR FAR")]
Memory = Annotated[str | None, Option("SIZE")]
WEIGHTS_HELP = f"Weights: {', '.join(WEIGHT_NAMES)}, or a file."
Weights = Annotated[str, Option("NAME|FILE", WEIGHTS_HELP)]
Address = Annotated[str | None, Option("ADDRESS")]


def rig_first(arguments: Sequence[str], command: Any) -> list[str]:
    """The arguments with the rig of `--rig RIG` in front, where it stands without the option."""
    words = list(arguments)
    if not {"rig", "given", "source"} & {*getattr(command, "__dataclass_fields__", {})}:
        return words
    for i, word in enumerate(words):
        option, equals, value = word.partition("=")
        if option == "--rig":
            value = value if equals else "".join(words[i + 1 : i + 2])
            if not value:
                raise UsageError("--rig", "a rig file")
            return [value, *words[:i], *words[i + (1 if equals else 2) :]]
    return words


def writable(out: Path, *, folder: bool = False, option: str = "--out") -> Path:
    """The path of an option, before the work whose result is to be written there.

    Raises ValueError if it cannot be: a folder where a file is wanted, a file in its way, no permission.
    """
    if out.exists() and out.is_dir() != folder:
        raise ValueError(
            f"{option}: {out} is a {'folder: name a file in it' if out.is_dir() else 'file: name a folder'}"
        )
    above = out if out.exists() else next(p for p in out.absolute().parents if p.exists())
    if above != out and not above.is_dir():
        raise ValueError(f"{option}: {above} is a file, so {out} cannot be made: give another path")
    if not os.access(above, os.W_OK):
        raise ValueError(f"{option}: {above} cannot be written to: give another path, or permission")
    place = above if above.is_dir() else above.absolute().parent
    try:
        with TemporaryFile(dir=place):  # of a drive that is read-only, or as root, permissions say little
            return out
    except OSError as error:
        raise ValueError(
            f"{option}: {place} cannot be written to ({error.strerror}): give another path, or permission"
        ) from None


def device_of(name: str) -> str:
    """ "cpu" or "cuda". Raises ValueError for a GPU that is not there."""
    if name == "cpu":
        return name
    import torch

    if torch.cuda.is_available():
        return "cuda"
    if name == "cuda":
        raise ValueError("--device cuda: no CUDA device is available: leave it out, or get torch for CUDA")
    return "cpu"


def field_named(name: str) -> ReceptiveField | None:
    """The receptive field of that name; None for "auto". Raises ValueError for a name that is none."""
    from arraygeom.fields import named_field

    try:
        return None if name == "auto" else named_field(name)
    except ValueError as error:
        raise ValueError(f"--field: {error}") from None


def load_rig(path: Path, depth: tuple[float, float] | None = None) -> Rig:
    """The rig of a file, with other depth bounds if given."""
    refuse_missing(path, rig=True)
    from arraygeom import Rig

    rig = Rig.load(path)
    return rig if depth is None else rig.replace(depth=depth)


NO_IMAGE = "is no image: images end in .png, .tif, .jpg and the like"


def load_rig_or_say_no_image(path: Path, depth: tuple[float, float] | None) -> Rig:
    """The rig of the first argument, perhaps meant as an image; with other depth bounds if given."""
    from arraygeom.io.source import UnknownRigFormat

    try:
        return load_rig(path, depth)
    except UnknownRigFormat:
        raise ValueError(
            f"{path}: {NO_IMAGE}; nor is it a rig file (`pat rig convert --help` names formats)"
        ) from None


def refuse_missing(path: Path, *, rig: bool) -> None:
    """Raise FileNotFoundError for a rig file, or an image, folder or video, that does not exist, before torch
    is imported to read it."""
    if path.exists() or (not rig and any(c in path.name for c in "*?[")):
        return
    _, _, file = str(path).partition("=")
    advice = "check the path"
    if file and Path(file).exists():
        rigless = f"give {file} alone, cameras are called as their files are"
        advice = "if it is an image, write --image before each NAME=FILE" if rig else rigless
    raise FileNotFoundError(f"{path}: no such {'rig file' if rig else 'image'}: {advice}")


def files_by_name(texts: Iterable[str], option: str = "--image") -> dict[str, Path]:
    """Values of a NAME=FILE option. Raises ValueError for other text, and for a name given twice."""
    return dict(_once(option, (_named_file(option, text) for text in texts)))


def numbers_by_name(texts: Iterable[str], option: str) -> dict[str, float]:
    """Values of a NAME=NUMBER option. Raises ValueError for other text, and for a name given twice."""
    return dict(_once(option, (_named_number(option, text) for text in texts)))


def read_images(rig: Rig, texts: Iterable[str], *, sized: bool = True) -> dict[str, Tensor]:
    """The images of `--image NAME=FILE` by camera, developed as the rig describes them.

    Raises ValueError for a camera given twice, or not of the rig, and, if `sized`, for an image of another
    size.
    """
    from ...fusion.views import read_view

    files = {rig.require(name): path for name, path in files_by_name(texts).items()}
    return {name: read_view(rig, name, path, sized=sized) for name, path in files.items()}


def read_frames(rig: Rig, texts: Iterable[str]) -> list[dict[str, Tensor]]:
    """Images of `--image NAME=FILE`: the first of every camera make a frame, the second ones the next.

    Raises ValueError for no images, and for cameras with unequal numbers of them.
    """
    from ...fusion.views import read_view

    files: dict[str, list[Path]] = {}
    for name, path in (_named_file("--image", text) for text in texts):
        files.setdefault(rig.require(name), []).append(path)
    if not files:
        raise ValueError("--image: give NAME=FILE for each of two cameras or more")
    try:
        frames = by_frame(files)
    except ValueError as error:
        raise ValueError(f"--image: {error}") from None
    return [{n: read_view(rig, n, path, sized=False) for n, path in frame.items()} for frame in frames]


def by_frame(files: Mapping[str, Sequence[Path]]) -> list[dict[str, Path]]:
    """The first file of each camera, the second of each, and so on. Raises ValueError for unequal numbers."""
    counts = {name: len(paths) for name, paths in files.items()}
    if len(set(counts.values())) > 1:
        listed = ", ".join(f"'{name}' {count}" for name, count in counts.items())
        raise ValueError(
            f"every camera needs an image of every frame; there are {listed}: give each camera as many"
        )
    return [dict(zip(files, paths)) for paths in zip(*files.values())]


def _named_file(option: str, text: str) -> tuple[str, Path]:
    name, _, path = text.partition("=")
    if name and path:
        return name, Path(path)
    file = path or text
    if not Path(file).suffix:
        raise ValueError(f"{option}: '{text}' is not NAME=FILE")
    raise ValueError(
        f"{option} {text}: which camera is it of? Give NAME=FILE, such as {Path(file).stem}={file}"
    )


def _named_number(option: str, text: str) -> tuple[str, float]:
    name, _, number = text.partition("=")
    with suppress(ValueError):
        if math.isfinite(value := float(number)):
            return name, value
    raise ValueError(f"{option}: '{text}' is not NAME=NUMBER, such as mono=30")


def _once(option: str, pairs: Iterable[tuple[str, T]]) -> Iterator[tuple[str, T]]:
    given = set()
    for name, value in pairs:
        if name in given:
            raise ValueError(f"{option}: '{name}' is given twice; give it once")
        given.add(name)
        yield name, value


@cache
def console() -> Console:
    """The terminal, for what is not the result: standard error."""
    from rich.console import Console

    return Console(stderr=True, highlight=False)


WARNED: list[Warning | str] = []
"""What a command has warned of, once each."""


def warn(message: Warning | str, *_: Any, **__: Any) -> None:
    """A warning as one line, without its position in the code; not again if it was said before."""
    if str(message) not in map(str, WARNED):
        WARNED.append(message)
        say(f"pat: warning: {message}", style="yellow")


def say(text: object, style: str | None = None) -> None:
    """Print a line on standard error."""
    with suppress(OSError):  # the work goes on where nothing can be said, as on a full disk
        console().print(printable(f"{text}"), style=style, markup=False, emoji=False, soft_wrap=True)


def progress(title: str) -> Callable[[Iterable[T], int], Iterable[T]]:
    """Wraps items and their number in a bar on the terminal."""
    from rich.progress import track

    return lambda items, total: track(items, title, total=total, console=console())


LINE_EVERY = 10.0
"""Least seconds between lines of progress where there is no terminal."""


@contextmanager
def working(title: str) -> Iterator[Callable[[str], None]]:
    """A block while the terminal shows a title, the present step, and the seconds that have passed.

    Gives a function that changes the title. Where there is no terminal, steps are lines, `LINE_EVERY` seconds
    apart.
    """
    import time

    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    from ...support.steps import steps_shown

    title_column, step_column = (
        TextColumn(text, markup=False) for text in ("{task.description}", "{task.fields[step]}")
    )
    title = printable(title)
    columns = SpinnerColumn(), title_column, TimeElapsedColumn(), step_column
    terminal, printed = console().is_terminal, time.monotonic()
    with Progress(*columns, console=console(), transient=True, disable=not terminal) as bar:
        task = bar.add_task(title, total=None, step="")

        def show(step: str) -> None:
            nonlocal printed
            bar.update(task, step=step)
            if not terminal and time.monotonic() - printed > LINE_EVERY:
                printed = time.monotonic()
                say(f"{bar.tasks[0].description}: {step}")

        with steps_shown(show):
            yield lambda title: bar.update(task, description=title)


@contextmanager
def working_by_plan(title: str) -> Iterator[Callable[[Plan], None]]:
    """A block as of `working`; gives a function that says the plan, and adds its time to the title."""
    with working(title) as retitle:

        def announce(plan: Plan) -> None:
            say(f"plan: {plan}")
            retitle(title if plan.seconds is None else f"{title}, about {plan.duration} in all")

        yield announce


@cache
def say_when_compiling() -> None:
    """Say once, in one line, that kernels are compiled, before they are: that takes some seconds."""
    from numba.core import event

    first = Lock()

    class Compiling(event.Listener):
        def on_start(self, event: object) -> None:
            if first.acquire(blocking=False):
                say("compiling kernels for this machine, once (`pat warm-up` does so beforehand)")

        def on_end(self, event: object) -> None:
            pass

    event.register("numba:compile", Compiling())


def print_json(document: Any) -> None:
    """Print a document as JSON; what is not finite is null."""
    import json

    print(json.dumps(_finite(document), indent=2))


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _finite(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
