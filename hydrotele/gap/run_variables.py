"""Physical variables of each drive along a run, by the states of its filter or its smoother."""

from typing import NamedTuple

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.estimate.evidence import Judged
from hydrotele.estimate.filter import Input
from hydrotele.estimate.levels import smoothed, smoothed_inputs
from hydrotele.estimate.reduced_model import X, model_space, place, supply_of
from hydrotele.estimate.track import Track, following_model
from hydrotele.hydraulics.actuator_layout import actuator_order
from hydrotele.logs.dataset import Dataset
from hydrotele.machine.machine import Machine
from hydrotele.terms.term import DRIVE_VARIABLES


class Seen(NamedTuple):
    """A run by what its smoother says: variables of every axis, and the rows that are known."""

    values: dict[str, dict[str, np.ndarray]]
    known: np.ndarray
    inputs: dict[Input, np.ndarray]


@compiled
def _drives_of(model, sp, states, position, velocity, act, supply):
    """Positions, velocities (n, nu), activations (n, 4 h) and supplies (n, h) along states (n, nz)."""
    n, t = len(model.mech.independent), len(model.transmission)
    for row in range(len(states)):
        place(model, sp, states[row])
        for i in range(len(model.gear)):
            position[row, i] = sp.drive[X, i]
            total = 0.0
            for f in range(n):
                total += sp.row[i, f] * states[row, n + t + f]
            velocity[row, i] = total
        for k in range(act.shape[1]):
            act[row, k] = sp.act[k]
        for i in range(model.hydraulic):
            supply[row, i] = supply_of(model, sp, states[row], i)


def see(data: Dataset, judged: Judged, track: Track) -> Seen:
    """A run of a guess by what the smoother of its track says."""
    return see_run(judged.guess.machine(data.machine, track.run.name), data, track, is_smoothed=True)


def see_run(machine: Machine, data: Dataset, track: Track, is_smoothed: bool = False) -> Seen:
    """A run of a machine by the states of its filter, which its laws see, or by states and inputs of its smoother."""
    size, states, inputs = track.states.shape[1], track.states, dict[Input, np.ndarray]()
    if is_smoothed:
        run, told = smoothed(track)
        states = states - run.correction[:, :size] + told.deviation[:, :size]
        inputs = dict(zip(track.levels.inputs, smoothed_inputs(track, (run, told)).T, strict=True))
    model = following_model(machine, data)
    order = actuator_order(machine)
    position, velocity = np.empty((len(states), len(order))), np.empty((len(states), len(order)))
    supply, act = np.zeros((len(states), model.hydraulic)), np.empty((len(states), 4 * model.hydraulic))
    _drives_of(model, model_space(model), np.ascontiguousarray(states), position, velocity, act, supply)
    clock = track.run.start + track.run.period * np.arange(len(states))
    values: dict[str, dict[str, np.ndarray]] = {}
    for i, axis in enumerate(order):
        own = {"time": clock, "position": position[:, i], "velocity": velocity[:, i],
               "command": track.run.command[:, i]}  # fmt: skip
        facts = machine.axes[axis]
        if facts.is_hydraulic:
            head, rod = act[:, 4 * i + 2], act[:, 4 * i + 3]
            areas = facts.hydraulic_drive.effective_areas
            own |= {"pressure_head": head, "pressure_rod": rod,
                    "force": areas[0] * head - areas[1] * rod}  # fmt: skip
            own["pump_speed" if facts.pump else "spool"] = act[:, 4 * i]
            if facts.valve:
                own["pressure_supply"] = supply[:, i]
        elif facts.force:
            own["force"] = facts.force.gain * own["command"]
        values[axis] = own
    plain = {axis: dict(own) for axis, own in values.items()}
    for axis, own in values.items():
        own |= {
            f"{name}.{other}": column for other, columns in plain.items() if other != axis
            for name, column in columns.items()
            if name in DRIVE_VARIABLES and (name != "force" or machine.axes[other].is_hydraulic)
        }  # fmt: skip
    known = np.isfinite(states.sum(axis=1))
    known[: min(round(0.5 / track.run.period), len(states) // 4)] = False
    if track.run.valid is not None:
        known &= track.run.valid
    return Seen(values, known, inputs)
