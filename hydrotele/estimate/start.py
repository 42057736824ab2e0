"""The state before a run's first reading: from its first rows, with a wide spread."""

from collections.abc import Callable

import numpy as np
from scipy.optimize import fminbound

from hydrotele.dynamics.integrate import load_position, place
from hydrotele.dynamics.model import Model, model_space
from hydrotele.hydraulics.circuit import (
    SLOTS,
    Slot,
    circuit_scratch,
    open_ports,
    wanted_share,
)
from hydrotele.hydraulics.parameters import DELIVERY, actuator_order
from hydrotele.logs.load import Dataset, RunData
from hydrotele.machine.machine import Machine

_LATEST = 1.0  # s after which a channel's first reading says nothing of the start
_LOOK = 0.1  # s whose mean starts the filter, or the first reading after it
_WIDE = {
    "position": 0.02, "drive": 0.0, "rate": 0.05, "drive_rate": 0.0, "spool": 0.02,
    "spool_rate": 0.2, "pressure_head": 1e6, "pressure_rod": 1e6,
    "speed": 1.0, "pressure_load": 1e5, "bristle": 0.5, "delivery": 0.3,
    "added_delivery": 0.1,
}  # fmt: skip
_SLIP = 0.01  # m/s or rad/s, rate at which a drive may leave its load
_LOOSE = 0.02  # of the backlash, within which a drive's rest is known once it was looked for
_ROUGH = 1e5  # Pa, of a pressure's mean over the first rows
_GRID, _FINE = 7, 0.01  # rests that are tried at first, and how fine they are at last
_MOVED = {"spool": 1.0, "spool_rate": 25.0}  # per command at the start, what it may be off by
_BLIND = {"pressure_head": 5e6, "pressure_rod": 5e6}


def start_state(
    machine: Machine, data: Dataset, run: RunData, model: Model, names: list[str],
    rest: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """State and covariance before the first reading.

    Args:
        machine: the machine.
        data: the dataset, for its channels.
        run: the run.
        model: the machine's reduced model.
        names: its states.
        rest: (t,) where the drive of each transmission rests in its backlash, from -1 to 1; by
            default in the middle.

    Returns:
        ((nz,) state, (nz, nz) covariance), wide enough to let the first readings decide.
    """
    order = actuator_order(machine)
    joints = {machine.axes[a].joint: a for a in order}
    state = np.zeros(len(names))
    wide = np.array([_WIDE[name.partition(".")[0]] for name in names])
    cut = run.start > run.log.time[0] + 0.5 * run.period  # out of a record, in motion
    shown = {}
    for c, name in enumerate(data.channels):
        head = run.reading[: _first_rows(run, c), c]
        if np.isfinite(head).any():
            value = float(np.nanmean(head))
            shown[name] = (value - model.offset[c]) / model.scale[c]
    for s, name in enumerate(names):
        kind, _, place = name.partition(".")
        axis = joints.get(place, place)
        if kind == "position":
            channel = f"{machine.position_kind(axis)}.{axis}" if axis in order else ""
            state[s] = shown.get(channel, machine.home.get(place, 0.0))
        elif kind in _MOVED and cut:  # the command has been there for long, or has just come
            given = float(np.clip(run.command[0, order.index(axis)], -1.0, 1.0))
            state[s] = given if kind == "spool" else 0.0
            wide[s] = np.hypot(wide[s], _MOVED[kind] * given)
        elif kind in _BLIND:  # a load cylinder rests without pressure, and none shows it
            state[s] = shown.get(f"{kind}.{axis}", 3e6)
            if f"{kind}.{axis}" not in shown:
                wide[s] = _BLIND[kind]
    if DELIVERY in names:
        state[names.index(DELIVERY)] = _drawn(model, state)
    spread = np.diag(wide**2)
    _place_drives(model, state, spread, np.zeros(len(model.transmission)) if rest is None else rest)
    return state, spread


def _drawn(model: Model, state: np.ndarray) -> float:
    """Share of its flow that a pump gives whose valves have stood where they stand."""
    act = state[2 * (len(model.mech.free) + len(model.transmission)) :]
    ports = circuit_scratch()
    open_ports(model.user, act, act, ports, 0, model.hydraulic, 0.0, act)
    return wanted_share(model.user, 0, model.hydraulic, ports)


def _first_rows(run: RunData, c: int) -> int:
    """Rows that show a channel's first readings."""
    rows = max(1, round(_LOOK / run.period))
    good = np.flatnonzero(np.isfinite(run.reading[:, c]))
    late = len(good) and good[0] >= rows and good[0] * run.period < _LATEST
    return int(good[0]) + 1 if late else rows


def _place_drives(model: Model, state: np.ndarray, spread: np.ndarray, rest: np.ndarray) -> None:
    """Put every drive where it rests in its backlash; at its end, where its spring pushes back.

    A drive is as uncertain as its load, and by what backlash, friction and pressures leave open.
    """
    space = model_space(model)
    place(model, space, state)
    n, t = len(model.mech.free), len(model.transmission)
    first = 2 * (n + t)
    for i, gear in enumerate(model.gear):
        if gear < 0:
            continue
        _, stiffness, _, backlash = model.transmission[gear]
        numbers = model.user[i * SLOTS : (i + 1) * SLOTS]
        twist, held = 0.5 * rest[gear] * backlash, numbers[Slot.COULOMB] + numbers[Slot.STRIBECK]
        if i < model.hydraulic and (abs(rest[gear]) == 1.0 or backlash == 0.0):
            head, rod = first + 4 * i + 2, first + 4 * i + 3
            areas = numbers[Slot.AREA_HEAD], numbers[Slot.AREA_ROD]
            twist += (areas[0] * state[head] - areas[1] * state[rod]) / stiffness
            held += np.hypot(*areas) * _ROUGH
        state[n + gear] = load_position(model, space, i) + twist
        loose = _LOOSE * backlash + held / stiffness
        for at, size in ((0, loose), (n + t, _SLIP)):
            drive, row = at + n + gear, space.row[i]
            spread[drive, :] = row @ spread[at : at + n, :]
            spread[:, drive] = spread[drive, :]
            spread[drive, drive] = row @ spread[at : at + n, drive] + size**2


def find_rest(loss: Callable[[np.ndarray], float], free: np.ndarray) -> np.ndarray:
    """Where drives rest in their backlash, one after the other.

    Args:
        loss: of the run's first seconds, for (t,) rests.
        free: (t,) whether a transmission has backlash.

    Returns:
        (t,) rests from -1 to 1.
    """
    rest = np.zeros(len(free))
    for gear in np.flatnonzero(free):

        def at(value: float, gear: int = int(gear)) -> float:
            moved = rest.copy()
            moved[gear] = value
            return loss(moved)

        grid = np.linspace(-1.0, 1.0, _GRID)
        tried = [at(value) for value in grid]
        best, width = grid[np.argmin(tried)], grid[1] - grid[0]
        inside = max(-1.0, best - width), min(1.0, best + width)
        value, least, _, _ = fminbound(at, *inside, xtol=_FINE, full_output=True)
        rest[gear] = value if least < min(tried) else best
    return rest
