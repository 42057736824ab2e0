"""Tasks by name, and running tasks made from a name and the user's options."""

import dataclasses
from typing import Any, get_type_hints

import numpy as np
from pydantic import ConfigDict, TypeAdapter, ValidationError

from hydrotele.core.datafile import suggest_valid_name
from hydrotele.core.errors import InputError
from hydrotele.core.plugins import find_plugins, is_object_reference, load_object
from hydrotele.envs import PLUGIN_GROUP
from hydrotele.envs.environment_step import step_or_reset_simulation
from hydrotele.envs.episode_batch import TaskCore
from hydrotele.envs.grade import GRADE
from hydrotele.envs.hold_force import HOLD_FORCE
from hydrotele.envs.load_truck import LOAD_TRUCK
from hydrotele.envs.place_log import PLACE_LOG
from hydrotele.envs.python_task import PythonTaskCore, find_python_task
from hydrotele.envs.reach_feller import REACH_FELLER
from hydrotele.envs.straight_line import STRAIGHT_LINE
from hydrotele.envs.task import Options, Task
from hydrotele.envs.track_trajectory import TRACK_TRAJECTORY

TASKS = {
    task.name: task
    for task in (
        TRACK_TRAJECTORY,
        STRAIGHT_LINE,
        HOLD_FORCE,
        REACH_FELLER,
        GRADE,
        PLACE_LOG,
        LOAD_TRUCK,
    )
}
"""Tasks by name."""

_STRICT_CONFIG = ConfigDict(strict=True, allow_inf_nan=False, arbitrary_types_allowed=True)
_OPTION_TYPES: dict[str, TypeAdapter] = {
    name: TypeAdapter(hint, config=_STRICT_CONFIG) for name, hint in get_type_hints(Options).items()
}
_COMPILE_LOOPS_COMMAND = "from hydrotele.multibody.closures import precompile_loop_residuals as compile_; compile_()"


def find_task(task: str | Task | type | Any) -> Task:
    """Return a task by the name of a shipped task or of a plug-in, or from an object.

    Args:
        task: name; `module:class` or `FILE.py:class`; a `Task`; or a subclass or object of `PythonTask`.

    Raises:
        InputError: there is no such task, or the plug-in cannot be loaded or is not a task.
    """
    if isinstance(task, Task):
        return task
    if task is None:
        raise InputError("hydrotele/Custom-v0", "needs a task: gymnasium.make('hydrotele/Custom-v0', task=MyTask)")
    if not isinstance(task, str):
        return find_python_task(task)
    if task in TASKS:
        return TASKS[task]
    if is_object_reference(task):
        found = load_object(task)
        return found if isinstance(found, Task) else find_python_task(found)
    plugins = find_plugins(PLUGIN_GROUP)
    if task not in plugins:
        raise InputError(f"task {task!r}", suggest_valid_name(task, [*TASKS, *plugins]))
    content = plugins[task].load()
    try:
        return content if isinstance(content, Task) else find_python_task(content)
    except InputError as error:
        raise InputError(plugins[task].source, str(error)) from None


def make_task_core(task: Any, choices: dict[str, Any], count: int, threads: int, autoreset: int) -> TaskCore:
    """Make a running task from its name and options.

    Args:
        task: name of the task, or another argument of `find_task`.
        choices: fields of `envs.task.Options`, and `device`: None for MuJoCo, "cpu" or "cuda" for the
            reduced model; then also `precision`, see `batch.Batch`.
        count: number of environments.
        threads: number of threads that step the environments, 0 for one per core.
        autoreset: autoreset mode, NEXT_STEP, SAME_STEP or DISABLED.

    Returns:
        The core.

    Raises:
        InputError: the task or an option does not exist, or a value is not valid.
    """
    found, choices = find_task(task), dict(choices)
    precision = choices.pop("precision", None)
    if (device := choices.pop("device", None)) not in (None, "cpu", "cuda"):
        raise InputError("environment option 'device'", f"must be cpu or cuda, for the reduced model, not {device!r}")
    known = {field.name for field in dataclasses.fields(Options)}
    if strange := set(choices) - known:
        name = sorted(strange)[0]
        raise InputError(f"environment option {name!r}", suggest_valid_name(name, known))
    options = _validate_options(choices)
    if device is not None:
        from hydrotele.envs.reduced_core import ReducedCore  # loads the tracing of mechanisms

        if device == "cpu":
            return ReducedCore(found, options, count, threads, autoreset, precision=precision)
        from hydrotele.envs.device_core import DeviceCore

        return DeviceCore(found, options, count, threads, autoreset, precision)
    if precision is not None:
        raise InputError("environment option 'precision'", "needs the option device")
    step_or_reset_simulation.compile_in_background(
        _COMPILE_LOOPS_COMMAND
    )  # while the plant's own code is compiled here
    make = PythonTaskCore if found.program is not None else TaskCore
    return make(found, options, count, threads, autoreset)


def _validate_options(choices: dict[str, Any]) -> Options:
    """Validate the type of every option; `variants="3"` and NaN are errors."""
    kept: dict[str, Any] = {}
    for name, value in choices.items():
        plain = value.item() if isinstance(value, np.generic) else value
        plain = tuple(plain) if isinstance(plain, list) else plain
        try:
            kept[name] = _OPTION_TYPES[name].validate_python(plain)
        except ValidationError as error:
            message = f"{error.errors()[0]['msg']}; got {value!r}"
            raise InputError(f"environment option {name!r}", message) from None
    return Options(**kept)
