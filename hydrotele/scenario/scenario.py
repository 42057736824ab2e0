"""A scenario: machine, start, pilot, controller, sensors and clocks of one run; frozen, validated.

Scenarios are YAML files; `scenarios/` holds the shipped ones. Keys may carry units as suffixes, as
in machine files.
"""

import copy
import math
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import yaml
from pydantic import Field, model_validator

from hydrotele.core.datafile import (
    Facts,
    Name,
    NonNegative,
    Positive,
    Vector,
    parse,
    read_value,
    read_yaml,
    suggest,
)
from hydrotele.core.errors import InputError
from hydrotele.core.files import beyond, scenarios_folder
from hydrotele.logs.log import load_log
from hydrotele.machine.signals import parse_channel
from hydrotele.scenario.teleoperation import TeleopPilot


class Plate(Facts):
    """A plate on a spring and a damper: a task of known stiffness.

    `position` [m] is the middle of its face, `normal` the way that the face looks (z up, x back
    towards the machine is -x); half sizes [m], mass [kg], stiffness [N/m], damping [N s/m].
    """

    kind: Literal["plate"] = "plate"
    position: Vector
    normal: Literal["x", "-x", "y", "-y", "z"] = "z"
    size: tuple[Positive, Positive] = (1.0, 1.0)
    mass: Positive = 300.0
    stiffness: Positive = 1.0e6
    damping: NonNegative = 3.0e4


class StandingTree(Facts):
    """A standing tree that a disc saw cuts from its stump and a grab arm then holds.

    `position` [m] on the ground; `kerf` [m] is the height at which it can be cut, `energy` [J/m^3]
    what cutting takes. `saw` and `grab` are axes of the machine; a grab beyond `closed` [rad] holds
    a stem that stands in its pocket.
    """

    kind: Literal["tree"] = "tree"
    position: tuple[float, float]
    diameter: Positive = 0.34
    height: Positive = 9.0
    density: Positive = 750.0
    kerf: Positive = 0.30
    energy: Positive = 2.0e7
    saw: Name = "saw"
    grab: Name = "grab"
    closed: float = 1.0


class LogOnGround(Facts):
    """A log on the ground that a grapple picks up and puts down.

    `position` [m] of its middle, `direction` [rad] of its axis in the horizontal plane, 0 along x;
    diameter and length [m], density [kg/m^3]. `grab` is the machine's axis that closes the jaw: the
    log is held beyond `closed` [rad] where it lies in the pocket, and let go below `open` [rad].
    """

    kind: Literal["log"] = "log"
    position: tuple[float, float]
    direction: float = 0.0
    diameter: Positive = 0.35
    length: Positive = 4.0
    density: Positive = 830.0
    grab: Name = "claw"
    closed: float = 1.2
    open: float = 1.0

    @model_validator(mode="after")
    def _check(self):
        if self.open > self.closed:
            raise ValueError(f"open {self.open:g} rad must not exceed closed {self.closed:g} rad")
        if self.length < 2.0 * self.diameter:
            raise ValueError(
                f"length {self.length:g} m must be at least twice the diameter {self.diameter:g} m"
            )
        return self

    @property
    def mass(self) -> float:
        """[kg]."""
        return self.density * math.pi * self.diameter**2 / 4.0 * self.length


SurroundingObject = Annotated[Plate | StandingTree | LogOnGround, Field(discriminator="kind")]


class Pose(Facts):
    """The arm's tip: r from the swing axis, z above ground [m], theta, attitude, head [rad]."""

    r: Positive
    z: float
    theta: float = 0.0
    attitude: float | None = None
    head: float | None = None


class Start(Facts):
    """Where a run starts: joint positions [rad] or [m], or a pose of the tip; else home."""

    joints: dict[Name, float] = {}
    pose: Pose | None = None


class ConstantPilot(Facts):
    """Open loop: the same drive commands all the time."""

    kind: Literal["constant"]
    commands: dict[Name, float] = {}


class TablePilot(Facts):
    """A table over time, given here by column or in a log file (`file`, CSV or Parquet).

    `of: command` drives the valves open loop, `of: joint` gives joint references [rad] or [m]. Of a
    file, `command.<axis>` or `reference.<axis>` (else `angle.<axis>`, `position.<axis>`) is taken.
    """

    kind: Literal["table"]
    of: Literal["command", "joint"] = "command"
    time: list[NonNegative] = []
    columns: dict[Name, list[float]] = {}
    file: str | None = None
    interpolate: Literal["hold", "linear"] = "hold"

    @model_validator(mode="after")
    def _check(self):
        if bool(self.file) == bool(self.columns):
            raise ValueError("give either columns (with time) or file")
        for name, values in self.columns.items():
            if len(values) != len(self.time):
                raise ValueError(
                    f"columns.{name} has {len(values)} values, time has {len(self.time)}"
                )
        if self.columns and (not self.time or self.time[0] != 0.0 or any(_falls(self.time))):
            raise ValueError("time must start at 0 and rise")
        return self


def _falls(values) -> list[bool]:
    return [b <= a for a, b in zip(values, values[1:], strict=False)]


def _refuse_beyond(name: str, amount: float) -> None:
    if said := beyond(name, amount):
        raise ValueError(f"has {said}")


class Harmonics(Facts):
    """Fourier reference of one joint: mean + sum_k sin_k sin(k w t) + cos_k cos(k w t)."""

    mean: float = 0.0
    sin: list[float] = []
    cos: list[float] = []


class FourierPilot(Facts):
    """Fourier references with a common period [s], faded in from the start over `fade` [s].

    The servo holds axes without a reference at their start, but those of `closed_valves`: their
    command is 0 throughout.
    """

    kind: Literal["fourier"]
    period: Positive
    fade: NonNegative = 2.0
    axes: dict[Name, Harmonics]
    closed_valves: tuple[Name, ...] = ()

    @model_validator(mode="after")
    def _check(self):
        if both := sorted(set(self.closed_valves) & self.axes.keys()):
            raise ValueError(f"closed_valves: {both[0]} has a reference in axes, too; name it once")
        counts = [max(len(axis.sin), len(axis.cos)) for axis in self.axes.values()]
        _refuse_beyond("HARMONICS", max(counts, default=0))
        return self


class Move(Facts):
    """A straight move of the tip: signed distances of r, z [m], theta, attitude, head [rad]."""

    r: float = 0.0
    z: float = 0.0
    theta: float = 0.0
    attitude: float = 0.0
    head: float = 0.0
    speed: Annotated[float, Field(ge=1e-4, le=100)] = 0.5
    pause: NonNegative = 0.5


class LinesPilot(Facts):
    """Straight lines by resolved motion in cylindrical coordinates.

    `mode: rate` integrates rate commands as a joystick under rate control gives them, `position`
    commands the pose itself. Speed [m/s] is that of the tip (or [rad/s] where only angles change),
    reached with `acceleration`.
    """

    kind: Literal["lines"]
    mode: Literal["rate", "position"] = "rate"
    settle: NonNegative = 1.0
    acceleration: Annotated[float, Field(ge=1e-3, le=1000)] = 1.0
    moves: Annotated[list[Move], Field(min_length=1)]

    @model_validator(mode="after")
    def _check(self):
        _refuse_beyond("MOVES", len(self.moves))
        return self


class Waypoint(Facts):
    """A joint target or a pose, reached `duration` [s] after the one before, then held `pause`."""

    duration: Positive
    pause: NonNegative = 0.0
    joints: dict[Name, float] = {}
    pose: Pose | None = None


class WaypointsPilot(Facts):
    """A list of waypoints, joined by quintic polynomials, in joint space or along the pose."""

    kind: Literal["waypoints"]
    settle: NonNegative = 0.5
    points: Annotated[list[Waypoint], Field(min_length=1)]

    @model_validator(mode="after")
    def _check(self):
        _refuse_beyond("MOVES", len(self.points))
        return self


Pilot = Annotated[
    ConstantPilot | TablePilot | FourierPilot | LinesPilot | WaypointsPilot | TeleopPilot,
    Field(discriminator="kind"),
]


class Servo(Facts):
    """Joint servo.

    position_gain [1/s], axis_gains for axes that need another one (a slewing house), velocity_gain
    (force drives only) [N s/m] or [N m s/rad], feedforward and deadband_compensation as fractions,
    lead [s] that makes up for the spool's lag, pressure_feedback [1/s] (damping) with load_time [s]
    of the slow mean force. With `force_model` the force that is expected follows from inverse
    dynamics along the reference instead of that mean: of the scenario's own machine (`nominal`), or
    of another (its name or folder).
    """

    position_gain: NonNegative = 4.0
    axis_gains: dict[Name, NonNegative] = {}
    velocity_gain: NonNegative = 0.0
    feedforward: Annotated[float, Field(ge=0, le=1.5)] = 1.0
    lead: Annotated[float, Field(ge=0, le=0.3)] = 0.05
    deadband_compensation: Annotated[float, Field(ge=0, le=1)] = 1.0
    load_time: Positive = 0.2
    pressure_feedback: NonNegative = 6.0
    force_model: str | None = None


class PlantedEffect(Facts):
    """An effect that the simulated machine has and its model lacks (`hydrotele list effects`)."""

    name: str
    location: str = ""
    parameters: dict[str, float] = {}


class Scenario(Facts):
    """One run, complete: same scenario, same bits."""

    name: Name
    description: str = ""
    machine: str = "cat215"
    tool: Name | None = None
    seed: Annotated[int, Field(ge=0)] = 0
    duration: Annotated[float, Field(gt=0, le=36000)]
    timestep: Annotated[float, Field(ge=1e-5, le=5e-3)] = 1.0e-3
    control_rate: Positive = 200.0
    log_rate: Positive = 50.0
    sensors: str = "ideal"
    ground: bool = True
    surroundings: tuple[SurroundingObject, ...] = ()
    start: Start = Start()
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
            raise ValueError(
                f"log_rate {self.log_rate:g} Hz must divide control_rate {self.control_rate:g} Hz"
            )
        _refuse_beyond("RUN_TICKS", self.duration * self.control_rate)
        _refuse_beyond("RUN_ROWS", self.duration * self.log_rate)
        if not self.ground and any(thing.kind == "log" for thing in self.surroundings):
            raise ValueError("a log needs ground to lie on: set ground: true or remove the log")
        if self.duration * self.control_rate > 2e7:
            raise ValueError("duration is too long: more than 2e7 control periods")
        if self.rows < 10:
            raise ValueError("duration is too short: a log needs at least 10 rows")
        return self

    @property
    def ticks(self) -> int:
        """Number of control periods."""
        return round(self.duration * self.control_rate)

    @property
    def rows(self) -> int:
        """Number of rows of the logs, all complete."""
        return self.ticks // round(self.control_rate / self.log_rate)


def shipped_scenarios() -> list[str]:
    """Names of the scenarios that come with the package."""
    return sorted(path.stem for path in scenarios_folder().glob("*.yaml"))


def scenario_path(name_or_path: str | Path) -> Path:
    """File of a shipped scenario (by name) or of a user's.

    Raises:
        InputError: there is no such scenario; lists those that are shipped.
    """
    path = Path(name_or_path)
    if str(name_or_path) in shipped_scenarios():
        return scenarios_folder() / f"{name_or_path}.yaml"
    if path.is_file():
        return path
    raise InputError(
        f"scenario {str(name_or_path)!r}",
        f"is neither a file nor a shipped scenario; {suggest(path.stem, shipped_scenarios())}",
    )


class ScenarioFile(NamedTuple):
    """A scenario's file as read, before overrides and validation.

    Attributes:
        path: the file.
        data: its keys and values.
        lines: key path -> line number from 1.
    """

    path: Path
    data: dict[str, Any]
    lines: dict[tuple, int]


def read_scenario_file(name_or_path: str | Path) -> ScenarioFile:
    """Read the file of a scenario once, to make many scenarios from it with `scenario_from`.

    Raises:
        InputError: there is no such scenario, or it is no YAML mapping.
    """
    path = scenario_path(name_or_path)
    return ScenarioFile(path, *read_yaml(path))


def load_scenario(name_or_path: str | Path, overrides: dict[str, str] | None = None) -> Scenario:
    """Read a scenario.

    Args:
        name_or_path: name of a shipped scenario or a YAML file.
        overrides: dotted key path -> YAML text, as of `--set servo.position_gain=2`.

    Returns:
        The validated scenario.

    Raises:
        InputError: names file, line, key path and what is allowed.
    """
    return scenario_from(read_scenario_file(name_or_path), overrides)


def scenario_from(file: ScenarioFile, overrides: dict[str, str] | None = None) -> Scenario:
    """The scenario of a file that was read, with overrides as of `load_scenario`.

    Raises:
        InputError: names file, line, key path and what is allowed.
    """
    path, data, lines = file.path, copy.deepcopy(file.data), file.lines
    for key, text in (overrides or {}).items():
        _override(data, key, text)
    if "folder" in data:
        raise InputError(_at(path, lines, "folder"), "is the scenario file's own; remove the key")
    data["folder"] = str(path.parent.resolve())
    kind = data["pilot"].get("kind") if isinstance(data.get("pilot"), dict) else None
    if isinstance(kind, str):  # pydantic names the pilot's kind in its key paths
        lines = lines | {
            ("pilot", kind, *k[1:]): n for k, n in lines.items() if k[:1] == ("pilot",)
        }
    source = f"{path} with --set {' '.join(overrides)}" if overrides else str(path)
    scenario = parse(Scenario, data, source, {} if overrides else lines)
    return _with_table(scenario, _at(path, lines, "pilot", "file"))


def _at(path: Path, lines: dict[tuple, int], *keys: str) -> str:
    line = f":{lines[keys]}" if keys in lines else ""
    return f"{path}{line}: {'.'.join(keys)}"


def _with_table(scenario: Scenario, where: str) -> Scenario:
    """The scenario with the file of its table pilot read in, so that it is complete by itself."""
    pilot = scenario.pilot
    if not isinstance(pilot, TablePilot) or pilot.file is None:
        return scenario
    try:
        log = load_log(Path(scenario.folder, pilot.file), minimum_rows=2, maximum_dropped=1.0)
    except InputError as error:
        raise InputError(where, str(error)) from None
    kinds = ("command",) if pilot.of == "command" else ("position", "angle", "reference")
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


def own_machine(scenario: Scenario) -> Path | None:
    """The machine file or folder that lies beside the scenario, None for a shipped machine."""
    path = Path(scenario.folder, scenario.machine)
    beside = scenario.folder and (path.is_file() or (path / "machine.yaml").is_file())
    return path if beside else None


def save_scenario(scenario: Scenario, path: str | Path) -> None:
    """Write a scenario as YAML, complete with every default, readable by `load_scenario`."""
    data = scenario.model_dump(mode="json")
    beside = own_machine(scenario)
    data["machine"] = str(beside) if beside else scenario.machine
    data.pop("folder")
    Path(path).write_text(yaml.safe_dump(data, sort_keys=False))


def _override(data: dict[str, Any], key: str, text: str) -> None:
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
        value = read_value(text)
    except (yaml.YAMLError, ValueError):
        raise InputError(f"--set {key}", f"{text!r} is not a YAML value") from None
    if isinstance(where, list) and parts[-1].isdigit() and int(parts[-1]) < len(where):
        where[int(parts[-1])] = value
    elif isinstance(where, dict):
        where[parts[-1]] = value
    else:
        raise InputError(f"--set {key}", "there is nothing there to set")
