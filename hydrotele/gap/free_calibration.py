"""Numbers that only free runs tell, calibrated before the search for effects.

A machine file that is an estimate says so: `uncertainty: {flow_table: 1.0, linkage: 0.15}`. What a
valve lets through at which command then weighs more than any effect of the library, and where no
pressure is read, one-step predictions hardly feel it. So these numbers are fitted to free runs
first, and an effect is what remains after that. The fit is kept only if it predicts stretches of
the fit runs better that are left out of it one by one.

A drive with a pump of its own is told by free runs, too, pressures or not: what its motor, its oil
and its friction do lasts longer than a reading, and where a pump stalls or a piston sticks, one-
step predictions say nothing. All numbers that its machine file calls uncertain are fitted then.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from hydrotele.effects.effect import changed
from hydrotele.estimate.calibration import CALIBRATION, calibration, numbers
from hydrotele.estimate.free_run import free_run_errors, machine_runner
from hydrotele.estimate.hypothesis import Guess
from hydrotele.estimate.open_numbers import (
    DIRECTIONS,
    LOG,
    TRAVEL,
    open_numbers,
    states_open_numbers,
    table_steps,
)
from hydrotele.estimate.output_error import LEAD, REMEMBERED, WINDOW, FreeRunFit, fit_free_runs
from hydrotele.estimate.stretches import thinned
from hydrotele.gap.result import Estimate
from hydrotele.logs.load import Dataset, RunData
from hydrotele.machine.machine import Machine

_NORMAL95 = 1.96
_WORSE = 1.05  # times the errors of free runs: less is no loss
_FLOW_TABLE = "flow_table"
_PUMP_WINDOW = 2.5  # s of a pump drive: a move of a stroke of some centimetres
_PUMP_REMEMBERED = 0.1  # s: the lag of its motor, see `output_error`


@dataclass(frozen=True)
class FreeCalibration:
    """A machine calibrated by free runs.

    Attributes:
        machine: with the numbers found, each as uncertain as free runs leave it.
        numbers: such as `linkage.stick.base` or `flow_table.boom.positive_50`, the opening at 50 %
            travel beyond the dead band; ratios to the given machine where no unit fits.
        note: one sentence on what stretches that were left out say.
        seconds: length of the free runs [s].
    """

    machine: Machine
    numbers: dict[str, Estimate]
    note: str
    seconds: float

    def undone_by(self, data: Dataset, machine: Machine, jobs: int) -> bool:
        """Whether another machine predicts free runs of the held-out run worse than this one.

        Worse is a larger median over the windows, in the geometric mean over the channels. What
        free runs have told must not be lost to one-step errors, which a drift may absorb.
        """

        def medians(some: Machine) -> np.ndarray:
            runner = machine_runner(some, data)(data.heldout)
            errors = free_run_errors(runner, data.heldout, (self.seconds,), to_end=False)
            return np.array([horizon.median for horizon in errors.horizons.values()])

        with ThreadPoolExecutor(jobs) as pool:
            own, other = pool.map(medians, (self.machine, machine))
        ratio = other / own
        return bool(np.any(ratio > 0.0) and not np.nanmean(np.log(ratio)) <= np.log(_WORSE))


def calibrate_freely(
    data: Dataset, jobs: int, tell: Callable[[str], None] = lambda text: None
) -> FreeCalibration | None:
    """Calibrate what a machine file leaves open, if it does.

    Args:
        data: the dataset; `heldout` is not seen.
        jobs: threads.
        tell: told of every round.

    Returns:
        The calibration; None where the machine states no such uncertainty, a pressure of a valve
        drive is read, runs are too short, or
        stretches that are left out are predicted no better.
    """
    guess, seconds, remembered = _open(data), WINDOW, REMEMBERED
    if any(axis.pump for axis in data.machine.axes.values()):
        seconds, remembered = _PUMP_WINDOW, _PUMP_REMEMBERED
    if guess is None or all(_seconds(run) < LEAD + 2.0 * seconds for run in data.fit):
        return None
    fit = fit_free_runs(thinned(data), guess, seconds, jobs=jobs, say=tell, remembered=remembered)
    before, after = fit.left_out
    if not np.mean(np.log(after / before)) < 0.0:
        return None
    closer = ", ".join(
        f"{channel} {100.0 * (1.0 - b / a):.0f} %"
        for channel, a, b in zip(data.channels, before, after, strict=True)
    )
    note = (
        "What the machine file leaves open was calibrated by free runs first; stretches of"
        f" {seconds:g} s, left out of the fit one by one, are predicted closer by: {closer}."
    )
    return FreeCalibration(_told(data.machine, fit), _numbers(data.machine, fit), note, seconds)


def _seconds(run: RunData) -> float:
    return len(run.command) * run.period


def _open(data: Dataset) -> Guess | None:
    """What is left open, at nominal; None if nothing is."""
    machine = data.machine
    if machine.uncertainty and any(axis.pump for axis in machine.axes.values()):
        group = calibration(machine)
        return Guess(((group, np.zeros(group.size)),))
    pressures = any(channel.startswith("pressure") for channel in data.channels)
    return None if pressures or not states_open_numbers(machine) else open_numbers(machine)


def _told(nominal: Machine, fit: FreeRunFit) -> Machine:
    """The fitted machine, whose numbers are as uncertain as the fit leaves them.

    Else one-step predictions, which know little of a number that free runs tell, take it back.
    """
    stated, place = dict(nominal.uncertainty), fit.guess.names
    sd = dict(zip(place, fit.deviation_sd, strict=True))
    first = f"{CALIBRATION}.all."
    known, found = numbers(nominal), numbers(fit.machine)
    for name in place:
        key = name.removeprefix(first)
        if name.startswith(first) and key in found:
            ratio = known[key].parameter.scale / found[key].parameter.scale
            stated[key] = found[key].share * ratio * min(float(sd[name]), 1.0)
    return changed(fit.machine, "uncertainty", stated)


def _numbers(nominal: Machine, fit: FreeRunFit) -> dict[str, Estimate]:
    """All numbers of a fit with their intervals."""
    covariance, first, found = fit.covariance, 0, {}
    for hypothesis, deviation in fit.guess.parts:
        own = slice(first, first + hypothesis.size)
        first += hypothesis.size
        values = np.array(list(hypothesis.values(deviation).values()))
        scale = np.array([p.scale for p in hypothesis.parameters.values()])
        spread = covariance[own, own] * np.outer(scale, scale)
        if hypothesis.name == _FLOW_TABLE:
            keys = list(hypothesis.parameters)
            found |= _openings(nominal, hypothesis.location, keys, values, spread)
        for k, (key, p) in enumerate(hypothesis.parameters.items()):
            if hypothesis.name == _FLOW_TABLE and p.unit == LOG:
                continue
            reach = _NORMAL95 * np.sqrt(spread[k, k])
            numbers = np.array([values[k], values[k] - reach, values[k] + reach, p.nominal])
            numbers = np.clip(numbers, p.low, p.high)
            if p.unit == LOG:
                numbers = np.exp(numbers)
            value, low, high, was = map(float, numbers)
            unit = "1" if p.unit == LOG else p.unit
            place = f"{hypothesis.name}.{hypothesis.location}.{key}"
            place = key if hypothesis.name == CALIBRATION else place
            found[place] = Estimate(value, unit, low, high, was)
    return found


def _openings(
    nominal: Machine, axis: str, keys: list[str], values: np.ndarray, spread: np.ndarray
) -> dict[str, Estimate]:
    """Openings of a flow table at its knots, intervals to first order in its logarithms."""
    valve, found = nominal.axes[axis].valve, {}
    assert valve
    count = len(TRAVEL) - 1
    for way in DIRECTIONS:
        own = [keys.index(f"gain_{way}"), *(keys.index(f"{way}_{k + 1}") for k in range(count))]
        gain, *logs = values[own]
        steps = table_steps(getattr(valve, way))
        grown = steps * np.exp(gain + np.array(logs))
        openings = np.cumsum(grown)
        slope = np.column_stack([openings, np.tril(np.tile(grown, (count, 1)))])
        reach = _NORMAL95 * np.sqrt(np.diag(slope @ spread[np.ix_(own, own)] @ slope.T))
        for travel, value, own_reach, was in zip(
            TRAVEL[1:], openings, reach, np.cumsum(steps), strict=True
        ):
            low, high = max(0.0, float(value - own_reach)), float(value + own_reach)
            key = f"{_FLOW_TABLE}.{axis}.{way}_{round(100 * travel)}"
            found[key] = Estimate(float(value), "1", low, high, float(was))
    return found
