"""3D scene and pressure plots of a simulated machine in a viser server on this computer.

The scene needs no OpenGL on the server: the browser draws it.
"""

import contextlib
import io
import logging
import threading
import warnings
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
_PLOT_HEIGHT = 90  # pixels
_PRESSURE_RANGE = {
    "min": {"hard": 0.0, "soft": 0.0, "mode": 1, "pad": 0.0},
    "max": {"pad": 0.15, "soft": 1.0, "mode": 1},
}
_FIELD_OF_VIEW = 0.8  # rad, vertical
_MIN_ASPECT = 1.3  # width per height of a view that shows the whole machine from the default distance
_MAX_RETREAT = 3.0  # limit of the camera distance, relative to the default distance
_MIN_WIDTH_FOR_PLOTS = 700  # pixels, of a view in which the plots are open at first
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
        self._camera, self._target = compute_machine_camera(model, None)
        first = self._server.initial_camera
        first.position, first.look_at, first.fov = tuple(self._camera), tuple(self._target), _FIELD_OF_VIEW
        self._axes, self._plots = tuple(hydraulic_axes), {}
        self._server.gui.configure_theme(show_logo=False, show_share_button=False)
        self._server.gui.set_panel_label("MPa: head blue, rod red" if self._axes else "no hydraulic axes")
        self._history: deque[tuple[float, np.ndarray]] = deque()
        self._poses: np.ndarray | None = None
        self._newest: tuple[np.ndarray, np.ndarray, float] | None = None
        self._fresh, self._is_over = threading.Event(), False
        self._server.on_client_connect(self._fit_to_page)
        self._server.on_client_disconnect(lambda client: self._plots.pop(client.client_id, None))
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

    def _fit_to_page(self, client: Any) -> None:
        """Add the plots to a new page; close them in a small view, and move the camera of a narrow view back."""
        width, height = client.camera.image_width, client.camera.image_height
        if height and width < _MIN_ASPECT * height:
            way = (self._camera - self._target) * min(_MAX_RETREAT, _MIN_ASPECT * height / max(1, width))
            client.camera.position = self._target + way
            client.camera.look_at = self._target
        if self._axes:
            with client.gui.add_folder("pressures", expand_by_default=width >= _MIN_WIDTH_FOR_PLOTS):
                self._plots[client.client_id] = [_add_plot(client.gui, axis) for axis in self._axes]

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
        if history and time - history[-1][0] < _PLOT_INTERVAL:
            return
        history.append((time, 1e-6 * pressures))
        while time - history[0][0] > _PLOT_DURATION:
            history.popleft()
        if len(history) < 2:
            return
        times, values = np.array([at for at, _ in history]), np.array([value for _, value in history])
        for plots in list(self._plots.values()):
            for number, plot in enumerate(plots):
                plot.data = (times, values[:, number, 0], values[:, number, 1])

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
    warnings.filterwarnings("ignore", "Queued a .* on a closed connection")  # plots of a page that just closed
    with contextlib.redirect_stdout(io.StringIO()):
        return Viewer(host="127.0.0.1", port=0, verbose=False)


def _add_plot(gui: Any, axis: str) -> Any:
    """Add a plot of the head- and rod-side pressures of an axis to the panel of a page."""
    empty = np.array([0.0, _PLOT_INTERVAL])  # uPlot fails with a single point
    lines = tuple(
        {"label": side, "stroke": colour, "width": 1.5}
        for side, colour in zip(("head", "rod"), _LINE_COLOURS, strict=True)
    )
    return gui.add_uplot(
        data=(empty, empty, empty), series=({"label": "s"}, *lines), title=axis, height=_PLOT_HEIGHT,
        scales={"x": {"time": False}, "y": {"range": _PRESSURE_RANGE}},
        axes=({"size": 24}, {"size": 36}), legend={"show": False},
    )  # fmt: skip


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
