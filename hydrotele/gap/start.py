"""The state before a run's first reading: from its first rows, with a wide spread."""

import numpy as np

from hydrotele.dynamics.model import HEAD, LENGTH, POSITION, ROD, Model
from hydrotele.gap.dataset import Dataset, RunData
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
    return state, np.diag(wide**2)


__all__ = ["HEAD", "LENGTH", "POSITION", "ROD", "start_state"]
