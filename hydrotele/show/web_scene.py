"""3D scene and pressure plots of a simulated machine in a viser server on this computer.

The scene needs no OpenGL on the server: the browser draws it.
"""

import contextlib
import io
import logging
import threading
from collections import deque
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from hydrotele.show import meshes as shapes
from hydrotele.show.rerun_scene import GROUND_COLOURS, GROUND_HALF_SIZE, TILE_LENGTH, compute_machine_camera
from hydrotele.show.visual_geometry import BodyMesh, body_meshes, ground_height
from hydrotele.show.web_server import import_viser

_PLOT_DURATION, _PLOT_INTERVAL = 10.0, 0.1  # s, simulated time that a plot displays, and its resolution
_PLOT_HEIGHT = 130  # pixels
_LINE_COLOURS = ("#1f6feb", "#d1242f")  # head and rod side
_CLOSE_TIMEOUT = 5.0  # s


class WebScene:
    """A viser server that displays a machine and the pressures of its hydraulic axes."""

    def __init__(self, model: mujoco.MjModel, hydraulic_axes: Sequence[str]) -> None:
        """Start the viser server on a free port of this computer.

        Args:
            model: model with visual geometry.
            hydraulic_axes: names of the axes with pressures.
        """
        self._model, self._data = model, mujoco.MjData(model)
        self._server = _start_viser()
        self.port = int(self._server.get_port())
        moving = [i for i in range(model.nbody) if model.body_weldid[i] != 0]
        self._frames = {i: self._server.scene.add_frame(f"/body_{i}", show_axes=False) for i in range(model.nbody)}
        self._moving = np.array(moving, dtype=int)
        for number, look in enumerate(body_meshes(model)):
            _add_mesh(self._server.scene, f"/body_{look.body}/mesh_{number}", look)
        self._add_ground()
        camera, target = compute_machine_camera(model, None)
        self._server.initial_camera.position, self._server.initial_camera.look_at = tuple(camera), tuple(target)
        self._plots = self._add_plots(hydraulic_axes)
        self._history: deque[tuple[float, np.ndarray]] = deque()
        self._poses: np.ndarray | None = None
        self._newest: tuple[np.ndarray, np.ndarray, float] | None = None
        self._fresh, self._is_over = threading.Event(), False
        self._painter = threading.Thread(target=self._send_states, daemon=True)
        self._painter.start()

    def show(self, qpos: np.ndarray, pressures: np.ndarray, time: float) -> None:
        """Set the state that the pages display next.

        Args:
            qpos: (nq,) joint positions [m], [rad]; they are copied.
            pressures: (h, 2) head- and rod-side pressures of the hydraulic axes [Pa].
            time: simulated time [s].
        """
        self._newest = qpos.copy(), pressures, time
        self._fresh.set()

    def close(self) -> None:
        """Stop the viser server."""
        self._is_over = True
        self._fresh.set()
        self._painter.join(_CLOSE_TIMEOUT)
        with contextlib.redirect_stdout(io.StringIO()):  # viser prints that it stops
            self._server.stop()

    def _send_states(self) -> None:
        """Send the latest state to viser in a loop, in a separate thread so that the simulation does not wait."""
        while self._fresh.wait() and not self._is_over:
            self._fresh.clear()
            assert self._newest
            qpos, pressures, time = self._newest
            with self._server.atomic():
                self._set_poses(qpos)
            self._plot_pressures(pressures, time)

    def _set_poses(self, qpos: np.ndarray) -> None:
        """Set the poses of the bodies that have moved."""
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self._data)
        poses = np.hstack([self._data.xpos, self._data.xquat])
        if self._poses is None:
            moved = range(self._model.nbody)
        else:
            moved = self._moving[np.any(poses[self._moving] != self._poses[self._moving], axis=1)]
        for body in moved:
            self._frames[body].position, self._frames[body].wxyz = poses[body, :3], poses[body, 3:]
        self._poses = poses

    def _plot_pressures(self, pressures: np.ndarray, time: float) -> None:
        history = self._history
        if history and time < history[-1][0]:  # the machine was reset
            history.clear()
        if not self._plots or (history and time - history[-1][0] < _PLOT_INTERVAL):
            return
        history.append((time, 1e-6 * pressures))
        while time - history[0][0] > _PLOT_DURATION:
            history.popleft()
        times, values = np.array([at for at, _ in history]), np.array([value for _, value in history])
        with self._server.atomic():
            for number, plot in enumerate(self._plots):
                plot.data = (times, values[:, number, 0], values[:, number, 1])

    def _add_plots(self, axes: Sequence[str]) -> list[Any]:
        """Add a plot of the two pressures of each axis; return the plots."""
        gui = self._server.gui
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.set_panel_label("pressures [MPa]" if axes else "no hydraulic axes")
        empty = np.zeros(1)
        lines = tuple(
            {"label": side, "stroke": colour, "width": 1.5}
            for side, colour in zip(("head", "rod"), _LINE_COLOURS, strict=True)
        )
        return [
            gui.add_uplot(
                data=(empty, empty, empty), series=({"label": "s"}, *lines), title=axis,
                scales={"x": {"time": False}}, height=_PLOT_HEIGHT,
                axes=({"size": 24}, {"size": 36}), legend={"show": False},
            )
            for axis in axes
        ]  # fmt: skip

    def _add_ground(self) -> None:
        height = ground_height(self._model)
        if height is None:
            return
        mesh, parity = shapes.make_chequered_square(GROUND_HALF_SIZE, round(2.0 * GROUND_HALF_SIZE / TILE_LENGTH))
        mesh = shapes.transform_mesh(mesh, (0.0, 0.0, height), np.eye(3))
        _add_mesh(self._server.scene, "/ground", BodyMesh(0, 1.0, mesh, GROUND_COLOURS[parity]))


def _start_viser() -> Any:
    """Start a viser server on a free port, without its messages on standard output."""
    viser = import_viser()

    class Viewer(viser.ViserServer):
        """A viser server that no page can publish in the internet."""

        def request_share_url(self, verbose: bool = True) -> None:
            """Do nothing."""

    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)  # no tracebacks of failed connections
    with contextlib.redirect_stdout(io.StringIO()):
        return Viewer(host="127.0.0.1", port=0, verbose=False)


def _add_mesh(scene: Any, name: str, look: BodyMesh) -> None:
    """Add the mesh of a body to a viser scene; a transparent one has the mean colour of its vertices."""
    if look.opacity < 1.0:
        scene.add_mesh_simple(
            name, look.mesh.vertices, look.mesh.triangles, color=look.colours.mean(axis=0) / 255.0,
            opacity=look.opacity, cast_shadow=False,
        )  # fmt: skip
        return
    import trimesh

    mesh = trimesh.Trimesh(
        look.mesh.vertices, look.mesh.triangles, vertex_normals=look.mesh.normals,
        vertex_colors=look.colours, process=False,
    )  # fmt: skip
    scene.add_mesh_trimesh(name, mesh)
