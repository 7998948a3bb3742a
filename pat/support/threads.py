"""Compiled loops on as many threads as torch may use."""

from arraygeom.threads import in_parallel

__all__ = ["in_parallel"]
