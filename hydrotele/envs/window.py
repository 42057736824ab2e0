"""A task in MuJoCo's window, as fast as its own time runs."""

import time

import mujoco

from hydrotele.envs.stage import Camera, Stage
from hydrotele.show.markers import write_markers

ADVICE = (
    "use render_mode='rgb_array', which needs none, or make a screen up: xvfb-run -a python ..."
)


class TaskWindow:
    """A passive viewer of the first simulation of a task; the user may close it.

    Where there is no screen MuJoCo's viewer hangs: `show.window.check_screen` comes before.
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

        self._stage, self._period, self._next = stage, 1.0 / rate, 0.0
        stage.show()
        self._handle = viewer.launch_passive(
            stage.model, stage.data, show_left_ui=False, show_right_ui=False
        )
        with self._handle.lock():
            for name in ("type", "fixedcamid", "distance", "azimuth", "elevation"):
                setattr(self._handle.cam, name, getattr(view, name))
            self._handle.cam.lookat[:] = view.lookat

    def show(self) -> None:
        """Show the task as it stands now, not before its time; nothing once the user closed it."""
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
        """Close it."""
        self._handle.close()
