"""Compiled functions that compiled functions alone call: their code is optimised and translated with the callers'.

numba would do both for each function by itself, and again for each caller after the code is linked into it: attention's
fifty took two and a half times as long to compile.
"""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

_INTERNAL = "_optimize_final_module", "_finalize_final_module", "_finalize_dynamic_globals"


@cache
def options_of_linked() -> dict[str, Any]:
    """numba's options for such a function. Called from Python it raises TypeError."""
    wrappers = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return wrappers | {"pipeline_class": _linked_compiler()}


@cache
def _linked_compiler() -> Any:
    from numba.core.codegen import JITCodeLibrary
    from numba.core.compiler import Compiler

    if not all(hasattr(JITCodeLibrary, name) for name in _INTERNAL):
        return Compiler  # another version of numba: it only takes longer
    called_from_python = ctypes.cast(ctypes.pythonapi.PyErr_BadArgument, ctypes.c_void_p).value

    class Linked(JITCodeLibrary):
        """The code of a function, as it was generated. `codegen` is where numba sets what a function called from Python
        needs: nothing here."""

        codegen = property(lambda self: self)

        def set_env(self, name: str, environment: Any) -> None:
            pass

        def get_pointer_to_function(self, name: str) -> int | None:
            self._ensure_finalized()
            return called_from_python

        def _optimize_final_module(self) -> None:
            pass

        def _finalize_final_module(self) -> None:
            self._finalize_dynamic_globals()
            self._finalized = True

    class LinkedCompiler(Compiler):
        def define_pipelines(self) -> Any:
            self.state.library = Linked(self.state.targetctx.codegen(), self.state.func_id.func_qualname)
            return super().define_pipelines()

    return LinkedCompiler
