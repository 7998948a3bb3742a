"""Rigs: named cameras of different kinds, and the depth range of the scene."""

from __future__ import annotations

import difflib
import fnmatch
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float
from torch import Tensor

from .batching import Batched, tensors_of
from .camera import Camera, LensView, View, view_facts
from .checks import check_above, check_batches, check_tensors, checking, derived
from .kornia_models import pinholes_by_name
from .pair import Link, Pair, depth_range
from .pixels import HW, resize_matrix, rot90_matrix, shift_matrix
from .runtime.text import baseline_text, depth_text, length_unit

if TYPE_CHECKING:
    from kornia.geometry.camera import PinholeCamera, StereoCamera

SERVICES: dict[str, Callable[..., Any]] = {}
"""Functions of higher modules that `Rig` offers as methods, by name: the package registers them."""


@dataclass(frozen=True, eq=False, repr=False)
class Rig(Batched):
    """Ordered, named cameras of different sizes, lenses and spectral responses.

    Every number may have leading batch axes, the same for all that have any: a batch of rigs. A rig never
    changes, except by `requires_grad_`: methods return new ones.

    Attributes:
        cameras: views by name; kornia's pinholes are converted, batches of one to single cameras.
        depth: (near, far) in metres along the optical axis of whichever camera is alpha (of one that sees 90
            degrees off it, along its rays), far may be infinite, of each rig or all; None if unknown.
        links: relations of cameras, measured between their images, by (alpha, beta).
        name: name of the rig; `runtime.text.UNSCALED` and `ASSUMED` say that lengths are not in metres.

    Raises:
        ValueError: for invalid depth bounds, names that cannot be printed, links to unknown cameras or from a
            camera to itself, and batch axes that do not broadcast.
        TypeError: for cameras, links or a depth of other types, or bounds that are not two.
    """

    cameras: Mapping[str, Any]  # View once made; kornia pinholes serve as well
    depth: Any = None  # Depths | None once made; numbers serve as well
    links: Mapping[tuple[str, str], Link] = field(default_factory=dict)
    name: str = ""

    def __post_init__(self) -> None:
        if not isinstance(self.cameras, Mapping):
            raise TypeError(
                f"the cameras are a {type(self.cameras).__name__}: give a mapping of names to cameras"
            )
        object.__setattr__(
            self, "cameras", {name: _view(name, camera) for name, camera in self.cameras.items()}
        )
        if odd := [name for name in self.cameras if not (isinstance(name, str) and name.isprintable())]:
            raise ValueError(f"the camera {odd[0]!a} has a name that cannot be printed: rename it")
        if self.depth is not None:
            if not isinstance(self.depth, Sequence | Tensor) or len(self.depth) != 2:
                raise TypeError(f"depth is {self.depth!r}: wanted (near, far), in metres")
            object.__setattr__(self, "depth", depth_range(*self.depth))
        if checking():
            check_batches("the rig's numbers", *sorted({t.shape[: t.ndim - n] for t, n in tensors_of(self)}))
        if self.depth is not None:
            shape = self.batch_shape
            object.__setattr__(self, "depth", tuple(bound.expand(shape) for bound in self.depth))
        if checking():
            self._check_links()

    def _check_links(self) -> None:
        if not isinstance(self.links, Mapping):
            raise TypeError(f"the links are a {type(self.links).__name__}: give a mapping of names to links")
        for names, link in self.links.items():
            if not (isinstance(link, Link) and isinstance(names, tuple) and len(names) == 2):
                kind = type(link).__name__
                raise TypeError(f"the link {names!r:.80} is a {kind}: wanted {{(ALPHA, BETA): Link(F)}}")
            alpha, beta = names
            if self.require(alpha) == self.require(beta):
                raise ValueError(f"a link relates two cameras; this one is from '{alpha}' to itself")

    @classmethod
    def from_kornia(
        cls,
        cameras: Mapping[str, PinholeCamera] | PinholeCamera | StereoCamera,
        *,
        hw: HW | None = None,
        batched: bool = False,
        **fields: Any,
    ) -> Rig:
        """Make a rig of kornia's cameras, which are always batched.

        Args:
            cameras: pinholes by name; a batch of pinholes, then named "camera0", "camera1" and so on; or a
                `StereoCamera`, whose cameras are "left" and "right".
            hw: height and width of a `StereoCamera`'s images; else unused.
            batched: True keeps batches of one as batches.
            fields: further fields of the rig, such as `depth`.

        Raises:
            ValueError: for batches of unequal length, a `StereoCamera` without `hw`, and as
                `Camera.from_kornia` and `Rig`.
            TypeError: for other cameras, or a field that `Rig` has not.
        """
        named = pinholes_by_name(cameras, hw)
        made = {name: Camera.from_kornia(camera, batched=True) for name, camera in named.items()}
        lengths = {name: camera.batch_shape[0] for name, camera in made.items()}
        if len(set(lengths.values())) > 1:
            raise ValueError(
                f"a rig's cameras are batches of one length, got {lengths}: "
                "expand those that are the same in all"
            )
        if not batched and set(lengths.values()) == {1}:
            made = {name: camera[0] for name, camera in made.items()}
        return cls(made, **fields)

    def to_kornia(self) -> dict[str, PinholeCamera]:
        """Convert to kornia's pinholes.

        Returns:
            Cameras by name, each a batch as long as the rig's (of one for a single rig); several batch axes
            become one.

        Raises:
            ValueError: for cameras with lenses of effect or gradient, and cameras that are not calibrated.
        """
        views = [name for name, view in self.cameras.items() if not isinstance(view, Camera)]
        if views:
            raise ValueError(
                f"kornia has no camera without a calibration: {', '.join(views)} of this rig are such"
            )
        lenses = [(name, camera.distortion) for name, camera in self.cameras.items()]
        if bent := [name for name, lens in lenses if lens is not None and not lens.harmless]:
            raise ValueError(
                f"kornia's cameras with a lens have no pose ({', '.join(bent)}): "
                "give each as camera.to_kornia() and keep its cam_from_world"
            )
        return {name: camera.to_kornia() for name, camera in self._whole().cameras.items()}

    def __getitem__(self, name: Any) -> Any:
        """Return the camera of a name; or for an index into a batch, the rigs there.

        Raises:
            ValueError: for an unknown name.
            TypeError: for an index into a single rig.
        """
        return self.cameras[self.require(name)] if isinstance(name, str) else super().__getitem__(name)

    def __contains__(self, name: object) -> bool:
        return name in self.cameras

    def __len__(self) -> int:
        """Return the number of cameras; for a batch of rigs, the number of rigs."""
        return super().__len__() if self.batch_shape else len(self.cameras)

    def __iter__(self) -> Iterator[Any]:
        """Iterate over the cameras' names; for a batch, over the rigs."""
        return (self[i] for i in range(len(self))) if self.batch_shape else iter(self.names)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the cameras, in order."""
        return tuple(self.cameras)

    def require(self, name: str) -> str:
        """Return the name itself if the rig has such a camera.

        Raises:
            ValueError: if it has not.
        """
        if name not in self.cameras:
            near = difflib.get_close_matches(str(name), self.names, 1)
            hint = f"; did you mean '{near[0]}'?" if near else ""
            raise ValueError(f"the rig has no camera '{name}'{hint} (it has: {', '.join(self.names)})")
        return name

    def betas(self, alpha: str) -> tuple[str, ...]:
        """Return all names but alpha's.

        Raises:
            ValueError: if the rig has no camera `alpha`.
        """
        return tuple(n for n in self.names if n != self.require(alpha))

    def pair(self, alpha: str, beta: str) -> Pair:
        """Return the pair of two cameras.

        Returns:
            The pair, with the rig's depth range and unit, and the cameras' link (reversed if stated the other
            way round) if there is one.

        Raises:
            ValueError: for an unknown name, and one camera given twice.
            RuntimeError: for a singular H to be reversed.
        """
        if self.require(alpha) == self.require(beta):
            raise ValueError(f"a pair is of two cameras, and both are '{alpha}': name another beta")
        link = self.links.get((alpha, beta))
        if link is None and (beta, alpha) in self.links:
            link = self.links[beta, alpha].reversed()
        return Pair(self[alpha], self[beta], self.depth, link, length_unit(self))

    def with_camera(self, name: str, camera: View) -> Rig:
        """Return a copy with one camera set, replacing that of the same name if there is one."""
        return self.replace(cameras={**self.cameras, name: camera})

    def resize(self, name: str, hw: HW) -> Rig:
        """Return the rig whose camera `name` records images of another size; its links follow."""
        return self.transformed(name, resize_matrix(self[name].hw, hw), hw)

    def crop(self, name: str, top: int, left: int, hw: HW) -> Rig:
        """Return the rig whose camera `name` keeps a window of its image (`Camera.crop`); links follow."""
        return self.transformed(name, shift_matrix(left, top), hw)

    def rot90(self, name: str, quarter_turns: int) -> Rig:
        """Return the rig whose camera `name` has its image rotated; see `Camera.rot90`. Its links follow."""
        A = rot90_matrix(self[name].hw, quarter_turns)
        return self.transformed(name, A, self[name].rot90(quarter_turns).hw)

    def transformed(self, name: str, A: Float[Tensor, "*b 3 3"], hw: HW) -> Rig:
        """Return the rig after a change of one camera's pixels: a crop, resize, rotation, mirror or shear.

        Args:
            name: name of the camera.
            A: affine matrix from pixels before to pixels after, or one for each rig of a batch.
            hw: height and width after.

        Returns:
            The rig with the camera's new size, K (if it has one) and links.

        Raises:
            ValueError: for an unknown name, and as `LensView.transformed`.
            RuntimeError: for a singular A where the camera has links.
        """
        eye = torch.eye(3, dtype=torch.float64)
        links = {
            (a, b): link.transformed(A if a == name else eye, A if b == name else eye)
            if name in (a, b)
            else link
            for (a, b), link in self.links.items()
        }
        return self.with_camera(name, self[name].transformed(A, hw)).replace(links=links)

    def scaled(self, factor: float) -> Rig:
        """Return the rig with all lengths (cameras', depth range) times a factor, as for another unit.

        Raises:
            ValueError: for a factor that is not positive and finite, and a camera model that is not central
                and does not say which of its numbers are lengths.
        """
        check_above(0, itself=False, factor=factor)
        cameras = {
            name: view.scaled(factor) if isinstance(view, LensView) else view
            for name, view in self.cameras.items()
        }
        depth = None if self.depth is None else (self.depth[0] * factor, self.depth[1] * factor)
        return self.replace(cameras=cameras, depth=depth)

    def parameters(self, *, free: Iterable[str]) -> dict[str, Tensor]:
        """Return the parameters that an optimiser may change, as zeros that require grad; `perturbed` applies
        them.

        Args:
            free: patterns over NAME.rotation (rotation vector, radians), NAME.translation (metres),
                NAME.focal (fx, fy in pixels), NAME.centre (cx, cy in pixels), NAME.distortion, for each
                camera's name, and depth.near and depth.far (metres), as ["colour.*", "depth.near"]. An
                uncalibrated view has only its lens's, a rig without a depth range no bounds.

        Returns:
            Tensors by name, (*b, n) each, (*b) for bounds, *b as the number itself has; none for no patterns.

        Raises:
            ValueError: for a pattern that matches nothing, such as each letter of a text given for a list.
        """
        shapes = self._parameter_shapes()
        chosen: dict[str, Tensor] = {}
        for pattern in free:
            names = fnmatch.filter(shapes, pattern)
            if not names:
                raise ValueError(f"no rig parameter matches '{pattern}' (there are: {', '.join(shapes)})")
            chosen |= {n: torch.zeros_like(shapes[n]).requires_grad_() for n in names}
        return chosen

    def perturbed(self, changes: Mapping[str, Tensor]) -> Rig:
        """Apply changes of parameters, named and in the units as in `parameters`.

        Rotations step on the manifold, to exp(change) R. Other changes are added.

        Returns:
            The rig; everything without a change is bit-identical. Cameras are not checked: NaN passes.

        Raises:
            ValueError: for an unknown name, a change of another size, and bounds that `Rig` refuses.
            TypeError: for a change that is no tensor.
            RuntimeError: for batch axes that do not broadcast.
        """
        shapes = self._parameter_shapes()
        unknown = set(changes) - set(shapes)
        if unknown:
            raise ValueError(f"no such rig parameter: {', '.join(sorted(unknown))}")
        for name, change in changes.items():
            last = () if name in ("depth.near", "depth.far") else tuple(shapes[name].shape[-1:])
            check_tensors(last, **{name: change})
        cameras = {
            name: derived(_perturbed_camera, name, camera, changes) for name, camera in self.cameras.items()
        }
        depth = self.depth
        if depth is not None:
            near, far = depth
            depth = near + changes.get("depth.near", 0), far + changes.get("depth.far", 0)
        return self.replace(cameras=cameras, depth=depth)

    def check(self) -> tuple[str, ...]:
        """List what is odd about the rig, a sentence each; empty if nothing is.

        Constructors refuse impossible numbers; these are possible, and mistakes more often than not: another
        unit, poses of another convention, exchanged axes, views that do not overlap.
        """
        return SERVICES["check"](self)

    @classmethod
    def load(cls, path: str | Path) -> Rig:
        """Read a rig file of any format that `arraygeom.io` knows.

        Raises:
            arraygeom.io.RigFileError: for a file that cannot be used.
            FileNotFoundError: for a missing file.
        """
        return SERVICES["load"](path)

    def save(self, path: str | Path) -> None:
        """Write the native rig file, atomically."""
        SERVICES["save"](self, path)

    def _text(self) -> str:
        named = ", ".join(f"{name} {view._text()}" for name, view in self.cameras.items())
        return "; ".join(filter(None, (named, *self._lengths())))

    def _lengths(self) -> tuple[str, str]:
        unit = length_unit(self)
        return baseline_text(self.cameras, unit), depth_text(self.depth, unit)

    def _repr_html_(self) -> str:
        head = ("camera", "size", "focal length", "lens", "response")
        rows = [head, *((name, *view_facts(view)) for name, view in self.cameras.items())]
        cells = ["".join(f"<td>{escape(cell)}</td>" for cell in row) for row in rows]
        facts = (self.name, self._batch_text(), *self._lengths())
        caption = escape("; ".join(filter(None, facts)))
        return f"<table><caption>{caption}</caption>{''.join(f'<tr>{row}</tr>' for row in cells)}</table>"

    def _parameter_shapes(self) -> dict[str, Tensor]:
        """Tensor of the right shape, type and device for each parameter."""
        shapes: dict[str, Tensor] = {}
        for name, camera in self.cameras.items():
            if isinstance(camera, Camera):
                shapes |= {f"{name}.rotation": camera.t, f"{name}.translation": camera.t}
                shapes |= {f"{name}.focal": camera.K[..., 0, :2], f"{name}.centre": camera.K[..., :2, 2]}
            lens = camera.distortion if isinstance(camera, LensView) else None
            if lens is not None and lens.coefficients.numel():
                shapes[f"{name}.distortion"] = lens.coefficients
        if self.depth is not None:
            shapes |= {"depth.near": self.depth[0], "depth.far": self.depth[1]}
        return shapes


def _view(name: str, camera: Any) -> View:
    """Camera as given, converted if it is kornia's."""
    if isinstance(camera, View):
        return camera
    from kornia.geometry.camera import PinholeCamera

    if isinstance(camera, PinholeCamera):
        return Camera.from_kornia(camera)
    kind = type(camera).__name__
    raise TypeError(
        f"camera '{name}' is a {kind}: give a Camera, a LensView, a View or a kornia PinholeCamera"
    )


def with_pixels(rig: Rig) -> Rig:
    """Return the rig whose views all have a K to follow changes of pixels, the identity if not known."""
    for name, view in rig.cameras.items():
        if not isinstance(view, LensView):
            eye = torch.eye(3, dtype=torch.float64)
            rig = rig.with_camera(name, LensView(hw=view.hw, sensor=view.sensor, K=eye))
    return rig


def focal_positions(K: Tensor) -> Tensor:
    """Return the positions of fx and fy in K as signs: on the diagonal, or beside it for a rotated image."""
    block = K.detach()[..., :2, :2]
    largest = block.abs() == block.abs().amax(-2, keepdim=True)
    return torch.where(largest, block.sign(), 0.0)


def _perturbed_camera(name: str, camera: View, changes: Mapping[str, Tensor]) -> View:
    """Camera with its part of the changes, by the names of `Rig.parameters`, added."""
    mine = {k.removeprefix(f"{name}."): v for k, v in changes.items() if k.startswith(f"{name}.")}
    if not mine or not isinstance(camera, LensView):
        return camera
    if "distortion" in mine and (lens := camera.distortion) is not None:
        lens = lens.with_coefficients(lens.coefficients + mine["distortion"])
        camera = camera.replace(distortion=lens)
    if not isinstance(camera, Camera):
        return camera
    pose, K = camera.cam_from_world, camera.K
    if mine.keys() & {"rotation", "translation"}:
        pose = pose.perturbed(mine.get("rotation"), mine.get("translation"))
    if "focal" in mine:
        K = K + torch.nn.functional.pad(focal_positions(K) * mine["focal"][..., None, :], (0, 1, 0, 1))
    if "centre" in mine:
        K = K + torch.nn.functional.pad(mine["centre"][..., None], (2, 0, 0, 1))
    return camera.replace(K=K, cam_from_world=pose)
