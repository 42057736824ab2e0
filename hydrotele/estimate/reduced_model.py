"""The reduced model of a Machine: its mechanism, drives, delays and sensors as flat arrays."""

from typing import NamedTuple

import numpy as np

from hydrotele.hydraulics.circuit import NO_MEMORY, SCRATCH
from hydrotele.hydraulics.parameters import (
    actuator_order,
    actuator_parameters,
    extra_state_names,
    terms_of,
)
from hydrotele.machine.machine import Machine
from hydrotele.machine.sensors import SensorError
from hydrotele.machine.signals import parse_channel
from hydrotele.multibody.reduced_mechanism import (
    ReducedMechanism,
    ReducedMotion,
    coordinate_names,
    mechanism,
    motion_space,
)

POSITION, LENGTH, HEAD, ROD, SUPPLY = range(5)
_KINDS = {
    "angle": POSITION, "position": POSITION, "length": LENGTH, "pressure_head": HEAD,
    "pressure_rod": ROD, "pressure_supply": SUPPLY,
}  # fmt: skip
GEAR_INERTIA, STIFFNESS, GEAR_DAMPING, BACKLASH = range(4)  # columns of `transmission`
X, V, COMMAND, GIVEN, INERTIA = range(5)  # rows of `Space.drive`


class Model(NamedTuple):
    """Numbers of the reduced model; n independent coordinates, t transmissions, h valves.

    A state is `(n positions, t drive positions, n rates, t drive rates, 4 h activations)` and what
    bristles, a slow pump and terms remember, see `parameters.extra_state_names`. Its pressures are
    those that the oil would have if it held its air (`laws.pressure_without_air`): any number is
    one, which a filter needs, and they are the felt ones wherever these are not below the
    atmosphere's.

    Attributes:
        mech: the mechanism.
        user: (nu * SLOTS,) actuator numbers.
        hydraulic: h, number of valves, which come first.
        gain: (nu,) force per command of the plain force drives, 0 for valves [N/V].
        delay: (nu,) command delays [s].
        gear: (nu,) transmission of every drive, -1 if rigid.
        transmission: (t, 4) GEAR_INERTIA, STIFFNESS, GEAR_DAMPING, BACKLASH in SI.
        kind: (c,) what every channel shows: POSITION, LENGTH, HEAD, ROD or SUPPLY.
        drive: (c,) drive of every channel.
        scale: (c,) sensor scales [1].
        offset: (c,) sensor offsets [channel's unit].
        lag: (c,) sensor delays [s].
        terms: (k,) table of the machine's terms, see `terms.table`.
        time_constant: (c,) time constants of the sensors' first-order lags [s].
        memory: number of states that follow the activations; NO_MEMORY, and not 0, where there are
            none: what needs them is then left out.
    """

    mech: ReducedMechanism
    user: np.ndarray
    hydraulic: int
    gain: np.ndarray
    delay: np.ndarray
    gear: np.ndarray
    transmission: np.ndarray
    kind: np.ndarray
    drive: np.ndarray
    scale: np.ndarray
    offset: np.ndarray
    lag: np.ndarray
    terms: np.ndarray
    time_constant: np.ndarray
    memory: int


class Space(NamedTuple):
    """Work space of the reduced model.

    Attributes:
        motion: work space of the mechanism.
        drive: (5, nu) of every drive: position X [m] or [rad], velocity V, COMMAND that arrived,
            that with its terms as GIVEN to the valve, and where it has bristles the INERTIA that it
            moves [kg] or [kg m^2], of which other drives at rest are part.
        row: (nu, n) d(load-side drive velocity) / d(independent rates).
        mass: (n + t, n + t) mass matrix, then its factor.
        force: (n + t,) forces, then acceleration.
        act: (4 h + memory,) activations and what is remembered, with the pressures that are felt.
        act_dot: (4 h + memory,) rates of `act`.
        scratch: (SCRATCH,) work space of the circuit.
        time: (2,) now, and of the run's first row; only terms see it [s].
    """

    motion: ReducedMotion
    drive: np.ndarray
    row: np.ndarray
    mass: np.ndarray
    force: np.ndarray
    act: np.ndarray
    act_dot: np.ndarray
    scratch: np.ndarray
    time: np.ndarray


def predicted_channels(machine: Machine) -> tuple[str, ...]:
    """Channels that the reduced model predicts: positions, lengths, pressures, supply."""
    order = actuator_order(machine)
    valves = list(machine.hydraulic_axes)
    names = [f"{machine.position_kind(a)}.{a}" for a in order]
    names += [f"length.{a}" for a in order if machine.axes[a].cylinder]
    names += [f"pressure_{side}.{a}" for a in valves for side in ("head", "rod")]
    return (*names, "pressure_supply") if machine.valve_axes else tuple(names)


def reduced_model(machine: Machine, channels: tuple[str, ...]) -> Model:
    """Reduced model of a machine for some of its channels.

    Args:
        machine: the machine.
        channels: names out of `predicted_channels(machine)`.

    Returns:
        The model.
    """
    order = actuator_order(machine)
    axes = [machine.axes[name] for name in order]
    gears = [axis.transmission for axis in axes if axis.transmission]
    parsed = [parse_channel(name) for name in channels]
    errors = [machine.sensor_errors.get(name, SensorError()) for name in channels]
    index, count = [], 0
    for axis in axes:
        index.append(count if axis.transmission else -1)
        count += axis.transmission is not None
    return Model(
        mech=mechanism(machine),
        user=np.concatenate(list(actuator_parameters(machine).values())),
        hydraulic=len(machine.hydraulic_axes),
        gain=np.array([axis.force.gain if axis.force else 0.0 for axis in axes]),
        delay=np.array([axis.command_delay for axis in axes], float),
        gear=np.array(index, int),
        transmission=np.array(
            [(g.inertia, g.stiffness, g.damping, g.backlash) for g in gears], float
        ).reshape(-1, 4),
        kind=np.array([_KINDS[c.kind] for c in parsed], int),
        drive=np.array([order.index(c.axis) if c.axis else 0 for c in parsed], int),
        scale=np.array([e.scale for e in errors], float),
        offset=np.array([e.offset for e in errors], float),
        lag=np.array([e.delay for e in errors], float),
        terms=terms_of(machine),
        time_constant=np.array([e.time_constant for e in errors], float),
        memory=len(extra_state_names(machine)) or NO_MEMORY,
    )


def model_space(model: Model) -> Space:
    """Fresh work space for a model."""
    nu, n, acts = len(model.gear), len(model.mech.free), 4 * model.hydraulic + max(model.memory, 0)
    total = n + len(model.transmission)
    return Space(
        motion_space(model.mech), np.zeros((5, nu)), np.zeros((nu, n)), np.zeros((total, total)),
        np.zeros(total), np.zeros(acts), np.zeros(acts), np.zeros(SCRATCH), np.zeros(2),
    )  # fmt: skip


def state_size(model: Model) -> int:
    """Number of states."""
    moving = 2 * (len(model.mech.free) + len(model.transmission))
    return moving + 4 * model.hydraulic + max(model.memory, 0)


def state_names(machine: Machine) -> list[str]:
    """Names of the states of `reduced_model(machine, ...)`, such as `rate.boom`, `spool.boom`."""
    names, mech = coordinate_names(machine), mechanism(machine)
    free = [names[i] for i in mech.free]
    gears = [n for n in actuator_order(machine) if machine.axes[n].transmission]
    out = [f"position.{n}" for n in free] + [f"drive.{n}" for n in gears]
    out += [f"rate.{n}" for n in free] + [f"drive_rate.{n}" for n in gears]
    for name, axis in machine.hydraulic_axes.items():
        kinds = ("speed", "pressure_load") if axis.pump else ("spool", "spool_rate")
        out += [f"{k}.{name}" for k in (*kinds, "pressure_head", "pressure_rod")]
    return out + extra_state_names(machine)
