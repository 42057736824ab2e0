"""The tasks, and from the keywords of `gymnasium.make` to a running one and its spaces."""

import dataclasses
from typing import Any, get_type_hints

import numpy as np
from gymnasium.spaces import Box
from pydantic import ConfigDict, TypeAdapter, ValidationError

from hydrotele.core.datafile import suggest
from hydrotele.core.errors import InputError
from hydrotele.envs.core import TaskCore
from hydrotele.envs.episode import DISABLED, NEXT_STEP, SAME_STEP
from hydrotele.envs.force import HOLD_FORCE
from hydrotele.envs.grade import GRADE
from hydrotele.envs.line import STRAIGHT_LINE
from hydrotele.envs.loop import advance
from hydrotele.envs.place import PLACE_LOG
from hydrotele.envs.reach import REACH_FELLER
from hydrotele.envs.task import Options, Task
from hydrotele.envs.track import track_fields
from hydrotele.machine.machine import Machine


def _about_home(machine: Machine, rng: np.random.Generator) -> dict[str, float]:
    """Axes somewhere in the middle part of their ranges; the swing anywhere in front."""
    places = {}
    for name, axis in machine.axes.items():
        low, high = machine.joints[axis.joint].range or (-0.5, 0.5)
        places[name] = float(low + (high - low) * rng.uniform(0.3, 0.7))
    return places


TASKS = {
    task.name: task
    for task in (
        Task(
            name="TrackTrajectory",
            kind="track",
            sentence="All axes of an excavator follow Fourier references, without tool.",
            reward="1 on the trajectory, less 1 for every 0.1 m that the tip is off, at least -1.",
            machine="cat215",
            tool="none",
            start=_about_home,
            fields=track_fields,
            measures=(("tip_error", "m"),),
        ),
        STRAIGHT_LINE,
        HOLD_FORCE,
        REACH_FELLER,
        GRADE,
        PLACE_LOG,
    )
}
"""Tasks by name."""


_STRICT = ConfigDict(strict=True, allow_inf_nan=False)
_TYPES: dict[str, TypeAdapter] = {
    name: TypeAdapter(hint, config=_STRICT) for name, hint in get_type_hints(Options).items()
}
_LOOPS = "from hydrotele.multibody.closures import compile_openings; compile_openings()"
AUTORESET = {"NextStep": NEXT_STEP, "SameStep": SAME_STEP, "Disabled": DISABLED}


def make_core(task: str, choices: dict[str, Any], count: int, threads: int, mode: int) -> TaskCore:
    """A running task.

    Args:
        task: its name.
        choices: fields of `tasks.task.Options`.
        count: number of environments.
        threads: that step them, 0 for one per core.
        mode: of autoreset.

    Returns:
        The core.

    Raises:
        InputError: no such task, no such option, or a value that does not suit.
    """
    if task not in TASKS:
        raise InputError(f"task {task!r}", suggest(task, TASKS))
    known = {field.name for field in dataclasses.fields(Options)}
    if strange := set(choices) - known:
        name = sorted(strange)[0]
        raise InputError(f"environment option {name!r}", suggest(name, known))
    options = _options(choices)
    advance.compile_elsewhere(_LOOPS)  # while the plant's own code is compiled here
    return TaskCore(TASKS[task], options, count, threads, mode)


def _options(choices: dict[str, Any]) -> Options:
    """The choices, each of its own type: `variants="3"` is a mistake, and so is a NaN."""
    kept: dict[str, Any] = {}
    for name, value in choices.items():
        plain = value.item() if isinstance(value, np.generic) else value
        plain = tuple(plain) if isinstance(plain, list) else plain
        try:
            kept[name] = _TYPES[name].validate_python(plain)
        except ValidationError as error:
            message = f"{error.errors()[0]['msg']}; it is {value!r}"
            raise InputError(f"environment option {name!r}", message) from None
    return Options(**kept)


def observation_space(core: TaskCore) -> Box:
    """(o,) float32 in SI, with the ends at which readings saturate."""
    return Box(core.low, core.high, dtype=np.float32)


def action_space(core: TaskCore) -> Box:
    """(a,) float32 from -1 to 1: full action to either side."""
    return Box(-1.0, 1.0, (len(core.setup.axes),), np.float32)


def info_of(core: TaskCore, final: bool = False) -> dict[str, np.ndarray]:
    """Name -> (n,) of the last step: the task's figures, variant, whether it became unstable.

    Args:
        core: the task.
        final: of the episodes that ended in this step, where new ones have begun since.

    Returns:
        The figures.
    """
    told, which = core.setup.task.measures, "last_" if final else ""
    figures = core.final_measures if final else core.measures
    info = {name: figures[:, i].copy() for i, (name, _) in enumerate(told)}
    info["variant"] = core.episodes[f"{which}variant"].copy()
    info["fault"] = core.episodes[f"{which}fault"] != 0
    return info


def check_mode(mode: str | None, known: list[str]) -> None:
    """Refuse a render mode that there is not.

    Raises:
        InputError: it is not known.
    """
    if mode is not None and mode not in known:
        raise InputError(f"render_mode {mode!r}", f"choose one of {', '.join(known)}, or none")


def with_rate(metadata: dict[str, Any], core: TaskCore) -> dict[str, Any]:
    """Metadata of an environment with the pictures per second [Hz] that its steps make."""
    rate = core.setup.options.control_rate
    return {**metadata, "render_fps": int(rate) if rate == int(rate) else rate}
