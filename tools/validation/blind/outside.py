"""List the effects of trials that the library does not have, with location and size.

The workflow knows nothing of them. How they act stands in `outside_steps` (they change the plant
while it runs) and in `outside_readings` (they change what a sensor says).
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from hydrotele.machine.machine import Machine
from tools.validation.blind import outside_readings, outside_steps

Draw = Callable[[Machine, np.random.Generator], tuple[str, dict[str, float]]]


@dataclasses.dataclass(frozen=True)
class OutsideEffect:
    """An effect that no library knows.

    Attributes:
        name: what the key calls it.
        sentence: what it is.
        law: the law of the model that it breaks.
        draw: (machine, rng) -> (location, parameters).
        step: None, or (model, actuator, machine, location, parameters) -> what to do before every
            physics step.
        read: None, or (time (n,), channel -> (n,), location, parameters) -> the channels that read
            otherwise.
    """

    name: str
    sentence: str
    law: str
    draw: Draw
    step: Callable[..., Callable[[Any], None]] | None = None
    read: Callable[..., dict[str, np.ndarray]] | None = None


def _at(places: tuple[str, ...] | None, **ranges: tuple[float, float]) -> Draw:
    """Draws uniformly from the places (None: any hydraulic axis) and log-uniformly from ranges."""

    def draw(machine: Machine, rng: np.random.Generator) -> tuple[str, dict[str, float]]:
        location = str(rng.choice(places or tuple(machine.hydraulic_axes)))
        return location, {name: float(np.exp(rng.uniform(*np.log(ends)))) for name, ends in ranges.items()}

    return draw


def _bore(machine: Machine, rng: np.random.Generator) -> tuple[str, dict[str, float]]:
    location, values = _at(("boom", "stick"), force=(3e3, 1.5e4), width=(0.03, 0.12))(machine, rng)
    middle = {"boom": (0.55, 0.90), "stick": (0.50, 1.00)}[location]  # where a bore wears most
    return location, {**values, "centre": float(rng.uniform(*middle))}


def _pressure(**ranges: tuple[float, float]) -> Draw:
    def draw(machine: Machine, rng: np.random.Generator) -> tuple[str, dict[str, float]]:
        axis, side = rng.choice(list(machine.hydraulic_axes)), rng.choice(["head", "rod"])
        size = {k: float(np.exp(rng.uniform(*np.log(v)))) for k, v in ranges.items()}
        first = next(iter(size))
        size[first] *= float(rng.choice([-1.0, 1.0]))
        return f"{axis}.{side}", size

    return draw


OUTSIDE: dict[str, OutsideEffect] = {
    effect.name: effect
    for effect in (
        OutsideEffect(
            "bore_friction", "a scored zone of the bore: friction that depends on the position",
            "force", _bore, outside_steps.bore_friction,
        ),
        OutsideEffect(
            "sticking_spool", "a spool that stays put until the command is off by a threshold",
            "valve", _at(None, threshold=(0.015, 0.08)), outside_steps.sticking_spool,
        ),
        OutsideEffect(
            "meter_out", "a spool whose return notches are smaller than its feed notches",
            "valve", _at(None, ratio=(0.4, 0.85)), outside_steps.meter_out,
        ),
        OutsideEffect(
            "pump_sag", "an engine that sags: pump flow that falls and recovers periodically",
            "supply", _at(("supply",), depth=(0.1, 0.4), frequency=(0.2, 1.5)),
            outside_steps.pump_sag,
        ),
        OutsideEffect(
            "power_limit", "a torque-limited pump: the more pressure, the less flow",
            "supply", _at(("supply",), power=(4e4, 1.1e5)), outside_steps.power_limit,
        ),
        OutsideEffect(
            "warming_oil", "oil that warms up: leakage grows and viscous friction falls over a run",
            "flow", _at(("all",), leakage=(3.0, 15.0), thinning=(0.3, 0.8)),
            outside_steps.warming_oil,
        ),
        OutsideEffect(
            "blowby", "a seal or a cross-port valve that leaks only beyond a pressure difference",
            "flow", _at(None, beyond=(3e6, 8e6), gain=(1e-11, 1e-10)), outside_steps.blowby,
        ),
        OutsideEffect(
            "back_pressure", "a clogged tank line: return pressure that grows with flow squared",
            "flow", _at(("supply",), drop=(1e6, 4e6)), outside_steps.back_pressure,
        ),
        OutsideEffect(
            "gear_ripple", "a worn slew gear: torque that ripples with the teeth",
            "force", _at(("swing",), torque=(1.5e3, 8e3), teeth=(20.0, 90.0)),
            outside_steps.gear_ripple,
        ),
        OutsideEffect(
            "pressure_drift", "a pressure transducer whose zero drifts as it warms up",
            "sensor", _pressure(drift=(1.5e5, 1.2e6), time=(15.0, 60.0)),
            read=outside_readings.pressure_drift,
        ),
        OutsideEffect(
            "bent_transducer", "a pressure transducer with a bent characteristic",
            "sensor", _pressure(bow=(1e5, 8e5)), read=outside_readings.bent_transducer,
        ),
    )
}  # fmt: skip
"""Effects outside the library by name."""
