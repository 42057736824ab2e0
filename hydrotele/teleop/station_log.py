"""What the operator's station saw and did, by control tick, and its channels for the logs."""

import numpy as np

from hydrotele.machine.joystick import AXES
from hydrotele.teleop.flat import flat_view
from hydrotele.teleop.master import MasterState
from hydrotele.teleop.slave_table import SlaveState

_LENGTHS = ("m", "m", "m", "rad", "rad", "rad")
_FORCES = ("N", "N", "N", "N m", "N m", "N m")
_STIFFNESS = ("N/m", "N/m", "N/m", "N m/rad", "N m/rad", "N m/rad")
_TASK = {"r": ("m", "N"), "theta": ("rad", "N m"), "z": ("m", "N"), "attitude": ("rad", "N m"),
         "head": ("rad", "N m")}  # fmt: skip


class StationLog:
    """Arrays over the run, of n ticks.

    Attributes:
        coordinates: k task coordinates.
        force: (n, k) at the tip as it is felt, task coordinates [N], [N m].
        muscles: (n, 6) forces of the operator on the handle [N], [N m].
        touching: (n,) whether the machine touches something.
    """

    def __init__(
        self, ticks: int, coordinates: tuple[str, ...], m: MasterState, s: SlaveState
    ) -> None:
        """Make room.

        Args:
            ticks: number of control ticks.
            coordinates: task coordinates of the arm.
            m: the master's state, which is kept every tick.
            s: the slave's.
        """
        self.coordinates = coordinates
        self._m, self._s, self._one, self._two = m, s, flat_view(m), flat_view(s)
        self._master = np.zeros((ticks, len(self._one)))
        self._slave = np.zeros((ticks, len(self._two)))
        self.force, self.muscles = np.zeros((ticks, len(coordinates))), np.zeros((ticks, 6))
        self.touching = np.zeros(ticks, bool)

    def take(self, tick: int, force: np.ndarray, muscles: np.ndarray, touching: bool) -> None:
        """Keep what stands after the operator's half of a tick."""
        self._master[tick], self._slave[tick] = self._one, self._two
        self.force[tick], self.muscles[tick], self.touching[tick] = force, muscles, touching

    def cut(self, ticks: int) -> None:
        """Keep the first ticks only."""
        self._master, self._slave = self._master[:ticks], self._slave[:ticks]
        self.force, self.muscles = self.force[:ticks], self.muscles[:ticks]
        self.touching = self.touching[:ticks]

    def master(self, name: str) -> np.ndarray:
        """(n, ...) of a field of MasterState, as `handle`."""
        return _field(self._master, self._m, name)

    def slave(self, name: str) -> np.ndarray:
        """(n, ...) of a field of SlaveState, as `pose`."""
        return _field(self._slave, self._s, name)

    def channels(self, every: int, rows: int) -> tuple[dict[str, np.ndarray], dict[str, str]]:
        """Channels of the measured log.

        Args:
            every: control ticks per row.
            rows: number of rows.

        Returns:
            (channel -> (rows,), channel -> unit).
        """
        values: dict[str, np.ndarray] = {}
        units: dict[str, str] = {}
        pick = slice(0, rows * every, every)

        def put(name: str, column: np.ndarray, unit: str) -> None:
            values[name], units[name] = column[pick].copy(), unit

        handle, hand, push = self.master("handle"), self.master("hand"), self.master("push")
        stiffness, current = self.master("stiffness"), self.master("currents")
        for i, axis in enumerate(AXES):
            put(f"handle.{axis}", handle[:, i], _LENGTHS[i])
            put(f"hand_force.{axis}", hand[:, i], _FORCES[i])
            put(f"handle_force.{axis}", push[:, i], _FORCES[i])
            put(f"handle_stiffness.{axis}", stiffness[:, i], _STIFFNESS[i])
            put(f"coil_current.coil_{i + 1}", current[:, i], "A")
        pose, seen = self.slave("pose"), self.slave("measured")
        for i, name in enumerate(self.coordinates):
            place, force = _TASK[name]
            put(f"tip_force.{name}", self.force[:, i], force)
            put(f"tip_reference.{name}", pose[:, i], place)
            put(f"tip_pose.{name}", seen[:, 0, i], place)
        return values, units


def _field(table: np.ndarray, state, name: str) -> np.ndarray:
    first = 0
    for part, key in zip(state, state._fields, strict=True):
        if key == name:
            return table[:, first : first + part.size].reshape(len(table), *part.shape)
        first += part.size
    raise KeyError(name)
