"""Extended Kalman filter on the reduced model: one-step prediction errors, whitened.

A run is crossed row by row. Readings are taken one after the other, so that a missing one is simply
left out. A second pass with another model may keep the gains and whiteners of the first: then the
whitened errors are smooth functions of the model's numbers, and their change is a signature.

Readings of sensors that are late, as further states of the filter.

A sensor with a delay shows later what the state was before: what it will show from one row to the
next is on its way. One with a first-order lag shows what it showed before, drawn towards the
present state: that is a state of its own, and if both, what it shows is what is delayed. Kept as
states, a late reading corrects the model through its own slope and not through that of the present.

Unknown inputs: force, flow and command that a machine has and its model lacks, as noise.

Each acts on one balance of one axis and is an Ornstein-Uhlenbeck process: it keeps its sign for
about a correlation time, as missing friction, leakage or valve opening does, and unlike white
process noise. They are further states of the filter; their sizes are found from the data
(`estimate.levels`), and a smoother reads them back, row by row.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hydrotele.core.compiled import compile_without_allocation, compiled
from hydrotele.effects.effect import with_value
from hydrotele.estimate.reduced_model import (
    Model,
    X,
    accelerate,
    add_sensor_drift,
    advance,
    follow_channel,
    load_position,
    model_space,
    place,
    read_channels,
    reduced_model,
    supply_of,
)
from hydrotele.hydraulics.actuator_layout import (
    ADDED_DELIVERY_STATE,
    SLOT_COUNT,
    ActuatorKind,
    Slot,
    actuator_order,
    extra_state_names,
    max_pump_drive_time_step,
)
from hydrotele.hydraulics.laws import air_compliance, air_softening_factor
from hydrotele.hydraulics.pump_drive import STALLED_SPEED
from hydrotele.hydraulics.supply import TERM_FLOW_TIME_CONSTANT
from hydrotele.machine.machine import Machine
from hydrotele.multibody.reduced_dynamics import solve_cholesky
from hydrotele.multibody.reduced_mechanism import JOINT
from hydrotele.terms.term import Term

MEMORY = 0.3  # s, correlation time: longer than a valve's lag, shorter than a motion
_USUAL_PRESSURE = 2.0e7  # Pa, of a pump's own circuit that states no relief setting
_TRIED = 1.0e-4  # of its largest size, by which an input of a pump drive is tried
_ROWS_STEP = 4.0e-3  # s, for what inputs do in a row
BALANCES = ("force", "flow_head", "flow_rod", "command")
SUPPLY = "flow_supply"
"""Balance of a pump that valves share; its input stands under the first axis that the pump feeds."""


class Input(NamedTuple):
    """An unknown input.

    Attributes:
        balance: out of `BALANCES`, or `SUPPLY`.
        axis: the axis on which it acts.
    """

    balance: str
    axis: str

    @property
    def name(self) -> str:
        """Balance and axis."""
        return f"{self.balance}.{self.axis}"


def possible_inputs(machine: Machine, axes: Sequence[str] = ()) -> tuple[Input, ...]:
    """Every unknown input of a machine, or of some of its axes; a force drive has one.

    One of the pump's flow is among them where the machine has a term of it.
    """
    found = []
    for axis in actuator_order(machine):
        if axes and axis not in axes:
            continue
        facts = machine.axes[axis]
        count = 4 if facts.valve else 3 if facts.pump else 1
        found += [Input(balance, axis) for balance in BALANCES[:count]]
    for pump in machine.pumps:
        if f"{ADDED_DELIVERY_STATE}.{pump}" in extra_state_names(machine):
            found.append(Input(SUPPLY, machine.axes_of_pump(pump)[0]))
    return tuple(found)


def input_sizes(machine: Machine, inputs: Sequence[Input]) -> np.ndarray:
    """(m,) the largest size of each input that makes sense: full force, rated flow, half stroke."""
    sizes = []
    for balance, axis in inputs:
        facts = machine.axes[axis]
        if balance == "command":
            sizes.append(0.5)
        elif balance == SUPPLY:
            sizes.append(machine.pumps[machine.pump_of(axis)].pump_flow)
        elif balance != "force":
            pump = facts.pump
            sizes.append(
                facts.valve.rated_flow if facts.valve
                else pump.displacement * pump.rated_speed if pump else math.nan
            )  # fmt: skip
        elif facts.force:
            sizes.append(abs(facts.force.gain) * facts.force.command_limit)
        else:
            pressure = machine.pumps[machine.pump_of(axis)].relief_pressure if machine.supply else _USUAL_PRESSURE
            sizes.append(pressure * facts.hydraulic_drive.effective_areas[0])
    return np.array(sizes)


def input_units(machine: Machine, inputs: Sequence[Input]) -> list[str]:
    """SI unit of each input."""
    units = {"command": "1", "flow_head": "m^3/s", "flow_rod": "m^3/s", SUPPLY: "m^3/s"}
    return [units.get(i.balance) or ("N m" if _turns(machine, i.axis) else "N") for i in inputs]


def _turns(machine: Machine, axis: str) -> bool:
    return machine.axes[axis].cylinder is None and machine.position_kind(axis) == "angle"


@compiled
def _drive_responses(model, sp, states, position, response):
    """Drive positions (n, nu), and accelerations per unit drive force (n, nu, rates)."""
    n, t = len(model.mech.independent), len(model.transmission)
    column = np.zeros(n + t)
    for row in range(len(states)):
        place(model, sp, states[row])
        accelerate(model, sp, states[row], 0.0)
        for i in range(len(model.gear)):
            position[row, i] = sp.drive[X, i]
            column[:] = 0.0
            if model.gear[i] >= 0:
                column[n + model.gear[i]] = 1.0
            else:
                for f in range(n):
                    column[f] = sp.row[i, f]
            solve_cholesky(sp.mass, column)
            response[row, i] = column


@compiled
def _rows_later(model, sp, states, command, period, steps, later):
    """States (n, nz) a row after given ones, without readings."""
    trail = np.zeros((0, 0))
    for row in range(len(states)):
        later[row] = states[row]
        advance(model, sp, later[row], command, row, period, steps, trail)


def _pumped_column(machine: Machine, states: np.ndarray, command: np.ndarray, period: float, i: Input) -> np.ndarray:
    """(n, nz) change of the states per unit of an input of a pump drive, by difference.

    Its oil and friction are faster than a row, so that no rule at the row's ends tells the change.
    Where dry friction holds, a force moves nothing until it breaks away; as what holds is itself
    uncertain, a force counts as on a piston that slides.
    """
    size = _TRIED * float(input_sizes(machine, [i])[0])
    if i.balance == "force":
        for part in ("coulomb", "stribeck_extra"):
            machine = with_value(machine, f"axes.{i.axis}.cylinder.friction.{part}", 0.0)
        if i.axis in machine.loads:
            bare = machine.loads[i.axis].model_copy(update={"friction": 0.0, "return_force": 0.0})
            machine = machine.model_copy(update={"loads": {**machine.loads, i.axis: bare}})
    term = Term.model_validate({
        "name": "unknown", "axis": i.axis, "balance": i.balance, "law": "constant",
        "parameters": {"value": size},
    })  # fmt: skip
    more = machine.model_copy(update={"terms": (*machine.terms, term)})
    steps = max(1, math.ceil(period / min(_ROWS_STEP, max_pump_drive_time_step(machine, i.axis))))
    ends = []
    for one in (machine, more):
        model, later = reduced_model(one, ()), np.empty(states.shape)
        _rows_later(model, model_space(model), states, command, period, steps, later)
        ends.append(later)
    return (ends[1] - ends[0]) / size


def input_columns(
    machine: Machine, states: np.ndarray, flow: np.ndarray, period: float, inputs: Sequence[Input],
    command: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Change of the model's states over each row per unit of each input.

    Args:
        machine: the machine.
        states: (n, nz) states of a run, row by row.
        flow: (n, >= nz, >= nz) their transition Jacobians as of `filter.filter_run`.
        period: time between rows [s].
        inputs: m unknown inputs.
        command: (n, nu) commands.

    Returns:
        (n, m, nz) changes [state's unit per input's unit], by the trapezoidal rule: half of what
        acts in a row is carried along by the row's transition. Those of pump drives by difference.
    """
    model = reduced_model(machine, ())
    order = actuator_order(machine)
    rows, size, nu = *states.shape, len(order)
    first = 2 * (len(model.mech.independent) + len(model.transmission))
    rates = first // 2
    position, response = np.empty((rows, nu)), np.empty((rows, nu, rates))
    _drive_responses(model, model_space(model), states, position, response)
    columns = np.zeros((rows, len(inputs), size))
    for m, (balance, axis) in enumerate(inputs):
        i = order.index(axis)
        facts = machine.axes[axis]
        if facts.pump:
            continue
        if balance == "force":
            columns[:, m, rates : 2 * rates] = response[:, i]
        elif balance == SUPPLY:
            pump = machine.pump_of(axis)
            at = first + 4 * model.hydraulic + extra_state_names(machine).index(f"{ADDED_DELIVERY_STATE}.{pump}")
            follows = 2.0 / period * math.tanh(0.5 * period / TERM_FLOW_TIME_CONSTANT)  # of its exponential
            columns[:, m, at] = follows / machine.pumps[pump].pump_flow
        elif balance == "command":
            assert facts.valve
            columns[:, m, first + 4 * i + 1] = facts.valve.bandwidth**2
        else:
            side = 2 if balance == "flow_head" else 3
            drive = facts.hydraulic_drive
            volume = np.maximum(drive.chamber_volumes(position[:, i])[side - 2], drive.dead_volume)
            oil = drive.hose_compliance
            if machine.supply:
                bubbles = np.array([
                    air_compliance(p, machine.supply.entrained_air)
                    for p in states[:, first + 4 * i + side]
                ])  # fmt: skip
                oil += volume * (1.0 / machine.supply.bulk_modulus + bubbles)
            columns[:, m, first + 4 * i + side] = 1.0 / oil
    carried = np.einsum("rms,rsk->rmk", columns, flow[:, :size, :size])
    columns = 0.5 * period * (columns + carried)
    for m, i in enumerate(inputs):
        if machine.axes[i.axis].pump:
            columns[:, m] = _pumped_column(machine, states, command, period, i)
    return columns


def decay(period: float) -> float:
    """By which factor an input falls over a row of a period [s]."""
    return math.exp(-period / MEMORY)


def input_drift(size: np.ndarray, period: float) -> np.ndarray:
    """Variance that a row adds to inputs of stationary standard deviations `size` (m,)."""
    return size**2 * (1.0 - decay(period) ** 2)


_CHANGE = 0.1  # s in which a channel may change as much as its value is unknown at a run's start


class DelayedReadings(NamedTuple):
    """Readings of late channels, q of them: per channel the next to be shown first.

    Attributes:
        channel: (q,) channel of each.
        due: (q,) time after a row's start at which the reading is taken that enters there [s];
            negative where the one behind moves up.
        first: (c,) place of each channel's next reading, -1 where it is not late.
        lags: (q,) whether it is what a first-order lag shows at present; last of its channel.
        stays: (q,) part of a change that is found in its place a row later [1].
        moves: (q,) part of a change that is found in the place before a row later [1].
        open: (q,) variance at a run's start beyond that of the present value, over that [1].
    """

    channel: np.ndarray
    due: np.ndarray
    first: np.ndarray
    lags: np.ndarray
    stays: np.ndarray
    moves: np.ndarray
    open: np.ndarray


def late_readings(model: Model, period: float) -> DelayedReadings:
    """Readings of the late channels of a model.

    Args:
        model: Model.
        period: of the rows [s].

    Returns:
        `floor(delay / period) + 1` readings per channel with a delay, and one more per channel
        with a first-order lag.
    """
    rows, first = [], np.full(len(model.lag), -1)
    for c, (delay, constant) in enumerate(zip(model.lag, model.time_constant, strict=True)):
        if delay == 0.0 and constant == 0.0:
            continue
        first[c] = len(rows)
        due = 0.0
        if delay > 0.0:
            count = int(delay / period) + 1
            due = max(0.0, count * period - delay)
            enter = [-1.0] * (count - 1) + [due]
            rows += [(c, at, False, 0.0, float(k > 0), 0.0) for k, at in enumerate(enter)]
        if constant > 0.0:
            passed = float(np.exp(-due / constant)) if delay > 0.0 else 0.0
            loose = min(1.0, constant / _CHANGE) ** 2
            rows.append((c, period, True, float(np.exp(-period / constant)), passed, loose))
    channel, at, lags, stays, moves, loose = zip(*rows, strict=True) if rows else ((),) * 6
    return DelayedReadings(
        np.array(channel, np.int64), np.array(at, float), first, np.array(lags, bool),
        np.array(stays, float), np.array(moves, float), np.array(loose, float),
    )  # fmt: skip


@compile_without_allocation
def begin_delayed(late, size, shown, z):
    """Fill the late readings as if the state had rested so far.

    Args:
        late: Late.
        size: number of states of the model.
        shown: (c,) what the sensors would show of the present state if they were not late.
        z: (size + q,) state, whose last q are written.

    Returns:
        Nothing.

    Source: pure transport delay; first-order lag.
    """
    for e in range(len(late.channel)):
        z[size + e] = shown[late.channel[e]]


@compile_without_allocation
def delayed_covariance(late, size, slope, spread):
    """Covariance of the late readings after `begin_delayed`.

    Args:
        late: Late.
        size: number of states of the model.
        slope: (c, size + q) slopes of the readings in the present state, if they were not late.
        spread: (size + q, size + q) covariance, whose last q rows and columns are written.

    Returns:
        Nothing.

    Source: propagation of covariance; what a first-order lag shows is moreover off by its time
        constant times the rate, at which the value may have changed by its own standard deviation
        in 0.1 s.
    """
    for e in range(len(late.channel)):
        s = size + e
        for k in range(s):
            total = 0.0
            for j in range(size):
                total += slope[late.channel[e], j] * spread[j, k]
            spread[k, s] = spread[s, k] = total
        total = 0.0
        for j in range(size):
            total += slope[late.channel[e], j] * spread[j, s]
        spread[s, s] = total + late.open[e] * total


@compile_without_allocation
def shift_delayed(model, late, size, trail, h, z):
    """Late readings a row later.

    Args:
        model: Model.
        late: Late.
        size: number of states of the model.
        trail: (steps + 1, c) what the late channels would show over the row if they were not, see
            `advance`; where a channel has a first-order lag, replaced by what that shows.
        h: step, scalar [s].
        z: (size + q,) state, whose last q are moved in place.

    Returns:
        Nothing.

    Source: pure transport delay and first-order lag, linear between steps.
    """
    for e in range(len(late.channel)):
        c = late.channel[e]
        if late.lags[e]:
            shown = (z[size + e] - model.offset[c]) / model.scale[c]
            follow_channel(trail, c, h / model.time_constant[c], shown)
    for e in range(len(late.channel)):
        if late.due[e] < 0.0:
            z[size + e] = z[size + e + 1]
            continue
        c = late.channel[e]
        low = min(int(late.due[e] / h), len(trail) - 2)
        value = trail[low, c] + (late.due[e] / h - low) * (trail[low + 1, c] - trail[low, c])
        z[size + e] = model.scale[c] * value + model.offset[c]


@compile_without_allocation
def perturb_delayed(late, place, change, readings):
    """Add to the late readings what a change of one of them makes of them a row later.

    Args:
        late: Late.
        place: which reading is changed.
        change: scalar [channel's unit].
        readings: (q,) late readings a row later without the change; changed in place.

    Returns:
        Nothing.

    Source: `shift_delayed`, which is linear in them.
    """
    readings[place] += late.stays[place] * change
    if place > 0:
        readings[place - 1] += late.moves[place] * change


_KIND, _PUMPED = int(Slot.KIND), float(ActuatorKind.PUMP_DRIVE)
_AIR, _ONSET = int(Slot.AIR_RELEASE), int(Slot.AIR_ONSET)
_BRISTLE_STIFFNESS, _BRISTLE = int(Slot.BRISTLE_STIFFNESS), int(Slot.BRISTLE)
_ASYMMETRY, _DELIVERY = int(Slot.COULOMB_ASYMMETRY), int(Slot.DELIVERY)


class Gains(NamedTuple):
    """What a pass of the filter keeps for later passes; n rows, c channels, nz states.

    Attributes:
        slope: (n, c, nz) d reading / d state.
        gain: (n, c, nz) correction of the state per prediction error.
        spread: (n, c) predicted standard deviation of the prediction error [channel's unit].
    """

    slope: np.ndarray
    gain: np.ndarray
    spread: np.ndarray


@compile_without_allocation
def _slopes(model, sp, z, nudge, slope, moved):
    """Slopes of the readings in a state that was just read."""
    first = 2 * (len(model.mech.independent) + len(model.transmission))
    slope[:] = 0.0
    n = len(model.mech.independent)
    for c in range(len(model.kind)):
        i = model.drive[c]
        if model.kind[c] == 0:
            for f in range(n):
                slope[c, f] = model.scale[c] * sp.motion.basis[model.mech.drive[i, JOINT], f]
        elif model.kind[c] == 1:
            if model.gear[i] >= 0:
                slope[c, n + model.gear[i]] = model.scale[c]
            else:
                for f in range(n):
                    slope[c, f] = model.scale[c] * sp.row[i, f]
        elif model.kind[c] < 4:
            air, onset = model.user[i * SLOT_COUNT + _AIR], model.user[i * SLOT_COUNT + _ONSET]
            soft = air_softening_factor(sp.act[4 * i + model.kind[c]], air, onset)
            slope[c, first + 4 * i + model.kind[c]] = model.scale[c] * soft
    for c in range(len(model.kind)):
        if model.kind[c] != 4:
            continue
        for s in range(first, len(z)):
            if s < first + 4 * model.hydraulic and (s - first) % 4 == 1:
                continue
            for r in range(len(z)):
                moved[r] = z[r]
            moved[s] += nudge[s]
            above = supply_of(model, sp, moved, model.drive[c])
            moved[s] -= 2.0 * nudge[s]
            below = supply_of(model, sp, moved, model.drive[c])
            slope[c, s] = model.scale[c] * (above - below) / (2.0 * nudge[s])


class MeasuredRun(NamedTuple):
    """A run of n rows.

    Attributes:
        command: (n, nu) commands.
        known: (n,) whether the row's command is known.
        reading: (n, c) readings, NaN where missing [channel's unit].
        period: between rows [s].
    """

    command: np.ndarray
    known: np.ndarray
    reading: np.ndarray
    period: float


class Variances(NamedTuple):
    """Noise of readings and of the process.

    Attributes:
        reading: (n, c) of the readings of every row; (0, c) where gains are kept.
        drift: (nz,) that a row adds to the state.
        unknown_command: (nz,) that a row with unknown command adds.
    """

    reading: np.ndarray
    drift: np.ndarray
    unknown_command: np.ndarray


class Steps(NamedTuple):
    """How finely a run is crossed.

    Attributes:
        mean: steps per row of the mean.
        covariance: steps per row of the covariance.
        difference: (nz,) differences for derivatives.
    """

    mean: int
    covariance: int
    difference: np.ndarray


class Linearisation(NamedTuple):
    """Gains and transitions, computed or used again.

    Attributes:
        fresh: whether to compute gains; False keeps those given.
        given: whether `flow` holds transition Jacobians already; only where `fresh`.
        own: (ng,) states that the gains know; of those that they lack, a transmission's follow
            the load. All states where `fresh`.
        gains: Gains, written if `fresh`, else used.
        initial: (nz, nz) written if `fresh`: covariance before the first row's readings.
        flow: (n, nz, nz) written if `fresh` and not `given`: d (state before the next row's
            readings) / d (state after this row's), the latter along the first index; (0, nz, nz)
            keeps none.
    """

    fresh: bool
    given: bool
    own: np.ndarray
    gains: Gains
    initial: np.ndarray
    flow: np.ndarray


class InputEffect(NamedTuple):
    """What m unknown inputs do.

    Attributes:
        columns: (n, m, nz - q - m) what each one, of size 1, adds to the model's states over a
            row.
        decay: by which factor inputs fall over a row.
    """

    columns: np.ndarray
    decay: float


class ColouredNoise(NamedTuple):
    """Coloured noise of readings, k states between the late readings and the residual inputs.

    Attributes:
        channel: (k,) channel to which a state is added, -1 for none.
        flow: (k, k) transition of the states over a row.
    """

    channel: np.ndarray
    flow: np.ndarray


class Crossing(NamedTuple):
    """What a filter writes of a run.

    Attributes:
        whitened: (n, c) errors; NaN where missing.
        predicted: (n, c) readings predicted from the rows before.
        corrected: (n, nz - q - m) the model's states after the row's readings.
    """

    whitened: np.ndarray
    predicted: np.ndarray
    corrected: np.ndarray


@compiled
def filter_run(model, sp, late, z, covariance, rows, variances, lines, extra, out):
    """Cross a run.

    Args:
        model: Model.
        sp: Space.
        late: DelayedReadings; its q readings follow the model's states, and are set here at first;
            k states of coloured noise and m residual inputs are the last of the nz states.
        z: (nz,) state before the first row's readings; overwritten.
        covariance: (nz, nz) its covariance; overwritten.
        rows: MeasuredRun.
        variances: Variances.
        lines: (Steps, Linearisation).
        extra: (InputEffect, ColouredNoise).
        out: Crossing, written.

    Returns:
        -2 log likelihood without its constant; infinite if the states broke down. From that row on,
        whitened errors are infinite where there is a reading, and predictions are NaN.

    Source: Anderson and Moore 1979, Optimal Filtering, chapters 6 and 8; sequential readings.
    """
    command, known, reading, period = rows
    noise, drift, unknown = variances
    (steps, coarse, nudge), (fresh, given, own, gains, initial, flow) = lines
    slope, gain, width = gains
    (columns, decay), (shown, turn) = extra
    tints = len(shown)
    whitened, predicted, corrected = out
    count, channels, full = reading.shape[0], reading.shape[1], len(z)
    inputs, h, few = columns.shape[1], period / steps, len(own)
    begin = full - inputs  # of the inputs
    tint = begin - tints  # of the coloured noise
    size = tint - len(late.channel)
    trail = np.zeros((steps + 1, channels))
    rough = np.zeros((coarse + 1, channels))
    if size == tint:  # nothing is late
        trail, rough = trail[:0], rough[:0]
    reached = np.zeros((full + 1, full))
    moved, work = np.zeros(size), np.zeros((full, full))
    delta, pull = np.zeros(few), np.zeros(full)
    noises = np.zeros(tints)
    place(model, sp, z)
    first = np.int64(0)  # numba compiles a function anew for a written number
    read_channels(model, sp, z, first, steps, h, trail[:0], predicted[0])
    begin_delayed(late, size, predicted[0], z)
    if fresh:
        _slopes(model, sp, z[:size], nudge, slope[0], moved)
        delayed_covariance(late, size, slope[0], covariance)
        initial[:] = covariance
    loss = 0.0
    for row in range(count):
        read_channels(model, sp, z, row, steps, h, trail[:0], predicted[row])
        if fresh:
            _slopes(model, sp, z[:size], nudge, slope[row], moved)
        for c in range(channels):
            if late.first[c] >= 0:
                predicted[row, c] = z[size + late.first[c]]
                if fresh:
                    slope[row, c, :] = 0.0
                    slope[row, c, size + late.first[c]] = 1.0
        add_sensor_drift(model, sp.time[1] + row * period, predicted[row])
        for k in range(tints):
            if shown[k] >= 0:
                predicted[row, shown[k]] += z[tint + k]
                if fresh:
                    slope[row, shown[k], tint + k] = 1.0
        delta[:] = 0.0
        for c in range(channels):
            if math.isnan(reading[row, c]):
                whitened[row, c] = math.nan
                continue
            hc = slope[row, c]
            error = reading[row, c] - predicted[row, c]
            for s in range(few):
                error -= hc[s] * delta[s]
            if fresh:
                total = update_covariance(covariance, hc, noise[row, c], pull, gain[row, c])
                if not total > 0.0:
                    _mark_unpredicted(reading, whitened, predicted, corrected, row)
                    return math.inf
                width[row, c] = math.sqrt(total)
            for s in range(few):
                delta[s] += gain[row, c, s] * error
            whitened[row, c] = error / width[row, c]
            loss += whitened[row, c] ** 2 + 2.0 * math.log(width[row, c])
        _correct(model, sp, z, own, delta)
        for s in range(size):
            corrected[row, s] = z[s]
        if not math.isfinite(loss):
            _mark_unpredicted(reading, whitened, predicted, corrected, row)
            return math.inf
        if row == count - 1:
            break
        if fresh:
            if given:
                reached[:full] = flow[row]
            else:
                for s in range(full, -1, -1):  # the state itself is the last row
                    moves = s < size or s == full
                    for r in range(full):
                        reached[s, r] = z[r] if moves else reached[full, r]
                    if s < size:
                        reached[s, s] += nudge[s]
                    if moves:
                        advance(model, sp, reached[s], command, row, period, coarse, rough)
                        shift_delayed(model, late, size, rough, period / coarse, reached[s])
                    elif begin <= s < full:
                        for r in range(size):
                            reached[s, r] += nudge[s] * columns[row, s - begin, r]
                        reached[s, s] += decay * nudge[s]
                    elif tint <= s < begin:
                        for k in range(tints):
                            reached[s, tint + k] += nudge[s] * turn[k, s - tint]
                    else:
                        perturb_delayed(late, s - size, nudge[s], reached[s, size:tint])
                for s in range(full):
                    for r in range(full):
                        reached[s, r] = (reached[s, r] - reached[full, r]) / nudge[s]
                if len(flow) > 0:
                    for s in range(full):
                        for r in range(full):
                            flow[row, s, r] = reached[s, r]
            _carry(reached, covariance, work, drift)
            if not known[row]:
                for s in range(full):
                    covariance[s, s] += unknown[s]
        advance(model, sp, z, command, row, period, steps, trail)
        shift_delayed(model, late, size, trail, h, z)
        for i in range(inputs):
            for r in range(size):
                z[r] += columns[row, i, r] * z[begin + i]
            z[begin + i] *= decay
        for k in range(tints):
            noises[k] = z[tint + k]
        for k in range(tints):
            z[tint + k] = 0.0
            for s in range(tints):
                z[tint + k] += turn[k, s] * noises[s]
    return loss


_ROUNDING = 1.0e-13  # of a prediction's variance: less noise is lost in the rounding of its covariance


@compile_without_allocation
def update_covariance(covariance, slope, noise, pull, gain):
    """Update a covariance with one reading: `P - K H P`, positive definite in spite of rounding.

    Args:
        covariance: (n, n) P before the reading; overwritten. Only its lower triangle is read and written.
        slope: (n,) H, slope of the reading in the state.
        noise: R, variance of the reading, scalar; counts as at least 1e-13 of H P H'. What it then leaves of
            the variance, R H P H' / (R + H P H'), exceeds the rounding of the difference.
        pull: (n,) P H', written.
        gain: (n,) K, gain of the reading, written.

    Returns:
        `H P H' + R`, variance of the prediction error, scalar; not positive if P is not finite.

    Source: Anderson and Moore 1979, Optimal Filtering, chapter 6.
    """
    size, spread = len(gain), 0.0
    for s in range(size):
        pull[s] = 0.0
    for k in range(size):  # a reading depends on few states
        if slope[k] != 0.0:
            for s in range(k + 1):
                pull[s] += covariance[k, s] * slope[k]
            for s in range(k + 1, size):
                pull[s] += covariance[s, k] * slope[k]
    for s in range(size):
        spread += slope[s] * pull[s]
    total = max(noise, _ROUNDING * spread) + spread
    for s in range(size):
        gain[s] = pull[s] / total
        for k in range(s + 1):
            covariance[s, k] -= gain[s] * pull[k]
    return total


@compile_without_allocation
def mirror_lower_triangle(matrix):
    """Copy the lower triangle of a matrix (n, n) to its upper one."""
    for a in range(len(matrix)):
        for b in range(a):
            matrix[b, a] = matrix[a, b]


@compile_without_allocation
def multiply_transposed(left, right, out):
    """Write the product left' right of two matrices (n, n); zeros of `left` are skipped, four rows at a time.

    Every sum adds its terms in the order of the rows. The innermost index is contiguous.
    """
    size = len(out)
    for a in range(size):
        for b in range(size):
            out[a, b] = 0.0
        for k in range(0, size - 3, 4):
            p, q, r, s = left[k, a], left[k + 1, a], left[k + 2, a], left[k + 3, a]
            if p != 0.0 or q != 0.0 or r != 0.0 or s != 0.0:
                for b in range(size):
                    total = ((out[a, b] + p * right[k, b]) + q * right[k + 1, b]) + r * right[k + 2, b]
                    out[a, b] = total + s * right[k + 3, b]
        for k in range(size - size % 4, size):
            if left[k, a] != 0.0:
                for b in range(size):
                    out[a, b] += left[k, a] * right[k, b]


@compile_without_allocation
def multiply_symmetric(left, right, out):
    """Write the product left right of two matrices (n, n) that is symmetric but for rounding, see above."""
    size = len(out)
    for a in range(size):
        for b in range(a + 1):
            out[a, b] = 0.0
        for k in range(0, size - 3, 4):
            p, q, r, s = left[a, k], left[a, k + 1], left[a, k + 2], left[a, k + 3]
            for b in range(a + 1):
                total = ((out[a, b] + p * right[k, b]) + q * right[k + 1, b]) + r * right[k + 2, b]
                out[a, b] = total + s * right[k + 3, b]
        for k in range(size - size % 4, size):
            for b in range(a + 1):
                out[a, b] += left[a, k] * right[k, b]
    mirror_lower_triangle(out)


@compile_without_allocation
def _mark_unpredicted(reading, whitened, predicted, corrected, first):
    """Mark all rows from one on as not predicted, because the states broke down."""
    for row in range(first, len(reading)):
        for c in range(reading.shape[1]):
            whitened[row, c] = math.nan if math.isnan(reading[row, c]) else math.inf
            predicted[row, c] = math.nan
        for s in range(corrected.shape[1]):
            corrected[row, s] = math.nan


@compile_without_allocation
def _correct(model, sp, z, own, delta):
    """Add a correction to a state; drives that it does not know follow their loads."""
    n, t = len(model.mech.independent), len(model.transmission)
    if len(own) == len(z):
        for s in range(len(z)):
            z[s] += delta[s]
        for i in range(model.hydraulic):
            if model.user[i * SLOT_COUNT + _KIND] == _PUMPED:
                _keep_side(z, 2 * (n + t) + 4 * i, delta[2 * (n + t) + 4 * i])
        if model.memory >= 0:
            _bound_memory(model, z)
        return
    for sign in (-1.0, 1.0):
        place(model, sp, z)
        for i in range(len(model.gear)):
            gear = model.gear[i]
            if gear < 0 or _among(own, n + gear):
                continue
            z[n + gear] += sign * load_position(model, sp, i)
            for f in range(n):
                z[n + t + n + gear] += sign * sp.row[i, f] * z[n + t + f]
        if sign < 0.0:
            for s in range(len(own)):
                z[own[s]] += delta[s]
    if model.memory >= 0:
        _bound_memory(model, z)


@compile_without_allocation
def _bound_memory(model, z):
    """Keep bristles within their breakaway force, and a pump between no flow and all of it."""
    act = z[2 * (len(model.mech.independent) + len(model.transmission)) :]
    for i in range(len(model.gear)):
        u = i * SLOT_COUNT
        if model.user[u + _BRISTLE_STIFFNESS] > 0.0:
            at, unequal = int(model.user[u + _BRISTLE]), model.user[u + _ASYMMETRY]
            act[at] = min(1.0 + unequal, max(unequal - 1.0, act[at]))
    for i in range(model.hydraulic):
        if model.user[i * SLOT_COUNT + _DELIVERY] > 0.0:
            at = int(model.user[i * SLOT_COUNT + _DELIVERY])
            act[at] = min(1.0, max(0.0, act[at]))


@compile_without_allocation
def _keep_side(z, at, moved):
    """Undo what readings cannot say of a pump drive: that its relays switched, or its load pulls.

    The commands alone tell the side of the valve, and whether it is shut.
    """
    before = z[at] - moved
    if before == 0.0:
        z[at] = 0.0
    elif z[at] * before <= 0.0:
        z[at] = math.copysign(STALLED_SPEED, before)
    z[at + 1] = max(0.0, z[at + 1])


@compile_without_allocation
def _among(numbers, number):
    """Whether a number is one of (n,) numbers."""
    for other in numbers:
        if other == number:
            return True
    return False


@compile_without_allocation
def _carry(columns, covariance, work, drift):
    """`P = F P F' + Q` by the lower triangle of P, kept symmetric; the rows of `columns` are F's columns."""
    mirror_lower_triangle(covariance)
    multiply_transposed(columns, covariance, work)  # F P
    multiply_symmetric(work, columns, covariance)
    for a in range(len(drift)):
        covariance[a, a] += drift[a]
