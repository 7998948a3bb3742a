"""Commands for the development of networks: evaluate, ablate, data, render, train, settings."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from tyro.conf import Fixed, Positional, arg

from . import options
from .options import FieldName, MaybePath, Out, Weights, optional, say, writable

if TYPE_CHECKING:
    from torch import Tensor

    from arraygeom import ReceptiveField

    from ..evaluation.protocols import StereoMethod
    from ..networks.protocol import Comparing, FusionNetwork
    from ..networks.weights import Network

RenderedFolder = Annotated[Positional[Path], arg(metavar="FOLDER", help="Folder written by `pat render`.")]


@dataclass
class Evaluate:
    """Compare alpha alone, the classical baseline and the fusion on stereo pairs: PSNR, SSIM, images.

    The left image made grey is alpha, the right one, reduced, is beta, the left one in colour is the ground truth.
    Example: pat evaluate --kitti data/kitti --middlebury data/middlebury
    """

    kitti: MaybePath = None
    """Folder of KITTI pairs: image_2 / image_3, or left.png / right.png."""
    middlebury: MaybePath = None
    """Folder of Middlebury's 2001 to 2006 collections."""
    flickr1024: MaybePath = None
    """Folder of Flickr1024 pairs: 0001_L.png / 0001_R.png."""
    folder: MaybePath = None
    """Folder of other pairs, named in any of these ways."""
    rates: tuple[int, ...] = (2, 4)
    """Factors by which beta is reduced."""
    protocol: Literal["table1", "table2"] = "table1"
    """The paper's: mono + colour (table1), or mono + three bands (table2)."""
    as_authors: bool = False
    """As the paper's code tests: images of half the size (its "x2" and its "x4"), rows of 80 pixels without the pixel
    itself. Give --rates 2."""
    controls: bool = False
    """Also fuse without beta, with another scene's, and with shuffled fields: the fusion must get worse."""
    without_rig: bool = False
    """Also fuse with the rig that is found from the two images alone, as `pat fuse a.png b.png` does."""
    conditions: bool = False
    """Instead: other responses, exposures, noise, misalignment; by region, with depth. Also conditions.png."""
    only: tuple[str, ...] = ()
    """Of these conditions, by name."""
    outside: bool = False
    """Instead: fuse with disparities from elsewhere: OpenCV's SGBM, the true ones, a prior. Writes outside.md."""
    half: Literal["tune", "report", "all"] = "all"
    """The pairs on which settings may be chosen, or those that are reported."""
    out: Out = Path("out/evaluate")
    """Folder for scores.md, scores.csv and, for each data set, a strip of images a pair."""
    weights: Weights = "mono-colour"

    def run(self) -> None:
        """Write and print the scores. Raises ValueError for no images, rates below 1, and a condition that is none."""
        from arraygeom.atomic import write_text

        from ..evaluation import protocols, stereo
        from ..evaluation.tables import write_csv
        from ..networks.weights import load_weights

        folders = {name: getattr(self, name) for name in stereo.DATA_SETS if getattr(self, name) is not None}
        if not folders:
            raise ValueError(f"no images: give at least one of --{', --'.join(stereo.DATA_SETS)}")
        if self.without_rig and (self.protocol != "table1" or self.conditions or self.only):
            raise ValueError("--without-rig needs --protocol table1, and no --conditions")
        if not self.rates or min(self.rates) < 1:
            raise ValueError(f"--rates: {' '.join(map(str, self.rates))}: give whole numbers from 1 up")
        writable(self.out, folder=True)
        network, bands = load_weights(self.weights), protocols.PROTOCOLS[self.protocol]
        if self.outside:
            return self._from_outside(network, folders)
        if self.conditions or self.only:
            return self._under_conditions(network, folders)
        wrong = protocols.controls(network, bands=bands) if self.controls else {}
        field = protocols.AuthorsRows() if self.as_authors else None
        fusion = protocols.rectified_fusion(network, bands=bands, field=field)
        methods = {**protocols.BASELINES, "fusion": fusion, **wrong}
        if self.without_rig:
            methods[RIG_FOUND] = with_found_rig(network)
        change = {"change": protocols.halved} if self.as_authors else {}
        rows = stereo.evaluate_sets(folders, methods, self.rates, out=self.out, half=self.half, **change)
        every = [row for found in rows.values() for row in found]
        text = stereo.sets_markdown(rows, protocol=self.protocol)
        compared = (*wrong, *[RIG_FOUND] * self.without_rig)
        text += "\n" + stereo.falls(every, names=compared) if compared else ""
        write_text(self.out / "scores.md", text)
        write_csv(self.out / "scores.csv", stereo.StereoRow._fields, every)
        print(text, end="")
        say(f"written: {self.out / 'scores.md'}, {self.out / 'scores.csv'}, images in {self.out}")

    def _from_outside(self, network: FusionNetwork, folders: dict[str, Path]) -> None:
        from arraygeom.atomic import write_text

        from ..evaluation import stereo
        from ..evaluation.halves import of_half
        from ..evaluation.outside import evaluate_outside, outside_markdown

        sets = [stereo.DATA_SETS[name](folder) for name, folder in folders.items()]
        pairs = [pair for found in sets for pair in of_half(found, self.half) if pair.disparity is not None]
        if not pairs:
            raise ValueError(f"--half {self.half}: none of its pairs has a true disparity: give the other half")
        with options.working("evaluating") as retitle:
            rows = evaluate_outside(pairs, network, each=lambda row: retitle(f"{row.pair}: {row.source}"))
        text = outside_markdown(rows)
        write_text(self.out / "outside.md", text)
        print(text, end="")
        say(f"written: {self.out / 'outside.md'}")

    def _under_conditions(self, network: FusionNetwork, folders: dict[str, Path]) -> None:
        from arraygeom.atomic import write_text

        from ..evaluation import conditions, stereo
        from ..evaluation.halves import of_half

        names = self.only or tuple(conditions.CONDITIONS)
        unknown = [name for name in names if name not in conditions.CONDITIONS]
        if unknown:
            raise ValueError(f"--only: no condition '{unknown[0]}': there are {', '.join(conditions.CONDITIONS)}")
        sets = [stereo.DATA_SETS[name](folder) for name, folder in folders.items()]
        pairs = [pair for found in sets for pair in of_half(found, self.half)]
        if not pairs:
            raise ValueError(f"--half {self.half}: no pair belongs to that half: give more pairs, or the other half")
        rows = conditions.evaluate_conditions(pairs, network, names, progress=options.progress("evaluating"))
        text = conditions.conditions_markdown(rows)
        write_text(self.out / "conditions.md", text)
        conditions.save_condition_curves(rows, self.out / "conditions.png")
        print(text, end="")
        say(f"written: {self.out / 'conditions.md'}")


RIG_FOUND = "fusion, rig found"


def with_found_rig(network: Network) -> StereoMethod:
    """The fusion of two images with the rig found from them."""
    from ..fusion.from_images import found_rig
    from ..fusion.fuse import fuse

    def fused(alpha: Tensor, beta: Tensor, max_disparity: float) -> Tensor:
        images = {"alpha": alpha, "beta": beta}
        rig, _ = found_rig(images, "alpha", {}, network, lambda line: None)
        return fuse(network, rig, images, alpha="alpha").image

    return fused


@dataclass
class Ablate:
    """What calibration is worth: receptive fields compared by one network as the calibration or the rig changes.

    Curves of calibrated segments, images that are rectified and the result warped back, rows, a local window and all
    of beta, on layered scenes with exact positions. Example: pat ablate --sweeps rotation ahead --scenes 4
    """

    weights: Weights = "pat-supervised"
    sweeps: tuple[str, ...] = ()
    """Of rotation, "principal point", baseline, "focal ratio" and ahead; all by default."""
    without: tuple[str, ...] = ()
    """Fields to leave out, such as dense, which takes most of the time."""
    every_field: bool = False
    """Instead: a table of every field of the toolkit, with time and memory: unrectified scenes and, with --middlebury,
    rectified pairs and the same with F alone. Also peaks.png: where attention is largest, in three pictures."""
    middlebury: MaybePath = None
    """Folder of Middlebury's pairs with true disparity, for --every-field; those of the report half."""
    families: bool = False
    """Instead: a table of families of fields, on unrectified rigs with focal lengths 1 to 3 times beta's."""
    photos: tuple[Path, ...] = ()
    """Folders of photographs; those that scikit-image ships if none is given."""
    rendered: MaybePath = None
    """Folder of scenes written by `pat render`, for --families: their first camera is alpha, their second beta."""
    scenes: int = 6
    """Number of scenes, of each rig."""
    hw: Annotated[tuple[int, int] | None, optional("H W")] = None
    """Height and width of both images: 96 128, or 240 320 with --families."""
    seed: int = 0
    """Of the scenes."""
    field: FieldName = "auto"
    out: Out = Path("out/ablate")
    """Folder for ablation.md, ablation.json, ablation.svg and ablation.png; with --families ablation.csv."""

    def run(self) -> None:
        """Write and print the tables. Raises ValueError for less than one scene, and for names that there are not."""
        from ..networks.weights import load_weights

        if self.scenes < 1:
            raise ValueError(f"--scenes: {self.scenes}: give at least 1")
        writable(self.out, folder=True)
        network = load_weights(self.weights)
        if self.every_field:
            self._every_field(network)
        elif self.families or self.rendered is not None:
            self._families(network)
        else:
            self._sweeps(network)
        print((self.out / "ablation.md").read_text(encoding="utf-8"), end="")
        say(f"written: {self.out / 'ablation.md'}, and its figures and numbers beside it")

    def _every_field(self, network: Network) -> None:
        from arraygeom.atomic import write_text

        from ..data.pairs import middlebury_pairs
        from ..evaluation import field_table
        from ..evaluation.ablation import sample_photographs
        from ..evaluation.halves import of_half
        from ..evaluation.tables import write_csv
        from ..media.figures import save_panels
        from ..synthesis.photos import PhotoBank

        bank = PhotoBank.load(*self.photos) if self.photos else sample_photographs()
        cases = list(field_table.layered_cases(bank, self.scenes))
        if self.middlebury is not None:
            for linked in (True, False):
                pairs = of_half(middlebury_pairs(self.middlebury), "report")
                cases += field_table.rectified_cases(pairs, linked=linked)

        def chosen(max_displacement: float) -> dict[str, ReceptiveField]:
            every = field_table.fields_of(max_displacement)
            return {name: field for name, field in every.items() if name not in self.without}

        self._known(field_table.fields_of(1.0))
        shown = options.progress("fusing")(cases, len(cases))
        rows = field_table.evaluate_fields(self._comparing(network), shown, fields=chosen)
        looked_at = [case for case in cases if case.kind != "F alone"]
        panels = field_table.drawn_peaks(self._comparing(network), looked_at[:: -(-len(looked_at) // 3)])
        save_panels(panels, self.out / "peaks.png", columns=4)
        write_text(self.out / "ablation.md", field_table.fields_markdown(rows))
        write_csv(self.out / "ablation.csv", field_table.FieldRow._fields, rows)

    def _comparing(self, network: Network) -> Comparing:
        """The network, if its attention alone finds the points. Raises ValueError for another."""
        from ..networks.protocol import Comparing

        if not isinstance(network, Comparing):
            raise ValueError(f"--weights {self.weights} needs --families: this network matches without attention, too")
        if network.betas not in (1, 3):
            wanted = "give some for one beta in colour, or for three with a band each"
            raise ValueError(f"--weights {self.weights}: they are for {network.betas} betas: {wanted}")
        return network

    def _known(self, fields: Mapping[str, object]) -> None:
        """Raise ValueError for a field to leave out that there is not."""
        unknown = [name for name in self.without if name not in fields]
        if unknown:
            raise ValueError(f"--without: no field '{unknown[0]}': there are {', '.join(fields)}")

    def _families(self, network: Network) -> None:
        from ..evaluation.ablation import FieldFamily, ablate, families, layered_cases, rendered_cases

        if self.rendered is not None:
            cases = rendered_cases(self.rendered, seed=self.seed)
        else:
            cases = layered_cases(self.scenes, photos=self.photos, hw=self.hw or (240, 320), seed=self.seed)
        chosen, own = families(), options.field_named(self.field)
        if own is not None:
            chosen[self.field] = FieldFamily(lambda disparity: own)
        ablate(network, cases, out=self.out, chosen=chosen)

    def _sweeps(self, network: Network) -> None:
        from ..evaluation.sweep_report import write_report
        from ..evaluation.sweeps import FIELDS, SIZE, SWEEPS, ablate, points
        from ..synthesis.photos import PhotoBank

        comparing = self._comparing(network)
        self._known(FIELDS)
        fields = {name: field for name, field in FIELDS.items() if name not in self.without}
        rigs = list(points(self.sweeps or tuple(SWEEPS), hw=self.hw or SIZE))
        bank = PhotoBank.load(*self.photos) if self.photos else None
        shown = options.progress("ablating")(rigs, len(rigs))
        write_report(ablate(comparing, shown, fields, scenes=self.scenes, photos=bank, seed=self.seed), self.out)


@dataclass
class DataShow:
    """Draw samples of rendered scenes: recorded images, search segments of some pixels, ground truth and depth."""

    folder: RenderedFolder
    out: Out = Path("out/data.png")
    """Image to write."""
    samples: int = 6
    """Number of patches."""
    alpha: Annotated[str | None, optional("NAME")] = None
    """The camera at whose view is fused; by default the first."""
    sensors: MaybePath = None
    """File (YAML) with a list of steps for each camera, instead of those that follow from their responses."""
    seed: int = 0
    """Of the choice of patches, and of noise."""

    def run(self) -> None:
        """Draw patches chosen by the seed. Raises ValueError for less than one."""
        import torch

        from ..data import ScenePatches
        from ..data.show import draw_patches
        from ..media.figures import save_figure
        from ..sensors import generator_for, read_chains
        from ..support.schema import read_yaml

        if self.samples < 1:
            raise ValueError(f"--samples: {self.samples}: give a whole number from 1 up")
        chains = None if self.sensors is None else read_chains(read_yaml(self.sensors), str(self.sensors))
        data = ScenePatches(self.folder, alpha=self.alpha, chains=chains, seed=self.seed)
        chosen = torch.randperm(len(data), generator=generator_for(self.seed, "show"))[: self.samples]
        save_figure(draw_patches([data[i] for i in chosen.tolist()]), self.out)
        say(f"written: {self.out} ({len(data)} patches of {len(data.scenes)} scenes in {self.folder})")


@dataclass
class DataInfo:
    """Summarise a folder of rendered scenes: sizes, refused seeds, abandoned scenes and the reasons."""

    folder: RenderedFolder

    def run(self) -> None:
        from ..farm.summary import summarise

        print(summarise(self.folder))


class Data:
    """Inspect rendered scenes."""

    commands: ClassVar[Mapping[str, Any]] = {"show": DataShow, "info": DataInfo}


@dataclass
class Render:
    """Render many scenes of a rig for training: workers, retries, resuming, clusters.

    Example: pat render config.yaml --scenes 900 --out data/ --workers 2. The same command again renders what is
    missing. The file has at least `rig: rig.yaml`; see `pat.farm.job.RenderConfig`.
    """

    config: Annotated[Positional[Path], arg(metavar="CONFIG")]
    """What to render (YAML): rig, seed, backend and its settings."""
    scenes: int
    """Number of scenes there should be in the end."""
    out: Out
    """Folder of the scenes."""
    workers: int = 1
    """Processes on this machine; with --scheduler local, of that cluster."""
    shard: Annotated[str, arg(metavar="I/N")] = "1/1"
    """Only every N-th scene from the I-th on, for batch systems."""
    scheduler: Annotated[str | None, optional("ADDRESS")] = None
    """Address of a Dask scheduler (tcp://...), or "local"."""

    def run(self) -> None:
        """Render what is missing; exit status 1 if the job is not complete then."""
        from ..farm.folders import Shard
        from ..farm.job import RenderConfig
        from ..farm.run import render

        summary = render(
            RenderConfig.load(self.config),
            scenes=self.scenes,
            out=self.out,
            workers=self.workers,
            shard=Shard.parse(self.shard),
            scheduler=self.scheduler,
            console=options.console(),
        )
        say(f"{self.out}: {summary}")
        if not summary.complete:
            sys.exit(1)


@dataclass
class Train:
    """Train weights by a recipe, on scenes made from photographs during training.

    Example: pat train mono-colour-small --photos ~/images --out runs/mine --minutes 60
    """

    spellings: ClassVar[Mapping[str, str]] = {"-o": "--out"}

    recipe: Positional[str] = "mono-colour"
    """A recipe of the package, or a YAML file."""
    config: Fixed[Any] = None

    @classmethod
    def parse(cls, arguments: list[str]) -> Train:
        """The command from its arguments; its options are those of the recipe."""
        from ..training.config import command_line

        return cls(config=command_line(arguments))

    def run(self) -> None:
        from ..training.train import train

        say(f"written: {train(self.config)}")


@dataclass
class Settings:
    """List the numbers that matching, fusion and networks were given: value, kind, and where each is from.

    Kinds: *physics* follows from what is measured, *size* says how much is done at a time, *tuned* was chosen.
    Example: pat settings --kind tuned
    """

    kind: Literal["physics", "size", "tuned", "all"] = "all"
    """Those of one kind alone."""

    rooms: ClassVar[tuple[str, ...]] = ("pat.matching", "pat.fusion", "pat.networks")

    def run(self) -> None:
        """Print a line for each."""
        from ..support.settings import all_settings

        found = [s for s in all_settings(*self.rooms) if self.kind in ("all", s.kind)]
        for entry in found:
            print(f"{entry.kind:8}{entry.algorithm.removesuffix('Settings')}.{entry.name} = {entry.value}  {entry.why}")
        print(f"{sum(s.numbers for s in found)} numbers under {len(found)} names")
