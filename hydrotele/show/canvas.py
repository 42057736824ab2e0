"""Pictures drawn in this process, one after the other, without a screen.

`mujoco.Renderer` draws with the OpenGL that was chosen when `mujoco` was imported, which on a
machine without a screen is one that cannot. A Canvas looks for one that works when it is opened.
"""

import importlib
import os
import sys
import warnings
from collections.abc import Sequence

import mujoco
import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.show.markers import Marker, write_markers

PACKAGES = "libegl1 and libgl1-mesa-dri, or libosmesa6"
_OFFSCREEN = ("egl", "osmesa")
_LARGEST = 8192  # pixel
_SHADOW = 4096  # pixel of the map of shadows at most
_MARKERS = 1000


class Canvas:
    """A place to draw models of one structure (their meshes are loaded once).

    Attributes:
        size: width and height [pixel].
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int) -> None:
        """Open OpenGL.

        Args:
            model: with its looks; the size of its offscreen buffer is written.
            width: of pictures [pixel].
            height: of pictures [pixel].

        Raises:
            InputError: the size is not possible, or no OpenGL works (says what to do).
        """
        self._gl = self._context = None
        for name, length in (("width", width), ("height", height)):
            if not 1 <= length <= _LARGEST:
                raise InputError(name, f"must be 1 to {_LARGEST} pixels, not {length}")
        self.size = width, height
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        # A shadow needs no more pixels than it is seen with.
        model.vis.quality.shadowsize = min(_SHADOW, 1 << (max(width, height) - 1).bit_length())
        self._gl, self._context = _open(model, width, height)
        self._scene = mujoco.MjvScene(model, model.ngeom + _MARKERS)
        self._option, self._rectangle = mujoco.MjvOption(), mujoco.MjrRect(0, 0, width, height)
        self._upright = np.empty((height, width, 3), np.uint8)

    def draw(
        self, model: mujoco.MjModel, data: mujoco.MjData, camera: mujoco.MjvCamera,
        markers: Sequence[Marker] = (),
    ) -> np.ndarray:  # fmt: skip
        """Draw a model as it stands.

        Args:
            model: with the structure of the one that the canvas was made for.
            data: its state, with up-to-date places of bodies.
            camera: where from.
            markers: drawn beside.

        Returns:
            (height, width, 3) uint8, a new array.
        """
        if self._gl is None or self._context is None:
            raise RuntimeError("the canvas is closed")
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(model, data, self._option, None, camera, everything, self._scene)
        write_markers(self._scene, markers)
        self._gl.make_current()
        mujoco.mjr_render(self._rectangle, self._scene, self._context)
        mujoco.mjr_readPixels(self._upright, None, self._rectangle, self._context)
        return self._upright[::-1].copy()

    def close(self) -> None:
        """Give OpenGL back."""
        context, gl, self._context, self._gl = self._context, self._gl, None, None
        if gl is not None:
            gl.make_current()
            if context is not None:
                context.free()
            gl.free()

    def __del__(self) -> None:
        """Close at the latest when nobody holds it."""
        if sys.meta_path is not None:  # at the end of Python the drivers are gone already
            self.close()


def has_screen() -> bool:
    """Whether there may be a screen to open windows on."""
    seen = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
    return seen or not sys.platform.startswith("linux")


def _open(model: mujoco.MjModel, width: int, height: int):
    """OpenGL and MuJoCo's part in it, of the first driver that works."""
    reasons = []
    for name in _candidates():
        gl = None
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of GLFW without a screen; the next one is tried
                gl = importlib.import_module(f"mujoco.{name}").GLContext(width, height)
                gl.make_current()
            context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
            mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, context)
            return gl, context
        except Exception as error:  # drivers fail in every way there is
            reasons.append(f"{name}: {error}")
            if gl is not None:
                gl.free()
    raise InputError(
        "picture",
        "OpenGL cannot draw without a screen; install its software drivers"
        f" (Debian: {PACKAGES}), or choose another with MUJOCO_GL=egl or MUJOCO_GL=osmesa in the"
        f" environment. {'; '.join(reasons)}",
    )


def _candidates() -> tuple[str, ...]:
    wanted = os.environ.get("MUJOCO_GL", "").lower()
    if wanted in _OFFSCREEN:
        return (wanted,)
    if sys.platform == "darwin":
        return ("cgl", "glfw")
    return ("egl", "glfw") if has_screen() else ("egl",)  # GLFW is for one thread only
