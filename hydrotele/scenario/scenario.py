"""Scenario of one run: machine, start, pilot, controller, sensors, and control and log rates.

The pilot is the source of the motion: given commands, a reference path, or a person at a joystick.
Scenarios are read from YAML files, validated and frozen; `scenarios/` holds the shipped ones. Keys
may have units as suffixes, as in machine files.
"""

import copy
import math
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import yaml
from pydantic import Field, ValidationError, model_validator

from hydrotele.core.datafile import (
    Name,
    NonNegativeFloat,
    PositiveFloat,
    StrictModel,
    Vector,
    parse_yaml_value,
    read_yaml,
    suggest_valid_name,
    validate_data,
)
from hydrotele.core.errors import InputError
from hydrotele.core.files import describe_excess, resolve_path, scenarios_folder
from hydrotele.logs.log import Log, load_log
from hydrotele.machine.signals import parse_channel
from hydrotele.scenario.teleoperation import TeleopPilot


class Plate(StrictModel):
    """A plate on a spring and a damper that the tool can press: an environment of known stiffness.

    `position` [m] is the centre of its face and `normal` the outward normal of the face (z is up,
    -x points back to the machine). `size` holds the half sizes [m]; further keys are mass [kg],
    stiffness [N/m] and damping [N s/m].
    """

    kind: Literal["plate"] = "plate"
    position: Vector
    normal: Literal["x", "-x", "y", "-y", "z"] = "z"
    size: tuple[PositiveFloat, PositiveFloat] = (1.0, 1.0)
    mass: PositiveFloat = 300.0
    stiffness: PositiveFloat = 1.0e6
    damping: NonNegativeFloat = 3.0e4


class StandingTree(StrictModel):
    """A standing tree that a disc saw cuts from its stump and a grab arm then holds.

    `position` [m] is on the ground, `cut_height` [m] the height of the cut, and
    `cutting_energy` [J/m^3] the energy per cut volume. `saw` and `grab` are axes of the machine; a
    grab at more than `closed_angle` [rad] holds a stem in its pocket.
    """

    renamed = {"kerf": "cut_height", "energy": "cutting_energy", "closed": "closed_angle"}

    kind: Literal["tree"] = "tree"
    position: tuple[float, float]
    diameter: PositiveFloat = 0.34
    height: PositiveFloat = 9.0
    density: PositiveFloat = 750.0
    cut_height: PositiveFloat = 0.30
    cutting_energy: PositiveFloat = 2.0e7
    saw: Name = "saw"
    grab: Name = "grab"
    closed_angle: float = 1.0


class LogOnGround(StrictModel):
    """A log on the ground that a grapple picks up and puts down.

    `position` [m] is its centre, and `direction` [rad] the angle of its axis in the horizontal
    plane, 0 along x; diameter and length are in [m], density in [kg/m^3]. `grab` is the axis of the
    machine that closes the jaw. A log in the pocket is gripped at more than `closed_angle` [rad]
    and released at less than `open_angle` [rad].
    """

    renamed = {"closed": "closed_angle", "open": "open_angle"}

    kind: Literal["log"] = "log"
    position: tuple[float, float]
    direction: float = 0.0
    diameter: PositiveFloat = 0.35
    length: PositiveFloat = 4.0
    density: PositiveFloat = 830.0
    grab: Name = "claw"
    closed_angle: float = 1.2
    open_angle: float = 1.0

    @model_validator(mode="after")
    def _check(self):
        if self.open_angle > self.closed_angle:
            raise ValueError(
                f"open_angle {self.open_angle:g} rad must not exceed closed_angle {self.closed_angle:g} rad"
            )
        if self.length < 2.0 * self.diameter:
            raise ValueError(f"length {self.length:g} m must be at least twice the diameter {self.diameter:g} m")
        return self

    @property
    def mass(self) -> float:
        """Mass of the log [kg]."""
        return self.density * math.pi * self.diameter**2 / 4.0 * self.length


class SoilGround(StrictModel):
    """Ground that the bucket of the machine can dig up: a strip of soil in the plane of the arm.

    `soil` selects the soil's strength parameters by name. Other links of the machine touch firm
    ground.
    """

    kind: Literal["soil"] = "soil"
    soil: Literal["soft", "sandy_loam", "firm"] = "sandy_loam"


SurroundingObject = Annotated[Plate | StandingTree | LogOnGround | SoilGround, Field(discriminator="kind")]


class Pose(StrictModel):
    """Pose of the arm's tip in cylindrical coordinates about the swing axis.

    `r` is the distance from the axis and `z` the height above ground [m]. `theta` is the swing angle,
    `attitude` the pitch of the tool and `head` its rotation [rad]; not all arms have the last two.
    """

    r: PositiveFloat
    z: float
    theta: float = 0.0
    attitude: float | None = None
    head: float | None = None


class StartState(StrictModel):
    """Start of a run: joint positions by joint name [rad] or [m], or a tip pose.

    Joints that are not given start at the machine's home position.
    """

    joints: dict[Name, float] = {}
    pose: Pose | None = None


class ConstantPilot(StrictModel):
    """Constant commands to valves or drives, open loop: axis -> command [1] or [V]."""

    kind: Literal["constant"]
    commands: dict[Name, float] = {}


class TablePilot(StrictModel):
    """Commands or references from a table over time, given as columns or in a log file.

    `quantity: command` drives the valves open loop, `quantity: joint` gives joint references [rad]
    or [m]. `file` is a CSV or Parquet log, of which the columns `command.<axis>` or
    `reference.<axis>` (otherwise `angle.<axis>`, `position.<axis>`) are used. `interpolate` holds
    the last value or connects the values linearly.
    """

    renamed = {"of": "quantity"}

    kind: Literal["table"]
    quantity: Literal["command", "joint"] = "command"
    time: list[NonNegativeFloat] = []
    columns: dict[Name, list[float]] = {}
    file: str | None = None
    interpolate: Literal["hold", "linear"] = "hold"

    @model_validator(mode="after")
    def _check(self):
        if bool(self.file) == bool(self.columns):
            raise ValueError("give either columns (with time) or file")
        for name, values in self.columns.items():
            if len(values) != len(self.time):
                raise ValueError(f"columns.{name} has {len(values)} values, time has {len(self.time)}")
        if self.columns and (not self.time or self.time[0] != 0.0 or any(_find_nonrising_steps(self.time))):
            raise ValueError("time must start at 0 and rise strictly")
        return self


def _find_nonrising_steps(values) -> list[bool]:
    return [b <= a for a, b in zip(values, values[1:], strict=False)]


def _check_size_limit(name: str, amount: float) -> None:
    if said := describe_excess(name, amount):
        raise ValueError(f"has {said}")


class FourierSeries(StrictModel):
    """Fourier series of one joint's reference: `mean + sum_k (sin_k sin(k w t) + cos_k cos(k w t))`.

    k counts from 1, w is 2 pi over the common period, and all coefficients are in [rad] or [m].
    """

    mean: float = 0.0
    sin: list[float] = []
    cos: list[float] = []


class FourierPilot(StrictModel):
    """Periodic joint references as Fourier series with a common `period` [s].

    They are faded in from the start position over `fade` [s].

    The servo holds axes without a reference at their start, except those in `closed_valves`, whose
    command is always 0.
    """

    kind: Literal["fourier"]
    period: PositiveFloat
    fade: NonNegativeFloat = 2.0
    axes: dict[Name, FourierSeries]
    closed_valves: tuple[Name, ...] = ()

    @model_validator(mode="after")
    def _check(self):
        if both := sorted(set(self.closed_valves) & self.axes.keys()):
            raise ValueError(f"closed_valves: {both[0]} also has a reference in axes; name it in one of them")
        counts = [max(len(axis.sin), len(axis.cos)) for axis in self.axes.values()]
        _check_size_limit("HARMONICS", max(counts, default=0))
        return self


class TipMove(StrictModel):
    """A straight move of the tip: signed distances of r, z [m], theta, attitude, head [rad].

    `speed` is that of the tip [m/s], or [rad/s] if only angles change; `pause` [s] follows the move.
    """

    r: float = 0.0
    z: float = 0.0
    theta: float = 0.0
    attitude: float = 0.0
    head: float = 0.0
    speed: Annotated[float, Field(ge=1e-4, le=100)] = 0.5
    pause: NonNegativeFloat = 0.5


class LinesPilot(StrictModel):
    """Straight moves of the tip in cylindrical coordinates, converted to joint references.

    `mode: rate` integrates rate commands like those of a joystick under rate control; `position`
    commands the pose. The tip rests for `settle` [s] and then makes the `moves`, whose speeds are
    reached with `acceleration` [m/s^2] or [rad/s^2].
    """

    kind: Literal["lines"]
    mode: Literal["rate", "position"] = "rate"
    settle: NonNegativeFloat = 1.0
    acceleration: Annotated[float, Field(ge=1e-3, le=1000)] = 1.0
    moves: Annotated[list[TipMove], Field(min_length=1)]

    @model_validator(mode="after")
    def _check(self):
        _check_size_limit("MOVES", len(self.moves))
        return self


class Waypoint(StrictModel):
    """Joint positions or tip pose, reached `duration` [s] after the previous one, held `pause` [s].

    `joints` are joint name -> position [rad] or [m].
    """

    duration: PositiveFloat
    pause: NonNegativeFloat = 0.0
    joints: dict[Name, float] = {}
    pose: Pose | None = None


class WaypointsPilot(StrictModel):
    """Waypoints connected by quintic polynomials of time, in joint space or in the tip pose.

    The motion starts after `settle` [s].
    """

    kind: Literal["waypoints"]
    settle: NonNegativeFloat = 0.5
    points: Annotated[list[Waypoint], Field(min_length=1)]

    @model_validator(mode="after")
    def _check(self):
        _check_size_limit("MOVES", len(self.points))
        return self


Pilot = Annotated[
    ConstantPilot | TablePilot | FourierPilot | LinesPilot | WaypointsPilot | TeleopPilot,
    Field(discriminator="kind"),
]


class Servo(StrictModel):
    """Settings of the servo that moves every joint along its reference.

    `position_gain` [1/s] is the velocity command per position error; `axis_gains` [1/s] replace it for
    individual axes (such as a slewing house); `velocity_gain` (force drives only) [N s/m] or
    [N m s/rad]; `feedforward` of the reference velocity and `deadband_compensation` of the valves, as
    fractions; `lead` [s], a phase lead that compensates the spool lag;
    `pressure_feedback` [1/s], which adds damping, with the time constant `load_time` [s] of the
    low-pass filtered drive force. `force_model` replaces the filtered force by inverse dynamics
    along the reference, of the machine of the scenario (`nominal`) or of another machine (its name
    or folder).
    """

    position_gain: NonNegativeFloat = 4.0
    axis_gains: dict[Name, NonNegativeFloat] = {}
    velocity_gain: NonNegativeFloat = 0.0
    feedforward: Annotated[float, Field(ge=0, le=1.5)] = 1.0
    lead: Annotated[float, Field(ge=0, le=0.3)] = 0.05
    deadband_compensation: Annotated[float, Field(ge=0, le=1)] = 1.0
    load_time: PositiveFloat = 0.2
    pressure_feedback: NonNegativeFloat = 6.0
    force_model: str | None = None


class PlantedEffect(StrictModel):
    """An effect of the simulated machine that is not in its nominal model, such as a leakage.

    `location` is the axis or part, and `parameters` are those of the effect. `hydrotele list effects`
    lists the names.
    """

    name: str
    location: str = ""
    parameters: dict[str, float] = {}


class Scenario(StrictModel):
    """Complete specification of one simulated run; the same scenario gives bit-identical results.

    `timestep` [s] is that of the physics, `control_rate` and `log_rate` [Hz] are the rates of
    controller and log, and `seed` that of all random numbers. `sensors` names a sensor set of the
    machine.
    """

    name: Name
    description: str = ""
    machine: str = "cat215"
    tool: Name | None = None
    seed: Annotated[int, Field(ge=0)] = 0
    duration: Annotated[float, Field(gt=0, le=36000)]
    timestep: Annotated[float, Field(ge=1e-5, le=5e-3)] = 1.0e-3
    control_rate: PositiveFloat = 200.0
    log_rate: PositiveFloat = 50.0
    sensors: str = "ideal"
    ground: bool = True
    surroundings: tuple[SurroundingObject, ...] = ()
    start: StartState = StartState()
    pilot: Pilot
    servo: Servo = Servo()
    effects: tuple[PlantedEffect, ...] = ()
    folder: str = ""

    @model_validator(mode="after")
    def _check(self):
        steps = 1.0 / (self.control_rate * self.timestep)
        if steps < 0.999 or abs(steps - round(steps)) > 1e-6:
            raise ValueError(
                f"control_rate {self.control_rate:g} Hz needs a whole number of physics steps of"
                f" {self.timestep:g} s per control period, not {steps:g}"
            )
        ticks = self.control_rate / self.log_rate
        if ticks < 0.999 or abs(ticks - round(ticks)) > 1e-6:
            raise ValueError(f"log_rate {self.log_rate:g} Hz must divide control_rate {self.control_rate:g} Hz")
        _check_size_limit("RUN_TICKS", self.duration * self.control_rate)
        _check_size_limit("RUN_ROWS", self.duration * self.log_rate)
        if not self.ground and any(thing.kind == "log" for thing in self.surroundings):
            raise ValueError("a log needs ground to lie on: set ground: true or remove the log")
        if sum(thing.kind == "soil" for thing in self.surroundings) > (1 if self.ground else 0):
            raise ValueError("soil can be given once, and only with ground: true")
        if self.duration * self.control_rate > 2e7:
            raise ValueError("duration is too long: more than 2e7 control periods")
        if self.row_count < 10:
            raise ValueError("duration is too short: a log needs at least 10 rows")
        return self

    @property
    def tick_count(self) -> int:
        """Number of control periods of the run."""
        return round(self.duration * self.control_rate)

    @property
    def row_count(self) -> int:
        """Number of log rows of the run."""
        return self.tick_count // round(self.control_rate / self.log_rate)


def shipped_scenarios() -> list[str]:
    """Return the sorted names of the scenario files that the package contains."""
    return sorted(path.stem for path in scenarios_folder().glob("*.yaml"))


def find_scenario(name_or_path: str | Path) -> Path:
    """Return the file of a shipped scenario, given by name, or of the user's scenario file.

    Raises:
        InputError: the scenario does not exist; the message lists the shipped ones.
    """
    path = Path(name_or_path)
    if str(name_or_path) in shipped_scenarios():
        return scenarios_folder() / f"{name_or_path}.yaml"
    if path.is_file():
        return path
    raise InputError(
        f"scenario {str(name_or_path)!r}",
        f"is neither a file nor a shipped scenario; {suggest_valid_name(path.stem, shipped_scenarios())}",
    )


class ScenarioFile(NamedTuple):
    """Content of a scenario file before overrides and validation.

    Attributes:
        path: the file.
        data: its keys and values.
        lines: key path, a tuple such as `("pilot", "file")` -> line number, starting at 1.
    """

    path: Path
    data: dict[str, Any]
    lines: dict[tuple, int]


def read_scenario_file(name_or_path: str | Path) -> ScenarioFile:
    """Read a shipped or own scenario file without validation.

    `make_scenario` can make several scenarios from the result, each with its own overrides.

    Raises:
        InputError: the scenario does not exist, or the file is not a YAML mapping.
    """
    path = find_scenario(name_or_path)
    return ScenarioFile(path, *read_yaml(path))


def load_scenario(name_or_path: str | Path, overrides: dict[str, str] | None = None) -> Scenario:
    """Read a scenario from a shipped or own YAML file, replace given values, and validate it.

    Args:
        name_or_path: name of a shipped scenario or path of a YAML file.
        overrides: dotted key path -> YAML text, as in `--set servo.position_gain=2`.

    Returns:
        The validated scenario.

    Raises:
        InputError: the file is not valid; the message names file, line, key path and valid values.
    """
    return make_scenario(read_scenario_file(name_or_path), overrides)


def make_scenario(file: ScenarioFile, overrides: dict[str, str] | None = None) -> Scenario:
    """Validate the content of a scenario file, after replacing values.

    `overrides` maps dotted key paths to YAML text, such as `servo.position_gain` to `2`. The file of a
    table pilot is read into the scenario.

    Raises:
        InputError: the file is not valid; the message names file, line, key path and valid values.
    """
    path, data, lines = file.path, copy.deepcopy(file.data), file.lines
    for key, text in (overrides or {}).items():
        _apply_override(data, key, text)
    if "folder" in data:
        raise InputError(_locate_key(path, lines, "folder"), "is set automatically; remove the key")
    data["folder"] = str(resolve_path(path.parent))
    kind = data["pilot"].get("kind") if isinstance(data.get("pilot"), dict) else None
    if isinstance(kind, str) and not overrides:  # the key paths of pydantic contain the kind of the pilot
        lines = lines | {("pilot", kind, *k[1:]): n for k, n in lines.items() if k[:1] == ("pilot",)}
    source = f"{path} with --set {' '.join(overrides)}" if overrides else str(path)
    scenario = validate_data(Scenario, data, source, {} if overrides else lines)
    return _load_pilot_table(scenario, _locate_key(path, lines, "pilot", "file"))


def _locate_key(path: Path, lines: dict[tuple, int], *keys: str) -> str:
    line = f":{lines[keys]}" if keys in lines else ""
    return f"{path}{line}: {'.'.join(keys)}"


def _load_pilot_table(scenario: Scenario, where: str) -> Scenario:
    """Replace the log file of a pilot that follows a table by its columns.

    The scenario is then self-contained.

    `where` names file, line and key in error messages. Raise InputError for an unsuitable log.
    """
    pilot = scenario.pilot
    if not isinstance(pilot, TablePilot) or pilot.file is None:
        return scenario
    try:
        log = load_log(Path(scenario.folder, pilot.file), minimum_rows=2, complete=True)
    except InputError as error:
        raise InputError(where, str(error)) from None
    kinds = ("command",) if pilot.quantity == "command" else ("position", "angle", "reference")
    found = {c.axis: c.name for k in kinds for c in map(parse_channel, log.columns)
             if c.kind == k and not c.truth}  # fmt: skip
    if not found:
        wanted = " or ".join(f"{kind}.<axis>" for kind in reversed(kinds))
        raise InputError(where, f"{log.source} has no {wanted}; it has {', '.join(log.columns)}")
    table = pilot.model_copy(update={
        "time": (log.time - log.time[0]).tolist(), "file": None,
        "columns": {axis: log[channel].tolist() for axis, channel in found.items()},
    })  # fmt: skip
    return scenario.model_copy(update={"pilot": table})


def find_local_machine(scenario: Scenario) -> Path | None:
    """Return the path of a scenario's own machine, or None if its machine is a shipped one.

    An own machine is a file or folder relative to the folder of the scenario file.
    """
    path = Path(scenario.folder, scenario.machine)
    beside = scenario.folder and (path.is_file() or (path / "machine.yaml").is_file())
    return path if beside else None


def save_scenario(scenario: Scenario, path: str | Path) -> None:
    """Write a scenario with all its values, defaults included, as YAML that `load_scenario` can read."""
    data = scenario.model_dump(mode="json")
    beside = find_local_machine(scenario)
    data["machine"] = str(beside) if beside else scenario.machine
    data.pop("folder")
    Path(path).write_text(yaml.safe_dump(data, sort_keys=False))


def _apply_override(data: dict[str, Any], key: str, text: str) -> None:
    where: Any = data
    parts = key.split(".")
    for part in parts[:-1]:
        if isinstance(where, list) and part.isdigit() and int(part) < len(where):
            where = where[int(part)]
        elif isinstance(where, dict) and part.isdigit():
            raise InputError(f"--set {key}", f"there is no entry {part}; set the whole list first")
        elif isinstance(where, dict):
            where = where.setdefault(part, {})
        else:
            raise InputError(f"--set {key}", f"there is nothing below {part!r} to set")
    try:
        value = parse_yaml_value(text)
    except (yaml.YAMLError, ValueError):
        raise InputError(f"--set {key}", f"{text!r} is not a YAML value") from None
    if isinstance(where, list) and parts[-1].isdigit() and int(parts[-1]) < len(where):
        where[int(parts[-1])] = value
    elif isinstance(where, dict):
        where[parts[-1]] = value
    else:
        raise InputError(f"--set {key}", "there is nothing to set at this key")


def read_soil_from_log(log: Log) -> tuple[SoilGround, ...]:
    """Read from a log's metadata the soil that the bucket could dig during the run.

    The result contains one soil, or is empty if the run had none.

    Raises:
        InputError: the metadata are damaged.
    """
    if "soil" not in log.metadata:
        return ()
    try:
        return (SoilGround.model_validate_json(log.metadata["soil"]),)
    except ValidationError as error:
        raise InputError(f"{log.source}: metadata soil", f"is invalid: {error.errors()[0]['msg']}") from None
