"""Parameter table of the six joystick axes, built from the joystick's file and the scenario."""

import numpy as np

from hydrotele.core.datafile import split_unit, suggest_valid_name, validate_data
from hydrotele.core.errors import InputError
from hydrotele.machine.joystick import AXES, AxisGains, Joystick
from hydrotele.scenario.teleoperation import (
    CoordinateMapping,
    RegulateForce,
    SteerToPoses,
    TeleopPilot,
    TrackForce,
)

# columns, SI; GAIN is the rate of a coordinate per displacement beyond the dead band [1/s], or its
# position per displacement; WAVE is the impedance b of wave variables
(NOMINAL_STIFFNESS, MIN_STIFFNESS, MAX_STIFFNESS, STIFFNESS_PER_FORCE, DAMPING, FORCE_LIMIT, DEADBAND, DETENT_DROP,
DETENT_STIFFNESS, HANDLE_RANGE, COORDINATE, SIGN,
 GAIN, REFLECTION_RATIO, COUPLING, COUPLING_DAMPING, MAX_REFLECTED_FORCE, AXIS_WAVE_IMPEDANCE) = range(18)  # fmt: skip
COLUMNS = AXIS_WAVE_IMPEDANCE + 1
LEVER = 0.1  # m, lever arm of a hand: converts translational gains to rotational ones
_DEFAULT_COUPLING_STIFFNESS = {
    "rate": 40.0,
    "position": 400.0,
}  # N/m, N per metre of machine or of handle
_COUPLING_TIME = 0.1  # s, ratio of damping to stiffness of that coupling


def build_axis_table(joystick: Joystick, pilot: TeleopPilot, coordinates: tuple[str, ...]) -> np.ndarray:
    """Build the table of control parameters of all joystick axes for the compiled code.

    Args:
        joystick: the joystick.
        pilot: teleoperation settings of the scenario.
        coordinates: task coordinates of the arm.

    Returns:
        (6, 18), one row per joystick axis; the constants NOMINAL_STIFFNESS to AXIS_WAVE_IMPEDANCE of
        this module number the columns. SI units.

    Raises:
        InputError: inconsistent gains, a coordinate that the arm does not have, one joystick axis
            for two coordinates, or an operator's goal that the joystick cannot move.
    """
    if pilot.gains not in joystick.gains:
        message = f"{pilot.gains!r}; {suggest_valid_name(pilot.gains, joystick.gains)}"
        raise InputError("pilot.gains", message)
    table = np.zeros((6, COLUMNS))
    table[:, COORDINATE] = -1.0
    soft = _DEFAULT_COUPLING_STIFFNESS[pilot.mode] if pilot.coupling is None else pilot.coupling
    damped = _COUPLING_TIME * soft if pilot.coupling_damping is None else pilot.coupling_damping
    for number, name in enumerate(AXES):
        law = _merge_gains(joystick, pilot, name)
        reach = joystick.handle_travel[number]
        detent = law.detent if pilot.detent and pilot.mode == "rate" else None  # needs a dead band
        table[number, : COORDINATE] = (
            law.nominal_stiffness, law.min_stiffness, law.max_stiffness,
            (law.max_stiffness - law.nominal_stiffness) / law.force_limit,
            law.damping, law.force_limit, law.deadband, detent.drop if detent else 0.0,
            detent.slope if detent else -1.0, reach,
        )  # fmt: skip
        lever = 1.0 if number < 3 else LEVER
        table[number, REFLECTION_RATIO:] = (
            lever * pilot.ratio, lever**2 * soft, lever**2 * damped,
            pilot.force_limit or law.force_limit, lever**2 * (pilot.wave_impedance or damped),
        )  # fmt: skip
    _assign_coordinates(pilot, table, coordinates)
    _check_operator_goals(pilot, table, coordinates)
    return table


def _assign_coordinates(pilot: TeleopPilot, table: np.ndarray, coordinates) -> None:
    """Write coordinate, sign and gain of every task coordinate to the row of its joystick axis.

    Under rate control the gain is the full speed over the handle's range beyond the dead band
    [1/s], under position control the scale. Raise InputError for a coordinate that the arm does not
    have, an axis with two coordinates, or an axis whose dead band covers its whole range.
    """
    where = "pilot.coordinates"
    if strange := set(pilot.coordinates) - set(coordinates):
        message = f"{', '.join(sorted(strange))}: the arm has {', '.join(coordinates)}"
        raise InputError(where, message)
    for number, coordinate in enumerate(coordinates):
        coupling = pilot.coordinates.get(coordinate, CoordinateMapping())
        axis, sign = coupling.resolve_axis(coordinate)
        row = table[AXES.index(axis)]
        if row[COORDINATE] >= 0.0:
            raise InputError(where, f"joystick axis {axis} is assigned to two coordinates")
        gain = coupling.scale
        if pilot.mode == "rate":
            if row[DEADBAND] >= row[HANDLE_RANGE] and coordinate in pilot.coordinates:
                message = f"the dead band of {axis} covers its whole range: it cannot be moved"
                raise InputError(f"{where}.{coordinate}", message)
            gain = coupling.speed / max(row[HANDLE_RANGE] - row[DEADBAND], 1e-9)
        row[[COORDINATE, SIGN, GAIN]] = number, sign, gain


def _merge_gains(joystick: Joystick, pilot: TeleopPilot, name: str) -> AxisGains:
    """Return stiffness, damping and limits of joystick axis `name`.

    The values are those of the joystick file's gain set that the scenario selects. Values that the
    scenario gives for this axis replace them. Raise InputError for invalid values of the scenario.
    """
    usual = joystick.gains[pilot.gains][name].model_dump()
    own = {str(axis): gains for axis, gains in pilot.stiffness.items()}.get(name, {})
    said = {split_unit(key)[0] for key in own}
    kept = {key: value for key, value in usual.items() if key not in said}
    return validate_data(AxisGains, kept | own, f"pilot.stiffness.{name}", {})


def _check_operator_goals(pilot: TeleopPilot, table: np.ndarray, coordinates: tuple[str, ...]) -> None:
    """Raise InputError if the simulated operator's target is a coordinate that cannot be moved.

    The arm must have the coordinate, and the dead band must not cover the range of its joystick axis.
    """
    goals: dict[str, str] = {}
    match pilot.operator:
        case RegulateForce() | TrackForce():
            goals = {pilot.operator.target.coordinate: "pilot.operator.target.coordinate"}
        case SteerToPoses():
            goals = {name: f"pilot.operator.points.{name}" for name in pilot.operator.points}
    for name, where in goals.items():
        if name not in coordinates:
            raise InputError(where, f"{name!r}: the arm has {', '.join(coordinates)}")
        row = table[table[:, COORDINATE] == coordinates.index(name)][0]
        if pilot.mode == "rate" and row[DEADBAND] >= row[HANDLE_RANGE]:
            axis = AXES[int(np.flatnonzero(table[:, COORDINATE] == row[COORDINATE])[0])]
            raise InputError(where, f"the dead band of {axis} covers its whole range")
