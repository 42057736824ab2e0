"""Many simulations of one model, advanced by one native function each, on a pool of threads.

The C side of `mujoco.batch`, whose `mjb_apply` Python does not show: a compiled function is handed
every simulation in turn and may step it as often as it likes, so that control, sensors and reward
run beside the physics without Python. Results do not depend on the number of threads.
"""

import ctypes
import os
from typing import Any

import mujoco
import numpy as np

from hydrotele.simulate.layout import mujoco_library

STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)


class _Config(ctypes.Structure):
    _fields_ = [("nthread", ctypes.c_int), ("persistent", ctypes.c_bool)]


class _Native:
    """What MuJoCo made; it is given back when neither a fleet nor an array looks at it."""

    def __init__(self, library: ctypes.CDLL, handle: int) -> None:
        self.library, self.handle, self.process = library, handle, os.getpid()

    def seen(self, address: int, shape: tuple[int, ...], kind: type = np.float64) -> np.ndarray:
        """An array of its memory, which lives as long as the array does."""
        size = int(np.prod(shape)) * np.dtype(kind).itemsize
        kept: Any = type("_Memory", (ctypes.c_char * size,), {})  # with room for its owner
        memory = kept.from_address(address)
        memory.owner = self
        return np.frombuffer(memoryview(memory), dtype=kind).reshape(shape)

    def __del__(self) -> None:
        if self.process == os.getpid():  # its threads are not in a forked child
            self.library.mjb_deleteBatch(self.handle)


class Fleet:
    """Simulations of copies of one model.

    Attributes:
        model: the model.
        count: number of simulations n.
        state: (n, s) complete states, in the order of `mj_getState` with mjSTATE_INTEGRATION; live.
    """

    def __init__(self, model: mujoco.MjModel, count: int, threads: int = 0) -> None:
        """Make room.

        Args:
            model: the model; it is copied.
            count: number of simulations.
            threads: including the caller's; 0 for one per core.

        Raises:
            RuntimeError: MuJoCo cannot make them; its own words.
        """
        self._library = mujoco_library()
        self._native: _Native | None = None
        _declare(self._library)
        said = ctypes.create_string_buffer(500)
        handle = self._library.mjb_makeBatch(
            model._address, count, ctypes.byref(_Config(threads, False)), said, len(said)
        )
        if not handle:
            raise RuntimeError(f"{count} simulations cannot be made: {said.value.decode()}")
        self._native, self.model, self.count = _Native(self._library, handle), model, count
        size = self._library.mjb_nstate(handle)
        self.state = self._native.seen(self._library.mjb_state(handle), (count, size))

    def expand(self, name: str) -> np.ndarray:
        """Give a field of floats of the model a value per simulation.

        Args:
            name: of an array of mjModel, or `opt.<name>`.

        Returns:
            (n, size) live array; what it says holds from the next call on.

        Raises:
            ValueError: MuJoCo cannot give this field a value per simulation.
        """
        native, size, width = self._usable(), ctypes.c_int(), ctypes.c_int()
        place = self._library.mjb_expand(
            native.handle, name.encode(), ctypes.byref(size), ctypes.byref(width)
        )
        if not place or width.value != 8:
            raise ValueError(f"{name} cannot differ between simulations")
        return native.seen(place, (self.count, size.value))

    def apply(self, function: int, argument: int, chosen: np.ndarray | None = None) -> None:
        """Call a C function `(mjModel*, mjData*, int simulation, void*)` for simulations.

        Args:
            function: its address.
            argument: address of what it is given last.
            chosen: (m,) int32 numbers of simulations, None for all.

        Raises:
            RuntimeError: they were closed, this process was forked from the one that made them, or
                MuJoCo raised an error in one of them.
        """
        native = self._usable()
        ids = None if chosen is None else chosen.ctypes.data
        count = self.count if chosen is None else len(chosen)
        if self._library.mjb_apply(native.handle, ids, count, function, argument, 1):
            status = native.seen(self._library.mjb_status(native.handle), (self.count,), np.int32)
            first = int(np.flatnonzero(status)[0])
            words = self._library.mjb_error(native.handle, first).decode()
            raise RuntimeError(f"simulation {first}: {words}")

    def get_model(self, number: int, model: mujoco.MjModel) -> None:
        """Write the model of one simulation into `model`, which has the same sizes."""
        self._library.mjb_getModel(self._usable().handle, number, model._address)

    def get_data(self, number: int, data: mujoco.MjData) -> None:
        """Write the state of one simulation into `data`, which has the same sizes."""
        self._library.mjb_getData(self._usable().handle, number, data._address)

    def _usable(self) -> _Native:
        if self._native is None:
            raise RuntimeError("the simulations were closed: make new ones")
        if self._native.process != os.getpid():
            raise RuntimeError(
                "this process was forked from the one that made the simulations, whose threads it"
                " lacks: make new ones here, or start processes by spawn"
            )
        return self._native

    def close(self) -> None:
        """Give the memory back, once nobody holds `state` or an expanded field."""
        self._native, self.state = None, np.empty((0, 0))

    def __reduce__(self):
        """Refuse to be copied or pickled."""
        raise TypeError(
            "simulations in native memory can be neither copied nor pickled: make a second"
            " environment with the same options and seed"
        )


def _declare(library: ctypes.CDLL) -> None:
    """Tell ctypes the signatures of mjbatch.h."""
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
