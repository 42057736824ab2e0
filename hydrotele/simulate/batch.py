"""Batch of simulations of one model, advanced in parallel by a compiled function on a thread pool.

The module calls MuJoCo's C function `mjb_apply`, which the Python module `mujoco.batch` does not
expose. It calls a compiled function for each simulation. The function can make any number of steps,
so that control, sensors and reward run without Python. Results do not depend on the number of
threads.
"""

import ctypes
import os
from typing import Any

import mujoco
import numpy as np

from hydrotele.simulate.mujoco_c_api import mujoco_library

STATE_KIND = int(mujoco.mjtState.mjSTATE_INTEGRATION)


class _Config(ctypes.Structure):
    _fields_ = [("nthread", ctypes.c_int), ("persistent", ctypes.c_bool)]


class _NativeBatch:
    """Owner of MuJoCo's native batch; frees it when no `SimulationBatch` or array refers to it."""

    def __init__(self, library: ctypes.CDLL, handle: int) -> None:
        self.library, self.handle, self.process = library, handle, os.getpid()

    def view_memory(self, address: int, shape: tuple[int, ...], kind: type = np.float64) -> np.ndarray:
        """Return an array of a shape and number type that shares the native memory at an address.

        The array keeps the native batch alive.
        """
        size = int(np.prod(shape)) * np.dtype(kind).itemsize
        kept: Any = type("_Memory", (ctypes.c_char * size,), {})  # a subclass can have attributes
        memory = kept.from_address(address)
        memory.owner = self
        return np.frombuffer(memoryview(memory), dtype=kind).reshape(shape)

    def __del__(self) -> None:
        if self.process == os.getpid():  # a forked child does not have the threads
            self.library.mjb_deleteBatch(self.handle)


class SimulationBatch:
    """Simulations of copies of one model, stepped in parallel by native code.

    Attributes:
        model: the model.
        count: number of simulations n.
        state: (n, s) view of the complete states, in the order of `mj_getState` with
            mjSTATE_INTEGRATION.
    """

    def __init__(self, model: mujoco.MjModel, count: int, threads: int = 0) -> None:
        """Allocate the simulations.

        Args:
            model: the model; it is copied.
            count: number of simulations.
            threads: number of threads, including the caller's; 0 for one per core.

        Raises:
            RuntimeError: MuJoCo cannot create the simulations; contains MuJoCo's message.
        """
        self._library = mujoco_library()
        self._native: _NativeBatch | None = None
        _declare_signatures(self._library)
        said = ctypes.create_string_buffer(500)
        handle = self._library.mjb_makeBatch(
            model._address, count, ctypes.byref(_Config(threads, False)), said, len(said)
        )
        if not handle:
            raise RuntimeError(f"cannot create {count} simulations: {said.value.decode()}")
        self._native, self.model, self.count = _NativeBatch(self._library, handle), model, count
        size = self._library.mjb_nstate(handle)
        self.state = self._native.view_memory(self._library.mjb_state(handle), (count, size))

    def expand_field_per_simulation(self, name: str) -> np.ndarray:
        """Let the values of a float field of the model differ between the simulations.

        Args:
            name: name of an array of mjModel, or `opt.<name>`.

        Returns:
            (n, size) view of the values, one row per simulation. Changes take effect with the next `apply`.

        Raises:
            ValueError: MuJoCo does not support separate values for this field.
        """
        native, size, width = self._require_native(), ctypes.c_int(), ctypes.c_int()
        place = self._library.mjb_expand(native.handle, name.encode(), ctypes.byref(size), ctypes.byref(width))
        if not place or width.value != 8:
            raise ValueError(f"field {name} cannot differ between simulations")
        return native.view_memory(place, (self.count, size.value))

    def apply(self, function: int, argument: int, chosen: np.ndarray | None = None) -> None:
        """Call a compiled function for each simulation, in parallel on the thread pool.

        Its C signature is `(mjModel*, mjData*, int simulation, void* argument)`.

        Args:
            function: address of the function.
            argument: pointer passed as the last argument.
            chosen: (m,) int32 indices of the simulations; None for all.

        Raises:
            RuntimeError: the simulations were closed, this process was forked from the one that
                created them, or MuJoCo reported an error in one of them.
        """
        native = self._require_native()
        ids = None if chosen is None else chosen.ctypes.data
        count = self.count if chosen is None else len(chosen)
        if self._library.mjb_apply(native.handle, ids, count, function, argument, 1):
            status = native.view_memory(self._library.mjb_status(native.handle), (self.count,), np.int32)
            first = int(np.flatnonzero(status)[0])
            words = self._library.mjb_error(native.handle, first).decode()
            raise RuntimeError(f"simulation {first}: {words}")

    def copy_model_into(self, number: int, model: mujoco.MjModel) -> None:
        """Copy the model of simulation `number` into `model`, which must have the same sizes."""
        self._library.mjb_getModel(self._require_native().handle, number, model._address)

    def copy_data_into(self, number: int, data: mujoco.MjData) -> None:
        """Copy the mjData of simulation `number` into `data`, which must have the same sizes."""
        self._library.mjb_getData(self._require_native().handle, number, data._address)

    def require_open(self) -> None:
        """Raise RuntimeError if the simulations are closed or belong to a parent process."""
        self._require_native()

    def _require_native(self) -> _NativeBatch:
        """Return the native batch; raise RuntimeError if it is closed or belongs to a parent process."""
        if self._native is None:
            raise RuntimeError("the simulations were closed: create new ones")
        if self._native.process != os.getpid():
            raise RuntimeError(
                "this process was forked from the one that created the simulations and does not"
                " have its threads: create new simulations here, or start processes by spawn"
            )
        return self._native

    def close(self) -> None:
        """Release the simulations; the native memory is freed once no array refers to it.

        `state` becomes an empty array, and further calls of the other methods raise RuntimeError.
        """
        self._native, self.state = None, np.empty((0, 0))

    def __reduce__(self):
        """Raise TypeError when the object is copied or pickled, since it refers to native memory."""
        raise TypeError(
            "simulations in native memory can be neither copied nor pickled: create a second"
            " environment with the same options and seed"
        )


def _declare_signatures(library: ctypes.CDLL) -> None:
    """Declare the argument and result types of MuJoCo's batch functions (mjbatch.h) to ctypes."""
    place, number = ctypes.c_void_p, ctypes.c_int
    for name, result, *arguments in (
        ("mjb_makeBatch", place, place, number, place, place, number),
        ("mjb_deleteBatch", None, place),
        ("mjb_nstate", number, place),
        ("mjb_state", place, place),
        ("mjb_status", place, place),
        ("mjb_error", ctypes.c_char_p, place, number),
        ("mjb_expand", place, place, ctypes.c_char_p, place, place),
        ("mjb_apply", number, place, place, number, place, place, number),
        ("mjb_getModel", None, place, number, place),
        ("mjb_getData", None, place, number, place),
    ):
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
