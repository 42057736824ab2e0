"""Regress measured quantities on each other before a search, to find gross errors of a log or of a machine file.

Three balances need no filter and no simulation where their channels are measured:

- `force`: force of the pressures (or of a force drive) = a times the force that the motion needs without friction
  + viscous + Coulomb friction + constant;
- `flow`: piston velocity times area = a times the flow of the valve at the measured command and pressures
  + constant; without pressures, a times the command + constant;
- `length`: cylinder length = a times the length from the measured angle + constant.

All signals pass the same low-pass filter. Rows at rest, near end stops and in gaps are left out. Errors have a t
distribution, so that single wild rows have little weight.

A gross error (columns exchanged, a wrong sign, a wrong unit) is an alternative reading of the same log. Every
alternative is fitted like the log itself, and their likelihoods are compared.
"""

import functools
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from scipy.signal import butter, sosfiltfilt
from threadpoolctl import threadpool_limits

from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.effects.effect import Parameter
from hydrotele.estimate.filter import MEMORY
from hydrotele.estimate.hypothesis import Hypothesis
from hydrotele.estimate.reduced_model import model_space, reduced_model
from hydrotele.gap.balances import (
    BAND,
    Signals,
    _corrected,
    _push,
    chamber_residuals,
    joint_motion,
    load_forces,
    supply_pressures,
)
from hydrotele.gap.result import SURE, Estimate, GrossError, InitialRegressions, Regression
from hydrotele.gap.rivals import weights
from hydrotele.hydraulics.actuator import actuator_friction
from hydrotele.hydraulics.actuator_layout import SLOT_COUNT, actuator_order, actuator_parameters
from hydrotele.identify.zero_phase_filter import filter_zero_phase
from hydrotele.kinematics.drive_linkage import axis_linkage
from hydrotele.kinematics.linkages import LoopOpenError
from hydrotele.logs.dataset import Dataset, RunData
from hydrotele.logs.dataset_reduction import select_exciting_segments
from hydrotele.machine.machine import Machine, SensorError
from hydrotele.multibody.reduced_dynamics import factorise_cholesky, solve_cholesky
from hydrotele.multibody.reduced_mechanism import JOINT

MAX_SECONDS = 120.0  # s of all fit runs together, those with the largest command changes: three typical runs
CUTOFF = 6.0  # Hz, before the nonlinear laws: above every motion of a heavy drive, below its sensor noise
MAX_PERIOD = 0.08  # s between rows before the nonlinear laws: two per period of the cutoff
BAND_PERIOD = 0.25  # s between rows after them: more than two per period of the band of the balances
REST_SPEED = 0.1  # of the RMS speed: slower rows count as rest, where dry friction may have any value
END_MARGIN = 0.01  # of the stroke: closer rows may touch an end stop
GROSS_FACTOR = 2.0
"""A coefficient below 1/2 or above 2 is a gross error: no tolerance of a component is as large."""
MAX_FACTOR = 10.0
"""Largest factor of one parameter; a larger one is a wrong unit or another quantity."""
GROSS_PRIOR = 0.01
"""Prior probability that a balance holds with a gross factor only, or not at all: one drawing in a hundred."""
_DEGREES = 4.0  # of freedom of the t distribution of the errors
_ITERATIONS = 20  # of the reweighted fit: its scale then changes by less than 1 %
_MEDIAN_OF_NORMAL = 0.67  # median absolute deviation of a normal distribution over its standard deviation
_MIN_ROWS = 25  # rows of a balance: five times its coefficients
_MAX_ERRORS = 3  # gross errors that are looked for, one after the other
_MIN_MOTION = 10.0  # standard deviations of a position's noise by which it must move
_POINTS = 400  # of a regression that a plot shows
_BLOCK = 2.0  # s of a run whose rows are drawn together
_UNITS = {
    "pressure": {"bar": 1e5, "MPa": 1e6, "psi": 6894.757},
    "angle": {"degrees": math.pi / 180.0, "radians, converted from degrees once too often": 180.0 / math.pi},
    "length": {"mm": 1e-3},
    "position": {"mm": 1e-3},
    "command": {"percent": 1e-2, "percent, divided by 100 once too often": 1e2},
}
"""Kind of channel -> unit that a column may have instead -> factor to the right unit."""


class Move(NamedTuple):
    """Where an alternative takes a channel from: another column, times a factor."""

    source: str
    factor: float = 1.0


@dataclass(frozen=True)
class Reading:
    """A way to read the log.

    Attributes:
        kind: `as logged`, `exchanged columns`, `wrong sign` or `wrong unit`.
        words: what is assumed, to follow "if"; empty of the log as it is.
        moves: channel -> where it is taken from; the other channels are as logged.
    """

    kind: str
    words: str
    moves: Mapping[str, Move] = field(default_factory=dict)

    def after(self, first: "Reading") -> "Reading":
        """Return this reading of what another reading yields."""
        both = dict(first.moves)
        for channel, move in self.moves.items():
            old = first.moves.get(move.source, Move(move.source))
            both[channel] = Move(old.source, old.factor * move.factor)
        return replace(self, moves=both)


@dataclass(frozen=True)
class Rows:
    """A balance as a regression problem over n rows of all runs.

    Attributes:
        measured: (n,) measured quantity [unit].
        columns: (n, p) regressors; the first is what the model says.
        names: the p coefficients.
        low: (p,) lower bounds of the coefficients, -inf if none; the factor is not negative.
        blocks: (n,) index of the 2 s stretch of a row.
        weight: effective readings per row [1].
        velocity: (n,) [m/s] or [rad/s].
        position: (n,) [m] or [rad].
        drive: (n,) what drives it: command [1], or the force that is needed [N] or [N m].
        is_nominal: whether the factor is 1 for the given machine; else only its sign is known.
    """

    measured: np.ndarray
    columns: np.ndarray
    names: tuple[str, ...]
    low: np.ndarray
    blocks: np.ndarray
    weight: float
    velocity: np.ndarray
    position: np.ndarray
    drive: np.ndarray
    is_nominal: bool


class RobustFit(NamedTuple):
    """Coefficients (p,), scale of the errors, and -2 log likelihood and weight of each row (n,)."""

    value: np.ndarray
    scale: float
    losses: np.ndarray
    row_weights: np.ndarray


_PARAMETERS = {
    ("force", "coulomb"): ("coulomb_friction", "coulomb"),
    ("force", "viscous"): ("viscous_friction", "viscous"),
    ("flow", "factor"): ("valve_gain", "ratio"),
}
"""(balance, coefficient) -> (effect, parameter) that it estimates directly."""


def start_values(found: InitialRegressions) -> dict[tuple[str, str, str], float]:
    """Return (effect, location, parameter) -> value, of effects whose parameter is a coefficient.

    Only coefficients whose 95 % interval excludes that of the given machine; none after a gross error of a column.
    """
    if any(error.kind not in ("factor", "unexplained") for error in found.errors):
        return {}
    values = {}
    for one in found.regressions:
        for (balance, name), (effect, parameter) in _PARAMETERS.items():
            estimate = one.coefficients.get(name)
            if estimate is None or one.balance != balance or not math.isfinite(estimate.nominal):
                continue
            if not estimate.low <= estimate.nominal <= estimate.high:
                values[effect, one.axis, parameter] = estimate.value
    return values


@threadpool_limits.wrap(limits=1, user_api="blas")  # many small products
def run_initial_regressions(data: Dataset) -> InitialRegressions:
    """Regress measured quantities of the fit runs on each other, and find gross errors.

    Args:
        data: the logs.

    Returns:
        The regressions of all balances whose channels are measured, and the gross errors. Both are empty where
        no balance has enough rows.
    """
    problem = _Problem(select_exciting_segments(data, MAX_SECONDS))
    plain = Reading("as logged", "")
    now, errors = plain, list[GrossError]()
    for _ in range(_MAX_ERRORS):
        found = find_wrong_reading(problem, now)
        if found is None:
            break
        now, error = found
        errors.append(error)
    errors += find_gross_factors(problem, now)
    regressions = [regress(data.machine, key, rows) for key, rows in problem.balances(plain).items()]
    return InitialRegressions(tuple(r for r in regressions if r is not None), tuple(errors))


# -- signals and balances ---------------------------------------------------------------------------------------------


def filter_run(machine: Machine, data: Dataset, run: RunData) -> Signals | None:
    """Low-pass the readings and commands of a run and reduce its rows; None if it is too short.

    Readings in gaps longer than a period of the cutoff are NaN.
    """
    cutoff = min(CUTOFF, 0.2 / run.period)
    thin = max(1, int(MAX_PERIOD / run.period))
    time = run.start + run.period * np.arange(len(run.command))
    bad = ~run.command_known if run.valid is None else ~run.valid
    names = [*data.channels, *(f"command.{axis}" for axis in data.axes)]
    reading, smoothed, noise, command = {}, {}, {}, {}
    for name, values in zip(names, np.column_stack([run.reading, run.command]).T, strict=True):
        if not name.startswith("command"):
            values = _corrected(values, machine.sensor_errors.get(name, SensorError()), time)
        known = np.flatnonzero(np.isfinite(values) & ~bad)
        if len(known) < _MIN_ROWS:
            continue
        filled = np.interp(np.arange(len(values)), known, values[known])
        try:
            signal = filter_zero_phase(filled, run.period, cutoff, 1.0)
        except InputError:  # fewer rows than the filter's transient
            return None
        count = len(values)
        behind, ahead = _rows_since(known, count), _rows_since(count - 1 - known[::-1], count)[::-1]
        distance = np.minimum(behind, ahead)
        inside = distance * run.period * cutoff < 1.0
        reading[name] = np.where(inside, signal.value, np.nan)[::thin]
        smoothed[name] = np.stack([signal.value, signal.rate, signal.acceleration])[None, :, ::thin]
        noise[name] = float(np.median(np.abs(values[known] - signal.value[known]))) / _MEDIAN_OF_NORMAL
        if name.startswith("command"):
            command[name.removeprefix("command.")] = signal.value[::thin]
    return Signals(time[::thin], thin * run.period, command, reading, noise, smoothed)


def _rows_since(known: np.ndarray, rows: int) -> np.ndarray:
    """(rows,) number of rows since the last known one; large before the first."""
    last = np.full(rows, -rows)
    last[known] = known
    return np.arange(rows) - np.maximum.accumulate(last)


def read_as(signals: Signals, reading: Reading) -> Signals:
    """Return the signals as an alternative reading takes them."""
    moves = {c: m for c, m in reading.moves.items() if m.source in signals.smoothed}
    if not moves:
        return signals
    smoothed, values, command = dict(signals.smoothed), dict(signals.reading), dict(signals.command)
    for channel, (source, factor) in moves.items():
        smoothed[channel] = factor * signals.smoothed[source]
        values[channel] = factor * signals.reading[source]
        if channel.startswith("command."):
            command[channel.removeprefix("command.")] = smoothed[channel][0, 0]
    return replace(signals, smoothed=smoothed, reading=values, command=command)


Key = tuple[str, str]


class _Problem:
    """The balances of a dataset under every reading of its log; what is alike is computed once."""

    def __init__(self, data: Dataset) -> None:
        self.machine, self.data = data.machine, data
        self.runs = [s for run in data.fit if (s := filter_run(data.machine, data, run)) is not None]
        self.channels = sorted({c for s in self.runs for c in s.smoothed})
        self._model = reduced_model(self.machine, ())
        self._kept: dict[tuple, Rows | None] = {}
        self._needed: dict[tuple, list[np.ndarray | None]] = {}
        self._drives: dict[tuple, tuple[np.ndarray, np.ndarray] | None] = {}
        self.used = self._used_channels()

    def _used_channels(self) -> dict[Key, tuple[str, ...]]:
        """Balance and drive -> channels on which it depends."""
        used: dict[Key, tuple[str, ...]] = {}
        positions = tuple(c for c in self.channels if c.startswith(("angle", "position", "length")))
        for axis, facts in self.machine.axes.items():
            own = tuple(c for c in positions if c.endswith(f".{axis}"))
            pressures = tuple(c for c in self.channels if "pressure" in c)
            used["force", axis] = (*positions, f"command.{axis}") if facts.force else (
                *positions, *(c for c in pressures if c.endswith(f".{axis}")))  # fmt: skip
            if facts.is_hydraulic:
                commands = tuple(c for c in self.channels if c.startswith("command"))
                fed_from = self.machine.supply_channel(axis)
                supplied = fed_from in self.channels
                used["flow", axis] = (
                    *own, *(c for c in pressures if not supplied or c.endswith(f".{axis}") or c == fed_from),
                    *(commands if not supplied else (f"command.{axis}",)),
                )  # fmt: skip
            if facts.cylinder:
                used["length", axis] = own
        return used

    def signature(self, key: Key, reading: Reading) -> tuple:
        """Return what makes a balance under a reading differ from that of another reading."""
        return (key, tuple(sorted((c, m) for c, m in reading.moves.items() if c in self.used[key])))

    def balances(self, reading: Reading) -> dict[Key, Rows]:
        """Balance and drive -> rows of the regression, where channels and motion suffice."""
        found = {}
        for key in self.used:
            mark = self.signature(key, reading)
            if mark not in self._kept:
                self._kept[mark] = self._rows(key, reading)
            if (rows := self._kept[mark]) is not None:
                found[key] = rows
        return found

    def needed_forces(self, reading: Reading) -> list[np.ndarray | None]:
        """Per run (n, nu) force of every drive that the motion needs, without friction; None if unknown."""
        mark = tuple(sorted((c, m) for c, m in reading.moves.items() if c.startswith(("angle", "position", "length"))))
        if mark not in self._needed:
            self._needed[mark] = [self._needed_in(k, read_as(s, reading), reading) for k, s in enumerate(self.runs)]
        return self._needed[mark]

    def drive(self, run: int, axis: str, signals: Signals, reading: Reading) -> tuple[np.ndarray, np.ndarray] | None:
        """Return `drive_motion` of a run under a reading."""
        own = tuple(f"{kind}.{axis}" for kind in ("angle", "position", "length"))
        mark = (run, axis, *(reading.moves.get(c) for c in own))
        if mark not in self._drives:
            self._drives[mark] = drive_motion(self.machine, signals, axis)
        return self._drives[mark]

    def _needed_in(self, run: int, signals: Signals, reading: Reading) -> np.ndarray | None:
        order = actuator_order(self.machine)
        motions = [motion_of(self.machine, signals, name) for name in order]
        if len(self._model.mech.independent) != len(order) or any(m is None for m in motions):
            return None
        joints = list(self._model.mech.drive[:, JOINT].astype(int))
        places = [joints.index(int(j)) if int(j) in joints else -1 for j in self._model.mech.independent]
        if min(places) < 0:
            return None
        motion = np.stack([motions[k][0] for k in places], axis=-1)  # pyright: ignore - none is None
        forces = load_forces(self._model, model_space(self._model), motion.swapaxes(0, 1).copy())
        for k, name in enumerate(order):
            speed = self.drive(run, name, signals, reading)
            if speed is None:
                return None
            forces[:, k] -= _friction_forces(self._model.user, k * SLOT_COUNT, speed[1])
        return forces if np.isfinite(forces).all() else None

    def _rows(self, key: Key, reading: Reading) -> Rows | None:
        parts, begin = [], 0
        for index, run in enumerate(self.runs):
            signals = read_as(run, reading)
            part = self._rows_in(key, signals, index, reading)
            if part is not None:
                parts.append(replace(part, blocks=part.blocks + begin))
            begin += math.ceil(len(run.time) * run.period / _BLOCK)
        parts = [p for p in parts if p.is_nominal == parts[0].is_nominal]
        if sum(len(p.measured) for p in parts) < _MIN_ROWS:
            return None
        joined = {
            name: np.concatenate([getattr(p, name) for p in parts])
            for name in ("measured", "columns", "blocks", "velocity", "position", "drive")
        }
        return replace(parts[0], **joined) if np.isfinite(joined["columns"]).all() else None

    def _rows_in(self, key: Key, signals: Signals, run: int, reading: Reading) -> Rows | None:
        (balance, axis), machine = key, self.machine
        own = self.drive(run, axis, signals, reading)
        if own is None:
            return None
        position, velocity = own
        nominal, names, low = True, ("factor", "constant"), np.array([0.0, -np.inf])
        one = np.ones(len(position))
        if balance == "force":
            push, needed = _push(machine, signals, axis), self.needed_forces(reading)[run]
            if push is None or needed is None or axis in machine.loads:
                return None
            measured = np.atleast_2d(push)[0]
            drive = needed[:, actuator_order(machine).index(axis)]
            way = np.tanh(velocity / machine.axes[axis].drive.friction.smoothing_velocity)
            columns = [drive, velocity, way, one]
            names, low = ("factor", "viscous", "coulomb", "constant"), np.array([0.0, 0.0, 0.0, -np.inf])
        elif balance == "flow":
            if axis not in signals.command:
                return None
            measured = machine.axes[axis].hydraulic_drive.effective_areas[0] * velocity
            drive = _delayed_command(machine, signals, axis)
            flow = _valve_flow(machine, signals, axis, drive, own)
            nominal = flow is not None
            columns = [drive if flow is None else flow, one]
        else:
            name = f"{machine.position_kind(axis)}.{axis}"
            cylinder = machine.axes[axis].cylinder
            if cylinder is None or not signals.has(f"length.{axis}", name):
                return None
            measured, drive = signals.smoothed[f"length.{axis}"][0, 0], position
            columns = [position, one]
        matrix = _band_matrix(len(position), signals.period)
        filtered = np.stack([measured, *columns, position, velocity, drive]) @ matrix
        mask = self._usable(key, signals, position, velocity)
        if not mask.any() or not np.isfinite(filtered).all():
            return None
        thin = max(1, int(BAND_PERIOD / signals.period))
        used = mask[::thin]
        filtered, blocks = filtered[:, used], (np.flatnonzero(used) * thin * signals.period / _BLOCK).astype(int)
        count = len(columns)
        return Rows(
            filtered[0], filtered[1 : 1 + count].T, names, low, blocks, thin * signals.period / MEMORY,
            filtered[-2], filtered[-3], filtered[-1], nominal,
        )  # fmt: skip

    def _usable(self, key: Key, signals: Signals, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """(n,) rows in motion, away from end stops and gaps."""
        known = np.ones(len(position), bool)
        for channel in self.used[key]:
            if channel in signals.reading:
                known &= np.isfinite(signals.reading[channel])
        ends = math.ceil(1.0 / (BAND * signals.period))  # where the filters have their transients
        known[:ends], known[-ends:] = False, False
        cylinder = self.machine.axes[key[1]].cylinder
        if cylinder:
            margin = END_MARGIN * cylinder.stroke
            known &= (position > margin) & (position < cylinder.stroke - margin)
        if key[0] == "length":
            return known
        channel = next((c for c in signals.noise if c == f"{self.machine.position_kind(key[1])}.{key[1]}"), None)
        channel = channel or f"length.{key[1]}"
        sensor = signals.smoothed[channel][0, 0]
        if np.ptp(sensor) < _MIN_MOTION * signals.noise.get(channel, 0.0):
            return np.zeros(len(position), bool)
        return known & (np.abs(velocity) > REST_SPEED * np.sqrt(np.mean(velocity**2)))


def motion_of(machine: Machine, signals: Signals, axis: str) -> np.ndarray | None:
    """Return the motion (1, 3, n) of an axis' joint; None if it is not measured or closes no linkage."""
    try:
        return joint_motion(machine, signals, axis)
    except LoopOpenError:
        return None


def drive_motion(machine: Machine, signals: Signals, axis: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Return displacement (n,) and velocity (n,) of a drive [m] or [rad]; None if unknown."""
    motion = motion_of(machine, signals, axis)
    if motion is None:
        return None
    cylinder = machine.axes[axis].cylinder
    try:
        linkage = axis_linkage(machine, axis)
        length = np.asarray(linkage.length(motion[0, 0]), float)
        velocity = np.asarray(linkage.rate(motion[0, 0]), float) * motion[0, 1]
    except LoopOpenError:
        return None
    position = length - (cylinder.closed_length if cylinder else 0.0)
    return (position, velocity) if np.isfinite(position + velocity).all() else None


def _delayed_command(machine: Machine, signals: Signals, axis: str) -> np.ndarray:
    """(n,) command after the delay of the signal and the mean lag of the spool."""
    facts = machine.axes[axis]
    lag = facts.command_delay
    if facts.valve:
        lag += 2.0 * facts.valve.damping / facts.valve.bandwidth
    command = np.clip(signals.command[axis], -1.0, 1.0) if facts.valve else signals.command[axis]
    rows = np.arange(len(command))
    return np.interp(rows - lag / signals.period, rows, command)


def _valve_flow(
    machine: Machine, signals: Signals, axis: str, spool: np.ndarray, motion: tuple[np.ndarray, np.ndarray]
) -> np.ndarray | None:  # fmt: skip
    """(n,) flow that leaves for the piston's motion by the valve law; None if pressures are not measured."""
    facts = machine.axes[axis]
    if facts.valve is None or not signals.has(f"pressure_head.{axis}", f"pressure_rod.{axis}"):
        return None
    head, rod = (signals.smoothed[f"pressure_{side}.{axis}"][0] for side in ("head", "rod"))
    channel = machine.supply_channel(axis)
    if signals.has(channel):
        supply = signals.smoothed[channel][0, 0]
    else:
        supply = _modelled_supply(machine, signals, axis)
    if supply is None:
        return None
    position, velocity = motion
    volumes = np.stack(facts.hydraulic_drive.chamber_volumes(position))
    lacks = chamber_residuals(
        actuator_parameters(machine)[axis], spool, supply, head[:2].copy(), rod[:2].copy(), volumes, velocity,
    )  # fmt: skip
    return facts.hydraulic_drive.effective_areas[0] * velocity - lacks[0]


def _modelled_supply(machine: Machine, signals: Signals, axis: str) -> np.ndarray | None:
    """Return the (n,) supply pressure of an axis in the model at measured commands and chamber pressures.

    The result is None if a command or pressure is missing.
    """
    numbers = actuator_parameters(machine)
    names = list(machine.valve_axes)
    chambers = [f"pressure_{side}.{name}" for name in names for side in ("head", "rod")]
    if not signals.has(*chambers) or any(name not in signals.command for name in names):
        return None
    spools = np.stack([_delayed_command(machine, signals, name) for name in names])
    pressures = np.stack([signals.smoothed[c][0, 0] for c in chambers]).reshape(len(names), 2, -1)
    user = np.concatenate([numbers[name] for name in names])
    return supply_pressures(user, spools, pressures, signals.period)[names.index(axis)]


# -- robust fit -------------------------------------------------------------------------------------------------------


def fit_robust(
    measured: np.ndarray, columns: np.ndarray, low: np.ndarray, high: np.ndarray | None = None
) -> RobustFit:  # fmt: skip
    """Fit a linear model whose errors have a t distribution with 4 degrees of freedom.

    The likelihood is maximised by iteratively reweighted least squares (an EM algorithm). A coefficient beyond a bound
    is set to it, and the others are fitted again.

    Args:
        measured: (n,).
        columns: (n, p).
        low: (p,) lower bounds.
        high: (p,) upper bounds; None for none.

    Returns:
        The fit; -2 log likelihoods are without constant.

    Source: Lange, Little and Taylor 1989, Journal of the American Statistical Association 84(408).

    >>> x = np.arange(20.0)
    >>> y = 3.0 * x
    >>> y[4] = 1e6
    >>> fit_robust(y, x[:, None], np.array([-np.inf])).value.round(3)
    array([3.])
    """
    high = np.full(len(low), np.inf) if high is None else high
    size = np.sqrt(np.mean(columns**2, axis=0)) + 1e-300
    row, value = np.ones(len(measured)), np.zeros(len(low))
    scale = _fit_reweighted(np.ascontiguousarray(columns / size), measured, low * size, high * size, row, value)
    errors = measured - columns @ (value / size)
    losses = 2.0 * math.log(scale) + (_DEGREES + 1.0) * np.log1p((errors / scale) ** 2 / _DEGREES)
    return RobustFit(value / size, scale, losses, row)


@compiled
def _fit_reweighted(x, measured, low, high, row, value):
    """Fit coefficients (p,) and weights of the rows (n,), which are 1 at the start; return the scale of the errors."""
    rows, count = x.shape
    gram, right, free = np.empty((count, count)), np.empty(count), np.empty(count)
    system, solved = np.empty((count, count)), np.empty(count)
    scale = 0.0
    for iteration in range(_ITERATIONS + 1):
        for i in range(count):
            right[i], value[i], free[i] = 0.0, 0.0, 1.0
            for j in range(count):
                gram[i, j] = 0.0
        for k in range(rows):
            for i in range(count):
                right[i] += row[k] * x[k, i] * measured[k]
                for j in range(count):
                    gram[i, j] += row[k] * x[k, i] * x[k, j]
        for _ in range(count):  # each round but the last holds at least one coefficient at its bound
            for i in range(count):
                solved[i] = value[i]
                if free[i] > 0.0:
                    solved[i] = right[i]
                for j in range(count):
                    system[i, j] = gram[i, j] * free[i] * free[j]
                    solved[i] -= gram[i, j] * value[j] * free[i] * (1.0 - free[j])
                system[i, i] = gram[i, i] * (1.0 + 1e-12) + 1e-300 if free[i] > 0.0 else 1.0
            factorise_cholesky(system)
            solve_cholesky(system, solved)
            done = True
            for i in range(count):
                if free[i] > 0.0:
                    value[i] = min(max(solved[i], low[i]), high[i])
                    if value[i] != solved[i]:
                        free[i], done = 0.0, False
            if done:
                break
        total = 0.0
        for k in range(rows):
            error = measured[k]
            for i in range(count):
                error -= x[k, i] * value[i]
            if iteration > 0:
                row[k] = (_DEGREES + 1.0) / (_DEGREES + (error / scale) ** 2)
            total += row[k] * error**2
        scale = math.sqrt(total / rows) + 1e-300
    return scale


@compiled
def _friction_forces(user, slot, velocity):
    """Return the friction (n,) of the given machine at velocities (n,)."""
    out = np.empty(len(velocity))
    for k in range(len(velocity)):
        out[k] = actuator_friction(user, slot, velocity[k])
    return out


@functools.lru_cache(maxsize=8)  # one per length and rate of a run
def _band_matrix(rows: int, period: float) -> np.ndarray:
    """Return (rows, k) the low-pass of the balances with every k-th row kept, as a matrix on row vectors."""
    every = slice(None, None, max(1, int(BAND_PERIOD / period)))
    if BAND >= 0.4 / period:
        return np.ascontiguousarray(np.eye(rows)[:, every])
    pad = min(rows - 1, round(1.0 / (BAND * period)))
    whole = sosfiltfilt(butter(2, BAND, fs=1.0 / period, output="sos"), np.eye(rows), axis=1, padlen=pad)
    return np.ascontiguousarray(whole[:, every])


# -- gross errors -----------------------------------------------------------------------------------------------------

FACTOR_RANGES = {
    "regular": (1.0 / GROSS_FACTOR, GROSS_FACTOR),
    "too small": (1.0 / MAX_FACTOR, 1.0 / GROSS_FACTOR),
    "too large": (GROSS_FACTOR, MAX_FACTOR),
}
"""How a balance may hold -> range of its factor."""
_CHARGES = {"regular": 0.0} | dict.fromkeys(("too small", "too large", "unexplained"), -2.0 * math.log(GROSS_PRIOR))


class Account(NamedTuple):
    """How a balance holds: `regular`, `too small`, `too large` or `unexplained`.

    The -2 log likelihood (blocks,) of its stretches is relative to the spread of the measured quantity.
    """

    way: str
    blocks: np.ndarray
    charge: float
    explained: float


def account_for(rows: Rows, count: int, ways: Sequence[str] = tuple(_CHARGES)) -> dict[str, Account]:
    """Fit a balance in every way in which it may hold.

    Args:
        rows: the balance.
        count: number of stretches of all runs.
        ways: the ways to try.

    Returns:
        Way -> account.
    """
    constant = np.ones((len(rows.measured), 1))
    spread = fit_robust(rows.measured, constant, np.array([-np.inf]))
    reference = 2.0 * math.log(spread.scale)

    def account(way: str, fit: RobustFit) -> Account:
        blocks = np.bincount(rows.blocks, rows.weight * (fit.losses - reference), count)
        blocks -= np.bincount(rows.blocks, rows.weight * (spread.losses - reference), count)
        return Account(way, blocks, _CHARGES[way], 1.0 - (fit.scale / spread.scale) ** 2)

    found = {}
    for way in ways:
        if way == "unexplained":
            found[way] = account(way, spread)
        elif rows.is_nominal or way == "regular":
            low, high = rows.low.copy(), np.full(len(rows.low), np.inf)
            if rows.is_nominal:
                low[0], high[0] = FACTOR_RANGES[way]
            found[way] = account(way, fit_robust(rows.measured, rows.columns, low, high))
    return found


def best_account(accounts: Mapping[str, Account]) -> Account:
    """Return the most probable way in which a balance holds."""
    return min(accounts.values(), key=lambda a: float(a.blocks.sum()) + a.charge)


def find_wrong_reading(problem: _Problem, now: Reading) -> tuple[Reading, GrossError] | None:
    """Return the reading that explains the log better than the present one, if that is sure.

    Args:
        problem: the balances.
        now: the present reading.

    Returns:
        The reading, and the error as a sentence; None if the present reading is not clearly worse.
    """
    count = sum(math.ceil(len(s.time) * s.period / _BLOCK) for s in problem.runs)
    base = problem.balances(now)
    if not base:
        return None
    options = [r.after(now) for r in possible_readings(problem.machine, problem.channels)]
    prior = 2.0 * math.log(max(len(options), 1))
    cache: dict[tuple, Account] = {}

    def accounts_of(reading: Reading) -> dict[Key, Account]:
        rows, found = problem.balances(reading), {}
        for key in base:
            mark = problem.signature(key, reading)
            if mark not in cache:
                cache[mark] = (
                    best_account(account_for(rows[key], count)) if key in rows else _unexplained_account(count)
                )
            found[key] = cache[mark]
        return found

    table = [(now, accounts_of(now)), *((r, accounts_of(r)) for r in options)]
    blocks = [np.concatenate([a.blocks for a in accounts.values()]) for _, accounts in table]
    charges = [
        sum(a.charge for a in accounts.values()) + (prior if k else 0.0) for k, (_, accounts) in enumerate(table)
    ]
    chances = weights(blocks, charges)
    best = int(np.argmax(chances))
    if best == 0 or chances[best] < SURE:
        return None
    reading, accounts = table[best]
    old = table[0][1]
    changed = [k for k in base if problem.signature(k, reading) != problem.signature(k, now)]
    key = max(changed, key=lambda k: float(old[k].blocks.sum() - accounts[k].blocks.sum()))
    as_logged = account_for(base[key], count, ("regular",))["regular"].explained
    sentence = (
        f"{reading.words}, the model explains {_percent(accounts[key].explained)} of the variance of the"
        f" {balance_words(*key)}; {'without this correction' if now.moves else 'as logged'}, it explains"
        f" {_percent(as_logged)}."
    )
    own = [c for c in reading.moves if reading.moves[c] != now.moves.get(c)]
    error = GrossError(
        reading.kind, tuple(own), float(chances[best]), accounts[key].explained, as_logged,
        sentence[0].upper() + sentence[1:],
    )  # fmt: skip
    return reading, error


def _unexplained_account(count: int) -> Account:
    """Account of a balance that cannot be computed under a reading, as if nothing explained it."""
    return Account("unexplained", np.zeros(count), _CHARGES["unexplained"], 0.0)


def find_gross_factors(problem: _Problem, now: Reading) -> list[GrossError]:
    """Return the balances that hold with a gross factor only, or not at all, where that is sure."""
    count = sum(math.ceil(len(s.time) * s.period / _BLOCK) for s in problem.runs)
    errors = []
    for key, rows in problem.balances(now).items():
        accounts = account_for(rows, count)
        ways = list(accounts)
        chances = weights([accounts[w].blocks for w in ways], [accounts[w].charge for w in ways])
        best = ways[int(np.argmax(chances))]
        if best == "regular" or chances.max() < SURE:
            continue
        regular = accounts["regular"].explained
        if best == "unexplained":
            text = (
                f"The model explains {_percent(regular)} of the variance of the {balance_words(*key)}, and no"
                " exchange of columns, sign or unit raises this. The log may be of another machine, or a large"
                " effect is missing."
            )
            errors.append(GrossError(best, key, float(chances.max()), math.nan, regular, text))
            continue
        fit, (low, high) = fit_robust(rows.measured, rows.columns, rows.low), FACTOR_RANGES["regular"]
        text = (
            f"The measured {balance_words(*key)} is {fit.value[0]:.3g} times that of the model. The fit explains"
            f" {_percent(accounts[best].explained)} of its variance; with a factor limited to {low:g} to {high:g} it"
            f" explains {_percent(regular)}. {_FACTOR_CAUSES[key[0]]}"
        )
        errors.append(GrossError("factor", key, float(chances.max()), accounts[best].explained, regular, text))
    return errors


_FACTOR_CAUSES = {
    "force": "Check piston areas, masses and the unit of the pressures.",
    "flow": "Check rated flow, piston area and the scale of the command.",
    "length": "Check the pins of the cylinder and the units of length and angle.",
}
"""Balance -> what a factor may come from."""


def balance_words(balance: str, axis: str) -> str:
    """Return a balance of a drive in words.

    >>> balance_words("flow", "boom")
    'flow of the boom drive (velocity times area)'
    """
    kinds = {"force": "force of the {} drive", "flow": "flow of the {} drive (velocity times area)",
             "length": "cylinder length of the {}"}  # fmt: skip
    return kinds[balance].format(axis)


def _percent(explained: float) -> str:
    """Return a fraction of variance in percent; `nothing` if it is not positive.

    >>> _percent(0.973), _percent(-3.0)
    ('97 %', 'nothing')
    """
    return f"{100.0 * explained:.0f} %" if explained >= 0.005 else "nothing"


def possible_readings(machine: Machine, channels: Sequence[str]) -> Iterator[Reading]:
    """Yield readings of a log with one gross error: a wrong sign, exchanged columns, or a wrong unit.

    Args:
        machine: the given machine.
        channels: measured channels and commands.
    """
    present = set(channels)
    for channel in channels:
        if "pressure" not in channel:
            yield Reading("wrong sign", f"if the sign of {channel} is reversed", {channel: Move(channel, -1.0)})
    for kind in ("command", "angle", "position", "length"):
        own = [c for c in channels if c.startswith(f"{kind}.")]
        for a, b in itertools.combinations(own, 2):
            yield _exchange(((a, b),))
    pairs = [
        (f"pressure_head.{axis}", f"pressure_rod.{axis}") for axis in machine.axes
        if {f"pressure_head.{axis}", f"pressure_rod.{axis}"} <= present
    ]  # fmt: skip
    for pair in pairs:
        yield _exchange((pair,))
    for one, other in itertools.combinations(pairs, 2):
        yield _exchange(tuple(zip(one, other, strict=True)))
    for kind, units in _UNITS.items():
        own = [c for c in channels if c.startswith(kind)]
        groups = [own, *([c] for c in own if len(own) > 1)]
        for (unit, factor), group in itertools.product(units.items(), [g for g in groups if g]):
            which = f"all {kind} columns are" if len(group) > 1 else f"{group[0]} is"
            yield Reading("wrong unit", f"if {which} in {unit}", {c: Move(c, factor) for c in group})


def _exchange(pairs: Sequence[tuple[str, str]]) -> Reading:
    moves = {a: Move(b) for a, b in pairs} | {b: Move(a) for a, b in pairs}
    words = " and ".join(f"{a} and {b}" for a, b in pairs)
    return Reading("exchanged columns", f"if the columns {words} are exchanged", moves)


# -- reported regressions ---------------------------------------------------------------------------------------------


def regress(machine: Machine, key: Key, rows: Rows) -> Regression | None:
    """Fit a balance of the log as it is, with a position coefficient in the force balance.

    Args:
        machine: the given machine.
        key: balance and drive.
        rows: its rows.

    Returns:
        The regression.
    """
    (balance, axis), names = key, rows.names
    columns, low = rows.columns, np.r_[0.0, np.full(len(rows.low) - 1, -np.inf)]
    facts = machine.axes[axis]
    turns = facts.cylinder is None and machine.position_kind(axis) == "angle"
    unit = {"force": "N m" if turns else "N", "flow": "m^3/s", "length": "m"}[balance]
    per = "rad" if turns else "m"
    if balance == "force":
        centred = rows.position - rows.position.mean()
        columns, names = np.column_stack([columns, centred]), (*names, "per_position")
        low = np.append(low, -np.inf)
    fit = fit_robust(rows.measured, columns, low)
    size = np.sqrt(np.mean(columns**2, axis=0)) + 1e-300
    scaled = columns / size
    information = (scaled * fit.row_weights[:, None]).T @ scaled * rows.weight / fit.scale**2
    deviations = np.sqrt(np.diag(np.linalg.pinv(information, hermitian=True))) / size
    friction = facts.drive.friction if balance == "force" else None
    nominal = {
        "factor": 1.0 if rows.is_nominal else math.nan, "constant": 0.0, "per_position": 0.0,
        "viscous": friction.viscous if friction else 0.0, "coulomb": friction.coulomb if friction else 0.0,
    }  # fmt: skip
    units = {"factor": "1" if rows.is_nominal else unit, "constant": unit, "coulomb": unit,
             "per_position": f"{unit}/{per}", "viscous": f"{unit} s/{per}"}  # fmt: skip
    reach = 1.96 * deviations
    coefficients = {
        name: Estimate(float(v), units[name], float(v - r), float(v + r), nominal[name])
        for name, v, r in zip(names, fit.value, reach, strict=True)
    }
    spread = fit_robust(rows.measured, np.ones((len(rows.measured), 1)), np.array([-np.inf])).scale
    given = math.nan
    if rows.is_nominal:
        rest = rows.measured - columns @ np.array([nominal[name] for name in names])
        given = 1.0 - (fit_robust(rest, np.empty((len(rest), 0)), np.empty(0)).scale / spread) ** 2
    thin = max(1, len(rows.measured) // _POINTS)
    points = {
        "measured": rows.measured, "model": rows.columns[:, 0], "velocity": rows.velocity,
        "position": rows.position, "drive": rows.drive,
    }  # fmt: skip
    return Regression(
        balance, axis, unit, coefficients, 1.0 - (fit.scale / spread) ** 2, given, len(rows.measured),
        {name: values[::thin] for name, values in points.items()},
    )  # fmt: skip


def with_start_values(candidates: Sequence[Hypothesis], found: InitialRegressions) -> list[Hypothesis]:
    """Return the candidates with the regressed values as a start value, in addition to their own."""
    starts, changed = start_values(found), []
    for hypothesis in candidates:
        parameters: dict[str, Parameter] = {}
        for name, p in hypothesis.parameters.items():
            value = starts.get((*hypothesis.key, name))
            relevant = value is not None and abs(value - p.nominal) >= p.min_relevant_change
            if value is not None and relevant and p.lower_bound < value < p.upper_bound:
                p = replace(p, start_values=(*p.start_values, value))
            parameters[name] = p
        changed.append(replace(hypothesis, parameters=parameters))
    return changed
