"""Friction of a drive: dry, viscous, extra at rest, and unequal in the two directions."""

from hydrotele.effects._sizes import (
    axes,
    drive_kind,
    force_unit,
    largest_force,
    speed_unit,
    usual_speed,
)
from hydrotele.effects.effect import Effect, Parameter, Values, changed
from hydrotele.machine.machine import Machine


def _numbers(field: str, scale: float, high: float):
    """Sizes as fractions of the drive's largest force.

    Least is a thousandth of it (20 to 30 kPa over the piston, what a good transducer is off by) or
    a tenth of the present friction (what warm oil does within a shift).
    """

    def parameters(machine: Machine, location: str) -> dict[str, Parameter]:
        present = getattr(machine.axes[location].drive.friction, field)
        whole, unit = largest_force(machine, location), force_unit(machine, location)
        if field == "viscous":
            whole /= usual_speed(machine, location)
            unit = f"{unit}/({speed_unit(machine, location)})"
        least = max(0.001 * whole, 0.1 * present)
        size = max(scale * whole, 0.3 * present)
        return {field: Parameter(_UNITS.get(unit, unit), present, 0.0, present + high * whole,
                                 size, least)}  # fmt: skip

    return parameters


_UNITS = {"N/(m/s)": "N s/m", "N m/(rad/s)": "N m s/rad"}


def _set(machine: Machine, location: str, values: Values) -> Machine:
    for field, value in values.items():
        path = f"axes.{location}.{drive_kind(machine, location)}.friction.{field}"
        machine = changed(machine, path, value)
    return machine


def _rubbing(machine: Machine) -> tuple[str, ...]:
    """Axes that have friction to be unequal."""
    present = {name: machine.axes[name].drive.friction for name in machine.axes}
    return tuple(n for n, f in present.items() if f.coulomb + f.stribeck_extra + f.viscous > 0)


def _asymmetry(machine: Machine, location: str) -> dict[str, Parameter]:
    """Fractions: seals with a lip differ by tens of per cent; least is 2 %."""
    friction = machine.axes[location].drive.friction
    sizes = {}
    if friction.coulomb + friction.stribeck_extra > 0:
        sizes["coulomb_asymmetry"] = friction.coulomb_asymmetry
    if friction.viscous > 0:
        sizes["viscous_asymmetry"] = friction.viscous_asymmetry
    return {name: Parameter("1", present, -0.9, 0.9, 0.2, 0.02) for name, present in sizes.items()}


EFFECTS = (
    Effect(
        "coulomb_friction", "another Coulomb friction of a drive", "force", axes,
        _numbers("coulomb", 0.02, 0.08), _set,
    ),
    Effect(
        "viscous_friction", "another viscous friction of a drive", "force", axes,
        _numbers("viscous", 0.015, 0.1), _set,
    ),
    Effect(
        "stribeck_friction", "another extra friction at rest", "force", axes,
        _numbers("stribeck_extra", 0.01, 0.05), _set,
    ),
    Effect(
        "friction_asymmetry", "friction that is larger in one direction of a drive", "force",
        _rubbing, _asymmetry, _set,
    ),
)  # fmt: skip
