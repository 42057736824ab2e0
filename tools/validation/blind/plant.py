"""Record one run of a trial's machine, with and without sensor noise."""

import dataclasses
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from scipy.signal import lsim, lti

from hydrotele.hydraulics.actuator_layout import actuator_order
from hydrotele.hydraulics.circuit import circuit_scratch, solve_state_supplies
from hydrotele.logs.log import Log
from hydrotele.machine.machine import Machine, get_sensor_set
from hydrotele.machine.sensors import SensorError
from hydrotele.run.run import Run, run_scenario
from hydrotele.scenario.scenario import PlantedEffect, Scenario
from hydrotele.simulate.sensor_models import simulate_readings
from tools.validation.blind.draw import Planted
from tools.validation.blind.outside import OUTSIDE

_KEPT = ("machine", "tool", "sample_rate_hz", "sensors", "run")  # metadata that tell nothing


@dataclasses.dataclass(frozen=True)
class Recorded:
    """One run.

    Attributes:
        log: what the workflow gets: measured channels only, metadata that tell nothing.
        truth: the true states.
        readings: channel -> (n,) what the sensors would read without noise and converter [SI].
    """

    log: Log
    truth: Log
    readings: dict[str, np.ndarray]


def record(machine: Machine, scenario: Scenario, planted: list[Planted]) -> Recorded:
    """Simulate a run of the machine with effects.

    Args:
        machine: the machine without effects.
        scenario: the run.
        planted: effects of the library, or at most one from outside of it.

    Returns:
        The run.
    """
    inside = [p for p in planted if p.name not in OUTSIDE]
    beyond = next((p for p in planted if p.name in OUTSIDE), None)
    effects = tuple(PlantedEffect(name=p.name, location=p.location, parameters=p.parameters) for p in inside)
    scenario = scenario.model_copy(update={"effects": effects})
    disturbance = _Disturbance(machine, beyond, scenario)
    run = run_scenario(scenario, disturbance.progress)
    channels = {c: run.truth[c] for c in run.measured.columns}
    if disturbance.numbers:
        channels["pressure_supply"] = _supply(machine, run.truth, disturbance.numbers)
    changed = _misread(run.truth.time, channels, beyond)
    columns = dict(run.measured.columns)
    redone = {c: v for c, v in changed.items() if v is not run.truth[c]}
    columns |= simulate_readings(machine, get_sensor_set(machine, scenario.sensors), scenario.seed, redone)
    readings = {c: _read(run, c, v) for c, v in changed.items() if not c.startswith("command.")}
    metadata = {k: v for k, v in run.measured.metadata.items() if k in _KEPT}
    log = dataclasses.replace(run.measured, columns=columns, metadata=metadata)
    return Recorded(log, run.truth, readings)


class _Disturbance:
    """Lets an effect from outside act before every step of a run, by MuJoCo's control callback.

    `run_scenario` reports progress just before its first step and just after its last one: there
    the callback comes and goes, so that nothing else in the process meets it.

    Args:
        machine: the machine.
        beyond: the effect; None for none.
        scenario: the run.
    """

    def __init__(self, machine: Machine, beyond: Planted | None, scenario: Scenario) -> None:
        self.machine, self.scenario = machine, scenario
        self.beyond = beyond if beyond and OUTSIDE[beyond.name].step else None
        self.every = round(1.0 / (scenario.log_rate * scenario.timestep))
        self.act: Callable[[Any], None] | None = None
        self.numbers: dict[int, np.ndarray] = {}
        """Row of the log -> (nu * SLOTS,) actuator numbers in force; empty without an effect."""

    def progress(self, now: float, total: float) -> None:
        if self.beyond and now == 0.0:
            mujoco.set_mjcb_control(self._control)
        elif now >= total:
            mujoco.set_mjcb_control(None)

    def _control(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        assert self.beyond
        if self.act is None:
            effect, order = OUTSIDE[self.beyond.name], actuator_order(self.machine)
            location = self.beyond.location
            i = order.index(location) if location in order else 0
            assert effect.step
            self.act = effect.step(model, i, self.machine, location, self.beyond.parameters)
        row, rest = divmod(round(data.time / model.opt.timestep), self.every)
        if rest == 0:
            self.numbers[row] = model.actuator_user.ravel().copy()
        self.act(data)


def _supply(machine: Machine, truth: Log, numbers: dict[int, np.ndarray]) -> np.ndarray:
    """Supply pressure (n,) [Pa] with the actuator numbers that every row had."""
    order, scratch = list(machine.hydraulic_axes), circuit_scratch()
    kinds = ("truth.spool", "truth.spool_rate", "pressure_head", "pressure_rod")
    act = np.column_stack([truth[f"{kind}.{axis}"] for axis in order for kind in kinds])
    return np.array([
        solve_state_supplies(numbers[row], 0, len(order), np.ascontiguousarray(act[row]), scratch)
        for row in range(len(act))
    ])  # fmt: skip


def _misread(time, channels, beyond: Planted | None) -> dict[str, np.ndarray]:
    if beyond is None or (read := OUTSIDE[beyond.name].read) is None:
        return channels
    return channels | read(time, channels, beyond.location, beyond.parameters)


def _read(run: Run, channel: str, values: np.ndarray) -> np.ndarray:
    """What a sensor with the defects of the library reads of true values, without noise."""
    error = run.plant.machine.sensor_errors.get(channel, SensorError())
    return shown(error, run.truth.time, values)


def shown(error: SensorError, time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """What a defective sensor shows of true values (n,) at times (n,) [s], row to row straight."""
    if error.time_constant:
        lag = lti([1.0], [error.time_constant, 1.0])
        values = values[0] + lsim(lag, values - values[0], time - time[0])[1]
    return error.scale * np.interp(time - error.delay, time, values) + error.offset
