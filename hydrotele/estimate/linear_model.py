"""Linear state-space models of a Machine: mechanism and hydraulics about a pose and a speed.

The model is the derivative of the reduced model (`estimate.reduced_model`), which has the closed
chains, chambers, valves and pumps of the simulated machine. Central differences of its time step h
give the matrices F and G of `x(t + h) = F x + G u`. The matrix logarithm of `[[F, G], [0, 1]]`
divided by h gives A and B of `dx/dt = A x + B u`.

Source: Van Loan 1978, "Computing integrals involving the matrix exponential", IEEE Trans. Automatic
Control 23(3), for the augmented matrix; operating point of a valve-controlled cylinder: Merritt
1967, chapter 6.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import eig, logm
from scipy.signal import StateSpace

from hydrotele.core.datafile import suggest_valid_name
from hydrotele.core.errors import InputError
from hydrotele.estimate.reduced_model import (
    load_position,
    model_space,
    predicted_channels,
    reduced_model,
    simulate_rows,
    state_names,
)
from hydrotele.hydraulics.actuator_layout import actuator_order
from hydrotele.hydraulics.circuit import ACTIVATIONS_PER_AXIS
from hydrotele.machine.drives import Axis
from hydrotele.machine.machine import Machine

REST_PRESSURE = 2.0e6  # Pa, in the unloaded chamber of an axis at rest, as in `simulate.plant`
_STEP = 1.0e-6  # s, time step h; the fastest time constants of chambers and stops are 100 times longer
_MAX_ACCELERATION = 1.0e-5  # rad/s^2 or m/s^2, residual of an operating point
_MAX_PRESSURE_RATE = 1.0e2  # Pa/s, residual of an operating point
_MIN_FREQUENCY = 1.0e-3  # Hz; slower pairs of poles are position integrators, split by rounding errors

# Perturbations of the differences, by the kind of a state: small against its range, and large
# against the rounding errors of a step. The unit is that of the state.
_PERTURBATIONS = {
    "position": 1e-4, "drive": 1e-5, "rate": 1e-5, "drive_rate": 1e-5, "spool": 1e-5, "spool_rate": 1e-3,
    "pressure_head": 1e2, "pressure_rod": 1e2,
}  # fmt: skip
_EXTRA_PERTURBATION = 1e-5  # of bristles, delivered fractions and other states of order one [1]


class Mode(NamedTuple):
    """A pole of a linear model, or a pair of complex poles.

    Attributes:
        pole: the pole with non-negative imaginary part [rad/s].
        frequency: natural frequency |pole| / (2 pi) [Hz].
        damping: damping ratio [1]; 1 for a stable real pole, negative for an unstable one.
        axis: axis or joint with the largest participation in the mode.
        is_valve: whether the mode is that of a spool, not of mechanism and oil.
    """

    pole: complex
    frequency: float
    damping: float
    axis: str
    is_valve: bool


@dataclasses.dataclass(frozen=True)
class LinearModel:
    """State space `dx/dt = A x + B u`, `y = C x` of a machine, in deviations from an operating point.

    All values are in SI units: positions [rad] or [m], rates, spools [1], pressures [Pa].

    Attributes:
        machine: name of the machine.
        tool: its tool.
        pose: joint name -> position of the independent joints [rad] or [m].
        speed: axis name -> rate at the operating point [rad/s] or [m/s].
        states: names of the n states, such as `position.boom`, `rate.boom`, `pressure_head.boom`.
        inputs: names of the m inputs: `command.<axis>`, then the external `torque.<joint>` [N m] or
            `force.<joint>` [N] of every independent joint.
        outputs: names of the p outputs: the channels of a log, and `velocity.<axis>`.
        a: (n, n) system matrix.
        b: (n, m) input matrix.
        c: (p, n) output matrix.
        operating_state: (n,) state at the operating point.
        operating_input: (m,) inputs at the operating point.
        operating_output: (p,) outputs at the operating point.
        delay: (m,) delays of the inputs [s]; not part of the matrices.

    Examples:
        Oscillations of the arm of an excavator on its oil columns, and the speed of the boom per valve command:

        >>> import hydrotele as ht
        >>> model = ht.linearise(ht.load_machine("cat215", "bucket"), {"boom": 0.3})
        >>> for mode in model.oscillations:
        ...     print(f"{mode.axis}: {mode.frequency:.1f} Hz, damping ratio {mode.damping:.2f}")
        boom: 2.2 Hz, damping ratio 0.01
        swing: 2.3 Hz, damping ratio 0.08
        stick: 6.3 Hz, damping ratio 0.01
        bucket: 20.3 Hz, damping ratio 0.01
        >>> gain = model.frequency_response([0.1], ["command.boom"], ["velocity.boom"])
        >>> round(float(abs(gain[0, 0, 0])), 2)  # rad/s for the full valve opening, at 0.1 Hz
        0.83
        >>> model.state_space(["command.boom"], ["velocity.boom"]).A.shape
        (24, 24)
    """

    machine: str
    tool: str
    pose: dict[str, float]
    speed: dict[str, float]
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    operating_state: np.ndarray
    operating_input: np.ndarray
    operating_output: np.ndarray
    delay: np.ndarray

    def __repr__(self) -> str:
        """Return machine, pose, speed and sizes of the model."""
        pose = ", ".join(f"{name}={value:g}" for name, value in self.pose.items())
        sizes = f"{len(self.states)} states, {len(self.inputs)} inputs, {len(self.outputs)} outputs"
        return f"LinearModel({self.machine!r}, tool={self.tool!r}, {pose}: {sizes})"

    def state_space(self, inputs: Sequence[str] | None = None, outputs: Sequence[str] | None = None) -> StateSpace:
        """Return the model as `scipy.signal.StateSpace`, without the delays of the inputs.

        Args:
            inputs: names of the inputs to keep; all by default.
            outputs: names of the outputs to keep; all by default.

        Raises:
            InputError: unknown name.
        """
        columns, rows = _find_names(inputs, self.inputs, "input"), _find_names(outputs, self.outputs, "output")
        return StateSpace(self.a, self.b[:, columns], self.c[rows], np.zeros((len(rows), len(columns))))

    def frequency_response(
        self, frequencies: Sequence[float] | np.ndarray, inputs: Sequence[str] | None = None,
        outputs: Sequence[str] | None = None,
    ) -> np.ndarray:  # fmt: skip
        """Compute the frequency response from inputs to outputs, including the delays of the inputs.

        Args:
            frequencies: (f,) frequencies [Hz].
            inputs: names of the inputs; all by default.
            outputs: names of the outputs; all by default.

        Returns:
            (f, outputs, inputs) complex `C (j w - A)^-1 B exp(-j w delay)`.

        Raises:
            InputError: unknown name.
        """
        columns, rows = _find_names(inputs, self.inputs, "input"), _find_names(outputs, self.outputs, "output")
        scale = _balance(self.states)
        a, b, c = (self.a * scale) / scale[:, None], self.b[:, columns] / scale[:, None], self.c[rows] * scale
        found = []
        for w in 2.0 * math.pi * np.asarray(frequencies, float):
            response = c @ np.linalg.solve(1j * w * np.eye(len(a)) - a, b)
            found.append(response * np.exp(-1j * w * self.delay[columns]))
        return np.array(found).reshape(len(found), len(rows), len(columns))

    @functools.cached_property
    def modes(self) -> tuple[Mode, ...]:
        """Poles with natural frequency, damping ratio and axis, by increasing natural frequency.

        The axis of a mode has the largest sum of participation factors, which are the products of
        the entries of its left and right eigenvectors. The mode is that of a valve if spool and
        spool rate have more than half of the sum.
        """
        scale = _balance(self.states)
        poles, left, right = eig((self.a * scale) / scale[:, None], left=True)  # pyright: ignore[reportAssignmentType]
        owners = [name.partition(".")[2] for name in self.states]
        spools = np.array([name.startswith("spool") for name in self.states])
        modes = []
        for k in np.argsort(np.abs(poles), kind="stable"):
            pole, size = complex(poles[k]), abs(poles[k])
            if pole.imag < 0.0:
                continue
            factors = np.abs(left[:, k].conj() * right[:, k])
            totals = {name: sum(f for f, n in zip(factors, owners, strict=True) if n == name) for name in owners}
            damping = -pole.real / size if size > 0.0 else 1.0
            is_valve = bool(factors[spools].sum() > 0.5 * factors.sum())
            owner = max(totals, key=totals.__getitem__)
            modes.append(Mode(pole, float(size / (2.0 * math.pi)), float(damping), owner, is_valve))
        return tuple(modes)

    @property
    def oscillations(self) -> tuple[Mode, ...]:
        """The modes of mechanism and oil with a pair of complex poles."""
        return tuple(m for m in self.modes if m.pole.imag > 0.0 and m.frequency > _MIN_FREQUENCY and not m.is_valve)

    def to_dict(self) -> dict[str, Any]:
        """Return the model as a dictionary of lists and numbers, for JSON."""
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        modes = [
            {
                "frequency_Hz": m.frequency,
                "damping": m.damping,
                "axis": m.axis,
                "is_valve": m.is_valve,
                "pole": [m.pole.real, m.pole.imag],
            }
            for m in self.modes
        ]
        return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in fields.items()} | {"modes": modes}


def linearise(
    machine: Machine, pose: Mapping[str, float] | None = None, speed: float | Mapping[str, float] = 0.0
) -> LinearModel:
    """Compute the linear model of a machine about steady motion through a pose.

    At the operating point the accelerations and the pressure rates are zero, and the valves are
    open as far as the speed requires. Friction, valves and flow limits have their slopes there. The
    slow change of the pose is not part of the model.

    An axis with speed 0 holds its load with a closed valve, with 2 MPa in the unloaded chamber.
    There, dry friction and the dead band would make its linear model that of a locked joint. They
    are therefore left out: the axis has viscous friction only, and a command is what it exceeds the
    dead band by, as a fraction of the travel beyond it. Its gain is the mean of both directions of
    the valve.

    Args:
        machine: the machine.
        pose: joint or axis name -> position [rad] or [m]; others at home. Joints without a drive
            move to their equilibrium.
        speed: rate of all hydraulic axes, or axis name -> rate, others 0 [rad/s] or [m/s].

    Returns:
        The linear model.

    Raises:
        InputError: unknown name, position out of range, no steady motion at this speed, or an axis
            with its own pump, which turns in one direction only and has no linear model.

    Examples:
        The oil columns of the rig are springs, on which the carriage oscillates. They are stiffest near the ends of
        the stroke, where one of the two columns is short.

        >>> import hydrotele as ht
        >>> rig = ht.load_machine("rig")
        >>> for position in 0.05, 0.25, 0.45:
        ...     mode = ht.linearise(rig, {"slide": position}).oscillations[0]
        ...     print(f"{position} m: {mode.frequency:.1f} Hz, damping ratio {mode.damping:.2f}")
        0.05 m: 40.6 Hz, damping ratio 0.01
        0.25 m: 29.5 Hz, damping ratio 0.01
        0.45 m: 31.5 Hz, damping ratio 0.01
    """
    point = _find_operating_point(machine, pose or {}, speed)
    step = point.step
    n, nu = len(point.state), len(point.command)
    deltas = np.array([_PERTURBATIONS.get(name.partition(".")[0], _EXTRA_PERTURBATION) for name in step.states])
    deltas = np.concatenate([deltas, [_EXTRA_PERTURBATION] * nu])
    augmented, c = np.eye(n + nu), np.zeros((len(step.channels), n))
    for k, delta in enumerate(deltas):
        sides = []
        for sign in (1.0, -1.0):
            x = np.concatenate([point.state, point.command])
            x[k] += sign * delta
            sides.append(step.advance(x[:n], x[n:]))
        augmented[:n, k] = (sides[0][0] - sides[1][0]) / (2.0 * delta)
        if k < n:
            c[:, k] = (sides[0][1] - sides[1][1]) / (2.0 * delta)
    scale = np.concatenate([_balance(step.states), np.ones(nu)])
    rates = np.real(np.asarray(logm((augmented * scale) / scale[:, None]))) / _STEP
    rates = (rates * scale[:, None]) / scale
    independent, first = step.joints, len(step.joints) + step.gears
    forces = np.zeros((n, len(independent)))
    forces[first : 2 * first] = np.linalg.inv(step.mass_matrix(point.state, point.command))[:, : len(independent)]
    kinds = ["torque" if machine.joints[name].type == "hinge" else "force" for name in independent]
    velocities = [
        name for name, axis in machine.axes.items()
        if axis.joint in independent and f"velocity.{name}" not in step.channels
    ]  # fmt: skip
    rows = np.zeros((len(velocities), n))
    for row, axis in zip(rows, velocities, strict=True):
        row[step.states.index(f"rate.{machine.axes[axis].joint}")] = 1.0
    _, shown = step.advance(point.state, point.command)
    commands = [f"command.{name}" for name in step.order]
    return LinearModel(
        machine=machine.name,
        tool=machine.tool,
        pose={name: float(v) for name, v in zip(independent, point.state, strict=False)},
        speed=point.speed,
        states=tuple(step.states),
        inputs=(*commands, *(f"{kind}.{name}" for kind, name in zip(kinds, independent, strict=True))),
        outputs=(*step.channels, *(f"velocity.{name}" for name in velocities)),
        a=rates[:n, :n],
        b=np.hstack([rates[:n, n:], forces]),
        c=np.vstack([c, rows]),
        operating_state=point.state,
        operating_input=np.concatenate([point.command, np.zeros(len(independent))]),
        operating_output=np.concatenate([shown, rows @ point.state]),
        delay=np.array([machine.axes[name].command_delay for name in step.order] + [0.0] * len(independent), float),
    )


def _balance(states: Sequence[str]) -> np.ndarray:
    """Return a typical size of every state, which makes the matrices well scaled."""
    return np.array([1e6 if name.startswith("pressure") else 1.0 for name in states])


def _find_names(names: Sequence[str] | None, known: Sequence[str], kind: str) -> list[int]:
    """Return the indices of names in a list; of all if `names` is None.

    Raises:
        InputError: unknown name.
    """
    for name in names or ():
        if name not in known:
            raise InputError(f"{kind} {name!r}", f"is not in the model; {suggest_valid_name(name, known)}")
    return list(range(len(known))) if names is None else [list(known).index(name) for name in names]


class _ReducedStep:
    """One time step of the reduced model of a machine, with ideal sensors.

    Attributes:
        order: names of the axes in actuator order.
        states: names of the states.
        channels: names of the outputs.
        joints: names of the independent joints.
        gears: number of transmissions.
    """

    def __init__(self, machine: Machine) -> None:
        ideal = machine.model_copy(update={"sensor_errors": {}})
        self.order, self.states = actuator_order(machine), state_names(machine)
        self.channels = predicted_channels(machine)
        self.joints = [name[9:] for name in self.states if name.startswith("position.")]
        self.gears = sum(name.startswith("drive.") for name in self.states)
        self._model = reduced_model(ideal, self.channels)
        self._space = model_space(self._model)
        self._out, self._states = np.zeros((2, len(self.channels))), np.zeros((2, len(self.states)))

    def advance(self, state: np.ndarray, command: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the state after one step, and the outputs at the start of the step."""
        z = np.array(state, float)
        simulate_rows(self._model, self._space, z, np.tile(command, (2, 1)), _STEP, 1, self._out, self._states)
        return z, self._out[0].copy()

    def load_position(self, state: np.ndarray, axis: str) -> float:
        """Return the position of the load side of an axis [m] or [rad]."""
        self.advance(state, np.zeros(len(self.order)))
        return float(load_position(self._model, self._space, self.order.index(axis)))

    def load_velocity(self, state: np.ndarray, axis: str) -> float:
        """Return the velocity of the load side of an axis [m/s] or [rad/s]."""
        self.advance(state, np.zeros(len(self.order)))
        first = len(self.joints) + self.gears
        return float(self._space.row[self.order.index(axis)] @ state[first : first + len(self.joints)])

    def rates(self, state: np.ndarray, command: np.ndarray) -> np.ndarray:
        """Return the rates of the states [unit/s]."""
        return (self.advance(state, command)[0] - state) / _STEP

    def mass_matrix(self, state: np.ndarray, command: np.ndarray) -> np.ndarray:
        """Return the mass matrix in the independent coordinates and the drive sides of transmissions."""
        self.advance(state, command)
        factor = np.tril(self._space.mass)
        return factor @ factor.T


class _OperatingPoint(NamedTuple):
    """Operating point: reduced model, state, commands and speeds of the axes."""

    step: _ReducedStep
    state: np.ndarray
    command: np.ndarray
    speed: dict[str, float]


def _find_operating_point(
    machine: Machine, pose: Mapping[str, float], speed: float | Mapping[str, float]
) -> _OperatingPoint:
    """Solve for chamber pressures, valve openings and commands of steady motion through a pose.

    First the drive forces are found with which the accelerations vanish, then for the moving axes
    the pressures and valve openings that give these forces at constant pressures.

    Raises:
        InputError: unknown name, position out of range, or no steady motion at this speed.
    """
    for name, axis in machine.axes.items():
        if axis.pump:
            message = "has its own pump, which turns in one direction only: it has no linear model"
            raise InputError(f"axis {name} of machine {machine.name}", message)
    speeds = _complete_speeds(machine, speed)
    step = _ReducedStep(remove_dry_friction(machine, [n for n in machine.axes if speeds[n] == 0.0]))
    driven = {axis.joint: name for name, axis in machine.axes.items()}
    state, command = np.zeros(len(step.states)), np.zeros(len(step.order))
    state[: len(step.joints)] = _complete_pose(machine, pose, step.joints)
    total, hydraulic = len(step.joints) + step.gears, list(machine.hydraulic_axes)
    for name, axis in machine.axes.items():
        if f"rate.{axis.joint}" in step.states:
            state[step.states.index(f"rate.{axis.joint}")] = speeds[name]
    for name, axis in machine.axes.items():
        if axis.transmission:  # its drive side leads by the backlash
            velocity = step.load_velocity(state, name)
            ahead = math.copysign(_BACKLASH_SHARE * axis.transmission.backlash, velocity)
            state[step.states.index(f"drive.{name}")] = step.load_position(state, name) + ahead
            state[step.states.index(f"drive_rate.{name}")] = velocity
    loose = [k for k, name in enumerate(step.joints) if name not in driven]
    loose += [*range(len(step.joints), total), *range(2 * total + ACTIVATIONS_PER_AXIS * len(hydraulic), len(state))]
    steered = [i for i, name in enumerate(step.order) if machine.axes[name].force]
    balanced = [*range(total, 2 * total), *range(2 * total + ACTIVATIONS_PER_AXIS * len(hydraulic), len(state))]
    pumps = [k for k, name in enumerate(step.states) if name.startswith("delivery.")]
    first = {name: 2 * total + ACTIVATIONS_PER_AXIS * i for i, name in enumerate(hydraulic)}

    def solve(held: Sequence[str], moving: Sequence[str]) -> float:
        """Solve with closed valves of the `held` axes and open valves of the `moving` ones, in place."""
        places = loose + [first[name] + k for name in moving for k in range(ACTIVATIONS_PER_AXIS)]
        commands = steered + [step.order.index(name) for name in moving]
        rows = balanced + [first[name] + k for name in moving for k in range(ACTIVATIONS_PER_AXIS)]
        sizes = _residual_sizes(step.states)[rows]
        scale = np.concatenate([_balance(step.states)[places], np.ones(len(commands)), np.full(len(held), 1e5)])

        def unpack(x: np.ndarray) -> None:
            x = x * scale
            state[places], command[commands] = x[: len(places)], x[len(places) : len(x) - len(held)]
            for name, force in zip(held, x[len(x) - len(held) :], strict=True):
                state[first[name] + 2 : first[name] + 4] = _rest_pressures(machine.axes[name], force)

        def residual(x: np.ndarray) -> np.ndarray:
            unpack(x)
            return step.rates(state, command)[rows] / sizes

        state[pumps] = 1.0  # of the full flow: Newton's method starts with enough supply pressure
        known = [_hydraulic_force(machine.axes[name], state[first[name] :]) for name in held]
        x = np.concatenate([state[places], command[commands], known]) / scale
        x = _solve_newton(residual, x)
        return float(np.abs(residual(x)).max(initial=0.0))

    moving = [name for name in hydraulic if speeds[name] != 0.0]
    worst = solve(hydraulic, [])
    if moving:
        for name in moving:
            _guess_open_valve(machine, name, step.load_velocity(state, name), state[first[name] :])
            command[step.order.index(name)] = state[first[name]]
        worst = solve([name for name in hydraulic if name not in moving], moving)
    if worst > 1.0:
        named = ", ".join(f"{name} {speeds[name]:g}" for name in moving) or "0"
        raise InputError(
            f"machine {machine.name}",
            f"no steady motion at this pose with the speeds {named}: the pump gives too little flow or"
            " pressure, a joint is at its end stop, or the leakage of a piston exceeds its flow; choose"
            " another pose or speed",
        )
    return _OperatingPoint(step, state, command, speeds)


def _solve_newton(residual: Callable[[np.ndarray], np.ndarray], x: np.ndarray) -> np.ndarray:
    """Solve `residual(x) = 0` by Newton's method with central differences and step halving.

    Steps are the shortest ones if the Jacobian is singular, as for a backlash operator at rest.
    """
    present = residual(x)
    for _ in range(_MAX_NEWTON_STEPS):
        sizes = _NEWTON_PERTURBATION * np.maximum(np.abs(x), 1e-3)
        columns = [(residual(x + d) - residual(x - d)) / (2.0 * d.max()) for d in np.diag(sizes)]
        if not np.isfinite(columns).all():
            break
        step = np.linalg.lstsq(np.transpose(columns), -present, rcond=None)[0]
        for halving in range(_MAX_HALVINGS):
            ahead = residual(x + step * 0.5**halving)
            if np.linalg.norm(ahead) < np.linalg.norm(present):
                break
        else:
            break
        x, present = x + step * 0.5**halving, ahead
    return x


def _residual_sizes(states: Sequence[str]) -> np.ndarray:
    """Return the largest rate of every state that counts as steady [unit/s]."""
    return np.array([_MAX_PRESSURE_RATE if name.startswith("pressure") else _MAX_ACCELERATION for name in states])


def _complete_speeds(machine: Machine, speed: float | Mapping[str, float]) -> dict[str, float]:
    """Return the rate of every axis from a common rate or from the rates of some axes [rad/s] or [m/s].

    Raises:
        InputError: unknown axis, or a rate that is not finite.
    """
    if not isinstance(speed, Mapping):
        speed = dict.fromkeys(machine.hydraulic_axes, float(speed))
    for name, value in speed.items():
        if name not in machine.axes:
            raise InputError(f"speed of {name!r}", f"is not an axis; {suggest_valid_name(name, machine.axes)}")
        if not math.isfinite(value):
            raise InputError(f"speed of {name!r}", f"{value} must be a finite number")
    return {name: float(speed.get(name, 0.0)) for name in machine.axes}


def _complete_pose(machine: Machine, pose: Mapping[str, float], independent: Sequence[str]) -> list[float]:
    """Return the positions of the independent joints; those that `pose` does not contain are at home.

    Raises:
        InputError: unknown joint, or a position out of range.
    """
    found = {name: machine.home.get(name, 0.0) for name in independent}
    for name, value in pose.items():
        joint = machine.axes[name].joint if name in machine.axes else name
        if joint not in found:
            known = sorted({*found, *machine.axes})
            raise InputError(f"pose of {name!r}", f"is not an independent joint; {suggest_valid_name(name, known)}")
        low, high = machine.joints[joint].range or (-math.inf, math.inf)
        if not low <= value <= high or not math.isfinite(value):
            raise InputError(f"pose of {name!r}", f"{value:g} is outside its range {low:g} .. {high:g}")
        found[joint] = float(value)
    return list(found.values())


def remove_dry_friction(machine: Machine, axes: Sequence[str]) -> Machine:
    """Return a machine without dry friction and dead band on some of its axes."""
    changed = dict(machine.axes)
    for name in axes:
        axis = machine.axes[name]
        kind = next(k for k in ("cylinder", "motor", "force") if getattr(axis, k))
        friction = axis.drive.friction.model_copy(update=_NO_DRY_FRICTION)
        update: dict[str, Any] = {kind: axis.drive.model_copy(update={"friction": friction})}
        if axis.valve:
            sides = {s: getattr(axis.valve, s).model_copy(update={"deadband": 0.0}) for s in ("positive", "negative")}
            update["valve"] = axis.valve.model_copy(update=sides)
        changed[name] = axis.model_copy(update=update)
    return machine.model_copy(update={"axes": changed})


_NO_DRY_FRICTION = {"coulomb": 0.0, "stribeck_extra": 0.0, "presliding_stiffness": 0.0, "presliding_damping": 0.0}


def _rest_pressures(axis: Axis, force: float) -> tuple[float, float]:
    """Return head- and rod-side pressure [Pa] that give a force with the unloaded chamber at rest pressure."""
    head, rod = axis.hydraulic_drive.effective_areas
    excess = force - (head - rod) * REST_PRESSURE
    return REST_PRESSURE + max(0.0, excess) / head, REST_PRESSURE + max(0.0, -excess) / rod


def _hydraulic_force(axis: Axis, activations: np.ndarray) -> float:
    """Return the force of the chamber pressures of an axis [N] or [N m]."""
    head, rod = axis.hydraulic_drive.effective_areas
    return float(head * activations[2] - rod * activations[3])


def _guess_open_valve(machine: Machine, name: str, velocity: float, activations: np.ndarray) -> None:
    """Replace the activations of an axis at rest by an estimate of those at a velocity, in place.

    The force stays the same. The flows into both chambers balance the motion of the piston and its
    leakage; the edges of the valve are equal, and the supply is at its maximum pressure.
    """
    axis, force = machine.axes[name], _hydraulic_force(machine.axes[name], activations)
    drive, valve = axis.hydraulic_drive, axis.valve
    assert valve
    head, rod = drive.effective_areas
    supply, tank = machine.max_feed_pressure(name), machine.return_pressure(name)
    for _ in range(_GUESS_ITERATIONS):
        leak = drive.leakage * (activations[2] - activations[3])
        to_head, from_rod = head * velocity + leak, rod * velocity + leak
        ratio = min(max(abs(to_head / from_rod) if from_rod else 1.0, 0.1), 10.0) ** 2
        if to_head > 0.0:  # p_head = supply - ratio (p_rod - tank)
            p_rod = (head * (supply + ratio * tank) - force) / (head * ratio + rod)
            p_rod = min(max(p_rod, tank + _MIN_DROP), tank + (supply - tank - _MIN_DROP) / ratio)
            p_head = supply - ratio * (p_rod - tank)
            flow, drop = to_head, supply - p_head
        else:
            p_head = (rod * (supply + tank / ratio) + force) / (rod / ratio + head)
            p_head = min(max(p_head, tank + _MIN_DROP), tank + (supply - tank - _MIN_DROP) * ratio)
            p_rod = supply - (p_head - tank) / ratio
            flow, drop = -from_rod, supply - p_rod
        activations[2:4] = p_head, p_rod
    opening = min(1.0, abs(flow) / valve.rated_flow * math.sqrt(valve.rated_pressure_drop / drop))
    deadband = valve.deadbands[0 if to_head > 0.0 else 1]
    activations[0] = math.copysign(deadband + (1.0 - deadband) * opening, to_head)


_GUESS_ITERATIONS = 5
_BACKLASH_SHARE = 0.51  # of the backlash, by which a drive side leads at first: contact, and not in the gap
_MAX_NEWTON_STEPS, _MAX_HALVINGS = 50, 12
_NEWTON_PERTURBATION = 1.0e-5  # of an unknown, relative to its value
_MIN_DROP = 1.0e4  # Pa, over an edge of an open valve
