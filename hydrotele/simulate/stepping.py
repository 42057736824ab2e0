"""A plant stepped under held commands that may arrive late.

MuJoCo's own actuator delay does not reach the native hydraulics, which read `ctrl` itself, and
would round a delay to its step; here a command that changes inside a step acts as its mean over the
step, which is of second order. Whoever steps a model bare steps it without command delay.
"""

import itertools

import mujoco
import numpy as np

from hydrotele.simulate.feedback import Past
from hydrotele.simulate.plant import Plant
from hydrotele.simulate.record import split_delay


class DelayLine:
    """Commands on their way to the valves and drives.

    Args:
        plant: the plant, with the `command_delay` of its axes.
        before: (nu,) commands in force before the first tick: those of a machine at rest.
    """

    def __init__(self, plant: Plant, before: np.ndarray) -> None:
        """Fill the line with what was commanded before."""
        h = plant.model.opt.timestep
        delays = [plant.machine.axes[name].command_delay for name in plant.axes]
        self.parts = [split_delay(delay, h) for delay in delays]
        self.size = 1 + max((steps for steps, _ in self.parts), default=0)
        self.idle = not any(delays)
        self._line = np.tile(np.asarray(before, float), (self.size, 1))

    def controls(self, command: np.ndarray, steps: int) -> np.ndarray:
        """Put a held command in at one end; (steps, nu) mean commands come out at the other."""
        line = np.concatenate([self._line, np.tile(command, (steps, 1))])
        out = np.empty((steps, len(self.parts)))
        for i, (whole, part) in enumerate(self.parts):
            first = self.size - whole
            out[:, i] = line[first : first + steps, i]
            if part:
                out[:, i] += part * (line[first - 1 : first - 1 + steps, i] - out[:, i])
        self._line = line[steps:]
        return out


class Stepper:
    """Advances a plant by one tick of held commands.

    Args:
        plant: the plant.
        data: staggered state at the start, as `begin_leapfrog` left it; its `ctrl` holds the
            commands in force before.
        steps: physics steps per tick.
    """

    def __init__(self, plant: Plant, data: mujoco.MjData, steps: int) -> None:
        """Fill the delay line and the past."""
        self._model, self._data, self._steps = plant.model, data, steps
        self._line, self.past = DelayLine(plant, data.ctrl), Past(plant, data)

    def advance(self, command: np.ndarray) -> None:
        """Step through one tick during which a command (nu,) is held."""
        model, data, past = self._model, self._data, self.past
        if self._line.idle and not past.lags:
            data.ctrl[:] = command
            mujoco.mj_step(model, data, nstep=self._steps)
            return
        controls = self._line.controls(command, self._steps)
        if past.lags:
            for control in controls:
                data.ctrl[:] = control
                mujoco.mj_step(model, data)
                past.keep(data)
            return
        changes = 1 + np.flatnonzero((controls[1:] != controls[:-1]).any(axis=1))
        for start, stop in itertools.pairwise((0, *changes.tolist(), self._steps)):
            data.ctrl[:] = controls[start]
            mujoco.mj_step(model, data, nstep=stop - start)
