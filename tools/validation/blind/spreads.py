"""Draw effect sizes as they occur in the field, each with the source of its spread.

The search's own `least` and `scale` play no part. Sources by letter:

K  Khoshzaban 1992, through `models/cat215/machine.yaml` and its README: two printed closed lengths
   of the boom cylinder differ by 24 mm; resolver +-0.1 deg, length +-2 mm, pressure +-25 psi
   (172 kPa); backlash in the slew gear train (no size).
V  the record of a Volvo EC20 in `docs/validation/real_machines.md`, from which dead bands of 14 and
   16 % of the command and a command delay of 0.12 s were estimated.
E  EMPS (Janot et al. 2019), the same page: friction asymmetry 0.14 (dry), -0.18 (viscous).
B  Bonchis, Ha, Corke and Rye, Model-based friction compensation in hydraulic servo systems for
   mining technology, introduction: friction takes 10 to 15 % and up to 30 % of the force.
Z  Zhang, Hydraulic fluids (Basics of Hydraulic Systems, chapter 10, abstract): oil gives 0.3 % at
   1 MPa and 1.3 % at 25 MPa, that is 0.3 to 1.9 GPa, and far more with air in it.
A  assumption of this project: nothing published was at hand.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from hydrotele.effects import EFFECTS
from hydrotele.machine.machine import Machine

Rng = np.random.Generator
Values = dict[str, float]


def log_uniform(rng: Rng, low: float, high: float) -> float:
    """A number between two positive ones, all factors alike."""
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def either(rng: Rng, low: float, high: float) -> float:
    """The same with a random sign."""
    return float(rng.choice([-1.0, 1.0])) * log_uniform(rng, low, high)


def _force(machine: Machine, place: str) -> float:
    """Force at relief pressure over the piston [N] or [N m]."""
    assert machine.supply
    return machine.supply.relief_pressure * machine.axes[place].hydraulic_drive.effective_areas[0]


def _rub(machine: Machine, place: str):
    return machine.axes[place].hydraulic_drive.friction


def _oil(machine: Machine, place: str) -> float:
    """Compliance of half a full chamber [m^3/Pa]."""
    drive, cylinder = machine.axes[place].hydraulic_drive, machine.axes[place].cylinder
    stroke = cylinder.stroke if cylinder else 0.0
    assert machine.supply
    return (drive.dead_volume + 0.5 * drive.effective_areas[0] * stroke) / machine.supply.bulk_modulus


def _deadband(machine: Machine, place: str, rng: Rng) -> Values:
    """V: 14 and 16 %; from a servovalve's to those, at least 1 % from the model's."""
    valve = machine.axes[place].valve
    assert valve
    while True:
        value = float(rng.uniform(0.0, 0.17))
        if abs(value - valve.deadband) > 0.01:
            return {"deadband": value}


def _bandwidth(machine: Machine, place: str, rng: Rng) -> Values:
    valve = machine.axes[place].valve
    assert valve
    return {"bandwidth": valve.bandwidth * log_uniform(rng, 0.35, 0.85)}  # A: slower, cold oil


def _pump(machine: Machine, place: str, rng: Rng) -> Values:
    assert machine.supply
    return {"pump_flow": machine.supply.pump_flow * rng.uniform(0.70, 0.95)}  # A: wear and engine


def _relief(machine: Machine, place: str, rng: Rng) -> Values:
    assert machine.supply
    return {"relief_pressure": machine.supply.relief_pressure * rng.uniform(0.80, 0.97)}  # A


def _bulk(machine: Machine, place: str, rng: Rng) -> Values:
    """Z: 0.3 to 1.9 GPa, at least 8 % from the model's."""
    assert machine.supply
    while True:
        value = log_uniform(rng, 0.3e9, 1.9e9)
        if abs(math.log(value / machine.supply.bulk_modulus)) > 0.08:
            return {"bulk_modulus": value}


def _asymmetry(machine: Machine, place: str, rng: Rng) -> Values:
    names = EFFECTS["friction_asymmetry"].parameters(machine, place)
    return {name: either(rng, 0.07, 0.36) for name in names}  # E: half to twice 0.14 .. 0.18


def _pair(effect: str, low: float, high: float):
    """Both coordinates of a place, each of a random sign."""

    def draw(machine: Machine, place: str, rng: Rng) -> Values:
        names = EFFECTS[effect].parameters(machine, place)
        return {name: either(rng, low, high) for name in names}

    return draw


def _one(name: str, value: Callable[[Machine, str, Rng], float]):
    return lambda machine, place, rng: {name: value(machine, place, rng)}


SIZES: dict[str, Callable[[Machine, str, Rng], Values]] = {
    "valve_deadband": _deadband,
    "valve_gain": _one("ratio", lambda m, at, r: math.exp(either(r, 0.05, 0.3))),  # A: notches
    "spool_lag": _bandwidth,
    "pump_flow_limit": _pump,
    "relief_pressure": _relief,
    "internal_leakage": _one(  # A: worn seals, 3 to 20 times a good one's
        "leakage", lambda m, at, r: m.axes[at].hydraulic_drive.leakage * log_uniform(r, 3, 20)
    ),
    "hose_compliance": _one(  # Z: what halves the modulus is as soft as the oil itself
        "compliance", lambda m, at, r: _oil(m, at) * log_uniform(r, 0.15, 1.5)
    ),
    "bulk_modulus": _bulk,
    "coulomb_friction": _one(  # B, of a machine that works at a tenth to a third of its force
        "coulomb", lambda m, at, r: _rub(m, at).coulomb + _force(m, at) * log_uniform(r, 0.005, 0.1)
    ),
    "viscous_friction": _one(
        "viscous", lambda m, at, r: _rub(m, at).viscous * log_uniform(r, 2.0, 12.0)  # A: cold oil
    ),
    "stribeck_friction": _one(  # A: a seal breaks away at one to three times its sliding friction
        "stribeck_extra", lambda m, at, r: _rub(m, at).coulomb * log_uniform(r, 1.0, 3.0)
    ),
    "friction_asymmetry": _asymmetry,
    "command_delay": _one("delay", lambda m, at, r: log_uniform(r, 0.01, 0.15)),  # V: 0.12 s
    "link_length": _one("length", lambda m, at, r: either(r, 0.005, 0.03)),  # K: 24 mm
    "pin_offset": _pair("pin_offset", 0.003, 0.024),  # K: 24 mm
    "com_offset": lambda m, at, r: {  # A: half a metre of a counterweight, 5 % of a boom
        k: either(r, 0.3, 0.8) if at == "swing" else either(r, 0.04, 0.25)
        for k in EFFECTS["com_offset"].parameters(m, at)
    },
    "inertia_error": _one("ratio", lambda m, at, r: math.exp(either(r, 0.2, 0.9))),  # A
    "payload": _one("mass", lambda m, at, r: log_uniform(r, 60.0, 1200.0)),  # A: a CAT 215's loads
    "base_tilt": _pair("base_tilt", 0.01, 0.09),  # A: half a degree to five
    "backlash": _one("gap", lambda m, at, r: log_uniform(r, 0.002, 0.02)),  # A, existence K
    "joint_flexibility": _one("compliance", lambda m, at, r: log_uniform(r, 4e-8, 4e-7)),  # A
    "angle_offset": _one("offset", lambda m, at, r: either(r, 0.0035, 0.035)),  # A: 0.2 .. 2 deg
    "angle_scale": _one("ratio", lambda m, at, r: 1.0 + either(r, 0.005, 0.03)),  # A
    "angle_delay": _one("delay", lambda m, at, r: log_uniform(r, 0.005, 0.06)),  # A: filter, bus
    "length_offset": _one("offset", lambda m, at, r: either(r, 0.002, 0.024)),  # K
    "pressure_offset": _one("offset", lambda m, at, r: either(r, 6e4, 5e5)),  # K: 1/3 to 3 x 25 psi
    "pressure_delay": _one("delay", lambda m, at, r: log_uniform(r, 0.005, 0.06)),  # A
}  # fmt: skip
"""Effect of the library -> (machine, place, rng) -> its parameters; sources by letter above."""

_RIGID_CYLINDERS = ("joint_flexibility",)  # the independent machine has none in a cylinder


def draw_library_effect(machine: Machine, rng: Rng, but: tuple[str, ...] = ()) -> tuple:
    """An effect of the library in a size of the field.

    Args:
        machine: the machine without it.
        rng: source of the choice.
        but: names that are not drawn.

    Returns:
        (name, place, parameters).
    """
    places = {}
    for name in SIZES:
        found = EFFECTS[name].locations(machine)
        if name in _RIGID_CYLINDERS:
            found = tuple(p for p in found if not machine.axes[p].cylinder)
        if found and name not in but:
            places[name] = found
    name = str(rng.choice(sorted(places)))
    place = str(rng.choice(places[name]))
    values = SIZES[name](machine, place, rng)
    known = EFFECTS[name].parameters(machine, place)
    return name, place, {
        k: float(np.clip(v, known[k].lower_bound, known[k].upper_bound)) for k, v in values.items()
    }  # fmt: skip


# Bound of the error of every number, as a share, by the last part of its path; A throughout, but
# K for lengths (24 mm of a cylinder of 1.4 m is 1.7 %; a tenth of it is built so).
OFF = {
    "mass": 0.10, "inertia": 0.10, "com": 0.05, "position": 0.002, "closed_length": 0.001,
    "area_head": 0.02, "area_rod": 0.02, "displacement": 0.02, "dead_volume": 0.10, "leakage": 0.10,
    "coulomb": 0.10, "stribeck_extra": 0.10, "viscous": 0.10, "rated_flow": 0.05, "deadband": 0.10,
    "bandwidth": 0.10, "damping": 0.05, "bulk_modulus": 0.10, "pump_flow": 0.05,
    "relief_pressure": 0.03, "tank_pressure": 0.10,
}  # fmt: skip
_LEAST_OFF = 0.1  # of the bound: every number is wrong


def _idle(path: str, letter: str) -> bool:
    """Whether nothing depends on a coordinate: height of the machine, pins across their plane."""
    return path == "links.swing.position" or ("_pin" in path and letter == "y")


def off_everywhere(machine: Machine, rng: Rng) -> tuple[Machine, dict[str, tuple[float, float]]]:
    """A machine whose every uncertain number differs from the model's.

    Args:
        machine: the model.
        rng: source of the errors.

    Returns:
        (the machine, path of each number -> (the model's, the true one)).
    """
    numbers: dict[str, tuple[float, float]] = {}

    def wrong(path: str, key: str, value: float) -> float:
        if value == 0.0:
            return 0.0
        factor = 1.0 + float(rng.choice([-1, 1])) * OFF[key] * rng.uniform(_LEAST_OFF, 1.0)
        numbers[path] = (value, value * factor)
        return value * factor

    def walk(node: Any, path: str) -> Any:
        if isinstance(node, dict):
            return {key: walk(item, f"{path}.{key}".lstrip(".")) for key, item in node.items()}
        if not hasattr(node, "model_copy"):
            return node
        update = {}
        for key in type(node).model_fields:
            item, here = getattr(node, key), f"{path}.{key}".lstrip(".")
            if key == "inertia":  # one factor, so that the body stays possible
                ratio = wrong(here, key, 1.0)
                update[key] = tuple(part * ratio for part in item)
            elif key in OFF and isinstance(item, tuple):
                update[key] = tuple(
                    v if _idle(here, k) else wrong(f"{here}.{k}", key, v) for k, v in zip("xyz", item, strict=True)
                )
            elif key in OFF and isinstance(item, float | int):
                update[key] = wrong(here, key, float(item))
            elif key in ("links", "axes", "supply", "cylinder", "motor", "valve", "friction",
                         "tube", "rod", "base_pin", "rod_pin"):  # fmt: skip
                update[key] = walk(item, here)
        return node.model_copy(update=update)

    return walk(machine, ""), numbers
