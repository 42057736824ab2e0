"""Force at the tip of an arm, felt through the pressures of its drives.

The static estimate takes the torque of gravity, linear in a few identified parameters, off that of
the drives (Zhu 1994, 6.1). The dynamic one takes off all that the motion needs: inertia, Coriolis
forces, friction, and the closed chains with their cylinders. Positions and forces pass the same
filter, so that both sides of the balance are equally late.
"""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from hydrotele.compiled import lean
from hydrotele.dynamics.mechanism import coordinate_names
from hydrotele.dynamics.model import reduced_model
from hydrotele.errors import InputError
from hydrotele.hydraulics.circuit import Slot
from hydrotele.hydraulics.parameters import actuator_numbers, actuator_order
from hydrotele.log import Log
from hydrotele.machine import Machine
from hydrotele.operate.arm_tables import arm_tables
from hydrotele.operate.gravity_model import Gravity, gravity_from_masses
from hydrotele.operate.state_filter import (
    CHANGE,
    LAST,
    LOW,
    RATE,
    filter_step,
    filter_table,
    noise_gains,
)
from hydrotele.operate.tip_balance import dynamic_balance, static_balance, tip_force

Kind = Literal["static", "dynamic"]
BANDWIDTH = 2.0  # Hz
_TASK = ("r", "theta", "z", "attitude", "head")
_WAITING, _GOOD, _BAD, _SINGULAR = range(4)


class Readings(NamedTuple):
    """How readings become filtered states; n independent coordinates, h valves.

    Attributes:
        table: (3, 5) of the filter.
        position: (n,) column of every coordinate's joint among the readings.
        valve: (h,) column of every valve's axis.
        area: (h, 2) areas of head and rod side [m^2] or [m^3/rad].
        state: (n + h, 4) of the filters: positions, then forces.
        last: (3, k) last good readings of joint, head and rod; NaN before the first.
        still: (3, k) calls since a reading changed.
    """

    table: np.ndarray
    position: np.ndarray
    valve: np.ndarray
    area: np.ndarray
    state: np.ndarray
    last: np.ndarray
    still: np.ndarray


@lean
def endpoint_force_step(arm, readings, dynamic, begun, joint, head, rod, out):
    """Take in the readings of one moment; force at the tip.

    Args:
        arm: Arm.
        readings: Readings.
        dynamic: whether the complete model is used, or gravity alone; scalar.
        begun: whether there was a moment before; scalar.
        joint: (k,) measured joint positions [rad] or [m].
        head: (k,) head-side pressures [Pa].
        rod: (k,) rod-side pressures [Pa].
        out: (m,) written: r [N], theta [N m], z [N], then attitude and head [N m].

    Returns:
        0 before every channel has read once, 1, 2 where a reading was not finite and the last one
        was taken, 3 where the arm is singular and `out` is left alone.

    Source: Zhu 1994, 6.1.
    """
    good = _take(readings.last[0], readings.still[0], readings.position, joint)
    good = _take(readings.last[1], readings.still[1], readings.valve, head) and good
    good = _take(readings.last[2], readings.still[2], readings.valve, rod) and good
    if not _known(readings):
        return _WAITING
    n, h, state = len(readings.position), len(readings.valve), readings.state
    first = n + len(arm.model.transmission)
    for c in range(n + h):
        if c < n:
            value = readings.last[0, readings.position[c]]
        else:
            i = c - n
            value = readings.area[i, 0] * readings.last[1, readings.valve[i]]
            value -= readings.area[i, 1] * readings.last[2, readings.valve[i]]
        if not begun:
            state[c, LOW], state[c, RATE], state[c, CHANGE], state[c, LAST] = value, 0.0, 0.0, value
        filter_step(readings.table, state[c], value)
        if c < n:
            arm.z[c] = state[c, LOW]
            arm.z[first + c] = state[c, RATE] if dynamic else 0.0
            arm.acceleration[c] = state[c, CHANGE]
        else:
            arm.push[c - n] = state[c, LOW]
    if dynamic:
        dynamic_balance(arm)
    else:
        static_balance(arm)
    if not tip_force(arm, out):
        return _SINGULAR
    return _GOOD if good else _BAD


@lean
def _take(last, still, used, values):
    """Keep readings that are finite; False if one that is used is not."""
    good = True
    for c in range(len(used)):
        i = used[c]
        if not math.isfinite(values[i]):
            good = False
            still[i] += 1
        elif values[i] == last[i]:
            still[i] += 1
        else:
            last[i] = values[i]
            still[i] = 0
    return good


@lean
def _known(readings):
    """Whether all channels that are used have read once."""
    for i in readings.position:
        if math.isnan(readings.last[0, i]):
            return False
    for i in readings.valve:
        if math.isnan(readings.last[1, i]) or math.isnan(readings.last[2, i]):
            return False
    return True


class EndpointForce:
    """Online estimate of the force of the environment on the tip of an arm.

    Attributes:
        axes: axes of the readings.
        task: what the force acts along: r [N], theta [N m], z [N], attitude, head [N m].
        bandwidth: of the filter [Hz].
        force: (m,) last estimate; 0 until every channel has read once.
        healthy: whether all readings of the last update were finite and the arm was not singular.
    """

    def __init__(
        self, machine: Machine, axes: Sequence[str], kind: Kind = "dynamic",
        period: float = 0.005, *, gravity: Gravity | None = None, bandwidth: float = BANDWIDTH,
        angle_noise: float = 0.0,
    ):  # fmt: skip
        """Lay out what every update needs.

        Args:
            machine: with an arm whose joints are driven by valves.
            axes: order of the readings, as `Feedback.joint`.
            kind: `static` knows gravity only, `dynamic` the complete model.
            period: time between two updates [s].
            gravity: parameters of the static model; those of the machine's masses if None.
            bandwidth: of the filter [Hz].
            angle_noise: standard deviation of the joint readings [rad] or [m], by which the sign
                of a slow motion, and with it friction, is uncertain.

        Raises:
            InputError: a joint is not driven, not by a valve, or not measured; a number makes no
                sense.
        """
        where = f"end-point force of {machine.name}"
        if kind not in ("static", "dynamic"):
            raise InputError(where, f"kind must be static or dynamic, got {kind!r}")
        if not (period > 0.0 and 0.0 < bandwidth < 0.5 / period):
            raise InputError(where, f"{bandwidth} Hz must lie below half of 1/{period} Hz")
        self.axes, self.bandwidth, self.healthy = tuple(axes), bandwidth, True
        self._dynamic, self._begun, self._period = kind == "dynamic", False, period
        self._arm = arm_tables(machine, self.axes, where)
        joints = len(self._arm.joint)
        if not self._dynamic:
            found = gravity or gravity_from_masses(machine)
            if len(found.value) != len(self._arm.gravity):
                raise InputError(where, f"gravity needs {len(self._arm.gravity)} parameters")
            self._arm.gravity[:] = found.value
        noise = noise_gains(bandwidth, period)[1] * angle_noise
        self._arm.rate_noise[:] = noise
        self._readings = _readings(machine, self.axes, filter_table(bandwidth, period))
        self.task, self.force = _TASK[:joints], np.zeros(joints)

    def update(self, joint: np.ndarray, head: np.ndarray, rod: np.ndarray) -> np.ndarray:
        """Take in the readings of one moment.

        A reading that is not finite is replaced by the last good one of its channel, and `healthy`
        is then False.

        Args:
            joint: (k,) measured joint positions [rad] or [m], in the order of `axes`.
            head: (k,) head-side pressures [Pa]; ignored where there is no valve.
            rod: (k,) rod-side pressures [Pa].

        Returns:
            (m,) force of the environment on the machine along `task`; the same array every time.
        """
        status = endpoint_force_step(
            self._arm, self._readings, self._dynamic, self._begun, joint, head, rod, self.force
        )
        self._begun = self._begun or status != _WAITING
        self.healthy = status == _GOOD
        return self.force

    def frozen(self, duration: float = 0.5) -> tuple[str, ...]:
        """Channels whose readings have not changed for a while, as a stuck sensor's.

        Args:
            duration: for how long [s]. Real sensors never read the same twice for long; ideal ones
                of a machine at rest do.

        Returns:
            Names such as `angle.boom`, `pressure_head.boom`.
        """
        r, calls = self._readings, duration / self._period
        kinds = (("joint", r.position), ("pressure_head", r.valve), ("pressure_rod", r.valve))
        return tuple(
            f"{kind}.{self.axes[i]}"
            for row, (kind, used) in enumerate(kinds)
            for i in sorted(used)
            if r.still[row, i] >= calls
        )


def _readings(machine: Machine, axes: tuple[str, ...], table: np.ndarray) -> Readings:
    """Where the readings are and the filters they go through."""
    names, model = coordinate_names(machine), reduced_model(machine, ())
    driver = {axis.joint: name for name, axis in machine.axes.items()}
    valves = actuator_order(machine)[: model.hydraulic]
    numbers = actuator_numbers(machine)
    k, n = len(axes), len(model.mech.free)
    return Readings(
        table=table,
        position=np.array([axes.index(driver[names[i]]) for i in model.mech.free]),
        valve=np.array([axes.index(name) for name in valves]),
        area=np.array([numbers[v][[Slot.AREA_HEAD, Slot.AREA_ROD]] for v in valves]),
        state=np.zeros((n + len(valves), 4)),
        last=np.full((3, k), np.nan),
        still=np.zeros((3, k), int),
    )


def endpoint_force_of_log(
    machine: Machine, log: Log, kind: Kind = "dynamic", gravity: Gravity | None = None,
    bandwidth: float = BANDWIDTH,
) -> dict[str, np.ndarray]:  # fmt: skip
    """The online estimate over a log, one update per row.

    Args:
        machine: the machine.
        log: positions and pressures of all its axes, measured.
        kind: see `EndpointForce`.
        gravity: see `EndpointForce`.
        bandwidth: see `EndpointForce`.

    Returns:
        `r` [N], `theta` [N m], `z` [N], `attitude` [N m] ... and `healthy` [1], (n,) each.

    Raises:
        InputError: a channel is missing, or the arm cannot be felt.
    """
    axes = tuple(machine.axes)
    joint = np.column_stack([log[f"{machine.position_kind(a)}.{a}"] for a in axes])
    head, rod = np.zeros_like(joint), np.zeros_like(joint)
    for i, name in enumerate(axes):
        if name in machine.hydraulic_axes:
            head[:, i], rod[:, i] = log[f"pressure_head.{name}"], log[f"pressure_rod.{name}"]
    felt = EndpointForce(machine, axes, kind, 1.0 / log.rate, gravity=gravity, bandwidth=bandwidth)
    out, healthy = np.empty((len(log), len(felt.task))), np.empty(len(log))
    for row in range(len(log)):
        out[row] = felt.update(joint[row], head[row], rod[row])
        healthy[row] = felt.healthy
    return {**dict(zip(felt.task, out.T, strict=True)), "healthy": healthy}
