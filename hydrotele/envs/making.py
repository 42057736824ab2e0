"""Environments of gymnasium: from the keywords of `make` and `make_vec` to tasks that run.

One environment, which MuJoCo's window can show as fast as its own time runs; and thousands of them
that one native call steps on a pool of threads.
"""

import atexit
import dataclasses
import threading
import time
from typing import Any, get_type_hints

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
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
from hydrotele.envs.stage import Camera, Stage
from hydrotele.envs.task import Options, Task
from hydrotele.envs.track import track_fields
from hydrotele.machine.machine import Machine
from hydrotele.show.canvas import write_markers
from hydrotele.show.window import check_screen


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


ADVICE = (
    "use render_mode='rgb_array', which needs none, or make a screen up: xvfb-run -a python ..."
)
_PATIENCE = 5.0  # s that MuJoCo's viewer may take to close its window
_OPEN: list["TaskWindow"] = []  # at most one: GLFW, which draws it, is for one thread only


class TaskWindow:
    """A passive viewer of the first simulation of a task; the user may close it.

    A process has one of them: opening another closes the last. Where there is no screen MuJoCo's
    viewer hangs: `show.window.check_screen` comes before.
    """

    def __init__(self, stage: Stage, camera: Camera, rate: float) -> None:
        """Open it.

        Args:
            stage: what is seen.
            camera: as of `Stage.camera`; the user may choose another one.
            rate: pictures per second of the task's time [Hz].

        Raises:
            InputError: there is no such camera.
        """
        view = stage.camera(camera)
        from mujoco import viewer

        for other in tuple(_OPEN):
            other.close()
        self._stage, self._period, self._next = stage, 1.0 / rate, 0.0
        stage.show()
        before = set(threading.enumerate())
        self._handle = viewer.launch_passive(
            stage.model, stage.data, show_left_ui=False, show_right_ui=False
        )
        self._threads = set(threading.enumerate()) - before
        _OPEN.append(self)
        atexit.register(self.close)
        with self._handle.lock():
            for name in ("type", "fixedcamid", "distance", "azimuth", "elevation"):
                setattr(self._handle.cam, name, getattr(view, name))
            self._handle.cam.lookat[:] = view.lookat

    def show(self) -> None:
        """Show the task as it stands now, not before its time; nothing once it was closed."""
        if not self._handle.is_running():
            return
        with self._handle.lock():
            self._stage.show()
            scene = self._handle.user_scn
            assert scene is not None
            scene.ngeom = 0
            write_markers(scene, self._stage.markers())
        self._handle.sync()
        now = time.monotonic()
        self._next = max(self._next + self._period, now)
        time.sleep(self._next - now)

    def close(self) -> None:
        """Close it, and wait until it is: Python must not take GLFW down before."""
        if self in _OPEN:
            _OPEN.remove(self)
            atexit.unregister(self.close)
            self._handle.close()
            for thread in self._threads:
                thread.join(_PATIENCE)


class MachineEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """A control task on a simulated machine.

    Attributes:
        core: the running task: machine, axes, fields of the observation with units, variants.
        observation_space: (o,) float32 in SI; what each number is: `core.setup.fields`.
        action_space: (a,) float32 from -1 to 1; what each number moves: `core.coordinates`.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array", "human"], "render_fps": 50}

    def __init__(
        self, task: str, render_mode: str | None = None, width: int = 640, height: int = 480,
        camera: Camera = None, **options: Any,
    ) -> None:  # fmt: skip
        """Compile the machine.

        Args:
            task: name of the task, as in `hydrotele/<Name>-v0`.
            render_mode: None, `rgb_array` for pictures, or `human` for a window.
            width: of pictures [pixel].
            height: of pictures [pixel].
            camera: a camera of the machine, such as `overview`, `side` or `cab`; without, one that
                shows all that its arm reaches.
            **options: fields of `hydrotele.envs.task.Options`.

        Raises:
            InputError: an option is not known or does not suit, or there is no screen for a window.
        """
        check_mode(render_mode, self.metadata["render_modes"])
        if render_mode == "human":
            check_screen(ADVICE)
        self.core = make_core(task, options, 1, 1, DISABLED)
        self.metadata = with_rate(self.metadata, self.core)
        self.render_mode, self._view = render_mode, (width, height, camera)
        self._stage: Stage | None = None
        self._window: TaskWindow | None = None
        self.observation_space = observation_space(self.core)
        self.action_space = action_space(self.core)
        self._begun = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode: a variant, and a goal, drawn from the seed or what came of it.

        Args:
            seed: integer >= 0; without one, random numbers go on.
            options: none.

        Returns:
            (observation (o,), info).
        """
        super().reset(seed=seed)
        if seed is None and not self._begun:
            seed = int(self.np_random.integers(2**62))
        self._begun = True
        self.core.reset(None if seed is None else np.array([seed]))
        self._show()
        return self.core.observation[0].copy(), self._info()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Go on by one step.

        Args:
            action: (a,); beyond +-1 it counts as full.

        Returns:
            (observation (o,), reward, terminated, truncated, info).

        Raises:
            ValueError: the action has another shape, or is not a finite number.
        """
        core = self.core
        core.step_one(action)
        self._show()
        return (
            core.observation[0].copy(), float(core.reward[0]), bool(core.terminated[0]),
            bool(core.truncated[0]), self._info(),
        )  # fmt: skip

    def _info(self) -> dict[str, Any]:
        return {name: values[0] for name, values in info_of(self.core).items()}

    def render(self) -> np.ndarray | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Draw the machine and its goal.

        Returns:
            (height, width, 3) uint8, or None where no pictures were asked for: a window shows
            every step by itself.

        Raises:
            InputError: there is no such camera, or no OpenGL works (says what to do).
        """
        if self.render_mode != "rgb_array":
            if self.render_mode is None:
                gymnasium.logger.warn("render() shows nothing without render_mode='rgb_array'")
            return None
        width, height, camera = self._view
        return self._staged().picture(0, width, height, camera)

    def _staged(self) -> Stage:
        if self._stage is None:
            self._stage = Stage(self.core)
        return self._stage

    def _show(self) -> None:
        """Show this step where there is a window."""
        if self.render_mode != "human":
            return
        if self._window is None:
            self._window = TaskWindow(self._staged(), self._view[2], self.metadata["render_fps"])
        self._window.show()

    def close(self) -> None:
        """Close what shows the simulation, and give its memory back."""
        if self._window:
            self._window.close()
        if self._stage:
            self._stage.close()
        self._stage = self._window = None
        self.core.close()


class MachineVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """n environments of a task; each is, bit for bit, the single one of its seed.

    Attributes:
        core: the running task.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}

    def __init__(
        self, task: str, num_envs: int = 1, render_mode: str | None = None, threads: int = 0,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP, width: int = 640,
        height: int = 480, camera: Camera = None, shown: int | None = None, **options: Any,
    ) -> None:  # fmt: skip
        """Compile the machines.

        Args:
            task: name of the task.
            num_envs: number of environments n.
            render_mode: None or `rgb_array`.
            threads: that step them; 0 for one per core. Results do not depend on it.
            autoreset_mode: of gymnasium.
            width: of pictures [pixel].
            height: of pictures [pixel].
            camera: a camera of the machine; without, one that shows all that its arm reaches.
            shown: number of environments, the first ones, that pictures are made of; without, all.
            **options: fields of `hydrotele.envs.task.Options`.

        Raises:
            InputError: an option is not known or does not suit.
        """
        check_mode(render_mode, self.metadata["render_modes"])
        mode = AutoresetMode(autoreset_mode)
        self.core = make_core(task, options, num_envs, threads, AUTORESET[mode.value])
        self.metadata = {**with_rate(self.metadata, self.core), "autoreset_mode": mode}
        self.num_envs, self.render_mode = num_envs, render_mode
        self.single_observation_space = observation_space(self.core)
        self.single_action_space = action_space(self.core)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._mode, self._begun = mode, False
        self._view: tuple[int, int, Camera] = width, height, camera
        self._stage: Stage | None = None
        self._shown = num_envs if shown is None else min(shown, num_envs)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin episodes.

        Args:
            seed: of the first environment, the others count up; or one each.
            options: `reset_mask` (n,) bool says which ones; all without.

        Returns:
            (observations (n, o), infos).

        Raises:
            ValueError: seeds or mask have a wrong length, or a seed is not usable.
            RuntimeError: the first reset leaves some out.
        """
        super().reset(seed=seed if isinstance(seed, int) else None)
        chosen = self._chosen(options)
        seeds = self._seeds(seed)
        if seeds is not None and chosen is not None:
            seeds = seeds[chosen]
        self.core.reset(seeds, chosen)
        return self.core.observation.copy(), self._infos(chosen)

    def _chosen(self, options: dict[str, Any] | None) -> np.ndarray | None:
        if not options or "reset_mask" not in options:
            return None
        mask = options["reset_mask"]
        if not (isinstance(mask, np.ndarray) and mask.dtype == np.bool_ and mask.any()
                and mask.shape == (self.num_envs,)):  # fmt: skip
            raise ValueError(f"reset_mask must be ({self.num_envs},) bool with a True in it")
        return np.flatnonzero(mask)

    def _seeds(self, seed: int | list[int | None] | None) -> np.ndarray | None:
        if seed is None and self._begun:
            return None
        self._begun = True
        if isinstance(seed, (int, np.integer)):
            return np.array([int(seed) + k for k in range(self.num_envs)])
        drawn = self.np_random.integers(2**62, size=self.num_envs)
        if seed is None:
            return drawn
        if len(seed) != self.num_envs:
            raise ValueError(f"{len(seed)} seeds for {self.num_envs} environments")
        return np.array([d if s is None else s for s, d in zip(seed, drawn, strict=True)])

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Go on by one step; environments whose episode ended begin a new one.

        Args:
            actions: (n, a); beyond +-1 they count as full.

        Returns:
            (observations (n, o), rewards (n,), terminations (n,), truncations (n,), infos).

        Raises:
            ValueError: the actions have another shape, or are not finite numbers.
        """
        core = self.core
        if np.shape(actions) != core.action.shape:
            raise ValueError(f"actions are {core.action.shape}, not {np.shape(actions)}")
        core.step(actions)
        infos = self._infos(None)
        over = (core.terminated | core.truncated).astype(bool)
        if self._mode is AutoresetMode.SAME_STEP and over.any():
            infos = self._with_final(infos, over)
        return (
            core.observation.copy(), core.reward.copy(), core.terminated.astype(bool),
            core.truncated.astype(bool), infos,
        )  # fmt: skip

    def _infos(self, chosen: np.ndarray | None) -> dict[str, Any]:
        there = np.zeros(self.num_envs, bool)
        there[slice(None) if chosen is None else chosen] = True
        return _masked(info_of(self.core), there)

    def _with_final(self, infos: dict[str, Any], over: np.ndarray) -> dict[str, Any]:
        """What the last steps of episodes ended with, beside the first of the new ones."""
        observations = np.full(self.num_envs, None, dtype=object)
        for number in np.flatnonzero(over):
            observations[number] = self.core.final[number].copy()
        last = _masked(info_of(self.core, final=True), over)
        final = {"final_obs": observations, "final_info": last}
        return infos | _masked(final, over)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Draw machines and their goals, one after the other.

        Returns:
            `shown` pictures (height, width, 3) uint8, or None without `render_mode`.

        Raises:
            InputError: there is no such camera, or no OpenGL works (says what to do).
        """
        if self.render_mode is None:
            gymnasium.logger.warn("render() shows nothing without render_mode='rgb_array'")
            return None
        if self._stage is None:
            self._stage = Stage(self.core)
        return tuple(self._stage.picture(n, *self._view) for n in range(self._shown))

    def close_extras(self, **kwargs: Any) -> None:
        """Give the simulations' memory back."""
        if self._stage:
            self._stage.close()
            self._stage = None
        self.core.close()


def _masked(infos: dict[str, Any], there: np.ndarray) -> dict[str, Any]:
    """The same with gymnasium's masks beside: whose figures they are."""
    return infos | {f"_{name}": there.copy() for name in infos}
