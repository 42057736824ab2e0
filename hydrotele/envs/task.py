"""What a task is, as facts in Python, and what a user may choose of it."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, Literal

import mujoco
import numpy as np

from hydrotele.envs.episode import ACTIONS
from hydrotele.envs.observation import Field
from hydrotele.machine.machine import Machine
from hydrotele.scenario.scenario import Servo
from hydrotele.scenario.surroundings import SurroundingObject

ActionKind = Literal["valve", "joint_rate", "resolved_motion"]
REAL = "real"


@dataclasses.dataclass(frozen=True)
class Task:
    """A control task.

    Attributes:
        name: as in `hydrotele/<Name>-v0`.
        kind: its name in native code, of `kinds.KINDS`.
        sentence: what is asked, one sentence.
        reward: what it pays and when an episode ends, in words.
        machine: name of the machine.
        tool: its tool, None for the machine's first one.
        more_axes: axes that are driven beside those of the arm.
        action: kind of actions where the user names none.
        duration: of an episode [s].
        start: (machine, random generator) -> axis or joint name -> position at the start.
        fields: (machine, driven axes) -> what `observe_<kind>` writes.
        measures: name and unit of every figure in `info`.
        surroundings: (machine, random generator, start) -> what stands around.
        ground: whether there is a hard ground.
        parameters: (machine, MuJoCo model) -> up to PARAMETERS that the task's native code reads.
        terrain: floats that an episode keeps of its ground, 0 without.
        swing_locked: whether the swing's action does nothing.
        writes: fields of the model that its native code writes; a new episode has them anew.
        pose_rates: of the tip at full action: r [m/s], theta [rad/s], z [m/s], attitude, head.
        servo: gains of the joint servo (`joint_rate`, `resolved_motion`).
    """

    name: str
    kind: str
    sentence: str
    reward: str
    machine: str
    tool: str | None
    start: Callable[[Machine, np.random.Generator], dict[str, float]]
    fields: Callable[[Machine, tuple[str, ...]], list[Field]]
    measures: tuple[tuple[str, str], ...]
    more_axes: tuple[str, ...] = ()
    action: ActionKind = "valve"
    duration: float = 20.0
    surroundings: Callable[
        [Machine, np.random.Generator, dict[str, float]], tuple[SurroundingObject, ...]
    ] = lambda *_: ()
    ground: bool = False
    parameters: Callable[[Machine, mujoco.MjModel], Sequence[float] | np.ndarray] | None = None
    terrain: int = 0
    swing_locked: bool = False
    writes: tuple[str, ...] = ()
    pose_rates: tuple[float, ...] = (0.5, 0.3, 0.5, 0.4, 0.25)
    servo: Servo = Servo()


@dataclasses.dataclass(frozen=True)
class Options:
    """What a user chooses; None is the task's own.

    Attributes:
        action: `valve` (commands of valves), `joint_rate` (rates of the axes, followed by the joint
            servo) or `resolved_motion` (rates of the tip, by resolved motion).
        sensors: `ideal`, `real` (the machine's first set of sensors) or the name of a set.
        control_rate: environment steps per second [Hz]; the servo runs at 200 Hz or faster.
        duration: of an episode [s].
        effects: planted in every episode: mappings with `name`, `location`, `parameters`.
        randomise: the same with a range [low, high] for every parameter: drawn for every variant.
        variants: machines and starts that are drawn; every episode has one of them.
        variant_seed: from which they are drawn.
        timestep: of the physics [s].
    """

    action: ActionKind | None = None
    sensors: str = "ideal"
    control_rate: float = 50.0
    duration: float | None = None
    effects: tuple[dict[str, Any], ...] = ()
    randomise: tuple[dict[str, Any], ...] = ()
    variants: int = 64
    variant_seed: int = 0
    timestep: float = 1.0e-3


assert set(ACTIONS) == set(ActionKind.__args__)
