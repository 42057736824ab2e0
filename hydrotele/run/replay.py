"""Replay the commands of a log in open loop and compare the simulated with the measured channels.

The model starts from the initial state of the log and receives no feedback from its readings.
"""

import dataclasses
import math
import time as clock
from collections.abc import Callable
from typing import Any

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.core.files import parse_json
from hydrotele.logs.log import Log
from hydrotele.machine.log_channels import default_channel_unit
from hydrotele.machine.machine import Machine, get_sensor_set, reading_noise_rms
from hydrotele.machine.sensors import SensorError
from hydrotele.scenario.surrounding_objects import read_soil_from_log
from hydrotele.simulate.mechanism import axes_with_transmission
from hydrotele.simulate.plant import Plant, build_plant, initial_state
from hydrotele.simulate.record import Record, Recorder, start_leapfrog
from hydrotele.simulate.sensor_models import apply_sensor_errors
from hydrotele.simulate.stepping import Stepper
from hydrotele.simulate.surroundings import Surroundings
from hydrotele.simulate.true_values import delayed_channels, true_channels

COMPARED_KINDS = ("angle", "position", "length", "pressure_head", "pressure_rod", "pressure_supply")


@dataclasses.dataclass(frozen=True)
class ChannelDifference:
    """Difference between a simulated and a measured channel.

    Attributes:
        rms: RMS difference [unit].
        max: largest absolute difference [unit].
        unit: SI unit.
        range: full scale of the channel [unit]: main relief pressure for pressures, stroke for
            lengths, otherwise the range of the measured values.
        noise_rms: noise standard deviation of one reading [unit], 0 for ideal sensors.
    """

    rms: float
    max: float
    unit: str
    range: float
    noise_rms: float


@dataclasses.dataclass(frozen=True)
class Replay:
    """Result of a replay.

    Attributes:
        measured: the log that was replayed.
        simulated: the simulated channels at the same times.
        channels: channel name -> difference, for every channel that both logs contain.
        realtime_factor: simulated time divided by computing time [1].

    Examples:
        >>> import hydrotele as ht
        >>> run = ht.run_scenario(ht.load_scenario("rig_steps", {"duration": "1"}))
        >>> replay = ht.replay_log(run.measured, ht.load_machine("rig"))

        The model is that of the simulation, so that the difference is the noise of the sensors.

        >>> difference = replay.channels["pressure_head.slide"]
        >>> round(difference.rms / difference.noise_rms, 2)
        1.06
    """

    measured: Log
    simulated: Log
    channels: dict[str, ChannelDifference]
    realtime_factor: float

    def __repr__(self) -> str:
        """Return a text with the source of the log, the number of channels and the worst channel.

        The worst channel has the largest RMS error relative to its range.
        """
        text = f"Replay({self.measured.source!r}, {len(self.channels)} channels"
        if self.channels:
            name, worst = max(self.channels.items(), key=lambda item: item[1].rms / (item[1].range or math.inf))
            text += f", largest error relative to the range: {name} RMS {worst.rms:.4g} {worst.unit}"
        return f"{text})"


def replay_log(
    log: Log,
    machine: Machine,
    timestep: float = 1.0e-3,
    progress: Callable[[float, float], None] | None = None,
) -> Replay:
    """Simulate a machine with the commands of a log and compare simulated with measured channels.

    The simulation starts from the `initial_state` metadata of the log. Without it, the first row
    gives the positions and pressures; velocities are zero and spools are closed. Before the first
    row the machine is assumed to be at rest with its rest commands, which matters for delayed
    commands. The scene contains a ground only if the metadata of the log has `ground: yes`, and soil
    to dig only if these metadata name it; the soil then moves once per row.

    The compared values are the sensor readings without noise, including offsets, scales and delays.
    For a log with `truth.*` columns they are the true values.

    Args:
        log: the log; must contain the command and the position of every axis.
        machine: the machine.
        timestep: largest physics step [s]; it is reduced to fit a whole number into one log row.
        progress: callback, called periodically with (simulated seconds, total seconds).

    Returns:
        The replay.

    Raises:
        InputError: a command or position column is missing, samples are missing, the recorded scene
            contained objects, or the initial state violates the closed loops of the machine.
        SimulationFailed: states became infinite or not a number.

    Examples:
        A log of a cylinder with a friction of 900 N, and a model with 150 N:

        >>> import hydrotele as ht
        >>> effect = "[{name: coulomb_friction, location: slide, parameters: {coulomb: 900}}]"
        >>> run = ht.run_scenario(ht.load_scenario("rig_steps", {"duration": "2", "effects": effect}))
        >>> model = ht.load_machine("rig")
        >>> wrong = ht.replay_log(run.measured, model)
        >>> sticky = ht.apply_effect(model, "coulomb_friction", "slide", {"coulomb": 900})
        >>> right = ht.replay_log(run.measured, sticky)
        >>> for replay in wrong, right:
        ...     print(round(1e-5 * replay.channels["pressure_head.slide"].rms, 2), "bar")
        3.42 bar
        0.3 bar
    """
    if not 1e-6 <= timestep < math.inf:
        raise InputError("timestep", f"must be at least 1e-6 s, not {timestep:g}")
    if len(log.gaps):
        where = f"{log.source}, row {log.gaps[0]}"
        raise InputError(where, "samples are missing: split the log there")
    if things := log.metadata.get("things"):
        message = f"the recorded scene contained {things}, which a replay cannot simulate"
        raise InputError(log.source, message)
    period = float(log.time[-1] - log.time[0]) / (len(log) - 1)
    steps = max(1, math.ceil(period / timestep - 1e-6))
    ground = log.metadata.get("ground") == "yes"
    plant = build_plant(machine, period / steps, ground, read_soil_from_log(log) if ground else ())
    missing = [c for c in _required_channels(plant) if c not in log]
    if missing:
        raise InputError(
            log.source,
            f"a replay of {machine.name} needs {', '.join(missing)}; the log has {', '.join(sorted(log.columns))}",
        )
    unknown = [c for c in _required_channels(plant) if not np.isfinite(log[c]).all(where=_used_rows(log, c))]
    if unknown:
        raise InputError(log.source, f"a replay needs all commands and the first positions; missing in {unknown[0]}")
    data = initial_state(plant, _initial_state_from_log(plant, log))
    commands = np.column_stack([log[f"command.{a}"] for a in plant.axes])
    begin = clock.perf_counter()
    record = _simulate_commands(plant, data, log.time, commands, steps, progress)
    factor = (log.time[-1] - log.time[0]) / max(clock.perf_counter() - begin, 1e-9)
    values, units = true_channels(plant, record)
    if not any(name.startswith("truth.") for name in log.columns):
        values |= apply_sensor_errors(machine, values | delayed_channels(plant, record), log.time)
    simulated = Log(
        time=log.time, columns=values, units=units, source=f"replay of {log.source}",
        metadata={"machine": machine.name, "tool": machine.tool, "run": f"replay {log.name}"},
    )  # fmt: skip
    return Replay(log, simulated, _compute_channel_differences(log, simulated, machine), factor)


def _used_rows(log: Log, channel: str) -> np.ndarray:
    """Return for each of the n rows of a log whether a replay needs the value of a channel there, (n,) bool.

    A replay needs commands in all rows, and the other channels only in the first row.
    """
    return np.full(len(log), True) if channel.startswith("command.") else np.arange(len(log)) == 0


def _required_channels(plant: Plant) -> list[str]:
    positions = [f"{plant.machine.position_kind(a)}.{a}" for a in plant.axes]
    return [f"command.{a}" for a in plant.axes] + positions


def _initial_state_from_log(plant: Plant, log: Log) -> dict[str, Any]:
    if "initial_state" in log.metadata:
        return _initial_state_from_metadata(plant, log)
    axes = list(plant.axes)
    state: dict[str, Any] = {
        "order": axes,
        "angle": [_first_true_value(plant, log, f"{plant.machine.position_kind(a)}.{a}") for a in axes],
    }
    valves = axes[: plant.hydraulic]
    names = [f"pressure_{side}.{a}" for side in ("head", "rod") for a in valves]
    if valves and all(n in log and math.isfinite(log[n][0]) for n in names):
        for side in ("pressure_head", "pressure_rod"):  # readings below 0 are sensor noise
            state[side] = [max(0.0, _first_true_value(plant, log, f"{side}.{a}")) for a in valves]
    return state


def _first_true_value(plant: Plant, log: Log, channel: str) -> float:
    """Return the true value at the first row of a log: the reading without the sensor's offset and scale."""
    error = plant.machine.sensor_errors.get(channel, SensorError())
    return (float(log[channel][0]) - error.offset) / error.scale


def _initial_state_from_metadata(plant: Plant, log: Log) -> dict[str, Any]:
    try:
        state = parse_json(log.metadata["initial_state"])
        order = list(state["order"])
        if sorted(order) != sorted(plant.axes):
            raise ValueError(f"its order {order} does not list the axes {list(plant.axes)}")
        start: dict[str, Any] = {
            "order": order,
            "angle": _read_finite_vector(state, "angle", len(order)),
        }
        for key in ("velocity", "spool", "spool_rate", "pressure_head", "pressure_rod"):
            if key in state:
                size = len(order) if key == "velocity" else plant.hydraulic
                start[key] = _read_finite_vector(state, key, size, len(order))
        joints = dict(state.get("joints", {}))
        start["joints"] = {name: float(_read_finite_vector(joints, name)) for name in joints}
        for key in ("drive", "drive_velocity"):
            sides = dict(state.get(key, {}))
            known = axes_with_transmission(plant.machine)
            start[key] = {name: float(_read_finite_vector(sides, name)) for name in sides if name in known}
        for key in ("bristle", "delivery", "added_delivery"):
            owners = dict(state.get(key, {}))
            start[key] = {name: float(_read_finite_vector(owners, name)) for name in owners}
    except (ValueError, KeyError, TypeError) as error:
        reason = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        where = f"{log.source}: metadata initial_state"
        raise InputError(where, f"is invalid: {reason}") from None
    return start


def _read_finite_vector(state: dict, key: str, *sizes: int) -> np.ndarray:
    """Return the finite numbers of an entry of a state dictionary.

    Args:
        state: key -> number or list of numbers.
        key: the entry.
        *sizes: allowed lengths; without any, the entry must be a single number.

    Raises:
        ValueError: the entry has another shape, or a number is not finite.
    """
    values = np.asarray(state[key], dtype=float)
    if values.shape not in ([(size,) for size in sizes] or [()]) or not np.isfinite(values).all():
        raise ValueError(f"{key} must be {sizes[0] if sizes else 1} finite numbers")
    return values


def _simulate_commands(plant: Plant, data, times, commands, steps, progress) -> Record:
    recorder = Recorder(plant, len(times))
    recorder.command[:] = commands
    around, period = Surroundings(plant.machine, plant.model, plant.surroundings), steps * plant.model.opt.timestep
    start_leapfrog(plant.model, data)
    stepper = Stepper(plant, data, steps)
    for row, time in enumerate(times):
        recorder.record_state(row, time, data, stepper.sensor_values() if stepper.has_delayed_sensors else None)
        if progress and row % 100 == 0:
            progress(time - times[0], times[-1] - times[0])
        recorder.contact[row, 0] += around.soil_force
        recorder.load[row] = around.soil_load
        stepper.advance(commands[row])
        if around.needs_update:
            around.update(time, data, period)
    if progress:
        progress(times[-1] - times[0], times[-1] - times[0])
    return recorder.to_record()


def _compute_channel_differences(log: Log, simulated: Log, machine: Machine) -> dict[str, ChannelDifference]:
    name = log.metadata.get("sensors", "")
    sensors = get_sensor_set(machine, name) if name in machine.sensors else None
    table = {}
    for channel in log.columns:
        kind = channel.partition(".")[0]
        if kind not in COMPARED_KINDS or channel not in simulated:
            continue
        known = np.isfinite(log[channel])
        if not known.any():
            continue
        error = (simulated[channel] - log[channel])[known]
        span = _full_scale(machine, channel) or float(np.ptp(log[channel][known]))
        table[channel] = ChannelDifference(
            rms=float(np.sqrt(np.mean(error**2))),
            max=float(np.abs(error).max()),
            unit=log.units.get(channel) or default_channel_unit(channel),
            range=span,
            noise_rms=reading_noise_rms(machine, sensors, channel),
        )
    return table


def _full_scale(machine: Machine, channel: str) -> float | None:
    """Return the full scale of a channel, relative to which its errors are reported.

    It is the main relief pressure for pressures [Pa] and the stroke of the cylinder for lengths
    [m]; None for other channels.
    """
    kind, _, axis = channel.partition(".")
    if kind.startswith("pressure") and machine.supply:
        return max(pump.relief_pressure for pump in machine.pumps.values())
    if kind == "length" and axis in machine.axes and machine.axes[axis].cylinder:
        return machine.axes[axis].cylinder.stroke  # type: ignore[union-attr]
    return None
