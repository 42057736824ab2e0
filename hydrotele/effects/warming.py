"""Oil and grease of another viscosity, and their warming during a run: less viscous friction, more leakage."""

from hydrotele.effects.effect import Effect, Parameter, Values, drive_kind, with_terms, with_value
from hydrotele.machine.machine import Machine
from hydrotele.terms.term import Term

NAME, ALL_AXES = "warming", "all"
_WARMING_TIME_S = 300.0  # s, time constant of warming of a tank of some hundred litres


def _viscous_friction(machine: Machine) -> dict[str, float]:
    """Return the coefficient of viscous friction of each axis [N s/m] or [N m s/rad], without axes where it is 0."""
    found = {name: axis.drive.friction.viscous for name, axis in machine.axes.items()}
    return {name: viscous for name, viscous in found.items() if viscous}


def _leakage_coefficients(machine: Machine) -> dict[str, float]:
    """Return the leakage coefficient between the chambers of each axis [m^3/(s Pa)], without axes where it is 0."""
    found = {n: axis.hydraulic_drive.leakage for n, axis in machine.hydraulic_axes.items()}
    return {name: leakage for name, leakage in found.items() if leakage}


def _warming_locations(machine: Machine) -> tuple[str, ...]:
    return (ALL_AXES,) if _viscous_friction(machine) or _leakage_coefficients(machine) else ()


def _warming_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal values, bounds and priors of the viscosity change by warming during a run.

    The parameters are the ratio of final to initial viscosity, 1 without the effect, and the time
    constant of its change. Warming by 20 K halves the viscosity. The smallest relevant change of
    the ratio is 0.05, which corresponds to 2 K.
    """
    term = next((term for term in machine.terms if term.name == NAME), None)
    present = dict(term.parameters) if term else {"ratio": 1.0, "time_constant": _WARMING_TIME_S}
    ratio, slow = present["ratio"], present["time_constant"]
    assert isinstance(ratio, float) and isinstance(slow, float)
    return {
        "ratio": Parameter("1", ratio, 0.1, 5.0, 0.3, 0.05),
        "time_constant": Parameter("s", slow, 2.0, 36000.0, 300.0, 5.0),
    }


def _set_warming(machine: Machine, location: str, values: Values) -> Machine:
    """Return the machine with viscous friction and leakage that change over time as the oil warms up.

    The change of the friction applies to the part that is equal in both directions. A viscosity
    ratio of 1 removes the effect.
    """
    if values["ratio"] == 1.0:
        return with_terms(machine, NAME, [])
    numbers = dict(values)
    terms = [
        Term(name=NAME, axis=axis, balance="force", law="viscous_drift",
             parameters={"viscous": viscous, **numbers})
        for axis, viscous in _viscous_friction(machine).items()
    ]  # fmt: skip
    for axis, leakage in _leakage_coefficients(machine).items():
        into_rod, into_head = {"leakage": leakage, **numbers}, {"leakage": -leakage, **numbers}
        terms += [
            Term(name=NAME, axis=axis, balance="flow_rod", law="leakage_drift",
                 parameters=into_rod),
            Term(name=NAME, axis=axis, balance="flow_head", law="leakage_drift",
                 parameters=into_head),
        ]  # fmt: skip
    return with_terms(machine, NAME, terms)


def _viscosity_locations(machine: Machine) -> tuple[str, ...]:
    """Return `all`, where the viscosity acts on more than one coefficient of a hydraulic machine."""
    count = len(_viscous_friction(machine)) + len(_leakage_coefficients(machine))
    return (ALL_AXES,) if machine.hydraulic_axes and count > 1 else ()


def _viscosity_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value (1), bounds and prior of the viscosity relative to that of the given machine.

    A difference of 10 K changes the viscosity of hydraulic oil by some 30 %. The smallest relevant change of the
    ratio is 0.05, which corresponds to 2 K.
    """
    return {"ratio": Parameter("1", 1.0, 0.1, 10.0, 0.3, 0.05)}


def _set_viscosity(machine: Machine, location: str, values: Values) -> Machine:
    """Return the machine with viscous friction of all axes times a ratio, and leakage past all pistons over it."""
    ratio = values["ratio"]
    for axis, viscous in _viscous_friction(machine).items():
        machine = with_value(machine, f"axes.{axis}.{drive_kind(machine, axis)}.friction.viscous", ratio * viscous)
    for axis, leakage in _leakage_coefficients(machine).items():
        machine = with_value(machine, f"axes.{axis}.{drive_kind(machine, axis)}.leakage", leakage / ratio)
    return machine


EFFECTS = (
    Effect(
        NAME, "warming oil, with less viscous friction and more leakage", "force", _warming_locations,
        _warming_parameters, _set_warming,
    ),
    Effect(
        "oil_viscosity", "viscosity of oil and grease that differs from the model, for example at another temperature",
        "force", _viscosity_locations, _viscosity_parameters, _set_viscosity,
    ),
)  # fmt: skip
