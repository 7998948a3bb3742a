"""Explorer in one line of a notebook, without a server or a network connection."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from arraygeom import ReceptiveField, Rig
from arraygeom.runtime.extras import needs
from arraygeom.uncertainty import Covariance

from ...networks.paper import PAT
from .page import GRID, MODULE, Explorer, opened

with needs("explore", "the explorer in a notebook"):
    import anywidget
    import traitlets


class FieldWidget(anywidget.AnyWidget):
    """Notebook widget that shows alpha and the betas side by side, with segments, samples and controls.

    The browser changes `controls`; the widget then sets `answer`.

    Args:
        explorer: scene to show, as `opened` returns it; of one with an error the message is shown.
    """

    _esm = MODULE
    cameras: Any = traitlets.List().tag(sync=True)
    ranges: Any = traitlets.List().tag(sync=True)
    choices: Any = traitlets.List().tag(sync=True)
    defaults = traitlets.Dict().tag(sync=True)
    files = traitlets.Dict().tag(sync=True)
    controls = traitlets.Dict().tag(sync=True)
    answer = traitlets.Dict().tag(sync=True)

    def __init__(self, explorer: Explorer) -> None:
        self.explorer = explorer
        super().__init__(**explorer.values())
        self.observe(self._respond, "controls")

    def __repr__(self) -> str:
        return "the explorer, which a kernel answers: run this cell"

    @property
    def rig(self) -> Rig:
        """The rig as the controls have changed it, for the next cell.

        Raises:
            ValueError: if there is none, or for impossible controls.
        """
        self.explorer.controls = self.controls
        return self.explorer.rig

    def save(self, path: str | Path, columns: int = GRID) -> None:
        """Write a page of one file that needs no kernel; see `Explorer.save`."""
        self.explorer.controls = self.controls
        self.explorer.save(path, columns)

    def _respond(self, change: Any) -> None:
        self.answer = self.explorer.answer(change.new)


def explore(
    rig: Rig,
    images: Mapping[str, Float[Tensor, "_ _ _"]] | None = None,
    *,
    alpha: str | None = None,
    x: tuple[float, float] | None = None,
    network: PAT | str | None = None,
    fields: Mapping[str, ReceptiveField] | None = None,
    covariance: Covariance | None = None,
    **controls: Any,
) -> FieldWidget:
    """Show the receptive fields of a rig in a cell of a notebook: point at a pixel of alpha, and move the
    rig.

    Args:
        rig: the rig.
        images: images (C, H, W) by camera; None for a checkered room.
        alpha: name of alpha; None for the first camera with an image.
        x: pixel (x, y) of alpha; None for the middle.
        network: network of the paper, or weights such as "pat-supervised", whose attention is shown; None for
            correlations of windows.
        fields: further fields by name, which can then be chosen; None for none.
        covariance: covariance of the rig's parameters, as `calib` writes it, for 95 % bands around segments;
            None for none.
        controls: initial values of the controls: `field` and `second` (names of fields), `weights`, `near`
            and `far` (in the rig's unit), `baseline` (factor), `errors` (changes by camera, such as
            {"colour": {"ry": 0.5, "cx": 3}}; `answers.ERRORS` lists them), `camera` (the one that sliders
            change), `map` (of `answers.MAPS`), `pins` (pixels of alpha that stay drawn).

    Returns:
        The widget; problems with the input are shown in it. Its `rig` is the rig as changed.

    Raises:
        TypeError: for an unknown argument.
    """
    return FieldWidget(
        opened(
            rig, images, alpha=alpha, x=x, network=network, fields=fields, covariance=covariance, **controls
        )
    )
