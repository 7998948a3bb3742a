"""Options shared by several commands: types and help, parsing of NAME=VALUE, and printing.

Neither this module nor those of the commands import torch before a command runs: `pat --help` is printed at
once.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cache, partial
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
"""Keys of `arraygeom.fields.FIELDS`, whose import takes torch."""
FIELD_HELP = f"Receptive field: auto (as the rig allows), {', '.join(FIELD_NAMES)}, or MODULE:OBJECT."
FieldName = Annotated[str, Option("NAME", FIELD_HELP)]


def response_of(text: str) -> Any:
    """Parse `--response fit`, `rec601` or `R,G,B`.

    Returns:
        The text, or the three weights.

    Raises:
        ValueError: for other text, and weights whose sum is not from 0.8 to 1.25.
    """
    if text in ("fit", "rec601"):
        return text
    try:
        red, green, blue = (float(number) for number in text.split(","))
    except ValueError:
        raise ValueError(f"--response: expected fit, rec601 or R,G,B, as .3,.4,.3, got '{text}'") from None
    if not 0.8 <= red + green + blue <= 1.25:  # an exposure is fitted or stated, not a part of the weights
        raise ValueError(f"--response: {text} add up to {red + green + blue:.3g}: they must add up to 1")
    return red, green, blue


def noise_of(texts: Iterable[str], *, by_default: bool = False) -> Any:
    """Parse `--noise estimate`, `none` or `NAME=ELECTRONS[,READ]`.

    Args:
        by_default: True to return "auto" (estimate where noise shows plainly) without --noise.

    Returns:
        "estimate", "auto", noise levels by camera, or None for no denoising.

    Raises:
        ValueError: for other text, a camera given twice, fewer than 1 electron, and a negative read noise.
            That the rig has the cameras is not checked.
    """
    from ...sensors import NoiseLevel

    entries = list(texts)
    if not entries:
        return "auto" if by_default else None
    if entries in (["estimate"], ["none"]):
        return None if entries == ["none"] else "estimate"
    if {"estimate", "none"} & {*entries}:
        raise ValueError(f"--noise: got {', '.join(entries)}: give estimate or none alone, or NAME=ELECTRONS")
    levels = []
    for entry in entries:
        name, _, numbers = entry.partition("=")
        try:
            electrons, *read = (float(number) for number in numbers.split(",") if name)
        except ValueError:
            raise ValueError(f"--noise: got '{entry}': give estimate, none, NAME=ELECTRONS[,READ]") from None
        if (count := 1 + len(read)) > 2:
            raise ValueError(f"--noise: '{entry}' has {count} numbers; wanted electrons at white, read noise")
        levels.append((name, NoiseLevel.from_electrons(electrons, sum(read))))
    return dict(_once("--noise", levels))


RigFile = Annotated[Path, Option("RIG", "Rig file of any known format; also: --rig RIG.", positional=True)]
Images = Annotated[tuple[str, ...], Option("NAME=FILE", repeat=True)]
Numbers = Annotated[tuple[str, ...], Option("NAME=NUMBER", repeat=True)]
Name = Annotated[str | None, Option("NAME")]
Out = Annotated[Path, Option("PATH", short="-o")]
MaybeOut = Annotated[Path | None, Option("PATH", short="-o")]
Depth = Annotated[tuple[float, float] | None, Option("NEAR FAR")]
Memory = Annotated[str | None, Option("SIZE")]
NETWORK_HELP = f"Network: {', '.join(WEIGHT_NAMES)}, or a file of weights."
NetworkName = Annotated[str, Option("NAME|FILE", NETWORK_HELP)]
Address = Annotated[str | None, Option("ADDRESS")]


def rig_first(arguments: Sequence[str], command: Any) -> list[str]:
    """Move the rig of `--rig RIG` to the front of the arguments, for commands with a positional rig.

    Returns:
        The arguments, for other commands and without --rig as they are.

    Raises:
        UsageError: for --rig without a value.
    """
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
    """Check that a path can be written, before the work whose result goes there.

    Args:
        out: path of the result.
        folder: True if a folder is wanted, False for a file.
        option: name of the option, for messages.

    Returns:
        The path; nothing is made.

    Raises:
        ValueError: for a folder where a file is wanted, a file in the way, or a place that cannot be written.
    """
    if out.exists() and out.is_dir() != folder:
        kind = "folder: name a file in it" if out.is_dir() else "file: name a folder"
        raise ValueError(f"{option}: {out} is a {kind}")
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
        raise ValueError(f"{option}: {place} cannot be written to ({error.strerror}): give another") from None


def device_of(name: str) -> str:
    """Resolve a device's name.

    Args:
        name: "cpu", "cuda", or "auto" for a GPU if there is one.

    Returns:
        "cpu" or "cuda".

    Raises:
        ValueError: for "cuda" without a GPU, and another name.
    """
    if name not in ("cpu", "cuda", "auto"):
        raise ValueError(f"device is '{name}': wanted cpu, cuda or auto")
    if name == "cpu":
        return name
    import torch

    if torch.cuda.is_available():
        return "cuda"
    if name == "cuda":
        raise ValueError("--device cuda: no CUDA device is available: leave it out, or get torch for CUDA")
    return "cpu"


def field_named(name: str) -> ReceptiveField | None:
    """Make the receptive field of that name; for MODULE:OBJECT import the module, which runs its code.

    Returns:
        The field; None for "auto".

    Raises:
        ValueError: for an unknown name, a module or object that cannot be imported, and an object that is no
            field.
    """
    from arraygeom.fields import named_field

    try:
        return None if name == "auto" else named_field(name)
    except ValueError as error:
        raise ValueError(f"--field: {error}") from None


def load_rig(path: Path, depth: tuple[float, float] | None = None, *, or_image: bool = False) -> Rig:
    """Load the rig of a file, with other depth bounds if given.

    Args:
        path: rig file.
        depth: (near, far) in place of the rig's bounds, metres; None for the rig's.
        or_image: True where an image may be given too, as the message for another file then says.

    Raises:
        FileNotFoundError: for a missing file.
        ValueError: for a file that is no rig (`RigFileError`), and invalid bounds.
    """
    refuse_missing(path, rig=True)
    from arraygeom import Rig
    from arraygeom.io.source import UnknownRigFormat

    try:
        rig = Rig.load(path)
    except UnknownRigFormat:
        if or_image:
            said = f"{NO_IMAGE}; nor is it a rig (see `pat rig convert --help`)"
            raise ValueError(f"{path}: {said}") from None
        raise
    return rig if depth is None else rig.replace(depth=depth)


NO_IMAGE = "is no image: images end in .png, .tif, .jpg and the like"


def extras_of(text: str, names: Sequence[str]) -> set[str]:
    """Parse names between commas, such as "page,points", as the value of --extras.

    Returns:
        The names, a set.

    Raises:
        UsageError: for a name that is none of `names`, as of an empty text.
    """
    given = {*text.split(",")}
    if unknown := given - {*names}:
        raise UsageError("--extras", f"some of {', '.join(names)}", min(unknown))
    return given


def is_pattern(name: str) -> bool:
    """Return True for a file's name with *, ? or [, by which files are searched for."""
    return any(c in name for c in "*?[")


def refuse_missing(path: Path, *, rig: bool) -> None:
    """Check that a rig file, or an image, folder or video, exists, before torch is imported to read it.

    Args:
        path: path, as the user gave it.
        rig: True if it is to be a rig file; otherwise a pattern with *, ? or [ passes.

    Raises:
        FileNotFoundError: if it does not.
    """
    if path.exists() or (not rig and is_pattern(path.name)):
        return
    _, _, file = str(path).partition("=")
    advice = "check the path"
    if file and Path(file).exists():
        rigless = f"give {file} alone, cameras are called as their files are"
        advice = "if it is an image, write --image before each NAME=FILE" if rig else rigless
    raise FileNotFoundError(f"{path}: no such {'rig file' if rig else 'image'}: {advice}")


def files_by_name(texts: Iterable[str], option: str = "--image") -> dict[str, Path]:
    """Parse values of a NAME=FILE option.

    Returns:
        Files by name, in order; whether they exist is not checked.

    Raises:
        ValueError: for other text, and a name given twice.
    """
    return dict(_once(option, (_named_file(option, text) for text in texts)))


def numbers_by_name(texts: Iterable[str], option: str) -> dict[str, float]:
    """Parse values of a NAME=NUMBER option.

    Returns:
        Numbers by name, in order.

    Raises:
        ValueError: for other text, a number that is not finite, and a name given twice.
    """
    return dict(_once(option, (_named_number(option, text) for text in texts)))


def read_images(rig: Rig, texts: Iterable[str], *, sized: bool = True) -> dict[str, Tensor]:
    """Read the images of `--image NAME=FILE`, developed as the rig describes them.

    Args:
        sized: False accepts images of another size than the rig's.

    Returns:
        Images (c, h, w) by camera, sRGB values (`read_view`).

    Raises:
        ValueError: for text other than NAME=FILE, a camera given twice or not of the rig, images that cannot
            be read or, if `sized`, have another size.
        FileNotFoundError: for a missing file.
    """
    from ...fusion.views import read_view

    files = {rig.require(name): path for name, path in files_by_name(texts).items()}
    return {name: read_view(rig, name, path, sized=sized) for name, path in files.items()}


def read_frames(rig: Rig, texts: Iterable[str]) -> list[dict[str, Tensor]]:
    """Read images of `--image NAME=FILE` as frames: the first of every camera, then the second ones.

    Returns:
        Images (C, H, W) by camera for each frame, sRGB values (`read_view`), of the files' own sizes.

    Raises:
        ValueError: for no images, text other than NAME=FILE, cameras that the rig lacks, cameras with unequal
            numbers of images, and files that are no images.
        FileNotFoundError: for a missing file.
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
    """Group files by frame: the first file of each camera, then the second ones.

    Returns:
        Files by camera, for each frame.

    Raises:
        ValueError: for unequal numbers.
    """
    counts = {name: len(paths) for name, paths in files.items()}
    if len(set(counts.values())) > 1:
        listed = ", ".join(f"'{name}' {count}" for name, count in counts.items())
        raise ValueError(f"every camera needs an image of every frame; there are {listed}: give each as many")
    return [dict(zip(files, paths)) for paths in zip(*files.values())]


def _named_file(option: str, text: str) -> tuple[str, Path]:
    name, _, path = text.partition("=")
    if name and path:
        return name, Path(path)
    file = path or text
    if not Path(file).suffix:
        raise ValueError(f"{option}: expected NAME=FILE, as mono=a.png, got '{text}'")
    raise ValueError(f"{option} {text}: of which camera? Give NAME=FILE, such as {Path(file).stem}={file}")


def _named_number(option: str, text: str) -> tuple[str, float]:
    name, _, number = text.partition("=")
    with suppress(ValueError):
        if name and math.isfinite(value := float(number)):
            return name, value
    example = 800 if option == "--focal" else 25
    raise ValueError(f"{option}: expected NAME=NUMBER, as mono={example}, got '{text}'")


def _once(option: str, pairs: Iterable[tuple[str, T]]) -> Iterator[tuple[str, T]]:
    given = set()
    for name, value in pairs:
        if name in given:
            raise ValueError(f"{option}: '{name}' is given twice; give it once")
        given.add(name)
        yield name, value


@cache
def console() -> Console:
    """Return the terminal on standard error, for everything but results."""
    from rich.console import Console

    return Console(stderr=True, highlight=False)


WARNED: list[Warning | str] = []
"""Warnings of the command, once each."""


def warn(message: Warning | str, *_: Any, **__: Any) -> None:
    """Print a warning as one line, without its position in the code; not again if it was printed before."""
    if str(message) not in map(str, WARNED):
        WARNED.append(message)
        say(f"pat: warning: {message}", style="yellow")


def say(text: object, style: str | None = None) -> None:
    """Print a line on standard error."""
    with suppress(OSError):  # the work goes on where nothing can be said, as on a full disk
        console().print(printable(f"{text}"), style=style, markup=False, emoji=False, soft_wrap=True)


def progress(title: str) -> Callable[[Iterable[T], int], Iterable[T]]:
    """Make a function that shows items and their number as a bar on the terminal."""
    from rich.progress import track

    return lambda items, total: track(items, title, total=total, console=console())


LINE_EVERY = 10.0
"""Least seconds between lines of progress without a terminal."""


@contextmanager
def working(title: str) -> Iterator[Callable[[str], None]]:
    """Context manager during which the terminal shows a title, the current step, and elapsed seconds.

    Without a terminal, steps are lines, at least `LINE_EVERY` seconds apart.

    Yields:
        A function of a text, which becomes the title.
    """
    import time

    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    from ...support.steps import steps_shown

    text = partial(TextColumn, markup=False)
    title = printable(title)
    columns = SpinnerColumn(), text("{task.description}"), TimeElapsedColumn(), text("{task.fields[step]}")
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
    """Context manager during which the terminal shows a title and steps (`working`), for work with a plan.

    Yields:
        A function of the plan, which prints it and adds its duration, if known, to the title.
    """
    with working(title) as retitle:

        def announce(plan: Plan) -> None:
            say(f"plan: {plan}")
            retitle(title if plan.seconds is None else f"{title}, about {plan.duration} in all")

        yield announce


@cache
def say_when_compiling() -> None:
    """Print a line on standard error once kernels are about to be compiled, which takes some seconds.

    From the call on, numba's first compilation in this process is announced, later ones are not.
    """
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
    """Print a document as JSON; numbers that are not finite become null."""
    import json

    print(json.dumps(_finite(document), indent=2))


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _finite(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
