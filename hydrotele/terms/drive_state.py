"""State of a drive at an instant in SI units, and the names of its variables in files."""

from typing import NamedTuple

import numpy as np

from hydrotele.core.datafile import (
    suggest_valid_name,
)


class DriveState(NamedTuple):
    """Physical variables of one drive at an instant, all in SI units.

    Attributes:
        time: time since the start of the run [s].
        position: piston displacement or motor angle [m] or [rad].
        velocity: velocity of the piston or motor [m/s] or [rad/s].
        spool: spool position [1]; this and the next three variables are 0 without a valve. For a
            drive with its own pump it is the pump speed [rad/s], `pump_speed` in files.
        spool_rate: rate of the spool [1/s]. For a drive with its own pump it is the pressure in its
            load cylinder [Pa], `pressure_load` in files.
        pressure_head: pressure of the head-side chamber, or port A of a motor [Pa].
        pressure_rod: pressure of the rod-side chamber, or port B [Pa].
        pressure_supply: pressure at the inlet of the valves [Pa].
        command: command to the valve or drive after its delay, without terms [1], [V] or [N].
        force: force of the oil on the piston, or of a force drive, before friction [N] or [N m].
        play_output: output of the term's backlash operator (`play`) [unit of its variable]; 0
            without.
        play_difference: the variable of the backlash operator minus its output, at most half the
            backlash width in magnitude [unit of the variable]; 0 without.
    """

    time: float
    position: float
    velocity: float
    spool: float
    spool_rate: float
    pressure_head: float
    pressure_rod: float
    pressure_supply: float
    command: float
    force: float
    play_output: float
    play_difference: float


class Drives(NamedTuple):
    """States of all nu drives, for the hydraulic step and for laws that use variables of another drive.

    Attributes:
        count: number of hydraulic drives, which come first.
        act: (>= 4 count,) spool [1], spool rate [1/s], head- and rod-side pressure [Pa] of each
            hydraulic drive; then the additional states.
        position: (nu,) piston displacements or motor angles [m] or [rad].
        velocity: (nu,) their rates [m/s] or [rad/s].
        command: (nu,) commands after their delays [1] or [V].
    """

    count: int
    act: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    command: np.ndarray


NO_DRIVES = Drives(0, np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0))
"""For laws that use no variables of other drives."""
VARIABLES = {name: index for index, name in enumerate(DriveState._fields)}
"""Name of a state variable in files -> its index in `DriveState`."""
VARIABLES |= {"pump_speed": VARIABLES["spool"], "pressure_load": VARIABLES["spool_rate"]}
_RENAMED_VARIABLES = {"played": "play_output", "ahead": "play_difference"}


def suggest_valid_variable(name: str) -> str:
    """Return a hint for an error message: the closest name of a state variable, and all valid names."""
    return suggest_valid_name(name, VARIABLES, _RENAMED_VARIABLES)
