"""Controller of the test rig: valve command from position error and reference rate."""

import numpy as np

FULL_SPEED = 0.4  # m/s, about that of the open valve
POSITION_GAIN = 8.0  # 1/s
DEADBAND = 0.02  # of the valve, compensated


class SlideController:
    """Proportional controller with feedforward, for every axis of a machine without an arm."""

    action, rate = "valve", 200.0

    def begin(self, machine, axes):
        """Receive the machine (without the effects of the scenario) and the driven axes, before the run."""
        self.axes = axes

    def __call__(self, state):
        """Return the action of every axis, -1 to 1, for a `hydrotele.PilotState`."""
        speed = state.reference_rate + POSITION_GAIN * (state.reference - state.position)
        opening = speed / FULL_SPEED
        return opening + DEADBAND * np.tanh(opening / 0.005)
