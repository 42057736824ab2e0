"""Simulate the electro-hydraulic actuator under its published controller.

Imported by `real_machines.py`. Once per ms, in the units of the firmware (counts of 25 um, rpm,
steps of a 5398-step bridge): position P 10, 7 on negative errors, limited to 2000 rpm; then speed
PI 1 and 0.15 per ms, whose integral rests while the output is beyond 10 000; nothing below 112
steps. The speed is the mean of 8 differences of the 12-bit encoder times 16.65, in whole rpm, with
the sign of the valve; it is 13.7 % too large.
"""

import math

import numpy as np

from hydrotele.machine.machine import Machine
from hydrotele.simulate.plant import build_plant, initial_state
from hydrotele.simulate.record import start_leapfrog
from hydrotele.simulate.stepping import Stepper
from tools.studies.eha_runs import CHANNELS, FIRMWARE_RPM, EhaRun, true_start

COUNT = 25.0e-6  # m
_TURN = 4096 / (2.0 * math.pi)  # counts per rad of the pump's encoder
_FULL, _DEAD = 5398, 112  # steps of the bridge
_GAIN, _BACKWARDS, _FASTEST = 10.0, 0.7, 2000.0  # rpm per count, 1, rpm
_INTEGRAL, _BEYOND = 0.15, 10_000.0  # per ms, steps


class Controller:
    """The firmware's two loops; its state from one ms to the next."""

    def __init__(self) -> None:
        """Everything at rest."""
        self._speeds = [0] * 8
        self._integral, self._resting, self._side, self._angle = 0.0, False, 0, 0

    def step(self, reference: float, position: float, turned: float) -> float:
        """Signed duty of the next ms.

        Args:
            reference: [m].
            position: [m].
            turned: angle that the pump has turned [rad].

        Returns:
            Duty with the sign of the valve [1]; 0 leaves both relays off.
        """
        error = reference / COUNT - round(position / COUNT)
        wanted = _GAIN * error * (_BACKWARDS if error < 0.0 else 1.0)
        wanted = min(_FASTEST, max(-_FASTEST, wanted))
        angle = math.floor(turned * _TURN)
        speed = self._side * int((angle - self._angle) * FIRMWARE_RPM)
        self._angle = angle
        self._speeds = [*self._speeds[1:], speed]
        off = wanted - int(sum(self._speeds) / 8)
        if not self._resting:
            self._integral += _INTEGRAL * off
        output = off + self._integral
        self._resting = abs(output) >= _BEYOND
        steps = int(min(_BEYOND, max(-_BEYOND, output)))
        self._side = 0 if abs(steps) <= _DEAD else (1 if steps > 0 else -1)
        return self._side * min(abs(steps), _FULL) / _FULL


def under_control(machine: Machine, run: EhaRun) -> np.ndarray:
    """(n, 3) what the sensors show of the MuJoCo plant under the controller, in `CHANNELS`.

    Args:
        machine: the machine with the load of the run.
        run: gives the start, the reference, and when the controller is off.
    """
    plant = build_plant(machine, 1.0e-3, ground=False)
    start = true_start(machine, run)
    pressures = {c.partition(".")[0]: [value] for c, value in start.items()}
    data = initial_state(plant, {"order": ["piston"], "angle": [0.0], **pressures})
    start_leapfrog(plant.model, data)
    stepper, controller, turned = Stepper(plant, data, 1), Controller(), 0.0
    reference = run.log["reference.piston"]
    shown = np.empty((len(reference), 3))
    for row, wanted in enumerate(reference):
        position = data.qpos[plant.qpos[0]]
        shown[row] = position, data.act[2], data.act[3]
        duty = controller.step(wanted, position, turned) if row < run.active.stop else 0.0
        stepper.advance(np.array([duty]))
        turned += 1.0e-3 * abs(data.act[0])
    for column, channel in enumerate(CHANNELS):
        if channel in machine.sensor_errors:
            shown[:, column] += machine.sensor_errors[channel].offset
    return shown
