"""From photographs of a board to a rig: target, corners, intrinsics, poses, bundle adjustment, report."""

from typing import TYPE_CHECKING, Any

if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        """Names that this package had when it was a module, of `target` now."""
        from arraygeom.moved import moved_name

        known = {"Board", "Charuco", "Chessboard", "Circles", "draw_board", "parse_board"}
        return moved_name(__name__, name, f"{__name__}.target.{name}" if name in known else None)
