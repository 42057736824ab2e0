"""Read a mechanism from MJCF as a joint tree with loops closed by `connect` and `weld` constraints.

Every joint of the tree is a hinge or a slide. A ball joint becomes three successive hinges about x,
y and z (Cardan angles, singular if the second is 90 degrees). A free joint becomes three slides and
a ball joint.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.core.mjcf import load_model

_FREE, _BALL, _SLIDE, _HINGE = (
    int(getattr(mujoco.mjtJoint, f"mjJNT_{kind}")) for kind in ("FREE", "BALL", "SLIDE", "HINGE")
)
_CONNECT, _WELD = int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)
_ERROR_CONTEXT = "chain"


class Tree(NamedTuple):
    """Joint tree for compiled code; b bodies including the world, v joints, c closures.

    Attributes:
        parent: (b,) index of the parent body.
        offset: (b, 3) origin of the body frame in the parent frame [m].
        rotation: (b, 3, 3) orientation of the body frame in the parent frame.
        first_joint: (b + 1,) index of the first joint of a body; `first_joint[i + 1]` is the end.
        is_slide: (v,) whether a joint is a slide; otherwise it is a hinge.
        axis: (v, 3) joint axis in the body frame.
        anchor: (v, 3) point on the axis in the body frame [m].
        reference_position: (v,) joint position in the reference pose of the file [rad] or [m].
        is_moved: (b, v) whether a joint moves a body.
        closure_bodies: (c, 2) bodies that a closure connects.
        closure_points: (c, 2, 3) points that the closure makes coincide, in the body frames [m].
        closure_rotations: (c, 2, 3, 3) orientations that a weld makes coincide, in the body frames.
        first_equation: (c + 1,) index of the first equation of a closure: a connect has 3, a weld 6.
        gravity: (3,) [m/s^2].
    """

    parent: np.ndarray
    offset: np.ndarray
    rotation: np.ndarray
    first_joint: np.ndarray
    is_slide: np.ndarray
    axis: np.ndarray
    anchor: np.ndarray
    reference_position: np.ndarray
    is_moved: np.ndarray
    closure_bodies: np.ndarray
    closure_points: np.ndarray
    closure_rotations: np.ndarray
    first_equation: np.ndarray
    gravity: np.ndarray


@dataclass(frozen=True)
class Chain:
    """A mechanism with named bodies, joints and closures.

    Attributes:
        name: name of the model.
        tree: arrays of the joint tree.
        bodies: names of the bodies, without the world.
        joints: names of the v joints; those of a ball joint `elbow` are `elbow_rx`, `elbow_ry` and
            `elbow_rz`, those of a free joint also `elbow_x`, `elbow_y` and `elbow_z`.
        closures: names of the c closures.
        start: (v,) initial positions for closing the loops: those of the first keyframe of the
            file, or of its reference pose.
        inertia: (b - 1, 10) inertial parameters of the bodies about the origins of their frames.
        armature: (v,) drive inertia of a joint [kg] or [kg m^2].
        damping: (v,) [N s/m] or [N m s/rad].
        frictionloss: (v,) dry friction [N] or [N m].
        stiffness: (v,) stiffness of the joint spring [N/m] or [N m/rad].
        spring_rest: (v,) rest position of the joint spring [rad] or [m].
        drives: joints that an actuator moves, in the order of the actuators.
        qpos_indices: (v,) index of a joint in MuJoCo's `qpos`, -1 for parts of ball and free joints.
        dof_indices: (v,) index of a joint in MuJoCo's `qvel`, -1 likewise.
        source: file that it was read from, empty for a compiled model.
    """

    name: str
    tree: Tree
    bodies: tuple[str, ...]
    joints: tuple[str, ...]
    closures: tuple[str, ...]
    start: np.ndarray
    inertia: np.ndarray
    armature: np.ndarray
    damping: np.ndarray
    frictionloss: np.ndarray
    stiffness: np.ndarray
    spring_rest: np.ndarray
    drives: tuple[str, ...]
    qpos_indices: np.ndarray
    dof_indices: np.ndarray
    source: str = ""

    def index(self, joint: str) -> int:
        """Return the index of the joint with a given name among all joints of the chain.

        Raises:
            InputError: the joint does not exist.
        """
        if joint not in self.joints:
            raise InputError(_ERROR_CONTEXT, f"{self.name} has no joint {joint}: {', '.join(self.joints)}")
        return self.joints.index(joint)


class _Joint(NamedTuple):
    """A hinge or a slide of the tree; units and meaning as in `Tree` and `Chain`."""

    name: str
    body: int
    is_slide: bool
    axis: tuple[float, ...]
    anchor: tuple[float, ...]
    reference_position: float
    start: float
    armature: float
    damping: float
    frictionloss: float
    stiffness: float
    spring_rest: float
    qpos_index: int
    dof_index: int


def load_chain(source: str | Path | mujoco.MjModel) -> Chain:
    """Read a mechanism from an MJCF file or a compiled model.

    A kinematic tree without actuator and closure, such as an object on the ground next to a
    machine, is treated as fixed: its joints are removed. If no tree has an actuator or a closure,
    all joints are kept.

    Args:
        source: path of an MJCF file, or a compiled model.

    Returns:
        The chain. The drives are the joints with an actuator, or all joints if there is none.

    Raises:
        InputError: the file does not exist, a ball or free joint has an actuator, damping,
            armature, friction or a spring, or there is an active constraint other than `connect`
            and `weld`.

    Source: MuJoCo manual, `mj_kinematics` and `mjData`.
    """
    model = load_model(source) if isinstance(source, str | Path) else source
    closures = _read_closures(model)
    moved = [
        int(model.actuator_trnid[a, 0])
        for a in range(model.nu)
        if model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT
    ]
    held = {int(model.body_rootid[model.jnt_bodyid[j]]) for j in moved}
    held |= {int(model.body_rootid[body]) for one in closures for body in one.bodies}
    held = held - {0} or set(range(model.nbody))
    pose = model.key_qpos[0] if model.nkey else model.qpos0
    joints: list[_Joint] = []
    first = np.zeros(model.nbody + 1, np.int64)
    offset, turn = model.body_pos.copy(), np.array([_rotation_matrix(q) for q in model.body_quat])
    for b in range(model.nbody):
        for j in range(model.body_jntadr[b], model.body_jntadr[b] + model.body_jntnum[b]):
            if model.body_rootid[b] not in held:
                continue
            if model.jnt_type[j] == _FREE:  # its position is the absolute position of the body
                offset[b], turn[b] = 0.0, np.eye(3)
            joints += _split_joint(model, j, pose)
        first[b + 1] = len(joints)
    above = np.zeros((model.nbody, len(joints)), dtype=np.bool_)
    for b in range(1, model.nbody):
        above[b] = above[model.body_parentid[b]]
        above[b, first[b] : first[b + 1]] = True
    c, names = len(closures), tuple(joint.name for joint in joints)
    whole = {joint.qpos_index: joint.name for joint in joints if joint.qpos_index >= 0}
    for j in moved:
        if int(model.jnt_qposadr[j]) not in whole:
            raise InputError(
                _ERROR_CONTEXT,
                f"joint {model.joint(j).name or j} has a drive; it must be a hinge or slide",
            )
    tree = Tree(
        parent=model.body_parentid.astype(np.int64), offset=offset, rotation=turn, first_joint=first,
        is_slide=np.array([joint.is_slide for joint in joints], np.bool_),
        axis=np.array([joint.axis for joint in joints]).reshape(-1, 3),
        anchor=np.array([joint.anchor for joint in joints]).reshape(-1, 3),
        reference_position=np.array([joint.reference_position for joint in joints]), is_moved=above,
        closure_bodies=np.array([one.bodies for one in closures], np.int64).reshape(c, 2),
        closure_points=np.array([one.points for one in closures]).reshape(c, 2, 3),
        closure_rotations=np.array([one.rotations for one in closures]).reshape(c, 2, 3, 3),
        first_equation=np.cumsum([0, *(6 if one.is_weld else 3 for one in closures)]).astype(np.int64),
        gravity=model.opt.gravity.copy(),
    )  # fmt: skip
    return Chain(
        name=model.names[: model.names.index(b"\0")].decode() or "model",
        tree=tree,
        bodies=tuple(model.body(b).name or f"body{b}" for b in range(1, model.nbody)),
        joints=names,
        closures=tuple(one.name for one in closures),
        start=np.array([joint.start for joint in joints]),
        inertia=np.array([body_inertial_parameters(model, b) for b in range(1, model.nbody)]).reshape(-1, 10),
        armature=np.array([joint.armature for joint in joints]),
        damping=np.array([joint.damping for joint in joints]),
        frictionloss=np.array([joint.frictionloss for joint in joints]),
        stiffness=np.array([joint.stiffness for joint in joints]),
        spring_rest=np.array([joint.spring_rest for joint in joints]),
        drives=tuple(dict.fromkeys(whole[int(model.jnt_qposadr[j])] for j in moved)) or names,
        qpos_indices=np.array([joint.qpos_index for joint in joints], np.int64),
        dof_indices=np.array([joint.dof_index for joint in joints], np.int64),
        source=str(source) if isinstance(source, str | Path) else "",
    )


_AXES = tuple(enumerate("xyz"))


def _split_joint(model: mujoco.MjModel, j: int, pose: np.ndarray) -> list[_Joint]:
    """Convert MuJoCo's joint j to hinges and slides, with start positions from `pose`, a vector `qpos` (nq,).

    A ball joint gives three hinges about x, y and z in this order (Cardan angles), and a free joint
    three slides before them. Hinges and slides are kept.
    """
    name, kind = model.joint(j).name or f"joint{j}", model.jnt_type[j]
    body, anchor = int(model.jnt_bodyid[j]), tuple(model.jnt_pos[j])
    place, dof = int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
    if kind in (_HINGE, _SLIDE):
        return [
            _Joint(
                name, body, kind == _SLIDE, tuple(model.jnt_axis[j]), anchor,
                float(model.qpos0[place]), float(pose[place]), float(model.dof_armature[dof]),
                float(model.dof_damping[dof]), float(model.dof_frictionloss[dof]),
                float(model.jnt_stiffness[j]), float(model.qpos_spring[place]), place, dof,
            )
        ]  # fmt: skip
    last = dof + (3 if kind == _BALL else 6)
    stated = (model.dof_damping, model.dof_armature, model.dof_frictionloss)
    if any(values[dof:last].any() for values in stated) or model.jnt_stiffness[j]:
        raise InputError(
            _ERROR_CONTEXT,
            f"joint {name}: only hinges and slides may have damping, armature, friction or springs",
        )
    out, unit = [], np.eye(3)
    if kind == _FREE:
        anchor, ground = (0.0, 0.0, 0.0), pose[place : place + 3]
        for k, letter in _AXES:
            out.append(
                _Joint(f"{name}_{letter}", body, True, tuple(unit[k]), anchor, 0.0,
                       float(ground[k]), 0.0, 0.0, 0.0, 0.0, 0.0, -1, -1)
            )  # fmt: skip
        place += 3
    angles = cardan_angles(_rotation_matrix(pose[place : place + 4]))
    for k, letter in _AXES:
        out.append(
            _Joint(f"{name}_r{letter}", body, False, tuple(unit[k]), anchor, 0.0,
                   float(angles[k]), 0.0, 0.0, 0.0, 0.0, 0.0, -1, -1)
        )  # fmt: skip
    return out


def cardan_angles(rotation: np.ndarray) -> np.ndarray:
    """Return the Cardan angles (a, b, c) of a rotation about successive x, y and z axes, (3,) [rad].

    `R = R_x(a) R_y(b) R_z(c)` with b from -90 to 90 degrees.

    Args:
        rotation: (3, 3) rotation matrix R.

    Source: Diebel 2006, Representing attitude, 8.4 (sequence 1-2-3).

    >>> cardan_angles(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])).round(4)
    array([-0.    ,  0.    ,  1.5708])
    """
    middle = np.arcsin(np.clip(rotation[0, 2], -1.0, 1.0))
    return np.array(
        [
            np.arctan2(-rotation[1, 2], rotation[2, 2]),
            middle,
            np.arctan2(-rotation[0, 1], rotation[0, 0]),
        ]
    )


class _Closure(NamedTuple):
    name: str
    is_weld: bool
    bodies: tuple[int, int]
    points: tuple[np.ndarray, np.ndarray]
    rotations: tuple[np.ndarray, np.ndarray]


def _read_closures(model: mujoco.MjModel) -> list[_Closure]:
    """Return the loop closures of a model: its active `connect` and `weld` constraints.

    Raises InputError for an active constraint of another kind.
    """
    out = []
    for e in range(model.neq):
        if not model.eq_active0[e]:
            continue
        name, kind = model.equality(e).name or f"closure{e}", model.eq_type[e]
        if kind not in (_CONNECT, _WELD):
            raise InputError(
                _ERROR_CONTEXT,
                f"constraint {name} is neither `connect` nor `weld`: deactivate it, or replace it by these",
            )
        one, two, data = int(model.eq_obj1id[e]), int(model.eq_obj2id[e]), model.eq_data[e]
        turns = (np.eye(3), np.eye(3))
        if model.eq_objtype[e] == mujoco.mjtObj.mjOBJ_SITE:
            ends = (int(model.site_bodyid[one]), int(model.site_bodyid[two]))
            points = (model.site_pos[one].copy(), model.site_pos[two].copy())
            turns = (_rotation_matrix(model.site_quat[one]), _rotation_matrix(model.site_quat[two]))
        elif kind == _CONNECT:
            ends, points = (one, two), (data[:3].copy(), data[3:6].copy())
        else:
            ends, points = (one, two), (data[3:6].copy(), data[:3].copy())
            turns = (_rotation_matrix(data[6:10]), np.eye(3))  # of body 2 in body 1
        out.append(_Closure(name, kind == _WELD, ends, points, turns))
    return out


def _rotation_matrix(quaternion: np.ndarray) -> np.ndarray:
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


def body_inertial_parameters(model: mujoco.MjModel, body: int) -> list[float]:
    """Return the inertial parameters of a body: mass, first moments, and inertia about its frame's origin.

    Args:
        model: compiled model.
        body: index of the body.

    Returns:
        Ten values in the body frame: mass [kg], mass times centre of mass [kg m], and xx, xy, xz, yy, yz,
        zz of the inertia [kg m^2].
    """
    mass, com, turn = (
        model.body_mass[body],
        model.body_ipos[body],
        _rotation_matrix(model.body_iquat[body]),
    )
    about = turn @ np.diag(model.body_inertia[body]) @ turn.T
    about += mass * (com @ com * np.eye(3) - np.outer(com, com))
    upper = about[0, 0], about[0, 1], about[0, 2], about[1, 1], about[1, 2], about[2, 2]
    return [float(mass), *(mass * com), *upper]
