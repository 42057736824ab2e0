"""Many simulations of one model, advanced by one native function each, on a pool of threads.

The C side of `mujoco.batch`, whose `mjb_apply` Python does not show: a compiled function is handed
every simulation in turn and may step it as often as it likes, so that control, sensors and reward
run beside the physics without Python. Results do not depend on the number of threads.
"""

import ctypes

import mujoco
import numpy as np

from hydrotele.simulate.library import mujoco_library

STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)


class _Config(ctypes.Structure):
    _fields_ = [("nthread", ctypes.c_int), ("persistent", ctypes.c_bool)]


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
        self._library, self._handle = mujoco_library(), None
        _declare(self._library)
        said = ctypes.create_string_buffer(500)
        handle = self._library.mjb_makeBatch(
            model._address, count, ctypes.byref(_Config(threads, False)), said, len(said)
        )
        if not handle:
            raise RuntimeError(f"{count} simulations cannot be made: {said.value.decode()}")
        self._handle, self.model, self.count = handle, model, count
        size = self._library.mjb_nstate(handle)
        self.state = _seen(self._library.mjb_state(handle), (count, size))

    def expand(self, name: str) -> np.ndarray:
        """Give a field of floats of the model a value per simulation.

        Args:
            name: of an array of mjModel, or `opt.<name>`.

        Returns:
            (n, size) live array; what it says holds from the next call on.

        Raises:
            ValueError: MuJoCo cannot give this field a value per simulation.
        """
        size, width = ctypes.c_int(), ctypes.c_int()
        place = self._library.mjb_expand(
            self._handle, name.encode(), ctypes.byref(size), ctypes.byref(width)
        )
        if not place or width.value != 8:
            raise ValueError(f"{name} cannot differ between simulations")
        return _seen(place, (self.count, size.value))

    def apply(self, function: int, argument: int, chosen: np.ndarray | None = None) -> None:
        """Call a C function `(mjModel*, mjData*, int simulation, void*)` for simulations.

        Args:
            function: its address.
            argument: address of what it is given last.
            chosen: (m,) int32 numbers of simulations, None for all.

        Raises:
            RuntimeError: they were closed, or MuJoCo raised an error in one of them.
        """
        if not self._handle:
            raise RuntimeError("the simulations were closed: make new ones")
        ids = None if chosen is None else chosen.ctypes.data
        count = self.count if chosen is None else len(chosen)
        if self._library.mjb_apply(self._handle, ids, count, function, argument, 1):
            status = _seen(self._library.mjb_status(self._handle), (self.count,), np.int32)
            first = int(np.flatnonzero(status)[0])
            words = self._library.mjb_error(self._handle, first).decode()
            raise RuntimeError(f"simulation {first}: {words}")

    def get_model(self, number: int, model: mujoco.MjModel) -> None:
        """Write the model of one simulation into `model`, which has the same sizes."""
        self._library.mjb_getModel(self._handle, number, model._address)

    def get_data(self, number: int, data: mujoco.MjData) -> None:
        """Write the state of one simulation into `data`, which has the same sizes."""
        self._library.mjb_getData(self._handle, number, data._address)

    def close(self) -> None:
        """Give the memory back; `state` and expanded fields must not be used any more."""
        if self._handle:
            self._library.mjb_deleteBatch(self._handle)
            self._handle = None

    def __del__(self) -> None:
        """Close at the latest when nobody holds it."""
        self.close()


def _seen(address: int, shape: tuple[int, ...], kind: type = np.float64) -> np.ndarray:
    size = int(np.prod(shape)) * np.dtype(kind).itemsize
    memory = (ctypes.c_char * size).from_address(address)
    return np.frombuffer(memoryview(memory), dtype=kind).reshape(shape)


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
