"""Machine with the identified masses, inertias, friction and force offsets."""

import numpy as np

from hydrotele.effects.effect import with_value
from hydrotele.identify.consistent_parameters import (
    AllowedDeformation,
    ConsistentParameters,
    find_consistent_parameters,
)
from hydrotele.identify.result import Identification
from hydrotele.machine.machine import Machine
from hydrotele.machine.sensors import SensorError

_MIN_OFFSET_CHANGE_STD = 2.0  # standard deviations: smallest change of an offset that is written
_FRICTION_FIELDS = {"coulomb": "coulomb", "stribeck": "stribeck_extra", "viscous": "viscous"}


def build_identified_machine(
    machine: Machine, found: Identification, bars: dict[str, tuple[str, str]]
) -> tuple[Machine, ConsistentParameters]:
    """Return a machine with identified masses, inertias, friction and force offsets.

    Links of a `Machine` have principal axes parallel to their frames, and tubes and rods have their
    centre of mass on their axis. The result is the machine of this form with the best fit. A force
    offset is written only if it changes by at least two standard deviations. For a hydraulic axis it is
    written as a sensor error of the head pressure.

    Args:
        machine: the given machine.
        found: its identification.
        bars: body of a tube or rod -> (axis, `tube` or `rod`).

    Returns:
        The machine, and its consistent parameters with their distance from the estimate.
    """
    freedom = {}
    for name in found.names:
        kind, _, body = name.partition(".")
        if kind == "mass":
            freedom[body] = AllowedDeformation(
                can_rotate_axes=False,
                shift_direction=_bar_axis(found, body) if body in bars else None,
            )
    best = find_consistent_parameters(found, freedom)
    numbers = dict(zip(found.names, best.value, strict=True))
    for body in freedom:
        machine = _replace_body_inertia(machine, body, numbers, bars.get(body))
    for axis, facts in machine.axes.items():
        place = _friction_joint(found, facts.joint, axis)
        if place is None:
            continue
        drive = f"axes.{axis}.{'cylinder' if facts.cylinder else 'motor' if facts.motor else 'force'}"
        machine = _replace_friction(machine, f"{drive}.friction", place, numbers)
        machine = _replace_force_offset(machine, axis, place, found, numbers)
    return machine, best


def _bar_axis(found: Identification, body: str) -> np.ndarray:
    """Return the direction of a tube's or rod's given centre of mass in its frame, a unit vector (3,).

    It is the x axis if the first moment is 0.
    """
    places = [found.names.index(f"moment_{c}.{body}") for c in "xyz"]
    moment = found.nominal[places]
    size = np.linalg.norm(moment)
    return moment / size if size else np.array([1.0, 0.0, 0.0])


def _friction_joint(found: Identification, joint: str, axis: str) -> str | None:
    """Return the location in the parameter names of an axis' friction: `AXIS_rod` or its joint, or None."""
    for place in (f"{axis}_rod", joint):
        if f"coulomb.{place}" in found.names:
            return place
    return None


def _replace_body_inertia(machine: Machine, body: str, numbers: dict, bar: tuple[str, str] | None) -> Machine:
    mass = numbers[f"mass.{body}"]
    com = np.array([numbers[f"moment_{c}.{body}"] for c in "xyz"]) / mass
    about = [numbers[f"inertia_{c}{c}.{body}"] for c in "xyz"]
    inertia = tuple(float(i - mass * (com @ com - c**2)) for i, c in zip(about, com, strict=True))
    if bar:
        path = f"axes.{bar[0]}.cylinder.{bar[1]}"
        given = getattr(machine.axes[bar[0]].cylinder, bar[1])
        numbers_of = {"mass": float(mass), "com": float(np.sign(given.com) * np.linalg.norm(com)),
                      "inertia": inertia}  # fmt: skip
    elif body in machine.links:
        path = f"links.{body}"
        numbers_of = {
            "mass": float(mass), "com": tuple(float(c) for c in com), "inertia": inertia
        }  # fmt: skip
    else:
        return machine
    for field, value in numbers_of.items():
        machine = with_value(machine, f"{path}.{field}", value)
    return machine


def _replace_friction(machine: Machine, path: str, place: str, numbers: dict) -> Machine:
    for kind, field in _FRICTION_FIELDS.items():
        if f"{kind}.{place}" in numbers:
            machine = with_value(machine, f"{path}.{field}", float(max(numbers[f"{kind}.{place}"], 0.0)))
    for kind, whole in (("coulomb", "coulomb"), ("viscous", "viscous")):
        key = f"{kind}_asymmetry.{place}"
        size = numbers.get(f"{whole}.{place}", 0.0)
        if key in numbers and size > 0.0:
            part = float(np.clip(numbers[key] / size, -0.99, 0.99))
            machine = with_value(machine, f"{path}.{kind}_asymmetry", part)
    return machine


def _replace_force_offset(machine: Machine, axis: str, place: str, found: Identification, numbers: dict) -> Machine:
    name = f"offset.{place}"
    if name not in numbers:
        return machine
    k = found.names.index(name)
    spread = {int(b): s for b, s in zip(found.data_identifiability.base, found.estimate.std, strict=True)}
    if k not in spread or abs(numbers[name] - found.nominal[k]) < _MIN_OFFSET_CHANGE_STD * spread[k]:
        return machine
    facts = machine.axes[axis]
    if facts.force:
        return with_value(machine, f"axes.{axis}.force.offset", float(numbers[name]))
    channel = f"pressure_head.{axis}"
    known = machine.sensor_errors.get(channel, SensorError())
    more = numbers[name] / facts.hydraulic_drive.effective_areas[0] * known.scale
    error = known.model_copy(update={"offset": float(known.offset + more)})
    return machine.model_copy(update={"sensor_errors": {**machine.sensor_errors, channel: error}})
