"""Rig: named cameras of different kinds, and the depth range of the scene."""

from __future__ import annotations

import dataclasses
import difflib
import fnmatch
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from .batching import Batched, map_tensors
from .camera import Camera, LensView, View, view_facts
from .checks import check_numbers, check_origin, checking, derived
from .epipolar import fundamental_matrix
from .homography import plane_homography
from .pixels import HW, product, resize_matrix, rot90_matrix, shift_matrix
from .pose import Pose
from .runtime.text import baseline_text, depth_text, length_unit
from .runtime.tracing import traced

if TYPE_CHECKING:
    from kornia.geometry.camera import PinholeCamera

Depths = tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]


@dataclass(frozen=True, eq=False, repr=False)
class Link(Batched):
    """The two-view geometry of an uncalibrated pair: x_beta^T F x_alpha = 0 and, roughly, x_beta ~ H x_alpha.

    Of views with lenses, x are undistorted pixels (`LensView.undistort`).
    """

    item_axes: ClassVar = {"F": 2, "H": 2}
    F: Float[Tensor, "*b 3 3"]
    H: Float[Tensor, "*b 3 3"] | None = None

    def __post_init__(self) -> None:
        if checking():
            for name, matrix in (("F", self.F), ("H", self.H)):
                if not (name == "H" and matrix is None):
                    check_numbers(matrix, (3, 3), name)

    def reversed(self) -> Link:
        """The same link with alpha and beta exchanged."""
        return Link(self.F.transpose(-1, -2), None if self.H is None else torch.linalg.inv(self.H))

    def _text(self) -> str:
        return "F" if self.H is None else "F and H"

    def transformed(self, A_alpha: Float[Tensor, "3 3"], A_beta: Float[Tensor, "3 3"]) -> Link:
        """The link between images whose pixels are A x of the old ones."""
        A_alpha, A_beta = A_alpha.to(self.F), A_beta.to(self.F)
        back = torch.linalg.inv(A_alpha)
        F = product(product(torch.linalg.inv(A_beta).T, self.F), back)
        return Link(F, None if self.H is None else product(product(A_beta, self.H), back))


@dataclass(frozen=True, eq=False, repr=False)
class Pair(Batched):
    """Alpha and one beta with their relation: two calibrated cameras, or a link, or only sizes."""

    alpha: View
    beta: View
    depth: Depths | None = None
    link: Link | None = None
    unit: str = "m"
    """Of lengths: "baselines" where the rig's scale is unknown."""
    memo: dict[str, Any] = field(default_factory=dict, init=False, compare=False, repr=False)
    """Cache of what fields compute once a pair; never copied."""

    @property
    def calibrated(self) -> bool:
        """Whether both cameras are calibrated."""
        return isinstance(self.alpha, Camera) and isinstance(self.beta, Camera)

    @property
    def has_lens(self) -> bool:
        """Whether either view has a lens that distorts, so that lines are curves in its image."""
        lenses = [view.distortion for view in (self.alpha, self.beta) if isinstance(view, LensView)]
        return any(lens is not None and not lens.harmless for lens in lenses)

    @property
    def cameras(self) -> tuple[Camera, Camera]:
        """Both cameras. Raises ValueError unless the pair is calibrated."""
        if not (isinstance(self.alpha, Camera) and isinstance(self.beta, Camera)):
            raise ValueError(
                "this field needs calibrated cameras and the pair has none: "
                "use one that needs only F or sizes, such as HomographyDisplacement or Rectified"
            )
        return self.alpha, self.beta

    @property
    def beta_from_alpha(self) -> Pose:
        """X_beta = R X_alpha + t; t is 0 where it is no more than the rounding of the cameras' poses."""
        alpha, beta = self.cameras
        if checking() and self.depth is not None:
            check_origin(self.depth[0], alpha.t, beta.t, unit=self.unit)
        # torch.compile cannot trace @ of these
        pose = beta.cam_from_world.__matmul__(alpha.cam_from_world.inverse())
        baseline, *sides = (t.detach().norm(dim=-1, keepdim=True) for t in (pose.t, alpha.t, beta.t))
        is_rounding = baseline <= ROUNDED * torch.finfo(baseline.dtype).eps * sum(sides)
        return derived(Pose, pose.R, pose.t - torch.where(is_rounding, pose.t.detach(), 0.0))

    @property
    def depth_range(self) -> Depths:
        """(near, far) in metres. Raises ValueError if the rig states none."""
        if self.depth is None:
            raise ValueError(
                "this field needs a depth range: give the rig one, `depth: [near, far]` in its file or "
                "`rig.replace(depth=(near, far))`, or `--depth NEAR FAR` to `pat fuse` and `pat align`; "
                "`pat rig doctor` says between which depths it finds points"
            )
        return self.depth

    @property
    def fundamental(self) -> Float[Tensor, "*b 3 3"]:
        """F with x_beta^T F x_alpha = 0, from cameras or as given; between undistorted pixels through lenses.

        0 without a baseline. Raises ValueError if neither is known.
        """
        if self.link is not None:
            return self.link.F
        if not self.calibrated:
            raise ValueError(
                "neither the cameras' calibration nor F is known for this pair: give the rig a link"
            )
        alpha, beta = self._central("fundamental matrix")
        return fundamental_matrix(alpha.K, beta.K, self.beta_from_alpha)

    @property
    def homography(self) -> Float[Tensor, "*b 3 3"]:
        """H with x_beta ~ H x_alpha, roughly: as given; or of the plane at the middle inverse depth.

        A pair that is known only by sizes, or by F alone, is assumed to have the same field of view.
        """
        if self.link is not None and self.link.H is not None:
            return self.link.H
        if self.calibrated and self.depth is not None:
            near, far = self.depth
            return self.homography_at(2 / (1 / near + 1 / far))  # the middle of the disparities
        if self.calibrated:
            return self.homography_at(torch.tensor(torch.inf, dtype=torch.float64))
        return resize_matrix(self.alpha.hw, self.beta.hw)

    def resize_beta(self, hw: HW) -> Pair:
        """The pair whose beta records images of another size."""
        return self.transform_beta(resize_matrix(self.beta.hw, hw), hw)

    def transform_beta(self, A: Float[Tensor, "3 3"], hw: HW) -> Pair:
        """The pair in which beta's pixels are x' ~ A x and its image's size is `hw`."""
        eye = torch.eye(3, dtype=A.dtype)
        link = None if self.link is None else self.link.transformed(eye, A)
        return dataclasses.replace(self, beta=self.beta.transformed(A, hw), link=link)

    def homography_at(self, depth: Float[Tensor, "*d"]) -> Float[Tensor, "*b 3 3"]:
        """The homography of the plane z = depth in alpha's frame (metres; may be inf)."""
        alpha, beta = self._central("homography")
        normal = alpha.K.new_tensor([0.0, 0.0, 1.0])
        pose = self.beta_from_alpha
        return plane_homography(alpha.K, beta.K, pose.R, pose.t, normal=normal, d=-depth.to(alpha.K))

    def _central(self, what: str) -> tuple[Camera, Camera]:
        """Both cameras. Raises ValueError if the rays of one do not meet in a point."""
        for camera in self.cameras:
            if not camera.central and camera.distortion is not None:
                model = camera.distortion.model
                raise ValueError(
                    f"rays of a camera ({model}) do not meet in a point: there is no {what}; use Curved"
                )
        return self.cameras

    def _text(self) -> str:
        views = {"alpha": self.alpha, "beta": self.beta}
        named = ", ".join(f"{name} {view._text()}" for name, view in views.items())
        link = "" if self.link is None else f"link by {self.link._text()}"
        lengths = baseline_text(views, self.unit), depth_text(self.depth, self.unit)
        return "; ".join(filter(None, (named, *lengths, link)))


ROUNDED = 8
"""A baseline of so many units in the last place of the cameras' translations is none."""


@dataclass(frozen=True, eq=False, repr=False)
class Rig(Batched):
    """Ordered, named cameras of different sizes, lenses and spectral responses.

    `depth` is (near, far) in metres along the optical axis of whichever camera is alpha; far may be inf.
    Every number may have leading batch axes, the same for all: a batch of rigs. A depth range without them is
    that of each rig. Kornia's pinholes are converted. `links` relate cameras that are not calibrated, by
    (alpha, beta). A rig never changes: methods return new ones.
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
        if self.depth is not None:
            if not isinstance(self.depth, Sequence | Tensor) or len(self.depth) != 2:
                raise TypeError(f"depth is {self.depth!r}: wanted (near, far), in metres")
            object.__setattr__(self, "depth", depth_range(*self.depth))
            shape = self.batch_shape
            object.__setattr__(self, "depth", tuple(bound.expand(shape) for bound in self.depth))
        if checking():
            self._check_links()

    def _check_links(self) -> None:
        for names, link in self.links.items():
            if not isinstance(link, Link):
                raise TypeError(f"the link {names} is a {type(link).__name__}: give a Link(F)")
            alpha, beta = names
            if self.require(alpha) == self.require(beta):
                raise ValueError(f"a link relates two cameras; this one is from '{alpha}' to itself")

    @classmethod
    def from_kornia(
        cls, cameras: Mapping[str, PinholeCamera], *, batched: bool = False, **fields: Any
    ) -> Rig:
        """The rig of kornia pinholes by name; `fields` are the rig's own, such as `depth`.

        Kornia's cameras are always batched: a batch of one becomes a single camera unless `batched`. Raises
        ValueError for batches of unequal length, TypeError for other cameras than kornia's pinholes by name.
        `Rig(cameras)` serves as well, for batches of one or more as they come.
        """
        if not isinstance(cameras, Mapping):
            kind = type(cameras).__name__
            raise TypeError(
                f"a {kind} is no mapping of kornia's PinholeCamera by name: give each camera a name"
            )
        made = {name: Camera.from_kornia(camera, batched=True) for name, camera in cameras.items()}
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
        """Kornia's pinholes by name, each a batch as long as the rig's (one for a single rig).

        Raises ValueError for cameras with lenses and for those not calibrated.
        """
        views = [name for name, view in self.cameras.items() if not isinstance(view, Camera)]
        if views:
            raise ValueError(
                f"kornia has no camera without a calibration: {', '.join(views)} of this rig are such"
            )
        shape = self.batch_shape
        lenses = [(name, camera.distortion) for name, camera in self.cameras.items()]
        if bent := [name for name, lens in lenses if lens is not None and not lens.harmless]:
            raise ValueError(
                f"kornia's cameras with a lens have no pose ({', '.join(bent)}): "
                "give each as camera.to_kornia() and keep its cam_from_world"
            )
        batched = map_tensors(self.cameras, lambda t, axes: t.expand(*shape, *t.shape[t.ndim - axes :]))
        return {name: camera.to_kornia() for name, camera in batched.items()}

    def __getitem__(self, name: Any) -> Any:
        """The camera of a name; or, of a batch of rigs, those at an index."""
        return self.cameras[self.require(name)] if isinstance(name, str) else super().__getitem__(name)

    def __contains__(self, name: object) -> bool:
        return name in self.cameras

    def __len__(self) -> int:
        """How many cameras; of a batch of rigs, how many rigs."""
        return super().__len__() if self.batch_shape else len(self.cameras)

    def __iter__(self) -> Iterator[Any]:
        """The cameras' names in order; of a batch of rigs, the rigs."""
        return (self[i] for i in range(len(self))) if self.batch_shape else iter(self.names)

    @property
    def names(self) -> tuple[str, ...]:
        """The cameras' names in order."""
        return tuple(self.cameras)

    def require(self, name: str) -> str:
        """The name itself. Raises ValueError if the rig has no such camera."""
        if name not in self.cameras:
            near = difflib.get_close_matches(str(name), self.names, 1)
            hint = f"; did you mean '{near[0]}'?" if near else ""
            raise ValueError(f"the rig has no camera '{name}'{hint} (it has: {', '.join(self.names)})")
        return name

    def betas(self, alpha: str) -> tuple[str, ...]:
        """All names but alpha's."""
        return tuple(n for n in self.names if n != self.require(alpha))

    def pair(self, alpha: str, beta: str) -> Pair:
        """What relates two cameras of the rig, in the order given."""
        link = self.links.get((alpha, beta))
        if link is None and (beta, alpha) in self.links:
            link = self.links[beta, alpha].reversed()
        return Pair(self[alpha], self[beta], self.depth, link, length_unit(self))

    def with_camera(self, name: str, camera: View) -> Rig:
        """A copy with one camera set, replacing that of the same name if there is one."""
        return self.replace(cameras={**self.cameras, name: camera})

    def resize(self, name: str, hw: HW) -> Rig:
        """The rig whose camera `name` records images of another size."""
        return self.transformed(name, resize_matrix(self[name].hw, hw), hw)

    def crop(self, name: str, top: int, left: int, hw: HW) -> Rig:
        """The rig whose camera `name` keeps a window of its image; see `Camera.crop`."""
        return self.transformed(name, shift_matrix(left, top), hw)

    def rot90(self, name: str, quarter_turns: int) -> Rig:
        """The rig whose camera `name` has its image rotated; see `Camera.rot90`."""
        A = rot90_matrix(self[name].hw, quarter_turns)
        return self.transformed(name, A, self[name].rot90(quarter_turns).hw)

    def transformed(self, name: str, A: Float[Tensor, "3 3"], hw: HW) -> Rig:
        """The rig in which the pixels of camera `name` are x' ~ A x and its image's size is `hw`."""
        eye = torch.eye(3, dtype=torch.float64)
        links = {
            (a, b): link.transformed(A if a == name else eye, A if b == name else eye)
            if name in (a, b)
            else link
            for (a, b), link in self.links.items()
        }
        return self.with_camera(name, self[name].transformed(A, hw)).replace(links=links)

    def scaled(self, factor: float) -> Rig:
        """The rig with all lengths (of cameras, depth range) times a positive factor: another unit, say.

        Raises ValueError for a camera model that does not say which of its numbers are lengths.
        """
        cameras = {
            name: view.scaled(factor) if isinstance(view, Camera) else view
            for name, view in self.cameras.items()
        }
        depth = None if self.depth is None else (self.depth[0] * factor, self.depth[1] * factor)
        return self.replace(cameras=cameras, depth=depth)

    def parameters(self, *, free: Iterable[str]) -> dict[str, Tensor]:
        """Changes an optimiser may make, all zero and requiring grad; `perturbed` applies them.

        `free` holds patterns over "camera.rotation" (rotation vector, radians), "camera.translation"
        (metres), "camera.focal" (fx, fy in pixels), "camera.centre" (cx, cy in pixels), "camera.distortion",
        "depth.near" and "depth.far" (metres), for instance ["colour.*", "depth.near"]. An uncalibrated view
        has its lens's. Raises ValueError for a pattern that matches nothing.
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
        """The rig after changes named as in `parameters`. What is not named stays bit-identical.

        Rotations step on the manifold, exp(change) R, so that they remain rotations.
        """
        unknown = set(changes) - set(self._parameter_shapes())
        if unknown:
            raise ValueError(f"no such rig parameter: {', '.join(sorted(unknown))}")
        cameras = {
            name: derived(_perturbed_camera, name, camera, changes) for name, camera in self.cameras.items()
        }
        depth = self.depth
        if depth is not None:
            near, far = depth
            depth = near + changes.get("depth.near", 0), far + changes.get("depth.far", 0)
        return self.replace(cameras=cameras, depth=depth)

    def check(self) -> tuple[str, ...]:
        """What is odd about the rig, a sentence each; none if nothing is.

        Constructors refuse numbers that cannot be; these can, and are mistakes more often than not: another
        unit, poses of another convention, axes exchanged, views that do not overlap.
        """
        from .rig_check import oddities

        return oddities(self)

    @classmethod
    def load(cls, path: str | Path) -> Rig:
        """Read a rig file of any format that `arraygeom.io` knows. Raises `arraygeom.io.RigFileError`."""
        from .io import read_rig

        return read_rig(path)

    def save(self, path: str | Path) -> None:
        """Write the native rig file, atomically."""
        from .io import write_rig

        write_rig(self, path)

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
        """One tensor of the right shape, type and device for each parameter."""
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
    """A camera as given, converted if it is kornia's."""
    if isinstance(camera, View):
        return camera
    from kornia.geometry.camera import PinholeCamera

    if isinstance(camera, PinholeCamera):
        return Camera.from_kornia(camera)
    kind = type(camera).__name__
    raise TypeError(
        f"camera '{name}' is a {kind}: give a Camera, a LensView, a View or a kornia PinholeCamera"
    )


def depth_range(near: Any, far: Any) -> Depths:
    """(near, far) as tensors, numbers in float64. Raises ValueError unless 0 < near <= far (where known)."""
    bounds = [
        d if isinstance(d, Tensor) else torch.tensor(float(d), dtype=torch.float64) for d in (near, far)
    ]
    near, far = bounds
    if not traced() and not bool(((near > 0) & (far >= near)).all()):
        raise ValueError(
            "depth bounds must satisfy 0 < near <= far, in metres; "
            f"got near = {_shown(near)}, far = {_shown(far)}"
        )
    return near, far


def _shown(d: Tensor) -> str:
    return ", ".join(f"{v:g}" for v in d.reshape(-1).tolist())


def focal_positions(K: Tensor) -> Tensor:
    """Positions of fx and fy in K, with their signs: the diagonal, or for a rotated image the other one."""
    block = K.detach()[..., :2, :2]
    largest = block.abs() == block.abs().amax(-2, keepdim=True)
    return torch.where(largest, block.sign(), 0.0)


def _perturbed_camera(name: str, camera: View, changes: Mapping[str, Tensor]) -> View:
    """The camera with its part of the changes, by the names of `Rig.parameters`, added."""
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
