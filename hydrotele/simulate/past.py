"""What late sensors show of a plant: its last states, delayed or behind a first-order lag."""

import mujoco
import numpy as np

from hydrotele.hydraulics.circuit import circuit_scratch
from hydrotele.machine.noise import first_order
from hydrotele.simulate.plant import Plant
from hydrotele.simulate.readout import state_supply
from hydrotele.simulate.record import Lag, aligned_positions, sensor_lags, split_delay


class Past:
    """States of the last physics steps, for sensors that read late.

    Args:
        plant: the plant, with the delays and time constants of its `sensor_errors`.
        data: state at the start, as `begin_leapfrog` left it; it stands for all times before.
    """

    def __init__(self, plant: Plant, data: mujoco.MjData) -> None:
        """Make room for the longest delay."""
        self._plant, self.lags = plant, sensor_lags(plant.machine)
        self._step = plant.model.opt.timestep
        self._parts = {delay: split_delay(delay, self._step) for delay, _ in self.lags}
        supply = plant.machine.sensor_errors.get("pressure_supply")
        self._slow_supply = supply is not None and supply.time_constant > 0.0
        self._scratch = circuit_scratch()
        self._before = self._state(data)
        size = 2 + max((steps for steps, _ in self._parts.values()), default=0)
        self._rings = {
            constant: tuple(np.tile(part, (size, 1)) for part in self._before)
            for constant in dict.fromkeys(constant for _, constant in self.lags)
        }
        self._size, self._now = size, 0

    def _state(self, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions (nq,), activations (na,) and supply pressure (1,), 0 where nobody asks."""
        supply = np.zeros(1)
        if self._slow_supply:
            user = self._plant.model.actuator_user.ravel()
            supply[0] = state_supply(user, self._plant.hydraulic, data.act, self._scratch)
        return aligned_positions(self._plant.model, data), data.act.copy(), supply

    def keep(self, data: mujoco.MjData) -> None:
        """Remember the state after a step."""
        state, last = self._state(data), self._now
        self._now = (last + 1) % self._size
        for constant, rings in self._rings.items():
            for ring, before, now in zip(rings, self._before, state, strict=True):
                ring[self._now] = (
                    first_order(ring[last], before, now, self._step / constant)
                    if constant else now
                )  # fmt: skip
        self._before = state

    def at(self, lag: Lag) -> tuple[np.ndarray, np.ndarray, float]:
        """What a sensor with this delay and time constant shows.

        Args:
            lag: one of `lags` [s].

        Returns:
            Positions (nq,), activations (na,) and supply pressure [Pa], linear between two steps;
            the supply pressure only where its own sensor has a time constant.
        """
        delay, constant = lag
        steps, part = self._parts[delay]
        new, old = (self._now - steps) % self._size, (self._now - steps - 1) % self._size
        qpos, act, supply = (
            ring[new] + part * (ring[old] - ring[new]) for ring in self._rings[constant]
        )
        return qpos, act, float(supply[0])
