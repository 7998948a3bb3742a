"""Whether EEVEE can run here. Without OpenGL 4.3 through EGL it aborts the whole process, so test another one.

This file is run as a script without Blender; it must import nothing but the standard library.
"""

from __future__ import annotations

import ctypes
import subprocess
import sys
from pathlib import Path

_SURFACELESS = 0x31DD
_OPENGL = 0x30A2
_CORE_4_3 = (0x3098, 4, 0x30FB, 3, 0x30FD, 1, 0x3038)


def refuse_eevee() -> None:
    """Raises ValueError, in one line, where an EEVEE render would abort."""
    answer = subprocess.run([sys.executable, "-I", str(Path(__file__))], capture_output=True, text=True, check=False)
    if answer.returncode:
        reason = (answer.stderr.strip().splitlines() or ["the probe crashed"])[-1]
        raise ValueError(
            f"engine 'eevee' cannot run here ({reason}): on Debian apt-get install -y libegl1, or use engine 'cycles'"
        )


def probe() -> str | None:
    """Why no OpenGL 4.3 context can be made, or None."""
    try:
        egl = ctypes.CDLL("libEGL.so.1")
    except OSError:
        return "libEGL.so.1 is missing"
    pointer = ctypes.c_void_p
    egl.eglGetProcAddress.restype = egl.eglCreateContext.restype = pointer
    address = egl.eglGetProcAddress(b"eglGetPlatformDisplayEXT")
    if not address:
        return "EGL has no displays without a screen"
    display = ctypes.CFUNCTYPE(pointer, ctypes.c_uint, pointer, pointer)(address)(_SURFACELESS, None, None)
    if not display or not egl.eglInitialize(pointer(display), None, None):
        return "EGL does not start"
    egl.eglBindAPI(_OPENGL)
    attributes = (ctypes.c_int * len(_CORE_4_3))(*_CORE_4_3)
    egl.eglCreateContext.argtypes = (pointer, pointer, pointer, ctypes.POINTER(ctypes.c_int))
    return None if egl.eglCreateContext(display, None, None, attributes) else "no OpenGL 4.3"


if __name__ == "__main__":
    sys.exit(probe())
