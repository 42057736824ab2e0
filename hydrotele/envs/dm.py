"""Environments for dm_control: `load("TrackTrajectory")` returns a `dm_env.Environment`.

The tasks are those of the gymnasium environments.
"""

import collections
from collections.abc import Mapping
from typing import Any

import dm_env
import mujoco
import numpy as np
from dm_control.mujoco import engine, wrapper
from dm_env import specs

from hydrotele.envs.episode import DISABLED
from hydrotele.envs.gymnasium_env import make_info
from hydrotele.envs.observation import ObservationField
from hydrotele.envs.rendering import FREE_CAMERA, Camera, TaskRenderer
from hydrotele.envs.saved_state import SavedState
from hydrotele.envs.task_catalogue import make_task_core

FLAT_KEY = "observations"  # dm_control's key for a flat observation


def load(
    task_name: Any, random: int | np.random.RandomState | None = None,
    flat_observation: bool = False, **options: Any,
) -> "MachineEnvironment":  # fmt: skip
    """Make an environment, as `dm_control.suite.load` does.

    Args:
        task_name: name of a task, or a class or object of `PythonTask`.
        random: seed of the episodes, or a random state from which a seed is drawn; None uses a seed
            from the operating system.
        flat_observation: whether to return all observations as one array under the key
            `observations`.
        **options: fields of `hydrotele.envs.task.Options`.

    Returns:
        The environment. The same seed and actions give the same values as the gymnasium
        environment.

    Raises:
        InputError: the task or an option does not exist.

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
        fields: observation key -> names, units and bounds of its values.
    """

    def __init__(
        self, task_name: Any, random: int | np.random.RandomState | None, flat: bool,
        options: Mapping[str, Any],
    ) -> None:  # fmt: skip
        """Create the environment and compile the machine variants.

        The arguments are those of `load`; `flat` is its `flat_observation`.
        """
        self.core = make_task_core(task_name, dict(options), 1, 1, DISABLED)
        if random is None:
            random = int(np.random.default_rng().integers(2**62))
        elif isinstance(random, np.random.RandomState):
            random = int(random.randint(2**31 - 1))
        self._seed = random
        self._is_started, self._is_over = False, True
        self._key_indices = group_indices_by_key(
            [FLAT_KEY] * len(self.core.setup.fields) if flat else self._observation_keys()
        )
        self.fields: dict[str, tuple[ObservationField, ...]] = {
            key: tuple(self.core.setup.fields[i] for i in places) for key, places in self._key_indices.items()
        }
        self._stage: TaskRenderer | None = None
        self._physics: Physics | None = None

    def _observation_keys(self) -> list[str]:
        return [field.name.partition(".")[0] for field in self.core.setup.fields]

    def reset(self) -> dm_env.TimeStep:
        """Start an episode; the first one uses the seed, the others continue its random stream."""
        self.core.reset(None if self._is_started else np.array([self._seed]))
        self._is_started, self._is_over = True, False
        return dm_env.restart(self._grouped_observation())

    def step(self, action: np.ndarray) -> dm_env.TimeStep:
        """Advance by one step, or start a new episode without using the action if the last one is over.

        Args:
            action: (a,); values outside +-1 are clipped.

        Returns:
            The time step; its discount is 0 if the task terminated, and 1 if it was truncated.

        Raises:
            ValueError: the action has the wrong shape, or is not finite.
        """
        if self._is_over:
            return self.reset()
        core = self.core
        core.step_single(action)
        reward, seen = float(core.reward[0]), self._grouped_observation()
        self._is_over = bool(core.terminated[0] or core.truncated[0])
        if core.terminated[0]:
            return dm_env.termination(reward, seen)
        return dm_env.truncation(reward, seen) if self._is_over else dm_env.transition(reward, seen)

    def get_state(self) -> SavedState:
        """Return a copy of the complete state, for `set_state` of this or an equal environment."""
        return self.core.get_state()

    def set_state(self, state: SavedState) -> collections.OrderedDict[str, np.ndarray]:
        """Continue from a saved state, see `MachineEnv.set_state`, and return the observation in this state."""
        self.core.set_state(state)
        self._is_started, self._is_over = True, bool(self.core.terminated[0] or self.core.truncated[0])
        return self._grouped_observation()

    def _grouped_observation(self) -> collections.OrderedDict[str, np.ndarray]:
        return split_by_key(self.core.observation[0], self._key_indices)

    def observation_spec(self) -> collections.OrderedDict[str, specs.BoundedArray]:
        """Return the specifications of the observations, key -> shape and bounds in SI units.

        Observations saturate at the bounds. The attribute `fields` names the values of each key.
        """
        low, high = (
            split_by_key(ends, self._key_indices) for ends in (self.core.observation_low, self.core.observation_high)
        )
        return collections.OrderedDict(
            (key, specs.BoundedArray(low[key].shape, np.float32, low[key], high[key], key)) for key in self._key_indices
        )

    def action_spec(self) -> specs.BoundedArray:
        """Return the specification of the action, (a,) from -1 to 1; its name lists the actions, separated by tabs."""
        name, count = "\t".join(self.core.action_names), len(self.core.action_names)
        return specs.BoundedArray((count,), np.float32, -1.0, 1.0, name)

    def control_timestep(self) -> float:
        """Return the time between environment steps [s]."""
        return 1.0 / self.core.setup.options.control_rate

    def last_info(self) -> dict[str, Any]:
        """Return the `info` of the last step: task measures, machine variant, and whether the simulation failed."""
        return {name: values[0] for name, values in make_info(self.core).items()}

    def render(self, height: int = 240, width: int = 320, camera_id: Camera = FREE_CAMERA) -> np.ndarray:
        """Render the machine and its goal.

        Args:
            height: [pixel].
            width: [pixel].
            camera_id: name or number of a camera of the machine, or -1 for a free camera that shows
                the whole workspace of the arm.

        Returns:
            (height, width, 3) uint8.

        Raises:
            InputError: the camera does not exist, or OpenGL does not work.
        """
        return self._get_renderer().render(0, width, height, camera_id)

    def _get_renderer(self) -> TaskRenderer:
        if self._stage is None:
            self._stage = TaskRenderer(self.core)
        return self._stage

    @property
    def physics(self) -> "Physics":
        """dm_control physics of the current state, with visual geometry, for dm_control's viewer and wrappers.

        It is a copy: changes to it do not affect the simulation.
        """
        stage = self._get_renderer()
        if self._physics is None:
            self._physics = Physics.from_model(wrapper.MjModel(stage.model))
            self._physics.stage = stage
        stage.update()
        mujoco.mj_copyData(self._physics.data.ptr, stage.model, stage.data)
        return self._physics

    def __reduce__(self):
        """Raise TypeError: the simulations can be neither copied nor pickled."""
        return self.core.__reduce__()

    def close(self) -> None:
        """Close the renderer and free the memory of the simulation."""
        if self._physics is not None:
            self._physics.free()
        if self._stage:
            self._stage.close()
        self._physics = self._stage = None
        self.core.close()


class Physics(engine.Physics):
    """dm_control physics of an environment, whose `render` also draws the goal."""

    stage: TaskRenderer

    def render(self, height: int = 240, width: int = 320, camera_id: Any = FREE_CAMERA, **asked: Any) -> np.ndarray:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Render like the environment, or with dm_control if further options are given.

        Args:
            height: [pixel].
            width: [pixel].
            camera_id: see `MachineEnvironment.render`.
            **asked: overlays, depth, segmentation and other options of
                `dm_control.mujoco.Physics.render`; these need MUJOCO_GL to name a working OpenGL.

        Returns:
            (height, width, 3) uint8, or the result of dm_control.

        Raises:
            InputError: the camera does not exist, or OpenGL does not work.
        """
        if any(value not in (None, False, ()) for value in asked.values()):
            return super().render(height, width, camera_id, **asked)
        return self.stage.render(0, width, height, camera_id)


def group_indices_by_key(keys: list[str]) -> collections.OrderedDict[str, np.ndarray]:
    """Return distinct key -> indices at which the key occurs in the list, in order of first occurrence."""
    places: collections.OrderedDict[str, list[int]] = collections.OrderedDict()
    for place, key in enumerate(keys):
        places.setdefault(key, []).append(place)
    return collections.OrderedDict((key, np.array(some)) for key, some in places.items())


def split_by_key(values: np.ndarray, places: Mapping[str, np.ndarray]) -> collections.OrderedDict[str, np.ndarray]:
    """Return key -> copy of the values of this key.

    `places` holds, for every key, the indices of its values in `values`.
    """
    return collections.OrderedDict((key, values[some]) for key, some in places.items())
