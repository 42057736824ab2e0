"""The state before a run's first reading: from its first rows, with a wide spread."""

import numpy as np

from hydrotele.dynamics.integrate import load_position, place
from hydrotele.dynamics.model import Model, model_space
from hydrotele.gap.dataset import Dataset, RunData
from hydrotele.hydraulics.circuit import SLOTS, Slot
from hydrotele.hydraulics.parameters import actuator_order
from hydrotele.machine import Machine

_LOOK = 5  # rows whose mean starts the filter
_WIDE = {
    "position": 0.02, "drive": 0.02, "rate": 0.05, "drive_rate": 0.05, "spool": 0.02,
    "spool_rate": 0.2, "pressure_head": 1e6, "pressure_rod": 1e6,
}  # fmt: skip
_BLIND = {"pressure_head": 5e6, "pressure_rod": 5e6}


def start_state(
    machine: Machine, data: Dataset, run: RunData, model: Model, names: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """State and covariance before the first reading.

    Args:
        machine: the machine.
        data: the dataset, for its channels.
        run: the run.
        model: the machine's reduced model.
        names: its states.

    Returns:
        ((nz,) state, (nz, nz) covariance), wide enough to let the first readings decide.
    """
    order = actuator_order(machine)
    joints = {machine.axes[a].joint: a for a in order}
    state = np.zeros(len(names))
    wide = np.array([_WIDE[name.partition(".")[0]] for name in names])
    shown = {}
    for c, name in enumerate(data.channels):
        head = run.reading[:_LOOK, c]
        if np.isfinite(head).any():
            value = float(np.nanmean(head))
            shown[name] = (value - model.offset[c]) / model.scale[c]
    for s, name in enumerate(names):
        kind, _, place = name.partition(".")
        axis = joints.get(place, place)
        if kind == "position":
            channel = f"{machine.position_kind(axis)}.{axis}" if axis in order else ""
            state[s] = shown.get(channel, machine.home.get(place, 0.0))
        elif kind.startswith("pressure"):
            state[s] = shown.get(f"{kind}.{axis}", 3e6)
            if f"{kind}.{axis}" not in shown:
                wide[s] = _BLIND[kind]
    _stretch_transmissions(model, state, names)
    return state, np.diag(wide**2)


def _stretch_transmissions(model: Model, state: np.ndarray, names: list[str]) -> None:
    """Put every drive where its spring carries what the pressures push."""
    space = model_space(model)
    place(model, space, state)
    n = len(model.mech.free)
    first = len(names) - 4 * model.hydraulic
    for i, gear in enumerate(model.gear):
        if gear < 0 or i >= model.hydraulic:
            continue
        numbers = model.user[i * SLOTS : (i + 1) * SLOTS]
        p_head, p_rod = state[first + 4 * i + 2 : first + 4 * i + 4]
        push = numbers[Slot.AREA_HEAD] * p_head - numbers[Slot.AREA_ROD] * p_rod
        _, stiffness, _, backlash = model.transmission[gear]
        twist = push / stiffness + np.sign(push) * 0.5 * backlash
        state[n + gear] = load_position(model, space, i) + twist
