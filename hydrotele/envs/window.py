"""A task in MuJoCo's window, as fast as its own time runs."""

import atexit
import threading
import time

from hydrotele.envs.stage import Camera, Stage
from hydrotele.show.markers import write_markers

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
