"""MuJoCo's shared library, for what its Python bindings do not show."""

import ctypes
import functools
from pathlib import Path

import mujoco


@functools.cache
def mujoco_library() -> ctypes.CDLL:
    """The library that the bindings use, loaded once.

    Raises:
        RuntimeError: it does not lie where the package has it.
    """
    found = next(Path(mujoco.__file__).parent.glob("*mujoco.*[0-9]*"), None)
    if found is None:
        raise RuntimeError(f"MuJoCo {mujoco.__version__} has no shared library in its package")
    return ctypes.CDLL(str(found))
