"""Runs of a dataset through the filter: where it starts, what it trusts, what it yields.

The state before a run's first reading: from its first rows, with a wide spread.

How prediction errors answer to what would be added to a balance, row by row, to first order.

With a track's kept gains, whitened errors are nearly linear in a small addition. So the responses
to many candidate laws cost one pass of small matrices each, not one simulation each, and a
regression of the errors on them weighs every reading as the likelihood does, with what the unknown
inputs of the track have taken up counted as unknown.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.optimize import fminbound
from scipy.signal import savgol_filter

from hydrotele.core.compiled import compiled
from hydrotele.effects.transmission import natural_frequency
from hydrotele.estimate.colour import STATE, Colour, join_transitions, state_labels
from hydrotele.estimate.filter import (
    ColouredNoise,
    Crossing,
    Gains,
    Input,
    InputEffect,
    Linearisation,
    MeasuredRun,
    Steps,
    Variances,
    decay,
    filter_run,
    input_drift,
    late_readings,
)
from hydrotele.estimate.reduced_model import (
    BACKLASH,
    Model,
    accelerate,
    load_position,
    model_space,
    place,
    reduced_model,
    state_names,
)
from hydrotele.hydraulics.actuator_layout import (
    DELIVERY_STATE,
    SLOT_COUNT,
    Slot,
    actuator_order,
    max_pump_drive_time_step,
)
from hydrotele.hydraulics.circuit import (
    circuit_scratch,
    compute_inlet_conditions,
    group_size,
    write_demanded_fractions,
)
from hydrotele.hydraulics.supply import DEMAND
from hydrotele.logs.dataset import Dataset, RunData
from hydrotele.machine.machine import Machine

_LATEST = 1.0  # s after which a channel's first reading says nothing of the start
_FIRST_READINGS = 0.1  # s whose mean starts the filter, or the first reading after it
_WIDE = {
    "position": 0.02, "drive": 0.0, "rate": 0.05, "drive_rate": 0.0, "spool": 0.02,
    "spool_rate": 0.2, "pressure_head": 1e6, "pressure_rod": 1e6,
    "speed": 1.0, "pressure_load": 1e5, "bristle": 0.5, "delivery": 0.3,
    "added_delivery": 0.1, "memory": 0.0,
}  # fmt: skip
REFERENCE_TRAVEL = 0.075  # m: the tables of this module hold for longer strokes; EHA, a laboratory actuator
REFERENCE_PRESSURE = 1.0e7  # Pa: they hold for higher feed pressures
_TRAVELLING = ("position", "rate", "drive", "drive_rate")  # kinds of states whose size follows the travel
_SLIP = 0.01  # m/s or rad/s, rate at which a drive may leave its load
_LOOSE = 0.02  # of the backlash, within which a drive's rest is known once it was looked for
_ROUGH = 1e5  # Pa, of a pressure's mean over the first rows
_NEWTON_STEPS = 20  # from home to any pose; a linkage needs about five
_GRID, _FINE = 7, 0.01  # rests that are tried at first, and how fine they are at last
_MOVED = {"spool": 1.0, "spool_rate": 25.0}  # per command at the start, what it may be off by
_BLIND = {"pressure_head": 5e6, "pressure_rod": 5e6}


def state_scales(machine: Machine, names: Sequence[str]) -> np.ndarray:
    """Return the sizes in which the states of a machine are counted, relative to those of the tables.

    Process noise, start uncertainty and differences for derivatives are stated for machines from a
    laboratory actuator (75 mm, 100 bar) to 20 t. Those of a smaller machine are proportional to its travel
    and feed pressure.

    Args:
        machine: the machine.
        names: n states, also those of late readings and residual inputs.

    Returns:
        (n,) sizes [1], at most 1; 1 for angles, spools and all other states.
    """
    joints = {facts.joint: name for name, facts in machine.axes.items()}
    sizes = np.ones(len(names))
    for s, name in enumerate(names):
        kind, _, place = name.partition(".")
        axis = joints.get(place, place)
        if kind in _TRAVELLING and (travel := _sliding_travel(machine, kind, place, axis)):
            sizes[s] = min(1.0, travel / REFERENCE_TRAVEL)
        elif kind.startswith("pressure_") and axis in machine.hydraulic_axes:
            sizes[s] = min(1.0, machine.max_feed_pressure(axis) / REFERENCE_PRESSURE)
    return sizes


def _sliding_travel(machine: Machine, kind: str, place: str, axis: str) -> float | None:
    """Travel of a state that is a length [m]; None of an angle, or where it is not limited."""
    if kind.startswith("drive"):
        cylinder = machine.axes[axis].cylinder
        return cylinder.stroke if cylinder else None
    joint = machine.joints[place]
    return joint.range[1] - joint.range[0] if joint.type == "slide" and joint.range else None


def start_state(
    machine: Machine, data: Dataset, run: RunData, model: Model, names: list[str],
    rest: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """State and covariance before the first reading.

    Args:
        machine: the machine.
        data: the dataset, for its channels.
        run: the run.
        model: the machine's reduced model.
        names: its states.
        rest: (t,) where the drive of each transmission rests in its backlash, from -1 to 1; by
            default in the middle.

    Returns:
        ((nz,) state, (nz, nz) covariance), wide enough to let the first readings decide.
    """
    order = actuator_order(machine)
    joints = {machine.axes[a].joint: a for a in order}
    state = np.zeros(len(names))
    scales = state_scales(machine, names)
    wide = scales * by_kind(names, _WIDE)
    cut = run.start > run.log.time[0] + 0.5 * run.period  # out of a record, in motion
    shown = {}
    for c, name in enumerate(data.channels):
        head = run.reading[: _first_rows(run, c), c]
        if np.isfinite(head).any():
            value = float(np.nanmean(head))
            shown[name] = (value - model.offset[c]) / model.scale[c]
    for s, name in enumerate(names):
        kind, _, place = name.partition(".")
        axis = joints.get(place, place)
        if kind == "position":
            channel = f"{machine.position_kind(axis)}.{axis}" if axis in order else ""
            state[s] = shown.get(channel, machine.home.get(place, 0.0))
        elif kind in _MOVED and cut:  # the command has been there for long, or has just come
            given = float(np.clip(run.command[0, order.index(axis)], -1.0, 1.0))
            state[s] = given if kind == "spool" else 0.0
            wide[s] = np.hypot(wide[s], _MOVED[kind] * given)
        elif kind in _BLIND:  # a load cylinder rests without pressure, and none shows it
            state[s] = shown.get(f"{kind}.{axis}", 3e6 * scales[s])
            if f"{kind}.{axis}" not in shown:
                wide[s] = _BLIND[kind] * scales[s]
    for k, pump in enumerate(machine.pumps):
        if f"{DELIVERY_STATE}.{pump}" in names:
            state[names.index(f"{DELIVERY_STATE}.{pump}")] = _drawn_fractions(model, state)[k]
    _place_by_lengths(model, data, state, shown)
    spread = np.diag(wide**2)
    _place_drives(model, state, spread, np.zeros(len(model.transmission)) if rest is None else rest)
    return state, spread


def _place_by_lengths(model: Model, data: Dataset, state: np.ndarray, shown: Mapping[str, float]) -> None:
    """Move the joints of cylinders whose lengths are read, and positions are not, to these lengths.

    Newton's method on all of these joints at once, starting from the home position. It stops where a step
    no longer brings the lengths closer, so that a length beyond the linkage's reach gives the nearest pose.
    """
    free = set(range(len(data.axes)))
    for channel in shown:
        kind, _, axis = channel.partition(".")
        if kind in ("angle", "position") and axis in data.axes:
            free.discard(data.axes.index(axis))
    wanted = {i: shown[f"length.{data.axes[i]}"] for i in sorted(free) if f"length.{data.axes[i]}" in shown}
    if not wanted:
        return
    space, n = model_space(model), len(model.mech.independent)
    drives, lengths = list(wanted), np.array(list(wanted.values()))

    def miss(moved: np.ndarray) -> np.ndarray:
        place(model, space, moved)
        return lengths - np.array([load_position(model, space, i) for i in drives])

    left = miss(state)
    for _ in range(_NEWTON_STEPS):
        step = np.linalg.lstsq(space.row[drives, :n], left, rcond=None)[0]
        moved = state.copy()
        moved[:n] += step
        other = miss(moved)
        if not np.linalg.norm(other) < np.linalg.norm(left):
            break
        state[:], left = moved, other


def _drawn_fractions(model: Model, state: np.ndarray) -> list[float]:
    """Return the fraction of its flow that each pump delivers if all valves have been at rest."""
    act = state[2 * (len(model.mech.independent) + len(model.transmission)) :]
    ports = circuit_scratch()
    compute_inlet_conditions(model.user, act, act, ports, 0, model.hydraulic, 0.0, act)
    write_demanded_fractions(model.user, 0, model.hydraulic, ports)
    found, i = [], 0
    while i < model.hydraulic:
        found.append(float(ports[DEMAND + i]))
        i += group_size(model.user, 0, model.hydraulic, i)
    return found


def _first_rows(run: RunData, c: int) -> int:
    """Rows that show a channel's first readings."""
    rows = max(1, round(_FIRST_READINGS / run.period))
    good = np.flatnonzero(np.isfinite(run.reading[:, c]))
    late = len(good) and good[0] >= rows and good[0] * run.period < _LATEST
    return int(good[0]) + 1 if late else rows


def _place_drives(model: Model, state: np.ndarray, spread: np.ndarray, rest: np.ndarray) -> None:
    """Put every drive where it rests in its backlash; at its end, where its spring pushes back.

    A drive is as uncertain as its load, and by what backlash, friction and pressures leave open.
    """
    space = model_space(model)
    place(model, space, state)
    n, t = len(model.mech.independent), len(model.transmission)
    first = 2 * (n + t)
    for i, gear in enumerate(model.gear):
        if gear < 0:
            continue
        _, stiffness, _, backlash = model.transmission[gear]
        numbers = model.user[i * SLOT_COUNT : (i + 1) * SLOT_COUNT]
        twist, held = 0.5 * rest[gear] * backlash, numbers[Slot.COULOMB] + numbers[Slot.STRIBECK]
        if i < model.hydraulic and (abs(rest[gear]) == 1.0 or backlash == 0.0):
            head, rod = first + 4 * i + 2, first + 4 * i + 3
            areas = numbers[Slot.AREA_HEAD], numbers[Slot.AREA_ROD]
            twist += (areas[0] * state[head] - areas[1] * state[rod]) / stiffness
            held += np.hypot(*areas) * _ROUGH
        state[n + gear] = load_position(model, space, i) + twist
        loose = _LOOSE * backlash + held / stiffness
        for at, size in ((0, loose), (n + t, _SLIP)):
            drive, row = at + n + gear, space.row[i]
            spread[drive, :] = row @ spread[at : at + n, :]
            spread[:, drive] = spread[drive, :]
            spread[drive, drive] = row @ spread[at : at + n, drive] + size**2


def find_rest(loss: Callable[[np.ndarray], float], free: np.ndarray) -> np.ndarray:
    """Where drives rest in their backlash, one after the other.

    Args:
        loss: of the run's first seconds, for (t,) rests.
        free: (t,) whether a transmission has backlash.

    Returns:
        (t,) rests from -1 to 1.
    """
    rest = np.zeros(len(free))
    for gear in np.flatnonzero(free):

        def at(value: float, gear: int = int(gear)) -> float:
            moved = rest.copy()
            moved[gear] = value
            return loss(moved)

        grid = np.linspace(-1.0, 1.0, _GRID)
        tried = [at(value) for value in grid]
        best, width = grid[np.argmin(tried)], grid[1] - grid[0]
        inside = max(-1.0, best - width), min(1.0, best + width)
        value, least, _, _ = fminbound(at, *inside, xtol=_FINE, full_output=True)
        rest[gear] = value if least < min(tried) else best
    return rest


STEP = 1.0e-3  # s: 2 ms leaves errors of 1000 in the loss where the pump is starved, 1 ms none of 100
COARSE = 4.0e-3  # s, for a first look at a candidate; at 6.7 ms an inertia that rings is not seen
_TANGENT = 5.0e-3  # s, for the transition Jacobians: a covariance need not be exact
_STIFF = 1.0e-3  # s, the least that a transmission asks for: its spring may ring at 150 Hz with oil
_MAX_PHASE_RAD = 1.6  # rad of an oscillation per step, of the 2 rad at which Verlet's method is unstable
_SLOWEST_RAD_S = 1.0  # rad/s: slower oscillations limit no step
_RADIAN = 0.94  # of such a ring that a step may cross: that of 150 Hz in 1 ms


@dataclass(frozen=True)
class Levels:
    """How large everything is that a model does not predict.

    Attributes:
        noise: (c,) standard deviation of a logged reading [channel's unit], see `row_noise`.
        inputs: the m unknown inputs.
        sizes: (m,) their stationary standard deviations [N], [N m], [m^3/s] or [1].
        drift: kind of state -> standard deviation of what 20 ms add to it, in units of its scale (see
            `state_scales`), where that is not the floor that `DRIFT` states.
        jitter: standard deviation of the instants at which channels are read [s].
        penalty: -2 log prior of the levels.
        colours: coloured parts of the readings' noise; `noise` is the white part.
    """

    noise: np.ndarray
    inputs: tuple[Input, ...] = ()
    sizes: np.ndarray = field(default_factory=lambda: np.zeros(0))
    drift: Mapping[str, float] = field(default_factory=dict)
    jitter: float = 0.0
    penalty: float = 0.0
    colours: tuple[Colour, ...] = ()

    @property
    def whole_noise(self) -> np.ndarray:
        """(c,) standard deviation of a reading's noise, white and coloured [channel's unit]."""
        found = self.noise**2
        for colour in self.colours:
            found[colour.channel] += colour.size**2
        return np.sqrt(found)


@dataclass(frozen=True)
class Track:
    """One run crossed by one model.

    Attributes:
        run: the run.
        levels: the noise levels that it was crossed with.
        loss: -2 log likelihood without its constant.
        whitened: (n, c) prediction errors over their predicted spread, NaN where missing.
        predicted: (n, c) one-step predictions [channel's unit].
        states: (n, nz) states after each row's readings.
        gains: gains and whiteners used.
        names: the states that the gains know, those of readings on their way and of unknown inputs
            included.
        start: (nz,) state before the first reading.
        rest: (t,) where the drives of transmissions rested in their backlash, see `start_state`;
            NaN where they have none.
        columns: (n, m, nz) what unit inputs add to the model's states over a row.
        initial: (nz, nz) covariance before the first reading, of all states; 0 with kept gains.
        flow: (n, nz, nz) transition Jacobians as of `filter_run`; empty unless asked for.
        scales: (nz,) sizes in which the states of `names` are counted, see `state_scales`.
    """

    run: RunData
    levels: Levels
    loss: float
    whitened: np.ndarray
    predicted: np.ndarray
    states: np.ndarray
    gains: Gains
    names: tuple[str, ...]
    start: np.ndarray
    rest: np.ndarray
    columns: np.ndarray
    initial: np.ndarray
    flow: np.ndarray
    scales: np.ndarray

    @property
    def is_compact(self) -> bool:
        """Whether gains and Jacobians were left out."""
        return len(self.gains.slope) < len(self.whitened)

    def compact(self) -> "Track":
        """Return the same without gains and Jacobians."""
        gains = Gains(self.gains.slope[:0].copy(), self.gains.gain[:0].copy(), self.gains.spread)
        return dataclasses.replace(self, gains=gains, columns=self.columns[:0].copy(), flow=self.flow[:0].copy())

    @property
    def process_variances(self) -> np.ndarray:
        """(nz,) variance that a row adds to the states."""
        return state_drift(list(self.names), self.levels, self.run.period, self.scales)

    @property
    def unknown_command_variances(self) -> np.ndarray:
        """(nz,) variance that a row with unknown command adds to the states."""
        return (self.scales * by_kind(list(self.names), STARTLE)) ** 2


_NUDGE = {
    "position": 1e-6, "drive": 1e-6, "rate": 1e-5, "drive_rate": 1e-5, "spool": 1e-5,
    "spool_rate": 1e-3, "pressure_head": 100.0, "pressure_rod": 100.0,
    "speed": 1e-3, "pressure_load": 100.0,
    "bristle": 1e-3, "delivery": 1e-4, "added_delivery": 1e-4, "memory": 1e-3, "late": 1.0,
    "input": 1.0, STATE: 1.0,
}  # fmt: skip
# What 20 ms may add to a state beyond the model: integrator error, not physics.
DRIFT = {
    "position": 2e-6, "drive": 2e-6, "rate": 2e-4, "drive_rate": 2e-4, "spool": 1e-4,
    "spool_rate": 1e-2, "pressure_head": 5e3, "pressure_rod": 5e3,
    "speed": 2e-2, "pressure_load": 5e3, "bristle": 5e-3, "delivery": 1e-3,
    "added_delivery": 1e-3,
}  # fmt: skip
DRIFT_TIME = 0.02  # s over which a process noise adds its standard deviation, as of a random walk
STARTLE = {
    "spool": 0.2,
    "spool_rate": 5.0,
    "pressure_head": 2e6,
    "pressure_rod": 2e6,
    "rate": 0.02,
    "speed": 20.0,
    "pressure_load": 2e6,
    "bristle": 0.5,
    "delivery": 0.2,
    "added_delivery": 0.1,
}

_ROWS_OF_A_RATE = 5
_DOUBT = 3.0  # times a reading's noise: lacks of pressure below it are taken for noise
_LOOK = 3.0  # s at a run's start that tell where drives rested in their backlash


def by_kind(names: Sequence[str], table: Mapping[str, float]) -> np.ndarray:
    """(nz,) numbers of a table by state or kind of state; 0 for what it lacks."""
    return np.array([table.get(name, table.get(name.partition(".")[0], 0.0)) for name in names])


class _ByIdentity:
    """An object as the key of a cache, equal to itself only."""

    def __init__(self, value) -> None:
        self.value = value

    def __hash__(self) -> int:
        return id(self.value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _ByIdentity) and other.value is self.value


_MACHINES_AT_ONCE = 16  # that the threads of a search compare, each on all of its runs


@lru_cache(maxsize=_MACHINES_AT_ONCE)
def _prepare(machine: _ByIdentity, data: _ByIdentity) -> tuple[Model, list[str], float]:
    """Model and names of the states of a machine, and the longest step [s] that it allows; not to be modified."""
    return (
        following_model(machine.value, data.value),
        state_names(machine.value),
        fine_enough(machine.value, math.inf),
    )


def fine_enough(machine: Machine, step: float) -> float:
    """A step [s], made smaller where a machine needs it.

    A pump's own circuit is stiff, and its piston light: with stiff lines they ring at 200 Hz and
    more, which steps of some milliseconds make unstable. So does a light drive on the spring of its
    transmission, and a small valve drive on the oil of its chambers.
    """
    springs = [
        max(_STIFF, _RADIAN / natural_frequency(machine, name))
        for name, axis in machine.axes.items() if axis.transmission
    ]  # fmt: skip
    rigid = [max_pump_drive_time_step(machine, name) for name, axis in machine.axes.items() if axis.pump]
    return min([step, *springs, *rigid, max_valve_drive_time_step(machine)])


def max_valve_drive_time_step(machine: Machine) -> float:
    """Return the longest step that resolves the mechanism's oscillation on the oil of its valve drives.

    Args:
        machine: the machine.

    Returns:
        Step [s]: 5 ms times a negative power of two, so that small parameter changes seldom change it. It is
        below `1.6 / omega` with the highest natural frequency omega [rad/s] of the mass matrix at home and the
        stiffness of the oil at the end of each stroke where it is highest. Infinite where 5 ms, the largest
        step of the filter, is short enough, and without valve drives.

    Source: stability limit of Verlet's method, h < 2 / omega, with a margin of 20 % for other poses.
    """
    if not machine.valve_axes:
        return math.inf
    model, names = reduced_model(machine, ()), state_names(machine)
    space, state = model_space(model), np.zeros(len(names))
    for s, name in enumerate(names):
        kind, _, place_name = name.partition(".")
        state[s] = machine.home.get(place_name, 0.0) if kind == "position" else 0.0
    place(model, space, state)
    accelerate(model, space, state, 0.0)
    n = len(model.mech.independent)
    factor, stiffness = np.tril(space.mass)[:n, :n], np.zeros((n, n))
    for i, axis in enumerate(actuator_order(machine)[: model.hydraulic]):
        if machine.axes[axis].valve and model.gear[i] < 0:
            row = space.row[i]
            stiffness += _oil_stiffness(machine, axis) * np.outer(row, row)
    whitened = np.linalg.solve(factor, np.linalg.solve(factor, stiffness).T)
    if not np.isfinite(whitened).all():  # an impossible mass matrix, at which the filter stops
        return math.inf
    omega = math.sqrt(max(float(np.linalg.eigvalsh(whitened)[-1]), _SLOWEST_RAD_S**2))
    longest = _MAX_PHASE_RAD / omega
    return math.inf if longest >= _TANGENT else _TANGENT * 2.0 ** math.floor(math.log2(longest / _TANGENT))


def _oil_stiffness(machine: Machine, axis: str) -> float:
    """Stiffness of the oil of a valve drive at the end of the stroke where it is highest [N/m] or [N m/rad]."""
    drive, cylinder = machine.axes[axis].hydraulic_drive, machine.axes[axis].cylinder
    assert machine.supply
    ends = np.array([0.0, cylinder.stroke if cylinder else 0.0])
    total = np.zeros(2)
    for area, volume in zip(drive.effective_areas, drive.chamber_volumes(ends), strict=True):
        oil = np.maximum(volume, drive.dead_volume) / machine.supply.bulk_modulus + drive.hose_compliance
        total += area**2 / oil
    return float(total.max())


def steps_per_row(machine: Machine, period: float, step: float) -> int:
    """Steps in which a row is crossed.

    Args:
        machine: the machine.
        period: of the rows [s].
        step: about what they should be [s]; they are finer where the machine needs it.

    Returns:
        Their number, at least 1.
    """
    return max(_min_steps_per_row(machine, period), round(period / step))


def _min_steps_per_row(machine: Machine, period: float) -> int:
    """Return the steps per row of a period [s] that a machine needs, at least 1."""
    return max(1, math.ceil(period / fine_enough(machine, period) - 1e-6))


def first_rows(track: Track, rows: int) -> Track:
    """The first rows of a track, for a look at less than its run; without transition Jacobians."""
    part = slice(0, rows)
    run = track.run.select_rows(0, min(rows, len(track.run.command)))
    gains = Gains(*(np.ascontiguousarray(table[part]) for table in track.gains))
    return dataclasses.replace(
        track, run=run, gains=gains, whitened=track.whitened[part],
        predicted=track.predicted[part], states=track.states[part], columns=track.columns[part],
        flow=track.flow[:0],
    )  # fmt: skip


def known_levels(data: Dataset) -> bool:
    """Whether the machine states the accuracy of every channel."""
    return bool(np.all(np.isfinite(data.noise)))


def row_variances(levels: Levels, run: RunData, rates: np.ndarray | None = None) -> np.ndarray:
    """(n, c) variance of the readings of a run, which may be means of logged ones.

    An instant that is off by dt makes a reading wrong by its rate times dt. The `squared_rates` of
    the run are found where they are not given.
    """
    noise = levels.noise if run.readings_per_mean is None else levels.noise / np.sqrt(run.readings_per_mean)
    found = np.tile(noise**2, (len(run.reading), 1))
    if levels.jitter:
        found += levels.jitter**2 * (squared_rates(run) if rates is None else rates)
    return found


def squared_rates(run: RunData) -> np.ndarray:
    """(n, c) squares of the rates of a run's readings, over as many as one is the mean of.

    Rates are slopes of straight lines through five rows, missing ones filled in linearly; 0 of a
    channel that was never read, and in a run of fewer rows.
    """
    whole, clock = np.zeros(run.reading.shape), np.arange(len(run.reading))
    for c, reading in enumerate(run.reading.T):
        if (good := np.isfinite(reading)).any():
            whole[:, c] = np.interp(clock, clock[good], reading[good])
    if len(whole) < _ROWS_OF_A_RATE:
        return np.zeros(whole.shape)
    rates = savgol_filter(whole, _ROWS_OF_A_RATE, 1, deriv=1, delta=run.period, axis=0)
    found = np.asarray(rates) ** 2
    return found if run.readings_per_mean is None else found / run.readings_per_mean


def state_drift(names: list[str], levels: Levels, period: float, scales: np.ndarray) -> np.ndarray:
    """(nz,) variance that a row adds to the states of a track by these names, of (nz,) `scales`."""
    drift = period / DRIFT_TIME * (scales * by_kind(names, {**DRIFT, **levels.drift})) ** 2
    m = len(levels.inputs)
    drift[len(names) - m :] = input_drift(levels.sizes, period)
    for colour in levels.colours:
        for label in state_labels([colour]):
            drift[names.index(label)] = colour.drift(period)
    return drift


def track_run(
    machine: Machine, data: Dataset, run: RunData, kept: Track | None = None,
    step: float = STEP, levels: Levels | None = None, columns: np.ndarray | None = None,
    linearise: bool = False, rest: np.ndarray | None = None, flow: np.ndarray | None = None,
) -> Track:  # fmt: skip
    """Cross a run with a machine.

    Args:
        machine: the machine to try.
        data: the dataset that the run belongs to.
        run: the run.
        kept: a track whose gains, whiteners, levels and start are kept; None computes them anew.
        step: largest step of the integrator [s].
        levels: noise levels; without them those that the machine states, and no inputs.
        columns: (n, m, nz) what unit inputs add to the states over a row.
        linearise: whether to keep the transition Jacobians; only without `kept`.
        rest: (t,) where drives rest in their backlash, from a track of a machine like it; it is
            looked for where this is None, of another machine, or NaN for a drive with backlash.
        flow: (n, nz, nz) transition Jacobians of the same machine near by, used instead of new
            ones, which cost most of a pass; only without `kept`.

    Returns:
        The track.
    """
    model, names, longest = _prepare(_ByIdentity(machine), _ByIdentity(data))
    if kept is not None:
        levels, columns = kept.levels, _for_states(kept, names)
    levels = levels or Levels(data.noise)
    trial = _Trial(machine, model, data, levels, step, names, longest)
    noise = row_variances(levels, run) if kept is None else np.zeros((0, len(data.channels)))
    if columns is None:
        columns = np.zeros((len(run.command), len(levels.inputs), len(names)))
    play = model.transmission[:, BACKLASH] > 0.0
    if kept is not None and len(kept.rest) == len(play):
        rest = kept.rest
    known = rest is not None and len(rest) == len(play) and bool(np.isfinite(rest[play]).all())
    if kept is None and not known:
        rows = min(max(2, round(_LOOK / run.period)), len(run.command))
        first, part = run.select_rows(0, rows), columns[:rows]
        rest = find_rest(
            lambda r: _cross(trial, first, None, r, part, noise[:rows]).loss,
            play,
        )
    elif rest is None or not known:
        rest = np.zeros(len(play))
    rest = np.where(play, rest, np.nan)
    return _cross(trial, run, kept, rest, columns, noise, linearise, flow)


def following_model(machine: Machine, data: Dataset) -> Model:
    """Reduced model whose chambers give off air only where readings can tell that they lack oil.

    An estimate below atmosphere by less than a few times the noise is mostly just that; taken for a
    chamber with air it would be a thousand times as soft, and stay there. A chamber whose pressure
    no sensor reads is taken for filled.
    """
    model, user = reduced_model(machine, data.channels), None
    noise = dict(zip(data.channels, data.noise, strict=True))
    for i, name in enumerate(actuator_order(machine)[: model.hydraulic]):
        read = [noise.get(f"pressure_{side}.{name}", np.nan) for side in ("head", "rod")]
        user = model.user.copy() if user is None else user
        user[i * SLOT_COUNT + Slot.AIR_ONSET] = np.inf if np.isnan(read).any() else _DOUBT * max(read)
    return model if user is None else model._replace(user=user)


def _for_states(kept: Track, names: list[str]) -> np.ndarray:
    """Columns of a kept track for a model with other states: 0 for those that it lacked."""
    before = list(kept.names[: len(kept.start)])
    if before == names:
        return kept.columns
    columns = np.zeros((*kept.columns.shape[:2], len(names)))
    for s, name in enumerate(before):
        if name in names:
            columns[:, :, names.index(name)] = kept.columns[:, :, s]
    return columns


class _Trial(NamedTuple):
    """A machine that is tried on the runs of a dataset."""

    machine: Machine
    model: Model
    data: Dataset
    levels: Levels
    step: float
    names: list[str]
    longest: float


def _cross(
    trial: _Trial, run: RunData, kept: Track | None, rest: np.ndarray, columns: np.ndarray,
    noise: np.ndarray, linearise: bool = False, given: np.ndarray | None = None,
) -> Track:  # fmt: skip
    machine, model, data, levels, step, own_names, longest = trial
    least = max(1, math.ceil(run.period / min(run.period, longest) - 1e-6))
    fine, coarse = (max(least, round(run.period / s)) for s in (step, _TANGENT))
    space = model_space(model)
    space.time[1] = run.start
    names, late = list(own_names), late_readings(model, run.period)
    rows, c, size, m = len(run.command), len(data.channels), len(names), len(levels.inputs)
    start, spread = start_state(machine, data, run, model, names, np.nan_to_num(rest))
    shown = [data.channels[k] for k in late.channel]
    names += [
        f"late.{channel}.{i - late.first[k]}" for i, (channel, k) in enumerate(zip(shown, late.channel, strict=True))
    ]
    names += state_labels(levels.colours)
    names += [f"input.{i.name}" for i in levels.inputs]
    full = len(names)
    if kept is None:
        gains = Gains(np.zeros((rows, c, full)), np.zeros((rows, c, full)), np.zeros((rows, c)))
    else:
        gains = kept.gains
        if not set(kept.names) <= set(names):  # the model lacks a transmission or a lag of theirs
            there = [s for s, name in enumerate(kept.names) if name in names]
            gains = Gains(
                np.ascontiguousarray(gains.slope[:, :, there]),
                np.ascontiguousarray(gains.gain[:, :, there]), gains.spread,
            )  # fmt: skip
    known = tuple(n for n in kept.names if n in names) if kept else tuple(names)
    whitened, predicted = np.empty((rows, c)), np.empty((rows, c))
    states = np.empty((rows, size))
    state, covariance = np.zeros(full), np.zeros((full, full))
    state[:size], covariance[:size, :size] = start, spread
    at = np.arange(full - m, full)
    covariance[at, at] = levels.sizes**2
    for colour in levels.colours:
        for label in state_labels([colour]):
            covariance[names.index(label), names.index(label)] = colour.size**2
    initial = np.zeros((full, full))
    if given is not None and given.shape[1] != full:  # another number of readings on their way
        given = None
    flow = np.zeros((rows if linearise else 0, full, full)) if given is None else given  # the last row stays 0
    scales = state_scales(machine, names)
    variances = Variances(
        noise, state_drift(names, levels, run.period, scales), (scales * by_kind(names, STARTLE)) ** 2
    )
    steps = Steps(fine, coarse, scales * by_kind(names, _NUDGE))
    own = np.array([names.index(name) for name in known])
    lines = Linearisation(kept is None, given is not None, own, gains, initial, flow)
    loss = filter_run(
        model, space, late, state, covariance,
        MeasuredRun(run.command, run.command_known, run.reading, run.period), variances,
        (steps, lines),
        (InputEffect(columns, decay(run.period)), ColouredNoise(*join_transitions(levels.colours, run.period))),
        Crossing(whitened, predicted, states),
    )  # fmt: skip
    return Track(
        run, levels, loss, whitened, predicted, states, gains, known, start, rest, columns,
        initial, flow, state_scales(machine, known),
    )  # fmt: skip


@compiled
def _respond(slope, gain, spread, whitened, flow, column, values, out):
    rows, channels, size = slope.shape
    count, states = values.shape[1], column.shape[1]
    moved, next_ = np.zeros((size, count)), np.zeros((size, count))
    delta, error = np.zeros((size, count)), np.zeros(count)
    for row in range(rows):
        delta[:] = 0.0
        for c in range(channels):
            if np.isnan(whitened[row, c]):
                continue
            error[:] = 0.0
            for s in range(size):
                h = slope[row, c, s]
                if h != 0.0:
                    for p in range(count):
                        error[p] -= h * (moved[s, p] + delta[s, p])
            for p in range(count):
                out[row, c, p] = error[p] / spread[row, c]
            for s in range(size):
                k = gain[row, c, s]
                for p in range(count):
                    delta[s, p] += k * error[p]
        moved += delta
        if row == rows - 1:
            break
        next_[:] = 0.0
        for s in range(size):
            for r in range(size):
                f = flow[row, s, r]
                if f != 0.0:
                    for p in range(count):
                        next_[r, p] += f * moved[s, p]
        for r in range(states):
            for p in range(count):
                next_[r, p] += column[row, r] * values[row, p]
        moved[:] = next_


def error_responses(track: Track, column: np.ndarray, values: np.ndarray, rows: slice = slice(None)) -> np.ndarray:
    """Change of a track's whitened errors per unit of each of p additions.

    Args:
        track: linearised, with n rows and c channels.
        column: (n, nz) what a unit of the addition, held over a row, adds to the model's states, as
            `filter.input_columns` has it [state's unit per unit of the addition].
        values: (n, p) the additions in every row.
        rows: some of the track's, n of which there are values.

    Returns:
        (n, c, p) changes [1 per unit of the addition]; 0 where a reading is missing.

    Source: linearised innovations with kept gains, Anderson and Moore 1979, Optimal Filtering,
        chapter 8.
    """
    gains = track.gains
    out = np.zeros((*track.whitened[rows].shape, values.shape[1]))
    _respond(
        gains.slope[rows], gains.gain[rows], gains.spread[rows], track.whitened[rows],
        track.flow[rows], np.ascontiguousarray(column)[rows], np.ascontiguousarray(values), out,
    )  # fmt: skip
    return out
