"""The same tasks for dm_control: `load("TrackTrajectory")` gives a `dm_env.Environment`."""

import collections
from collections.abc import Mapping
from typing import Any

import dm_env
import mujoco
import numpy as np
from dm_control.mujoco import engine, wrapper
from dm_env import specs

from hydrotele.envs.episode import DISABLED
from hydrotele.envs.making import info_of, make_core
from hydrotele.envs.stage import FREE, Camera, Stage
from hydrotele.envs.world import Field

FLAT = "observations"  # dm_control's name of the one array


def load(
    task_name: str, random: int | np.random.RandomState | None = None,
    flat_observation: bool = False, **options: Any,
) -> "MachineEnvironment":  # fmt: skip
    """Make a task, as `dm_control.suite.load` does.

    Args:
        task_name: of `hydrotele.envs.making.TASKS`.
        random: seed of the episodes, or a state that one is drawn from; without, they are drawn
            from the computer's own.
        flat_observation: whether observations are one array, under the key `observations`.
        **options: fields of `hydrotele.envs.task.Options`.

    Returns:
        The environment. With the same seed and actions its numbers are those of gymnasium's.

    Raises:
        InputError: there is no such task or option.

    Example:
        >>> env = load("TrackTrajectory", random=7, variants=2)
        >>> env.reset().observation["angle"].shape
        (3,)
    """
    return MachineEnvironment(task_name, random, flat_observation, options)


class MachineEnvironment(dm_env.Environment):
    """A control task on a simulated machine.

    Attributes:
        core: the running task.
        fields: key of the observation -> what its numbers are, with units.
    """

    def __init__(
        self, task_name: str, random: int | np.random.RandomState | None, flat: bool,
        options: Mapping[str, Any],
    ) -> None:  # fmt: skip
        """Compile the machine; arguments as of `load`."""
        self.core = make_core(task_name, dict(options), 1, 1, DISABLED)
        if random is None:
            random = int(np.random.default_rng().integers(2**62))
        elif isinstance(random, np.random.RandomState):
            random = int(random.randint(2**31 - 1))
        self._seed = random
        self._begun, self._over = False, True
        self._places = group([FLAT] * len(self.core.setup.fields) if flat else self._kinds())
        self.fields: dict[str, tuple[Field, ...]] = {
            key: tuple(self.core.setup.fields[i] for i in places)
            for key, places in self._places.items()
        }
        self._stage: Stage | None = None
        self._physics: Physics | None = None

    def _kinds(self) -> list[str]:
        return [field.name.partition(".")[0] for field in self.core.setup.fields]

    def reset(self) -> dm_env.TimeStep:
        """Begin an episode; the first one is that of the seed."""
        self.core.reset(None if self._begun else np.array([self._seed]))
        self._begun, self._over = True, False
        return dm_env.restart(self._observation())

    def step(self, action: np.ndarray) -> dm_env.TimeStep:
        """Go on by one step, or begin an episode where the last one is over.

        Args:
            action: (a,); beyond +-1 it counts as full.

        Returns:
            The step; its discount is 0 where the task ended, and 1 where only the time did.

        Raises:
            ValueError: the action has another shape, or is not a finite number.
        """
        if self._over:
            return self.reset()
        core = self.core
        core.step_one(action)
        reward, seen = float(core.reward[0]), self._observation()
        self._over = bool(core.terminated[0] or core.truncated[0])
        if core.terminated[0]:
            return dm_env.termination(reward, seen)
        return dm_env.truncation(reward, seen) if self._over else dm_env.transition(reward, seen)

    def _observation(self) -> collections.OrderedDict[str, np.ndarray]:
        return split(self.core.observation[0], self._places)

    def observation_spec(self) -> collections.OrderedDict[str, specs.BoundedArray]:
        """Bounds in SI at which readings saturate; `fields` says what each number is."""
        low, high = (split(ends, self._places) for ends in (self.core.low, self.core.high))
        return collections.OrderedDict(
            (key, specs.BoundedArray(low[key].shape, np.float32, low[key], high[key], key))
            for key in self._places
        )

    def action_spec(self) -> specs.BoundedArray:
        """(a,) from -1 to 1; what each number moves is in its name, between tabs."""
        name, count = "\t".join(self.core.coordinates), len(self.core.coordinates)
        return specs.BoundedArray((count,), np.float32, -1.0, 1.0, name)

    def control_timestep(self) -> float:
        """Time between steps [s]."""
        return 1.0 / self.core.setup.options.control_rate

    def figures(self) -> dict[str, Any]:
        """What gymnasium gives as `info`: the task's figures of the last step, variant, fault."""
        return {name: values[0] for name, values in info_of(self.core).items()}

    def render(self, height: int = 240, width: int = 320, camera_id: Camera = FREE) -> np.ndarray:
        """Draw the machine and its goal.

        Args:
            height: [pixel].
            width: [pixel].
            camera_id: name or number of a camera of the machine, or -1 for one that shows all that
                its arm reaches.

        Returns:
            (height, width, 3) uint8.

        Raises:
            InputError: there is no such camera, or no OpenGL works (says what to do).
        """
        return self._staged().picture(0, width, height, camera_id)

    def _staged(self) -> Stage:
        if self._stage is None:
            self._stage = Stage(self.core)
        return self._stage

    @property
    def physics(self) -> "Physics":
        """The machine with its looks as it stands now, for dm_control's viewer and wrappers.

        What is written there does not reach the simulation.
        """
        stage = self._staged()
        if self._physics is None:
            self._physics = Physics.from_model(wrapper.MjModel(stage.model))
            self._physics.stage = stage
        stage.show()
        mujoco.mj_copyData(self._physics.data.ptr, stage.model, stage.data)
        return self._physics

    def close(self) -> None:
        """Close what shows the simulation, and give its memory back."""
        if self._physics is not None:
            self._physics.free()
        if self._stage:
            self._stage.close()
        self._physics = self._stage = None
        self.core.close()


class Physics(engine.Physics):
    """The machine of an environment, which draws the goal too."""

    stage: Stage

    def render(
        self, height: int = 240, width: int = 320, camera_id: Any = FREE, **asked: Any
    ) -> np.ndarray:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Draw it as the environment does; what else is asked for, dm_control draws.

        Args:
            height: [pixel].
            width: [pixel].
            camera_id: as of `MachineEnvironment.render`.
            **asked: overlays, depth, segmentation and so on, as of `dm_control.mujoco.Physics`; for
                them MUJOCO_GL must name an OpenGL that works.

        Returns:
            (height, width, 3) uint8, or what dm_control gives.

        Raises:
            InputError: there is no such camera, or no OpenGL works (says what to do).
        """
        if any(value not in (None, False, ()) for value in asked.values()):
            return super().render(height, width, camera_id, **asked)
        return self.stage.picture(0, width, height, camera_id)


def group(keys: list[str]) -> collections.OrderedDict[str, np.ndarray]:
    """Places of every key in a list, keys in the order of their first places."""
    places: collections.OrderedDict[str, list[int]] = collections.OrderedDict()
    for place, key in enumerate(keys):
        places.setdefault(key, []).append(place)
    return collections.OrderedDict((key, np.array(some)) for key, some in places.items())


def split(
    values: np.ndarray, places: Mapping[str, np.ndarray]
) -> collections.OrderedDict[str, np.ndarray]:
    """Numbers by key, copied."""
    return collections.OrderedDict((key, values[some]) for key, some in places.items())
