"""What a plan may ask of a machine: ranges of joints, commands of drives, the time of the run."""

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.machine.machine import Machine

_FARTHEST = 1.0e6  # rad or m, of a joint without a range
_ROUNDING = 1.0e-3  # of a command, as `signals` allows real loggers


def check_reference(machine: Machine, name: str, time: np.ndarray, reference: np.ndarray) -> None:
    """Refuse a joint reference that is not finite or leaves the joint's range.

    Args:
        machine: the machine.
        name: axis name.
        time: (n,) [s].
        reference: (n,) [rad] or [m].

    Raises:
        InputError: names axis, value, time and range.
    """
    low, high = machine.joints[machine.axes[name].joint].range or (-_FARTHEST, _FARTHEST)
    outside = np.flatnonzero(~((low - 1e-9 <= reference) & (reference <= high + 1e-9)))
    if len(outside):
        row = outside[0]
        raise InputError(
            "pilot",
            f"asks {name} for {reference[row]:.4g} at {time[row]:.4g} s, its joint allows"
            f" {low:.4g} .. {high:.4g}",
        )


def check_command(machine: Machine, name: str, command: np.ndarray) -> None:
    """Refuse a command beyond what the drive takes.

    Args:
        machine: the machine.
        name: axis name.
        command: (n,) valve command [1], or in the force drive's unit.

    Raises:
        InputError: names axis, value and limit.
    """
    force = machine.axes[name].force
    limit, unit = (force.command_limit, force.command_unit) if force else (1.0, "1")
    if len(outside := np.flatnonzero(~(np.abs(command) <= limit + _ROUNDING))):
        raise InputError(
            "pilot",
            f"commands {name} with {command[outside[0]]:g}, its drive takes -{limit:g} .. {limit:g}"
            f" [{unit}]",
        )


def cut_short(time: np.ndarray, needed: float) -> tuple[str, ...]:
    """A note where a pilot is not through when the run ends.

    Args:
        time: (n,) control ticks [s].
        needed: time that the pilot needs [s].

    Returns:
        One sentence, or nothing.
    """
    missing = needed - (2 * time[-1] - time[-2])
    return (f"the run ends {missing:.3g} s before its pilot",) if missing > 1e-6 else ()
