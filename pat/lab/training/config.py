"""Training recipes: one typed dataclass, read from YAML, with overrides from the command line."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pat.app.cli.parser import Option, parse
from pat.lab.synthesis.rig_distribution import RigDistribution
from pat.networks.configs import PATConfig
from pat.support.schema import check_fields, from_document, near, parse_yaml, to_document

RECIPES = Path(__file__).parent / "recipes"
RECTIFIED = RigDistribution(mode="rectified", parallax=(6.0, 110.0))
GENERAL = RigDistribution(mode="general", parallax=(6.0, 90.0), focal_ratio=(0.8, 1.25))
UNSEEN = ("out", "device", "save", "tensorboard", "cache")
"""Entries that may differ between a run and its continuation, as samples and steps do not depend on them."""


@dataclass(frozen=True)
class RecordingConfig:
    """Degradations of each camera's images.

    Raises:
        ValueError: for probabilities outside 0 to 1, and `miscalibrated` negative or infinite.
    """

    gain: float = 0.3
    """Probability of another gain, gamma and white balance."""
    blur: float = 0.25
    """Probability of Gaussian blur."""
    noise: float = 0.6
    """Probability of shot and read noise."""
    paper: float = 0.3
    """Probability of one of the paper's four degradations on top, for one beta."""
    miscalibrated: float = 0.0
    """Error of the poses that fields are computed from: root mean square displacement of points, pixels."""
    lens: float = 0.0
    """Probability of lens distortion (|k1| up to 0.3), the image undistorted before fusion."""
    ideal: bool = False
    """The ground truth is the scene itself; else it has alpha's luminance as recorded, noise included."""

    def __post_init__(self) -> None:
        check_fields(self, "gain blur noise paper lens", 0, 1)
        if not 0 <= self.miscalibrated < math.inf:
            raise ValueError(f"miscalibrated must be 0 or more pixels, got {self.miscalibrated:g}")


@dataclass(frozen=True)
class TrainConfig:
    """A recipe. A step sees `groups` times `batch` scenes; there are `steps` steps, or what `minutes` allow.

    Raises:
        ValueError: naming the entry, for values out of range, sides of `hw` that are not multiples of 16, a
            share of rendered or measured scenes without folders or the other way round, or over 1 in all.
    """

    photos: tuple[Path, ...] = ()
    """Folders of photographs: the textures of layered scenes."""
    out: Annotated[Path, Option("PATH", short="-o")] = Path("runs/pat")
    """Folder for weights, checkpoints, figures and images."""
    start: Path | None = None
    """File of weights to start from."""
    network: PATConfig = PATConfig()
    """The network; with several betas each has a band, in order."""
    steps: int = 4000
    """Steps of the whole run."""
    minutes: float = float("inf")
    """Time limit of the whole run, minutes."""
    batch: int = 4
    """Scenes in a batch."""
    groups: int = 1
    """Batches a step, distributed over processes."""
    hw: tuple[int, int] = (96, 192)
    """Height and width of alpha in the scenes."""
    loss: Literal["psnr", "mse"] = "psnr"
    """On the image: minus the mean PSNR, or the mean squared error."""
    attention: float = 0.0
    """Weight of the cross-entropy of attention to the true position, beside the loss on the image."""
    rate: float = 8e-4
    """Learning rate of Adam."""
    momenta: tuple[float, float] = (0.9, 0.99)
    """Decay rates of Adam's two averages."""
    schedule: Literal["cosine", "halving"] = "cosine"
    """The rate falls along half a cosine, or is halved every 30/80 of the way."""
    warmup: int = 100
    """Steps of linear warm-up of the rate."""
    clip: float = 1.0
    """Norm that gradients are clipped to; inf for none."""
    reuse: float = 2.0
    """Number of times a batch of scenes is recorded on average, each time differently."""
    average: int = 300
    """Time constant, in steps, of the weight average that is validated and saved."""
    validate: int = 250
    """Steps between validations, which save the weights if they are the best so far."""
    save: int = 250
    """Steps between checkpoints."""
    rectified: float = 0.5
    """Share of the layered batches with rigs of `rectified_rigs`, the others being of `general_rigs`."""
    rectified_rigs: RigDistribution = RECTIFIED
    """Distribution of rectified rigs."""
    general_rigs: RigDistribution = GENERAL
    """Distribution of rigs in any pose."""
    rendered: float = 0.0
    """Share of the batches made of rendered scenes instead of layered ones."""
    rendered_from: tuple[Path, ...] = ()
    """Folders of rendered scenes, output of `pat lab render`."""
    measured: float = 0.0
    """Share of the batches made of stereo pairs with true disparity."""
    measured_from: tuple[Path, ...] = ()
    """Folders of Middlebury's stereo pairs, with the true disparity of both images."""
    recording: RecordingConfig = RecordingConfig()
    """Recording of the scenes by the cameras."""
    field: str = "epipolar"
    """The receptive field, by name, or MODULE:OBJECT for your own."""
    held_out: int = 12
    """One photograph in so many is for validation only."""
    seed: int = 0
    """Random seed."""
    cache: Path | None = None
    """File (.npz) that caches the photographs."""
    device: str = "auto"
    """Torch device, such as cuda or cpu; auto takes a GPU if there is one."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Precision of convolutions; attention and geometry are in float32."""
    compile: bool = False
    """Compile convolutions by torch.compile."""
    tensorboard: bool = False
    """Log figures and images for TensorBoard too."""

    def __post_init__(self) -> None:
        check_fields(self, "steps batch groups average validate save held_out", 1)
        check_fields(self, "attention warmup seed", 0)
        check_fields(self, "minutes rate reuse clip", 0, above=True)
        check_fields(self, "rectified rendered measured", 0, 1)
        if not all(0 <= momentum < 1 for momentum in self.momenta):
            raise ValueError(f"momenta must be from 0 to below 1, got {self.momenta}")
        if not 1 <= self.network.betas <= 3:
            raise ValueError(f"network.betas must be from 1 to 3, a band each, got {self.network.betas}")

        if min(self.hw) < 16 or any(side % 16 for side in self.hw):
            raise ValueError(f"hw must be multiples of 16, got {self.hw[0]} x {self.hw[1]}")

        for name in ("rendered", "measured"):
            share, folders = getattr(self, name), getattr(self, f"{name}_from")
            if bool(share) != bool(folders):
                given = "there is no folder" if share else f"{folders[0]} is given"
                raise ValueError(f"{name} is {share:g} and {given}: give `{name}` and `{name}_from`")
        total = self.rendered + self.measured
        if total > 1:
            raise ValueError(f"rendered and measured are shares of the batches, {total:g} in all")


def recipes() -> tuple[str, ...]:
    """Return the names of the recipes in the package, sorted."""
    return tuple(sorted(p.stem for p in RECIPES.glob("*.yaml")))


def load_config(name: str | Path) -> TrainConfig:
    """Load a recipe of the package by name, or else a YAML file; paths in it are not resolved by its folder.

    Raises:
        FileNotFoundError: if it is neither.
        ValueError: naming the file and the entry, as `parse_config`.
    """
    path = RECIPES / f"{name}.yaml" if str(name) in recipes() else Path(name)
    if not path.is_file():
        raise FileNotFoundError(f"no recipe '{name}' (a file, or a shipped name){near(name, recipes())}")
    return parse_config(path.read_bytes(), str(path))


def parse_config(text: str | bytes, name: str = "config") -> TrainConfig:
    """Parse a recipe from YAML text (UTF-8 if bytes); `name` begins messages.

    Returns:
        The recipe, with defaults for entries that the text leaves out.

    Raises:
        ValueError: naming the entry, for an invalid or empty recipe, and text that is not YAML.
    """
    values = parse_yaml(text, name)
    try:
        if not values:
            raise ValueError(f"the recipe is empty: write entries, or take {', '.join(recipes())}")
        if not isinstance(values, Mapping):
            raise ValueError(f"wanted entries (name: value), got {values!r}")
        return from_document(TrainConfig, values)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


def config_text(config: TrainConfig) -> str:
    """Format a recipe as YAML with every value written out; `parse_config` reads it back."""
    from arraygeom.runtime.safe_yaml import dump_yaml

    return dump_yaml(to_document(config, defaults=True), default_flow_style=None, width=118)


def save_config(config: TrainConfig, path: Path) -> None:
    """Write a recipe to a YAML file, atomically."""
    from arraygeom.runtime.atomic import write_text

    write_text(path, config_text(config))


def command_line(arguments: list[str], prog: str = "pat lab train") -> TrainConfig:
    """Parse `[RECIPE] [--name value ...]`: a recipe by name or file, and overrides of its values.

    Args:
        arguments: arguments behind the command's name.
        prog: name of the command, for messages.

    Returns:
        The recipe.

    Raises:
        ValueError: for an invalid recipe, also after the overrides, and for one that names code as its field
            where the arguments do not.
        FileNotFoundError: for a missing recipe.
        UsageError: for unknown options and values that cannot be read.
        SystemExit: after `--help`, which prints.
    """
    base = TrainConfig()
    if arguments and not arguments[0].startswith("-"):
        base, arguments = load_config(arguments[0]), arguments[1:]
        if ":" in base.field and not any(base.field in a.split("=") for a in arguments):
            raise ValueError(
                f"field: {base.field} is code, which a recipe alone does not run: if you trust it, "
                f"add --field {base.field}"
            )
    description = (
        "Train weights on scenes made from photographs while training. RECIPE is a YAML file or one of\n"
        f"{', '.join(recipes())}; the options below change it.\n\n"
        "The same command again continues a run that stopped. On N processors:\n"
        "torchrun --nproc_per_node N -m pat lab train RECIPE --groups N"
    )
    return parse(TrainConfig, arguments, prog=f"{prog} [RECIPE]", base=base, description=description)


def difference(config: TrainConfig, other: TrainConfig) -> str | None:
    """Compare two recipes, except for the entries in `UNSEEN`.

    Returns:
        The first difference, as "name: value of config, value of other"; None if there is none.
    """
    for entry in dataclasses.fields(TrainConfig):
        ours, theirs = getattr(config, entry.name), getattr(other, entry.name)
        if entry.name not in UNSEEN and ours != theirs:
            return f"{entry.name}: {ours}, {theirs}"
    return None
