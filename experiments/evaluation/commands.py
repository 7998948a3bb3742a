"""The commands of this room: `python -m experiments evaluate`, `conditions`, `outside`, `certainty`, ..."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal, TypeVar

from arraygeom.runtime.atomic import write_text
from experiments.names import refuse_unknown
from pat.app.cli.options import NetworkName, Out, progress, say, writable
from pat.app.cli.parser import Option
from pat.app.sample_array import load_sample
from pat.fusion.fuse import FuseSettings
from pat.lab import commands as research
from pat.lab.data.pairs import StereoPair, middlebury_pairs
from pat.lab.evaluation import protocols, stereo
from pat.lab.evaluation.ablation import sample_photographs
from pat.lab.evaluation.tables import write_csv
from pat.matching.choice import fitted_certainty
from pat.media.figures import save_panels
from pat.networks.paper import PAT
from pat.networks.protocol import Comparing, FusionNetwork
from pat.networks.weights import Network, load_weights
from pat.support.tensor_files import write_tensors

from . import certainty, conditions, fields, gradients, paper, sensitivity, stages, sweeps, trained_fields
from .halves import of_half
from .outside import evaluate_outside, outside_markdown
from .sweep_report import write_report

Half = Literal["tune", "report", "all"]
T = TypeVar("T")


def finished(path: Path, text: str, more: str = "") -> None:
    """Write and print a text, and say where it is."""
    write_text(path, text)
    print(text, end="")
    say(f"written: {path}{more}")


def with_truth(items: Sequence[T], half: str) -> Sequence[T]:
    """Raises ValueError where no pair of a half has a true disparity."""
    if not items:
        raise ValueError(f"--half {half}: none of its pairs has a true disparity: give the other half")
    return items


@dataclass
class Pairs(research.StereoSets):
    """Pairs of one half."""

    half: Half = "all"
    """The pairs on which settings may be chosen, or those that are reported."""

    def sets(self) -> dict[str, Iterable[StereoPair]]:
        """The pairs of the half by data set."""
        return {name: of_half(pairs, self.half) for name, pairs in super().sets().items()}

    def pairs(self) -> list[StereoPair]:
        """All of them. Raises ValueError if there is none."""
        every = [pair for pairs in self.sets().values() for pair in pairs]
        if not every:
            raise ValueError(f"--half {self.half}: no pair belongs to it: give more, or the other half")
        return every


@dataclass
class Evaluate(Pairs, research.Evaluate):
    """As `pat lab evaluate`, by the paper's protocols, of one half of the pairs, with controls, rigless.

    Example: python -m experiments evaluate --middlebury data/middlebury --half report --controls
    """

    protocol: Literal["table1", "table2"] = "table1"
    """The paper's: mono + colour (table1), or mono + three bands (table2)."""
    as_authors: bool = False
    """As the paper's code tests: images of half the size (its "x2" and its "x4"), rows of 80 pixels without
    the pixel itself. Give --rates 2."""
    controls: bool = False
    """Also fuse without beta, with another scene's, and with shuffled fields: the fusion must get worse."""
    without_rig: bool = False
    """Also fuse with the rig that is found from the two images alone, as `pat fuse a.png b.png` does."""

    def run(self) -> None:
        """Write and print the scores. Raises ValueError for no images, and for rates below 1."""
        if self.without_rig and self.protocol != "table1":
            raise ValueError("--without-rig needs --protocol table1")
        sets, network, bands = self.sets(), load_weights(self.network), self.protocol == "table2"
        compared = paper.controls(network, bands=bands) if self.controls else {}
        if self.without_rig:
            compared["fusion, rig found"] = paper.with_found_rig(network)
        field = paper.AuthorsRows() if self.as_authors else None
        if self.as_authors:
            sets = {name: map(paper.halved, pairs) for name, pairs in sets.items()}
        fusion = protocols.rectified_fusion(network, bands=bands, settings=FuseSettings(field=field))
        methods = {**protocols.BASELINES, "fusion": fusion, **compared}
        rows = stereo.evaluate_sets(sets, methods, self.rates, out=self.out)
        text = stereo.sets_markdown(rows, printed=paper.PRINTED[self.protocol])
        if compared:
            text += "\n" + paper.falls([row for of_pair in rows.values() for row in of_pair], names=compared)
        self.write(rows, text)


@dataclass
class Conditions(Pairs):
    """Fuse stereo pairs under other responses, exposures, noise, misalignment; by region, with depth.

    Example: python -m experiments conditions --middlebury data/middlebury --only ideal "50 electrons"
    """

    only: tuple[str, ...] = ()
    """Some conditions, by name."""
    out: Out = Path("out/conditions")
    """Folder for conditions.md and conditions.png."""

    def run(self) -> None:
        """Write and print the tables. Raises ValueError for no images, and a condition that is none."""
        names = self.only or tuple(conditions.CONDITIONS)
        refuse_unknown("--only: no condition", names, conditions.CONDITIONS)
        pairs, network = self.pairs(), load_weights(self.network)
        rows = conditions.evaluate_conditions(pairs, network, names, progress=progress("evaluating"))
        conditions.save_condition_curves(rows, self.out / "conditions.png")
        finished(self.out / "conditions.md", conditions.conditions_markdown(rows))


@dataclass
class Stages(Pairs):
    """Fuse stereo pairs with each stage left out in turn: PSNR, depth and core seconds as they change.

    Example: python -m experiments stages --middlebury data/middlebury --half tune --only x2 "200 electrons"
    """

    half: Half = "tune"
    """Pairs on which a stage may be judged."""
    only: tuple[str, ...] = tuple(stages.STAGE_CONDITIONS)
    """Conditions to measure, by name."""
    out: Out = Path("out/stages")
    """Folder for stages.md."""

    def run(self) -> None:
        """Write and print the table. Raises ValueError for no images, and for an unknown condition."""
        refuse_unknown("--only: no condition", self.only, stages.STAGE_CONDITIONS)
        scores = stages.score_stages(self.pairs(), self.only)
        finished(self.out / "stages.md", stages.stages_markdown(scores))


@dataclass
class Sensitivity:
    """Fuse stereo pairs of the tune half with each tuned number halved and doubled; half an hour.

    Example: python -m experiments sensitivity --middlebury data/middlebury
    """

    middlebury: Path
    """Folder of Middlebury's pairs."""
    out: Out = Path("out/sensitivity")
    """Folder for sensitivity.md."""

    def run(self) -> None:
        """Write and print the table. Raises RuntimeError for a fusion that fails."""
        entries = sensitivity.tuned_entries()
        rows = progress("changing")(sensitivity.measured(self.middlebury, entries), len(entries))
        finished(self.out / "sensitivity.md", sensitivity.sensitivity_markdown(rows))


@dataclass
class Outside(Pairs):
    """Fuse stereo pairs with disparities from elsewhere: OpenCV's SGBM, the true ones, a prior."""

    out: Out = Path("out/outside")
    """Folder for outside.md."""

    def run(self) -> None:
        """Write and print the table. Raises ValueError for no images, and for none with a true disparity."""
        pairs = with_truth([pair for pair in self.pairs() if pair.disparity is not None], self.half)
        rows = evaluate_outside(progress("evaluating")(pairs, len(pairs)), load_weights(self.network))
        finished(self.out / "outside.md", outside_markdown(rows))


@dataclass
class Certainty(Pairs):
    """How well stated certainty holds, on pairs of true disparity under many conditions; and its fit."""

    half: Half = "report"
    """Pairs that take part: it is fitted to tune."""
    conditions: tuple[str, ...] = ()
    """Of the conditions, by name; those on which it was fitted if none is given."""
    fit: Path | None = None
    """Fit to these pairs, and write that here."""
    choices: tuple[Path, ...] = ()
    """Files of choices trained without some pairs: a pair is judged by one that has not seen it."""
    out: Out = Path("out/certainty")
    """Folder for certainty.md, the tables, and reliability.png."""

    def run(self) -> None:
        """Write and print the tables. Raises ValueError for a condition that is none."""
        names = self.conditions or certainty.FITTED_ON
        refuse_unknown("--conditions: no condition", names, conditions.CONDITIONS)
        writable(self.out, folder=True)
        pairs = self.pairs()
        shown = progress("fusing")(pairs, len(pairs))
        judged = with_truth(
            list(certainty.judged(load_weights(self.network), shown, names, self.choices)), self.half
        )
        if self.fit:
            write_tensors(self.fit, certainty.widened(judged).state_dict())
            held = certainty.held(judged, certainty.by_thirds(judged))
        else:
            held = certainty.held(judged, lambda one: certainty.Stated.by(fitted_certainty(), one.numbers))
        certainty.save_reliability(held, self.out / "reliability.png")
        finished(self.out / "certainty.md", certainty.held_markdown(held), ", and reliability.png beside it")


@dataclass
class OnScenes:
    """Options that ablations on layered scenes share."""

    network: NetworkName = "pat-supervised"
    without: tuple[str, ...] = ()
    """Fields to leave out, such as dense, which takes most of the time."""
    scenes: int = 6
    """Number of scenes, of each rig."""
    out: Out = Path("out/ablate")
    """Folder for ablation.md, its figures and its numbers."""

    def comparing(self, fields: Iterable[str]) -> Comparing:
        """The network, once its attention alone is known to find the points and such fields to exist."""
        if self.scenes < 1:
            raise ValueError(f"--scenes: {self.scenes}: give at least 1")
        refuse_unknown("--without: no field", self.without, fields)
        writable(self.out, folder=True)
        network: Network = load_weights(self.network)
        if not isinstance(network, Comparing):
            raise ValueError(f"--network {self.network}: it matches without attention: `pat lab ablate`")
        if network.betas not in (1, 3):
            wanted = "give some for one beta in colour, or for three with a band each"
            raise ValueError(f"--network {self.network}: they are for {network.betas} betas: {wanted}")
        return network

    def chosen(self, fields: Mapping[str, T]) -> dict[str, T]:
        """The fields that are not left out."""
        return {name: field for name, field in fields.items() if name not in self.without}

    def say_written(self) -> None:
        """Print the table."""
        print((self.out / "ablation.md").read_text(encoding="utf-8"), end="")
        say(f"written: {self.out / 'ablation.md'}, and its figures and numbers beside it")


@dataclass
class Gradients:
    """Measure which gradients of a fused image by a rig's numbers are true, and what a rig is recovered to.

    On the sample array; against differences, by network, parameter and region.
    """

    networks: tuple[str, ...] = ("pat-supervised", "mono-colour", "classical")
    """Networks to compare, by name."""
    out: Out = Path("out/gradients")
    """Folder for gradients.md."""

    def run(self) -> None:
        """Write and print the tables. Raises FileNotFoundError for unknown weights."""
        writable(self.out, folder=True)
        chosen: dict[str, FusionNetwork] = {}
        for name in self.networks:
            network = load_weights(name)
            if isinstance(network, PAT):
                chosen[f"{name}, border {gradients.BORDER:g}"] = network.with_border(gradients.BORDER)
            chosen[name] = network
        sample, paper = load_sample(), load_weights("pat-supervised")
        assert isinstance(paper, PAT)
        rows = gradients.gradient_rows(chosen, gradients.cropped(sample), tuple(gradients.UNITS))
        found = gradients.recovered_markdown(paper, sample)
        finished(self.out / "gradients.md", f"{gradients.gradients_markdown(rows)}\n{found}")


@dataclass
class Sweeps(OnScenes):
    """What calibration is worth as it gets wrong or the rig changes: one network, each field, same scenes.

    Curves of calibrated segments, images that are rectified and the result warped back, rows, a local window
    and all of beta, on layered scenes with exact positions. Example: python -m experiments sweeps --sweeps
    rotation ahead
    """

    sweeps: tuple[str, ...] = ()
    """Of rotation, "principal point", baseline, "focal ratio" and ahead; all by default."""
    hw: Annotated[tuple[int, int], Option("H W")] = (96, 128)
    """Height and width of both images."""

    def run(self) -> None:
        """Write ablation.md, .json, .svg, .png; print the table. Raises ValueError for an unknown sweep."""
        network = self.comparing(sweeps.FIELDS)
        chosen = self.chosen(sweeps.FIELDS)
        rigs = list(sweeps.points(self.sweeps or tuple(sweeps.SWEEPS), hw=self.hw))
        shown = progress("ablating")(rigs, len(rigs))
        write_report(sweeps.ablate(network, shown, chosen, scenes=self.scenes), self.out)
        self.say_written()


@dataclass
class Fields(OnScenes):
    """Every field of the toolkit, with time and memory: unrectified, rectified, the same with F alone."""

    middlebury: Path | None = None
    """Folder of Middlebury's pairs with true disparity; those of the report half."""

    def run(self) -> None:
        """Write ablation.md and .csv; print the table."""
        network = self.comparing(fields.fields_of(1.0))
        cases = list(fields.layered_cases(sample_photographs(), self.scenes))
        if self.middlebury is not None:
            for linked in (True, False):
                pairs = of_half(middlebury_pairs(self.middlebury), "report")
                cases += fields.rectified_cases(pairs, linked=linked)
        shown = progress("fusing")(cases, len(cases))
        rows = fields.evaluate_fields(network, shown, fields=lambda most: self.chosen(fields.fields_of(most)))
        write_text(self.out / "ablation.md", fields.fields_markdown(rows))
        write_csv(self.out / "ablation.csv", fields.FieldRow._fields, rows)
        self.say_written()


@dataclass
class TrainedFields:
    """Train the paper's network, narrow, anew with each field, and compare them on unseen scenes.

    Segments, rows, windows, the true position and segments elsewhere; a run that stopped is continued.
    Example: python -m experiments trained-fields --photos photos --seeds 0 1
    """

    photos: tuple[Path, ...]
    """Folders of photographs: the textures of layered scenes."""
    seeds: tuple[int, ...] = (0, 1)
    """Seeds of weights, scenes and noise."""
    steps: int = 500
    """Steps of each training."""
    batches: int = 32
    """Batches of unseen scenes that each is scored on."""
    hw: Annotated[tuple[int, int], Option("H W")] = trained_fields.RECIPE.hw
    """Height and width of the images."""
    out: Out = Path("out/trained-fields")
    """Folder for the runs, trained.md and errors.png."""

    def run(self) -> None:
        """Write and print the table. Raises ValueError for no photographs, and runs of another recipe."""
        writable(self.out, folder=True)
        recipe = replace(
            trained_fields.RECIPE,
            photos=self.photos,
            cache=self.out / "photographs.npz",
            steps=self.steps,
            validate=self.steps,
            save=max(self.steps // 4, 1),
            hw=self.hw,
            out=self.out,
            device="cpu",
        )
        rows, panels = trained_fields.compare_trained(recipe, self.seeds, batches=self.batches, each=say)
        save_panels(panels, self.out / "errors.png", columns=3)
        finished(self.out / "trained.md", trained_fields.trained_markdown(rows), ", and errors.png beside it")
