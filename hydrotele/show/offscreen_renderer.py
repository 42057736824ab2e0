"""Render a sequence of images in this process, without a screen.

`mujoco.Renderer` uses the OpenGL driver that was selected when `mujoco` was imported; on a computer
without a screen, this driver does not work. A `Canvas` selects a working driver when it is opened.
Markers are spheres, lines, arrows and boxes that are added to a scene and are not part of a model.
"""

import importlib
import os
import sys
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from hydrotele.core.errors import InputError

_MARKER_EMISSION = 0.4
_Geom = mujoco.mjtGeom


class Marker(NamedTuple):
    """Shape that is added to a scene.

    Attributes:
        shape: MuJoCo geom type.
        start: (3,) centre of the shape, or start point of a line or arrow [m].
        end: (3,) end point of a line or arrow [m]; None for other shapes.
        size: (3,) size of the MuJoCo geom, or (1,) radius of a line or arrow [m].
        colour: (4,) red, green, blue, opacity, 0 .. 1.
        rotation: (9,) rotation matrix of a shape with a centre.
        emission: emission, 0 .. 1, so that the marker is visible in shadows.
    """

    shape: int
    start: np.ndarray
    end: np.ndarray | None
    size: np.ndarray
    colour: tuple[float, float, float, float]
    rotation: np.ndarray = np.eye(3).ravel()
    emission: float = _MARKER_EMISSION


def make_ball_marker(middle, radius: float, colour) -> Marker:
    """Create a sphere to add to a rendered scene, with centre (3,) and radius [m] and RGBA colour."""
    return Marker(_Geom.mjGEOM_SPHERE, np.array(middle), None, np.full(3, radius), colour)


def make_line_marker(start, end, radius: float, colour) -> Marker:
    """Create a line to add to a rendered scene, between points (3,) [m], with radius [m] and RGBA colour."""
    return Marker(_Geom.mjGEOM_CAPSULE, np.array(start), np.array(end), np.array([radius]), colour)


def make_arrow_marker(start, end, radius: float, colour) -> Marker:
    """Create an arrow to add to a rendered scene, between points (3,) [m], with radius [m] and RGBA colour."""
    return Marker(_Geom.mjGEOM_ARROW, np.array(start), np.array(end), np.array([radius]), colour)


def make_box_marker(middle, half_sizes, colour, rotation: np.ndarray | None = None) -> Marker:
    """Create a box to add to a rendered scene.

    Args:
        middle: (3,) centre in the world frame [m].
        half_sizes: (3,) half of the edge lengths [m].
        colour: (4,) red, green, blue, opacity, 0 .. 1.
        rotation: (3, 3) rotation matrix to the world frame; default none.
    """
    turn = np.eye(3) if rotation is None else rotation
    return Marker(_Geom.mjGEOM_BOX, np.array(middle), None, np.array(half_sizes), colour, turn.ravel())


def make_polyline_markers(points, radius: float, colour) -> list[Marker]:
    """Create lines to add to a rendered scene that connect consecutive points (n, 3) [m].

    The lines have a radius [m] and an RGBA colour.
    """
    return [make_line_marker(a, b, radius, colour) for a, b in zip(points[:-1], points[1:], strict=True)]


def add_markers_to_scene(scene: mujoco.MjvScene, markers: Sequence[Marker]) -> None:
    """Add shapes to a MuJoCo scene as decoration; those beyond its capacity are omitted.

    Args:
        scene: updated MuJoCo scene.
        markers: shapes to add.
    """
    for marker in markers[: scene.maxgeom - scene.ngeom]:
        geom = scene.geoms[scene.ngeom]
        colour = np.array(marker.colour, np.float32)
        size = np.resize(np.asarray(marker.size, float), 3)
        mujoco.mjv_initGeom(geom, marker.shape, size, marker.start, marker.rotation, colour)
        if marker.end is not None:
            width = float(marker.size[0])
            mujoco.mjv_connector(geom, marker.shape, width, marker.start, marker.end)
        geom.category, geom.emission = mujoco.mjtCatBit.mjCAT_DECOR.value, marker.emission
        scene.ngeom += 1


PACKAGES = "libegl1 and libgl1-mesa-dri, or libosmesa6"
_OFFSCREEN = ("egl", "osmesa")
_MAX_IMAGE_SIZE = 8192  # pixel, maximum width and height of an image
_MAX_SHADOW_SIZE = 4096  # pixel, maximum size of the shadow map
_MAX_MARKERS = 1000  # maximum number of markers


class Canvas:
    """Off-screen renderer for models of equal structure, whose meshes are loaded once.

    Any thread may use it, but only one at a time: its OpenGL context is current during a call only.

    Attributes:
        size: width and height [pixel].
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int) -> None:
        """Open an OpenGL context.

        Args:
            model: model with visual geometry; the size of its offscreen buffer is changed.
            width: image width [pixel].
            height: image height [pixel].

        Raises:
            InputError: the size is out of range, or no OpenGL driver works.
        """
        self._gl = self._context = None
        for name, length in (("width", width), ("height", height)):
            if not 1 <= length <= _MAX_IMAGE_SIZE:
                raise InputError(name, f"must be 1 to {_MAX_IMAGE_SIZE} pixels, not {length}")
        self.size = width, height
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        # A shadow map needs no more pixels than the image.
        model.vis.quality.shadowsize = min(_MAX_SHADOW_SIZE, 1 << (max(width, height) - 1).bit_length())
        self._gl, self._context = _open_render_context(model, width, height)
        self._scene = mujoco.MjvScene(model, model.ngeom + _MAX_MARKERS)
        self._option, self._rectangle = mujoco.MjvOption(), mujoco.MjrRect(0, 0, width, height)
        self._upright = np.empty((height, width, 3), np.uint8)

    def draw(
        self, model: mujoco.MjModel, data: mujoco.MjData, camera: mujoco.MjvCamera,
        markers: Sequence[Marker] = (),
    ) -> np.ndarray:  # fmt: skip
        """Render an image of the current state of a model.

        Args:
            model: model with the same structure as that of the canvas.
            data: state of the model, with updated body positions.
            camera: camera of the image.
            markers: additional shapes.

        Returns:
            Pixels (height, width, 3), uint8, in a new array.
        """
        if self._gl is None or self._context is None:
            raise RuntimeError("the canvas is closed")
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(model, data, self._option, None, camera, everything, self._scene)
        add_markers_to_scene(self._scene, markers)
        self._gl.make_current()
        try:
            mujoco.mjr_render(self._rectangle, self._scene, self._context)
            mujoco.mjr_readPixels(self._upright, None, self._rectangle, self._context)
        finally:
            _release_context(self._gl)
        return self._upright[::-1].copy()

    def close(self) -> None:
        """Release the OpenGL context."""
        context, gl, self._context, self._gl = self._context, self._gl, None, None
        if gl is not None:
            gl.make_current()
            if context is not None:
                context.free()
            gl.free()

    def __del__(self) -> None:
        """Release the OpenGL context when the object is deleted."""
        if sys.meta_path is not None:  # at interpreter exit the drivers are already unloaded
            self.close()


def has_screen() -> bool:
    """Return whether a screen for windows is likely to exist."""
    seen = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
    return seen or not sys.platform.startswith("linux")


def _open_render_context(model: mujoco.MjModel, width: int, height: int):
    """Open an off-screen OpenGL context with the first driver that works.

    Args:
        model: model to render.
        width: image width [pixel].
        height: image height [pixel].

    Returns:
        (OpenGL context, MuJoCo render context).

    Raises:
        InputError: no driver works; the message names the packages to install.
    """
    reasons = []
    for name in _list_opengl_drivers():
        gl = None
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # GLFW warns without a screen
                gl = importlib.import_module(f"mujoco.{name}").GLContext(width, height)
                gl.make_current()
            context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
            mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, context)
            _release_context(gl)
            return gl, context
        except Exception as error:  # drivers raise many types of exceptions
            reasons.append(f"{name}: {error}")
            if gl is not None:
                gl.free()
    raise InputError(
        "picture",
        "OpenGL cannot render without a screen; install its software drivers"
        f" (Debian: {PACKAGES}), or select another driver by the environment variable"
        f" MUJOCO_GL=egl or MUJOCO_GL=osmesa. {'; '.join(reasons)}",
    )


def _release_context(gl: Any) -> None:
    """Release the OpenGL context from this thread, so that another thread can make it current."""
    driver = sys.modules[type(gl).__module__]
    if egl := getattr(driver, "EGL", None):
        egl.eglBindAPI(egl.EGL_OPENGL_API)  # a state of the thread
        egl.eglMakeCurrent(driver.EGL_DISPLAY, egl.EGL_NO_SURFACE, egl.EGL_NO_SURFACE, egl.EGL_NO_CONTEXT)
    elif glfw := getattr(driver, "glfw", None):
        glfw.make_context_current(None)
    elif osmesa := getattr(driver, "osmesa", None):
        osmesa.OSMesaMakeCurrent(None, None, driver.GL.GL_FLOAT, 0, 0)
    elif cgl := getattr(driver, "cgl", None):
        cgl.CGLUnlockContext(gl._context)  # `make_current` locks it: another thread would wait for ever
        cgl.CGLSetCurrentContext(None)


def _list_opengl_drivers() -> tuple[str, ...]:
    wanted = os.environ.get("MUJOCO_GL", "").lower()
    if wanted in _OFFSCREEN:
        return (wanted,)
    if sys.platform == "darwin":
        return ("cgl", "glfw")
    return ("egl", "glfw") if has_screen() else ("egl",)  # GLFW last: it works in one thread only
