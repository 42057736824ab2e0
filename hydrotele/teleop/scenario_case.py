"""The linear case of a teleoperated scenario: machine in contact, joystick, servo, line, task."""

from pathlib import Path
from typing import NamedTuple

from hydrotele.control.resolved_motion import COORDINATES, arm_axes, pose_to_joints
from hydrotele.core.errors import InputError
from hydrotele.machine.joystick import Joystick
from hydrotele.machine.machine import Machine
from hydrotele.machine.noise import sensor_set
from hydrotele.scenario.scenario import Scenario
from hydrotele.scenario.surroundings import Plate
from hydrotele.scenario.teleoperation import Regulate, TeleopPilot, Track
from hydrotele.teleop.linear_case import LinearCase, linear_case
from hydrotele.teleop.linear_machine import Clocks, tip_drive
from hydrotele.teleop.master import master
from hydrotele.teleop.two_port import Impedance

DEFAULT_TASK = Impedance(damping=3.0e4, stiffness=1.0e6)  # stiff ground, as a plate's default
_NORMALS = {"z": ("z",), "r": ("x", "-x")}
_PLACE = {"z": 2, "r": 0}


class Contact(NamedTuple):
    """Where and what the tip presses on.

    Attributes:
        joints: axis -> position [rad].
        task: impedance along the coordinate.
        source: what it was taken from.
    """

    joints: dict[str, float]
    task: Impedance
    source: str


def scenario_case(
    scenario: Scenario, machine: Machine, joystick: Joystick, coordinate: str | None = None
) -> tuple[LinearCase, Contact]:
    """The linear case of a scenario.

    Args:
        scenario: with a teleoperated pilot.
        machine: its machine.
        joystick: its joystick.
        coordinate: of the arm; that of the operator's force target by default, else z.

    Returns:
        The case, and where and what it touches.

    Raises:
        InputError: the scenario is not teleoperated, the arm has no such coordinate, nothing comes
            back.
    """
    pilot = scenario.pilot
    if not isinstance(pilot, TeleopPilot):
        raise InputError(f"scenario {scenario.name}", "has no teleoperated pilot to analyse")
    if not pilot.ratio > 0.0:
        raise InputError("pilot.ratio", "nothing comes back; give a ratio, such as 1e-5")
    coordinates = COORDINATES[: len(arm_axes(machine))]
    wanted = coordinate or _pressed(pilot)
    if wanted not in coordinates:
        message = f"no {wanted!r}; the arm has {', '.join(coordinates)}"
        raise InputError("--coordinate", message)
    contact = _contact(scenario, machine, wanted)
    sensors, period = sensor_set(machine, scenario.sensors), 1.0 / scenario.control_rate
    clocks = Clocks(period, max(period, 1.0 / sensors.rate) if sensors else period)
    numbers, _ = master(joystick, pilot, coordinates)
    tip = tip_drive(machine, contact.joints, wanted, scenario.servo)
    case = linear_case(pilot, joystick, numbers, tip, scenario.servo, clocks, contact.task)
    return case, contact


def joystick_of(scenario: Scenario) -> str:
    """Name or file of a scenario's joystick, counted from the scenario's file."""
    name = scenario.pilot.joystick if isinstance(scenario.pilot, TeleopPilot) else "joystick"
    path = Path(scenario.folder, name)
    return str(path) if name != "joystick" and path.is_file() else name


def _pressed(pilot: TeleopPilot) -> str:
    operator = pilot.operator
    return operator.target.coordinate if isinstance(operator, Regulate | Track) else "z"


def _contact(scenario: Scenario, machine: Machine, coordinate: str) -> Contact:
    """Start pose, moved along the coordinate to the plate that stands in its way."""
    joints = machine.home | scenario.start.joints
    here = {name: joints.get(axis.joint, 0.0) for name, axis in machine.axes.items()}
    pose, plate = scenario.start.pose, _plate(scenario, coordinate)
    if pose and plate:
        pose = pose.model_copy(update={coordinate: plate.position[_PLACE[coordinate]]})
    if pose:
        here |= pose_to_joints(machine, pose, here, "start.pose")
    if plate:
        task = Impedance(plate.mass, plate.damping, plate.stiffness)
        return Contact(here, task, "the scenario's plate")
    if coordinate in ("r", "z"):
        return Contact(here, DEFAULT_TASK, "default, stiff ground")
    lever = pose.r if pose and coordinate == "theta" else 1.0
    turned = Impedance(0.0, *(lever**2 * v for v in (DEFAULT_TASK.damping, DEFAULT_TASK.stiffness)))
    return Contact(here, turned, f"default, stiff ground {lever:g} m from the axis")


def _plate(scenario: Scenario, coordinate: str) -> Plate | None:
    """The first plate that looks along a coordinate."""
    ways = _NORMALS.get(coordinate, ())
    for thing in scenario.surroundings:
        if isinstance(thing, Plate) and thing.normal in ways:
            return thing
    return None
