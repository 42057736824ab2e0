"""Programs that drive a run: trained policies, Python functions and plug-ins.

`load_policy` loads a file of stable-baselines3, TorchScript or ONNX, a Python function, or a plug-in of
the group `hydrotele.pilots`. A plug-in or function is called with a `PilotState`, or with an observation
if the scenario lists its values. An object may have the attributes `action`, `rate`, `observation`,
`axes` and `pose_rates` as defaults for a scenario (`scenario.pilots.PolicyPilot`), and a method
`begin(machine, axes)` that is called before the run.
"""

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hydrotele.control.action_limits import POSE_RATES
from hydrotele.control.arm_kinematics import arm_axes
from hydrotele.core.datafile import suggest_valid_name, validate_data
from hydrotele.core.errors import InputError
from hydrotele.core.files import resolve_path
from hydrotele.core.plugins import (
    find_plugins,
    hide_triton_from_torch,
    is_object_reference,
    load_object,
    require_library,
)
from hydrotele.machine.machine import Machine
from hydrotele.scenario.pilots import PolicyPilot

PLUGIN_GROUP = "hydrotele.pilots"
FILE_SUFFIXES = (".zip", ".pt", ".onnx")
_DEFAULT_RATE = 50.0  # Hz, actions per second
_EXTRA = "policy"


class PilotState(NamedTuple):
    """State of a run that a Python function receives, with k driven axes (`pilot.axes`).

    Attributes:
        time: time since the start of the run [s].
        position: (k,) readings of the axis positions [rad] or [m].
        rate: (k,) difference quotients of these readings [rad/s] or [m/s].
        pressure_head: (k,) readings of the head-side pressures [Pa]; 0 for an axis without a valve.
        pressure_rod: (k,) readings of the rod-side pressures [Pa]; 0 for an axis without a valve.
        pressure_supply: (s,) readings of the pump pressures [Pa].
        tip_pose: (5,) pose of the tip from the readings: r [m], theta [rad], z [m], attitude [rad], head [rad];
            0 for a machine without an arm, and for angles that the arm does not have.
        command: (k,) commands of valves [1], or of drives in their units.
        reference: (k,) positions to follow [rad] or [m]; the start positions without a reference.
        reference_rate: (k,) their rates [rad/s] or [m/s].

    Examples:
        A proportional controller for the position of a cylinder:

        >>> import numpy as np
        >>> from hydrotele import PilotState
        >>> def follow(state):
        ...     return 8.0 * (state.reference - state.position) + 2.5 * state.reference_rate
        >>> zero, pressure = np.zeros(1), np.array([5.0e6])
        >>> state = PilotState(
        ...     time=0.0, position=np.array([0.20]), rate=zero, pressure_head=pressure, pressure_rod=pressure,
        ...     pressure_supply=pressure, tip_pose=np.zeros(5), command=zero, reference=np.array([0.22]),
        ...     reference_rate=np.array([0.04]),
        ... )
        >>> follow(state).round(3)  # of the full valve command
        array([0.26])
    """

    time: float
    position: np.ndarray
    rate: np.ndarray
    pressure_head: np.ndarray
    pressure_rod: np.ndarray
    pressure_supply: np.ndarray
    tip_pose: np.ndarray
    command: np.ndarray
    reference: np.ndarray
    reference_rate: np.ndarray


class Policy(NamedTuple):
    """A loaded program.

    Attributes:
        source: file, function or plug-in, for messages.
        act: function of an observation (o,) float32, or of a `PilotState`; returns the actions (k,).
        needs_observation: whether it must be called with an observation.
        begin: function (machine, driven axes) that is called before the run, None without one.
        defaults: values for keys of `PolicyPilot` that the scenario leaves open.
    """

    source: str
    act: Callable[[Any], Any]
    needs_observation: bool
    begin: Callable[[Machine, tuple[str, ...]], object] | None = None
    defaults: dict[str, Any] = {}  # noqa: RUF012


_ALLOWED: set[str] = set()


def allow_policy(name: str, folder: str = "") -> None:
    """Allow scenario files to use a program that can run code: a Python function, or a `.zip` or `.pt` file.

    `hydrotele run --policy` does this for the program that it names. A scenario file alone cannot: it may
    come from somebody else.

    Args:
        name: as for `load_policy`.
        folder: folder to which a file is relative.

    Examples:
        A scenario file that names a Python function is refused until the user allows this function.

        >>> import tempfile
        >>> from pathlib import Path
        >>> import hydrotele as ht
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = Path(folder, "half.py").write_text("def half(state): return 0.5 + 0 * state.position")
        ...     _ = Path(folder, "pull.yaml").write_text(
        ...         "{name: pull, machine: rig, duration: 0.5, pilot: {kind: policy, policy: half.py:half}}"
        ...     )
        ...     scenario = ht.load_scenario(Path(folder, "pull.yaml"))
        ...     try:
        ...         ht.run_scenario(scenario)
        ...     except ht.InputError as error:
        ...         print(error.where)
        ...     ht.allow_policy("half.py:half", folder)
        ...     run = ht.run_scenario(scenario)
        pilot.policy
        >>> float(run.measured["command.slide"][-1])
        0.5
    """
    _ALLOWED.add(_absolute_name(name, folder))


def _absolute_name(name: str, folder: str) -> str:
    place, colon, end = name.rpartition(":")
    path = Path(folder, place if colon else end)
    return f"{resolve_path(path)}{colon}{end if colon else ''}" if path.is_file() else name


def check_policy_is_allowed(name: str, folder: str) -> None:
    """Raise InputError if a scenario file names a program that can run code and that the user has not allowed.

    `folder` is that of the file, empty for a scenario made in Python.
    """
    can_run_code = name.endswith((".zip", ".pt")) or is_object_reference(name)
    if folder and can_run_code and _absolute_name(name, folder) not in _ALLOWED:
        message = (
            f"the scenario file names {name}, which can run any code with your rights: if you trust it, give"
            f" --policy {_absolute_name(name, folder)} on the command line, or call hydrotele.allow_policy in Python"
        )
        raise InputError("pilot.policy", message)


def load_policy(name: str, folder: str = "") -> Policy:
    """Load a program that drives a run.

    Args:
        name: file (`.zip`, `.pt`, `.onnx`), `module:function`, `FILE.py:function`, or name of a plug-in.
        folder: folder to which a file is relative.

    Returns:
        The program.

    Raises:
        InputError: it does not exist or cannot be loaded, or a library that it needs is not installed.
    """
    path = Path(folder, name)
    if path.suffix in FILE_SUFFIXES:
        if not path.is_file():
            raise InputError(path, "no such policy file")
        load = {".zip": _load_stable_baselines, ".pt": _load_torchscript, ".onnx": _load_onnx}[path.suffix]
        return Policy(str(path), load(path), True)
    if is_object_reference(name):
        return _wrap_object(name, load_object(name, folder))
    plugins = find_plugins(PLUGIN_GROUP)
    if name in plugins:
        return _wrap_object(plugins[name].source, plugins[name].load())
    kinds = f"a file ({', '.join(FILE_SUFFIXES)}), module:function, FILE.py:function or a plug-in"
    installed = suggest_valid_name(name, plugins) if plugins else "no plug-in is installed"
    raise InputError(f"policy {name!r}", f"is not {kinds}; plug-ins: {installed}")


def _wrap_object(source: str, found: Any) -> Policy:
    """Return a Python function, or an object or class with the method `__call__`, as a policy."""
    try:
        program = found() if isinstance(found, type) else found
    except Exception as error:  # any error of the user's code
        raise InputError(source, f"cannot be made without arguments: {type(error).__name__}: {error}") from error
    if not callable(program):
        raise InputError(source, f"is not a function or an object that can be called: {program!r}")
    keys = ("observation", "axes", "action", "rate", "pose_rates")
    defaults = {key: value for key in keys if (value := getattr(program, key, None)) is not None}
    return Policy(source, program, False, getattr(program, "begin", None), defaults)


def complete_policy_pilot(pilot: PolicyPilot, policy: Policy, machine: Machine, axes: tuple[str, ...]) -> PolicyPilot:
    """Return a policy pilot whose open values are those of the program, or the defaults.

    Args:
        pilot: specification of the scenario.
        policy: the program.
        machine: the machine.
        axes: all axes of the machine, in the order of the plant.

    Returns:
        The specification, with all values except `reference`.

    Raises:
        InputError: a value of the program is not valid, or a policy file has no list of observations.
    """
    arm = arm_axes(machine) if machine.arm else ()
    order = (*arm, *(name for name in axes if name not in arm))
    values = {"axes": order, "action": "valve", "rate": _DEFAULT_RATE, "pose_rates": POSE_RATES} | policy.defaults
    given = {key: value for key in values if (value := getattr(pilot, key))}
    values |= given | ({"observation": pilot.observation} if pilot.observation else {})
    plain = {key: list(value) if isinstance(value, tuple | list) else value for key, value in values.items()}
    spec = {"kind": "policy", "policy": pilot.policy, **plain}
    whole = validate_data(PolicyPilot, spec, policy.source, {})
    if whole.action == "resolved_motion" and not arm:
        raise InputError("pilot.action", f"{machine.name} has no arm for resolved_motion; use valve or joint_rate")
    if whole.action == "resolved_motion" and whole.axes[: len(arm)] != arm:
        raise InputError("pilot.axes", f"resolved_motion needs the axes of the arm first: {', '.join(arm)}")
    if policy.needs_observation and not whole.observation:
        message = "say what it observes: `hydrotele run --task TASK` for that of a task, or `pilot.observation`"
        raise InputError(policy.source, message)
    return whole.model_copy(update={"reference": pilot.reference})


def _load_stable_baselines(path: Path) -> Callable[[np.ndarray], np.ndarray]:
    name = _find_algorithm(path)
    hide_triton_from_torch()
    require_library("torch", "learn", f"policy {path}")
    library = require_library("stable_baselines3", "learn", f"policy {path}")
    try:
        model = getattr(library, name).load(path, device="cpu")
    except Exception as error:  # the file holds pickled objects of any kind
        message = f"cannot be loaded as a policy of {name}: {type(error).__name__}: {error}"
        raise InputError(path, message) from error
    size = model.observation_space.shape

    def act(observation: np.ndarray) -> np.ndarray:
        _check_size(path, observation, size[0])
        return model.predict(observation, deterministic=True)[0]

    return act


def _find_algorithm(path: Path) -> str:
    """Return the class name of the algorithm that wrote a stable-baselines3 file, from the keys of its data."""
    try:
        with zipfile.ZipFile(path) as archive:
            keys = set(json.loads(archive.read("data")))
    except (zipfile.BadZipFile, KeyError, ValueError):
        raise InputError(path, "is not a file of stable-baselines3 (model.save)") from None
    marks = {"PPO": "clip_range", "SAC": "target_entropy", "TD3": "policy_delay", "A2C": "gae_lambda"}
    for name, mark in marks.items():
        if mark in keys:
            return name
    raise InputError(path, f"was not written by one of {', '.join(marks)}")


def _load_torchscript(path: Path) -> Callable[[np.ndarray], np.ndarray]:
    hide_triton_from_torch()
    torch = require_library("torch", "learn", f"policy {path}")
    try:
        module = torch.jit.load(path, map_location="cpu").eval()
    except (RuntimeError, ValueError) as error:
        raise InputError(path, f"is not a TorchScript file (torch.jit.save): {str(error).splitlines()[0]}") from None

    def act(observation: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            try:
                return module(torch.from_numpy(observation[None]))[0].numpy()
            except RuntimeError as error:
                last = str(error).strip().splitlines()[-1]
                raise InputError(path, f"does not accept {len(observation)} values: {last}") from None

    return act


def _load_onnx(path: Path) -> Callable[[np.ndarray], np.ndarray]:
    library = require_library("onnxruntime", _EXTRA, f"policy {path}")
    options = library.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = 1, 3
    try:
        session = library.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # the library has many kinds of errors, without a common class
        raise InputError(path, f"is not a usable ONNX file: {str(error).splitlines()[0]}") from None
    first = session.get_inputs()[0]
    size = first.shape[-1] if first.shape else 0
    if "float" not in first.type:
        raise InputError(path, f"its input {first.name} has the type {first.type}; float is needed")

    def act(observation: np.ndarray) -> np.ndarray:
        if isinstance(size, int):
            _check_size(path, observation, size)
        return session.run(None, {first.name: observation[None]})[0][0]

    return act


def _check_size(path: Path, observation: np.ndarray, size: int) -> None:
    if len(observation) != size:
        message = f"needs an observation of {size} values, but {len(observation)} are listed"
        raise InputError(path, f"{message}: check --task, its machine and tool, or `pilot.observation`")
