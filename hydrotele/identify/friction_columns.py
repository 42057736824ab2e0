"""Friction of the drives as columns of a regressor: the law of `hydraulics.laws`, taken apart."""

from typing import NamedTuple

import numpy as np

from hydrotele.drives import ForceDrive, Friction
from hydrotele.hydraulics.parameters import actuator_order
from hydrotele.machine import Machine


class Columns(NamedTuple):
    """A part of a regressor: see `regressor.Regressor`.

    Attributes:
        matrix: (n, k, m).
        names: the m parameters.
        units: (m,) SI units.
        nominal: (m,) values in the machine.
    """

    matrix: np.ndarray
    names: tuple[str, ...]
    units: tuple[str, ...]
    nominal: np.ndarray


def friction_columns(machine: Machine, velocities: np.ndarray) -> Columns:
    """Coulomb, viscous and offset columns of every drive, and the others that its friction uses.

    `stribeck` and the asymmetries `coulomb_asymmetry` (F_c a_c), `stribeck_asymmetry` (F_s a_c) and
    `viscous_asymmetry` (b a_v) are there where they are not 0. The velocities in the shapes of the
    Coulomb and Stribeck parts are the machine's.

    Args:
        machine: the machine.
        velocities: (n, k) of the drives, in actuator order [m/s] or [rad/s].

    Returns:
        The columns; their sum with nominal values is `hydraulics.laws.friction` and, of a plain
        force drive, its offset.

    Source: nominal model, "Piston force", without the speeds that make it nonlinear.
    """
    blocks, names, units, nominal = [], [], [], []
    for i, name in enumerate(actuator_order(machine)):
        drive = machine.axes[name].drive
        rotary = not machine.axes[name].cylinder and machine.position_kind(name) == "angle"
        force = "N m" if rotary else "N"
        slope = "N m s/rad" if rotary else "N s/m"
        for kind, (value, column) in _parts(drive.friction, velocities[:, i]).items():
            if value == 0.0 and kind not in ("coulomb", "viscous"):
                continue
            blocks.append(_column(column, i, velocities.shape[1]))
            names.append(f"{kind}.{name}")
            units.append(slope if kind.startswith("viscous") else force)
            nominal.append(value)
        blocks.append(_column(np.ones(len(velocities)), i, velocities.shape[1]))
        names.append(f"offset.{name}")
        units.append(force)
        nominal.append(drive.offset if isinstance(drive, ForceDrive) else 0.0)
    matrix = np.stack(blocks, axis=2)
    return Columns(matrix, tuple(names), tuple(units), np.array(nominal))


def _parts(friction: Friction, velocity: np.ndarray) -> dict[str, tuple[float, np.ndarray]]:
    """Parameter -> (its value, what one unit of it does at every velocity)."""
    way = np.tanh(velocity / friction.smoothing_velocity)
    slow = np.exp(-((velocity / friction.stribeck_velocity) ** 2))
    dry, wet = friction.coulomb_asymmetry, friction.viscous_asymmetry
    return {
        "coulomb": (friction.coulomb, way),
        "stribeck": (friction.stribeck_extra, slow * way),
        "coulomb_asymmetry": (friction.coulomb * dry, way**2),
        "stribeck_asymmetry": (friction.stribeck_extra * dry, slow * way**2),
        "viscous": (friction.viscous, velocity),
        "viscous_asymmetry": (friction.viscous * wet, velocity * way),
    }


def _column(values: np.ndarray, place: int, count: int) -> np.ndarray:
    column = np.zeros((len(values), count))
    column[:, place] = values
    return column
