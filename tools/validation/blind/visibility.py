"""Compute how visible an effect is in the readings, from the true states.

A model without the effect starts every half second from the true state of the machine that has it
and is fed with the logged commands; what its sensors would read is compared with what those of the
machine would read, in standard deviations of one noisy sample.
"""

from typing import Any

import mujoco
import numpy as np

from hydrotele.logs.log import Log
from hydrotele.machine.machine import Machine, get_sensor_set, reading_noise_rms
from hydrotele.machine.sensors import SensorError
from hydrotele.simulate.mechanism import axes_with_transmission
from hydrotele.simulate.plant import Plant, build_plant, initial_state
from hydrotele.simulate.record import Recorder, start_leapfrog
from hydrotele.simulate.stepping import delayed_commands
from hydrotele.simulate.true_values import true_channels
from tools.validation.blind.plant import Recorded, shown

RESTART = 0.5  # s
TIMESTEP = 1.0e-3  # s
STRONG, MODERATE = 2.0, 0.7  # noise standard deviations, RMS in the best channel of the best run


def visibility(model: Machine, runs: dict[str, Recorded]) -> dict[str, Any]:
    """Visibility of what a machine has and a model of it lacks.

    Args:
        model: the machine without the effect.
        runs: name -> run of the machine that has it.

    Returns:
        Per run `channel` where it shows most and `rms_over_sigma` there; `total_fit_runs`: root of
        the summed squares over all samples and channels of the fit runs; `strength`.
    """
    plant = build_plant(model, TIMESTEP, ground=False)
    table, total = {}, 0.0
    for name, run in runs.items():
        differences = _differences(plant, run)
        sizes = {channel: float(np.sqrt(np.mean(d**2))) for channel, d in differences.items()}
        best = max(sizes, key=lambda channel: sizes[channel])
        table[name] = {"channel": best, "rms_over_sigma": round(sizes[best], 4)}
        if name.startswith("fit"):
            total += sum(float(np.sum(d**2)) for d in differences.values())
    best = max(row["rms_over_sigma"] for name, row in table.items() if name.startswith("fit"))
    strength = "strong" if best >= STRONG else "moderate" if best >= MODERATE else "weak"
    return {"runs": table, "total_fit_runs": round(float(np.sqrt(total)), 2), "strength": strength}


def _differences(plant: Plant, run: Recorded) -> dict[str, np.ndarray]:
    machine = plant.machine
    sensors = get_sensor_set(machine, run.log.metadata["sensors"])
    predicted = _restarted(plant, run.truth, np.column_stack(
        [run.log[f"command.{axis}"] for axis in plant.axes]
    ))  # fmt: skip
    table = {}
    for channel, reading in run.readings.items():
        error = machine.sensor_errors.get(channel, SensorError())
        expected = shown(error, run.truth.time, predicted[channel])
        difference = (reading - expected) / reading_noise_rms(machine, sensors, channel)
        if _free_zero(machine, channel):
            difference = difference - difference.mean()
        table[channel] = difference
    return table


def _free_zero(machine: Machine, channel: str) -> bool:
    """Whether nothing depends on where a joint is zero: it turns the whole machine upright."""
    kind, _, name = channel.partition(".")
    if kind != "angle":
        return False
    joint = machine.joints[machine.axes[name].joint]
    upright = np.cross(joint.axis, machine.gravity)
    return machine.links[machine.link_of(joint.name)].parent == "world" and not upright.any()


def _restarted(plant: Plant, truth: Log, commands: np.ndarray) -> dict[str, np.ndarray]:
    """True channels (n,) of the plant, put into the true state again and again."""
    period = float(truth.time[-1] - truth.time[0]) / (len(truth) - 1)
    every, steps = round(RESTART / period), round(period / TIMESTEP)
    recorder = Recorder(plant, len(truth))
    data = mujoco.MjData(plant.model)
    controls = delayed_commands(plant, data.ctrl, commands, steps).reshape(len(truth), steps, -1)
    for row in range(len(commands)):
        if row % every == 0:
            data = initial_state(plant, _state(plant, truth, row))
            start_leapfrog(plant.model, data)
        recorder.record_state(row, truth.time[row], data)
        for control in controls[row]:
            data.ctrl[:] = control
            mujoco.mj_step(plant.model, data)
    return true_channels(plant, recorder.to_record())[0]


def _state(plant: Plant, truth: Log, row: int) -> dict[str, Any]:
    """The true state in the form of a log's `initial_state`."""
    axes, valves = list(plant.axes), list(plant.axes[: plant.hydraulic])
    state: dict[str, Any] = {
        "order": axes,
        "angle": [truth[f"{plant.machine.position_kind(a)}.{a}"][row] for a in axes],
        "velocity": [truth[f"truth.velocity.{a}"][row] for a in axes],
    }
    for key in ("spool", "spool_rate"):
        state[key] = [truth[f"truth.{key}.{a}"][row] for a in valves]
    for key in ("pressure_head", "pressure_rod"):
        state[key] = [truth[f"{key}.{a}"][row] for a in valves]
    sides = {a: _drive_side(plant.machine, truth, a, row) for a in axes_with_transmission(plant.machine)}
    state["drive"] = {a: place for a, (place, _) in sides.items()}
    state["drive_velocity"] = {a: speed for a, (_, speed) in sides.items()}
    return state


def _drive_side(machine: Machine, truth: Log, axis: str, row: int) -> tuple[float, float]:
    """Place and velocity of a drive behind a transmission; a rotor's is as its torque winds it."""
    if machine.axes[axis].cylinder:
        return truth[f"length.{axis}"][row], truth[f"truth.piston_velocity.{axis}"][row]
    facts, torque = machine.axes[axis].transmission, truth[f"truth.force.{axis}"][row]
    assert facts
    wound = torque / facts.stiffness + np.sign(torque) * facts.backlash / 2.0
    kind = machine.position_kind(axis)
    return truth[f"{kind}.{axis}"][row] + wound, truth[f"truth.velocity.{axis}"][row]
