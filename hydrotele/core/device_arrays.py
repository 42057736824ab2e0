"""Small arrays of functions that run on CUDA devices: `np.empty` and `np.zeros` in the memory of a thread."""

from typing import Any

import numpy as np

from hydrotele.core.device import import_cuda

LOCAL_SIZE = 16
"""Largest number of elements of such an array; the size must be known to the compiler."""


def make_local_array_functions() -> dict[str, Any]:
    """Return CUDA forms of `np.empty` and `np.zeros` for up to LOCAL_SIZE numbers; their code is copied to callers.

    A function may not return such an array: its memory ends with the function.
    """
    cuda, real = import_cuda(), np.float64
    local, size = cuda.local, LOCAL_SIZE

    def make_empty_array(count):
        return local.array(size, real)[:count]

    def make_zero_array(count):
        values = local.array(size, real)
        for k in range(size):
            values[k] = 0.0
        return values[:count]

    forms = {"empty": make_empty_array, "zeros": make_zero_array}
    return {name: cuda.jit(function, device=True, inline="always") for name, function in forms.items()}
