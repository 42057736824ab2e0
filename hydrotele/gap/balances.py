"""Balances of a log, law by law and axis by axis: which law of the model fails, where and when.

A balance is computed from smoothed signals, without any simulation of the machine; its noise is
what the sensors' noise, and what smoothing takes from the signals, would make of it.

A log's signals for the balances: on one clock, smoothed, and once more with other noise.

How much later a signal comes than another, window by window.

Residuals of the model's laws on given signals, compiled; nothing here knows of logs.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, sosfiltfilt

from hydrotele.core.compiled import compiled
from hydrotele.estimate.reduced_model import (
    X,
    arriving,
    load_position,
    model_space,
    place,
    reduced_model,
)
from hydrotele.hydraulics.actuator_layout import PUMP_OFFSET, actuator_order, actuator_parameters
from hydrotele.hydraulics.circuit import (
    SLOT_COUNT,
    Slot,
    actuator_end_stop_force,
    actuator_friction,
    advance_pump_flow_fraction,
    axis_valve_opening,
    chamber_flows,
    compute_inlet_conditions,
    group_size,
    solve_supply_pressures,
    write_demanded_fractions,
)
from hydrotele.hydraulics.laws import air_compliance, air_softening_factor, relief_and_makeup_flow, spool_step
from hydrotele.hydraulics.pump_drive import load_cylinder_force, load_pressure_step
from hydrotele.hydraulics.supply import (
    DEMAND,
    FEED,
    SCRATCH_SIZE,
    write_delivered_fractions,
)
from hydrotele.identify import optimal_smoother
from hydrotele.kinematics.drive_linkage import axis_linkage
from hydrotele.kinematics.linkages import LoopOpenError
from hydrotele.logs.clock import fit_clock
from hydrotele.logs.dataset import Dataset, RunData
from hydrotele.logs.log import Log
from hydrotele.machine.log_channels import default_channel_unit, parse_channel
from hydrotele.machine.machine import Machine, get_sensor_set, reading_noise_rms
from hydrotele.machine.sensors import SensorError
from hydrotele.multibody.reduced_dynamics import BIAS, DRIFT, LENGTH_BIAS, LENGTH_ROW, RATE, compute_mass_and_bias
from hydrotele.multibody.reduced_mechanism import BAR, DAMPING, JOINT

_AH, _AR, _LEAK = int(Slot.AREA_HEAD), int(Slot.AREA_ROD), int(Slot.LEAKAGE)
_PORT, _KR = int(Slot.PORT_RELIEF), int(Slot.RELIEF_GAIN)
_TANK, _KM = int(Slot.TANK_PRESSURE), int(Slot.MAKEUP_GAIN)
_BETA, _HOSE = int(Slot.BULK_MODULUS), int(Slot.HOSE_COMPLIANCE)
_AIR, _ONSET = int(Slot.AIR_RELEASE), int(Slot.AIR_ONSET)
_BUBBLES = int(Slot.ENTRAINED_AIR)
_LAG, _DELIVERY = int(Slot.PUMP_TIME_CONSTANT), int(Slot.DELIVERY)
_MEMORY = int(Slot.EXTRA_STATES)


@compiled
def load_forces(model, space, motion):
    """Force of every drive that a motion needs, its own friction included, less its end stops'.

    `J' F = N' (M (N q'' + c) + h + D q')`, where N maps independent to tree rates, c is what the
    closures add, D the dampers of the joints and J the drives' Jacobian; a transmission counts as
    rigid.

    Args:
        model: Model of the reduced dynamics with as many drives as independent coordinates.
        space: its Space.
        motion: (n, 3, f) positions, rates and accelerations of the independent coordinates.

    Returns:
        (n, nu) forces [N] or torques [N m].

    Source: virtual work on the closed chains.
    """
    mech, m = model.mech, space.motion
    rows, free, drives = len(motion), len(mech.independent), len(model.gear)
    total = free + len(model.transmission)
    z, load = np.zeros(2 * total + 4 * model.hydraulic), np.zeros(free)
    forces = np.empty((rows, drives))
    for k in range(rows):
        z[:free] = motion[k, 0]
        z[total : total + free] = motion[k, 1]
        place(model, space, z)
        compute_mass_and_bias(mech, m)
        acceleration = m.joint[DRIFT] + m.basis @ motion[k, 2]
        tree = m.mass @ acceleration + m.joint[BIAS] + mech.joint[DAMPING] * m.joint[RATE]
        load[:] = m.basis.T @ tree
        forces[k] = np.linalg.solve(space.row.T.copy(), load)
        for i in range(drives):
            velocity, change = 0.0, 0.0
            for f in range(free):
                velocity += space.row[i, f] * motion[k, 1, f]
                change += space.row[i, f] * motion[k, 2, f]
            bar = mech.drive[i, BAR]
            if bar >= 0:
                change += m.bar[bar, LENGTH_BIAS] + np.sum(m.bar[bar, LENGTH_ROW:] * m.joint[DRIFT])
            forces[k, i] += actuator_friction(model.user, i * SLOT_COUNT, velocity)
            at = space.drive[X, i] if model.gear[i] < 0 else load_position(model, space, i)
            forces[k, i] -= actuator_end_stop_force(model.user, i * SLOT_COUNT, at, velocity)[0]
            if model.gear[i] >= 0:
                forces[k, i] += model.transmission[model.gear[i], 0] * change
    return forces


@compiled
def chamber_residuals(user, spool, supply, head, rod, volumes, velocity):
    """What a chamber's oil does not account for: `V p'/beta + A v + leak - valve - port`.

    Args:
        user: (SLOTS,) numbers of the axis' actuator.
        spool: (n,) spool positions [1].
        supply: (n,) supply pressure [Pa].
        head: (2, n) head-side pressure [Pa] and its rate [Pa/s].
        rod: (2, n) the same of the rod side.
        volumes: (2, n) volumes of head and rod chamber [m^3].
        velocity: (n,) piston velocity [m/s] or [rad/s].

    Returns:
        (2, n) residual flows of head and rod chamber [m^3/s]; positive: oil is missing. Those of a
        chamber drawn below atmosphere count as little as its pressure tells of them
        (`laws.softening`).

    Source: nominal model, "Chambers".
    """
    out = np.empty((2, len(spool)))
    tank, hose, beta = user[_TANK], user[_HOSE], user[_BETA]
    for k in range(len(spool)):
        p_head, p_rod = head[0, k], rod[0, k]
        opening = axis_valve_opening(user, 0, spool[k])
        q_head, q_rod, _, _ = chamber_flows(user, 0, opening, supply[k], p_head, p_rod)
        r_head, _ = relief_and_makeup_flow(p_head, user[_PORT], user[_KR], tank, user[_KM])
        r_rod, _ = relief_and_makeup_flow(p_rod, user[_PORT], user[_KR], tank, user[_KM])
        leak = user[_LEAK] * (p_head - p_rod)
        soft = 1.0 / beta + air_compliance(p_head, user[_BUBBLES])
        stored_head = (volumes[0, k] * soft + hose) * head[1, k]
        soft = 1.0 / beta + air_compliance(p_rod, user[_BUBBLES])
        stored_rod = (volumes[1, k] * soft + hose) * rod[1, k]
        soft_head = air_softening_factor(p_head, user[_AIR], user[_ONSET])
        soft_rod = air_softening_factor(p_rod, user[_AIR], user[_ONSET])
        out[0, k] = stored_head + soft_head * (user[_AH] * velocity[k] + leak - q_head - r_head)
        out[1, k] = stored_rod - soft_rod * (user[_AR] * velocity[k] + leak + q_rod + r_rod)
    return out


@compiled
def _solve_row(user, spools, pressures, period, act, ports):
    """Write a row's activations and supplies; slow pumps have followed over a period, 0 at first."""
    count = len(spools)
    for i in range(count):
        act[4 * i] = spools[i]
        act[4 * i + 2], act[4 * i + 3] = pressures[i]
    i = 0
    compute_inlet_conditions(user, act, act, ports, 0, count, 0.0, act)
    write_demanded_fractions(user, 0, count, ports)
    while i < count:
        if user[i * SLOT_COUNT + _LAG] > 0.0:
            wanted, at = ports[DEMAND + i], int(user[i * SLOT_COUNT + _DELIVERY])
            act[at] = advance_pump_flow_fraction(user, i, wanted, act[at], period) if period > 0.0 else wanted
        i += group_size(user, 0, count, i)
    write_delivered_fractions(user, 0, count, act, ports)
    solve_supply_pressures(user, 0, count, ports)


@compiled
def supply_pressures(user, spools, pressures, period):
    """Return the supply pressures of all axes from spools and chamber pressures.

    Args:
        user: (h * SLOTS,) numbers of the h valves.
        spools: (h, n) [1].
        pressures: (h, 2, n) head and rod pressures [Pa].
        period: between rows, scalar [s]. A pump with a time constant begins settled and follows
            from row to row.

    Returns:
        (h, n) pressure that feeds each axis [Pa].

    Source: nominal model, "Supply".
    """
    count, rows = spools.shape
    ports, out = np.zeros(SCRATCH_SIZE), np.empty((count, rows))
    act = np.zeros(4 * count + int(user[_MEMORY]))
    for k in range(rows):
        _solve_row(user, spools[:, k], pressures[:, :, k], period if k else 0.0, act, ports)
        out[:, k] = ports[FEED : FEED + count]
    return out


DRAWS = 16  # a standard deviation from 16 draws, averaged over a second, is known to some 5 %
_LEAST_READINGS = 10  # readings that a channel needs


@dataclass(frozen=True)
class Signals:
    """Signals of one run; the first of the d sets is the measured one, the others have more noise.

    Attributes:
        time: (n,) uniform clock [s].
        period: time between samples [s].
        command: axis -> (n,) valve command or drive input held from row to row [1], [V] or [N].
        reading: channel -> (n,) readings corrected by the machine's sensor errors, NaN where
            missing [channel's unit].
        noise: channel -> standard deviation of one reading [channel's unit].
        smoothed: channel -> (d, 3, n) value, rate and acceleration.
    """

    time: np.ndarray
    period: float
    command: Mapping[str, np.ndarray]
    reading: Mapping[str, np.ndarray]
    noise: Mapping[str, float]
    smoothed: Mapping[str, np.ndarray]

    def has(self, *channels: str) -> bool:
        """Whether all these channels were measured."""
        return all(channel in self.smoothed for channel in channels)


def read_signals(machine: Machine, log: Log, sensors: str | None, noise: Mapping[str, float] | None = None) -> Signals:
    """Signals of a log.

    Args:
        machine: the machine, whose sensor errors are taken out of the readings.
        log: the run; rows may be missing.
        sensors: name of the machine's sensors; None to find the noise from the data.
        noise: channel -> standard deviation of one reading, in place of the sensors'.

    Returns:
        The signals of all channels that have enough samples.

    Raises:
        InputError: the time stamps follow no clock, or the machine has no such sensors.
    """
    clock, _ = fit_clock(log.time, log.source)
    rows = int(clock.tick[-1]) + 1
    time = clock.start + clock.period * np.arange(rows)
    stated = None if sensors is None else get_sensor_set(machine, sensors)
    command, reading, found, smoothed = {}, {}, {}, {}
    told = noise or {}
    for k, (name, values) in enumerate(log.columns.items()):
        channel = parse_channel(name)
        if channel.truth or (channel.axis and channel.axis not in {*machine.axes, *machine.supplies}):
            continue
        on_clock = np.full(rows, np.nan)
        on_clock[clock.tick] = values[clock.row]
        if channel.kind == "command":
            command[channel.axis] = on_clock[_last_known(on_clock)]
        if channel.kind not in ("angle", "position", "length") and "pressure" not in channel.kind:
            continue
        error = machine.sensor_errors.get(name, SensorError())
        on_clock = _corrected(on_clock, error, time)
        known = on_clock[np.isfinite(on_clock)]
        sigma = told.get(name) or reading_noise_rms(machine, stated, name)
        sigma = sigma / error.scale or None
        if len(known) < _LEAST_READINGS or (sigma is None and np.ptp(known) == 0.0):
            continue
        motion = optimal_smoother.smooth_and_differentiate(on_clock[:, None], clock.period, sigma)
        best = np.stack([motion.value, motion.rate, motion.acceleration])[None, :, :, 0]
        draws = optimal_smoother.sample_smoothing_errors(motion, DRAWS, k)[..., 0]
        reading[name], found[name] = on_clock, float(motion.noise[0])
        smoothed[name] = np.concatenate([best, best + draws])
    return Signals(time, clock.period, command, reading, found, smoothed)


def joint_motion(machine: Machine, signals: Signals, axis: str) -> np.ndarray | None:
    """Motion of an axis' joint from its own sensor or else from its cylinder's length.

    Args:
        machine: the machine.
        signals: of a run.
        axis: name.

    Returns:
        (d, 3, n) position [rad] or [m], rate and acceleration; None where nothing tells it.
    """
    own = f"{machine.position_kind(axis)}.{axis}"
    if signals.has(own):
        return signals.smoothed[own]
    cylinder = machine.axes[axis].cylinder
    if cylinder is None or not signals.has(f"length.{axis}"):
        return None
    linkage = axis_linkage(machine, axis)
    length, speed, change = np.moveaxis(signals.smoothed[f"length.{axis}"], 1, 0)
    try:
        angle = linkage.angle(length + cylinder.closed_length)
    except LoopOpenError:
        return None
    lever, step = linkage.rate(angle), 1.0e-5  # rad or m: truncation 1e-10, cancellation 1e-11
    bend = (linkage.rate(angle + step) - linkage.rate(angle - step)) / (2.0 * step)
    rate = speed / lever
    return np.stack([angle, rate, (change - bend * rate**2) / lever], axis=1)


def spool_positions(machine: Machine, signals: Signals, axis: str) -> np.ndarray:
    """Spool of an axis at every row: its equation needs the command only.

    Args:
        machine: the machine; a command delay is taken into account.
        signals: of a run that has the command.
        axis: name.

    Returns:
        (n,) [1]; at the first row it stands at the first command.
    """
    valve, delay = machine.axes[axis].valve, machine.axes[axis].command_delay
    assert valve is not None
    command = np.clip(signals.command[axis], -1.0, 1.0)
    spool = np.empty(len(command))
    position, rate = float(command[0]), 0.0
    parts = max(1, round(signals.period / 1.0e-3)) if delay else 1
    part = signals.period / parts
    for row in range(len(command)):
        spool[row] = position
        for i in range(parts):
            target = arriving(command, row, i * part, (i + 1) * part, signals.period, delay)
            position, rate = spool_step(
                position, rate, target, valve.bandwidth, valve.damping, part,
                valve.slew_limit or 0.0,
            )  # fmt: skip
    return spool


def _last_known(values: np.ndarray) -> np.ndarray:
    """Row of the last known value at or before every row; the first row is known."""
    return np.maximum.accumulate(np.where(np.isfinite(values), np.arange(len(values)), 0))


def _corrected(values: np.ndarray, error: SensorError, time: np.ndarray) -> np.ndarray:
    values = (values - error.offset_at(time)) / error.scale
    if not error.is_delayed:
        return values
    # a first-order lag delays motions slower than itself by its time constant
    rows, lag = np.arange(len(values)), (error.delay + error.time_constant) / (time[1] - time[0])
    return np.interp(rows + lag, rows, values, right=np.nan)


_WINDOW = 8.0  # s: holds several reversals of a machine at work
_LARGEST = 0.5  # s: lag that is searched
_LEAST_CORRELATION = 0.5  # correlation below which a window tells nothing


def window_lags(expected: np.ndarray, measured: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Lag of a measured behind an expected signal in windows, with its noise.

    The lag is where the cross-correlation of the two, without their means, has its peak, refined by
    a parabola.

    Args:
        expected: (d, n) [u]; the first row as found, the others with other noise.
        measured: (d, n) [u].
        period: time between samples [s].

    Returns:
        ((n,) lag, positive if measured comes later, (n,) standard deviation) [s], constant in each
        window and NaN in windows without a clear peak; None where no window has one.
    """
    rows = expected.shape[1]
    count = max(1, int(rows * period / _WINDOW))
    edges = np.linspace(0, rows, count + 1).astype(int)
    lag, noise = np.full(rows, np.nan), np.full(rows, np.nan)
    for begin, end in zip(edges[:-1], edges[1:], strict=True):
        lags = np.array([peak_lag(e[begin:end], m[begin:end], period) for e, m in zip(expected, measured, strict=True)])
        if np.isfinite(lags[0]) and np.isfinite(lags[1:]).sum() > len(lags) // 2:
            lag[begin:end] = lags[0]
            noise[begin:end] = np.sqrt(np.nanmean((lags[1:] - lags[0]) ** 2))
    return (lag, noise) if np.isfinite(lag).any() else None


def peak_lag(expected: np.ndarray, measured: np.ndarray, period: float) -> float:
    """Lag of one signal behind another.

    Args:
        expected: (n,) [u].
        measured: (n,) [u].
        period: time between samples [s].

    Returns:
        Lag [s], positive if measured comes later; NaN where the two are not alike.

    >>> time = 0.02 * np.arange(400)
    >>> round(peak_lag(np.sin(time), np.sin(time - 0.05), 0.02), 3)
    0.05
    """
    reach = min(round(_LARGEST / period), len(expected) // 4)
    if reach < 2:
        return float("nan")
    fixed = expected[reach:-reach] - expected[reach:-reach].mean()
    near = np.lib.stride_tricks.sliding_window_view(measured, len(fixed))  # (2 reach + 1, .)
    near = near - near.mean(axis=1, keepdims=True)
    size = np.sqrt((fixed @ fixed) * np.einsum("ij,ij->i", near, near))
    if not size.min() > 0.0:
        return float("nan")
    likeness = near @ fixed / size
    best = int(likeness.argmax())
    if likeness[best] < _LEAST_CORRELATION or not 0 < best < len(likeness) - 1:
        return float("nan")
    before, top, after = likeness[best - 1 : best + 2]
    shift = 0.5 * (before - after) / (before - 2.0 * top + after)
    return float((best + shift - reach) * period)


# Hz: below the 2.5 Hz at which an excavator rings on its oil and accelerations drown in the noise
BAND = 1.5
_AVERAGE = 1.0  # s: the draws' scatter is averaged over it
_SUPPLY = "supply"


@dataclass(frozen=True)
class Balance:
    """Residual of one law at one place over a run.

    Attributes:
        time: (n,) [s].
        residual: (n,) [unit].
        noise: (n,) standard deviation that the residual has where the law holds [unit]: from the
            sensors' noise and, but for `closure`, from random errors of the smoother.
        unit: SI unit of residual and noise.
        rms: root mean square of the residual [unit].
        normalised_rms: the same of residual over noise [1]; about 1 where the law holds.
    """

    time: np.ndarray
    residual: np.ndarray
    noise: np.ndarray
    unit: str
    rms: float
    normalised_rms: float


def run_balances(machine: Machine, data: Dataset, run: RunData, noise: np.ndarray) -> dict[str, dict[str, Balance]]:
    """Balances of a run as a dataset has it: mended, and without rows that may not be used.

    Args:
        machine: the model.
        data: the dataset, for axes, channels and sensors.
        run: one of its runs.
        noise: (c,) standard deviation of one logged reading [channel's unit].

    Returns:
        As `balances`; residuals are NaN in rows that a mask leaves out.
    """
    found = _balances(machine, _signals(machine, data, run, noise))
    if run.valid is None or run.valid.all():
        return found

    def masked(balance: Balance) -> Balance:
        row = np.clip(np.round((balance.time - run.start) / run.period), 0, len(run.command) - 1)
        assert run.valid is not None
        residual = np.where(run.valid[row.astype(int)], balance.residual, np.nan)
        return _balance(balance.time, residual, balance.noise, balance.unit)

    return {law: {p: masked(b) for p, b in places.items()} for law, places in found.items()}


def _signals(machine: Machine, data: Dataset, run: RunData, noise: np.ndarray) -> Signals:
    columns = {f"command.{axis}": v for axis, v in zip(data.axes, run.command.T, strict=True)}
    columns |= dict(zip(data.channels, run.reading.T, strict=True))
    time = run.start + run.period * np.arange(len(run.command))
    log = Log(time, columns, {c: default_channel_unit(c, columns) for c in columns}, source=run.name)
    each = noise if run.readings_per_mean is None else noise / np.sqrt(run.readings_per_mean)
    known = dict(zip(data.channels, each.tolist(), strict=True))
    return read_signals(machine, log, data.sensors, known)


def _balances(machine: Machine, signals: Signals) -> dict[str, dict[str, Balance]]:
    found: dict[str, dict[str, Balance]] = {}
    for law in (_closure, _force, _flow_and_timing, _supply):
        for name, location, balance in law(machine, signals):
            found.setdefault(name, {})[location] = balance
    return found


Found = Iterator[tuple[str, str, Balance]]


def _balance(time: np.ndarray, residual: np.ndarray, noise: np.ndarray, unit: str) -> Balance:
    ratio = np.divide(residual, noise, out=np.full(len(noise), np.nan), where=noise > 0)
    rms, normalised = (float(np.sqrt(np.nanmean(v**2))) if np.isfinite(v).any() else np.nan for v in (residual, ratio))
    return Balance(time, residual, noise, unit, rms, normalised)


def _closure(machine: Machine, signals: Signals) -> Found:
    for name, axis in machine.axes.items():
        length, angle = f"length.{name}", f"{machine.position_kind(name)}.{name}"
        if not (axis.cylinder and signals.has(length, angle)):
            continue
        linkage, readings = axis_linkage(machine, name), signals.reading
        lever = linkage.rate(signals.smoothed[angle][0, 0])
        # to first order about the smoothed angle, as one reading may lie where no loop closes
        geometric = linkage.length(signals.smoothed[angle][0, 0]) - axis.cylinder.closed_length
        geometric = geometric + lever * (readings[angle] - signals.smoothed[angle][0, 0])
        noise = np.hypot(signals.noise[length], lever * signals.noise[angle])
        yield (
            "closure",
            name,
            _balance(signals.time, readings[length] - geometric, noise, "m"),
        )


def _force(machine: Machine, signals: Signals) -> Found:
    order, model = actuator_order(machine), reduced_model(machine, ())
    motions = {name: joint_motion(machine, signals, name) for name in order}
    driven = {int(j): name for j, name in zip(model.mech.drive[:, JOINT], order, strict=True)}
    free = [driven.get(int(j), "") for j in model.mech.independent]
    parts = [motions[name] for name in free if name and motions[name] is not None]
    pushes = {name: _push(machine, signals, name) for name in order}
    known = {name: push for name, push in pushes.items() if push is not None}
    if len(parts) < len(free) or len(order) != len(free) or not known:
        return
    motion = np.stack([part for part in parts if part is not None], axis=-1)
    space = model_space(model)
    needed = np.stack([load_forces(model, space, m.swapaxes(0, 1).copy()) for m in motion])
    for name in known.keys() & machine.loads.keys():
        own = motions[name]
        if own is not None:
            known[name] = known[name] - _load(machine, name, own, signals.period)
    for name, push in known.items():
        rotary = machine.axes[name].cylinder is None and machine.position_kind(name) == "angle"
        lacks = push - needed[:, :, order.index(name)]
        residual, noise = _in_band(lacks, signals.period)
        yield "force", name, _balance(signals.time, residual, noise, "N m" if rotary else "N")


def _push(machine: Machine, signals: Signals, name: str) -> np.ndarray | None:
    """(d, n) or (n,) force of a drive before friction, or None where nothing tells it."""
    axis = machine.axes[name]
    if axis.force:
        if name not in signals.command:
            return None
        held = np.concatenate([signals.command[name][:1], signals.command[name]])
        now = np.arange(len(held) - 1) + 0.5 - axis.command_delay / signals.period
        arrived = np.interp(now, np.arange(len(held)), held)  # mean over a period about the row
        return axis.force.gain * arrived - axis.force.offset
    channels = f"pressure_head.{name}", f"pressure_rod.{name}"
    if not signals.has(*channels):
        return None
    head, rod = (signals.smoothed[c][:, 0] for c in channels)
    area_head, area_rod = axis.hydraulic_drive.effective_areas
    return area_head * head - area_rod * rod


def _load(machine: Machine, name: str, motion: np.ndarray, period: float) -> np.ndarray:
    """(d, n) force of the load cylinder against an axis' motion (d, 3, n), its friction included.

    Its pressure follows from the travel alone; in the first row there is none.
    """
    user, load = actuator_parameters(machine)[name], machine.loads[name]
    smooth = machine.axes[name].drive.friction.smoothing_velocity
    forces = np.zeros((len(motion), motion.shape[2]))
    for d, (_, velocity, _) in enumerate(motion):
        pressure = 0.0
        for row in range(1, len(velocity)):
            pressure = load_pressure_step(user, PUMP_OFFSET, pressure, velocity[row], period)
            forces[d, row] = load_cylinder_force(user, PUMP_OFFSET, pressure)
        way = np.tanh(velocity / smooth)
        forces[d] += load.friction * forces[d] * way + load.return_force * np.minimum(way, 0.0)
    return forces


def _flow_and_timing(machine: Machine, signals: Signals) -> Found:
    numbers = actuator_parameters(machine)
    for name, axis in machine.hydraulic_axes.items():
        channels = f"pressure_head.{name}", f"pressure_rod.{name}", machine.supply_channel(name)
        motion = joint_motion(machine, signals, name)
        if axis.valve is None or motion is None or name not in signals.command:
            continue
        if not signals.has(*channels):
            continue
        head, rod, supply = (signals.smoothed[c] for c in channels)
        linkage, spool = axis_linkage(machine, name), spool_positions(machine, signals, name)
        drive = axis.hydraulic_drive
        closed = axis.cylinder.closed_length if axis.cylinder else 0.0
        displacement = np.asarray(linkage.length(motion[:, 0])) - closed
        velocity = np.asarray(linkage.rate(motion[:, 0])) * motion[:, 1]
        lacks = np.stack(
            [
                chamber_residuals(
                    numbers[name], spool, supply[d, 0], head[d, :2].copy(), rod[d, :2].copy(),
                    np.stack(drive.chamber_volumes(displacement[d])), velocity[d],
                )
                for d in range(len(velocity))
            ]
        )  # fmt: skip
        for side, law in enumerate(("flow_head", "flow_rod")):
            residual, noise = _in_band(lacks[:, side], signals.period)
            yield law, name, _balance(signals.time, residual, noise, "m^3/s")
        expected = velocity - lacks[:, 0] / drive.effective_areas[0]
        lags = window_lags(expected, velocity, signals.period)
        if lags is not None:
            yield "timing", name, _balance(signals.time, *lags, "s")


def _supply(machine: Machine, signals: Signals) -> Found:
    for name in machine.pumps:
        parts = _supply_signals(machine, signals, name)
        if parts is None:
            continue
        user, spools, pressures, supplies = parts
        first = _first_valve(machine, name)
        expected = np.stack([supply_pressures(user, spools, p, signals.period)[first] for p in pressures])
        place = _SUPPLY if name == _SUPPLY else f"{_SUPPLY}.{name}"
        yield _SUPPLY, place, _balance(signals.time, *_in_band(supplies - expected, signals.period), "Pa")


def _first_valve(machine: Machine, pump: str) -> int:
    """Return the index of the first valve that a pump feeds among all valves."""
    return list(machine.valve_axes).index(machine.axes_of_pump(pump)[0])


def _supply_signals(
    machine: Machine, signals: Signals, pump: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
    """Return what the balance of a pump is made of, None if a channel is missing.

    Returns:
        The h valves' numbers, their spools (h, n) [1], the pressures of their chambers
        (d, h, 2, n) and of the pump (d, n) [Pa].
    """
    names = list(machine.valve_axes)
    chambers = [f"pressure_{side}.{name}" for name in names for side in ("head", "rod")]
    commanded = all(name in signals.command for name in names)
    if not (names and commanded and machine.axes_of_pump(pump)):
        return None
    channel = machine.supply_channel(machine.axes_of_pump(pump)[0])
    if not signals.has(channel, *chambers):
        return None
    numbers = actuator_parameters(machine)
    user = np.concatenate([numbers[name] for name in names])
    spools = np.stack([spool_positions(machine, signals, name) for name in names])
    table = np.stack([signals.smoothed[c][:, 0] for c in chambers], axis=1)
    pressures = table.reshape(len(table), len(names), 2, -1)
    return user, spools, pressures, signals.smoothed[channel][:, 0]


def _in_band(sets: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
    """(d, n) residuals -> (n,) residual of the first set and its noise from the others."""
    if BAND < 0.4 / period:
        filtered = butter(2, BAND, fs=1.0 / period, output="sos")
        pad = min(sets.shape[1] - 1, round(1.0 / (BAND * period)))
        sets = sosfiltfilt(filtered, sets, axis=1, padlen=pad)
    return sets[0], _scatter(sets, period)


def _scatter(sets: np.ndarray, period: float) -> np.ndarray:
    square = np.mean((sets[1:] - sets[0]) ** 2, axis=0)
    width = min(max(1, round(_AVERAGE / period)), len(square))  # a shorter run is averaged as a whole
    edges = np.convolve(np.ones(len(square)), np.ones(width), "same")
    return np.sqrt(np.convolve(square, np.ones(width), "same") / edges)
