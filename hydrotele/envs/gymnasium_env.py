"""Gymnasium environments: the entry points of `make` and `make_vec`.

`MachineEnv` is a single environment, which MuJoCo's viewer can show in real time.
`MachineVectorEnv` is a batch of environments, which one native call steps on a pool of threads.
"""

import atexit
import threading
import time
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from hydrotele.core.errors import InputError
from hydrotele.envs.episode import DISABLED, NEXT_STEP, SAME_STEP
from hydrotele.envs.episode_batch import TaskCore
from hydrotele.envs.rendering import Camera, TaskRenderer
from hydrotele.envs.saved_state import SavedState
from hydrotele.envs.task_catalogue import make_task_core
from hydrotele.show.live_window import check_screen
from hydrotele.show.offscreen_renderer import add_markers_to_scene

AUTORESET_MODES = {"NextStep": NEXT_STEP, "SameStep": SAME_STEP, "Disabled": DISABLED}


def make_observation_space(core: TaskCore) -> Box:
    """Return the observation space, (o,) float32 in SI units; observations are clipped to its bounds."""
    return Box(core.observation_low, core.observation_high, dtype=np.float32)


def make_action_space(core: TaskCore) -> Box:
    """Return the action space, (a,) float32 from -1 to 1."""
    return Box(-1.0, 1.0, (len(core.setup.axes),), np.float32)


def make_info(core: TaskCore, final: bool = False) -> dict[str, np.ndarray]:
    """Return the `info` of the last step: task measures, index of the machine variant, and fault.

    Args:
        core: the running task.
        final: whether to return, for episodes that ended and were reset in this step, the values at
            their end instead of those of the new episodes.

    Returns:
        Name -> (n,) values; `fault` is True if the simulation became unstable.
    """
    told, which = core.setup.task.measures, "last_" if final else ""
    figures = core.final_measures if final else core.measures
    info = {name: figures[:, i].copy() for i, (name, _) in enumerate(told)}
    info["variant"] = core.episodes[f"{which}variant"].copy()
    info["fault"] = core.episodes[f"{which}fault"] != 0
    return info


def check_render_mode(mode: str | None, known: list[str]) -> None:
    """Check that a render mode exists.

    Raises:
        InputError: the mode is not in the list.
    """
    if mode is not None and mode not in known:
        raise InputError(f"render_mode {mode!r}", f"choose one of {', '.join(known)}, or leave it out")


def add_render_fps(metadata: dict[str, Any], core: TaskCore) -> dict[str, Any]:
    """Return a copy of the metadata with `render_fps` set to the environment steps per second [Hz]."""
    rate = core.setup.options.control_rate
    return {**metadata, "render_fps": int(rate) if rate == int(rate) else rate}


NO_SCREEN_ADVICE = "use render_mode='rgb_array', which needs no screen, or a virtual one: xvfb-run -a python ..."
_CLOSE_TIMEOUT = 5.0  # s, maximum time to wait for MuJoCo's viewer to close
_OPEN_WINDOWS: list["TaskWindow"] = []  # at most one: GLFW supports one thread only


class TaskWindow:
    """A window with MuJoCo's passive viewer of the first simulation of a task; the user may close it.

    A process has at most one viewer; opening another closes the first. Call
    `show.live_window.check_screen` before, since MuJoCo's viewer hangs without a screen.
    """

    def __init__(self, stage: TaskRenderer, camera: Camera, rate: float) -> None:
        """Open the viewer.

        Args:
            stage: renderer of the task, whose model and data are shown.
            camera: see `TaskRenderer.find_camera`; the user may select another one in the viewer.
            rate: frames per second of simulated time [Hz].

        Raises:
            InputError: the camera does not exist.
        """
        view = stage.find_camera(camera)
        from mujoco import viewer

        for other in tuple(_OPEN_WINDOWS):
            other.close()
        self._stage, self._period, self._next_time = stage, 1.0 / rate, 0.0
        stage.update()
        before = set(threading.enumerate())
        self._viewer = viewer.launch_passive(stage.model, stage.data, show_left_ui=False, show_right_ui=False)
        self._threads = set(threading.enumerate()) - before
        _OPEN_WINDOWS.append(self)
        atexit.register(self.close)
        with self._viewer.lock():
            for name in ("type", "fixedcamid", "distance", "azimuth", "elevation"):
                setattr(self._viewer.cam, name, getattr(view, name))
            self._viewer.cam.lookat[:] = view.lookat

    def show(self) -> None:
        """Show the current state and the markers of the goal, then wait until the next frame is due in real time.

        If the user has closed the viewer, nothing is done.
        """
        if not self._viewer.is_running():
            return
        with self._viewer.lock():
            self._stage.update()
            scene = self._viewer.user_scn
            assert scene is not None
            scene.ngeom = 0
            add_markers_to_scene(scene, self._stage.make_markers())
        self._viewer.sync()
        now = time.monotonic()
        self._next_time = max(self._next_time + self._period, now)
        time.sleep(self._next_time - now)

    def close(self) -> None:
        """Close the viewer and wait until its threads have ended.

        This must happen before Python unloads the window library GLFW.
        """
        if self in _OPEN_WINDOWS:
            _OPEN_WINDOWS.remove(self)
            atexit.unregister(self.close)
            self._viewer.close()
            for thread in self._threads:
                thread.join(_CLOSE_TIMEOUT)


class MachineEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """Gymnasium environment of a control task on a simulated machine.

    Attributes:
        core: the running task with machine, axes, observation fields and variants.
        observation_space: (o,) float32 in SI units; `core.setup.fields` names the values.
        action_space: (a,) float32 from -1 to 1; `core.action_names` names the actions.

    Examples:
        >>> import gymnasium
        >>> import hydrotele.envs
        >>> env = gymnasium.make("hydrotele/TrackTrajectory-v0", variants=1)
        >>> observation, info = env.reset(seed=1)
        >>> env.observation_space.shape, env.action_space.shape
        ((35,), (3,))
        >>> for _ in range(50):  # one second without any command: the arm stays, and the references move on
        ...     observation, reward, terminated, truncated, info = env.step([0.0, 0.0, 0.0])
        >>> sorted(info)
        ['fault', 'tip_error', 'variant']
        >>> bool(info["tip_error"] > 0.1)  # m
        True

        A saved state continues with the same bits.

        >>> saved = env.unwrapped.get_state()
        >>> once = env.step([0.5, 0.0, 0.0])[0]
        >>> _ = env.unwrapped.set_state(saved)
        >>> bool((env.step([0.5, 0.0, 0.0])[0] == once).all())
        True
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array", "human"], "render_fps": 50}

    def __init__(
        self, task: Any, render_mode: str | None = None, width: int = 640, height: int = 480,
        camera: Camera = None, **options: Any,
    ) -> None:  # fmt: skip
        """Create the environment: compile the machine variants and define observation and action space.

        Args:
            task: name of the task, as in `hydrotele/<Name>-v0`, or a class or object of `PythonTask`.
            render_mode: None, `rgb_array` for images, or `human` for a window.
            width: width of images [pixel].
            height: height of images [pixel].
            camera: a camera of the machine, such as `overview`, `side` or `cab`; None for a free
                camera that shows the whole workspace of the arm.
            **options: fields of `hydrotele.envs.task.Options`.

        Raises:
            InputError: an option does not exist or is not valid, or there is no screen for a
                window.
        """
        check_render_mode(render_mode, self.metadata["render_modes"])
        if render_mode == "human":
            check_screen(NO_SCREEN_ADVICE)
        self.core = make_task_core(task, options, 1, 1, DISABLED)
        self.metadata = add_render_fps(self.metadata, self.core)
        self.render_mode, self._image_settings = render_mode, (width, height, camera)
        self._stage: TaskRenderer | None = None
        self._window: TaskWindow | None = None
        self.observation_space = make_observation_space(self.core)
        self.action_space = make_action_space(self.core)
        self._is_started = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode with a random machine variant and a random goal.

        Args:
            seed: seed of the random stream, an integer >= 0; None continues the stream, or starts a
                random one in the first call.
            options: not used.

        Returns:
            (observation (o,), info).
        """
        super().reset(seed=seed)
        if seed is None and not self._is_started:
            seed = int(self.np_random.integers(2**62))
        self._is_started = True
        self.core.reset(None if seed is None else np.array([seed]))
        self._show_step()
        return self.core.observation[0].copy(), self._make_info()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advance by one step.

        Args:
            action: (a,); values outside +-1 are clipped.

        Returns:
            (observation (o,), reward, terminated, truncated, info).

        Raises:
            ValueError: the action has the wrong shape, or is not finite.
            RuntimeError: the episode is over.
        """
        core = self.core
        if core.terminated[0] or core.truncated[0]:
            raise RuntimeError("the episode is over: call reset() before the next step")
        core.step_single(action)
        self._show_step()
        return (
            core.observation[0].copy(), float(core.reward[0]), bool(core.terminated[0]),
            bool(core.truncated[0]), self._make_info(),
        )  # fmt: skip

    def get_state(self) -> SavedState:
        """Return a copy of the complete state, for `set_state` of this or an equal environment."""
        return self.core.get_state()

    def set_state(self, state: SavedState) -> np.ndarray:
        """Continue from a saved state; the next steps give the same bits as they did after `get_state`.

        Args:
            state: of one episode of an environment with the same task, machine and options, single or batched.

        Returns:
            (o,) the observation in this state.

        Raises:
            InputError: the state belongs to another environment, or has several episodes.
        """
        self.core.set_state(state)
        self._is_started = True
        self._show_step()
        return self.core.observation[0].copy()

    def _make_info(self) -> dict[str, Any]:
        return {name: values[0] for name, values in make_info(self.core).items()}

    def render(self) -> np.ndarray | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Render the machine and its goal.

        Returns:
            (height, width, 3) uint8 with `render_mode="rgb_array"`, otherwise None: a window shows
            every step automatically.

        Raises:
            InputError: the camera does not exist, or OpenGL does not work.
        """
        if self.render_mode != "rgb_array":
            if self.render_mode is None:
                gymnasium.logger.warn("render() returns None without render_mode='rgb_array'")
            return None
        width, height, camera = self._image_settings
        return self._get_renderer().render(0, width, height, camera)

    def _get_renderer(self) -> TaskRenderer:
        if self._stage is None:
            self._stage = TaskRenderer(self.core)
        return self._stage

    def _show_step(self) -> None:
        """Show the current step in the window if `render_mode` is "human"."""
        if self.render_mode != "human":
            return
        if self._window is None:
            self._window = TaskWindow(self._get_renderer(), self._image_settings[2], self.metadata["render_fps"])
        self._window.show()

    def __reduce__(self):
        """Raise TypeError: the simulations can be neither copied nor pickled."""
        return self.core.__reduce__()

    def close(self) -> None:
        """Close the window and the renderer, and free the memory of the simulation."""
        if self._window:
            self._window.close()
        if self._stage:
            self._stage.close()
        self._stage = self._window = None
        self.core.close()


class MachineVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Gymnasium vector environment with n environments of a task.

    Each environment gives bit for bit the same values as a single environment with the same seed.

    Attributes:
        core: the running task.

    Examples:
        Each environment of a batch gives the values of a single environment with its seed.

        >>> import gymnasium
        >>> import numpy as np
        >>> import hydrotele.envs
        >>> envs = gymnasium.make_vec("hydrotele/TrackTrajectory-v0", 4, "vector_entry_point", variants=2)
        >>> env = gymnasium.make("hydrotele/TrackTrajectory-v0", variants=2)
        >>> observations, infos = envs.reset(seed=5)  # seeds 5, 6, 7, 8
        >>> observations.shape, bool((observations[2] == env.reset(seed=7)[0]).all())
        ((4, 35), True)
        >>> observations, rewards, *_ = envs.step(np.full((4, 3), 0.3))
        >>> bool(rewards[2] == env.step([0.3, 0.3, 0.3])[1])
        True
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}

    def __init__(
        self, task: Any, num_envs: int = 1, render_mode: str | None = None, threads: int = 0,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP, width: int = 640,
        height: int = 480, camera: Camera = None, render_count: int | None = None, **options: Any,
    ) -> None:  # fmt: skip
        """Create the environments: compile the machine variants and define observation and action spaces.

        Args:
            task: name of the task, or a class or object of `PythonTask`.
            num_envs: number of environments n.
            render_mode: None or `rgb_array`.
            threads: number of threads that step the environments; 0 for one per core. Results do
                not depend on it.
            autoreset_mode: mode of gymnasium that says when an environment whose episode ended is
                reset.
            width: width of images [pixel].
            height: height of images [pixel].
            camera: a camera of the machine; None for a free camera that shows the whole workspace
                of the arm.
            render_count: number of environments to render, from the first one; None for all.
            **options: fields of `hydrotele.envs.task.Options`.

        Raises:
            InputError: an option does not exist or is not valid.
        """
        check_render_mode(render_mode, self.metadata["render_modes"])
        mode = AutoresetMode(autoreset_mode)
        self.core = make_task_core(task, options, num_envs, threads, AUTORESET_MODES[mode.value])
        self.metadata = {**add_render_fps(self.metadata, self.core), "autoreset_mode": mode}
        self.num_envs, self.render_mode = num_envs, render_mode
        self.single_observation_space = make_observation_space(self.core)
        self.single_action_space = make_action_space(self.core)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._autoreset_mode, self._is_started = mode, False
        self._image_settings: tuple[int, int, Camera] = width, height, camera
        self._stage: TaskRenderer | None = None
        self._render_count = num_envs if render_count is None else min(render_count, num_envs)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start new episodes in all environments, or in those that a mask selects.

        Args:
            seed: seed of the first environment, to which the others add their index; or one seed
                per environment. None continues the random stream of each environment.
            options: `reset_mask` (n,) bool selects the environments; all without it.

        Returns:
            (observations (n, o), infos).

        Raises:
            ValueError: seeds or mask have the wrong length, or a seed is not valid.
            RuntimeError: the first reset does not include all environments.
        """
        super().reset(seed=seed if isinstance(seed, int) else None)
        chosen = self._parse_reset_mask(options)
        seeds = self._seeds(seed)
        if seeds is not None and chosen is not None:
            seeds = seeds[chosen]
        self.core.reset(seeds, chosen)
        self._is_started = True
        if self.core.is_on_device:
            return self.core.observation, self._device_infos()
        return self.core.observation.copy(), self._make_infos(chosen)

    def _device_infos(self) -> dict[str, Any]:
        """Return the task measures (n, MAX_MEASURES), and final observations of an autoreset in the same step."""
        core = self.core
        if self._autoreset_mode is not AutoresetMode.SAME_STEP:
            return {"measures": core.measures}
        return {"measures": core.measures, "final_obs": core.final_observation, "final_measures": core.final_measures}

    def _parse_reset_mask(self, options: dict[str, Any] | None) -> np.ndarray | None:
        if not options or "reset_mask" not in options:
            return None
        mask = options["reset_mask"]
        if not (isinstance(mask, np.ndarray) and mask.dtype == np.bool_ and mask.any()
                and mask.shape == (self.num_envs,)):  # fmt: skip
            raise ValueError(f"reset_mask must be ({self.num_envs},) bool with at least one True")
        return np.flatnonzero(mask)

    def _seeds(self, seed: int | list[int | None] | None) -> np.ndarray | None:
        if seed is None and self._is_started:
            return None
        if isinstance(seed, (int, np.integer)):
            return np.array([int(seed) + k for k in range(self.num_envs)])
        drawn = self.np_random.integers(2**62, size=self.num_envs)
        if seed is None:
            return drawn
        if len(seed) != self.num_envs:
            raise ValueError(f"{len(seed)} seeds for {self.num_envs} environments")
        return np.array([d if s is None else s for s, d in zip(seed, drawn, strict=True)])

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advance all environments by one step; those whose episode ended are reset as the autoreset mode says.

        Args:
            actions: (n, a); values outside +-1 are clipped.

        Returns:
            (observations (n, o), rewards (n,), terminations (n,), truncations (n,), infos). With `device="cuda"`
            they are arrays of the device that the next step overwrites, the ends as uint8; see
            `hydrotele.batch.as_dlpack`.

        Raises:
            ValueError: the actions have the wrong shape, or are not finite.
        """
        core = self.core
        if np.shape(actions) != core.action.shape:
            raise ValueError(f"actions must be {core.action.shape}, not {np.shape(actions)}")
        core.step(actions)
        if core.is_on_device:
            return core.observation, core.reward, core.terminated, core.truncated, self._device_infos()
        infos = self._make_infos(None)
        over = (core.terminated | core.truncated).astype(bool)
        if self._autoreset_mode is AutoresetMode.SAME_STEP and over.any():
            infos = self._add_final_infos(infos, over)
        return (
            core.observation.copy(), core.reward.copy(), core.terminated.astype(bool),
            core.truncated.astype(bool), infos,
        )  # fmt: skip

    def get_state(self, index: Any = None) -> SavedState:
        """Return a copy of the complete state of the environments `index` (None: all)."""
        return self.core.get_state(index)

    def set_state(self, state: SavedState, index: Any = None) -> np.ndarray:
        """Continue from a saved state; the next steps give the same bits as they did after `get_state`.

        Args:
            state: state of as many episodes as are set, or of one that is written to all of them: an environment,
                single or batched, with the same task, machine and options has returned it.
            index: indices of the environments to set, None for all.

        Returns:
            (n, o) the observations of all environments.

        Raises:
            InputError: the state belongs to another environment, or has another number of episodes.
        """
        self.core.set_state(state, index)
        self._is_started = True
        return self.core.observation if self.core.is_on_device else self.core.observation.copy()

    def _make_infos(self, chosen: np.ndarray | None) -> dict[str, Any]:
        there = np.zeros(self.num_envs, bool)
        there[slice(None) if chosen is None else chosen] = True
        return _add_validity_masks(make_info(self.core), there)

    def _add_final_infos(self, infos: dict[str, Any], over: np.ndarray) -> dict[str, Any]:
        """Return `infos` with the final observations and final infos of the episodes that were reset in this step.

        `over` (n,) is True for these episodes.
        """
        observations = np.full(self.num_envs, None, dtype=object)
        for number in np.flatnonzero(over):
            observations[number] = self.core.final_observation[number].copy()
        last = _add_validity_masks(make_info(self.core, final=True), over)
        final = {"final_obs": observations, "final_info": last}
        return infos | _add_validity_masks(final, over)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Render the machines and their goals.

        Returns:
            `render_count` images (height, width, 3) uint8, or None without `render_mode`.

        Raises:
            InputError: the camera does not exist, or OpenGL does not work.
        """
        if self.render_mode is None:
            gymnasium.logger.warn("render() returns None without render_mode='rgb_array'")
            return None
        if self._stage is None:
            self._stage = TaskRenderer(self.core)
        return tuple(self._stage.render(n, *self._image_settings) for n in range(self._render_count))

    def __reduce__(self):
        """Raise TypeError: the simulations can be neither copied nor pickled."""
        return self.core.__reduce__()

    def close_extras(self, **kwargs: Any) -> None:
        """Close the renderer and free the memory of the simulations."""
        if self._stage:
            self._stage.close()
            self._stage = None
        self.core.close()


def _add_validity_masks(infos: dict[str, Any], mask: np.ndarray) -> dict[str, Any]:
    """Return `infos` with a mask added for every entry.

    The entry `name` gets the mask `_name`, (n,) bool: a copy of `mask`, True for the environments
    for which the entry is valid.
    """
    return infos | {f"_{name}": mask.copy() for name in infos}
