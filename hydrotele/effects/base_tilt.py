"""A machine that does not stand level."""

import math

import numpy as np

from hydrotele.effects.effect import Effect, Parameter, Values, changed
from hydrotele.machine.machine import Machine


def _place(machine: Machine) -> tuple[str, ...]:
    return ("base",) if any(machine.gravity) else ()


def _parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Ground is level to a few degrees; 3 mrad is what a builder's level shows."""
    tilt = Parameter("rad", 0.0, -0.2, 0.2, 0.03, 0.003)
    return {"roll": tilt, "pitch": tilt}


def _apply(machine: Machine, location: str, values: Values) -> Machine:
    """Gravity in the frame of a base turned by pitch about y and then by roll about its own x.

    Positive pitch lowers the front (x), positive roll lowers the right-hand side (-y).
    """
    roll, pitch = values["roll"], values["pitch"]
    c, s = math.cos(roll), math.sin(roll)
    about_x = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    c, s = math.cos(pitch), math.sin(pitch)
    about_y = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    if roll == 0.0 and pitch == 0.0:
        return machine
    gravity = (about_y @ about_x).T @ np.array(machine.gravity)
    return changed(machine, "gravity", tuple(float(g) for g in gravity))


EFFECT = Effect("base_tilt", "the base does not stand level", "force", _place, _parameters, _apply)
