"""Pictures drawn in this process, one after the other, without a screen.

`mujoco.Renderer` draws with the OpenGL that was chosen when `mujoco` was imported, which on a
machine without a screen is one that cannot. A Canvas looks for one that works when it is opened.
Markers are balls, lines and arrows that are drawn into a scene and are no part of a model.
"""

import importlib
import os
import sys
import warnings
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from hydrotele.core.errors import InputError

_GLOW = 0.4
_Geom = mujoco.mjtGeom


class Marker(NamedTuple):
    """One shape.

    Attributes:
        shape: of MuJoCo.
        start: (3,) its middle, or where it begins [m].
        end: (3,) where it ends [m]; None for a shape that has a middle.
        size: (3,) of MuJoCo's shape, or (1,) radius of a line [m].
        colour: (4,) red, green, blue, opacity, 0 .. 1.
        rotation: (9,) of a shape that has a middle.
        glow: its own light, 0 .. 1, so that it is seen in shadows.
    """

    shape: int
    start: np.ndarray
    end: np.ndarray | None
    size: np.ndarray
    colour: tuple[float, float, float, float]
    rotation: np.ndarray = np.eye(3).ravel()
    glow: float = _GLOW


def ball(middle, radius: float, colour) -> Marker:
    """Give a ball around a point [m]."""
    return Marker(_Geom.mjGEOM_SPHERE, np.array(middle), None, np.full(3, radius), colour)


def line(start, end, radius: float, colour) -> Marker:
    """Give a round line from point to point [m]."""
    return Marker(_Geom.mjGEOM_CAPSULE, np.array(start), np.array(end), np.array([radius]), colour)


def arrow(start, end, radius: float, colour) -> Marker:
    """Give an arrow from point to point [m]."""
    return Marker(_Geom.mjGEOM_ARROW, np.array(start), np.array(end), np.array([radius]), colour)


def box(middle, half_sizes, colour, rotation: np.ndarray | None = None) -> Marker:
    """Give a box around a point [m], turned by (3, 3)."""
    turn = np.eye(3) if rotation is None else rotation
    return Marker(
        _Geom.mjGEOM_BOX, np.array(middle), None, np.array(half_sizes), colour, turn.ravel()
    )


def polyline(points, radius: float, colour) -> list[Marker]:
    """Lines through points (n, 3) [m]."""
    return [line(a, b, radius, colour) for a, b in zip(points[:-1], points[1:], strict=True)]


def write_markers(scene: mujoco.MjvScene, markers: Sequence[Marker]) -> None:
    """Add shapes to a scene; those that find no room are left out.

    Args:
        scene: of MuJoCo, brought up to date.
        markers: the shapes.
    """
    for marker in markers[: scene.maxgeom - scene.ngeom]:
        geom = scene.geoms[scene.ngeom]
        colour = np.array(marker.colour, np.float32)
        size = np.resize(np.asarray(marker.size, float), 3)
        mujoco.mjv_initGeom(geom, marker.shape, size, marker.start, marker.rotation, colour)
        if marker.end is not None:
            width = float(marker.size[0])
            mujoco.mjv_connector(geom, marker.shape, width, marker.start, marker.end)
        geom.category, geom.emission = mujoco.mjtCatBit.mjCAT_DECOR.value, marker.glow
        scene.ngeom += 1


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
