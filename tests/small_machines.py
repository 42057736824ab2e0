"""Machines of other sizes than the shipped ones, for tests: dynamically similar copies of them.

Lengths grow by a ratio, masses by its cube, pressures by the ratio itself, because weight over area does.
Angles, commands, angular rates of the drives and time constants of the valves stay. The oil keeps its bulk
modulus, so that a small machine is stiff.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hydrotele.estimate.colour import Colour
from hydrotele.estimate.reduced_model import model_space, reduced_model, simulate_rows, state_names
from hydrotele.estimate.track import steps_per_row
from hydrotele.hydraulics.actuator_layout import actuator_order
from hydrotele.logs.dataset import Dataset, RunData
from hydrotele.logs.log import Log
from hydrotele.machine.machine import Machine

_LENGTH_POWER = {
    "position": 1, "com": 1, "closed_length": 1, "stroke": 1, "smoothing_length": 1,
    "stribeck_velocity": 1, "mass": 3, "inertia": 5,
    "area_head": 2, "area_rod": 2, "dead_volume": 3, "displacement": 3, "leakage": 2,
    "rated_flow": 3, "pump_flow": 3, "tank_leakage": 2, "makeup_gain": 2, "port_relief_gain": 2,
    "rated_pressure_drop": 1, "compensated_drop": 1, "port_relief": 1, "smoothing": 1,
    "relief_pressure": 1, "tank_pressure": 1,
}  # fmt: skip
"""Field of a machine -> power of the length ratio by which it is multiplied."""
_CYLINDER_FRICTION = {"coulomb": 3, "stribeck_extra": 3, "viscous": 2, "stribeck_velocity": 1}
_MOTOR_FRICTION = {"coulomb": 4, "stribeck_extra": 4, "viscous": 4, "stribeck_velocity": 0}


def scale_machine(machine: Machine, ratio: float, sensors: bool = False) -> Machine:
    """Return a dynamically similar machine.

    Args:
        machine: with valve drives.
        ratio: of the lengths [1].
        sensors: whether to keep the stated sensors, whose accuracies are not scaled.

    Returns:
        The machine, validated.
    """
    data = machine.model_dump()
    if not sensors:
        data["sensors"] = {}
    scaled = {key: _scale(value, ratio) for key, value in data.items()}
    for name, axis in scaled["axes"].items():
        for kind, powers in (("cylinder", _CYLINDER_FRICTION), ("motor", _MOTOR_FRICTION)):
            if axis.get(kind):
                old = data["axes"][name][kind]["friction"]
                axis[kind]["friction"] = {k: _times(v, ratio ** powers.get(k, 0)) for k, v in old.items()}
    for name, link in scaled["links"].items():
        joint = data["links"][name]["joint"]
        if joint:
            slides = joint["type"] == "slide"
            power = 2 if slides else 4
            link["joint"] = {**joint, "damping": joint["damping"] * ratio**power}
            if slides:
                link["joint"]["range"] = _times(joint["range"], ratio)
                scaled["home"][joint["name"]] = data["home"].get(joint["name"], 0.0) * ratio
    return Machine.model_validate(scaled)


def _scale(value: Any, ratio: float) -> Any:
    if not isinstance(value, dict):
        return value
    return {
        key: _times(part, ratio ** _LENGTH_POWER[key]) if key in _LENGTH_POWER else _scale(part, ratio)
        for key, part in value.items()
    }


def _times(value: Any, factor: float) -> Any:
    if isinstance(value, int | float) and not isinstance(value, bool):
        return value * factor
    return tuple(v * factor for v in value) if isinstance(value, list | tuple) else value


def simulate_data(
    truth: Machine, channels: tuple[str, ...], noise: dict[str, float], model: Machine | None = None,
    period: float = 0.02, rows: int = 400, noise_stated: bool = False, own: Sequence[Machine] = (),
) -> Dataset:  # fmt: skip
    """Simulate runs of a machine with the reduced model, and return them as a dataset.

    Args:
        truth: machine that is simulated.
        channels: c channels that are read.
        noise: kind of channel -> standard deviation of its readings [channel's unit].
        model: machine of the dataset; `truth` by default.
        period: of the rows [s].
        rows: of each run.
        noise_stated: whether the dataset states the noise.
        own: the machine of each run; by default two runs of `truth`.

    Returns:
        The dataset; the first run is held out.
    """
    axes, names = tuple(actuator_order(truth)), state_names(truth)
    assert truth.supply
    sizes = np.array([noise[c.partition(".")[0]] for c in channels])
    time, runs = period * np.arange(rows), []
    for seed, true in enumerate(own or (truth, truth)):
        command = np.column_stack(
            [0.4 * np.sin((1.1 + 0.4 * k + 0.13 * seed) * time / (50.0 * period) + k) for k in range(len(axes))]
        )
        state = np.zeros(len(names))
        for s, name in enumerate(names):
            kind, _, place = name.partition(".")
            if kind == "position":
                state[s] = truth.home.get(place, 0.0)
            elif kind.startswith("pressure"):
                state[s] = 0.3 * truth.supply.relief_pressure
        simulated, steps = reduced_model(true, channels), steps_per_row(true, period, 0.5e-3)
        shown, states = np.empty((rows, len(channels))), np.empty((rows, len(names)))
        simulate_rows(simulated, model_space(simulated), state, command, period, steps, shown, states)
        shown += np.random.default_rng(seed).normal(size=shown.shape) * sizes
        log = Log(time=time, columns={}, units={})
        runs.append(RunData(f"run_{seed}", 0.0, period, command, np.ones(rows, bool), shown, log))
    stated = sizes if noise_stated else np.full(len(channels), np.nan)
    return Dataset(model or truth, axes, channels, stated, tuple(runs[1:]), runs[0], ())


def simulate_colour(colour: Colour, period: float, rows: int, seed: int) -> np.ndarray:
    """Return coloured noise (rows,) of a standard deviation of 1, whatever the size of the colour."""
    rng, flow = np.random.default_rng(seed), colour.transition(period)
    state, values = rng.standard_normal(colour.states), np.empty(rows)
    for row in range(rows):
        values[row] = state[0]
        state = flow @ state + np.sqrt(1.0 - colour.decay(period) ** 2) * rng.standard_normal(colour.states)
    return values


def add_coloured_noise(data: Dataset, colours: Mapping[str, Colour], seed: int) -> Dataset:
    """Add coloured noise to channels of all runs.

    Args:
        data: the dataset.
        colours: channel -> noise, whose size counts.
        seed: of the noise.

    Returns:
        The dataset with the same stated noise.
    """

    def add(run: RunData, number: int) -> RunData:
        reading = run.reading.copy()
        for k, (channel, colour) in enumerate(colours.items()):
            own = simulate_colour(colour, run.period, len(reading), seed + 100 * number + k)
            reading[:, data.channels.index(channel)] += colour.size * own
        return dataclasses.replace(run, reading=reading)

    fit = tuple(add(run, 1 + k) for k, run in enumerate(data.fit))
    return dataclasses.replace(data, fit=fit, heldout=add(data.heldout, 0))
