"""Recorded signals of the teleoperation loop by control tick, and their channels for the logs."""

import numpy as np

from hydrotele.core.contiguous_state import flat_view
from hydrotele.machine.joystick import AXES
from hydrotele.teleop.master import MasterState
from hydrotele.teleop.slave import (
    SlaveState,
)

_DISPLACEMENT_UNITS = ("m", "m", "m", "rad", "rad", "rad")
_FORCES = ("N", "N", "N", "N m", "N m", "N m")
_STIFFNESS = ("N/m", "N/m", "N/m", "N m/rad", "N m/rad", "N m/rad")
_TASK_UNITS = {"r": ("m", "N"), "theta": ("rad", "N m"), "z": ("m", "N"), "attitude": ("rad", "N m"),
         "head": ("rad", "N m")}  # fmt: skip


class TeleoperationLog:
    """Recorded signals of the teleoperation loop in a run of n control ticks.

    Attributes:
        coordinates: k task coordinates.
        force: (n, k) estimated tip force, task coordinates [N], [N m].
        muscles: (n, 6) forces of the operator on the handle [N], [N m].
        touching: (n,) whether the machine is in contact.
    """

    def __init__(self, ticks: int, coordinates: tuple[str, ...], m: MasterState, s: SlaveState) -> None:
        """Allocate the arrays for the signals of a run.

        Args:
            ticks: number of control ticks.
            coordinates: task coordinates of the arm.
            m: state of the master, which is recorded every tick.
            s: state of the slave, which is recorded every tick.
        """
        self.coordinates = coordinates
        self._m, self._s, self._master_view, self._slave_view = m, s, flat_view(m), flat_view(s)
        self._master = np.zeros((ticks, len(self._master_view)))
        self._slave = np.zeros((ticks, len(self._slave_view)))
        self.force, self.muscles = np.zeros((ticks, len(coordinates))), np.zeros((ticks, 6))
        self.touching = np.zeros(ticks, np.int64)

    def tick_arrays(self) -> dict[str, np.ndarray]:
        """Return name -> array to which the compiled loop (`step_teleoperation`) writes a row per tick."""
        return {"log_master": self._master, "log_slave": self._slave, "log_force": self.force,
                "log_muscles": self.muscles, "touching": self.touching}  # fmt: skip

    def truncate(self, ticks: int) -> None:
        """Discard all rows after the first `ticks`, for a run that ended early."""
        self._master, self._slave = self._master[:ticks], self._slave[:ticks]
        self.force, self.muscles = self.force[:ticks], self.muscles[:ticks]
        self.touching = self.touching[:ticks]

    def master(self, name: str) -> np.ndarray:
        """Return the recorded history (n, ...) of a field of MasterState, such as `handle`."""
        return _state_field(self._master, self._m, name)

    def slave(self, name: str) -> np.ndarray:
        """Return the recorded history (n, ...) of a field of SlaveState, such as `pose`."""
        return _state_field(self._slave, self._s, name)

    def channels(self, every: int, rows: int) -> tuple[dict[str, np.ndarray], dict[str, str]]:
        """Return the recorded signals as channels of the run's log, at the rate of the log.

        Args:
            every: control ticks per row of the log; the signals are sampled, not averaged.
            rows: number of rows of the log.

        Returns:
            Two dictionaries: channel name -> (rows,) values, and channel name -> unit.
        """
        values: dict[str, np.ndarray] = {}
        units: dict[str, str] = {}
        pick = slice(0, rows * every, every)

        def add_channel(name: str, column: np.ndarray, unit: str) -> None:
            values[name], units[name] = column[pick].copy(), unit

        handle, hand, push = self.master("handle"), self.master("hand"), self.master("push")
        stiffness, current = self.master("stiffness"), self.master("currents")
        for i, axis in enumerate(AXES):
            add_channel(f"handle.{axis}", handle[:, i], _DISPLACEMENT_UNITS[i])
            add_channel(f"hand_force.{axis}", hand[:, i], _FORCES[i])
            add_channel(f"handle_force.{axis}", push[:, i], _FORCES[i])
            add_channel(f"handle_stiffness.{axis}", stiffness[:, i], _STIFFNESS[i])
            add_channel(f"coil_current.coil_{i + 1}", current[:, i], "A")
        pose, seen = self.slave("pose"), self.slave("measured")
        for i, name in enumerate(self.coordinates):
            place, force = _TASK_UNITS[name]
            add_channel(f"tip_force.{name}", self.force[:, i], force)
            add_channel(f"tip_reference.{name}", pose[:, i], place)
            add_channel(f"tip_pose.{name}", seen[:, 0, i], place)
        return values, units


def _state_field(table: np.ndarray, state, name: str) -> np.ndarray:
    first = 0
    for part, key in zip(state, state._fields, strict=True):
        if key == name:
            return table[:, first : first + part.size].reshape(len(table), *part.shape)
        first += part.size
    raise KeyError(name)
