"""Show a simulated machine in MuJoCo's viewer window while it is driven."""

import threading
from collections.abc import Callable, Sequence

import mujoco
import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.show.offscreen_renderer import has_screen
from hydrotele.simulate.mechanism import compile_mechanism
from hydrotele.simulate.plant import Plant

_NO_SCREEN_ADVICE = "add --no-viewer and use --device gamepad, spacemouse or scripted:FILE"
_CLOSE_TIMEOUT = 5.0  # s, timeout for the last frame when the window is closed
_CAMERA_DISTANCE, _CAMERA_AZIMUTH, _CAMERA_ELEVATION = (
    14.0,
    120.0,
    -18.0,
)  # m, deg, deg, initial camera position


class Window:
    """MuJoCo viewer window that shows a plant simulated elsewhere, until the user or the program closes it."""

    def __init__(self, plant: Plant, pressed: Callable[[int], None] | None = None) -> None:
        """Open the window.

        Args:
            plant: simulated plant.
            pressed: callback for the GLFW code of each pressed key; runs in another thread.

        Raises:
            InputError: there is no screen, or OpenGL does not work on it.
        """
        check_screen()
        from mujoco import viewer

        self._model = compile_mechanism(plant.machine, ground=plant.ground, surroundings=plant.surroundings)
        assert self._model.nq == plant.model.nq
        self._data = mujoco.MjData(self._model)
        self._handle = viewer.launch_passive(
            self._model, self._data, key_callback=pressed, show_left_ui=False, show_right_ui=False
        )
        with self._handle.lock():
            camera = self._handle.cam
            camera.lookat[:] = 4.0, 0.0, 1.5
            camera.distance, camera.azimuth, camera.elevation = (
                _CAMERA_DISTANCE,
                _CAMERA_AZIMUTH,
                _CAMERA_ELEVATION,
            )

        self._newest: tuple[np.ndarray, Sequence[tuple[str, str]]] | None = None
        self._fresh, self._over = threading.Event(), False
        self._painter = threading.Thread(target=self._draw_frames, daemon=True)
        self._painter.start()

    def show(self, qpos: np.ndarray, rows: Sequence[tuple[str, str]]) -> bool:
        """Set the joint positions and the table of texts that the next frame of the window displays.

        Args:
            qpos: (nq,) joint positions [m], [rad]; they are copied.
            rows: (name, value) of each row of the table.

        Returns:
            False if the user has closed the window, else True.
        """
        if not self._handle.is_running():
            return False
        self._newest = qpos.copy(), rows
        self._fresh.set()
        return True

    def _draw_frames(self) -> None:
        """Draw the latest state in a loop, which runs in a separate thread so that a slow screen does not block."""
        while self._fresh.wait() and not self._over:
            self._fresh.clear()
            assert self._newest
            qpos, rows = self._newest
            with self._handle.lock():
                self._data.qpos[:] = qpos
                mujoco.mj_kinematics(self._model, self._data)
                mujoco.mj_comPos(self._model, self._data)
                mujoco.mj_camlight(self._model, self._data)
            names, values = ("\n".join(column) for column in zip(*rows, strict=True))
            self._handle.set_texts((None, mujoco.mjtGridPos.mjGRID_BOTTOMLEFT, names, values))
            self._handle.sync()

    def close(self) -> None:
        """Close the window, after waiting for the last frame for at most 5 s."""
        self._over = True
        self._fresh.set()
        self._painter.join(_CLOSE_TIMEOUT)
        self._handle.close()


def check_screen(advice: str = _NO_SCREEN_ADVICE) -> None:
    """Check that a window can be opened, because MuJoCo's viewer hangs without a screen.

    The check opens an invisible window and closes it.

    Args:
        advice: advice for the error message.

    Raises:
        InputError: no window can be opened.
    """
    if not has_screen():
        raise InputError("viewer", f"there is no screen (DISPLAY is not set); {advice}")
    import glfw

    if not glfw.init():
        raise InputError("viewer", f"the screen cannot be used; {advice}")
    glfw.window_hint(glfw.VISIBLE, glfw.FALSE)
    window = glfw.create_window(8, 8, "", None, None)
    glfw.default_window_hints()
    if not window:
        raise InputError("viewer", f"OpenGL does not work on this screen; {advice}")
    glfw.destroy_window(window)
