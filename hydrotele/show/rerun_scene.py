"""3D scene of a rerun recording: machines, ground, soil and tool-tip paths, with the camera that shows them."""

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from hydrotele.logs.log import Log
from hydrotele.machine.machine import Machine
from hydrotele.scenario.surrounding_objects import SoilGround
from hydrotele.show import meshes as shapes
from hydrotele.show.logged_poses import (
    Poses,
    body_poses,
    extract_joint_motion,
    logged_surroundings,
    point_trajectory,
)
from hydrotele.show.rerun_blueprint import Scene
from hydrotele.show.rerun_stream import TIMELINE, time_column
from hydrotele.show.soil_shapes import (
    LOOSE_COLOUR,
    SoilHistory,
    SoilShape,
    make_bucket_load_mesh,
    make_ground_around_trench,
    soil_history,
    trench_mesh,
)
from hydrotele.show.visual_geometry import BodyMesh, body_meshes, ground_height, visible_bounds
from hydrotele.simulate.mechanism import compile_mechanism

if TYPE_CHECKING:
    import rerun as rr

_GHOST_COLOUR = np.array([40.0, 130.0, 255.0])
_GHOST_TINT = 0.7  # fraction of the ghost colour in the displayed colour
_GHOST_OPACITY = 0.35
_GHOST_INSET = 0.01  # m, reduction in size, so that the solid machine hides an equal ghost
GROUND_COLOURS = np.array([[134, 122, 104], [144, 131, 112]], dtype=np.uint8)
GROUND_HALF_SIZE, TILE_LENGTH = 20.0, 2.0  # m
_SOIL_PERIOD = 0.1  # s between two meshes of the same trench
_TIP_COLOUR, _GHOST_TIP_COLOUR = (215, 40, 30), (40, 110, 230)


def log_machine(
    stream: "rr.RecordingStream",
    root: str,
    model: mujoco.MjModel,
    poses: Poses,
    clock: "rr.TimeColumn",
    ghost: bool = False,
) -> None:
    """Add a moving 3D machine to a recording: its meshes once, the poses of its bodies for all times.

    Args:
        stream: recording stream.
        root: parent entity of the bodies.
        model: model with visual geometry.
        poses: body poses at n times; a single pose is static.
        clock: n times.
        ghost: draw only moving bodies, tinted and transparent.
    """
    moving = [i for i in range(model.nbody) if model.body_weldid[i] != 0]
    for look in body_meshes(model):
        if ghost and look.body not in moving:
            continue
        part = "shape" if look.opacity == 1.0 else f"glass_{round(100 * look.opacity)}"
        path = f"{root}/{poses.bodies[look.body]}/{part}"
        stream.log(path, make_rerun_mesh(look, ghost), static=True)
    for body, name in enumerate(poses.bodies):
        if body in moving or not ghost:
            _log_body_poses(stream, f"{root}/{name}", poses, body, clock, static=body not in moving)


def make_rerun_mesh(look: BodyMesh, ghost: bool = False) -> "rr.Mesh3D":
    """Convert the mesh of a body to a rerun mesh; a ghost (second machine) is tinted and transparent."""
    import rerun as rr

    colours, opacity, vertices = look.colours, look.opacity, look.mesh.vertices
    if ghost:
        vertices = vertices - _GHOST_INSET * look.mesh.normals
        colours = (1.0 - _GHOST_TINT) * colours + _GHOST_TINT * _GHOST_COLOUR
        opacity *= _GHOST_OPACITY
    return rr.Mesh3D(
        vertex_positions=vertices.astype(np.float32),
        vertex_normals=look.mesh.normals.astype(np.float32),
        triangle_indices=look.mesh.triangles.astype(np.uint32),
        vertex_colors=np.asarray(colours, dtype=np.uint8),
        albedo_factor=[1.0, 1.0, 1.0, opacity] if opacity < 1.0 else None,
    )


def log_ground(stream: "rr.RecordingStream", model: mujoco.MjModel, soil: SoilHistory | None = None) -> bool:
    """Add a chequered ground with tiles of 2 m to a recording, if the model has a ground plane.

    With soil, the ground has a gap for the strip in which the bucket digs.

    Returns:
        Whether the model has a ground plane.
    """
    height = ground_height(model)
    if height is None:
        return False
    if soil:
        mesh, parity = make_ground_around_trench(soil.bed, GROUND_HALF_SIZE, TILE_LENGTH)
    else:
        mesh, parity = shapes.make_chequered_square(GROUND_HALF_SIZE, round(2.0 * GROUND_HALF_SIZE / TILE_LENGTH))
    mesh = shapes.transform_mesh(mesh, (0.0, 0.0, height), np.eye(3))
    stream.log("ground", make_rerun_mesh(BodyMesh(0, 1.0, mesh, GROUND_COLOURS[parity])), static=True)
    return True


def log_soil(stream: "rr.RecordingStream", root: str, bucket: str, soil: SoilHistory, time: np.ndarray) -> None:
    """Add the changing soil to a recording: trench and heaps, and the soil in the bucket.

    Trench and heaps are updated at most every 0.1 s, the soil in the bucket at every change.

    Args:
        stream: recording stream.
        root: parent entity of the machine.
        bucket: name of the bucket's body.
        soil: soil at the rows of the log.
        time: (n,) times of the rows [s].
    """
    import rerun as rr

    drawn_at, drawn, load = -np.inf, None, np.empty((0, 2))
    for row, shape in enumerate(soil.shapes):
        stream.set_time(TIMELINE, duration=float(time[row]))
        is_last = row == len(time) - 1
        if drawn is None or ((time[row] - drawn_at >= _SOIL_PERIOD or is_last) and _has_soil_changed(drawn, shape)):
            mesh, colours = trench_mesh(soil.bed, shape)
            stream.log(f"{root}/soil", make_rerun_mesh(BodyMesh(0, 1.0, mesh, colours.astype(np.uint8))))
            drawn_at, drawn = time[row], shape
        if not np.array_equal(load, shape.load):
            load, path = shape.load, f"{root}/{bucket}/load"
            if (mesh := make_bucket_load_mesh(soil, row)) is None:
                stream.log(path, rr.Clear(recursive=False))
            else:
                colours = np.tile(LOOSE_COLOUR, (len(mesh.vertices), 1)).astype(np.uint8)
                stream.log(path, make_rerun_mesh(BodyMesh(0, 1.0, mesh, colours)))
    stream.reset_time()


def _has_soil_changed(before: SoilShape, now: SoilShape) -> bool:
    return not (np.array_equal(before.surface, now.surface) and np.array_equal(before.loose, now.loose))


def log_tip(
    stream: "rr.RecordingStream",
    root: str,
    tip: np.ndarray | None,
    clock: "rr.TimeColumn",
    ghost: bool = False,
) -> None:
    """Add the path of the tool tip to a recording: whole path, latest part, current point.

    The entity `trail` has one line segment per row; the layout selects the displayed seconds.
    Nothing is added for fewer than two rows.

    Args:
        stream: recording stream.
        root: parent entity of the path.
        tip: (n, 3) positions in the world [m], or None.
        clock: n times.
        ghost: whether the machine is a second one, whose path is blue and thinner.
    """
    import rerun as rr

    if tip is None or len(tip) < 2:
        return
    colour = _GHOST_TIP_COLOUR if ghost else _TIP_COLOUR
    pale = [round(0.5 * (c + 220)) for c in colour]
    thin = rr.LineStrips3D([tip.astype(np.float32)], colors=[pale], radii=[0.005])
    stream.log(f"{root}/way", thin, static=True)
    pieces = np.stack([np.concatenate([tip[:1], tip[:-1]]), tip], axis=1)
    style = rr.LineStrips3D.from_fields(colors=[colour], radii=[0.012 if ghost else 0.02])
    stream.log(f"{root}/trail", style, static=True)
    stream.send_columns(f"{root}/trail", [clock], rr.LineStrips3D.columns(strips=pieces))
    style = rr.Points3D.from_fields(colors=[colour], radii=[0.06 if ghost else 0.07])
    stream.log(f"{root}/now", style, static=True)
    stream.send_columns(f"{root}/now", [clock], rr.Points3D.columns(positions=tip))


def _log_body_poses(stream, path: str, poses: Poses, body: int, clock, static: bool) -> None:
    import rerun as rr

    position = poses.position[:, body]
    quaternion = np.roll(poses.quaternion[:, body], -1, axis=1)  # rerun: x y z w
    if static or len(position) == 1:
        turn = rr.Quaternion(xyzw=quaternion[0])
        stream.log(path, rr.Transform3D(translation=position[0], quaternion=turn), static=True)
        return
    columns = rr.Transform3D.columns(translation=position, quaternion=quaternion)
    stream.send_columns(path, [clock], columns)


_EYE_DISTANCE = 1.4  # camera distance, relative to the radius of the scene


def log_scene(stream, entries) -> Scene:
    """Write machines, paths of their tool tips and surroundings to a recording; return the 3D view.

    The first machine is solid, the others are transparent. Ground, soil and camera are those of the
    first machine.

    Args:
        stream: recording stream.
        entries: {root entity, such as `measured`: (machine, log)}.
    """
    contents, trails, models, scene = [], [], {}, None
    for name, (machine, log) in entries.items():
        things = logged_surroundings(log)
        key = machine.model_dump_json() + log.metadata.get("surroundings", "")
        if key not in models:
            models[key] = compile_mechanism(machine, surroundings=things)
        model = models[key]
        poses = body_poses(machine, model, extract_joint_motion(machine, log), log)
        clock, tip = time_column(log.time), compute_tip_path(machine, log, poses)
        log_machine(stream, f"/{name}/machine", model, poses, clock, ghost=scene is not None)
        log_tip(stream, f"/{name}/tip_path", tip, clock, scene is not None)
        grounds = [thing for thing in things if isinstance(thing, SoilGround)]
        soil = soil_history(machine, grounds[0], log, poses) if grounds and len(log) > 1 else None
        contents += [f"/{name}/machine/**", f"/{name}/tip_path/**"]
        trails.append(f"/{name}/tip_path/trail")
        if scene is None:
            eye, target = compute_machine_camera(model, tip)
            ground = log_ground(stream, model, soil)
            if soil and machine.arm:
                log_soil(stream, f"/{name}/machine", machine.arm.tip.link, soil, log.time)
            scene = Scene(_scene_title(list(entries)), contents, trails, eye, target, ground)
    contents.append("/ground/**")
    assert scene is not None  # there is at least one entry
    return scene


def _scene_title(names: list[str]) -> str:
    solid, *glass = names
    return f"{solid} (solid), {', '.join(glass)} (transparent blue)" if glass else "machine"


def compute_tip_path(machine: Machine, log: Log, poses: Poses) -> np.ndarray | None:
    """Return the path of the tool tip (n, 3) in the world [m]; None for a machine without an arm.

    It is the true path if the log contains it, else it is computed from the body poses.
    """
    recorded = [f"truth.tip.{component}" for component in "xyz"]
    if all(name in log for name in recorded):
        return np.stack([log[name] for name in recorded], axis=1)
    if machine.arm is None or machine.arm.tip.link not in poses.bodies:
        return None
    return point_trajectory(poses, machine.arm.tip.link, machine.arm.tip.position)


def compute_machine_camera(model: mujoco.MjModel, tip: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Compute a camera that shows the whole machine and, if given, the whole path of its tip (n, 3).

    The direction is that of the camera `overview` if the model has one.

    Returns:
        (position of the camera (3,), point that it looks at (3,)) in the world [m].
    """
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    low, high = visible_bounds(model, data)
    camera = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, "overview")
    way = data.cam_xpos[camera] - 0.5 * (low + high) if camera >= 0 else np.array([1.6, 1.4, 0.8])
    if tip is not None:
        low, high = np.minimum(low, tip.min(axis=0)), np.maximum(high, tip.max(axis=0))
    target = 0.5 * (low + high)
    distance = _EYE_DISTANCE * 0.5 * float(np.linalg.norm(high - low))
    return target + distance * way / np.linalg.norm(way), target
