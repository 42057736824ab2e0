"""The machine with its identified numbers: a Machine like any other, which runs and replays.

`identify.json`: an identification as scripts read it.
"""

from typing import Any

import numpy as np

from hydrotele.effects.effect import changed
from hydrotele.identify.consistent import Consistent, Freedom, consistent
from hydrotele.identify.hydraulic import Hydraulics
from hydrotele.identify.result import WEAK, Identification, counts, parameter_rows
from hydrotele.machine.machine import Machine
from hydrotele.machine.sensors import SensorError

_SURE = 2.0  # standard deviations by which an offset must differ to be written
_FRICTION = {"coulomb": "coulomb", "stribeck": "stribeck_extra", "viscous": "viscous"}


def identified_machine(
    machine: Machine, found: Identification, bars: dict[str, tuple[str, str]]
) -> tuple[Machine, Consistent]:
    """Machine with the identified bodies, friction and offsets.

    A Machine's links have their principal axes along their frames, and bars their mass on their
    axis; of all such machines it is the one that explains the data best.

    Args:
        machine: the given machine.
        found: its identification.
        bars: body of a tube or rod -> (axis, `tube` or `rod`).

    Returns:
        The machine, and how well it agrees with the estimate.
    """
    freedom = {}
    for name in found.names:
        kind, _, body = name.partition(".")
        if kind == "mass":
            freedom[body] = Freedom(
                shear=False, axis=_bar_axis(found, body) if body in bars else None
            )
    best = consistent(found, freedom)
    numbers = dict(zip(found.names, best.value, strict=True))
    for body in freedom:
        machine = _with_body(machine, body, numbers, bars.get(body))
    for axis, facts in machine.axes.items():
        place = _drive_joint(found, facts.joint, axis)
        if place is None:
            continue
        drive = (
            f"axes.{axis}.{'cylinder' if facts.cylinder else 'motor' if facts.motor else 'force'}"
        )
        machine = _with_friction(machine, f"{drive}.friction", place, numbers)
        machine = _with_offset(machine, axis, place, found, numbers)
    return machine, best


def _bar_axis(found: Identification, body: str) -> np.ndarray:
    """Line on which a bar's centre of mass lies, in its frame."""
    places = [found.names.index(f"moment_{c}.{body}") for c in "xyz"]
    moment = found.nominal[places]
    size = np.linalg.norm(moment)
    return moment / size if size else np.array([1.0, 0.0, 0.0])


def _drive_joint(found: Identification, joint: str, axis: str) -> str | None:
    """Place of an axis' friction in the names: its joint, or its cylinder's rod."""
    for place in (f"{axis}_rod", joint):
        if f"coulomb.{place}" in found.names:
            return place
    return None


def _with_body(machine: Machine, body: str, numbers: dict, bar: tuple[str, str] | None) -> Machine:
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
        machine = changed(machine, f"{path}.{field}", value)
    return machine


def _with_friction(machine: Machine, path: str, place: str, numbers: dict) -> Machine:
    for kind, field in _FRICTION.items():
        if f"{kind}.{place}" in numbers:
            machine = changed(
                machine, f"{path}.{field}", float(max(numbers[f"{kind}.{place}"], 0.0))
            )
    for kind, whole in (("coulomb", "coulomb"), ("viscous", "viscous")):
        key = f"{kind}_asymmetry.{place}"
        size = numbers.get(f"{whole}.{place}", 0.0)
        if key in numbers and size > 0.0:
            part = float(np.clip(numbers[key] / size, -0.99, 0.99))
            machine = changed(machine, f"{path}.{kind}_asymmetry", part)
    return machine


def _with_offset(
    machine: Machine, axis: str, place: str, found: Identification, numbers: dict
) -> Machine:
    name = f"offset.{place}"
    if name not in numbers:
        return machine
    k = found.names.index(name)
    spread = {int(b): s for b, s in zip(found.told.base, found.estimate.std, strict=True)}
    if k not in spread or abs(numbers[name] - found.nominal[k]) < _SURE * spread[k]:
        return machine
    facts = machine.axes[axis]
    if facts.force:
        return changed(machine, f"axes.{axis}.force.offset", float(numbers[name]))
    channel = f"pressure_head.{axis}"
    known = machine.sensor_errors.get(channel, SensorError())
    more = numbers[name] / facts.hydraulic_drive.areas[0] * known.scale
    error = known.model_copy(update={"offset": float(known.offset + more)})
    return machine.model_copy(update={"sensor_errors": {**machine.sensor_errors, channel: error}})


def identify_document(
    found: Identification | None, hydraulics: Hydraulics | None = None,
    best: Consistent | None = None,
) -> dict[str, Any]:  # fmt: skip
    """The document; what is unknown is None or NaN.

    Args:
        found: identification of the mechanism, None where no force is known.
        hydraulics: identification of the hydraulics, None where not asked for.
        best: the nearest machine that can exist.

    Returns:
        Keys `parameters`, `condition`, `heldout`, `counts`, `status`, `seconds`, `band_hz`,
        `whiteness`, `given`, `consistent`, `notes`; `hydraulics` where asked for.
    """
    distance, limit = found.distance(found.nominal) if found else (None, None)
    rows = parameter_rows(found) if found else []
    document: dict[str, Any] = {
        "parameters": [
            {
                "name": row.name, "value": row.value, "std": row.std,
                "ci95": None if row.ci95 is None else list(row.ci95), "status": row.status,
                "unit": row.unit, "nominal": row.nominal, "combination": row.combination,
                "bias": row.bias,
            }
            for row in rows
        ],
        "condition": found.estimate.condition if found else None,
        "heldout": {
            drive: {
                "rms": h.rms, "unit": h.unit, "noise_rms": h.noise_rms, "relative": h.relative,
                "nominal_rms": h.nominal_rms,
            }
            for drive, h in (found.heldout.items() if found else ())
        },
        "counts": counts(rows),
        "status": found.status if found else "no force is known",
        "seconds": found.seconds if found else 0.0,
        "band_hz": found.band if found else None,
        "whiteness": found.whiteness if found else {},
        "given": {"distance": distance, "limit95": limit},
        "consistent": {
            "distance": best.loss, "limit95": limit,
            "parameters": dict(zip(found.names, best.value.tolist(), strict=True)),
        } if found and best else None,
        "notes": list(found.notes) if found else [],
    }  # fmt: skip
    if hydraulics:
        document["parameters"] += [
            {
                "name": n.name, "value": n.value if n.told else None,
                "std": n.std if n.told else None, "ci95": list(n.ci95) if n.told else None,
                "status": "full" if n.told else WEAK, "unit": n.unit, "nominal": n.nominal,
                "combination": "", "bias": None, "parameter": n.parameter,
            }
            for n in hydraulics.numbers
        ]  # fmt: skip
        document["hydraulics"] = {
            "before": hydraulics.before, "after": hydraulics.after, "status": hydraulics.status,
            "seconds": hydraulics.seconds,
        }  # fmt: skip
        document["seconds"] += hydraulics.seconds
    return document
