"""Machine variants and start states of the episodes, compiled before the first episode.

Every variant is a complete machine with its effects, at rest at its start with closed valves. An
episode selects a variant by copying model parameters and a state in native code.
`typical_variation` gives parameter ranges for robustness tests.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import MODEL_FIELDS

from hydrotele.core.errors import InputError
from hydrotele.core.files import resolve_path
from hydrotele.effects import EFFECTS, apply_effect
from hydrotele.envs.episode import MAX_AXES, MAX_CHANNELS
from hydrotele.envs.task import Options, Task
from hydrotele.machine.machine import Machine
from hydrotele.machine.sensors import SensorError
from hydrotele.scenario.surrounding_objects import SurroundingObject
from hydrotele.simulate.batch import STATE_KIND
from hydrotele.simulate.mechanism import TIP_SITE
from hydrotele.simulate.plant import Plant, build_plant, rest_state
from hydrotele.simulate.record import sensed_channels, start_leapfrog
from hydrotele.simulate.stepping import command_delays, sensor_delays

_MAX_CACHED_SETS = 8  # maximum number of cached sets of variants, which the environments of a process share
_CACHE: dict[str, tuple["Variants", Task]] = {}


@dataclasses.dataclass(frozen=True)
class Variants:
    """v machines with their start states.

    Attributes:
        plant: plant of the first variant.
        machines: the machines.
        surroundings: objects around each machine.
        states: (v, s) complete MuJoCo start states, staggered in time by `start_leapfrog`.
        start_tips: (v, 3) tip positions at the start [m].
        fields: model field -> (v, size) values, for fields that differ or that the task writes.
        sensor_scales: (v, MAX_CHANNELS) sensor scale factors [1].
        sensor_offsets: (v, MAX_CHANNELS) sensor offsets.
        sensor_delays: (v, MAX_CHANNELS, 2) sensor delays: whole physics steps, fraction of a step [1].
        lag_ratios: (v, MAX_CHANNELS) physics step divided by the sensor time constant [1]; 0 without lag.
        command_delays: (v, MAX_AXES, 2) command delays: whole physics steps, fraction of a step [1].
    """

    plant: Plant
    machines: tuple[Machine, ...]
    surroundings: tuple[tuple[SurroundingObject, ...], ...]
    states: np.ndarray
    start_tips: np.ndarray
    fields: dict[str, np.ndarray]
    sensor_scales: np.ndarray
    sensor_offsets: np.ndarray
    sensor_delays: np.ndarray
    lag_ratios: np.ndarray
    command_delays: np.ndarray


def make_variants(task: Task, options: Options, nominal: Machine) -> Variants:
    """Draw the random machines and starts of all variants and compile their models.

    Variants with equal task and options are cached; the last eight sets are kept.

    Args:
        task: the task.
        options: the user's options, whose effects are applied.
        nominal: the machine before any effect is applied.

    Returns:
        The variants.

    Raises:
        InputError: an effect is not valid for the machine, a randomised effect changes the
            structure of the model, or a posterior is missing, damaged or of another machine.
    """
    ranges, folder = split_randomise(options)
    written = folder and [file.stat().st_mtime_ns for file in sorted(folder.glob("posterior*")) if file.is_file()]
    key = repr((task.name, id(task), nominal, options.effects, ranges, folder and resolve_path(folder), written,
                options.variants, options.variant_seed, options.timestep, options.phase, options.start))  # fmt: skip
    if key not in _CACHE:
        made = _build_variants(task, options, nominal, ranges, _choose_machine(options, folder, nominal))
        _CACHE[key] = made, task  # the task is kept, so that no other one gets its id
        while len(_CACHE) > _MAX_CACHED_SETS:
            _CACHE.pop(next(iter(_CACHE)))
    return _CACHE[key][0]


def split_randomise(options: Options) -> tuple[tuple[Mapping[str, Any], ...], Path | None]:
    """Return the effects with ranges of `Options.randomise`, and its result folder of `hydrotele gap` or None.

    Raises:
        InputError: there are several folders.
    """
    given = options.randomise
    entries = (given,) if isinstance(given, str | Path) else given
    folders = [Path(entry) for entry in entries if isinstance(entry, str | Path)]
    if len(folders) > 1:
        raise InputError("randomise", "takes one result folder of `hydrotele gap`, not several")
    return tuple(entry for entry in entries if not isinstance(entry, str | Path)), folders[0] if folders else None


def _choose_machine(options: Options, folder: Path | None, nominal: Machine) -> Callable[[int], Machine]:
    """Return a function that returns the machine of variant k: the nominal one, or a sample of a posterior.

    Raises InputError if the posterior in the folder is not of the task's machine and tool.
    """
    if folder is None:
        return lambda number: nominal
    from hydrotele.gap.posterior import machine_of_sample, read_posterior  # slow: it imports scipy.signal

    posterior = read_posterior(folder)
    own = posterior.machine
    if (own.name, own.tool, set(own.axes)) != (nominal.name, nominal.tool, set(nominal.axes)):
        message = f"is the result for {own.name} with the tool {own.tool}; the task needs {nominal.name} with"
        raise InputError(f"randomise {folder}", f"{message} {nominal.tool} and the same axes")
    order = np.random.default_rng(options.variant_seed).permutation(len(posterior.samples))
    return lambda number: machine_of_sample(posterior, order[number % len(order)])


def _build_variants(
    task: Task, options: Options, nominal: Machine, ranges: Sequence[Mapping[str, Any]],
    choose_machine: Callable[[int], Machine],
) -> Variants:  # fmt: skip
    machines, plants, states, tips = [], [], [], []
    for number in range(options.variants):
        rng = np.random.default_rng([options.variant_seed, number])
        joints = {**task.start(nominal, rng), **(options.start or {})}
        things = task.surroundings(nominal, rng, joints)
        machine = _apply_effects(choose_machine(number), options.effects, ranges, rng)
        known = (p for m, p in zip(machines, plants, strict=True)
                 if m == machine and p.surroundings == things)  # fmt: skip
        plant = next(known, None)
        if plant is None:
            plant = build_plant(machine, options.timestep, task.ground, things)
        machines.append(machine)
        plants.append(plant)
        data = rest_state(plant, _rename_axes_to_joints(machine, joints))
        start_leapfrog(plant.model, data)
        state = np.zeros(mujoco.mj_stateSize(plant.model, STATE_KIND))
        mujoco.mj_getState(plant.model, data, state, STATE_KIND)
        states.append(state)
        tips.append(data.site(TIP_SITE).xpos.copy() if nominal.arm else np.zeros(3))
    return Variants(
        plants[0], tuple(machines), tuple(plant.surroundings for plant in plants),
        np.array(states), np.array(tips), _find_differing_fields(plants, task.written_fields),
        *_make_sensor_error_tables(plants[0], machines), _make_command_delay_table(plants[0], machines),
    )  # fmt: skip


def _rename_axes_to_joints(machine: Machine, places: Mapping[str, float]) -> dict[str, float]:
    """Return positions (name -> value) with the names of axes replaced by the names of their joints."""
    return {machine.axes[n].joint if n in machine.axes else n: v for n, v in places.items()}


def _apply_effects(
    machine: Machine, effects: Sequence[Mapping[str, Any]], ranges: Sequence[Mapping[str, Any]],
    rng: np.random.Generator,
) -> Machine:  # fmt: skip
    """Return the machine with effects added; those with ranges get parameters drawn uniformly from them."""
    for effect in effects:
        machine = apply_effect(machine, *_parse_effect(effect), dict(effect.get("parameters", {})))
    for effect in ranges:
        drawn = {
            key: float(rng.uniform(*_parse_range(effect, key, value)))
            for key, value in effect.get("parameters", {}).items()
        }
        machine = apply_effect(machine, *_parse_effect(effect), drawn)
    return machine


def _parse_effect(effect: Mapping[str, Any]) -> tuple[str, str]:
    """Check the keys of an effect entry and return the effect's name and location."""
    keys = ("name", "location", "parameters")
    if not isinstance(effect, Mapping) or "name" not in effect or set(effect) - set(keys):
        raise InputError("effects", f"each needs {', '.join(keys)}, not {effect!r}")
    return str(effect["name"]), str(effect.get("location", ""))


def _parse_range(effect: Mapping[str, Any], key: str, value: Any) -> tuple[float, float]:
    """Return the range of a randomised parameter, or raise InputError if it is not valid."""
    where = f"randomise {effect.get('name')}: {key}"
    try:
        low, high = (float(end) for end in value)
    except (TypeError, ValueError):
        raise InputError(where, f"needs a range [low, high], not {value!r}") from None
    if not (np.isfinite([low, high]).all() and low <= high):
        raise InputError(where, f"needs a finite range with low <= high, not {value!r}")
    return low, high


def _find_differing_fields(plants: list[Plant], also: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Return name -> values (v, size) of the model fields that differ between v plants or are named in `also`.

    A difference in the structure of the model raises InputError.
    """
    first, fields = plants[0].model, {}
    distinct = list({id(plant): plant for plant in plants}.values())
    for name in sorted(MODEL_FIELDS):
        values = [np.asarray(_get_model_field(plant.model, name)) for plant in distinct]
        if any(value.shape != values[0].shape for value in values):
            raise _make_structure_error(name)
        if name not in also and all(np.array_equal(value, values[0]) for value in values):
            continue
        if values[0].dtype != np.float64:
            raise _make_structure_error(name)
        fields[name] = np.array([np.asarray(_get_model_field(p.model, name)).ravel() for p in plants])
    for size in ("nv", "na"):
        if any(getattr(plant.model, size) != getattr(first, size) for plant in distinct):
            raise _make_structure_error(size)
    return fields


def _make_structure_error(name: str) -> InputError:
    known = ", ".join(sorted(EFFECTS))
    message = (
        f"the variants differ in the structure of the model ({name}), not only in parameters: add"
        f" the effect to all of them with `effects`; available effects: {known}"
    )
    return InputError("randomise", message)


def _get_model_field(model: mujoco.MjModel, name: str):
    return getattr(model.opt, name[4:]) if name.startswith("opt.") else getattr(model, name)


def sensor_channels(plant: Plant) -> tuple[str, ...]:
    """Return the names of the sensor channels in the order of native code: positions, pressures, supply pressure."""
    return tuple(c for c in sensed_channels(plant) if not c.startswith("length."))


def _make_sensor_error_tables(plant: Plant, machines: list[Machine]):
    """Return scales, offsets, delays and lag ratios of all sensors of all variants, as in `Variants`.

    Raises:
        InputError: a sensor has a drift, which environments do not simulate.
    """
    shape, names = (len(machines), MAX_CHANNELS), sensor_channels(plant)
    scales, offsets, ratios = np.ones(shape), np.zeros(shape), np.zeros(shape)
    lags, c = np.zeros((*shape, 2)), len(names)
    for v, machine in enumerate(machines):
        defects = [machine.sensor_errors.get(name, SensorError()) for name in names]
        for name, defect in zip(names, defects, strict=True):
            if defect.drift:
                said = "has a drift, which environments do not simulate; give it an offset instead"
                raise InputError(f"sensor {name}", said)
        scales[v, :c] = [defect.scale for defect in defects]
        offsets[v, :c] = [defect.offset for defect in defects]
        lags[v, :c], ratios[v, :c] = sensor_delays(machine, names, plant.model.opt.timestep)
    return scales, offsets, lags, ratios


def _make_command_delay_table(plant: Plant, machines: list[Machine]) -> np.ndarray:
    delays = np.zeros((len(machines), MAX_AXES, 2))
    for v, machine in enumerate(machines):
        delays[v, : len(plant.axes)] = command_delays(machine, plant.axes, plant.model.opt.timestep)
    return delays


_DEADBAND_FACTORS = (0.5, 2.0)  # factors of the nominal overlap
_FLOW_FACTORS = (0.8, 1.2)  # factors: rating tolerance of 5 to 10 %, plus wear and temperature
_BANDWIDTH_FACTORS = (0.6, 1.4)  # factors of the nominal bandwidth
_FRICTION_FACTORS = (0.5, 2.0)  # factors of the nominal Coulomb friction
_BULK_MODULUS_FACTORS = (0.6, 1.2)  # factors of the nominal bulk modulus: air in the oil
_DELAY_RANGE = (0.0, 0.05)  # s, of a fieldbus and its valve amplifiers
_PAYLOAD_FACTORS = (0.0, 0.02)  # factors of the mass of all links, at the tip


def typical_variation(machine: Machine) -> tuple[dict[str, Any], ...]:
    """Return effects with typical parameter ranges for `Options.randomise`.

    Args:
        machine: the machine without effects; the ranges are relative to its parameters.

    Returns:
        For every valve, the overlap (0.5 to 2 times its value), flow (0.8 to 1.2) and bandwidth (0.6
        to 1.4); for every drive with a valve, the Coulomb friction (0.5 to 2); for the machine, the
        bulk modulus (0.6 to 1.2), the command delay (0 to 50 ms) and a payload at the tool
        (0 to 2 % of the mass of all links).
    """
    found = []
    for name, axis in machine.axes.items():
        if axis.valve is None:
            continue
        found += [
            _make_effect("valve_deadband", name, deadband=_scale_range(axis.valve.deadband, _DEADBAND_FACTORS)),
            _make_effect("valve_gain", name, ratio=list(_FLOW_FACTORS)),
            _make_effect("spool_lag", name, bandwidth=_scale_range(axis.valve.bandwidth, _BANDWIDTH_FACTORS)),
            _make_effect(
                "coulomb_friction", name,
                coulomb=_scale_range(axis.hydraulic_drive.friction.coulomb, _FRICTION_FACTORS),
            ),
        ]  # fmt: skip
    if machine.supply:
        bulk = _scale_range(machine.supply.bulk_modulus, _BULK_MODULUS_FACTORS)
        found.append(_make_effect("bulk_modulus", "all", bulk_modulus=bulk))
    weight = sum(link.mass for link in machine.links.values())
    found.append(_make_effect("command_delay", "all", delay=list(_DELAY_RANGE)))
    return (*found, _make_effect("payload", "tool", mass=_scale_range(weight, _PAYLOAD_FACTORS)))


def _make_effect(name: str, location: str, **ranges: list[float]) -> dict[str, Any]:
    return {"name": name, "location": location, "parameters": ranges}


def _scale_range(nominal: float, factors: tuple[float, float]) -> list[float]:
    return [factor * nominal for factor in factors]
