"""Records for identification: joint positions and drive forces of a run on a uniform clock.

`build_records` computes them from the logs of a machine, with known sensor defects removed. The other
functions cut records and check that a motion is periodic.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.hydraulics.actuator_layout import actuator_order
from hydrotele.kinematics.drive_linkage import DriveLinkage, axis_linkage
from hydrotele.kinematics.linkages import LoopOpenError
from hydrotele.logs.dataset import Dataset, RunData
from hydrotele.machine.machine import Machine, get_sensor_set, reading_noise_rms
from hydrotele.machine.sensors import SensorError

_ERROR_CONTEXT = "identification"
_MAX_CYCLE_DRIFT_ROWS = 0.5  # rows, largest shift of a cycle against the rows over a whole record
_MEDIAN_OVER_STD = 0.6745  # median absolute value of a normal error over its standard deviation
_MAX_DIFFERENCE_OVER_NOISE = 8.0  # noise multiples: servos react to noise, so that cycles differ slightly


@dataclass(frozen=True)
class IdentificationRecord:
    """One run of k axes over n rows of a uniform clock.

    Attributes:
        name: name of the run.
        period: time between rows [s].
        axes: names of the axes.
        position: (n, k) joint positions [rad] or [m], NaN where unknown.
        position_noise: (k,) standard deviation of one position; NaN if the sensors state none.
        force: (n, k) drive forces before friction [N] or [N m], NaN where unknown: the force of the
            oil, or of a force drive's command.
        force_noise: (k,) standard deviation of one force; 0 if it follows from a command, NaN if
            the sensors state none.
        first_row: index of the first row in the run; earlier rows have no position.
    """

    name: str
    period: float
    axes: tuple[str, ...]
    position: np.ndarray
    position_noise: np.ndarray
    force: np.ndarray
    force_noise: np.ndarray
    first_row: int = 0


def build_records(
    dataset: Dataset,
) -> tuple[tuple[IdentificationRecord, ...], IdentificationRecord, tuple[str, ...]]:
    """Compute joint positions and drive forces of all runs from the logs of a machine.

    For a joint with an own sensor and a cylinder length sensor, both readings are averaged with
    weights according to their noise. A sensor without stated noise is used only where the other has no
    reading.

    Args:
        dataset: logs of a machine.

    Returns:
        Records of the fitted runs, of the held-out run, and notes on missing readings.

    Raises:
        InputError: an axis has a transmission or no position, or no drive has a known force.

    Examples:
        The force of a drive follows from the pressures of its chambers.

        >>> import tempfile
        >>> from pathlib import Path
        >>> import hydrotele as ht
        >>> machine = ht.load_machine("rig")
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for seed in "1", "2":
        ...         overrides = {"duration": "5", "log_rate": "200", "control_rate": "200", "seed": seed}
        ...         run = ht.run_scenario(ht.load_scenario("rig_steps", overrides))
        ...         ht.save_log(run.measured, Path(folder, f"run_{seed}.parquet"))
        ...     fit, heldout, notes = build_records(ht.load_dataset(folder, machine))
        >>> [record.name for record in fit], heldout.name, heldout.axes
        (['run_1'], 'run_2', ('slide',))
        >>> area = machine.axes["slide"].cylinder
        >>> head, rod = run.measured["pressure_head.slide"], run.measured["pressure_rod.slide"]
        >>> bool(abs(heldout.force[:, 0] - (area.area_head * head - area.area_rod * rod)).max() < 1e-6)  # N
        True
    """
    for axis, facts in dataset.machine.axes.items():
        if facts.transmission:
            raise InputError(
                _ERROR_CONTEXT, f"{axis} has a transmission (backlash or flexibility) between drive and"
                " load: measurements of one side do not determine the other",
            )  # fmt: skip
    axes = tuple(axis for axis in dataset.axes if _position_channels(dataset, axis))
    forced = [axis for axis in axes if _force_channels(dataset, axis) is not None]
    notes = [f"{a} has no position sensor: it is not used." for a in dataset.axes
             if a not in axes]  # fmt: skip
    notes += [f"{a} has no pressure sensor at one side: its motion is used, its force is unknown."
              for a in axes if a not in forced]  # fmt: skip
    if len(axes) < len(dataset.axes):
        missing = ", ".join(a for a in dataset.axes if a not in axes)
        raise InputError(
            _ERROR_CONTEXT,
            f"the position of {missing} is not in the logs, but the forces of all axes depend on"
            " it: log its angle or its length",
        )
    if not forced:
        raise InputError(
            _ERROR_CONTEXT,
            "no force is known: log both pressures of at least one axis (or a drive command)",
        )
    made = [_build_record(dataset, run, axes) for run in (*dataset.fit, dataset.heldout)]
    return tuple(made[:-1]), made[-1], tuple(notes)


def compute_force_noise(machine: Machine, sensors: str) -> np.ndarray:
    """Compute the noise of all drive forces from that of the pressure sensors in a sensor set.

    Args:
        machine: the machine.
        sensors: name of the sensor set.

    Returns:
        (k,) standard deviation of a force reading in actuator order [N] or [N m]; 0 for force
        drives.

    Raises:
        InputError: the machine has no such sensor set.
    """
    known, out = get_sensor_set(machine, sensors), []
    for axis in actuator_order(machine):
        facts = machine.axes[axis]
        if facts.force:
            out.append(0.0)
            continue
        sides = zip(facts.hydraulic_drive.effective_areas, ("head", "rod"), strict=True)
        out.append(float(np.linalg.norm(
            [area * reading_noise_rms(machine, known, f"pressure_{side}.{axis}") for area, side in sides]
        )))  # fmt: skip
    return np.array(out)


def cut_to_whole_cycles(record: IdentificationRecord, period: float) -> IdentificationRecord:
    """Cut a record to its last whole cycles; earlier rows may contain the fade-in.

    Args:
        record: record of a periodic motion.
        period: period of the motion [s].

    Returns:
        The cut record.

    Raises:
        InputError: the record has no whole cycle, or a cycle is not a whole number of rows.
    """
    rows = period / record.period
    cycle = round(rows)
    drift = abs(rows - cycle) * len(record.force) / max(cycle, 1)
    if drift > _MAX_CYCLE_DRIFT_ROWS or cycle < 3:
        raise InputError(
            record.name, f"a period of {period:g} s is not a whole number of rows of"
            f" {record.period:g} s",
        )  # fmt: skip
    count = len(record.force) // cycle * cycle
    if count == 0:
        raise InputError(record.name, f"is shorter than a period of {period:g} s")
    return replace(record, position=record.position[-count:], force=record.force[-count:])


def check_periodicity(record: IdentificationRecord, period: float, noise: np.ndarray) -> None:
    """Raise InputError if the motion of a record does not repeat.

    The criterion for each axis is the median difference of positions one period apart. It must not
    exceed eight times that of the noise.

    Args:
        record: the record.
        period: stated period of the motion [s].
        noise: (k,) noise of the positions [rad] or [m].

    Raises:
        InputError: the motion of an axis does not repeat after the period.
    """
    step = round(period / record.period)
    if step < 1 or len(record.force) <= step:
        return
    change = record.position[step:] - record.position[:-step]
    size = np.sqrt(np.nanmedian(change**2, axis=0)) / (_MEDIAN_OVER_STD * np.sqrt(2.0) * noise)
    for axis, times in zip(record.axes, size, strict=True):
        if times > _MAX_DIFFERENCE_OVER_NOISE:
            raise InputError(
                record.name, f"the motion of {axis} does not repeat after {period:g} s: it differs"
                f" by {times:.0f} times its noise",
            )  # fmt: skip


def keep_beginning(
    record: IdentificationRecord, max_duration: float, period: float | None = None
) -> IdentificationRecord:
    """Keep only the first part of a record, at most `max_duration` long.

    Args:
        record: the record.
        max_duration: largest length of the part [s].
        period: period of the motion [s], of which a whole number, at least one, is kept; None for any length.

    Returns:
        The cut record.

    Raises:
        InputError: a position has no valid sample in this part.
    """
    if period:
        max_duration = max(1.0, max_duration // period) * period
    rows = round(max_duration / record.period)
    if rows >= len(record.force):
        return record
    return trim_missing_positions(replace(record, position=record.position[:rows], force=record.force[:rows]))


def _build_record(dataset: Dataset, run: RunData, axes: Sequence[str]) -> IdentificationRecord:
    rows = len(run.command)
    position, force = np.full((2, rows, len(axes)), np.nan)
    position_noise, force_noise = np.full((2, len(axes)), np.nan)
    for k, axis in enumerate(axes):
        position[:, k], position_noise[k] = _compute_position(dataset, run, axis)
        force[:, k], force_noise[k] = _compute_force(dataset, run, axis)
    return trim_missing_positions(
        IdentificationRecord(run.name, run.period, tuple(axes), position, position_noise, force, force_noise)
    )


def trim_missing_positions(record: IdentificationRecord) -> IdentificationRecord:
    """Remove rows at the ends of a record at which a position is missing.

    Args:
        record: the record.

    Returns:
        The rows from the first to the last with all positions.

    Raises:
        InputError: a position has no valid sample.
    """
    known = np.isfinite(record.position)
    for axis, column in zip(record.axes, known.T, strict=True):
        if not column.any():
            raise InputError(record.name, f"has no valid position of {axis}: remove this run")
    first = int(known.argmax(axis=0).max())
    last = len(known) - int(known[::-1].argmax(axis=0).max())
    rows = slice(first, last)
    return replace(record, position=record.position[rows], force=record.force[rows], first_row=record.first_row + first)


def _position_channels(dataset: Dataset, axis: str) -> list[str]:
    names = (f"{dataset.machine.position_kind(axis)}.{axis}", f"length.{axis}")
    return [name for name in names if name in dataset.channels]


def _compute_position(dataset: Dataset, run: RunData, axis: str) -> tuple[np.ndarray, float]:
    """Compute the joint position (n,) of an axis from its sensors in a run, and its noise.

    Readings of an angle and a length sensor are averaged if both state their noise. Otherwise the one
    that states it is preferred, and the other is used where its reading is missing. The noise is a
    standard deviation, or NaN if neither states it.
    """
    machine = dataset.machine
    values, noises = [], []
    for channel in _position_channels(dataset, axis):
        reading, noise = _read_corrected_channel(dataset, run, channel)
        if not np.isfinite(reading).any():
            continue
        if channel.startswith("length."):
            linkage = axis_linkage(machine, axis)
            reading = _compute_joint_position(machine, axis, linkage, reading)
            middle = reading[np.isfinite(reading)]
            noise = noise / float(np.sqrt(np.mean(linkage.rate(middle) ** 2)))
        values.append(reading)
        noises.append(noise)
    if not values:
        return np.full(len(run.command), np.nan), float("nan")
    known = np.isfinite(noises)
    weight = np.where(known, 1.0 / np.maximum(np.where(known, noises, 1.0), 1e-12) ** 2, 0.0)
    weights = weight[:, None] * np.isfinite(values)
    total = weights.sum(axis=0)
    out = np.nansum(weights * np.nan_to_num(values), axis=0) / np.where(total > 0, total, np.nan)
    for reading in values:
        out = np.where(np.isfinite(out), out, reading)
    return out, float(weight.sum() ** -0.5) if known.any() else float("nan")


def _compute_joint_position(machine: Machine, axis: str, linkage: DriveLinkage, length: np.ndarray) -> np.ndarray:
    """Convert piston displacements (n,) [m] to joint positions (n,) by a cylinder's linkage."""
    cylinder = machine.axes[axis].cylinder
    assert cylinder is not None
    out, known = np.full(len(length), np.nan), np.isfinite(length)
    try:
        out[known] = linkage.angle(length[known] + cylinder.closed_length)
    except LoopOpenError as error:
        raise InputError(f"length.{axis}", f"does not match the machine's linkage: {error}") from None
    return out


def _force_channels(dataset: Dataset, axis: str) -> tuple[str, ...] | None:
    """Return the names of the two pressure channels that give a hydraulic drive's force.

    The result is empty for a force drive, and None if a channel is missing.
    """
    if not dataset.machine.axes[axis].is_hydraulic:
        return ()
    names = (f"pressure_head.{axis}", f"pressure_rod.{axis}")
    return names if all(name in dataset.channels for name in names) else None


def _compute_force(dataset: Dataset, run: RunData, axis: str) -> tuple[np.ndarray, float]:
    """Compute the drive force (n,) of an axis from pressures or command, and its noise [N] or [N m].

    The noise is a standard deviation: 0 for a force from a command. Both are NaN if a pressure channel
    is missing.
    """
    machine = dataset.machine
    channels = _force_channels(dataset, axis)
    facts = machine.axes[axis]
    if channels is None:
        return np.full(len(run.command), np.nan), float("nan")
    if facts.force:
        command = run.command[:, dataset.axes.index(axis)]
        rows = np.arange(len(command)) - facts.command_delay / run.period
        late = np.maximum(np.floor(rows + 1e-9), 0.0).astype(int)
        return np.where(run.command_known, facts.force.gain * command, np.nan)[late], 0.0
    (head, noise_head), (rod, noise_rod) = (_read_corrected_channel(dataset, run, c) for c in channels)
    area_head, area_rod = facts.hydraulic_drive.effective_areas
    return area_head * head - area_rod * rod, float(np.hypot(area_head * noise_head, area_rod * noise_rod))


def _read_corrected_channel(dataset: Dataset, run: RunData, channel: str) -> tuple[np.ndarray, float]:
    """Return a channel's readings (n,) corrected for the machine's known sensor errors, and their noise."""
    column = dataset.channels.index(channel)
    error = dataset.machine.sensor_errors.get(channel, SensorError())
    values = correct_sensor_error(run.reading[:, column], error, run.period, run.start)
    return values, float(dataset.noise_of(run)[column]) / error.scale


def correct_sensor_error(values: np.ndarray, error: SensorError, period: float, start: float = 0.0) -> np.ndarray:
    """Remove a known sensor error (offset, drift, scale, delay, lag) from readings.

    Offset and drift are subtracted, the result is divided by the scale and moved earlier by the delay.

    Args:
        values: (n,) readings, NaN where missing.
        error: offset, drift, scale, delay and lag. The lag is treated as a delay, which is accurate
            for motions slower than the lag.
        period: time between rows [s].
        start: time of the first row since the start of the run [s].

    Returns:
        (n,) corrected readings, NaN where unknown, as at the end for a delayed sensor.
    """
    values = (values - error.offset_at(start + period * np.arange(len(values)))) / error.scale
    if error.is_delayed:
        rows = np.arange(len(values), dtype=float)
        late = (error.delay + error.time_constant) / period
        values = np.interp(rows + late, rows, values, right=np.nan)
    return values
