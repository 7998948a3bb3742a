"""Batches of cameras, rigs, poses: one base class for every frozen dataclass of tensors."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, TypeVar

import torch
from torch import Tensor
from torch.utils._pytree import GetAttrKey, register_pytree_node, tree_leaves
from torch.utils.data._utils.collate import default_collate_fn_map

from .checks import check_methods, derived
from .pixels import broadcast_shapes

T = TypeVar("T", bound="Batched")
LABELS = ("name", "sensor")
"""Fields that may differ between stacked items; the batch has the first item's."""


class Batched:
    """Base of frozen dataclasses whose tensors have leading batch axes: `[i]`, `len`, `to` and `==`.

    A tensor without batch axes is shared by all items of a batch. Instances are equal if their types and
    fields are (tensors in dtype and device too), and not hashable. Subclasses are declared with
    `@dataclass(frozen=True, eq=False, repr=False)`, and define `_text`, their part of `repr`.

    Attributes:
        item_axes: by field, the number of a tensor's last axes that belong to one item; 0 for other fields.

    Raises:
        TypeError: by `[i]` and `len` of a single item; but `len` of a single rig is its number of cameras.
    """

    item_axes: ClassVar[Mapping[str, int]] = {}

    def __init_subclass__(cls, **options: Any) -> None:
        """Register the subclass as a pytree, and for `torch.load(weights_only=True)`."""
        super().__init_subclass__(**options)
        register_pytree_node(
            cls,
            _flattened,
            _unflattened,
            flatten_with_keys_fn=_flattened_with_keys,  # type: ignore[arg-type]
        )
        torch.serialization.add_safe_globals([cls])
        if cls.__module__.startswith("arraygeom."):
            check_methods(cls)

    @property
    def batch_shape(self) -> torch.Size:
        """Batch axes; empty for a single item."""
        shapes = [t.shape[: t.ndim - axes] for t, axes in tensors_of(self) if t.ndim > axes]
        return broadcast_shapes(*shapes) if shapes else torch.Size()

    def __len__(self) -> int:
        return self._batched()[0]

    def __bool__(self) -> bool:
        return True

    def __getitem__(self: T, index: Any) -> T:
        """Select items of the batch; `index` applies to its axes as to the first axes of a tensor."""
        shape = self._batched()

        def chosen(t: Tensor, axes: int) -> Tensor:
            trailing = t.shape[t.ndim - axes :]
            return t if t.ndim == axes else t.expand(*shape, *trailing)[index]

        return map_tensors(self, chosen)

    def to(self: T, *args: Any, **kwargs: Any) -> T:
        """Return a copy with `Tensor.to` applied to each tensor; masks and whole numbers keep their dtype.

        Tensors that stay as they are are shared, and errors of `Tensor.to` pass.

        Raises:
            TypeError: for another dtype than float32 and float64; half precision holds no pixel position.
        """

        def moved(t: Tensor, axes: int) -> Tensor:
            there = t.to(*args, **kwargs)
            if t.is_floating_point() and there.dtype not in (torch.float32, torch.float64):
                raise TypeError(
                    f"the numbers of a {type(self).__name__} are float32 or float64, got {there.dtype}: "
                    "half precision holds no pixel position; give features in it, and geometry as it is"
                )
            return there if t.is_floating_point() else there.to(t.dtype)

        return map_tensors(self, moved)

    def float(self: T) -> T:
        """Return a copy in float32."""
        return self.to(torch.float32)

    def double(self: T) -> T:
        """Return a copy in float64."""
        return self.to(torch.float64)

    def cpu(self: T) -> T:
        """Return a copy in the CPU's memory."""
        return self.to("cpu")

    def detach(self: T) -> T:
        """Return the same numbers without their history."""
        return map_tensors(self, lambda t, axes: t.detach())

    def clone(self: T) -> T:
        """Return a copy with memory of its own; gradients go through."""
        return map_tensors(self, lambda t, axes: t.clone())

    def pin_memory(self: T) -> T:
        """Return a copy in page-locked memory, as `torch.utils.data.DataLoader(pin_memory=True)` asks."""
        return map_tensors(self, lambda t, axes: t.pin_memory())

    def requires_grad_(self: T, requires_grad: bool = True) -> T:
        """Let autograd record operations on its numbers, or not, in place: in all that share its tensors.

        Returns:
            Itself.

        Raises:
            RuntimeError: for False where a tensor was computed from others that require grad.
        """
        for t, _ in tensors_of(self):
            if t.is_floating_point():
                t.requires_grad_(requires_grad)
        return self

    def replace(self: T, **changes: Any) -> T:
        """Return a copy with some fields changed, checked as in the constructor."""
        return dataclasses.replace(self, **changes)  # type: ignore[type-var]

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return all(_equal(getattr(self, f.name), getattr(other, f.name)) for f in _fields(self) if f.compare)

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return f"{type(self).__name__}: {', '.join(filter(None, (self._batch_text(), self._text())))}"

    def _batch_text(self) -> str:
        return f"batch of {'x'.join(map(str, self.batch_shape))}" if self.batch_shape else ""

    def _text(self) -> str:
        raise NotImplementedError

    def _whole(self: T) -> T:
        """Return a copy in which tensors that the items share have the batch's axes too."""
        shape = self.batch_shape
        return map_tensors(self, lambda t, axes: t.expand((*shape, *t.shape[t.ndim - axes :])))

    def _batched(self) -> torch.Size:
        shape = self.batch_shape
        if not shape:
            raise TypeError(
                f"this {type(self).__name__} is one item, not a batch: make a batch with arraygeom.stack"
            )
        return shape


def stack(items: Sequence[T]) -> T:
    """Stack items of one kind, single or batches of one shape, along a new first axis.

    All but tensors must be equal (sizes, lens models, a rig's cameras by name), except for the fields `name`
    and `sensor`, which are the first item's.

    Raises:
        ValueError: for no items, and items that differ in kind, shapes or such a field.
        RuntimeError: for items on several devices.
    """
    if not items:
        raise ValueError("nothing to stack: give one item or more")
    return _stacked(list(items), type(items[0]).__name__)


def map_tensors(value: Any, f: Callable[[Tensor, int], Tensor], axes: int = 0) -> Any:
    """Replace each tensor of a value by f(tensor, number of item axes), in nested mappings and tuples too.

    Args:
        value: tensor, `Batched`, mapping or tuple; anything else is returned itself, lists included.
        axes: number of item axes of tensors outside a `Batched`, which has its own.

    Returns:
        The new value, not checked; mappings become dictionaries, named tuples plain ones.
    """
    if isinstance(value, Tensor):
        return f(value, axes)
    if isinstance(value, Batched):
        held = {
            g.name: map_tensors(getattr(value, g.name), f, value.item_axes.get(g.name, 0))
            for g in _fields(value)
        }
        return derived(dataclasses.replace, value, **held)
    if isinstance(value, Mapping):
        return {key: map_tensors(v, f, axes) for key, v in value.items()}
    return tuple(map_tensors(v, f, axes) for v in value) if isinstance(value, tuple) else value


def tensors_of(value: Any, axes: int = 0) -> Iterator[tuple[Tensor, int]]:
    """Yield every tensor that `map_tensors` replaces, with the number of its item axes."""
    if isinstance(value, Tensor):
        yield value, axes
    elif isinstance(value, Batched):
        for f in _fields(value):
            yield from tensors_of(getattr(value, f.name), value.item_axes.get(f.name, 0))
    elif isinstance(value, Mapping | tuple):
        for v in value.values() if isinstance(value, Mapping) else value:
            yield from tensors_of(v, axes)


class _Layout(NamedTuple):
    """Flattened value without its tensors: its kind, names of fields with tensors, and the others."""

    kind: type
    names: tuple[str, ...]
    rest: dict[str, Any]


def _flattened(value: Batched) -> tuple[list[Any], _Layout]:
    held = {f.name: getattr(value, f.name) for f in _fields(value)}
    names = vars(value).get(_NAMES)  # of a tree with something else in place of tensors
    if names is None:
        names = tuple(
            name for name, v in held.items() if isinstance(v, Batched) or any(True for _ in tensors_of(v))
        )
    rest = {name: v for name, v in held.items() if name not in names}
    return [held[name] for name in names], _Layout(type(value), names, rest)


def _flattened_with_keys(value: Batched) -> tuple[list[tuple[GetAttrKey, Any]], _Layout]:
    held, layout = _flattened(value)
    return [(GetAttrKey(name), v) for name, v in zip(layout.names, held)], layout


def _unflattened(held: Iterable[Any], layout: _Layout) -> Any:
    """Rebuild a value without a constructor's checks: a tree may hold other things in place of tensors."""
    held = list(held)
    made: Any = object.__new__(layout.kind)
    for name, v in (layout.rest | dict(zip(layout.names, held))).items():
        object.__setattr__(made, name, v)
    for f in dataclasses.fields(made):
        if not f.init and f.default_factory is not dataclasses.MISSING:
            object.__setattr__(made, f.name, f.default_factory())
    if not all(isinstance(t, Tensor) for t in tree_leaves(held)):
        object.__setattr__(made, _NAMES, layout.names)
    return made


_NAMES = "_tensors"
default_collate_fn_map[Batched] = lambda items, *, collate_fn_map=None: stack(items)


def _fields(value: Any) -> list[dataclasses.Field[Any]]:
    return [f for f in dataclasses.fields(value) if f.init]


def _stacked(values: list[Any], where: str) -> Any:
    """Stack values of one kind; `where` names them in errors."""
    first = values[0]
    if any(type(v) is not type(first) for v in values):
        kinds = " and ".join(sorted({type(v).__name__ for v in values}))
        raise ValueError(f"cannot stack {where}: some are {kinds}")
    if isinstance(first, Tensor):
        if len({v.shape for v in values}) > 1:
            raise ValueError(
                f"cannot stack {where}: shapes {' and '.join(map(str, {tuple(v.shape) for v in values}))}"
            )
        return torch.stack(values)
    if isinstance(first, Batched):
        values = [v._whole() for v in values]
        held = {f.name: [getattr(v, f.name) for v in values] for f in _fields(first)}
        made = {n: same[0] if n in LABELS else _stacked(same, f"{where}.{n}") for n, same in held.items()}
        return derived(dataclasses.replace, first, **made)
    if isinstance(first, Mapping) and all(v.keys() == first.keys() for v in values):
        return {key: _stacked([v[key] for v in values], f"{where}[{key!r}]") for key in first}
    if isinstance(first, tuple) and any(isinstance(v, Tensor) for v in first):
        return tuple(_stacked(list(same), where) for same in zip(*values))
    differing = [v for v in values if v != first]
    if differing:
        raise ValueError(f"cannot stack {where}: {_named(first)} and {_named(differing[0])} differ")
    return first


def _named(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, Mapping) else str(value)


def _equal(a: Any, b: Any) -> bool:
    if isinstance(a, Tensor) and isinstance(b, Tensor):
        return (a.dtype, a.device, a.shape) == (b.dtype, b.device, b.shape) and torch.equal(a, b)
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return list(a) == list(b) and all(_equal(a[key], b[key]) for key in a)
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(_equal(x, y) for x, y in zip(a, b))
    return not isinstance(a, Tensor) and not isinstance(b, Tensor) and bool(a == b)
