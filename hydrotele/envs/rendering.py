"""Render running tasks: the machine with its visual geometry, and markers that show the goal.

`TaskRenderer` copies the state of a simulation to a model with visual geometry and draws it. One function
per kind of task makes the markers from the goal of an episode. A bed of soil is drawn as boxes in
the plane of the arm; the undisturbed bank is darker than the loose soil on top.
"""

import copy
import math
import threading
from collections.abc import Callable

import mujoco
import numpy as np
from mujoco.batch import MODEL_FIELDS

from hydrotele.control.arm_kinematics import arm_specification
from hydrotele.core.errors import InputError
from hydrotele.envs.episode import MAX_ARM_AXES
from hydrotele.envs.episode_batch import TaskCore
from hydrotele.envs.grade import MAX_RADIUS, MIN_RADIUS, target_plane_height
from hydrotele.envs.hold_force import MEASURED_FORCE, reference_force
from hydrotele.envs.load_truck import BANK_AZIMUTH, undisturbed_height
from hydrotele.envs.place_log import GOAL_POSE, LOG_HALF_LENGTH, LOG_RADIUS
from hydrotele.envs.soil_bed import CELL_COUNT, CELL_LENGTH, PROFILE_START, TERRAIN_SIZE
from hydrotele.envs.straight_line import SETTLE_TIME, compute_line_pose
from hydrotele.envs.track_trajectory import compute_axis_reference
from hydrotele.envs.truck_bed import LOAD_CELL_COUNT, LOAD_CELL_LENGTH, TRUCK
from hydrotele.kinematics.task_space import (
    BASE_RADIUS,
    BOOM_LENGTH,
    LATERAL_OFFSET,
    STICK_LENGTH,
    TOOL_ALONG,
    compute_tip_pose,
)
from hydrotele.show.offscreen_renderer import (
    Canvas,
    Marker,
    make_arrow_marker,
    make_ball_marker,
    make_box_marker,
    make_line_marker,
    make_polyline_markers,
)
from hydrotele.simulate.batch import STATE_KIND
from hydrotele.simulate.mechanism import compile_mechanism
from hydrotele.soil.parameters import CAT215

_BANK_COLOUR, _LOOSE_COLOUR = (0.36, 0.25, 0.15, 1.0), (0.62, 0.47, 0.30, 1.0)
_GROUND_COLOUR, _BANK_SIDE = (0.45, 0.40, 0.32, 1.0), 2.5  # of the ground next to a trench, m of it that are drawn
_MIN_LOOSE_THICKNESS = 1e-3  # m, maximum thickness of loose soil that is not drawn


def _house_rotation(core: TaskCore, number: int) -> np.ndarray:
    """Return the rotation matrix (3, 3) by which the upper structure and the plane of the arm are rotated.

    It follows from the true swing angle of the simulation `number`.
    """
    swing = float(core.episodes["position"][number][core.parameters["driven_axis"][0]])
    return _rotation_about_z(swing)


def make_soil_markers(core: TaskCore, number: int) -> list[Marker]:
    """Return boxes for the cells of the soil profile of an episode: undisturbed bank, and loose soil on it.

    Args:
        core: the running task, with a bed of soil.
        number: index of the episode.

    Returns:
        The boxes, in the world frame.
    """
    terrain, turn = core.terrain[number], _house_rotation(core, number)
    surface, loose = terrain[:CELL_COUNT], terrain[CELL_COUNT : 2 * CELL_COUNT]
    side, half = float(core.parameters["arm"][LATERAL_OFFSET]), 0.5 * CAT215.width
    bottom = min(0.0, float(np.min(surface)) - _MIN_LOOSE_THICKNESS)  # 0 is the level of the tracks

    def make_cell_box(i: int, low: float, high: float, colour) -> Marker:
        middle = turn @ [PROFILE_START + (i + 0.5) * CELL_LENGTH, side, 0.5 * (low + high)]
        return make_box_marker(middle, (0.5 * CELL_LENGTH, half, 0.5 * (high - low)), colour, turn)

    bank = surface - loose
    boxes = [make_cell_box(i, bottom, float(bank[i]), _BANK_COLOUR) for i in range(CELL_COUNT)]
    heaps = [i for i in range(CELL_COUNT) if loose[i] > _MIN_LOOSE_THICKNESS]
    return boxes + [make_cell_box(i, float(bank[i]), float(surface[i]), _LOOSE_COLOUR) for i in heaps]


def _make_load_markers(core: TaskCore, number: int) -> list[Marker]:
    """Return boxes for the bank, the undisturbed ground next to it, and the load of the truck."""
    terrain, goal = core.terrain[number], core.episodes["goal"][number]
    azimuth, half = float(goal[BANK_AZIMUTH]), 0.5 * CAT215.width
    turn = _rotation_about_z(azimuth)
    surface, loose = terrain[:CELL_COUNT], terrain[CELL_COUNT : 2 * CELL_COUNT]
    markers = []

    def add(r: float, side: float, width: float, low: float, high: float, colour) -> None:
        middle = turn @ [r, side, 0.5 * (low + high)]
        sizes = (0.5 * CELL_LENGTH, 0.5 * width, 0.5 * (high - low))
        markers.append(make_box_marker(middle, sizes, colour, turn)._replace(emission=0.0))

    bottom = float(surface.min()) - 0.1
    for i in range(CELL_COUNT):
        r = PROFILE_START + (i + 0.5) * CELL_LENGTH
        add(r, 0.0, 2.0 * half, bottom, float(surface[i] - loose[i]), _BANK_COLOUR)
        if loose[i] > _MIN_LOOSE_THICKNESS:
            add(r, 0.0, 2.0 * half, float(surface[i] - loose[i]), float(surface[i]), _LOOSE_COLOUR)
        high = float(undisturbed_height.py_func(goal, r))
        if high > 0.0:
            for side in (-1.0, 1.0):
                add(r, side * (half + 0.5 * _BANK_SIDE), _BANK_SIDE, 0.0, high, _GROUND_COLOUR)
    ahead = _rotation_about_z(TRUCK.direction)
    for i, height in enumerate(terrain[TERRAIN_SIZE : TERRAIN_SIZE + LOAD_CELL_COUNT]):
        if height > _MIN_LOOSE_THICKNESS:
            place = ahead @ [(i + 0.5) * LOAD_CELL_LENGTH - 0.5 * TRUCK.length, 0.0, 0.5 * float(height)]
            sizes = (0.5 * LOAD_CELL_LENGTH, 0.5 * TRUCK.width, 0.5 * float(height))
            place += [*TRUCK.position, TRUCK.floor_height]
            markers.append(make_box_marker(place, sizes, _LOOSE_COLOUR, ahead)._replace(emission=0.0))
    return markers


def _rotation_about_z(angle: float) -> np.ndarray:
    """Return the rotation matrix (3, 3) about the vertical by an angle [rad]."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def make_target_plane_markers(core: TaskCore, number: int, colour) -> list[Marker]:
    """Return the outline of the target plane over the ground to grade.

    Args:
        core: the running task.
        number: index of the episode.
        colour: (4,) colour of the lines.

    Returns:
        The lines, in the world frame.
    """
    goal, turn = core.episodes["goal"][number], _house_rotation(core, number)
    side, out = float(core.parameters["arm"][LATERAL_OFFSET]), 0.5 * CAT215.width + 0.03
    corners = [
        turn @ [r, side + y, target_plane_height.py_func(goal, r)]
        for r, y in (
            (MIN_RADIUS, -out),
            (MAX_RADIUS, -out),
            (MAX_RADIUS, out),
            (MIN_RADIUS, out),
            (MIN_RADIUS, -out),
        )
    ]
    return make_polyline_markers(np.array(corners), 0.02, colour)


_GOAL_COLOUR = (0.10, 0.75, 0.25, 1.0)  # colour of the reference
_PATH_COLOUR = (0.15, 0.45, 0.95, 1.0)  # colour of the future reference
_ERROR_COLOUR = (0.90, 0.15, 0.10, 1.0)  # colour of the error
_PREVIEW_TIME, _PATH_SEGMENTS = (
    3.0,
    30,
)  # s of the reference that are drawn ahead, number of line segments
_BALL_RADIUS, _THICK_WIDTH, _THIN_WIDTH = 0.15, 0.045, 0.035  # m, ball radius and line widths
_ARROW_LENGTH_PER_NEWTON = 7.0e-5  # m per N, length of a force arrow
_ARROW_DISTANCE = 0.3  # m between the arrows of two forces
_POINTER_LENGTH = 0.8  # m, length of the line that shows an attitude


def make_goal_markers(core: TaskCore, number: int) -> list[Marker]:
    """Return the markers of the goal of an episode; none for an unknown kind of task.

    Args:
        core: the running task.
        number: index of the episode.

    Returns:
        The markers, in the world frame.
    """
    draw = _MARKER_FUNCTIONS.get(core.setup.task.kind)
    return draw(core, number) if draw else []


def pose_to_cartesian_position(pose: np.ndarray) -> np.ndarray:
    """Return the Cartesian position (3,) [m] of a tip pose (r [m], theta [rad], z [m], ...)."""
    return np.array([pose[0] * math.cos(pose[1]), pose[0] * math.sin(pose[1]), pose[2]])


def _make_track_markers(core: TaskCore, number: int) -> list[Marker]:
    """Return markers of the reference tip position, its path over the next 3 s and the tip error."""
    episode, k = core.episodes[number], core.setup.arm_axes
    now = float(episode["tick"]) * core.setup.clock.period

    def tip_position_at(time: float) -> np.ndarray:
        joints, pose = np.empty(k), np.empty(MAX_ARM_AXES)
        for axis in range(k):
            driven = int(core.parameters["driven_axis"][axis])
            joints[axis] = compute_axis_reference(episode["goal"], driven, time)[0]
        compute_tip_pose(core.parameters["arm"], joints, pose)
        return pose_to_cartesian_position(pose)

    way = np.array([tip_position_at(now + ahead) for ahead in np.linspace(0.0, _PREVIEW_TIME, _PATH_SEGMENTS + 1)])
    off = make_line_marker(episode["tip"], way[0], _THICK_WIDTH, _ERROR_COLOUR)
    return [
        make_ball_marker(way[0], _BALL_RADIUS, _GOAL_COLOUR),
        off,
        *make_polyline_markers(way, _THIN_WIDTH, _PATH_COLOUR),
    ]


def _make_line_markers(core: TaskCore, number: int) -> list[Marker]:
    """Return markers of the line, the reference position on it and the tip error."""
    episode = core.episodes[number]
    now, pose, rate = (
        float(episode["tick"]) * core.setup.clock.period,
        np.zeros(MAX_ARM_AXES),
        np.zeros(MAX_ARM_AXES),
    )

    def line_position_at(time: float) -> np.ndarray:
        compute_line_pose(episode["goal"], time, pose, rate)
        return pose_to_cartesian_position(pose)

    end = core.setup.clock.horizon * core.setup.clock.ticks * core.setup.clock.period
    way = np.array([line_position_at(time) for time in np.linspace(SETTLE_TIME, end, _PATH_SEGMENTS + 1)])
    wanted = line_position_at(now)
    off = make_line_marker(episode["tip"], wanted, _THICK_WIDTH, _ERROR_COLOUR)
    return [
        make_ball_marker(wanted, _BALL_RADIUS, _GOAL_COLOUR),
        off,
        *make_polyline_markers(way, _THIN_WIDTH, _PATH_COLOUR),
    ]


def _make_force_markers(core: TaskCore, number: int) -> list[Marker]:
    """Return arrows on the plate for the reference force and the measured force."""
    episode, side = core.episodes[number], np.array([0.0, 0.5 * _ARROW_DISTANCE, 0.0])
    goal, foot = episode["goal"], episode["tip"] - np.array([0.6, 0.0, 0.0])
    now = float(episode["tick"]) * core.setup.clock.period
    wanted, _ = reference_force(goal, now)
    up = np.array([0.0, 0.0, _ARROW_LENGTH_PER_NEWTON])
    pushes = ((wanted, -side, _GOAL_COLOUR), (float(goal[MEASURED_FORCE]), side, _ERROR_COLOUR))
    return [
        make_arrow_marker(foot + way + max(0.0, force) * up, foot + way, 1.5 * _THICK_WIDTH, colour)
        for force, way, colour in pushes
    ]


def _make_reach_markers(core: TaskCore, number: int) -> list[Marker]:
    """Return markers of the goal position, the tip error and the goal attitude."""
    episode = core.episodes[number]
    pose = episode["goal"][:MAX_ARM_AXES]
    wanted, level = pose_to_cartesian_position(pose), math.cos(pose[3])
    ahead = np.array([level * math.cos(pose[1]), level * math.sin(pose[1]), math.sin(pose[3])])
    pointer = make_line_marker(wanted - _POINTER_LENGTH * ahead, wanted, _THICK_WIDTH, _PATH_COLOUR)
    return [
        make_ball_marker(wanted, _BALL_RADIUS, _GOAL_COLOUR),
        make_line_marker(episode["tip"], wanted, _THICK_WIDTH, _ERROR_COLOUR),
        pointer,
    ]


def _make_grade_markers(core: TaskCore, number: int) -> list[Marker]:
    """Return markers of the soil and of the target plane."""
    return [*make_soil_markers(core, number), *make_target_plane_markers(core, number, _GOAL_COLOUR)]


def _make_place_markers(core: TaskCore, number: int) -> list[Marker]:
    """Return markers of the axis and the outline of the log at its goal on the ground."""
    x, y, yaw = core.episodes[number]["goal"][GOAL_POSE]
    radius, half = (
        core.parameters["parameters"][LOG_RADIUS],
        core.parameters["parameters"][LOG_HALF_LENGTH],
    )
    way = np.array([math.cos(yaw), math.sin(yaw), 0.0])
    aside = radius * np.array([-math.sin(yaw), math.cos(yaw), 0.0])
    middle = np.array([x, y, 0.02])
    ends = [middle + half * a * way + b * aside for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
    rim = make_polyline_markers(np.array([*ends, ends[0]]), 0.03, _GOAL_COLOUR)
    return [*rim, make_line_marker(middle - half * way, middle + half * way, 0.03, _GOAL_COLOUR)]


_MARKER_FUNCTIONS: dict[str, Callable[[TaskCore, int], list[Marker]]] = {
    "track": _make_track_markers,
    "line": _make_line_markers,
    "force": _make_force_markers,
    "reach": _make_reach_markers,
    "grade": _make_grade_markers,
    "place": _make_place_markers,
    "load": _make_load_markers,
}


_AZIMUTH, _ELEVATION = 232.0, -20.0  # degree: view from the front, the side and above
_MAX_CACHED_MODELS = 16  # maximum number of cached models
FREE_CAMERA = -1  # number of the free camera

Camera = str | int | None


class TaskRenderer:
    """Renderer of the simulations of a task; it holds a model with visual geometry.

    Attributes:
        model: model with visual geometry; `update` sets its parameters to those of the variant shown.
        data: data of the simulation shown.
    """

    def __init__(self, core: TaskCore) -> None:
        """Compile the machine of the first variant with visual geometry.

        Args:
            core: the running task.
        """
        self._core = core
        self._cached_models: dict[tuple[int, str], mujoco.MjModel] = {}
        self._current_model = self._get_visual_model(0)
        self.model = copy.copy(self._current_model)
        self.data = mujoco.MjData(self.model)
        self._canvas: Canvas | None = None
        self._lock = threading.Lock()  # of the images

    def _get_visual_model(self, variant: int) -> mujoco.MjModel:
        """Return the model of a variant with visual geometry; compile it on first use."""
        variants, task = self._core.setup.variants, self._core.setup.task
        machine, things = variants.machines[variant], variants.surroundings[variant]
        key = id(machine), repr(things)
        if key not in self._cached_models:
            model = compile_mechanism(machine, ground=task.ground, surroundings=things)
            assert mujoco.mj_stateSize(model, STATE_KIND) == self._core.simulations.state.shape[1]
            self._set_free_camera(model)
            self._cached_models[key] = model
            while len(self._cached_models) > _MAX_CACHED_MODELS:
                self._cached_models.pop(next(iter(self._cached_models)))
        return self._cached_models[key]

    def _set_free_camera(self, model: mujoco.MjModel) -> None:
        """Set the default view of the model's free camera so that it shows the whole workspace of the arm."""
        machine = self._core.setup.machine
        if machine.arm:
            numbers = arm_specification(machine)[0]
            far = float(numbers[[BASE_RADIUS, BOOM_LENGTH, STICK_LENGTH]].sum() + abs(numbers[TOOL_ALONG]))
            model.stat.center[:] = 0.40 * far, 0.0, 0.18 * far
            model.stat.extent = far
        model.vis.global_.azimuth, model.vis.global_.elevation = _AZIMUTH, _ELEVATION

    def update(self, number: int = 0) -> None:
        """Copy the parameters and the state of a simulation to `model` and `data`.

        Args:
            number: index of the simulation.
        """
        variant = int(self._core.episodes["variant"][number])
        if (wanted := self._get_visual_model(variant)) is not self._current_model:
            copy_model_parameters(wanted, self.model)
            self._current_model = wanted
        mujoco.mj_setState(self.model, self.data, self._core.simulations.state[number], STATE_KIND)
        mujoco.mj_forward(self.model, self.data)

    def make_markers(self, number: int = 0) -> list[Marker]:
        """Return the markers that show the goal of the simulation `number`, in the world frame."""
        return make_goal_markers(self._core, number)

    def find_camera(self, which: Camera = None) -> mujoco.MjvCamera:
        """Return a camera by name or number.

        Args:
            which: name or number of a camera of the machine; None, -1 or `free` for a free camera
                that shows the whole workspace of the arm.

        Returns:
            The camera.

        Raises:
            InputError: the camera does not exist.
        """
        camera = mujoco.MjvCamera()
        names = [self.model.camera(i).name for i in range(self.model.ncam)]
        if which is None or which == FREE_CAMERA or which == "free":
            mujoco.mjv_defaultFreeCamera(self.model, camera)
            return camera
        if which in names:
            which = names.index(which)
        if not (isinstance(which, (int, np.integer)) and 0 <= which < len(names)):
            raise InputError(f"camera {which!r}", f"choose one of {', '.join((*names, 'free'))}")
        camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, int(which)
        return camera

    def render(self, number: int = 0, width: int = 640, height: int = 480, camera: Camera = None) -> np.ndarray:
        """Render the current state of a simulation with the markers of its goal.

        The OpenGL context is reused for images of the same size.

        Args:
            number: index of the simulation.
            width: [pixel].
            height: [pixel].
            camera: see the method `find_camera`.

        Returns:
            (height, width, 3) uint8.

        Raises:
            InputError: the camera does not exist, the size is not possible, or OpenGL does not
                work.
        """
        view = self.find_camera(camera)
        with self._lock:
            if self._canvas is None or self._canvas.size != (width, height):
                self.close()
                self._canvas = Canvas(self.model, width, height)
            self.update(number)
            return self._canvas.draw(self.model, self.data, view, self.make_markers(number))

    def close(self) -> None:
        """Free the OpenGL context."""
        if self._canvas:
            self._canvas.close()
            self._canvas = None


def copy_model_parameters(source: mujoco.MjModel, target: mujoco.MjModel) -> None:
    """Copy the parameters of a model, except those of `opt`, to another model of the same structure.

    Args:
        source: the model to copy from.
        target: the model to write to.
    """
    for name in MODEL_FIELDS:
        if not name.startswith("opt."):
            getattr(target, name)[...] = getattr(source, name)
