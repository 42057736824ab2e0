"""Scenario of one run: machine, start, pilot, controller, sensors, and control and log rates.

The pilot is the source of the motion: given commands, a reference path, or a person at a joystick.
Scenarios are read from YAML files, validated and frozen; `scenarios/` holds the shipped ones. Keys
may have units as suffixes, as in machine files.
"""

import copy
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import yaml
from pydantic import Field, model_validator

from hydrotele.core.datafile import (
    Name,
    NonNegativeFloat,
    PositiveFloat,
    StrictModel,
    parse_yaml_value,
    read_yaml,
    suggest_valid_name,
    validate_data,
)
from hydrotele.core.errors import InputError
from hydrotele.core.files import models_folder, resolve_path, scenarios_folder
from hydrotele.logs.log import load_log
from hydrotele.machine.log_channels import parse_channel
from hydrotele.machine.oil import Temperature
from hydrotele.scenario.pilots import Pilot, PolicyPilot, Pose, TablePilot, check_size_limit
from hydrotele.scenario.surrounding_objects import SurroundingObject
from hydrotele.scenario.teleoperation import TeleopPilot


class StartState(StrictModel):
    """Start of a run: joint positions by joint name [rad] or [m], or a tip pose.

    Joints for which nothing is given start at their positions in the machine's home position.
    """

    joints: dict[Name, float] = {}
    pose: Pose | None = None


class Servo(StrictModel):
    """Settings of the servo that moves every joint along its reference.

    - `position_gain` [1/s]: velocity command per position error. `axis_gains` [1/s] maps axis names to
      gains that replace it, such as for the swing.
    - `velocity_gain` [N s/m] or [N m s/rad]: force per velocity error, for force drives only.
    - `feedforward` [1]: fraction of the reference velocity that is fed forward.
    - `deadband_compensation` [1]: fraction of the valves' dead band that is compensated.
    - `lead` [s]: the reference velocity is taken this much later than now, to compensate spool lag.
    - `pressure_feedback` [1/s]: gain of the drive force minus its low-pass filtered value; it adds
      damping. `load_time` [s] is the time constant of this low-pass filter.
    - `force_model`: if given, inverse dynamics along the reference replace the filtered force. They are
      those of the scenario's machine (`nominal`) or of another machine (its name, or its folder relative
      to the scenario file or to the current folder).
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
    """An effect that is added to the simulated machine but is not in its nominal model, such as a leakage.

    `name` is the kind of effect; `hydrotele list effects` lists all names. `location` is the axis or
    part of the machine that has the effect. `parameters` maps the effect's parameter names to values.
    """

    name: str
    location: str = ""
    parameters: dict[str, float] = {}


class Scenario(StrictModel):
    """Complete specification of one simulated run; the same scenario gives bit-identical results.

    `duration` [s] is that of the run, `timestep` [s] that of the physics. `control_rate` and `log_rate`
    [Hz] are the rates of controller and log, and `seed` is the seed of all random numbers. `sensors`
    names a sensor set of the machine, and `tool` one of the machine's tools. `oil_temperature` [degC]
    is that during the run; the default is that of the machine's `oil`. `folder` is the folder of
    the scenario file, which is set automatically; relative paths in the scenario start there.

    Examples:
        A scenario is written in Python with the keys of a scenario file.

        >>> import hydrotele as ht
        >>> pilot = {"kind": "constant", "commands": {"slide": 0.2}}
        >>> scenario = ht.Scenario(name="extend", machine="rig", duration=1.0, pilot=pilot)
        >>> scenario.tick_count, scenario.row_count  # at 200 Hz and 50 Hz
        (200, 50)
        >>> speed = ht.run_scenario(scenario).truth["truth.velocity.slide"]
        >>> round(float(speed[-1]), 3)  # m/s
        0.097
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
    oil_temperature: Temperature | None = None
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
        check_size_limit("RUN_TICKS", self.duration * self.control_rate)
        check_size_limit("RUN_ROWS", self.duration * self.log_rate)
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
        """Number of log rows of the run: control periods over control periods per row, rounded down."""
        return self.tick_count // round(self.control_rate / self.log_rate)


def shipped_scenarios() -> list[str]:
    """Return the sorted names of the scenarios that the package contains: file names without `.yaml`.

    Examples:
        >>> import hydrotele as ht
        >>> [name for name in ht.shipped_scenarios() if name.startswith("rig")]
        ['rig_steps']
        >>> ht.load_scenario("rig_steps").description
        'Laboratory rig, valve steps of rising size in both directions, open loop'
    """
    return sorted(path.stem for path in scenarios_folder().glob("*.yaml"))


def find_scenario(name_or_path: str | Path) -> Path:
    """Return the path of the file of a shipped scenario, given by name, or of the user's scenario file.

    A shipped scenario takes precedence over a file of the same name.

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
        data: keys and values of the file.
        lines: key path -> line number, starting at 1. A key path is a tuple such as
            `("pilot", "file")`.
    """

    path: Path
    data: dict[str, Any]
    lines: dict[tuple, int]


def read_scenario_file(name_or_path: str | Path) -> ScenarioFile:
    """Read the scenario file of a shipped scenario or of the user, without validation of its values.

    `make_scenario` can make several scenarios from the result, each with other values replaced.

    Raises:
        InputError: the scenario does not exist, or the file is not a YAML mapping.
    """
    path = find_scenario(name_or_path)
    return ScenarioFile(path, *read_yaml(path))


def load_scenario(name_or_path: str | Path, overrides: dict[str, Any] | None = None) -> Scenario:
    """Read a scenario from a shipped or the user's YAML file, replace given values, and validate the result.

    Args:
        name_or_path: name of a shipped scenario or path of a YAML file.
        overrides: dotted key path -> value, or YAML text as in `--set servo.position_gain=2`.

    Returns:
        The validated scenario.

    Raises:
        InputError: the file is not valid; the message names file, line, key path and valid values.

    Examples:
        Overrides have the form of `--set`, a key path and YAML text, or are values.

        >>> import hydrotele as ht
        >>> scenario = ht.load_scenario("rig_steps", {"duration": 2.0, "sensors": "ideal"})
        >>> scenario.machine, scenario.duration, scenario.row_count
        ('rig', 2.0, 2000)
        >>> try:
        ...     ht.load_scenario("rig_steps", {"duration": "-2"})
        ... except ht.InputError as error:
        ...     print(error.message)
        duration: Input should be greater than 0
    """
    return make_scenario(read_scenario_file(name_or_path), overrides)


def make_scenario(file: ScenarioFile, overrides: dict[str, Any] | None = None) -> Scenario:
    """Return the validated scenario of a scenario file, after replacing given values.

    `overrides` maps dotted key paths to values or YAML text, such as `servo.position_gain` to `2`. `file` is not
    changed. If the pilot is a table in a log file, that log is read and its columns are stored in the
    scenario.

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
    """Return a scenario in which the log file of a table pilot is replaced by the log's columns.

    Times then count from the first row of the log. A scenario with another pilot or without such a
    file is returned unchanged. `where` names file, line and key in error messages.

    Raises:
        InputError: the log cannot be read, or has no column of the pilot's quantity.
    """
    if isinstance(scenario.pilot, PolicyPilot) and scenario.pilot.reference is not None:
        inner = _load_pilot_table(scenario.model_copy(update={"pilot": scenario.pilot.reference}), where)
        return scenario.model_copy(update={"pilot": scenario.pilot.model_copy(update={"reference": inner.pilot})})
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
    """Return the path of the user's machine that a scenario names, or None if there is none at that path.

    The path is relative to the folder of the scenario file: a machine file, or a folder that contains
    `machine.yaml`. Without such a file, the scenario's machine is a shipped one.
    """
    return _find_machine_beside(scenario, scenario.machine)


def find_local_force_model(scenario: Scenario) -> Path | None:
    """Return the path of the user's machine that `servo.force_model` names, or None if it names no such file.

    The path is relative to the folder of the scenario file, or else to the current folder. Without such
    a file, `force_model` is `nominal` or a shipped machine.
    """
    name = scenario.servo.force_model
    if name is None or name == "nominal":
        return None
    is_own = _is_machine(Path(name)) and not _is_machine(models_folder() / name)
    return _find_machine_beside(scenario, name) or (resolve_path(name) if is_own else None)


def _find_machine_beside(scenario: Scenario, name: str) -> Path | None:
    path = Path(scenario.folder, name)
    return path if scenario.folder and _is_machine(path) else None


def _is_machine(path: Path) -> bool:
    return path.is_file() or (path / "machine.yaml").is_file()


def find_scenario_joystick(scenario: Scenario) -> str:
    """Return the path of a scenario's own joystick file, or the name of a shipped joystick.

    An own file is relative to the folder of the scenario. A scenario without teleoperation has the
    shipped `joystick`.
    """
    name = scenario.pilot.joystick if isinstance(scenario.pilot, TeleopPilot) else "joystick"
    path = Path(scenario.folder, name)
    return str(path) if name != "joystick" and path.is_file() else name


def with_absolute_paths(scenario: Scenario) -> Scenario:
    """Return the scenario with absolute paths of its files, so that they do not depend on its folder.

    These are the user's machine, force model and joystick, the recorded motion, the trace of packet
    delays, the operator file, the table of a table pilot, and the file of a policy.
    """
    changes: dict[str, Any] = {}
    if machine := find_local_machine(scenario):
        changes["machine"] = str(machine)
    if model := find_local_force_model(scenario):
        changes["servo"] = scenario.servo.model_copy(update={"force_model": str(model)})

    def with_absolute_path(part: Any, key: str) -> Any:
        name = getattr(part, key, None)
        return part.model_copy(update={key: str(resolve_path(Path(scenario.folder, name)))}) if name else part

    pilot = scenario.pilot
    if isinstance(pilot, TablePilot):
        changes["pilot"] = with_absolute_path(pilot, "file")
    elif isinstance(pilot, PolicyPilot):
        place, colon, name = pilot.policy.rpartition(":")
        file = Path(scenario.folder, place if colon else name)
        if scenario.folder and file.is_file():
            changes["pilot"] = pilot.model_copy(
                update={"policy": f"{resolve_path(file)}{colon}{name if colon else ''}"}
            )
    elif isinstance(pilot, TeleopPilot):
        changes["pilot"] = pilot.model_copy(update={
            "operator": with_absolute_path(pilot.operator, "recorded"),
            "channel": with_absolute_path(pilot.channel, "trace"),
            "perception": with_absolute_path(pilot.perception, "file"),
            "joystick": find_scenario_joystick(scenario),
        })  # fmt: skip
    return scenario.model_copy(update=changes)


def save_scenario(scenario: Scenario, path: str | Path) -> None:
    """Write a scenario with all its values, defaults included, as YAML that `load_scenario` can read.

    Files that the scenario names are written with absolute paths, so that they do not depend on the
    folder of `path`. The key `folder` is not written.
    """
    data = with_absolute_paths(scenario).model_dump(mode="json")
    data.pop("folder")
    Path(path).write_text(yaml.safe_dump(data, sort_keys=False))


def _apply_override(data: dict[str, Any], key: str, text: Any) -> None:
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
        value = parse_yaml_value(text) if isinstance(text, str) else text
    except (yaml.YAMLError, ValueError):
        raise InputError(f"--set {key}", f"{text!r} is not a YAML value") from None
    if isinstance(where, list) and parts[-1].isdigit() and int(parts[-1]) < len(where):
        where[int(parts[-1])] = value
    elif isinstance(where, dict):
        where[parts[-1]] = value
    else:
        raise InputError(f"--set {key}", "there is nothing to set at this key")
