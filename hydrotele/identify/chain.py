"""A mechanism read from an MJCF: a joint tree whose loops are closed by `connect` constraints."""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from hydrotele.core.errors import InputError

_HINGE, _SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
_WHERE = "chain"


class Tree(NamedTuple):
    """Numbers of a joint tree, as compiled code takes them; b bodies with the world, v joints.

    Attributes:
        parent: (b,) parent body.
        offset: (b, 3) place of a body's frame in its parent's [m].
        turn: (b, 3, 3) its orientation.
        first: (b + 1,) first joint of a body; its joints end where the next body's begin.
        slides: (v,) whether a joint slides instead of turning.
        axis: (v, 3) in the body's frame.
        anchor: (v, 3) in the body's frame [m].
        zero: (v,) position at which the frames stand as in the file [rad] or [m].
        above: (b, v) whether a joint moves a body.
        ends: (c, 2) bodies that a closure connects.
        points: (c, 2, 3) the points that it holds together, in their bodies' frames [m].
        gravity: (3,) [m/s^2].
    """

    parent: np.ndarray
    offset: np.ndarray
    turn: np.ndarray
    first: np.ndarray
    slides: np.ndarray
    axis: np.ndarray
    anchor: np.ndarray
    zero: np.ndarray
    above: np.ndarray
    ends: np.ndarray
    points: np.ndarray
    gravity: np.ndarray


@dataclass(frozen=True)
class Chain:
    """A mechanism with names.

    Attributes:
        name: of the model.
        tree: its numbers.
        bodies: names of the bodies that move or carry mass, without the world.
        joints: names of the v joints.
        closures: names of the c closures.
        start: (v,) positions in which the loops are closed, as the file has them.
        inertia: (b - 1, 10) inertial parameters of the bodies, about their frames' origins.
        armature: (v,) inertia of a joint's drive [kg] or [kg m^2].
        damping: (v,) [N s/m] or [N m s/rad].
        drives: joints that an actuator moves, in the actuators' order.
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
    drives: tuple[str, ...]

    def index(self, joint: str) -> int:
        """Place of a joint.

        Raises:
            InputError: there is no such joint.
        """
        if joint not in self.joints:
            raise InputError(_WHERE, f"{self.name} has no joint {joint}: {', '.join(self.joints)}")
        return self.joints.index(joint)


def load_chain(source: str | Path | mujoco.MjModel) -> Chain:
    """Read a mechanism.

    Args:
        source: path of an MJCF, or a compiled model.

    Returns:
        The chain. Actuators that move a joint name the drives; without any, all joints are.

    Raises:
        InputError: no such file, a joint that is neither hinge nor slide, or an active constraint
            other than `connect`.

    Source: MuJoCo manual, `mj_kinematics` and `mjData`.
    """
    model = _read(source) if isinstance(source, str | Path) else source
    _refuse(model)
    count = model.njnt
    above = np.zeros((model.nbody, count), dtype=np.bool_)
    for body in range(1, model.nbody):
        above[body] = above[model.body_parentid[body]]
        start = model.body_jntadr[body]
        if start >= 0:
            above[body, start : start + model.body_jntnum[body]] = True
    first = np.concatenate([[0], np.cumsum(model.body_jntnum)])
    ends, points = _closures(model)
    tree = Tree(
        parent=model.body_parentid.astype(np.int64), offset=model.body_pos.copy(),
        turn=np.array([_turn(q) for q in model.body_quat]), first=first.astype(np.int64),
        slides=model.jnt_type == _SLIDE, axis=model.jnt_axis.copy(), anchor=model.jnt_pos.copy(),
        zero=model.qpos0.copy(), above=above, ends=ends, points=points,
        gravity=model.opt.gravity.copy(),
    )  # fmt: skip
    joints = tuple(model.joint(j).name or f"joint{j}" for j in range(count))
    moved = [int(model.actuator_trnid[a, 0]) for a in range(model.nu)
             if model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT]  # fmt: skip
    return Chain(
        name=model.names[: model.names.index(b"\0")].decode() or "model",
        tree=tree,
        bodies=tuple(model.body(b).name or f"body{b}" for b in range(1, model.nbody)),
        joints=joints,
        closures=tuple(
            model.equality(e).name or f"closure{e}" for e in range(model.neq) if model.eq_active0[e]
        ),
        start=model.key_qpos[0].copy() if model.nkey else model.qpos0.copy(),
        inertia=np.array([_inertia(model, b) for b in range(1, model.nbody)]).reshape(-1, 10),
        armature=model.dof_armature.copy(),
        damping=model.dof_damping.copy(),
        drives=tuple(joints[j] for j in dict.fromkeys(moved)) or joints,
    )


def _read(path: str | Path) -> mujoco.MjModel:
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise InputError(str(path), str(error)) from error


def _refuse(model: mujoco.MjModel) -> None:
    for j in range(model.njnt):
        if model.jnt_type[j] not in (_HINGE, _SLIDE):
            raise InputError(
                _WHERE,
                f"joint {model.joint(j).name or j} is neither hinge nor slide: build it of those",
            )
    for e in range(model.neq):
        if model.eq_active0[e] and model.eq_type[e] != mujoco.mjtEq.mjEQ_CONNECT:
            raise InputError(
                _WHERE, f"constraint {model.equality(e).name or e} is no `connect`: not supported"
            )


def _closures(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Bodies (c, 2) and points (c, 2, 3) of the active `connect` constraints."""
    ends, points = [], []
    for e in range(model.neq):
        if not model.eq_active0[e]:
            continue
        one, two = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
        if model.eq_objtype[e] == mujoco.mjtObj.mjOBJ_SITE:
            ends.append([model.site_bodyid[one], model.site_bodyid[two]])
            points.append([model.site_pos[one], model.site_pos[two]])
        else:
            ends.append([one, two])
            points.append([model.eq_data[e, :3], model.eq_data[e, 3:6]])
    count = len(ends)
    return np.array(ends, np.int64).reshape(count, 2), np.array(points, float).reshape(count, 2, 3)


def _turn(quaternion: np.ndarray) -> np.ndarray:
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


def _inertia(model: mujoco.MjModel, body: int) -> list[float]:
    """Mass, mass times centre of mass, and inertia about the frame's origin, of a body."""
    mass, com, turn = model.body_mass[body], model.body_ipos[body], _turn(model.body_iquat[body])
    about = turn @ np.diag(model.body_inertia[body]) @ turn.T
    about += mass * (com @ com * np.eye(3) - np.outer(com, com))
    upper = about[np.triu_indices(3)]
    return [float(mass), *(mass * com), *upper]
