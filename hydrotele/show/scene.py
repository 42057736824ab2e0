"""A machine, the ground and the way of the tool tip as rerun entities."""

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from hydrotele.show import shapes
from hydrotele.show.looks import Look, body_looks, ground_height
from hydrotele.show.pose import Poses

if TYPE_CHECKING:
    import rerun as rr

_GHOST_COLOUR = np.array([40.0, 130.0, 255.0])
_GHOST_TINT = 0.7  # part of the ghost's own colour in what is seen
_GHOST_OPACITY = 0.35
_GHOST_INSET = 0.01  # m that it is smaller: where both machines agree, the solid one hides it
_GROUND_COLOURS = np.array([[134, 122, 104], [144, 131, 112]], dtype=np.uint8)
_GROUND_HALF_SIZE = 20.0  # m
_TIP_COLOUR, _GHOST_TIP_COLOUR = (215, 40, 30), (40, 110, 230)


def log_machine(
    stream: "rr.RecordingStream",
    root: str,
    model: mujoco.MjModel,
    poses: Poses,
    clock: "rr.TimeColumn",
    ghost: bool = False,
) -> None:
    """Log the shapes once, and where the bodies are by column.

    Args:
        stream: where to.
        root: entity above the bodies.
        model: the model with its looks.
        poses: n poses; one alone is static.
        clock: n times.
        ghost: draw only what moves, as tinted glass.
    """
    moving = [i for i in range(model.nbody) if model.body_weldid[i] != 0]
    for look in body_looks(model):
        if ghost and look.body not in moving:
            continue
        part = "shape" if look.opacity == 1.0 else f"glass_{round(100 * look.opacity)}"
        path = f"{root}/{poses.bodies[look.body]}/{part}"
        stream.log(path, mesh_entity(look, ghost), static=True)
    for body, name in enumerate(poses.bodies):
        if body in moving or not ghost:
            _log_way(stream, f"{root}/{name}", poses, body, clock, static=body not in moving)


def mesh_entity(look: Look, ghost: bool = False) -> "rr.Mesh3D":
    """A look as a rerun mesh; a ghost is tinted and transparent."""
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


def log_ground(stream: "rr.RecordingStream", model: mujoco.MjModel) -> bool:
    """Log a chequered ground with tiles of 2 m; tell whether the model has a ground plane."""
    height = ground_height(model)
    if height is None:
        return False
    mesh, parity = shapes.tiles(_GROUND_HALF_SIZE, int(_GROUND_HALF_SIZE))
    mesh = shapes.moved(mesh, (0.0, 0.0, height), np.eye(3))
    stream.log("ground", mesh_entity(Look(0, 1.0, mesh, _GROUND_COLOURS[parity])), static=True)
    return True


def log_tip(
    stream: "rr.RecordingStream",
    root: str,
    tip: np.ndarray | None,
    clock: "rr.TimeColumn",
    ghost: bool = False,
) -> None:
    """Log where the tip is (n, 3) [m]: the whole way as a thin line, its latest part, the point.

    `trail` holds one piece per row; the layout decides how many seconds of it are shown.
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


def _log_way(stream, path: str, poses: Poses, body: int, clock, static: bool) -> None:
    import rerun as rr

    position = poses.position[:, body]
    quaternion = np.roll(poses.quaternion[:, body], -1, axis=1)  # rerun: x y z w
    if static or len(position) == 1:
        turn = rr.Quaternion(xyzw=quaternion[0])
        stream.log(path, rr.Transform3D(translation=position[0], quaternion=turn), static=True)
        return
    columns = rr.Transform3D.columns(translation=position, quaternion=quaternion)
    stream.send_columns(path, [clock], columns)
