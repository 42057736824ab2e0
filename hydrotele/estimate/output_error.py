"""A machine's numbers from free runs: output-error fits over windows of some seconds.

One-step errors judge what a model says of the next reading. Where angles are all that is read, and
often, the next one is nearly the last one whatever the model is, and small errors of the speed,
which a user sees after five seconds, hardly count. So the model runs freely through many windows,
each started from the filter's state, and its deviations d are those of the least loss

    sum over windows and channels of  w rho(e / s) + d'd,   rho(z) = 2 (sqrt(1 + z^2) - 1),

with a unit normal as prior of d and a scale s of each channel's errors, which is found on the way.
The loss is robust because digging, stalls and end stops are in no model: they shall not bend it. An
error integrates what the speed lacks, so neighbouring rows say the same thing again: w counts them
as one value per second.

Source: Ljung 1999, *System Identification*, 7.3 (output error, simulation focus) and 15.2 (robust
norms); Bock 1987 (multiple shooting: windows keep the error of the start from growing); Gauss-
Newton steps damped as of Levenberg and Marquardt (Nocedal and Wright 2006, 10.3).

What an estimated machine leaves open of its drives, as hypotheses for a fit to free runs.

A machine file that was written from a brochure knows neither what its valves let through at which
command, nor how late they do, nor its cylinder pins to the centimetre. Each is a few numbers with a
wide prior; every one is the logarithm of a ratio to the machine as it is, so that none changes its
sign, and 0 is nominal.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.effects import Parameter, with_value
from hydrotele.estimate.free_run import _run_from, _shown, following_levels
from hydrotele.estimate.hypothesis import Guess, Hypothesis
from hydrotele.estimate.reduced_model import model_space, reduced_model
from hydrotele.estimate.track import Levels, steps_per_row, track_run
from hydrotele.kinematics.drive_linkage import joint_range_at_drive
from hydrotele.logs.dataset import Dataset, RunData
from hydrotele.machine.drives import FlowCurve, Metering
from hydrotele.machine.machine import Machine

TRAVEL = (0.0, 0.15, 0.3, 0.5, 0.75, 1.0)
"""Knots of a flow table in travel beyond the dead band [1], closest where valves begin to open."""

UNCERTAINTY = {
    "flow_table": 1.0, "delay": 0.05, "spool_lag": 1.4, "valve_damping": 0.4, "linkage": 0.15,
    "relief_pressure": 0.4, "pump_flow_limit": 0.4,
}  # fmt: skip
"""Prior standard deviations: of logarithms [1], of the delay [s]."""

LOG = "log"
"""Unit of a parameter that is the logarithm of a ratio to the machine as it is."""

DIRECTIONS = ("positive", "negative")
_LOWEST, _HIGHEST = -5.0, 2.5  # logarithms of a table's steps: from closed to 12 times as steep
_SHAPE, _DEADBAND = 0.5, 0.15  # standard deviations of steps and dead bands, per one of the gain
_WIDEST = 0.6  # dead band [1]
_EVEN = 1.0e-3  # least step of a table, in openings: a flat one could not be scaled up
_LONGEST_DELAY = 0.5  # s
_CLEARANCE = 0.02  # m, by which a closed cylinder is longer than its stroke


def states_uncertain_parameters(machine: Machine) -> bool:
    """Whether a machine file says how uncertain its flow tables or linkages are.

    Args:
        machine: the machine.

    Returns:
        True with a key `flow_table` or `linkage`, for all axes or one, in its `uncertainty`.
    """
    return any(key.partition(".")[0] in ("flow_table", "linkage") for key in machine.uncertainty)


def uncertain_parameters(machine: Machine) -> Guess:
    """All that an estimate leaves open of the machine's drives, at nominal.

    Args:
        machine: the nominal machine.

    Returns:
        Flow tables, timing and linkages of all axes, and the supply; only those that it has.
    """
    found = []
    for axis, facts in machine.axes.items():
        found.append(timing(machine, axis))
        if facts.valve:
            found.append(flow_table(machine, axis))
        if joint_range_at_drive(machine, axis) and facts.cylinder and not facts.four_bar:
            found.append(linkage(machine, axis))
    if machine.supply and machine.hydraulic_axes:
        found += [supply_limits(machine, name) for name in machine.pumps]
    return Guess(tuple((hypothesis, np.zeros(hypothesis.size)) for hypothesis in found))


def flow_table(machine: Machine, axis: str) -> Hypothesis:
    """Flow over command of both directions: a dead band, a gain and a monotone table each.

    The opening at knot k is the gain times the sum of the steps up to it; the parameters are the
    logarithms of the ratios to the present ones, so that no table ever falls. Gain and dead band
    are in the steps, too; as numbers of their own they say that a table is moved and stretched as a
    whole rather than bent, which a minute of data needs to be told.

    Args:
        machine: the nominal machine.
        axis: one with a valve.

    Returns:
        The hypothesis, of 14 parameters.
    """
    scale = _share(machine, "flow_table", axis)
    valve = machine.axes[axis].valve
    assert valve
    shape, band = _SHAPE * scale, _DEADBAND * scale
    parameters = {}
    for way, present in zip(DIRECTIONS, valve.deadbands, strict=True):
        most = max(_WIDEST, present)
        parameters[f"deadband_{way}"] = Parameter("1", present, 0.0, most, band, 0.1 * band)
        parameters[f"gain_{way}"] = Parameter(LOG, 0.0, _LOWEST, _HIGHEST, scale, 0.1 * scale)
        step = Parameter(LOG, 0.0, _LOWEST, _HIGHEST, shape, 0.1 * shape)
        parameters |= {f"{way}_{k}": step for k in range(1, len(TRAVEL))}

    def change(nominal: Machine, values: Mapping[str, float]) -> Machine:
        valve = nominal.axes[axis].valve
        assert valve
        for way, present in zip(DIRECTIONS, valve.deadbands, strict=True):
            path = f"axes.{axis}.valve.{way}"
            steps = [values[f"{way}_{k}"] for k in range(1, len(TRAVEL))]
            logs = values[f"gain_{way}"] + np.array(steps)
            if np.any(logs):
                nominal = with_value(nominal, f"{path}.curve", stretched(getattr(valve, way), logs))
            if values[f"deadband_{way}"] != present:
                nominal = with_value(nominal, f"{path}.deadband", values[f"deadband_{way}"])
        return nominal

    return Hypothesis("flow_table", axis, parameters, change)


def stretched(present: Metering, logs: np.ndarray) -> FlowCurve:
    """A direction's flow curve with its steps between the knots of `TRAVEL` made larger or smaller.

    Args:
        present: the direction; straight without a curve.
        logs: (5,) logarithms of the steps' ratios [1].

    Returns:
        The curve.

    Source: a sum of positive steps never falls.

    >>> curve = stretched(Metering(), np.array([-5.0, -5.0, 0.0, 0.0, 0.0]))
    >>> [round(opening, 3) for opening in curve.opening]
    [0.0, 0.001, 0.002, 0.202, 0.452, 0.702]
    """
    opening = np.concatenate([[0.0], np.cumsum(table_steps(present) * np.exp(logs))])
    return FlowCurve(travel=TRAVEL, opening=tuple(float(o) for o in opening))


def table_steps(present: Metering) -> np.ndarray:
    """Steps of a direction's opening between the knots of `TRAVEL`.

    Args:
        present: the direction; straight without a curve.

    Returns:
        (5,) steps, none of them less than a thousandth [1].
    """
    old = present.curve or FlowCurve(travel=(0.0, 1.0), opening=(0.0, 1.0))
    return np.maximum(np.diff(np.interp(TRAVEL, old.travel, old.opening)), _EVEN)


def timing(machine: Machine, axis: str) -> Hypothesis:
    """Delay of an axis' command; bandwidth and damping of its spool, if it has one.

    Args:
        machine: the nominal machine.
        axis: any.

    Returns:
        The hypothesis, of one or three parameters.
    """
    facts = machine.axes[axis]
    scale, delay = _share(machine, "delay", axis), facts.command_delay
    high = max(_LONGEST_DELAY, 2.0 * delay)
    parameters = {"delay": Parameter("s", delay, 0.0, high, scale, 0.05 * scale)}
    if facts.valve:
        parameters["bandwidth"] = _log(_share(machine, "spool_lag", axis), math.log(20.0))
        parameters["damping"] = _log(_share(machine, "valve_damping", axis), math.log(4.0))

    def change(nominal: Machine, values: Mapping[str, float]) -> Machine:
        nominal = with_value(nominal, f"axes.{axis}.command_delay", values["delay"])
        valve = nominal.axes[axis].valve
        for field in ("bandwidth", "damping") if valve else ():
            value = getattr(valve, field) * math.exp(values[field])
            nominal = with_value(nominal, f"axes.{axis}.valve.{field}", value)
        return nominal

    return Hypothesis("timing", axis, parameters, change)


def linkage(machine: Machine, axis: str) -> Hypothesis:
    """Where the pins of a cylinder sit, seen from the joint that it moves.

    `base` and `rod` are logarithms of the pins' distances from the joint, `angle` turns the rod pin
    about it [rad]. Closed length and stroke go along, so that the joint keeps its range between the
    same ends.

    Args:
        machine: the nominal machine.
        axis: one with a cylinder between the two links that its joint connects.

    Returns:
        The hypothesis, of three parameters.
    """
    scale = _share(machine, "linkage", axis)
    ratio, angle = _log(scale, math.log(2.0)), Parameter("rad", 0.0, -0.6, 0.6, scale, 0.1 * scale)

    def change(nominal: Machine, values: Mapping[str, float]) -> Machine:
        if not any(values.values()):
            return nominal
        before = joint_range_at_drive(nominal, axis)
        cylinder, joint = nominal.axes[axis].cylinder, nominal.axes[axis].joint
        assert cylinder and before
        name = nominal.link_of(joint)
        moved = nominal
        for end, pin in (("base_pin", cylinder.base_pin), ("rod_pin", cylinder.rod_pin)):
            grown = math.exp(values["base" if end == "base_pin" else "rod"])
            centre = np.zeros(3) if pin.link == name else np.array(nominal.links[name].position)
            arm = grown * (np.array(pin.position) - centre)
            if end == "rod_pin":
                arm = _turned(arm, np.array(nominal.joints[joint].axis), values["angle"])
            place = tuple(float(x) for x in centre + arm)
            moved = with_value(moved, f"axes.{axis}.cylinder.{end}.position", place)
        after = joint_range_at_drive(moved, axis)
        if after is None:  # the linkage would turn back within the joint's range
            return nominal
        stroke = cylinder.stroke + (after[1] - after[0]) - (before[1] - before[0])
        closed = max(cylinder.closed_length + after[0] - before[0], stroke + _CLEARANCE)
        moved = with_value(moved, f"axes.{axis}.cylinder.stroke", stroke)
        return with_value(moved, f"axes.{axis}.cylinder.closed_length", closed)

    return Hypothesis("linkage", axis, {"base": ratio, "rod": ratio, "angle": angle}, change)


def supply_limits(machine: Machine, name: str = "supply") -> Hypothesis:
    """Return the hypothesis on relief pressure and flow of a pump.

    Args:
        machine: the nominal machine, with valves.
        name: name of the pump.

    Returns:
        The hypothesis, of two parameters, one on a constant-pressure supply.
    """
    place, path = ("supply", "supply") if name == "supply" else (f"supply.{name}", f"supplies.{name}")
    parameters = {"relief_pressure": _log(_share(machine, "relief_pressure", place), math.log(3.0))}
    if machine.pumps[name].kind != "constant_pressure":
        share = _share(machine, "pump_flow_limit", place)
        parameters["pump_flow"] = _log(share, math.log(3.0))

    def change(nominal: Machine, values: Mapping[str, float]) -> Machine:
        for field, value in values.items():
            new = getattr(nominal.pumps[name], field) * math.exp(value)
            nominal = with_value(nominal, f"{path}.{field}", new)
        return nominal

    return Hypothesis("supply", place, parameters, change)


def _log(scale: float, most: float) -> Parameter:
    return Parameter(LOG, 0.0, -most, most, scale, 0.1 * scale)


def _share(machine: Machine, kind: str, place: str) -> float:
    """Prior standard deviation, as the machine states it or by default."""
    stated = machine.uncertainty
    return stated.get(f"{kind}.{place}", stated.get(kind, UNCERTAINTY[kind]))


def _turned(vector: np.ndarray, axis: np.ndarray, angle: float) -> np.ndarray:
    """A vector (3,) turned about a unit axis (3,) by an angle [rad] (Rodrigues)."""
    return (
        vector * math.cos(angle)
        + np.cross(axis, vector) * math.sin(angle)
        + axis * (axis @ vector) * (1.0 - math.cos(angle))
    )


WINDOW = 5.0  # s: shorter windows weigh the start, longer ones what no model can know
LEAD = 2.0  # s of readings before a window that tell its start
MOST_WINDOWS = 240  # in all: 1200 s; an hour's digging differs from the next one's
REMEMBERED = 2.5  # s of a window in which errors say one thing
_STILL = 0.01  # of a channel's range: a window in which all channels move less says nothing
_STEPS = (1.0e-2, 4.0e-3, 2.0e-3, 1.0e-3)  # s of the integrator, the largest that does
_ROUGHNESS = 0.02  # of the errors, that a larger step may add
_NUDGE = 0.05  # typical deviations, for slopes: windows with friction are not smooth below
_ROUND = 5  # steps between new starts
_FALL = 0.003  # of the loss, that another round must promise: less is no better model
_LOOKS_AT, _FEWEST = (16, 4, 1), 12  # one window out of so many, round by round; at least so many
_SMALLEST_SCALE = 1.0e-9  # of errors, against a division by nothing [channel's unit]
_FAR = 1.0e9  # error of a run that left all numbers behind [channel's unit]
_LOOKS = 8  # windows that choose the integrator's step
_DAMPING = 1.0e-2, 4.0, 1.0e6  # at first, factor, and where no step helps


class Window(NamedTuple):
    """A stretch of a run through which the model runs freely.

    Attributes:
        run: the whole run, whose commands are on their way when the window begins.
        first: row of the start.
        count: rows after it.
    """

    run: RunData
    first: int
    count: int

    @property
    def measured(self) -> np.ndarray:
        """(count, c) readings, NaN where there is none to hold the model against."""
        rows = slice(self.first + 1, self.first + 1 + self.count)
        reading = self.run.reading[rows]
        valid = self.run.valid
        return reading if valid is None else np.where(valid[rows, None], reading, np.nan)


@dataclass(frozen=True)
class FreeRunFit:
    """A guess fitted to free runs.

    Attributes:
        guess: the guess.
        machine: the machine that has it.
        before: (c,) RMS error of the windows before the fit [channel's unit].
        after: (c,) and after it.
        scale: (c,) of the errors, as of the robust loss [channel's unit].
        covariance: (P, P) of the deviations; the prior's is the unit matrix.
        loss: as fitted, with the last scales.
        iterations: damped Gauss-Newton steps taken.
        converged: whether the loss no longer fell; if not, allow more iterations.
        windows: number of windows.
        step: of the integrator [s].
        left_out: (2, c) mean over the windows of their RMS error, before the fit and as it would be
            of a fit without the window [channel's unit].
    """

    guess: Guess
    machine: Machine
    before: np.ndarray
    after: np.ndarray
    scale: np.ndarray
    covariance: np.ndarray
    loss: float
    iterations: int
    converged: bool
    windows: int
    step: float
    left_out: np.ndarray

    @property
    def deviation_sd(self) -> np.ndarray:
        """(P,) standard deviations of the deviations; 1 is the prior's own."""
        return np.sqrt(np.diag(self.covariance))


def fit_free_runs(
    data: Dataset, guess: Guess, seconds: float = WINDOW, most: int = MOST_WINDOWS,
    max_iterations: int = 10, jobs: int = 2, say: Callable[[str], None] = lambda text: None,
    remembered: float = REMEMBERED,
) -> FreeRunFit:  # fmt: skip
    """Fit a guess's deviations to free runs through windows of the fit runs.

    Args:
        data: the dataset; its machine is the nominal one, `heldout` is not seen.
        guess: hypotheses with the deviations to begin at.
        seconds: length of the windows [s].
        most: number of windows, spread evenly over those in which anything moves.
        max_iterations: Gauss-Newton steps, at every number of windows.
        jobs: worker threads.
        say: told of every step.
        remembered: time in which errors say one thing [s]: shorter where what drives them is.

    Returns:
        The fit.

    Raises:
        InputError: the guess has no parameters, or no window fits into the runs.
    """
    if not len(guess.deviation):
        raise InputError("the hypothesis", "has no parameters to fit: add an effect or parameters")
    windows = free_run_windows(data.fit, seconds, most)
    fewer = sorted({max(1, min(k, len(windows) // _FEWEST)) for k in _LOOKS_AT}, reverse=True)
    with ThreadPoolExecutor(jobs) as pool:
        problem = _Problem(data, windows, following_levels(data), pool, remembered=remembered)
        problem = replace(problem, step=_large_step(problem, guess))
        first = now = _point(problem, guess)
        taken, converged = 0, False
        for every in fewer:
            part = replace(problem, windows=windows[::every])
            begin = _point(part, now.guess)
            now, steps, converged = _fit(part, begin, max_iterations, say)
            taken += steps
        scale, weights = _scales(now.errors, windows), problem.weights()
        columns = _columns(problem, now, scale)
        return FreeRunFit(
            guess=now.guess, machine=now.machine,
            before=_rms(first.errors), after=_rms(now.errors), scale=scale,
            covariance=_covariance(now, columns, weights, scale, windows),
            loss=_loss(now, weights, scale), iterations=taken, converged=converged,
            windows=len(windows), step=problem.step,
            left_out=np.array([
                _scales(first.errors, windows),
                _scales(_left_out(now, columns, weights, scale, windows), windows),
            ]),
        )  # fmt: skip


def free_run_windows(runs: Sequence[RunData], seconds: float = WINDOW, most: int = MOST_WINDOWS) -> list[Window]:
    """Windows side by side through all runs, without those in which nothing moves.

    Args:
        runs: the runs.
        seconds: length [s].
        most: number of windows; if there are more, these are spread evenly over them.

    Returns:
        The windows.

    Raises:
        InputError: there is none.
    """
    readings = np.concatenate([run.reading for run in runs])
    still = _STILL * (np.nanmax(readings, axis=0) - np.nanmin(readings, axis=0))
    found = []
    for run in runs:
        count, lead = round(seconds / run.period), round(LEAD / run.period)
        for first in range(lead, len(run.reading) - count, max(1, count)):
            window = Window(run, first, count)
            measured = window.measured
            known = np.isfinite(measured).any(axis=0)
            moved = np.zeros(len(still))
            moved[known] = np.nanmax(measured[:, known], axis=0)
            moved[known] -= np.nanmin(measured[:, known], axis=0)
            if np.any(moved > still):
                found.append(window)
    if not found:
        raise InputError(
            "the runs to fit",
            f"contain no interval of {LEAD + seconds:g} s with motion: use longer runs or a shorter window",
        )
    every = np.linspace(0, len(found) - 1, min(most, len(found)))
    return [found[k] for k in np.round(every).astype(int)]


@dataclass(frozen=True)
class _Problem:
    """What a fit is held against.

    Attributes:
        data: the dataset.
        windows: the windows.
        levels: noise levels of the filter that tells their starts.
        pool: the workers.
        step: largest step of the integrator [s].
        remembered: time of a window in which errors say one thing [s].
    """

    data: Dataset
    windows: list[Window]
    levels: Levels
    pool: ThreadPoolExecutor
    step: float = _STEPS[-1]
    remembered: float = REMEMBERED

    def leads(self, machine: Machine) -> list[np.ndarray]:
        """(lead + 1, nz) states before every window, the last of them its start."""

        def lead(window: Window) -> np.ndarray:
            part = window.run.select_rows(window.first - _rows(window, LEAD), window.first + 1)
            return track_run(machine, self.data, part, step=self.step, levels=self.levels).states

        return list(self.pool.map(lead, self.windows))

    def errors(self, machine: Machine, leads: Sequence[np.ndarray]) -> np.ndarray:
        """(r, c) errors in all rows of all windows, NaN without a reading [channel's unit]."""
        model = reduced_model(machine, self.data.channels)
        late, out = bool(np.any(model.lag > 0.0) or np.any(model.time_constant > 0.0)), []
        for window, states in zip(self.windows, leads, strict=True):
            measured, run = window.measured, window.run
            lead, period = len(states) - 1, run.period
            made = np.full(measured.shape, np.nan)
            if np.isfinite(states[-1]).all():
                space, begin = model_space(model), window.first - lead
                space.time[1] = run.start + begin * period
                command = run.command[begin : window.first + window.count + 1]
                before = _shown(model, states, period) if late else np.zeros((1, len(model.lag)))
                steps = steps_per_row(machine, period, self.step)
                start = states[-1].copy()
                _run_from(model, space, start, command, lead, period, steps, before, made)
            with np.errstate(over="ignore", invalid="ignore"):
                error = np.where(np.isfinite(made), made - measured, np.inf)
            out.append(np.where(np.isnan(measured), np.nan, np.clip(error, -_FAR, _FAR)))
        return np.concatenate(out)

    def weights(self) -> np.ndarray:
        """(r, c) share of every row of an independent value; 0 without a reading."""
        out = []
        for window in self.windows:
            known = np.isfinite(window.measured)
            values = window.count * window.run.period / self.remembered
            out.append(known * values / np.maximum(known.sum(axis=0), 1))
        return np.concatenate(out)


@dataclass(frozen=True)
class _Point:
    """A guess and the errors of its free runs."""

    guess: Guess
    machine: Machine
    leads: list[np.ndarray]
    errors: np.ndarray


def _fit(problem: _Problem, now: _Point, max_iterations: int, say: Callable[[str], None]) -> tuple[_Point, int, bool]:
    """Rounds of steps with kept starts, until a round with new starts is no better.

    Returns:
        (point, steps taken, whether the loss no longer fell).
    """
    weights = problem.weights()
    scale = _scales(now.errors, problem.windows)
    taken, converged = 0, False
    while not converged and taken < max_iterations:
        tried, steps = _descend(problem, now, weights, scale, min(_ROUND, max_iterations - taken))
        taken += steps
        fresh = _point(problem, tried.guess)
        before, after = (_loss(point, weights, scale) for point in (now, fresh))
        converged = before - after < _FALL * before
        if after < before:
            now, scale = fresh, _scales(fresh.errors, problem.windows)
        count = len(problem.windows)
        say(f"open-loop fit, {count} windows: loss decreases from {before:.1f} to {after:.1f}")
    return now, taken, converged


def _descend(problem: _Problem, now: _Point, weights: np.ndarray, scale: np.ndarray, most: int) -> tuple[_Point, int]:
    """At most so many damped Gauss-Newton steps with the starts of a point; (point, steps)."""
    damping, factor, largest = _DAMPING
    loss = _loss(now, weights, scale)
    for taken in range(1, most + 1):
        slope, information = _normal_equations(now, _columns(problem, now, scale), weights, scale)
        fall = 0.0
        while fall <= 0.0 and damping < largest:
            damped = information + damping * np.diag(np.diag(information))
            step = np.linalg.solve(damped, -slope)
            tried = _trial(problem, now, now.guess.at(now.guess.deviation + step))
            fall = loss - _loss(tried, weights, scale)
            damping = damping / factor if fall > 0.0 else damping * factor
        if fall > 0.0:
            now, loss = tried, loss - fall
        if fall < _FALL * loss:
            return now, taken
    return now, most


def _point(problem: _Problem, guess: Guess, leads: list[np.ndarray] | None = None) -> _Point:
    """A guess with its errors; from given starts, else from those that its own filter finds."""
    machine = guess.machine(problem.data.machine)
    leads = leads or problem.leads(machine)
    return _Point(guess, machine, leads, problem.errors(machine, leads))


def _trial(problem: _Problem, now: _Point, guess: Guess) -> _Point:
    """Return a point with another guess and the starts of a point; outside the model's domain all errors are `_FAR`."""
    if guess.is_in_domain(problem.data.machine):
        return _point(problem, guess, now.leads)
    return replace(now, guess=guess, errors=np.where(np.isnan(now.errors), np.nan, _FAR))


def _columns(problem: _Problem, now: _Point, scale: np.ndarray) -> np.ndarray:
    """(r, c, P) slopes of the scaled errors in the deviations, 0 without a reading."""
    deviation, nudges = now.guess.deviation, now.guess.nudges(_NUDGE)

    def column(p: int) -> np.ndarray:
        for nudge in (nudges[p], -nudges[p]):  # to the other side where the first is outside the domain
            moved = deviation.copy()
            moved[p] += nudge
            there = now.guess.at(moved)
            if np.array_equal(there.deviation, moved) and there.is_in_domain(problem.data.machine):
                machine = there.machine(problem.data.machine)
                slope = (problem.errors(machine, now.leads) - now.errors) / (nudge * scale)
                return np.where(np.isnan(now.errors), 0.0, slope)
        return np.zeros(now.errors.shape)

    return np.stack(list(problem.pool.map(column, range(len(deviation)))), axis=2)


def _normal_equations(
    now: _Point, columns: np.ndarray, weights: np.ndarray, scale: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Slope (P,) and Gauss-Newton curvature (P, P) of half the loss in the deviations."""
    slope, curvature = _half_loss(now.errors / scale, columns, weights)
    return slope + now.guess.deviation, curvature + np.eye(len(slope))


def _half_loss(z: np.ndarray, columns: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Slope (P,) and curvature (P, P) of half the loss of scaled errors (r, c), without prior."""
    known = weights > 0.0
    there = columns[known]
    bent = weights[known] / np.sqrt(1.0 + z[known] ** 2)
    weighted = there * bent[:, None]
    return weighted.T @ z[known], there.T @ weighted


def _covariance(
    now: _Point, columns: np.ndarray, weights: np.ndarray, scale: np.ndarray,
    windows: Sequence[Window],
) -> np.ndarray:  # fmt: skip
    """(P, P) covariance of the deviations, from curvature and from what windows contradict.

    A model that is only nearly right is pulled another way by every window. So no number is surer
    than the scatter of the windows' slopes says, each window counted as one observation.

    Source: sandwich covariance, Huber 1967; by clusters, Liang and Zeger 1986, Biometrika 73(1).
    """
    usual = np.linalg.inv(_normal_equations(now, columns, weights, scale)[1])
    slopes, end = [], 0
    for window in windows:
        rows = slice(end, end + window.count)
        end += window.count
        slopes.append(_half_loss(now.errors[rows] / scale, columns[rows], weights[rows])[0])
    count = len(windows)
    if count < 2:
        return usual
    away = np.array(slopes) - np.mean(slopes, axis=0)
    scatter = away.T @ away * count / (count - 1) + np.eye(len(usual))
    robust = usual @ scatter @ usual
    wider = np.sqrt(np.maximum(np.diag(robust) / np.diag(usual), 1.0))
    return usual * np.outer(wider, wider)


def _left_out(
    now: _Point, columns: np.ndarray, weights: np.ndarray, scale: np.ndarray,
    windows: Sequence[Window],
) -> np.ndarray:  # fmt: skip
    """(r, c) errors of every window as of a fit without it [channel's unit].

    At the least loss, leaving out a window's slope g and curvature H_w moves the deviations by
    `(H - H_w)^-1 g`, to first order.

    Source: leave-one-out by one Newton step, Rad and Maleki 2020, J. R. Stat. Soc. B 82(4).
    """
    _, whole = _normal_equations(now, columns, weights, scale)
    errors, end = now.errors.copy(), 0
    for window in windows:
        rows = slice(end, end + window.count)
        end += window.count
        slope, own = _half_loss(now.errors[rows] / scale, columns[rows], weights[rows])
        errors[rows] += scale * (columns[rows] @ np.linalg.solve(whole - own, slope))
    return errors


def _loss(point: _Point, weights: np.ndarray, scale: np.ndarray) -> float:
    """Robust loss of the errors, plus the prior's."""
    known = weights > 0.0
    z = (point.errors / scale)[known]
    rho = 2.0 * (np.sqrt(1.0 + z**2) - 1.0)
    return float(weights[known] @ rho + point.guess.deviation @ point.guess.deviation)


def _scales(errors: np.ndarray, windows: Sequence[Window]) -> np.ndarray:
    """(c,) scale of every channel's errors: the mean over the windows of their RMS error."""
    ends = np.cumsum([window.count for window in windows])[:-1]
    each = np.array([_rms(part) for part in np.split(errors, ends)])
    return np.array([
        max(float(np.mean(column[np.isfinite(column)])), _SMALLEST_SCALE)
        if np.isfinite(column).any() else 1.0
        for column in each.T
    ])  # fmt: skip


def _rms(errors: np.ndarray) -> np.ndarray:
    """(c,) RMS of (r, c) errors; NaN without any."""
    known = np.isfinite(errors)
    total = np.sum(np.where(known, errors, 0.0) ** 2, axis=0)
    return np.sqrt(total / np.where(known.any(axis=0), known.sum(axis=0), np.nan))


def _rows(window: Window, seconds: float) -> int:
    return round(seconds / window.run.period)


def _large_step(problem: _Problem, guess: Guess) -> float:
    """The largest step of the integrator that adds little to the errors [s]."""
    every = max(1, len(problem.windows) // _LOOKS)
    part = replace(problem, windows=problem.windows[::every], step=_STEPS[-1])
    machine = guess.machine(problem.data.machine)
    leads = part.leads(machine)
    exact = part.errors(machine, leads)
    for step in _STEPS[:-1]:
        errors = replace(part, step=step).errors(machine, leads)
        if np.all(_rms(errors - exact) <= _ROUGHNESS * _rms(exact)):
            return step
    return _STEPS[-1]
