"""One environment for gymnasium.

A task in MuJoCo's window, as fast as its own time runs.
"""

import atexit
import threading
import time
from typing import Any

import gymnasium
import numpy as np

from hydrotele.envs.episode import DISABLED
from hydrotele.envs.making import (
    action_space,
    check_mode,
    info_of,
    make_core,
    observation_space,
    with_rate,
)
from hydrotele.envs.stage import Camera, Stage
from hydrotele.show.canvas import write_markers
from hydrotele.show.window import check_screen

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
