"""Takes out of the readings what no sensor in working order says; every change leaves a note.

Channels that are refreshed more slowly than they are logged: only fresh readings are readings.

A logger that runs at 1 kHz beside a bus that carries a pressure every 20 ms writes each value 20
times. Taken for 20 readings, their one error would count as noise of its own colour, and their age
as a delay that saws between none and 20 ms.

Sensors that froze, and rows that a logger wrote twice.

A noisy sensor rarely reads the same value twice in a row: with a uniform error of +-a and a
converter step q, with probability q / 2a at most; with a normal one, whose density is at most
1 / (sigma sqrt(2 pi)), likewise. A long repeat is then impossible by chance. That
holds only for a sensor that is as noisy as stated; of one that is quieter, or whose noise is not
stated, repeats at rest are the rule, and only the motion of others can convict it.

Readings that no machine in working order gives: beyond the sensor, spikes, another unit.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.logs import cleaning as value_range
from hydrotele.logs.rows import Rows
from hydrotele.machine.machine import Machine, Sensor, SensorSet, channel_sensor, converter

_ANGLE_PLAY = 0.35  # [rad] beyond a joint's range; zeros are set worse than ranges are known
_LENGTH_PLAY = 0.2  # of the stroke or the range, likewise
_VACUUM = -1.0e6  # [Pa] below it no sensor of absolute or gauge pressure reads
_PRESSURE_PLAY = 2.0  # times the highest relief pressure; ports overshoot their relief
_HARDEST = 500.0  # [rad/s^2] or [m/s^2]: end stops hit at full speed stay below it
_SPIKE = 20.0  # standard deviations of one reading
_NEAR_CLIP = 0.1  # [s] before and after a clipped row in which readings near the end are suspect
_WIDE = 3.46  # standard deviations of a random error, within which readings near an end are suspect


def limits(machine: Machine, channel: str) -> tuple[float, float]:
    """Readings between which a channel must be, generously.

    Args:
        machine: the machine.
        channel: channel name.

    Returns:
        (low, high) [channel's unit], infinite where the machine has no limit.
    """
    kind, _, axis = channel.partition(".")
    if kind.startswith("pressure"):
        if machine.supply is None:  # pumps of their own, without a stated limit
            return _VACUUM, math.inf
        reliefs = [a.valve.port_relief for a in machine.hydraulic_axes.values() if a.valve]
        return _VACUUM, _PRESSURE_PLAY * max(machine.supply.relief_pressure, *reliefs)
    if kind == "length":
        cylinder = machine.axes[axis].cylinder
        assert cylinder
        return -_LENGTH_PLAY * cylinder.stroke, (1 + _LENGTH_PLAY) * cylinder.stroke
    low, high = machine.joints[machine.axes[axis].joint].range or (-math.inf, math.inf)
    play = _ANGLE_PLAY if kind == "angle" else _LENGTH_PLAY * (high - low)
    return (low - play, high + play) if math.isfinite(high) else (low, high)


def check_range(machine: Machine, channel: str, reading: np.ndarray, where: str) -> None:
    """Refuse a channel that is out of the machine's reach most of the time.

    Args:
        machine: the machine.
        channel: channel name.
        reading: (n,) readings, NaN where missing [channel's unit].
        where: the file.

    Raises:
        InputError: names file and channel, what it reads, what the machine can do, and the unit
            that would explain it.
    """
    low, high = limits(machine, channel)
    values = reading[np.isfinite(reading)]
    if not len(values) or np.mean((values < low) | (values > high)) <= 0.5:
        return
    factors = {"degrees": math.pi / 180} if channel.startswith("angle") else {}
    if channel.startswith(("length", "position")):
        factors = {"millimetres": 1e-3, "inches": 0.0254}
    middle = np.median(values)
    unit = next((u for u, f in factors.items() if low <= f * middle <= high), None)
    cure = f"looks like {unit}, convert it" if unit else (
        "its zero, sign or unit is another one, or the log is of another machine")  # fmt: skip
    raise InputError(
        f"{where}, column {channel!r}",
        f"reads {values.min():.4g} .. {values.max():.4g}, the machine allows {low:.4g} .."
        f" {high:.4g}: {cure}",
    )


def clipped(sensor: Sensor, channel: str, reading: np.ndarray, period: float) -> np.ndarray:
    """Which readings stand at an end of the converter, or so near beside such that they may have.

    A sensor at its end cuts half of its noise off. Leaving out only the cut readings would keep
    those that the noise pushed inwards; near a cut reading, all within the noise of the end go.

    Args:
        sensor: the channel's sensor, with its span.
        channel: channel name.
        reading: (n,) readings, NaN where missing [channel's unit].
        period: time between rows [s].

    Returns:
        (n,) bool.
    """
    step, low, high = converter(sensor, channel)
    at_end = np.zeros(len(reading), dtype=bool)
    if not math.isfinite(high):
        return at_end
    for distance in (reading - low, high - reading):
        cut = np.nan_to_num(distance, nan=math.inf) <= 0.25 * step
        if cut.any():
            rows = min(max(1, round(_NEAR_CLIP / period)), (len(cut) - 1) // 2)
            beside = np.convolve(cut, np.ones(2 * rows + 1), mode="same") > 0.5
            reach = (2 * sensor.accuracy or _WIDE * sensor.standard_deviation) + step
            near = np.nan_to_num(distance, nan=math.inf) <= reach
            at_end |= cut | (beside & near)
    return at_end


def spikes(
    machine: Machine, channel: str, reading: np.ndarray, period: float, noise: float
) -> np.ndarray:
    """Single readings that are physically impossible.

    Of pressures only those beyond `limits`: a pressure can jump by 10 MPa from row to row. Of
    positions also a reading that leaves its two neighbours, which agree with each other, farther
    than any acceleration could have moved it.

    Args:
        machine: the machine.
        channel: channel name.
        reading: (n,) readings, NaN where missing [channel's unit].
        period: time between rows [s].
        noise: standard deviation of one reading [channel's unit]; NaN: taken from the readings.

    Returns:
        (n,) bool.
    """
    low, high = limits(machine, channel)
    with np.errstate(invalid="ignore"):
        bad = (reading < low) | (reading > high) | np.isinf(reading)
    if channel.startswith("pressure") or len(reading) < 3:
        return bad
    bend = reading[1:-1] - 0.5 * (reading[:-2] + reading[2:])
    apart = np.abs(reading[2:] - reading[:-2])
    if not math.isfinite(noise):  # bends of 0 are those of a coarse sensor between its steps
        bent = np.abs(bend[np.isfinite(bend) & (bend != 0.0)])
        noise = 1.2 * float(np.median(bent)) if len(bent) else 0.0
    allowed = max(_SPIKE * noise, 0.5 * _HARDEST * period**2)
    with np.errstate(invalid="ignore"):
        bad[1:-1] |= (np.abs(bend) > allowed) & (apart < 0.25 * np.abs(bend))
    return bad


_LEAST = 20  # changes that must be seen
_REGULAR = 0.9  # of the values last equally long, or a whole number of times as long
_HURRIED = 0.01  # of the values may last for one reading only
_ONE_STEP = 0.9  # of the changes are one converter step where a coarse sensor moves slowly
_EQUAL = 1.05  # times the least change, up to which one is as large


def refreshed_every(reading: np.ndarray) -> float:
    """Logged readings from one fresh value of a channel to the next; 1 where each is fresh.

    A sensor without noise repeats, too, at rest or between two steps of its converter, but for as
    long as its motion has it, and then goes on by one step. One that is refreshed by a clock
    repeats for a fixed number of readings, one more or less where the clocks run apart.

    Args:
        reading: (n,) readings, NaN where missing.

    Returns:
        The mean number of readings, at least 1.

    >>> refreshed_every(np.repeat(np.random.default_rng(0).normal(size=50), 4))
    4.0
    """
    values = reading[np.isfinite(reading)]
    change = np.diff(values)
    lasted = np.diff(np.flatnonzero(change))
    if len(lasted) < _LEAST or np.mean(lasted == 1) > _HURRIED:
        return 1.0
    size = np.abs(change[change != 0.0])
    if np.mean(size < _EQUAL * size.min()) > _ONE_STEP:
        return 1.0
    usual = np.median(lasted)
    times = np.maximum(np.rint(lasted / usual), 1.0)
    once = times == 1.0
    regular = np.abs(lasted - times * usual) <= 1.0
    if min(regular.mean(), once.mean()) < _REGULAR:
        return 1.0
    return float(lasted[once & regular].mean())


def stale(reading: np.ndarray, every: float) -> np.ndarray:
    """Which readings only repeat the one before because no fresh one has come.

    A value that stays for longer than it takes to refresh it was refreshed and was the same.

    Args:
        reading: (n,) readings, NaN where missing.
        every: readings from one fresh one to the next.

    Returns:
        (n,) bool.

    >>> stale(np.array([1.0, 1.0, 2.0, 2.0, 2.0, 2.0]), 2.0).tolist()
    [False, True, False, True, False, True]
    """
    rows = np.flatnonzero(np.isfinite(reading))
    place = np.arange(len(rows))
    changed = np.append(True, np.diff(reading[rows]) != 0.0)[: len(rows)]
    since = place - np.maximum.accumulate(np.where(changed, place, 0))
    again = np.rint(np.rint(since / every) * every) == since
    lasts = np.append(np.flatnonzero(changed)[1:], len(rows))[np.cumsum(changed) - 1] - place
    fresh = changed | (again & (lasts >= np.floor(every)))
    old = np.zeros(len(reading), dtype=bool)
    old[rows] = ~fresh
    return old


_BY_CHANCE = 1.0e-6  # probability of convicting a sound sensor somewhere in a data set
_SHORTEST = 0.1  # [s] a freeze has to last; shorter ones harm nobody
_SHORTEST_QUIET = 1.0  # [s] the same without noise to judge by
_QUIET = 0.5  # of the stated noise: below it a sensor is quieter than stated
_WINDOW = 20  # rows in which the noise is looked at
_PARTNER_STEPS = 20.0  # converter steps (or noises) that a motion seen elsewhere must amount to
_PARTNER_PRESSURE = 2.0e6  # [Pa] by which the other chamber must change meanwhile
_STRONG = 0.5  # of the largest command, beyond dead bands
_STRONG_TIME = 1.0  # [s] of strong command in each direction


class Stretch(NamedTuple):
    """Rows first .. last - 1 of one run, in which a channel repeats one value."""

    first: int
    last: int


def repeat_probability(sensor: Sensor, channel: str) -> float | None:
    """Largest probability that two readings of one value are equal [1]; None if noise tells none.

    >>> repeat_probability(Sensor(accuracy=0.002, bits=12, span=1.024), "length.boom")
    0.0625
    """
    if sensor.error_rms == 0.0:
        return None
    width = 2.0 * sensor.accuracy or math.sqrt(2.0 * math.pi) * sensor.standard_deviation
    share = converter(sensor, channel).step / width
    return max(share, 1.0e-9) if share <= 0.5 else None


def longest_repeat(probability: float, count: int) -> int:
    """Equal readings in a row that do not happen by chance among `count` readings.

    >>> longest_repeat(0.1, 90_000)
    12
    """
    return 1 + math.ceil(math.log(_BY_CHANCE / max(count, 1)) / math.log(probability))


def repeats(reading: np.ndarray, shortest: int) -> list[Stretch]:
    """Stretches of at least `shortest` equal readings; missing ones in between count as equal.

    >>> repeats(np.array([1.0, 2.0, 2.0, np.nan, 2.0, 3.0]), 3)
    [Stretch(first=1, last=5)]
    """
    rows = np.flatnonzero(np.isfinite(reading))
    if not len(rows):
        return []
    starts = np.flatnonzero(np.diff(reading[rows], prepend=np.nan) != 0.0)
    ends = np.append(starts[1:], len(rows))
    return [
        Stretch(int(rows[a]), int(rows[b - 1]) + 1)
        for a, b in zip(starts, ends, strict=True)
        if b - a >= shortest
    ]


def saturated(reading: np.ndarray, parts: Sequence[Stretch]) -> bool:
    """Whether a channel comes to rest at one value again and again, and never beyond it.

    >>> reading = np.array([1.0, 2.0, 2.0, 1.5, 2.0, 2.0, 1.0])
    >>> saturated(reading, repeats(reading, 2))
    True

    Args:
        reading: (n,) readings of one run, NaN where missing.
        parts: where it repeats one value.
    """
    values = {float(np.nanmedian(reading[slice(*part)])) for part in parts}
    ends = {float(np.nanmin(reading)), float(np.nanmax(reading))}
    return len(parts) > 1 and len(values) == 1 and values <= ends


def noise_floor(reading: np.ndarray) -> float:
    """Noise [channel's unit] where the channel is most at rest, NaN if it repeats all along.

    It is the 10th percentile, over windows of 20 rows that do not repeat throughout, of the
    standard deviation that second differences show.
    """
    values = reading[np.isfinite(reading)]
    bend = np.diff(values, 2)
    bend = bend[: len(bend) // _WINDOW * _WINDOW].reshape(-1, _WINDOW)
    moving = (bend != 0.0).any(axis=1)
    return float(np.percentile(bend[moving].std(axis=1), 10) / math.sqrt(6.0)) if any(moving) else (
        math.nan)  # fmt: skip


def as_noisy_as_stated(sensor: Sensor, channel: str, floors: Sequence[float]) -> bool:
    """Whether the sensor's stated noise shows in this channel or others with the same sensor.

    Args:
        sensor: the sensor.
        channel: channel name.
        floors: `noise_floor` of these channels, the best witnesses first; NaN tells nothing.
    """
    stated = math.hypot(sensor.error_rms, converter(sensor, channel).step / 12**0.5)
    known = [floor for floor in floors if math.isfinite(floor)]
    return bool(known) and known[0] >= _QUIET * stated


def frozen_by_noise(
    reading: np.ndarray, probability: float, count: int, period: float
) -> list[Stretch]:
    """Stretches that repeat longer than noise allows.

    Args:
        reading: (n,) readings of one run, NaN where missing.
        probability: of `repeat_probability`.
        count: readings in the whole data set.
        period: time between rows [s].
    """
    shortest = max(longest_repeat(probability, count), math.ceil(_SHORTEST / period))
    return repeats(reading, shortest)


def frozen_by_motion(
    reading: np.ndarray, partner: np.ndarray | None, command: np.ndarray, others: np.ndarray,
    step: float, ranges: tuple[float, float], period: float,
) -> list[Stretch]:  # fmt: skip
    """Stretches in which a position repeats one value while the axis must have moved.

    Either the partner (the length of an angle, the angle of a length) moved; or the axis was
    strongly commanded in both directions, others moved, and the value is no end of the range.

    Args:
        reading: (n,) positions, NaN where missing [channel's unit].
        partner: (n,) the other sensor of the same axis, or None.
        command: (n,) the axis' command over the largest one [1].
        others: (n, k) positions of other axes.
        step: what the sensor resolves [channel's unit].
        ranges: span of the channel and of its partner over all runs, each in its unit; a span of 0
            is that of a channel that repeats one value for ever.
        period: time between rows [s].
    """
    own, partners = ranges
    least = own * 0.02
    low, high = np.nanmin(reading), np.nanmax(reading)
    found = []
    for part in repeats(reading, math.ceil(_SHORTEST_QUIET / period)):
        rows = slice(*part)
        if partner is not None and partners > 0.0:
            moved = _span(partner[rows]) / partners
            if moved > 0.05 and (own == 0.0 or moved * own > _PARTNER_STEPS * step):
                found.append(part)
                continue
        both = all(
            period * (sign * command[rows] > _STRONG).sum() >= _STRONG_TIME for sign in (1.0, -1.0)
        )
        value = np.nanmedian(reading[rows])
        at_end = own > 0.0 and (value - low < least or high - value < least)
        alive = any(_span(other[rows]) > 0.1 * _span(other) > 0.0 for other in others.T)
        if both and not at_end and alive:
            found.append(part)
    return found


def frozen_chamber(
    reading: np.ndarray, partner: np.ndarray, lowest: float, period: float
) -> list[Stretch]:
    """Stretches in which one chamber repeats a pressure while the other one's changes much.

    Args:
        reading: (n,) pressures, NaN where missing [Pa].
        partner: (n,) pressures of the other chamber [Pa].
        lowest: pressure below which a starved chamber rests on its make-up valve [Pa].
        period: time between rows [s].
    """
    return [
        part
        for part in repeats(reading, math.ceil(_SHORTEST_QUIET / period))
        if _span(partner[slice(*part)]) > _PARTNER_PRESSURE
        and np.nanmedian(reading[slice(*part)]) > lowest
    ]


def _span(values: np.ndarray) -> float:
    """Range between the 2nd and the 98th percentile, so that single readings do not count."""
    values = values[np.isfinite(values)]
    return float(np.diff(np.percentile(values, [2, 98]))[0]) if len(values) else 0.0


def repeated_rows(
    reading: np.ndarray, probability: Sequence[float | None], count: int
) -> np.ndarray:
    """Rows in which every reading equals that of the row before, which noise forbids.

    Args:
        reading: (n, c) readings, NaN where missing.
        probability: per channel, of `repeat_probability`; None where repeats tell nothing.
        count: readings in the whole data set.

    Returns:
        (n,) bool.
    """
    noisy = [c for c, p in enumerate(probability) if p is not None]
    if not noisy:
        return np.zeros(len(reading), dtype=bool)
    logs = np.log([p for p in probability if p is not None])
    pairs = np.isfinite(reading[1:, noisy]) & np.isfinite(reading[:-1, noisy])
    equal = pairs & (reading[1:, noisy] == reading[:-1, noisy])
    improbable = (equal * logs).sum(axis=1) < math.log(_BY_CHANCE / max(count, 1))
    return np.append(False, improbable & (equal == pairs).all(axis=1) & pairs.any(axis=1))


_KEPT = 0.1  # of its readings a channel must keep in a run to be of use there
_NEAR = 3.0  # of its noise, within which a limit of a sensor cuts off some of it
_CLIPPED = 0.02  # of a run; a starved chamber reads 0 now and then on any machine
_RESOLVED = 1.0e-4  # of its span: what a sensor without a stated converter resolves, at worst
_STARVED = 0.5e6  # [Pa] above tank, where a chamber on its make-up valve may rest


class _Data(NamedTuple):
    """All runs of one machine and its sensors."""

    machine: Machine
    sensors: SensorSet | None
    axes: Sequence[str]
    channels: Sequence[str]
    noise: np.ndarray
    runs: dict[str, Rows]

    def column(self, channel: str, run: str) -> np.ndarray | None:
        """Readings (n,) of a channel in a run; None if the channel is unknown."""
        if channel not in self.channels:
            return None
        return self.runs[run].reading[:, list(self.channels).index(channel)]

    def span(self, channel: str) -> float:
        """Range of a channel over all runs [channel's unit], 0 without readings."""
        every = [self.column(channel, run) for run in self.runs]
        values = np.concatenate([v[np.isfinite(v)] for v in every if v is not None] or [[]])
        return float(np.ptp(values)) if len(values) else 0.0

    def sensor(self, channel: str) -> Sensor:
        """Sensor of a channel, with its span."""
        return channel_sensor(self.machine, self.sensors, channel)


def remove_faults(
    machine: Machine, sensors: SensorSet | None, axes: Sequence[str], channels: Sequence[str],
    noise: np.ndarray, runs: Mapping[str, Rows],
) -> tuple[dict[str, Rows], tuple[str, ...]]:  # fmt: skip
    """Replace by NaN what is beyond a sensor, impossible, frozen or written twice.

    Args:
        machine: the machine.
        sensors: its sensors, None if unknown.
        axes: the nu axes, in the order of the commands.
        channels: the c channels.
        noise: (c,) standard deviation of one reading, NaN if unknown.
        runs: run -> rows.

    Returns:
        (run -> mended rows, notes).
    """
    copies = {name: rows._replace(reading=rows.reading.copy()) for name, rows in runs.items()}
    data = _Data(machine, sensors, axes, channels, noise, copies)
    notes: list[str] = []
    for column, channel in enumerate(channels):
        for run in data.runs:
            notes += _out_of_sensor(data, run, channel, noise[column])
            notes += _stale(data, run, channel)
    fresh = {name: rows.reading.copy() for name, rows in data.runs.items()}
    found = [(run, ch, _frozen(data, run, ch)) for run in data.runs for ch in channels]
    for run, channel, parts in found:  # after all were judged: a frozen one is a poor witness
        notes += _take_out_frozen(data, run, channel, parts)
    for run in data.runs:
        notes += _take_out_repeated_rows(data, run)
        notes += _take_out_useless(data, run, fresh[run])
    return data.runs, tuple(notes)


def _out_of_sensor(data: _Data, run: str, channel: str, noise: float) -> list[str]:
    reading, period, notes = data.column(channel, run), data.runs[run].period, []
    assert reading is not None
    if bad := int(np.isinf(reading).sum()):
        reading[np.isinf(reading)] = np.nan
        notes.append(f"{run}: {bad} infinite readings of {channel} were left out.")
    for what, noted, rows in (
        ("at the end of its sensor", _CLIPPED,
         value_range.clipped(data.sensor(channel), channel, reading, period)),
        ("which nothing physical explains", 0.0,
         value_range.spikes(data.machine, channel, reading, period, noise)),
    ):  # fmt: skip
        if rows.mean() > noted:
            first = data.runs[run].start + period * int(np.flatnonzero(rows)[0])
            notes.append(f"{run}: {rows.sum()} readings of {channel} {what} were left out, the"
                         f" first at {first:.6g} s.")  # fmt: skip
        reading[rows] = np.nan
    return notes


def _stale(data: _Data, run: str, channel: str) -> list[str]:
    """Leave out rows that only repeat a channel's last value because it is refreshed less often."""
    reading, period = data.column(channel, run), data.runs[run].period
    assert reading is not None
    every = refreshed_every(reading)
    if every == 1.0:
        return []
    step = period * float(np.median(np.diff(np.flatnonzero(np.isfinite(reading)))))
    reading[stale(reading, every)] = np.nan
    lasts = 1e3 * every * step
    return [f"{run}: {channel} is refreshed every {lasts:.3g} ms only; the rows between repeat it"
            " and count as missing."]  # fmt: skip


def _count(data: _Data) -> int:
    return sum(rows.reading.size for rows in data.runs.values())


def _frozen(data: _Data, run: str, channel: str) -> list[Stretch]:
    """Stretches of a run in which a channel is frozen, by the strictest test that applies."""
    reading, sensor, period = data.column(channel, run), data.sensor(channel), data.runs[run].period
    assert reading is not None
    probability = repeat_probability(sensor, channel)
    if probability and as_noisy_as_stated(sensor, channel, _floors(data, run, channel)):
        return frozen_by_noise(reading, probability, _count(data), period)
    kind, _, axis = channel.partition(".")
    if kind == "pressure_supply":  # rests at its relief for as long as it likes
        return []
    if kind.startswith("pressure"):
        other = "pressure_rod" if kind == "pressure_head" else "pressure_head"
        partner = data.column(f"{other}.{axis}", run)
        lowest = data.machine.return_pressure(axis) + _STARVED
        if partner is None:
            return []
        return frozen_chamber(reading, partner, lowest, period)
    if not np.isfinite(reading).any():
        return []
    return _frozen_position(data, run, channel, axis)


def _frozen_position(data: _Data, run: str, channel: str, axis: str) -> list[Stretch]:
    position = f"{data.machine.position_kind(axis)}.{axis}"
    partner = position if channel != position else f"length.{axis}"
    force = data.machine.axes[axis].force
    command = data.runs[run].command[:, list(data.axes).index(axis)]
    others = [data.column(f"{data.machine.position_kind(a)}.{a}", run) for a in data.axes]
    apart = [v for a, v in zip(data.axes, others, strict=True) if v is not None and a != axis]
    span = data.span(channel)
    reading = data.column(channel, run)
    assert reading is not None
    return frozen_by_motion(
        reading, data.column(partner, run), command / (force.command_limit if force else 1.0),
        np.column_stack(apart) if apart else np.empty((len(command), 0)),
        converter(data.sensor(channel), channel).step or _RESOLVED * span,
        (span, data.span(partner)), data.runs[run].period,
    )  # fmt: skip


def _floors(data: _Data, run: str, channel: str) -> list[float]:
    """Noise floors of the channel here, in other runs, and of others with an equal sensor."""
    sensor, witnesses = data.sensor(channel), [(channel, run)]
    witnesses += [(channel, other) for other in data.runs if other != run]
    kind = channel.partition("_")[0].partition(".")[0]
    witnesses += [
        (c, r) for c in data.channels for r in data.runs
        if c != channel and c.startswith(kind) and data.sensor(c).error_rms == sensor.error_rms
    ]  # fmt: skip
    floors = (noise_floor(v) for c, r in witnesses
              if (v := data.column(c, r)) is not None)  # fmt: skip
    return [next((floor for floor in floors if math.isfinite(floor)), math.nan)]


def _take_out_frozen(data: _Data, run: str, channel: str, parts) -> list[str]:
    if not parts:
        return []
    reading, rows = data.column(channel, run), data.runs[run]
    assert reading is not None
    spans = [f"from {rows.start + rows.period * a:.6g} to {rows.start + rows.period * b:.6g} s"
             for a, b in parts]  # fmt: skip
    listed = ", ".join(spans[:3]) + (f" and {len(spans) - 3} times more" if spans[3:] else "")
    value = np.nanmedian(reading[slice(*parts[0])])
    said = f"{run}: {channel} is stuck at {value:.6g} {listed}; these readings were left out."
    if saturated(reading, parts):
        noise = float(data.noise[list(data.channels).index(channel)])
        near = np.abs(reading - value) <= _NEAR * (noise if math.isfinite(noise) else 0.0)
        reading[near] = np.nan
        said = f"{run}: {channel} does not get beyond {value:.6g}, as {listed}; left out there."
    for part in parts:
        reading[slice(*part)] = np.nan
    return [said]


def _take_out_repeated_rows(data: _Data, run: str) -> list[str]:
    rows = data.runs[run]
    odds = [repeat_probability(data.sensor(c), c) for c in data.channels]
    odds = [p if p and as_noisy_as_stated(data.sensor(c), c, _floors(data, run, c))
            else None for c, p in zip(data.channels, odds, strict=True)]  # fmt: skip
    again = repeated_rows(rows.reading, odds, _count(data))
    if not again.any():
        return []
    rows.reading[again] = np.nan
    same = np.append(False, (np.diff(rows.command, axis=0) == 0.0).all(axis=1))
    data.runs[run] = rows._replace(known=rows.known & ~(again & same))
    return [f"{run}: {again.sum()} rows repeat all readings of the row before, which their noise"
            " forbids; they count as missing."]  # fmt: skip


def _take_out_useless(data: _Data, run: str, before: np.ndarray) -> list[str]:
    notes, after = [], data.runs[run].reading
    had, has = np.isfinite(before).sum(axis=0), np.isfinite(after).sum(axis=0)
    for column, channel in enumerate(data.channels):
        if not 0 < has[column] < _KEPT * had[column]:
            continue
        after[:, column] = np.nan
        notes.append(f"{run}: {channel} has too few good readings and was left out"
                     " of this run.")  # fmt: skip
    return notes
