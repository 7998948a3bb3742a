"""Where the modules of `pat` have moved: their old names work for one release, with a DeprecationWarning."""

from __future__ import annotations

from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

_SAME_NAME = {
    "evaluation": ("metrics",),
    "fusion": ("batch", "fuse", "results", "sequence"),
    "media": ("images", "video"),
    "networks": ("bandwise", "guided", "weights"),
    "support": ("jobs", "memory"),
    "training": ("train",),
}
MOVED = {f"pat.{name}": f"pat.{room}.{name}" for room, names in _SAME_NAME.items() for name in names}
MOVED |= {
    "pat.ablate": "pat.evaluation.ablation",
    "pat.attention.op": "pat.attention.attend",
    "pat.classical": "pat.evaluation.baseline",
    "pat.data.protocol": "pat.evaluation.protocols",
    "pat.demo": "pat.data.sample_array",
    "pat.develop": "pat.media.raw",
    "pat.evaluate": "pat.evaluation.stereo",
    "pat.model": "pat.networks.paper",
    "pat.motion": "pat.fusion.optical_flow",
}

RENAMED = {
    "pat.batch.find_pictures": "pat.fusion.batch.find_images",
    "pat.demo.report_figure": "pat.systems.demo.save_demo_figure",
    "pat.develop.ViewFiles": "pat.fusion.views.ViewFiles",
    "pat.develop.read_views": "pat.fusion.views.read_views",
    "pat.fuse.default_field": "arraygeom.fields.default.default_field",
    "pat.fuse.FusedFrame": "pat.fusion.results.Frame",
    "pat.images.from_luma_chroma": "pat.media.colour.from_luma_chroma",
    "pat.images.luminance": "pat.media.colour.luminance",
    "pat.images.to_luma_chroma": "pat.media.colour.to_luma_chroma",
    "pat.model.FusionNetwork": "pat.networks.protocol.FusionNetwork",
    "pat.sequence.PictureFiles": "pat.fusion.frames.ImageFiles",
}
"""New addresses of names that are not in the new module under the same name."""


class OldNames:
    """A finder for `sys.meta_path`; torch is imported only when one of the old names is."""

    @staticmethod
    def find_spec(fullname: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """The specification of a module that has moved."""
        if fullname not in MOVED:
            return None
        from arraygeom.moved import OldModules

        return OldModules(MOVED, RENAMED).find_spec(fullname)


class CallableModule(ModuleType):
    """A module that, called, calls its function of the same name."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call it."""
        return getattr(self, self.__name__.rpartition(".")[2])(*args, **kwargs)
