"""What a data set measures: its channels, its sensors and their noise, and what nobody measured."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from hydrotele.core.datafile import suggest
from hydrotele.core.errors import InputError
from hydrotele.hydraulics.parameters import actuator_order
from hydrotele.logs.files import RunFiles
from hydrotele.logs.rows import Rows
from hydrotele.machine.machine import Machine
from hydrotele.machine.noise import IDEAL, channel_sensor, noise_rms, sensor_set
from hydrotele.machine.sensors import SensorSet
from hydrotele.machine.signals import parse_channel

_MOVES = 10.0  # standard deviations of a reading that a motion must amount to
_UNSTATED = ("none", "", IDEAL)  # what logs with true values say of their sensors


def predicted(machine: Machine) -> tuple[str, ...]:
    """Every channel that the model predicts, in the order of a dataset."""
    order = actuator_order(machine)
    valves = [name for name in order if machine.axes[name].hydraulic]
    return (
        *(f"{machine.position_kind(name)}.{name}" for name in order),
        *(f"length.{name}" for name in order if machine.axes[name].cylinder),
        *(f"pressure_head.{name}" for name in valves),
        *(f"pressure_rod.{name}" for name in valves),
        *(("pressure_supply",) if machine.supply and valves else ()),
    )


def channels(files: Sequence[RunFiles], machine: Machine) -> tuple[str, ...]:
    """Channels that any run has and the model predicts.

    Raises:
        InputError: there is none; lists what the model predicts.
    """
    logs = [log for run in files for log in run.logs]
    found = tuple(c for c in predicted(machine) if any(c in log for log in logs))
    if not found:
        raise InputError(
            ", ".join(run.name for run in files) or "the data",
            f"holds nothing that the model of {machine.name} predicts; that would be"
            f" {', '.join(predicted(machine))}",
        )
    return found


def sensors(
    files: Sequence[RunFiles], machine: Machine, name: str | None
) -> tuple[SensorSet | None, list[str]]:
    """The sensors of all logs, None if their noise is unknown, and notes.

    Raises:
        InputError: the machine has no such sensors, or the logs have different ones.
    """
    if name is not None:
        return sensor_set(machine, name), []
    stated = {log.metadata["sensors"]: log.source
              for run in files for log in run.logs if "sensors" in log.metadata}  # fmt: skip
    if len(stated) > 1:
        (a, first), (b, other) = list(stated.items())[:2]
        raise InputError(
            first, f"has the sensors {a!r}, {other} has {b!r}: name those that all logs have, or"
            " take logs of one kind",
        )  # fmt: skip
    said = next(iter(stated), None)
    if said in machine.sensors:
        return machine.sensors[said], []
    if said in _UNSTATED or not machine.sensors:
        return None, ["the logs state no sensors with a known accuracy; the noise is unknown."]
    first = next(iter(machine.sensors))
    if said is not None:
        return machine.sensors[first], [
            f"the logs have the sensors {said!r}, which {machine.name} has not; {first!r} was taken"
            " for them."
        ]
    return machine.sensors[first], []


def noise(machine: Machine, sensors: SensorSet | None, channel: str) -> float:
    """Standard deviation of one reading [channel's unit], NaN without a stated accuracy."""
    if channel_sensor(machine, sensors, channel).error_rms == 0.0:
        return math.nan
    return noise_rms(machine, sensors, channel)


def strangers(files: Sequence[RunFiles], machine: Machine) -> list[str]:
    """Notes on channels that no axis of the machine has, and on commands that were averaged."""
    valid = (*predicted(machine), *(f"command.{axis}" for axis in machine.axes))
    kinds = {name.partition(".")[0] for name in valid} | {"angle", "position"}
    notes = []
    for channel in dict.fromkeys(c for run in files for log in run.logs for c in log.columns):
        if channel not in valid and parse_channel(channel).kind in kinds:
            notes.append(f"{channel} is ignored: {machine.name} has no such channel;"
                         f" {suggest(channel, valid)}.")  # fmt: skip
    averaged = [r.name for r in files if r.logs[0].metadata.get("command", "held") != "held"]
    if averaged:
        notes.append(f"{', '.join(averaged)}: a row's command is a mean over the row, not held;"
                     " delays are known to a row at best.")  # fmt: skip
    return notes


def still(runs: Mapping[str, Rows], channels: Sequence[str], noise: np.ndarray) -> list[str]:
    """Notes on runs in which no position moves."""
    notes = []
    places = [c for c, name in enumerate(channels) if not name.startswith("pressure")]
    for name, rows in runs.items():
        good = [c for c in places if np.isfinite(rows.reading[:, c]).any()]
        spans = [np.nanmax(rows.reading[:, c]) - np.nanmin(rows.reading[:, c]) for c in good]
        if good and all(s <= _MOVES * np.nan_to_num(noise[c])
                        for s, c in zip(spans, good, strict=True)):  # fmt: skip
            notes.append(f"{name}: nothing moves; friction, inertia and timing cannot be seen.")
    return notes


def blind_axes(machine: Machine, axes: Sequence[str], channels: Sequence[str]) -> list[str]:
    """Notes on axes whose position nobody measured."""
    return [
        f"neither {machine.position_kind(axis)} nor length of {axis} is measured; what only its"
        " position shows cannot be told."
        for axis in axes
        if not {f"{machine.position_kind(axis)}.{axis}", f"length.{axis}"} & set(channels)
    ]
